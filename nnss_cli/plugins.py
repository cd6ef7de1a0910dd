"""Plug-ins: methods and datasets that other packages (entry points) and single files (`--plugin FILE.py`) bring.

A package's plug-in is imported when its name is asked for and not before, so that one that is broken costs
only itself. A file is named by the user, who trusts its code: it is executed when the command starts.
"""

from __future__ import annotations

import hashlib
import re
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, TypeVar

from nnss_cli.errors import InputError

T = TypeVar("T")

NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,63}")
"""What a method or dataset may be called: it becomes the name of folders, and stands before the dot of --set."""


class PluginWarning(UserWarning):
    """A plug-in that cannot be used was passed over; the rest goes on."""


@dataclass(frozen=True)
class Source:
    """A plug-in file as it was read: another process executes the same bytes."""

    path: Path
    """Where it was read."""
    code: bytes
    """What was in it."""

    @property
    def digest(self) -> str:
        """The first 12 hexadecimal digits of its sha256."""
        return hashlib.sha256(self.code).hexdigest()[:12]


@dataclass(frozen=True)
class Origin:
    """Where a method or dataset comes from."""

    title: str
    """In a message: nnss, package their-package 1.2, or file 'mine.py'."""
    stamp: str = ""
    """In a run's identity: their-package 1.2, or 'file' and digits of its sha256; "" for nnss, which has its own."""


@dataclass(frozen=True)
class _Offer(Generic[T]):
    """One claim to a name."""

    origin: Origin
    give: Callable[[], T]
    """What is offered, imported at need. Raises InputError when it cannot be used."""


_files: tuple[tuple[Source, ModuleType], ...] = ()
_ATTRIBUTES = ("METHOD", "METHODS", "BENCHMARK", "BENCHMARKS")


def read_source(path: Path) -> Source:
    """Read a plug-in file.

    Raises:
        InputError: no readable file, or not by the name of a Python file.
    """
    if path.suffix != ".py":
        raise InputError(f"plug-in '{path}': expected a Python file, FILE.py; an installed package needs no --plugin")
    try:
        return Source(path, path.read_bytes())
    except OSError as error:
        raise InputError(f"plug-in '{path}' cannot be read: {error.strerror or error}") from error


def use(sources: Sequence[Source]) -> None:
    """Execute plug-in files; from now on these are in use and no others.

    Raises:
        InputError: a file fails, or defines nothing that is looked for.
    """
    global _files
    _files = ()
    _files = tuple((source, _executed(source)) for source in dict.fromkeys(sources))


def in_use() -> tuple[Source, ...]:
    """The plug-in files in use, for another process to `use`."""
    return tuple(source for source, _ in _files)


