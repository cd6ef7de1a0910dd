"""The runs of a results folder by name: which there are, taking them away, and joining folders of several machines."""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import get_args

from nnss_cli.errors import InputError, unknown
from nnss_cli.experiment.agreement import agreeing, unlike
from nnss_cli.experiment.run import RunResult, Status
from nnss_cli.experiment.store import Store, stores

STATUSES = (*get_args(Status), "damaged")


@dataclass(frozen=True)
class Entry:
    """A run of a results folder."""

    store: Store
    """Where it is."""
    label: str
    """Name of its folder."""
    result: RunResult | None
    """What came of it, without its history; None where its files are damaged."""
    fault: str
    """What is wrong with its files, or ""."""

    @property
    def name(self) -> str:
        """Its folder within the results, without 'runs': DATASET/PROTOCOL/METHOD-nORDER-sSEED."""
        return f"{self.store.dataset}/{self.store.protocol}/{self.label}"

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.store.folder_of(self.label)


@dataclass(frozen=True)
class Merged:
    """What came of joining folders."""

    copied: list[str] = field(default_factory=list)
    """Runs that are new here, by name."""
    same: list[str] = field(default_factory=list)
    """Runs that were here already, with the same scores."""
    left_out: list[str] = field(default_factory=list)
    """A line for each run that is damaged or disagrees with what is here."""


def entries(out: Path, patterns: Sequence[str] = (), statuses: Sequence[str] = ()) -> list[Entry]:
    """The runs of a results folder, in a fixed order; those of ablations have folders of their own.

    Args:
        out: the results folder.
        patterns: globs of names, or of labels where they have no '/'; all where empty.
        statuses: of those wanted; 'damaged' for those that cannot be read. All where empty.

    Raises:
        InputError: there is no such status.
    """
    for status in statuses:
        if status not in STATUSES:
            raise unknown("status", status, STATUSES)
    found = []
    for store in stores(out):
        read = store.read()
        of_store = [Entry(store, r.spec.label, r, "") for r in read.results]
        of_store += [Entry(store, label, None, line) for label, line in sorted(read.faults.items())]
        found += [
            entry
            for entry in of_store
            if (not patterns or any(_matches(entry, pattern) for pattern in patterns))
            and (not statuses or (entry.result.status if entry.result else "damaged") in statuses)
        ]
    return found


def _matches(entry: Entry, pattern: str) -> bool:
    return fnmatch.fnmatchcase(entry.name if "/" in pattern else entry.label, pattern)


def remove(chosen: Sequence[Entry]) -> Iterator[tuple[Entry, bool]]:
    """Take runs away; each comes with whether it was: not where another command is at it.

    Raises:
        InputError: the folder cannot be written.
    """
    for entry in chosen:
        with entry.store.lock_label(entry.label) as held:
            if held:
                entry.store.clear_label(entry.label)
        yield entry, held


def merge(sources: Sequence[Path], out: Path) -> Merged:
    """Copy the runs of other results folders into one, checked as they are read; nothing is ever replaced.

    A run is left out, and told, where its files are damaged; where another one of its name is there with other scores;
    or where it does not go into one table with the runs of its dataset that are there: other data, options, or
    version of the method. The first folder decides where there are none.

    Raises:
        InputError: there are no runs in a source, or `out` cannot be written.
    """
    merged = Merged()
    for source in sources:
        found = stores(source)
        if not found:
            raise InputError(f"no runs under '{source}': expected a results folder, as --out names it")
        for store in found:
            _merge_store(store, replace(store, out=out), merged)
    return merged


def _merge_store(source: Store, target: Store, merged: Merged) -> None:
    table = agreeing(source, source.read())
    merged.left_out.extend(table.left_out)
    there = target.read()
    kept = {result.spec.label: result for result in there.results}
    reference = agreeing(target, there).results
    for result in table.results:
        spec = result.spec
        origin = source.run_folder(spec)
        other = kept.get(spec.label)
        if spec.label in there.faults:
            merged.left_out.append(f"'{origin}': the run of this name is damaged there: {there.faults[spec.label]}")
        elif other is not None and (other.spec, other.scores, other.status) == (spec, result.scores, result.status):
            merged.same.append(spec.name)
        elif other is not None:
            why = unlike(spec, [other]) or "other scores"
            merged.left_out.append(f"'{origin}': another run of this name is there, with {why}")
        elif why := unlike(spec, reference):
            merged.left_out.append(f"'{origin}': runs there are of {why}")
        else:
            _copy(origin, target, result, merged)


def _copy(origin: Path, target: Store, result: RunResult, merged: Merged) -> None:
    files = {path.name: path.read_bytes() for path in origin.iterdir() if _belongs(path)}
    with target.lock(result.spec) as held:
        if not held or target.stamp(result.spec) is not None:
            merged.left_out.append(f"'{origin}': another command is at the run of this name there")
            return
        try:
            target.adopt(files)
        except ValueError as error:
            merged.left_out.append(f"'{origin}': {error}")
            return
    merged.copied.append(result.spec.name)


def _belongs(path: Path) -> bool:
    return not path.name.startswith(".") and path.is_file() and not path.is_symlink()
