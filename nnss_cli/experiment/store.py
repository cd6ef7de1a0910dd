"""Results on disk: one folder a run under results/<dataset>/<protocol>/runs/.

run.json is written last, so a run without it was not finished and counts as missing.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from pathlib import Path

from nnss_cli.datasets.record import FITTED_ON, Record
from nnss_cli.errors import InputError
from nnss_cli.experiment.index import Line, Stamp, read_index, stamp, write_index
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.schema import check_place, check_signals, parse_result
from nnss_cli.files import free_space, remove_leftovers, together, write_bytes, write_text
from nnss_cli.lock import lock
from nnss_cli.modelfile import Tensors, parse_tensors, read_tensors, write_tensors

LOCKS = ".locks"  # beside the runs: their own folders come and go
SIGNALS = "signals.safetensors"


@dataclass(frozen=True)
class Found:
    """What there is of a folder's runs."""

    results: list[RunResult]
    """Finished runs that are sound, in a fixed order, without the histories of their fits."""
    faults: dict[str, str]
    """Runs whose files are damaged or disagree, by label: a line each that names the file."""
    lines: dict[str, Line] = field(repr=False)
    """What is known of each sound run's files, by label."""


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
        return self.folder_of(spec.label)

    def folder_of(self, label: str) -> Path:
        """Likewise, by the name of its folder."""
        return self.folder / "runs" / label

    def results(self) -> list[RunResult]:
        """All finished runs, whole, in a fixed order.

        Raises:
            InputError: a run's file is damaged.
        """
        read = (_read(path) for path in (self.folder / "runs").glob("*/run.json"))
        return _sorted([result for result in read if result is not None])

    def read(self, before: Found | None = None, touch: bool = True) -> Found:
        """All finished runs, from the index where their files are those that it tells of.

        What is not is read, checked against its folder and its signals, and told in the index, which is written anew.

        Args:
            before: what was found earlier by this process, instead of the index.
            touch: whether the index may be written.
        """
        runs = self.folder / "runs"
        known = read_index(runs) if before is None else before.lines
        lines: dict[str, Line] = {}
        faults: dict[str, str] = {}
        for folder in _folders(runs):
            try:
                line = _line(folder, known.get(folder.name))
            except InputError as error:
                faults[folder.name] = str(error)
            else:
                if line is not None:
                    lines[folder.name] = line
        if touch and lines != known:
            write_index(runs, lines)
        return Found(_sorted([line.result for line in lines.values()]), faults, lines)

    def find(self, spec: RunSpec) -> RunResult | None:
        """The finished run in this one's folder.

        Raises:
            InputError: its file is damaged.
        """
        return _read(self.run_folder(spec) / "run.json")

    def stamp(self, spec: RunSpec) -> Stamp:
        """Which finished run is there: it differs as soon as another one is."""
        return stamp(self.run_folder(spec) / "run.json")

    def lock(self, spec: RunSpec) -> AbstractContextManager[bool]:
        """Hold a run, if nobody does; gives whether it is held now.

        Raises:
            InputError: the folder cannot be written.
        """
        return self.lock_label(spec.label)

    @contextlib.contextmanager
    def lock_label(self, label: str) -> Iterator[bool]:
        """Likewise, by the name of its folder."""
        with contextlib.ExitStack() as stack:
            with self.writing():
                held = stack.enter_context(lock(self._lock_of(label)))
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
            raise InputError(
                f"cannot write to '{self.folder}': {error.strerror or error}{free_space(self.folder)}; the finished "
                "runs are kept, and once it can be written the same command goes on from here"
            ) from error

    def tidy(self) -> None:
        """Remove what killed commands left: temporary files, locks, and the files of unfinished runs.

        Raises:
            InputError: it cannot be removed.
        """
        runs = self.folder / "runs"
        with self.writing():
            for folder in (self.folder, runs):
                remove_leftovers(folder)
            for folder in _folders(runs):
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
        self.clear_label(spec.label)

    def clear_label(self, label: str) -> None:
        """Likewise, by the name of its folder."""
        folder = self.folder_of(label)
        (folder / "run.json").unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)

    def write(self, result: RunResult, signals: Tensors) -> None:
        """Keep a result. The model, if any, is already in the run's folder."""
        folder = self.run_folder(result.spec)
        with self.writing():
            if signals:
                write_tensors(folder / SIGNALS, signals)
            write_text(folder / "run.json", json.dumps(result.to_json(), indent=1, ensure_ascii=False) + "\n")

    def adopt(self, files: Mapping[str, bytes]) -> RunResult:
        """Keep a run that was made elsewhere. Whoever else may write it holds its lock.

        Args:
            files: what was in its folder, by name.

        Raises:
            ValueError: it is damaged, disagrees with itself, or is of another dataset or protocol.
            InputError: it cannot be written.
        """
        strange = [name for name in files if Path(name).name != name or name.startswith(".")]
        if strange or "run.json" not in files:
            raise ValueError(f"files: expected run.json and others beside it, found {', '.join(files)[:80]}")
        result = parse_result(files["run.json"])
        check_place(result, self.dataset, self.protocol, result.spec.label)
        if Path(result.spec.label).name != result.spec.label:
            raise ValueError(f"spec: expected a plain name, found {result.spec.label!r:.80}")
        if SIGNALS in files or result.status == "ok":
            check_signals(result, parse_tensors(files.get(SIGNALS, b"")))
        folder = self.run_folder(result.spec)
        with self.writing(), together():
            self.clear(result.spec)
            for name in sorted(files, key=lambda name: name == "run.json"):
                write_bytes(folder / name, files[name])
        return result

    def signals(self, spec: RunSpec) -> Tensors:
        """Measured and simulated outputs and states of a run: '<split>/<record>/y', '…/y_sim', '…/x', '…/u'.

        Raises:
            InputError: they are missing or damaged, or not those of its scores.
        """
        folder = self.run_folder(spec)
        signals = read_tensors(folder / SIGNALS)
        result = self.find(spec)
        if result is not None:
            _agree(result, signals, folder)
        return signals


