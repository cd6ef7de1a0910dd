"""Results on disk: one folder a run under results/<dataset>/<protocol>/runs/.

run.json is written last, so a run without it was not finished and counts as missing.
"""

from __future__ import annotations

import json
import shutil
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nnss_cli.datasets.record import Record
from nnss_cli.errors import InputError
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.files import write_text
from nnss_cli.modelfile import Tensors, read_tensors, write_tensors
from nnss_cli.version import __version__


@dataclass(frozen=True)
class Store:
    """The runs of one dataset and protocol."""

    out: Path
    """The results folder (--out)."""
    dataset: str
    """Name of the dataset."""
    protocol: str
    """Split and statistics."""

    @property
    def folder(self) -> Path:
        """Where tables and figures go."""
        return self.out / self.dataset / self.protocol

    def run_folder(self, spec: RunSpec) -> Path:
        """Where a run's files go."""
        return self.folder / "runs" / spec.label

    def results(self) -> list[RunResult]:
        """All finished runs, in a fixed order.

        Raises:
            InputError: a run's file is damaged.
        """
        found = [_read(path) for path in (self.folder / "runs").glob("*/run.json")]
        return sorted(found, key=lambda r: (r.spec.method, r.spec.order, r.spec.seed))

    def clear(self, spec: RunSpec) -> None:
        """Forget a run: its marker goes first, so an interruption leaves it missing, not half there."""
        folder = self.run_folder(spec)
        (folder / "run.json").unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)

    def write(self, result: RunResult, signals: Tensors) -> None:
        """Keep a result. The model, if any, is already in the run's folder."""
        folder = self.run_folder(result.spec)
        if signals:
            write_tensors(folder / "signals.safetensors", signals)
        write_text(folder / "run.json", json.dumps(result.to_json(), indent=1, ensure_ascii=False) + "\n")

    def signals(self, spec: RunSpec) -> Tensors:
        """Measured and simulated outputs and states of a run: '<split>/<record>/y', '…/y_sim', '…/x', '…/u'."""
        return read_tensors(self.run_folder(spec) / "signals.safetensors")

    def conflict(self, spec: RunSpec, results: list[RunResult]) -> str:
        """Which finished runs must not be mixed with `spec` in one table, and how they differ ("" if there are none).

        Runs of any method and order must be of the same data; those of the same method and order also of the same
        versions and options.
        """
        for result in results:
            difference = self._difference(spec, result)
            if difference:
                return f"{result.spec.method}, order {result.spec.order}, with {difference}"
        return ""

    @staticmethod
    def _difference(spec: RunSpec, result: RunResult) -> str:
        other = result.spec
        if other.data != spec.data:
            return "another version of the data"
        if (other.method, other.order) != (spec.method, spec.order):
            return ""
        made = result.provenance.get("nnss", "unknown")
        if made != __version__:
            return f"nnss {made} instead of {__version__}"
        if other.version != spec.version:
            return f"version {other.version or 'unknown'} of the method instead of {spec.version}"
        return ", ".join(
            f"{name} {_value(other.settings, name)} instead of {_value(spec.settings, name)}"
            for name in spec.settings | other.settings
            if _value(other.settings, name) != _value(spec.settings, name)
        )


def stores(out: Path) -> list[Store]:
    """Every dataset and protocol that has runs under `out`."""
    return [
        Store(out, folder.parent.parent.name, folder.parent.name)
        for folder in sorted(out.glob("*/*/runs"))
        if folder.is_dir()
    ]


def records_of(folder: Path, Ts: float) -> dict[str, tuple[Record, ...]]:
    """The records of a run by split, as kept with it.

    Raises:
        InputError: the run keeps none, or they are damaged.
    """
    signals = read_tensors(folder / "signals.safetensors")
    counts = Counter(name.split("/")[0] for name in signals if name.endswith("/y"))
    return {
        split: tuple(Record(signals[f"{split}/{i}/u"], signals[f"{split}/{i}/y"], Ts) for i in range(count))
        for split, count in counts.items()
    }


def _value(settings: dict[str, Any], name: str) -> Any:
    value = settings.get(name)
    return list(value) if isinstance(value, tuple) else value


def _read(path: Path) -> RunResult:
    try:
        return RunResult.from_json(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"'{path}' is not a finished run of this version ({type(error).__name__}: {error}); "
            f"remove the folder '{path.parent}' and run it again"
        ) from error
