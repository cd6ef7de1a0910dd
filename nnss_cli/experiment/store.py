"""Results on disk: one folder a run under results/<dataset>/<protocol>/runs/.

run.json is written last, so a run without it was not finished and counts as missing.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from nnss_cli.datasets.record import Record
from nnss_cli.errors import InputError
from nnss_cli.experiment.lock import lock
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.schema import check_place, check_signals, parse_result
from nnss_cli.files import remove_leftovers, write_text
from nnss_cli.modelfile import Tensors, read_tensors, write_tensors
from nnss_cli.version import __version__

LOCKS = ".locks"  # beside the runs: their own folders come and go

Stamp: TypeAlias = tuple[int, int] | None
"""Which file a run.json is: its inode and time of change; None where there is none."""


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
        read = (_read(path) for path in (self.folder / "runs").glob("*/run.json"))
        found = [result for result in read if result is not None]
        return sorted(found, key=lambda r: (r.spec.method, r.spec.order, r.spec.seed))

    def find(self, spec: RunSpec) -> RunResult | None:
        """The finished run in this one's folder.

        Raises:
            InputError: its file is damaged.
        """
        return _read(self.run_folder(spec) / "run.json")

    def stamp(self, spec: RunSpec) -> Stamp:
        """Which finished run is there: it differs as soon as another one is."""
        try:
            found = (self.run_folder(spec) / "run.json").stat()
        except FileNotFoundError:
            return None
        return found.st_ino, found.st_mtime_ns

    @contextlib.contextmanager
    def lock(self, spec: RunSpec) -> Iterator[bool]:
        """Hold a run, if nobody does; gives whether it is held now.

        Raises:
            InputError: the folder cannot be written.
        """
        with contextlib.ExitStack() as stack:
            with self.writing():
                held = stack.enter_context(lock(self._lock_of(spec.label)))
            yield held

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Say of an error of the disk within what it means.

        Raises:
            InputError: in place of OSError.
        """
        try:
            yield
        except OSError as error:
            free = ""
            with contextlib.suppress(OSError):
                free = f" ({shutil.disk_usage(self.folder).free:,} bytes free)"
            raise InputError(
                f"cannot write to '{self.folder}': {error.strerror or error}{free}; the finished runs are kept, and "
                "once it can be written the same command goes on from here"
            ) from error

    def tidy(self) -> None:
        """Remove what killed commands left: temporary files, locks, and the files of unfinished runs.

        Raises:
            InputError: it cannot be removed.
        """
        runs = self.folder / "runs"
        with self.writing():
            remove_leftovers(self.folder)
            for folder in runs.glob("*"):
                if folder.name.startswith(".") or not folder.is_dir():
                    continue
                if (folder / "run.json").exists():
                    remove_leftovers(folder)
                    continue
                with lock(self._lock_of(folder.name)) as held:
                    if held and not (folder / "run.json").exists():
                        shutil.rmtree(folder, ignore_errors=True)
            for path in (runs / LOCKS).glob("*"):
                with lock(path):  # its file goes with it
                    pass

    def _lock_of(self, label: str) -> Path:
        return self.folder / "runs" / LOCKS / label

    def clear(self, spec: RunSpec) -> None:
        """Forget a run: its marker goes first, so an interruption leaves it missing, not half there."""
        folder = self.run_folder(spec)
        (folder / "run.json").unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)

    def write(self, result: RunResult, signals: Tensors) -> None:
        """Keep a result. The model, if any, is already in the run's folder."""
        folder = self.run_folder(result.spec)
        with self.writing():
            if signals:
                write_tensors(folder / "signals.safetensors", signals)
            write_text(folder / "run.json", json.dumps(result.to_json(), indent=1, ensure_ascii=False) + "\n")

    def signals(self, spec: RunSpec) -> Tensors:
        """Measured and simulated outputs and states of a run: '<split>/<record>/y', '…/y_sim', '…/x', '…/u'.

        Raises:
            InputError: they are missing or damaged, or not those of its scores.
        """
        path = self.run_folder(spec) / "signals.safetensors"
        signals = read_tensors(path)
        result = self.find(spec)
        try:
            if result is not None:
                check_signals(result, signals)
        except ValueError as error:
            raise InputError(
                f"'{path}' disagrees with the run.json beside it ({error}); remove '{path.parent}' and run it again"
            ) from error
        return signals

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


def _read(path: Path) -> RunResult | None:
    """A finished run; None where there is none (any more).

    Raises:
        InputError: it is damaged.
    """
    try:
        result = parse_result(path.read_bytes())
        *_, dataset, protocol, _, label = path.parent.parts
        check_place(result, dataset, protocol, label)
        return result
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise InputError(
            f"'{path}' is not a finished run of this version ({error}); "
            f"remove the folder '{path.parent}' and run it again"
        ) from error
