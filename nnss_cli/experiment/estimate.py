"""How long a plan will take, as far as earlier runs tell."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nnss_cli.experiment.run import RunResult, RunSpec

DAY = 86_400.0
OVERHEAD = 0.005  # seconds that a run takes beside its fit: what even a trivial one costs


@dataclass(frozen=True)
class PlannedGroup:
    """The runs of one method and order that a plan has to do."""

    method: str
    """Name of the method."""
    order: int
    """Number of states n."""
    runs: int
    """How many."""
    seconds: float | None
    """What one takes, the mean of earlier runs at the nearest order; None where there are none."""


@dataclass(frozen=True)
class Estimate:
    """How long a plan takes."""

    groups: tuple[PlannedGroup, ...]
    """By method and order, as planned."""
    seconds: float
    """Wall time [s]: at least, where `unknown` names methods."""
    unknown: tuple[str, ...]
    """Methods of which no earlier run tells."""


def estimate(todo: Sequence[RunSpec], earlier: Sequence[RunResult], jobs: int) -> Estimate:
    """Time for runs that are to be done, from those that were.

    Args:
        todo: the runs to do.
        earlier: finished runs of the same dataset, whatever came of them.
        jobs: processes.
    """
    counts: dict[tuple[str, int], int] = {}
    for spec in todo:
        counts[spec.method, spec.order] = counts.get((spec.method, spec.order), 0) + 1
    times: dict[str, dict[int, list[float]]] = {}
    for result in earlier:
        times.setdefault(result.spec.method, {}).setdefault(result.spec.order, []).append(_own_seconds(result))
    groups = []
    for (method, order), runs in counts.items():
        known = times.get(method, {})
        nearest = known[min(known, key=lambda n: (abs(n - order), n))] if known else []
        groups.append(PlannedGroup(method, order, runs, sum(nearest) / len(nearest) if nearest else None))
    total = sum(group.runs * (OVERHEAD + (group.seconds or 0.0)) for group in groups)
    unknown = dict.fromkeys(group.method for group in groups if group.seconds is None)
    return Estimate(tuple(groups), total / max(1, min(jobs, len(todo))), tuple(unknown))


def is_combined(spec: RunSpec) -> bool:
    """Whether a run combines the models of others, which have trained them."""
    return "members" in spec.settings


def _own_seconds(result: RunResult) -> float:
    """What a run took itself [s]: the time of a combination's fit has its members' in it."""
    own = result.provenance.get("seconds", "")
    return float(own) if is_combined(result.spec) and own.replace(".", "", 1).isdecimal() else result.fit_seconds


class Forecast:
    """Of a study of which no earlier run tells: its time, as soon as its own first runs tell it."""

    def __init__(self, todo: Sequence[RunSpec], earlier: Sequence[RunResult], jobs: int) -> None:
        self._left = {spec.label: spec for spec in todo}
        self._known, self._jobs = list(earlier), jobs
        self._open = set(estimate(todo, earlier, jobs).unknown)

    def after(self, result: RunResult) -> Estimate | None:
        """The time for what is left when this result has just come; once, when every method has one, else None."""
        if not self._open:
            return None
        self._left.pop(result.spec.label, None)
        self._known.append(result)
        self._open.discard(result.spec.method)
        return None if self._open else estimate(list(self._left.values()), self._known, self._jobs)


def amount(todo: Sequence[RunSpec]) -> str:
    """How much is planned, in words, by method: runs, and the epochs of each at most where a method has them."""
    runs: dict[str, list[RunSpec]] = {}
    for spec in todo:
        runs.setdefault(spec.method, []).append(spec)
    parts = []
    for method, own in runs.items():
        epochs = sorted({int(spec.settings.get("epochs", 0)) for spec in own if not is_combined(spec)} - {0})
        most = ""
        if all(map(is_combined, own)):
            most = ", made of the others' runs"
        elif epochs:
            ends = dict.fromkeys((epochs[0], epochs[-1]))  # one number where all have the same
            most = f", each of {' to '.join(f'{n:,}' for n in ends)} epochs at most"
        parts.append(f"{method} {len(own):,} run{'s' * (len(own) > 1)} of order {_orders(own)}{most}")
    return "; ".join(parts)


def _orders(specs: Sequence[RunSpec]) -> str:
    orders = sorted({spec.order for spec in specs})
    return ", ".join(map(str, orders)) if len(orders) < 6 else f"{orders[0]} to {orders[-1]}"


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    for unit, size in (("days", DAY), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{max(seconds, 1):.0f} s"
