"""Every method by name: a file of this package each, found by themselves, and those of plug-ins."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from nnss_cli.errors import InputError, unknown
from nnss_cli.methods.options import options_of
from nnss_cli.methods.protocol import Fit, Method, Model, ModelReader
from nnss_cli.plugins import Registry


def sound_method(thing: Any) -> Method:
    """A method that keeps the protocol, from itself or its class.

    Raises:
        ValueError: it does not; the message says what is missing or wrong.
    """
    if inspect.isclass(thing) and issubclass(thing, Method):
        missing = ", ".join(sorted(thing.__abstractmethods__))
        if missing:
            raise ValueError(f"{thing.__name__} lacks {missing}")
        thing = thing()
    if not isinstance(thing, Method):
        raise ValueError(f"expected a subclass of nnss_cli.methods.Method or an object of one, found {thing!r:.80}")
    for name, kind in (("name", str), ("seeded", bool), ("version", str), ("members", str), ("models", Mapping)):
        if not hasattr(thing, name):
            raise ValueError(f"{type(thing).__name__} lacks {name}")
        if not isinstance(getattr(thing, name), kind):
            raise ValueError(f"{name}: expected {kind.__name__}, found {getattr(thing, name)!r:.80}")
    if not thing.version:
        raise ValueError("version: expected a word, found none")
    _check_call(thing, "fit", ("data", "order", "seed", "settings", "on_epoch"))
    if thing.members and type(thing).combine is Method.combine:
        raise ValueError(f"{type(thing).__name__} has members and lacks combine")
    options_of(thing.options)
    for model, reader in thing.models.items():
        if not callable(reader):
            raise ValueError(f"models: expected a function that reads kind '{model}', found {reader!r:.80}")
        if _READERS.get(model, reader) is not reader:
            raise ValueError(f"models: '{model}' is a kind of nnss itself; take another name")
    return thing


def sound_fit(thing: Any, method: Method) -> Fit:
    """What a method's fit returned: a plug-in may return anything.

    Raises:
        TypeError: it is no Fit.
    """
    if not isinstance(thing, Fit):
        raise TypeError(f"fit of {method.name}: expected a Fit, found {thing!r:.80}")
    return thing


def _check_call(method: Method, name: str, arguments: Sequence[str]) -> None:
    """A method that cannot be called is told before a run is planned, not by each run."""
    try:
        inspect.signature(getattr(method, name)).bind(*arguments)
    except TypeError as error:
        raise ValueError(f"{name}: expected {name}({', '.join(arguments)}): {error}") from error


def _discovered() -> list[Method]:
    """The methods of every file of this folder that lists some, in the order of tables."""
    names = sorted(found.name for found in pkgutil.iter_modules([str(Path(__file__).parent)]))
    modules = [importlib.import_module(f"{__package__}.{name}") for name in names if name != "registry"]
    listed = [method for module in modules for method in getattr(module, "METHODS", ())]
    return sorted(listed, key=lambda method: (method.position, method.name))


_BUILT_IN = _discovered()
_READERS: dict[str, ModelReader] = {kind: reader for method in _BUILT_IN for kind, reader in method.models.items()}
METHODS: Registry[Method] = Registry("method", "nnss.methods", ("METHOD", "METHODS"), _BUILT_IN, sound_method)
"""Every method by name, in the order of tables: those of nnss, of plug-in files, of installed packages."""
ASKED_FOR = ("nnss-paper", "nnss-clipped")
"""Variants of nnss and of its ensemble, for use beside them."""
DEFAULT = tuple(method.name for method in _BUILT_IN if method.name not in ASKED_FOR)
"""What `compare` takes unless told."""


def select(names: Sequence[str]) -> list[Method]:
    """The methods of these names, in this order; `DEFAULT` and those of plug-in files where `names` is empty.

    Raises:
        InputError: a name is unknown (the message lists the valid ones), claimed twice, or of a plug-in that
            cannot be used.
    """
    chosen = []
    for name in dict.fromkeys(names or (*DEFAULT, *METHODS.of_files())):
        try:
            method = METHODS[name]
        except KeyError:
            raise unknown("method", name, METHODS) from None
        if method.members:
            _check_members(method)
        chosen.append(method)
    return chosen


def _check_members(method: Method) -> None:
    try:
        combines = METHODS[method.members].members
    except KeyError:
        raise InputError(f"{method.name} combines runs of '{method.members}', which is no method here") from None
    if combines:
        raise InputError(f"{method.name} combines runs of {method.members}, which combines those of {combines} itself")


def version_of(method: Method) -> str:
    """The version that identifies its runs: for a plug-in, with that of its package or the hash of its file."""
    stamp = METHODS.origin(method.name).stamp
    return f"{stamp}; {method.version}" if stamp else method.version


def load_model(folder: Path, models: Mapping[str, ModelReader] | None = None) -> Model:
    """Read a trained model.

    Args:
        folder: of the run.
        models: readers of kinds that no registered method has.

    Raises:
        InputError: missing, damaged or of an unknown kind.
    """
    from nnss_cli.modelfile import read_model

    description, tensors = read_model(folder)
    kind = str(description.get("kind"))
    try:
        reader = _READERS.get(kind) or (models or {}).get(kind) or _foreign_reader(kind)
        return reader(description, tensors)
    except InputError as error:
        raise InputError(f"'{folder}': {error}") from error
    except (LookupError, TypeError, AttributeError, ArithmeticError, RuntimeError, ValueError, MemoryError) as error:
        raise InputError(
            f"'{folder}' holds an incomplete {kind:.40} model: {' '.join(str(error).split())}; train it again"
        ) from error


def _foreign_reader(kind: str) -> ModelReader:
    """Who reads the models of a plug-in; installed ones are imported to be asked.

    Raises:
        InputError: nobody does, or two do.
    """
    found = {name: method for name, method in METHODS.all_usable().items() if kind in method.models}
    readers = {id(method.models[kind]): method.models[kind] for method in found.values()}
    if not readers:
        known = dict.fromkeys(kind for method in METHODS.all_usable().values() for kind in method.models)
        error = unknown("kind of model", kind, known)
        raise InputError(f"{error}; one of a plug-in needs its package, or --plugin FILE.py")
    if len(readers) > 1:
        titles = " and ".join(METHODS.origin(name).title for name in found)
        raise InputError(f"models of kind '{kind}' are claimed by {titles}: uninstall one")
    return next(iter(readers.values()))
