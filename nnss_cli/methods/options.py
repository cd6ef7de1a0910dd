"""Options of a method as its frozen dataclass declares them: types, choices and docstrings, checks and parsing."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import math
import textwrap
import types
import typing
import warnings
from collections.abc import Mapping
from dataclasses import MISSING, dataclass
from functools import cache
from numbers import Integral, Real
from typing import Any

from nnss_cli.errors import InputError, RenamedWarning, unknown

SCALARS: dict[type, str] = {bool: "true or false", int: "a whole number", float: "a number", str: "a word"}
"""Types of an option, and what is expected of its value."""


@dataclass(frozen=True)
class NoOptions:
    """A method that can be told nothing."""


@dataclass(frozen=True)
class Option:
    """One option of a method."""

    name: str
    """Name after the dot of --set."""
    kind: type
    """bool, int, float or str; of each value where there are several."""
    several: bool
    """Whether it is a tuple of values."""
    choices: tuple[Any, ...]
    """The only values; () where there is no such list."""
    doc: str
    """Docstring of the field, on one line."""
    renamed: Mapping[str, str] = dataclasses.field(default_factory=dict)
    """A value's former name → its name today."""

    def value(self, given: object) -> Any:
        """A value of the option's type, from Python.

        Raises:
            InputError: it has another type or is no choice; the message names the option.
        """
        if not self.several:
            return self._one(given)
        if not isinstance(given, tuple | list):
            raise InputError(f"{self.name}: expected {self.expected}, found {given!r:.60}")
        return tuple(self._one(each) for each in given)

    def parse(self, text: str) -> Any:
        """A value of the option's type, from a word of the command line: 0.5, true, or 100,100 for several.

        Raises:
            InputError: the word does not stand for one.
        """
        if not self.several:
            return self._one(self._read(text))
        return tuple(self._one(self._read(part.strip())) for part in text.split(",") if part.strip())

    @property
    def expected(self) -> str:
        """What a value must be, in words."""
        if self.choices:
            return " or ".join(map(str, self.choices))
        return f"{SCALARS[self.kind]}{', or several with commas' * self.several}"

    def _read(self, text: str) -> Any:
        if self.kind is str:
            return text
        if self.kind is bool:
            return {"true": True, "yes": True, "1": True, "false": False, "no": False, "0": False}.get(
                text.lower(), text
            )
        try:
            return self.kind(text)
        except ValueError:
            return text

    def _one(self, given: object) -> Any:
        if isinstance(given, str) and given in self.renamed:
            now = self.renamed[given]
            warnings.warn(
                f"{self.name}: '{given}' is now called '{now}' and means the same; write '{now}', the old name will go",
                RenamedWarning, stacklevel=2,
            )  # fmt: skip
            given = now
        if self.choices:
            if given not in self.choices:
                raise unknown(self.name, str(given), map(str, self.choices))
            return given
        sound = {bool: isinstance(given, bool), str: isinstance(given, str)}.get(
            self.kind, isinstance(given, Integral if self.kind is int else Real) and not isinstance(given, bool)
        )
        if not sound or (self.kind is float and not math.isfinite(given)):  # type: ignore[arg-type]
            raise InputError(f"{self.name}: expected {self.expected}, found {str(given)!r:.60}")
        return self.kind(given)


def options_of(declared: type[Any]) -> dict[str, Option]:
    """The options that a frozen dataclass declares, by name.

    A field is bool, int, float, str, a Literal of these, a tuple of one of them (`tuple[int, ...]`), or one
    of these or None, where None stands for what the method makes of it. `metadata={"choices": (…)}` lists values,
    `metadata={"renamed": {…}}` those that had another name: former name → today's.

    Raises:
        ValueError: it is no frozen dataclass, or a field has another type or no default.
    """
    key: Any = declared  # mypy takes no type[Any] for hashable
    return _declared(key)


@cache
def _declared(declared: type[Any]) -> dict[str, Option]:
    if not (isinstance(declared, type) and dataclasses.is_dataclass(declared)):
        raise ValueError(f"options: expected a frozen dataclass, found {declared!r:.80}")
    if not declared.__dataclass_params__.frozen:  # type: ignore[attr-defined]
        raise ValueError(f"options: expected a frozen dataclass, found that {declared.__name__} is not frozen")
    hints = typing.get_type_hints(declared)
    docs = _field_docs(declared)
    found = {}
    for each in dataclasses.fields(declared):
        if each.default is MISSING and each.default_factory is MISSING:
            raise ValueError(f"options: {declared.__name__}.{each.name} has no default")
        kind, several, choices = _type(f"{declared.__name__}.{each.name}", hints[each.name])
        choices = tuple(each.metadata.get("choices", choices))
        renamed = each.metadata.get("renamed", {})
        found[each.name] = Option(each.name, kind, several, choices, docs.get(each.name, ""), renamed)
    return found


def _type(name: str, hint: Any) -> tuple[type, bool, tuple[Any, ...]]:
    """Kind of a value, whether there are several, and the only values."""
    origin, args = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType) and len(args) == 2 and type(None) in args:
        return _type(name, next(arg for arg in args if arg is not type(None)))
    if hint in SCALARS:
        return hint, False, ()
    if origin is typing.Literal and len({type(arg) for arg in args}) == 1 and type(args[0]) in SCALARS:
        return type(args[0]), False, args
    if origin is tuple and len(args) == 2 and args[1] is Ellipsis:
        kind, several, choices = _type(name, args[0])
        if not several:
            return kind, True, choices
    raise ValueError(f"options: {name}: expected bool, int, float, str, a Literal or a tuple of one, found {hint}")


def _field_docs(declared: type[Any]) -> dict[str, str]:
    """The docstring of each field of a dataclass, those of its bases included, where its source can be read."""
    texts: dict[str, str] = {}
    for base in reversed(declared.__mro__):
        if not dataclasses.is_dataclass(base):
            continue
        try:
            (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        except (OSError, TypeError, SyntaxError, ValueError):  # a package without its source
            continue
        body = tree.body if isinstance(tree, ast.ClassDef) else []
        for each, text in itertools.pairwise(body):
            if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name) and isinstance(text, ast.Expr):
                texts[each.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return texts


def chosen_options(declared: type[Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """Those of `overrides` that `declared` has and that are not None, in its types.

    Raises:
        InputError: a value has another type or is no choice.
    """
    known = options_of(declared)
    return {name: known[name].value(given) for name, given in overrides.items() if name in known and given is not None}


def for_method(overrides: Mapping[str, Any], *names: str) -> dict[str, Any]:
    """What of `overrides` reaches a method of these names: those for all, then those for one, 'METHOD.OPTION'."""
    found = {option: value for option, value in overrides.items() if "." not in option}
    for name in names:
        prefix = f"{name}."
        found |= {option.removeprefix(prefix): own for option, own in overrides.items() if option.startswith(prefix)}
    return found