def _executed(source: Source) -> ModuleType:
    module = ModuleType(f"nnss_plugin_{source.digest}")
    module.__file__ = str(source.path)
    sys.modules[module.__name__] = module  # dataclasses look their module up there
    try:
        exec(compile(source.code, str(source.path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        raise InputError(f"plug-in '{source.path}' fails: {_cause(error, str(source.path))}") from error
    if not any(hasattr(module, name) for name in _ATTRIBUTES):
        raise InputError(f"plug-in '{source.path}': expected {' or '.join(_ATTRIBUTES)} in it, found none")
    return module


def _cause(error: BaseException, path: str = "") -> str:
    """An exception of foreign code on one line, with the line of the file `path` that led to it."""
    text = " ".join(str(error).split())[:300]
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == path]
    where = f" (line {lines[-1]})" if lines else ""
    return f"{type(error).__name__}{': ' * bool(text)}{text}{where}"


class Registry(Mapping[str, T]):
    """What nnss has built in, what the plug-in files in use define, and what installed packages offer, by name.

    Names can be listed without importing any package's plug-in. Looking one up raises InputError when it
    cannot be used or is claimed twice; `in` is then false, with a warning.
    """

    def __init__(
        self, noun: str, group: str, attributes: tuple[str, str], built_in: Sequence[T], check: Callable[[Any], T]
    ) -> None:
        """Collect what is built in; the rest is looked for at need.

        Args:
            noun: what it holds, for messages.
            group: of entry points.
            attributes: names by which a file defines one, or several.
            built_in: what nnss itself has, in order.
            check: what a plug-in offers → what is registered. Raises ValueError saying what is missing.
        """
        self.noun = noun
        self.group = group
        self.attributes = attributes
        self.built_in: dict[str, T] = {_name(thing): thing for thing in built_in}
        self._check = check
        self._seen: tuple[object, dict[str, list[_Offer[T]]]] = ((), {})

    def __getitem__(self, name: str) -> T:
        offers = self._offers(name)
        if not offers:
            raise KeyError(name)
        if len(offers) > 1:
            claims = " and ".join(offer.origin.title for offer in offers)
            raise InputError(f"the name '{name}' of a {self.noun} is claimed by {claims}: rename or uninstall one")
        return offers[0].give()

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*self.built_in, *self._of_files(), *sorted(self._installed)]))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and self.usable(name) is not None

    def usable(self, name: str) -> T | None:
        """That of this name; None where there is none, or none that can be used, of which a warning tells."""
        try:
            return self[name]
        except KeyError:
            return None
        except InputError as error:
            warnings.warn(str(error), PluginWarning, stacklevel=2)
            return None

    def all_usable(self) -> dict[str, T]:
        """All by name, packages' plug-ins imported; a warning tells of each that cannot be used."""
        return {name: thing for name in self if (thing := self.usable(name)) is not None}

    def of_files(self) -> list[str]:
        """The names that plug-in files in use define.

        Raises:
            InputError: what a file defines cannot be used, or its name is taken.
        """
        names = list(self._of_files())
        for name in names:
            self[name]
        return names

    def origin(self, name: str) -> Origin:
        """Where that of this name comes from; nnss for an unknown one."""
        offers = self._offers(name)
        return offers[0].origin if offers else BUILT_IN

    def _offers(self, name: str) -> list[_Offer[T]]:
        own = [_Offer(BUILT_IN, lambda: self.built_in[name])] if name in self.built_in else []
        return [*own, *self._of_files().get(name, []), *self._installed.get(name, [])]

    def _of_files(self) -> dict[str, list[_Offer[T]]]:
        if self._seen[0] is not _files:
            found: dict[str, list[_Offer[T]]] = {}
            for source, module in _files:
                origin = Origin(f"file '{source.path}'", f"file {source.digest}")
                one, several = (getattr(module, name, None) for name in self.attributes)
                listed = isinstance(several, tuple | list)
                if several is not None and not listed:
                    raise InputError(f"{origin.title}: {self.attributes[1]}: expected a tuple, found {several!r:.60}")
                for thing in ([] if one is None else [one]) + list(several or ()):
                    made = self._checked(thing, origin.title)
                    found.setdefault(_name(made), []).append(_Offer(origin, lambda made=made: made))  # type: ignore[misc]
            self._seen = (_files, found)
        return self._seen[1]

    @cached_property
    def _installed(self) -> dict[str, list[_Offer[T]]]:
        found: dict[str, list[_Offer[T]]] = {}
        for point in metadata.entry_points(group=self.group):
            found.setdefault(point.name, []).append(self._packaged(point))
        return {name: sorted(offers, key=lambda offer: offer.origin.title) for name, offers in found.items()}

    def _packaged(self, point: metadata.EntryPoint) -> _Offer[T]:
        stamp = f"{point.dist.name} {point.dist.version}" if point.dist else point.value

        @cache
        def outcome() -> T | InputError:  # a failure is kept as well: it is not tried again at every look-up
            try:
                return self._imported(point, f"'{point.name}' of package {stamp}")
            except InputError as error:
                return error

        def give() -> T:
            found = outcome()
            if isinstance(found, InputError):
                raise found
            return found

        return _Offer(Origin(f"package {stamp}", stamp), give)

    def _imported(self, point: metadata.EntryPoint, title: str) -> T:
        try:
            thing = point.load()
        except (Exception, SystemExit) as error:
            raise InputError(
                f"plug-in {title} cannot be imported: {_cause(error)}; mend or uninstall the package"
            ) from error
        made = self._checked(thing, title)
        if _name(made) != point.name:
            raise InputError(f"plug-in {title}: its entry point is called '{point.name}', it '{_name(made)}'")
        return made

    def _checked(self, thing: object, title: str) -> T:
        try:
            made = self._check(thing)
            if not (isinstance(_name(made), str) and NAME.fullmatch(_name(made))):
                raise ValueError(
                    f"name: expected small letters, digits, '-' and '_', at most 64, found {_name(made)!r:.80}"
                )
        except Exception as error:
            fault = str(error) if isinstance(error, ValueError) else _cause(error)
            raise InputError(f"plug-in {title} is no {self.noun}: {' '.join(fault.split())}") from error
        return made


BUILT_IN = Origin("nnss")


def _name(thing: Any) -> Any:
    return getattr(thing, "name", None)
