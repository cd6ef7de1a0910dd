"""Signals over time: panels under each other on one time axis, drawn once, and their samples for the script to zoom."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.report.html.looks import Look
from nnss_cli.report.html.svg import Axis, Tick, axis_of, few, path

DRAWN = 360
"""Bins of a line as it is drawn without the script: two points each."""
KEPT = 1500
"""Bins of a record that is longer than twice as many samples, for the script."""
STEPS = 9999
"""A sample is kept as one of so many steps of its signal's range."""


@dataclass(frozen=True)
class Series:
    """A signal of a panel."""

    name: str
    """What it is called."""
    values: FloatArray
    """Samples (K,)."""
    look: Look | None = None
    """The method's; None for what is measured or a state."""
    order: int = 0
    """The model's order; 0 where there is no model."""
    held: bool = False
    """Whether it is constant between samples, as an input is."""


@dataclass(frozen=True)
class Panel:
    """Signals that share an axis."""

    title: str
    """Name and unit of the axis."""
    series: Sequence[Series]
    """What is drawn, the first at the back."""
    height: int = 150
    """In pixels."""


@dataclass(frozen=True)
class Line:
    """A signal as it is drawn."""

    series: Series
    """Which."""
    d: str
    """The line."""


@dataclass(frozen=True)
class Drawn:
    """A panel as it is drawn."""

    panel: Panel
    """What of."""
    ticks: list[Tick]
    """Of its vertical axis."""
    lines: list[Line]
    """Its signals."""


@dataclass(frozen=True)
class Trace:
    """Panels on one time axis."""

    name: str
    """Unique on the page: a name for its parts."""
    title: str
    """What it shows."""
    description: str
    """The same in words for who cannot see it."""
    panels: list[Drawn]
    """From top to bottom."""
    ticks: list[Tick]
    """Of the time axis."""
    unit: str
    """Of the time axis."""
    breaks: list[float]
    """Where another record begins, in hundredths."""
    data: dict[str, Any]
    """What the script needs."""
    shown: str
    """How dense records are shown; "" where every sample is."""


def draw_trace(
    name: str, title: str, description: str, panels: Sequence[Panel], step: float, unit: str, starts: Sequence[int]
) -> Trace:
    """Draw panels of signals.

    Args:
        name: unique on the page.
        title: what it shows.
        description: the same in words.
        panels: from top to bottom; all signals (K,).
        step: time from sample to sample, in `unit`.
        unit: of time.
        starts: samples at which another record begins.
    """
    K = len(panels[0].series[0].values)
    time = Axis(0.0, max(K - 1, 1) * step)
    thinned = 2 * KEPT < K
    drawn = []
    kept = []
    for panel in panels:
        axis = axis_of(np.concatenate([one.values for one in panel.series]))
        lines = []
        for one in panel.series:
            at, values = few(one.values, DRAWN)
            if one.held:
                at, values = np.repeat(at, 2)[1:], np.repeat(values, 2)[:-1]
            lines.append(Line(one, path(at / max(K - 1, 1), axis(values))))
        drawn.append(Drawn(panel, axis.ticks(4 if panel.height > 100 else 3), lines))
        kept.append([_packed(one, thinned) for one in panel.series])
    data = {
        "samples": K, "step": step, "unit": unit, "bins": KEPT if thinned else 0, "steps": STEPS, "panels": kept,
        "starts": list(starts),
    }  # fmt: skip
    breaks = [100 * start / max(K - 1, 1) for start in starts]
    shown = f"{K} samples, drawn as the smallest and largest of each of {KEPT} intervals" if thinned else ""
    return Trace(name, title, description, drawn, time.ticks(7), unit, breaks, data, shown)


def _packed(one: Series, thinned: bool) -> dict[str, Any]:
    """A signal as whole steps of its range: every sample, or each bin's smallest and largest."""
    values = one.values
    if thinned:
        edges = np.linspace(0, len(values), KEPT + 1).astype(int)[:-1]
        low, high = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
        values = np.stack([low, high], axis=1).ravel()
    finite = values[np.isfinite(values)]
    least, most = (float(finite.min()), float(finite.max())) if len(finite) else (0.0, 0.0)
    scale = STEPS / (most - least) if most > least else 0.0
    steps = [round((value - least) * scale) if math.isfinite(value) else None for value in values.tolist()]
    return {"name": one.name, "low": least, "high": most, "held": one.held, "values": steps}
