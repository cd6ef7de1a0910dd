"""What a model's folder holds."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from nnss_cli.modelfile import read_format, read_model
from nnss_cli.trained.model import TrainedModel


def shown(model: TrainedModel) -> dict[str, Any]:
    """Description, arrays' shapes, scaling, channels, training and provenance of a model that lies in a folder.

    Raises:
        InputError: the folder cannot be read.
    """
    assert model.folder is not None
    description, tensors = read_model(model.folder)
    return {
        "folder": str(model.folder),
        "format": read_format(model.folder),
        "kind": description.get("kind"),
        "order": model.order,
        "Ts": model.Ts,
        "init_window": model.init_window,
        "channels": asdict(model.channels),
        "scaling": {name: values.tolist() for name, values in asdict(model.scaling).items()} if model.scaling else None,
        "fingerprint": model.fingerprint,
        "description": {key: value for key, value in description.items() if key not in ("kind", "Ts", "channels")},
        "arrays": {name: {"shape": list(array.shape), "dtype": str(array.dtype)} for name, array in tensors.items()},
        "training": asdict(model.origin) if model.origin else None,
    }