def stores(out: Path) -> list[Store]:
    """Every dataset and protocol that has runs under `out`."""
    return [
        Store(out, folder.parent.parent.name, folder.parent.name)
        for folder in sorted(out.glob("*/*/runs"))
        if folder.is_dir()
    ]


def records_of(folder: Path, Ts: float) -> dict[str, tuple[Record, ...]]:
    """The records of a run by split, as kept with it: train, val, then the test sets by name.

    Raises:
        InputError: the run keeps none, or they are damaged.
    """
    signals = read_tensors(folder / SIGNALS)
    counts = Counter(name.split("/")[0] for name in signals if name.endswith("/y"))
    return {
        split: tuple(Record(signals[f"{split}/{i}/u"], signals[f"{split}/{i}/y"], Ts) for i in range(count))
        for split, count in sorted(counts.items(), key=lambda of: (of[0] not in FITTED_ON, of[0]))
    }


def _folders(runs: Path) -> list[Path]:
    """The folders of runs, finished or not."""
    try:
        with os.scandir(runs) as entries:
            return [runs / entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir()]
    except (FileNotFoundError, NotADirectoryError):
        return []


def _sorted(results: list[RunResult]) -> list[RunResult]:
    return sorted(results, key=lambda r: (r.spec.method, r.spec.order, r.spec.seed))


def _line(folder: Path, known: Line | None) -> Line | None:
    """What is known of a run, else what its own files say; None where it has gone meanwhile.

    Raises:
        InputError: they are damaged, or disagree.
    """
    run, signals = stamp(folder / "run.json"), stamp(folder / SIGNALS)  # older than what is read
    if run is None:
        return None
    try:
        if known is not None and (known.run, known.signals) == (run, signals):
            _in_place(known.result, folder)  # it may have been moved with its index
            return known
        result = _read(folder / "run.json")
        if result is None:
            return None
        if signals is not None or result.status == "ok":
            _agree(result, read_tensors(folder / SIGNALS), folder)
    except InputError:
        if stamp(folder / "run.json") != run:  # another command replaced it under our eyes
            return _line(folder, known)
        raise
    return Line(run, signals, replace(result, history={}))


def _agree(result: RunResult, signals: Tensors, folder: Path) -> None:
    try:
        check_signals(result, signals)
    except ValueError as error:
        raise InputError(
            f"'{folder / SIGNALS}' disagrees with the run.json beside it ({error}); remove '{folder}' and run it again"
        ) from error


def _read(path: Path) -> RunResult | None:
    """A finished run; None where there is none (any more).

    Raises:
        InputError: it is damaged.
    """
    try:
        result = parse_result(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise _unfinished(path.parent, error) from error
    return _in_place(result, path.parent)


def _in_place(result: RunResult, folder: Path) -> RunResult:
    """A run that is that of its folder.

    Raises:
        InputError: it is another one's.
    """
    *_, dataset, protocol, _, label = folder.parts
    try:
        check_place(result, dataset, protocol, label)
    except ValueError as error:
        raise _unfinished(folder, error) from error
    return result


def _unfinished(folder: Path, error: Exception) -> InputError:
    return InputError(
        f"'{folder / 'run.json'}' is not a finished run of this version ({error}); "
        f"remove the folder '{folder}' and run it again"
    )
