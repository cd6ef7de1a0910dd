"""The little that the page's pictures need: elements with everything escaped, scales, ticks, lines of few points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from markupsafe import Markup, escape
from matplotlib.ticker import MaxNLocator

from nnss_cli.datasets.record import FloatArray
from nnss_cli.report.dense import thinned
from nnss_cli.report.style import TICK_STEPS, log_ticks

GRID = 1000
"""Whole steps across a picture that is stretched to its frame."""


@dataclass(frozen=True)
class Tick:
    """A labelled place on an axis."""

    at: float
    """Where, in hundredths of the axis from its start."""
    label: str
    """What it says."""


@dataclass(frozen=True)
class Axis:
    """A scale from values to 0 … 1."""

    low: float
    """Value at 0."""
    high: float
    """Value at 1."""
    logarithmic: bool = False
    """Whether equal ratios are equal lengths."""

    def __call__(self, value: Any) -> Any:
        """Where a value, or each of an array, stands."""
        if self.logarithmic:
            low, high = math.log(self.low), math.log(self.high)
            return (np.log(np.maximum(value, np.finfo(float).tiny)) - low) / (high - low)
        return (np.asarray(value, dtype=float) - self.low) / (self.high - self.low)

    def ticks(self, count: int = 5) -> list[Tick]:
        """Round values within the axis, two at least."""
        values = log_ticks(self.low, self.high, count + 1) if self.logarithmic else _ticks(self.low, self.high, count)
        inside = [value for value in values if self.low <= value <= self.high]
        return [Tick(100 * float(self(value)), f"{value:.6g}") for value in inside]


def axis_of(values: Sequence[float] | FloatArray, logarithmic: bool = False, margin: float = 0.04) -> Axis:
    """An axis that holds all finite values (all positive ones, where it is logarithmic), with a margin."""
    array = np.asarray(values, dtype=float).ravel()
    array = array[np.isfinite(array) & ((array > 0) | (not logarithmic))]
    if not len(array):
        return Axis(0.1, 1.0, True) if logarithmic else Axis(0.0, 1.0)
    low, high = float(array.min()), float(array.max())
    if logarithmic:
        spread = max(math.log(high / low), 0.05)
        return Axis(low * math.exp(-margin * spread), high * math.exp(margin * spread), True)
    spread = high - low or abs(high) or 1.0
    return Axis(low - margin * spread, high + margin * spread)


def _ticks(low: float, high: float, count: int) -> list[float]:
    return [float(value) for value in MaxNLocator(count, steps=TICK_STEPS).tick_values(low, high)]


def tag(name: str, *children: Any, **attributes: Any) -> Markup:
    """An element. Children and values of attributes are escaped unless they are markup; class_ is 'class'."""
    given = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(value)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return Markup("<{0}{1}>{2}</{0}>").format(name, Markup(given), Markup("").join(children))


def few(values: FloatArray, bins: int) -> tuple[FloatArray, FloatArray]:
    """Samples and values of a line that looks like all of them; see `thinned`."""
    return thinned(np.arange(len(values), dtype=float), values, bins)


def path(x: FloatArray, y: FloatArray, place: Callable[[float, float], tuple[float, float]] | None = None) -> str:
    """A line through points of 0 … 1, y upwards, in whole steps of the grid; values that are not finite break it."""
    parts: list[str] = []
    pen = "M"
    last = ""
    for a, b in zip(x, y, strict=True):
        if not (math.isfinite(a) and math.isfinite(b)):
            pen = "M"
            continue
        p, q = (GRID * a, GRID * (1 - b)) if place is None else place(float(a), float(b))
        point = f"{round(p)} {round(min(max(q, -GRID), 2 * GRID))}"
        if point != last or pen == "M":
            parts.append(f"{pen}{point}")
        pen, last = "L", point
    return "".join(parts)
