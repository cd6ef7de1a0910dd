"""Trained models on disk: model.json says what it is, model.safetensors holds the numbers.

Both are data: nothing in them is ever executed. model.json has, beside what the kind of model keeps,

    format      version of this layout; a folder without one is of version 1
    training    what the model was trained on and how (`nnss_cli.experiment.origin`), from version 2 on
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nnss_cli.errors import InputError
from nnss_cli.files import write_bytes, write_text

Tensors = dict[str, NDArray[Any]]

FORMAT = 2
"""Version of the layout; `read_model` reads all up to it."""


def write_model(folder: Path, description: dict[str, Any], tensors: Tensors) -> None:
    """Write a model's description and its arrays."""
    write_tensors(folder / "model.safetensors", tensors)
    _write_description(folder, {"format": FORMAT} | description)


def write_training(folder: Path, training: dict[str, Any]) -> None:
    """Add to a model's folder what it was trained on and how.

    Raises:
        InputError: there is no model in it.
    """
    _write_description(folder, {"format": FORMAT} | _read_description(folder) | {"training": training})


def read_training(folder: Path) -> Any:
    """What `write_training` wrote, unchecked; None in a folder of version 1.

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
    return description, read_tensors(folder / "model.safetensors")


def _write_description(folder: Path, description: dict[str, Any]) -> None:
    write_text(folder / "model.json", json.dumps(description, indent=2, ensure_ascii=False) + "\n")


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


def write_tensors(path: Path, tensors: Tensors) -> None:
    """Write named arrays as safetensors."""
    from safetensors.numpy import save

    write_bytes(path, save({name: np.ascontiguousarray(array) for name, array in tensors.items()}))


def read_tensors(path: Path) -> Tensors:
    """Read named arrays.

    Raises:
        InputError: missing or damaged.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    try:
        return dict(load(path.read_bytes()))
    except (OSError, SafetensorError) as error:
        raise InputError(f"'{path}' cannot be read: {error}; run it again with --force") from error
