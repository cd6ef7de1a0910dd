"""Errors that the user can mend. Each becomes one line on stderr and exit code 2."""

from collections.abc import Iterable
from difflib import get_close_matches


class InputError(ValueError):
    """Bad input: the message names the thing, what was expected, what was found, what to do."""


class DataUnavailable(InputError):
    """A data file could not be had: not in the cache and no source gave it."""


class RenamedWarning(FutureWarning):
    """A value of an option was given by the name that it had before."""


class FontWarning(UserWarning):
    """Names in a figure have letters that its font does not have."""


def unknown(kind: str, found: str, valid: Iterable[str]) -> InputError:
    """The error for a name that is not in a closed list: it always shows the list."""
    return InputError(f"unknown {kind} '{found}': choose from {', '.join(valid)}")


def nearest(word: str, names: Iterable[str], likeness: float = 0.6) -> str:
    """The name that was meant: the same in upper or lower case before a similar one; "" for none."""
    names = list(names)
    same = [name for name in names if name.lower() == word.lower()]
    return next(iter(same or get_close_matches(word, names, 1, likeness)), "")
