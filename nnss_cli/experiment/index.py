"""An index of the runs of a folder, so that ten thousand are as quick to look at as ten.

It is a copy and never the truth: a line of it stands for a run only while the run's own files are the very ones that
were read and checked when the line was written. It may be removed at any time; damaged, it is rebuilt.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from nnss_cli.experiment.run import FORBID, RunResult
from nnss_cli.files import write_bytes
from nnss_cli.version import __version__

if TYPE_CHECKING:
    from pydantic import TypeAdapter

NAME = ".index"
FORMAT = 2
"""Older ones may hold settings in former names."""
SETTLED_NS = 2_000_000_000
"""A file that changed so recently may change again without another time of change: it gets no line yet."""

Stamp: TypeAlias = tuple[int, int, int, int] | None
"""Which file it is: inode, size, times of content and of change [ns]; None where there is none."""


def stamp(path: Path) -> Stamp:
    """Which file is at a path: it differs as soon as the file is replaced or changed."""
    try:
        found = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns


@dataclass(frozen=True)
class Line:
    """What is known of a run."""

    __pydantic_config__ = FORBID

    run: Stamp
    """Its run.json that was read."""
    signals: Stamp
    """Its signals, with which the scores agreed."""
    result: RunResult
    """What it says, without the history of its fit."""


def read_index(folder: Path) -> dict[str, Line]:
    """The lines of a folder's index by the run's label; none where it is missing, damaged or of another version."""
    try:
        head, *lines = (folder / NAME).read_bytes().splitlines()
        if json.loads(head) != _head(lines):
            return {}
        found = [_adapter().validate_json(line, strict=True) for line in lines]
    except (OSError, ValueError, RecursionError):
        return {}
    return {line.result.spec.label: line for line in found}


def write_index(folder: Path, lines: Mapping[str, Line]) -> None:
    """Replace a folder's index. One that cannot be written costs time, nothing else."""
    newest = time.time_ns() - SETTLED_NS
    kept = [
        _adapter().dump_json(line)
        for line in lines.values()
        if max(one[3] for one in (line.run, line.signals) if one is not None) < newest
    ]
    with contextlib.suppress(OSError):
        write_bytes(folder / NAME, b"\n".join([json.dumps(_head(kept)).encode(), *kept]) + b"\n")


def _head(lines: list[bytes]) -> dict[str, Any]:
    return {"index": FORMAT, "nnss": __version__, "sha256": hashlib.sha256(b"\n".join(lines)).hexdigest()}


@cache
def _adapter() -> TypeAdapter[Line]:
    from pydantic import TypeAdapter

    return TypeAdapter(Line)
