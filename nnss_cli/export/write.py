"""Exports on disk: made aside, checked as they are on disk, and only then put in their place."""

from __future__ import annotations

import filecmp
import importlib
import json
import keyword
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

from nnss_cli.errors import InputError, unknown
from nnss_cli.export.facts import facts_of
from nnss_cli.export.parity import Parity, Trial, single_left_out, trial_of
from nnss_cli.files import require_writable, write_bytes, write_text
from nnss_cli.trained import TrainedModel

HEADERS = (
    "assert", "complex", "ctype", "errno", "fenv", "float", "inttypes", "iso646", "limits", "locale", "math", "setjmp",
    "signal", "stdarg", "stdbool", "stddef", "stdint", "stdio", "stdlib", "string", "tgmath", "time", "wchar", "wctype",
)  # fmt: skip
"""The standard headers of C99."""


@dataclass(frozen=True)
class _Target:
    module: str
    """Where its writer is."""
    writer: str
    """Name of the function."""
    needs: tuple[str, ...] = ()
    """Packages beyond nnss's own."""
    single: bool = False
    """Whether it has single precision beside double, where that holds the model's signals."""
    refuses: Callable[[str], bool] = lambda _: False
    """Whether files of a name, an identifier, could not be used: the checks load them by their paths."""
    expected: str = ""
    """What was expected of a name that it refuses, as `name`."""


def _is_module(name: str) -> bool:
    return keyword.iskeyword(name) or name in sys.stdlib_module_names or name in packages_distributions()


_TARGETS = {
    "control": _Target(
        "nnss_cli.export.control_module", "write_control", refuses=_is_module,
        expected="one of no Python module, found '{name}': the file would be taken for it",
    ),
    "casadi": _Target(
        "nnss_cli.export.casadi_function", "write_casadi", ("casadi",),
        refuses=lambda name: name.startswith("_") or "__" in name,
        expected="one that a function of casadi may have, which must begin with a letter, without '__', found '{name}'",
    ),
    "onnx": _Target("nnss_cli.export.onnx_graph", "write_onnx", ("onnx", "onnxruntime"), single=True),
    "c": _Target(
        "nnss_cli.export.c99", "write_c", single=True, refuses=HEADERS.__contains__,
        expected="one of no header of C, found '{name}': {name}.h would be taken for it",
    ),
    "mat": _Target(
        "nnss_cli.export.matlab", "write_mat", refuses=lambda name: name.startswith("_"),
        expected="one that a function of mat may have, which must begin with a letter, found '{name}'",
    ),
}  # fmt: skip
TARGETS = tuple(_TARGETS)
"""What a model may be exported to."""


@dataclass(frozen=True)
class Exported:
    """What an export gave."""

    files: tuple[Path, ...]
    """The files written."""
    parity: tuple[Parity, ...]
    """How far each part of them is from the model."""
    start: str
    """How their start differs from the model's; "" where it does not."""
    left_out: str
    """Why there is none in single precision; "" where there is, and of targets that never have one."""


def export(model: TrainedModel, to: str, out: str | Path, name: str = "model", force: bool = False) -> Exported:
    """Write a model for another tool, once what was written has been seen to compute what the model does.

    Args:
        model: whose kind has an elementary step: NN-SS, linear, or an ensemble of them.
        to: one of `TARGETS`.
        out: folder for the files.
        name: of the files and of what is in them.
        force: replace files that are there and hold something else.

    Raises:
        InputError: an unknown target, a package or compiler that is missing (it is named), a name that is no
            identifier or means something else to the target, files that are there already with other content, a folder
            that cannot be written, or a model without an elementary step.
        ParityError: what was written computes something else; nothing is left.
    """
    if to not in _TARGETS:
        raise unknown("target", to, _TARGETS)
    if not (name.isidentifier() and name.isascii()):
        raise InputError(f"name: expected letters, digits and '_', not beginning with a digit, found '{name:.60}'")
    target, out = _TARGETS[to], Path(out)
    if target.refuses(name):
        raise InputError(f"name: expected {target.expected.format(name=name)}")
    for package in target.needs:
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise InputError(f"export to {to} needs the package {package}: pip install 'nnss[{to}]'") from error
    write: Callable[[TrainedModel, dict[str, Any], Trial, Path, str], list[Parity]] = getattr(
        importlib.import_module(target.module), target.writer
    )
    facts, trial = facts_of(model), trial_of(model)
    with tempfile.TemporaryDirectory(prefix="nnss-export-") as aside:
        parity = write(model, facts, trial, Path(aside), name)
        left_out = single_left_out(model, trial) if target.single else ""
        content = facts | {"target": to, "parity": [asdict(found) for found in parity], "left_out": left_out}
        write_text(Path(aside) / f"{name}.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n")
        made = sorted(path for path in Path(aside).iterdir() if path.is_file())
        placed = [out / path.name for path in made]
        for source, path in zip(made, placed, strict=True):
            if path.exists() and not force and not filecmp.cmp(source, path, shallow=False):
                raise InputError(f"'{path}' exists already: name another folder with --out, or --force to replace it")
        require_writable(out)
        for source, path in zip(made, placed, strict=True):
            write_bytes(path, source.read_bytes())
    return Exported(tuple(placed), tuple(parity), facts["start"], left_out)
