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
        times.setdefault(result.spec.method, {}).setdefault(result.spec.order, []).append(result.fit_seconds)
    groups = []
    for (method, order), runs in counts.items():
        known = times.get(method, {})
        nearest = known[min(known, key=lambda n: (abs(n - order), n))] if known else []
        groups.append(PlannedGroup(method, order, runs, sum(nearest) / len(nearest) if nearest else None))
    total = sum(group.runs * (OVERHEAD + (group.seconds or 0.0)) for group in groups)
    unknown = dict.fromkeys(group.method for group in groups if group.seconds is None)
    return Estimate(tuple(groups), total / max(1, min(jobs, len(todo))), tuple(unknown))


def duration(seconds: float) -> str:
    """A time in the unit that suits it."""
    for unit, size in (("days", DAY), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * size:
            return f"{seconds / size:.3g} {unit}"
    return f"{max(seconds, 1):.0f} s"
