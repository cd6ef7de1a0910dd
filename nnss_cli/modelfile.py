"""Trained models on disk: model.json says what it is, model.safetensors holds the numbers.

Both are data: nothing in them is ever executed.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nnss_cli.errors import InputError
from nnss_cli.files import write_bytes, write_text

Tensors = dict[str, NDArray[Any]]


def write_model(folder: Path, description: dict[str, Any], tensors: Tensors) -> None:
    """Write a model's description and its arrays."""
    write_tensors(folder / "model.safetensors", tensors)
    write_text(folder / "model.json", json.dumps(description, indent=2, ensure_ascii=False) + "\n")


def read_model(folder: Path) -> tuple[dict[str, Any], Tensors]:
    """Read what `write_model` wrote.

    Raises:
        InputError: missing or damaged.
    """
    path = folder / "model.json"
    try:
        description = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(description, dict):
            raise ValueError(f"expected an object, found {description!r:.60}")
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"'{path}' is not a model's description: {error}; train it again") from error
    return description, read_tensors(folder / "model.safetensors")


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
