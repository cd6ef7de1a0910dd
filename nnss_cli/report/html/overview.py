"""Which method has the lowest error where, by how much, and how sure that is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from nnss_cli.experiment.run import RunResult
from nnss_cli.report.aggregate import is_combination, methods_of
from nnss_cli.report.html.looks import Look
from nnss_cli.report.html.svg import Axis, Tick, axis_of
from nnss_cli.report.standing import errors_by_record, fails_too_often, is_seeded, record_name
from nnss_cli.report.statistics import LEVEL, Interval, median_interval, quantile, ratio, ratio_interval


@dataclass(frozen=True)
class Entry:
    """A method's errors on one record and order."""

    look: Look
    """Which method."""
    median: float
    """Over seeds; ∞ where most runs have no result."""
    interval: Interval
    """Of the median; of a method without seeds the value itself."""
    ok: int
    """Runs with a result."""
    runs: int
    """All runs."""


@dataclass(frozen=True)
class Standing:
    """Methods on one record and order, by their medians."""

    record: str
    """The record, with its test set where there are several."""
    anchor: str
    """The dataset."""
    order: int
    """Of the models."""
    entries: list[Entry]
    """Independent methods, the lowest median first; those that fail too often last."""
    combined: list[Entry]
    """Combinations of other runs, which are no competitors."""
    ratio: float | None
    """Lowest median over the next; None where there is no second method."""
    bounds: Interval | None
    """Of the ratio."""
    beaten: list[str]
    """Methods that the seeds settle to be higher than the first, at 95 %."""
    undecided: list[str]
    """Those that they do not."""
    failing: list[str]
    """Those that fail on too many runs to be compared."""

    @property
    def first(self) -> Entry:
        """The lowest."""
        return self.entries[0]

    @property
    def settled(self) -> bool:
        """Whether the seeds settle that the first is lower than every other."""
        return bool(self.beaten) and not self.undecided


@dataclass(frozen=True)
class Row:
    """A method's place on the common axis of a chart, in hundredths."""

    entry: Entry
    """Which."""
    at: float
    """Its median."""
    low: float
    """Lower end of its interval."""
    high: float
    """Upper end."""


@dataclass(frozen=True)
class Chart:
    """Medians with intervals on one logarithmic axis."""

    ticks: list[Tick]
    """Of the axis."""
    groups: list[tuple[Standing, list[Row]]]
    """Rows by record and order."""


def standings(results: Sequence[RunResult], split: str, looks: dict[str, Look]) -> list[Standing]:
    """Methods on each record and order, by the median over seeds of RMSE/σ, mean over outputs.

    Args:
        results: of one protocol.
        split: "test" for every test set.
        looks: of every method in them.
    """
    names = methods_of(results)
    found = []
    for (dataset, order, name), errors in sorted(errors_by_record(results, split).items()):
        alone = {method: errors[method] for method in names if method in errors and not is_combination(method)}
        if not any(math.isfinite(value) for values in alone.values() for value in values):
            continue
        ranked = sorted(alone, key=lambda m: (fails_too_often(alone[m]), quantile(alone[m], 0.5)))
        sound = [method for method in ranked if not fails_too_often(alone[method])]
        beaten: list[str] = []
        undecided: list[str] = []
        first, *others = sound or ranked[:1]
        for other in others:
            bounds = _bounds(first, other, alone)
            label = looks[other].label
            (beaten if bounds.coverage >= LEVEL and bounds.high < 1 else undecided).append(label)
        next_ = others[0] if others else None
        found.append(
            Standing(
                record_name(dataset, name), dataset, order, [_entry(m, alone[m], looks) for m in ranked],
                [_entry(m, errors[m], looks) for m in names if m in errors and is_combination(m)],
                None if next_ is None else ratio(alone[first], alone[next_]),
                None if next_ is None else _bounds(first, next_, alone),
                beaten, undecided, [looks[m].label for m in ranked if m not in sound],
            )
        )  # fmt: skip
    return found


def chart_of(found: Sequence[Standing]) -> Chart:
    """The same as a chart."""
    entries = [entry for one in found for entry in (*one.entries, *one.combined)]
    axis = axis_of([value for e in entries for value in (e.median, e.interval.low, e.interval.high)], True)
    groups = [(one, [_row(entry, axis) for entry in (*one.entries, *one.combined)]) for one in found]
    return Chart(axis.ticks(6), groups)


def _row(entry: Entry, axis: Axis) -> Row:
    def at(value: float) -> float:
        return 100.0 if math.isinf(value) else 100 * min(max(float(axis(value)), 0.0), 1.0)

    return Row(entry, at(entry.median), at(entry.interval.low), at(entry.interval.high))


def _entry(method: str, errors: Sequence[float], looks: dict[str, Look]) -> Entry:
    median = quantile(errors, 0.5)
    interval = median_interval(errors) if is_seeded(method) else Interval(median, median, 1.0)
    return Entry(looks[method], median, interval, sum(map(math.isfinite, errors)), len(errors))


def _bounds(first: str, second: str, errors: dict[str, list[float]]) -> Interval:
    return ratio_interval(errors[first], errors[second], (not is_seeded(first), not is_seeded(second)))
