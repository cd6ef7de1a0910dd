"""Several models at once: the folders below one, and the members of an ensemble."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

BELOW = ("*/model.json", "runs/*/model.json", "*/runs/*/model.json", "*/*/runs/*/model.json")
"""Where models lie below a folder: of runs, of a dataset's protocol, of a dataset, of results."""


def folders_below(path: Path) -> list[Path]:
    """The folders of all models below a folder, in order; [] where it is a model's own, or none is there."""
    if not path.is_dir() or (path / "model.json").exists():
        return []
    return sorted({file.parent for pattern in BELOW for file in path.glob(pattern)})


def name_of(folder: Path, root: Path) -> str:
    """A model's folder as seen from the one that was named, without 'runs'."""
    try:
        parts = [part for part in folder.relative_to(root).parts if part != "runs"]
    except ValueError:
        parts = []
    return "/".join(parts) or str(folder)


def members(name: str, model: Any) -> Iterator[tuple[str, Any]]:
    """A model, or the members of an ensemble, each with a name: what holds for the states of each holds in it.

    Where their outputs are clipped, a bound on their gain does not carry over as it is (docs/stability.md).
    """
    own = getattr(model, "members", None)
    if own is None:
        yield name, model
        return
    for number, member in enumerate(own, 1):
        yield f"{name}, member {number}", member
