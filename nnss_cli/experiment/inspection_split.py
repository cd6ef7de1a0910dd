"""Which part of a record should train, validate and test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.preparation import cut, parse_split
from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.inspection_signals import Channel

# tried in this order; the first whose training and validation parts are at rest or far out of range least often is
# recommended. All test on the same samples, which so have no say.
SHARES = ("60/20/20", "50/30/20", "40/40/20")
BEYOND = 0.02  # share of samples outside the training range that is worth a warning
FAR = 0.1  # share that is worth another split
PART_NAMES = ("training", "validation", "test")


@dataclass(frozen=True)
class Part:
    """Samples start … stop − 1 of one experiment."""

    experiment: int
    """Index of the experiment, 0-based."""
    start: int
    """First sample."""
    stop: int
    """One past the last sample."""


@dataclass(frozen=True)
class Split:
    """What trains, what validates, what tests."""

    rule: str
    """E.g. "60/20/20 in time order"."""
    train: tuple[Part, ...]
    """Fitted on."""
    val: tuple[Part, ...]
    """Chosen on."""
    test: tuple[Part, ...]
    """Only scored on."""
    warnings: tuple[str, ...]
    """Where a part does not excite, or goes beyond the training range."""


def percent(share: float) -> str:
    """Two digits, or whole percents."""
    return f"{100 * share:.0f} %" if share >= 0.1 else f"{100 * share:.2g} %"


def recommend_split(experiments: Sequence[FloatArray], channels: Sequence[Channel]) -> Split:
    """60/20/20 in time order, unless another division does better; whole experiments where there are several.

    With three experiments or more the last tests and the one before validates; with two the second tests and the last
    quarter of the first validates. What the test part holds has no say.

    Args:
        experiments: columns (K, c) of each, NaN where missing.
        channels: what is known of the columns.
    """
    lengths = [len(data) for data in experiments]
    if len(experiments) >= 3:
        parts = [Part(e, 0, K) for e, K in enumerate(lengths)]
        return _checked("whole experiments", parts[:-2], parts[-2:-1], parts[-1:], experiments, channels)[0]
    if len(experiments) == 2:
        at = cut(lengths[0], (0.75, 0.25, 0.0))
        first, rest = Part(0, 0, at["train"].stop), Part(0, at["val"].start, lengths[0])
        rule = "the second experiment tests, the last quarter of the first validates"
        return _checked(rule, [first], [rest], [Part(1, 0, lengths[1])], experiments, channels)[0]
    K = lengths[0] if lengths else 0
    best: tuple[Split, int] | None = None
    for shares in SHARES:
        rule = f"{shares} in time order"
        at = cut(K, parse_split(shares))
        train, val, test = ([Part(0, at[name].start, at[name].stop)] if K else [] for name in ("train", "val", "test"))
        grave = _checked(rule, train, val, [], experiments, channels)[1]
        if best is None or grave < best[1]:
            best = _checked(rule, train, val, test, experiments, channels)[0], grave
    assert best is not None
    return best[0]


def checked(split: Split, experiments: Sequence[FloatArray], channels: Sequence[Channel]) -> Split:
    """The split with its warnings on these columns."""
    parts = [*split.train], [*split.val], [*split.test]
    return _checked(split.rule, *parts, experiments, channels)[0]


def _checked(
    rule: str, train: list[Part], val: list[Part], test: list[Part],
    experiments: Sequence[FloatArray], channels: Sequence[Channel],
) -> tuple[Split, int]:  # fmt: skip
    """The split with its warnings, and how many of them are worth another split."""
    warnings, grave = [], 0
    outside: dict[str, list[str]] = {name: [] for name in PART_NAMES}
    for i, channel in enumerate(channels):
        if channel.kind in ("empty", "constant"):
            continue
        ranges: tuple[float, float] | None = None
        for name, parts in zip(PART_NAMES, (train, val, test), strict=True):
            columns = [experiments[part.experiment][part.start : part.stop, i] for part in parts]
            low, high = _range(columns)
            if low > high:  # nothing there
                continue
            if low == high:
                warnings.append(f"{channel.role} '{channel.name}' is constant in the {name} part")
                grave += 1
            elif ranges is not None:
                beyond = _share(columns, *ranges)
                grave += beyond > FAR
                if beyond > BEYOND:
                    outside[name].append(f"{percent(beyond)} of {channel.role} '{channel.name}'")
            ranges = ranges or (low, high)
    for name, channels_outside in outside.items():
        if channels_outside:
            warnings.append(f"samples of the {name} part lie outside the training range: {', '.join(channels_outside)}")
    return Split(rule, tuple(train), tuple(val), tuple(test), tuple(warnings)), grave


def _range(columns: Sequence[FloatArray]) -> tuple[float, float]:
    """Smallest and largest sample; (∞, −∞) for none."""
    lows = [float(np.fmin.reduce(column)) for column in columns if len(column)]
    highs = [float(np.fmax.reduce(column)) for column in columns if len(column)]
    lows, highs = [v for v in lows if np.isfinite(v)], [v for v in highs if np.isfinite(v)]
    return min(lows, default=np.inf), max(highs, default=-np.inf)


def _share(columns: Sequence[FloatArray], low: float, high: float) -> float:
    """Share of the samples outside low … high."""
    count = sum(int(np.isfinite(column).sum()) for column in columns)
    return sum(int(np.sum((column < low) | (column > high))) for column in columns) / count
