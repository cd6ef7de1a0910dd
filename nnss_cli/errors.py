"""Errors that the user can mend. Each becomes one line on stderr and exit code 2."""

from collections.abc import Iterable


class InputError(ValueError):
    """Bad input: the message names the thing, what was expected, what was found, what to do."""


class DataUnavailable(InputError):
    """A data file could not be had: not in the cache and no source gave it."""


class RenamedWarning(FutureWarning):
    """A value of an option was given by the name that it had before."""


def unknown(kind: str, found: str, valid: Iterable[str]) -> InputError:
    """The error for a name that is not in a closed list: it always shows the list."""
    return InputError(f"unknown {kind} '{found}': choose from {', '.join(valid)}")
