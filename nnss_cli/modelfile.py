"""Trained models on disk: model.json says what it is, model.safetensors holds the numbers.

Both are data: nothing in them is ever executed. model.json has, beside what the kind of model keeps,

    format      version of this layout; a folder without one is of version 1
    training    what the model was trained on and how (`nnss_cli.experiment.origin`), from version 2 on

From version 3 on an NN-SS model keeps how far off its encoder's guesses are, and an ensemble may be one that clips.
"""

import json
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nnss_cli.errors import InputError
from nnss_cli.files import write_bytes, write_text

Tensors = dict[str, NDArray[Any]]

_TRAINING: ContextVar[dict[str, Any] | None] = ContextVar("training", default=None)
FORMAT = 3
"""Version of the layout; `read_model` reads all up to it."""


def write_model(folder: Path, description: dict[str, Any], tensors: Tensors) -> None:
    """Write a model's description and its arrays."""
    write_tensors(folder / "model.safetensors", tensors)
    training = _TRAINING.get()
    content = {"format": FORMAT} | description | ({} if training is None else {"training": training})
    write_text(folder / "model.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n")


@contextmanager
def trained_as(training: dict[str, Any]) -> Iterator[None]:
    """Models that are written meanwhile keep with them what they were trained on and how."""
    token = _TRAINING.set(training)
    try:
        yield
    finally:
        _TRAINING.reset(token)


def read_training(folder: Path) -> Any:
    """What `trained_as` was given, unchecked; None in a folder of version 1.

    Raises:
        InputError: there is no model in it.
    """
    return _read_description(folder).get("training")


def read_model(folder: Path) -> tuple[dict[str, Any], Tensors]:
    """Read what `write_model` wrote.

    Raises:
        InputError: missing, damaged or of a later version.
    """
    description = _read_description(folder)
    for name in ("format", "training"):  # no business of the kind of model
        description.pop(name, None)
    Ts = description.get("Ts", 1.0)
    if not isinstance(Ts, int | float) or isinstance(Ts, bool) or not 0 < Ts < math.inf:
        path = folder / "model.json"
        raise InputError(f"'{path}': Ts: expected seconds above 0, found {Ts!r:.60}; train it again")
    return description, read_tensors(folder / "model.safetensors")


def _read_description(folder: Path) -> dict[str, Any]:
    path = folder / "model.json"
    try:
        description = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(description, dict):
            raise ValueError(f"expected an object, found {description!r:.60}")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"'{path}' is not a model's description: {error}; train it again") from error
    version = description.get("format", 1)
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise InputError(f"'{path}': format: expected a whole number from 1, found {version!r:.60}; train it again")
    if version > FORMAT:
        raise InputError(
            f"'{path}' is of format {version}, this nnss reads up to {FORMAT}: install the nnss that wrote "
            "it, or a later one"
        )
    return description


def read_format(folder: Path) -> int:
    """Version of a folder's layout.

    Raises:
        InputError: there is no model in it.
    """
    return int(_read_description(folder).get("format", 1))


def require_arrays(tensors: Tensors, expected: Mapping[str, tuple[tuple[int, ...], str]]) -> None:
    """Refuse arrays that are not those of a model.

    Args:
        tensors: what was read.
        expected: shape and type of each array by name; there may be no other.

    Raises:
        ValueError: one is missing, unknown, of another shape or type, or not finite.
    """
    if tensors.keys() != expected.keys():
        missing, more = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
        raise ValueError(f"arrays: missing {', '.join(missing) or 'none'}, unknown {', '.join(more)[:80] or 'none'}")
    for name, (shape, kind) in expected.items():
        array = tensors[name]
        if array.shape != shape or array.dtype != kind:
            raise ValueError(f"{name}: expected {kind} {shape}, found {array.dtype} {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name}: expected finite numbers")
        if name in ("u_std", "y_std") and not (array > 0).all():
            raise ValueError(f"{name}: expected deviations above 0, found {array.min():g}")


def scaling_arrays(inputs: int, outputs: int) -> dict[str, tuple[tuple[int, ...], str]]:
    """Shapes and types of the arrays of a `Scaling`, for `require_arrays`."""
    sizes = {"u_mean": inputs, "u_std": inputs, "y_mean": outputs, "y_std": outputs}
    return {name: ((size,), "float64") for name, size in sizes.items()}


def write_tensors(path: Path, tensors: Tensors) -> None:
    """Write named arrays as safetensors."""
    from safetensors.numpy import save

    write_bytes(path, save({name: np.ascontiguousarray(array) for name, array in tensors.items()}))


def read_tensors(path: Path) -> Tensors:
    """Read named arrays.

    Raises:
        InputError: missing or damaged.
    """
    try:
        return parse_tensors(path.read_bytes())
    except (OSError, ValueError) as error:
        raise InputError(f"'{path}' cannot be read: {error}; run it again with --force") from error


def parse_tensors(content: bytes) -> Tensors:
    """Named arrays from the content of a safetensors file.

    Raises:
        ValueError: it is damaged.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        return dict(load(content))
    except SafetensorError as error:
        raise ValueError(str(error)) from error
