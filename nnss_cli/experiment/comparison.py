"""Two results folders compared run by run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from nnss_cli.errors import InputError
from nnss_cli.experiment.agreement import telling
from nnss_cli.experiment.collection import Entry, entries
from nnss_cli.experiment.provenance import MADE_WITH
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import stores

HERE, MISSING = "there", "missing"


@dataclass(frozen=True)
class Difference:
    """Something in which a run of two folders differs."""

    name: str
    """The run: DATASET/PROTOCOL/METHOD-nORDER-sSEED."""
    what: str
    """A score by split and output, an option, a version, or the run itself."""
    first: float | str | None
    """In the first folder; None where it has none."""
    second: float | str | None
    """In the second."""

    @property
    def change(self) -> float | None:
        """(second − first)/first of two numbers, else None."""
        if isinstance(self.first, str) or isinstance(self.second, str) or not self.first or self.second is None:
            return None
        return self.second / self.first - 1


@dataclass(frozen=True)
class Comparison:
    """What came of comparing two folders."""

    equal: int
    """Runs that are in both and differ in nothing."""
    different: int
    """Runs that are in both and differ."""
    only_first: int
    """Runs that the second folder lacks."""
    only_second: int
    """Runs that the first lacks."""
    differing: list[Difference]
    """By run, in a fixed order."""
    faults: list[str]
    """A line for each damaged run: it is compared with nothing."""


def compared(first: Path, second: Path, tolerance: float = 0.0) -> Comparison:
    """Compare runs of the same dataset, protocol, method, order and seed.

    Args:
        first: a results folder.
        second: another one.
        tolerance: relative change of an error, up to which two are the same.

    Raises:
        InputError: one of them holds no runs.
    """
    for folder in (first, second):
        if not stores(folder):
            raise InputError(f"no runs under '{folder}': expected a results folder, as --out names it")
    found = {entry.name: entry for entry in entries(first)}, {entry.name: entry for entry in entries(second)}
    faults = [entry.fault for side in found for entry in side.values() if entry.fault]
    differing: list[Difference] = []
    counts = [0, 0, 0, 0]  # equal, different, only in the first, only in the second
    for name in sorted(found[0].keys() | found[1].keys()):
        one, other = (side.get(name) for side in found)
        if (one and one.fault) or (other and other.fault):
            continue
        own = list(_differences(name, one, other, tolerance))
        differing += own
        counts[2 if other is None else 3 if one is None else bool(own)] += 1
    equal, different, only_first, only_second = counts
    return Comparison(equal, different, only_first, only_second, differing, faults)


def _differences(name: str, first: Entry | None, second: Entry | None, tolerance: float) -> Iterator[Difference]:
    one, other = (entry.result if entry else None for entry in (first, second))
    if one is None or other is None:
        yield Difference(name, "run", HERE if one else MISSING, HERE if other else MISSING)
        return
    for what, a, b in _facts(one, other):
        if a != b:
            yield Difference(name, what, a, b)
    errors = [{(score.split, score.output): score.rmse for score in result.scores} for result in (one, other)]
    for split, output in dict.fromkeys([*errors[0], *errors[1]]):
        was, now = (side.get((split, output)) for side in errors)
        if was is None or now is None or abs(now - was) > tolerance * abs(was):
            yield Difference(name, f"RMSE {split} {output}", was, now)


def _facts(one: RunResult, other: RunResult) -> Iterator[tuple[str, str, str]]:
    """What is text in both: status, data, version of the method, options, versions of libraries."""
    yield "status", one.status, other.status
    yield "data", one.spec.data, other.spec.data
    yield "method's version", one.spec.version, other.spec.version
    for name in telling(one.spec.settings | other.spec.settings):
        yield name, _text(one.spec.settings.get(name)), _text(other.spec.settings.get(name))
    for name in MADE_WITH:
        yield name, one.provenance.get(name, "unknown"), other.provenance.get(name, "unknown")


def _text(value: object) -> str:
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
