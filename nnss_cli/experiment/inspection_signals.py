"""What single columns of a record are like: its clock, gaps, grid, stops, spikes, copies, and how an input excites."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from nnss_cli.datasets.preparation import fit_drift, usual_step
from nnss_cli.datasets.record import FloatArray

Role: TypeAlias = Literal["input", "output"]

GRID = 0.01  # of a step: a sample closer than this to the grid lies on it
MERGED = 1e-9  # of the range: values closer than this are one value, apart by rounding only
RUN = 3  # equal extreme samples in a row that count as a stop
SPIKE = 8.0  # robust standard deviations that both flanks of a spike exceed
FEW = 16  # distinct values up to which a signal is listed by its levels
COPY = 1e-6  # of σ: RMS distance below which one column is an affine copy of another

ENDLESS = 1e100  # s: no instant

PE_LARGEST = 50  # largest order of persistency that is looked at
PE_TOLERANCE = 1e-9  # of the variance: eigenvalues of the covariance below it count as zero
PE_SAMPLES = 100_000  # samples of which the covariance is taken


def finite(value: float) -> float | None:
    """The number, or None for what JSON and tables cannot hold."""
    return float(value) if math.isfinite(value) else None


@dataclass(frozen=True)
class Clock:
    """Sampling instants."""

    Ts: float | None
    """Sampling time [s]: as given, else the time column's `step`; None where neither is there."""
    source: Literal["given", "time column", "preparation", "unknown"]
    """Where Ts comes from."""
    step: float | None
    """Usual step of the (first) time column [s], by the rule of training: mean of those within 1 % of the median, to
    nine digits; None without one."""
    jitter: float | None
    """Largest distance of a step from the median step, relative to it."""
    duplicates: int
    """Steps of zero length."""
    backwards: int
    """Steps back in time."""
    gaps: int
    """Steps longer than 1.5 median steps."""
    first_gap: int | None
    """Sample (0-based, of its experiment) before which the first gap stands."""
    first_gap_experiment: int | None
    """Experiment (0-based) of the first gap."""
    unreadable: int
    """Instants that are no numbers below 1e100 s."""


@dataclass(frozen=True)
class Channel:
    """One column, over all experiments. None where the column gives no answer."""

    name: str
    """Name."""
    role: Role
    """Input or output."""
    unit: str
    """Unit, "–" where none is stated."""
    samples: int
    """Rows."""
    missing: int
    """Samples that are NaN or infinite."""
    longest_gap: int
    """Most missing samples in a row."""
    minimum: float | None
    """Smallest value."""
    maximum: float | None
    """Largest value."""
    mean: float | None
    """Mean."""
    sigma: float | None
    """Standard deviation, ddof = 1."""
    levels: int
    """Distinct values; values closer than 1e-9 of the range are one."""
    kind: Literal["empty", "constant", "two levels", "few levels", "steps", "continuous"]
    """few levels: up to 16; steps: more, but over half of the samples equal the one before."""
    switches: int
    """Changes from one sample to the next."""
    step: float | None
    """Quantisation: the smallest distance of two distinct values."""
    on_grid: float | None
    """Share of the samples on the grid minimum + i·step, within 1 % of a step; near 0.02 for a signal without grid."""
    bits: float | None
    """log2(range/step + 1) where at least 99 % of the samples lie on the grid."""
    at_minimum: float
    """Share of the samples that are exactly the minimum, in runs of at least 3."""
    at_maximum: float
    """Share of the samples that are exactly the maximum, in runs of at least 3."""
    held: float
    """Share of the samples between minimum and maximum that equal the one before; near 1 for a staircase."""
    spikes: int | None
    """Single samples whose differences to both neighbours exceed 8 robust deviations (1.4826 MAD of all differences)
    in opposite directions; None where over half of the differences are equal, or the signal has few levels."""
    first_spike: int | None
    """Sample (0-based, of its experiment) that is the first of them."""
    first_spike_experiment: int | None
    """Experiment (0-based) of the first of them."""
    trend: float | None
    """What a straight line, fitted to the training part as `detrend = "linear"` does (in the time since each
    experiment's start), changes over the longest of it, in σ of that part."""
    trend_share: float | None
    """Share of that part's variance on the line. A description, no test: a slow signal without drift has one too."""


@dataclass(frozen=True)
class Copy:
    """Two columns that tell the same."""

    first: str
    """Name of the one."""
    second: str
    """Name of the other."""
    equal: bool
    """Whether they are equal; else second = gain·first + offset, |correlation| = 1."""
    gain: float | None
    """Gain."""
    offset: float | None
    """Offset."""


def examine_clock(Ts: float | None, times: Sequence[FloatArray]) -> Clock:
    """Steps of the time columns, one an experiment, against their median.

    Args:
        Ts: sampling time [s] if it is known.
        times: time column of each experiment [s]; empty without one.
    """
    readable = [np.abs(time) < ENDLESS for time in times]  # False for NaN
    steps = [np.diff(np.where(ok, time, np.nan)) for ok, time in zip(readable, times, strict=True)]
    known = [step[np.isfinite(step)] for step in steps]
    everything = np.concatenate(known) if known else np.empty(0)
    forward = [step[step > 1 / ENDLESS] for step in known]
    median = float(np.median(np.concatenate(forward))) if any(map(len, forward)) else None
    usual = next((usual_step(step) for step in forward if len(step)), None)
    source: Literal["given", "time column", "unknown"]
    source = "given" if Ts is not None else "unknown" if median is None else "time column"
    jitter, gaps, first = None, 0, None
    if median is not None:
        jitter = float(np.abs(everything - median).max() / median)
        for index, step in enumerate(steps):
            late = np.flatnonzero(step > 1.5 * median)
            gaps += len(late)
            if first is None and len(late):
                first = index, int(late[0]) + 1
    return Clock(
        usual if Ts is None else Ts, source, usual, jitter, int(np.sum(everything == 0)), int(np.sum(everything < 0)),
        gaps, first[1] if first else None, first[0] if first else None, int(sum(np.sum(~ok) for ok in readable)),
    )  # fmt: skip


def examine_channel(name: str, role: Role, unit: str, parts: Sequence[FloatArray]) -> Channel:
    """Facts about a column.

    Args:
        name: of the column.
        role: input or output.
        unit: of its values.
        parts: its samples in each experiment (K,); NaN where missing.
    """
    samples = sum(len(part) for part in parts)
    missing = [~np.isfinite(part) for part in parts]
    # a missing sample between experiments: no difference and no run crosses from one to the next
    x = np.concatenate([row for part in parts for row in (part, [np.nan])][:-1]) if parts else np.empty(0)
    v = x[np.isfinite(x)]
    empty = Channel(
        name, role, unit, samples, int(sum(np.sum(gap) for gap in missing)),
        max((_longest_run(gap) for gap in missing), default=0), None, None, None, None, 0, "empty", 0,
        None, None, None, 0.0, 0.0, 0.0, None, None, None, None, None,
    )  # fmt: skip
    if len(v) == 0:
        return empty
    # squares of huge or tiny numbers leave the range of numbers
    largest = float(np.abs(v).max())
    scale = 1.0 if largest == 0 or 1e-100 < largest < 1e100 else largest
    x, v = x / scale, v / scale
    low, high, mean = float(v.min()), float(v.max()), float(v.mean())
    sigma = float(v.std(ddof=1)) if len(v) > 1 else None
    d = np.diff(x)
    switches = int(np.sum(np.abs(d) > 0))
    common = {
        "minimum": low * scale, "maximum": high * scale, "mean": mean * scale, "switches": switches,
        "sigma": None if sigma is None else finite(sigma * scale),
        "at_minimum": _share_in_runs(x == low, len(v)), "at_maximum": _share_in_runs(x == high, len(v)),
    }  # fmt: skip
    if high == low:
        return _replace(empty, common | {"levels": 1, "kind": "constant", "sigma": 0.0 if len(v) > 1 else None})
    levels, step, on_grid = _grid(v, low, high)
    changes = switches / max(1, int(np.sum(np.isfinite(d))))
    between = (x[1:] > low) & (x[1:] < high)
    kind = (
        "two levels" if levels == 2 else "few levels" if levels <= FEW else "steps" if changes < 0.5 else "continuous"
    )
    spikes = _spikes(d) if levels > FEW else None
    starts = np.cumsum([0, *(len(part) + 1 for part in parts)])  # of the experiments in x
    at = int(np.searchsorted(starts, spikes[0], side="right")) - 1 if spikes is not None and len(spikes) else None
    return _replace(
        empty,
        common
        | {
            "levels": levels, "kind": kind, "step": finite(step * scale), "on_grid": on_grid,
            "bits": math.log2((high - low) / step + 1) if on_grid >= 0.99 else None,
            "held": float(np.mean(d[between] == 0)) if between.any() else 0.0,
            "spikes": None if spikes is None else len(spikes),
            "first_spike": None if spikes is None or at is None else int(spikes[0] - starts[at]),
            "first_spike_experiment": at,
        },
    )  # fmt: skip


def _replace(channel: Channel, known: dict[str, object]) -> Channel:
    return Channel(**(channel.__dict__ | known))


def _longest_run(mask: NDArray[np.bool_]) -> int:
    starts, stops = runs(mask)
    return int((stops - starts).max(initial=0))


def runs(mask: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Starts and ends (exclusive) of the runs of True in `mask` (K,)."""
    edges = np.flatnonzero(np.diff(mask, prepend=False, append=False))
    return edges[::2], edges[1::2]


def _share_in_runs(mask: NDArray[np.bool_], samples: int) -> float:
    starts, stops = runs(mask)
    length = stops - starts
    return float(length[length >= RUN].sum() / samples)


def _grid(v: FloatArray, low: float, high: float) -> tuple[int, float, float]:
    """Number of distinct values, their smallest distance, and the share of `v` on its grid."""
    gaps = np.diff(np.sort(v))
    gaps = gaps[gaps > MERGED * (high - low)]
    step = float(gaps.min())
    step = (high - low) / max(1, round((high - low) / step))  # rid of the rounding of one difference
    position = (v - low) / step
    return len(gaps) + 1, step, float(np.mean(np.abs(position - np.rint(position)) < GRID))


def _spikes(d: FloatArray) -> NDArray[np.intp] | None:
    """Samples that are spikes, from the differences `d` (K − 1,); None where their deviation is zero."""
    known = d[np.isfinite(d)]
    if len(known) < 10:
        return None
    centre = np.median(known)
    deviation = 1.4826 * np.median(np.abs(known - centre))
    if not deviation > 0:
        return None
    z = (d - centre) / deviation
    both = np.minimum(np.abs(z[:-1]), np.abs(z[1:])) > SPIKE
    return np.flatnonzero(both & (z[:-1] * z[1:] < 0)) + 1


def with_trend(channel: Channel, parts: Sequence[tuple[FloatArray, FloatArray]]) -> Channel:
    """The channel with the line of its training parts, each (t, values), (K,) both; values may have gaps."""
    known = [(t[ok], values[ok]) for t, values in parts for ok in [np.isfinite(values)] if ok.any()]
    t, x = (np.concatenate([pair[i] for pair in known]) if known else np.empty(0) for i in (0, 1))
    largest = float(np.abs(x).max(initial=0))  # squares of huge numbers leave the range of numbers
    if len(x) < 3 or largest == 0 or np.ptp(t) == 0:
        return channel
    slope = float(fit_drift([(t, values[:, None] / largest) for t, values in known]).slope[0])
    spread = float(np.var(x / largest))
    if not spread > 0:
        return channel
    change = slope * float(np.ptp(t)) / math.sqrt(spread * len(x) / (len(x) - 1))
    return replace(channel, trend=finite(change), trend_share=min(1.0, slope**2 * float(np.var(t)) / spread))


def find_copies(names: Sequence[str], columns: FloatArray) -> tuple[Copy, ...]:
    """Pairs of columns that are equal or affine copies of each other.

    Args:
        names: name of each column.
        columns: complete rows (K, c), no constant column among them.
    """
    if len(columns) < 3:
        return ()
    scale = np.abs(columns).max(0)  # squares of huge numbers leave the range of numbers
    columns = columns / np.where(scale > 0, scale, 1)
    mean, sigma = columns.mean(0), columns.std(0)
    thin = (columns[:: max(1, len(columns) // 1000)] - mean) / np.where(sigma > 0, sigma, 1)
    found = []
    for i in range(len(names)):
        for j in range(i + 1, len(names)):
            if not (sigma[i] > 0 and sigma[j] > 0):
                continue
            sign = 1.0 if thin[:, i] @ thin[:, j] > 0 else -1.0
            if np.sqrt(np.mean((thin[:, i] - sign * thin[:, j]) ** 2)) > 2 * COPY:
                continue
            gain = sign * sigma[j] / sigma[i]
            rest = columns[:, j] - mean[j] - gain * (columns[:, i] - mean[i])
            if np.sqrt(np.mean(rest**2)) <= COPY * sigma[j]:
                equal = bool(scale[i] == scale[j] and np.array_equal(columns[:, i], columns[:, j]))
                with np.errstate(over="ignore", invalid="ignore"):
                    physical = gain * scale[j] / scale[i], (mean[j] - gain * mean[i]) * scale[j]
                found.append(Copy(names[i], names[j], equal, finite(physical[0]), finite(physical[1])))
    return tuple(found)


@dataclass(frozen=True)
class Persistency:
    """How many parameters an input can tell apart."""

    order: int
    """Numerical rank of the covariance of `largest` shifted inputs, not centred: a constant counts 1, a sine 2."""
    largest: int
    """Largest order looked at; the order of persistency is at least this where `order` equals it."""
    tolerance: float
    """Eigenvalues below this share of the variance count as zero."""
    samples: int
    """Samples looked at."""


def persistency(parts: Sequence[FloatArray]) -> Persistency:
    """Order of persistent excitation of one or more inputs together.

    Largest n such that the covariance of u(k), …, u(k−n+1) is not singular (L. Ljung, "System Identification", 2nd
    ed., 1999, definition 13.2), by windows that lie inside the record: for k sines it is 2k, without leakage.

    Args:
        parts: stretches without gaps, inputs (K, r).
    """
    r = parts[0].shape[1] if parts else 1
    everything = np.concatenate(parts) if parts else np.empty((0, r))
    # for r inputs the covariance has r·n rows
    largest = min(PE_LARGEST, 200 // r, max([(len(part) + 1) // (1 + r) for part in parts], default=0))
    if largest < 1:
        return Persistency(0, 0, PE_TOLERANCE, len(everything))
    scale = np.maximum(np.abs(everything).max(0), np.finfo(float).tiny)
    mean = (everything / scale).mean(0)
    sigma = (everything / scale).std(0)
    sigma = np.where(sigma > 1e-12, sigma, np.where(np.abs(mean) > 0, np.abs(mean), 1.0))
    # a mean of many σ would drown the rest in rounding; one σ of it is as constant
    level = np.clip(mean / sigma, -1, 1)
    covariance = np.zeros((r * largest, r * largest))
    windows = samples = 0
    for part in parts:
        rows = min(len(part), PE_SAMPLES - samples)
        for block in _windows((part[:rows] / scale - mean) / sigma + level, largest):
            covariance += block.T @ block
            windows += len(block)
        samples += max(rows, 0)
    if windows == 0:
        return Persistency(0, largest, PE_TOLERANCE, samples)
    covariance /= windows
    if r == 1:
        order = int(np.sum(np.linalg.eigvalsh(covariance) > PE_TOLERANCE))
    else:  # the leading blocks are the covariances of fewer shifts
        regular = [np.linalg.eigvalsh(covariance[: n * r, : n * r])[0] > PE_TOLERANCE for n in range(1, largest + 1)]
        order = regular.index(False) if False in regular else largest
    return Persistency(order, largest, PE_TOLERANCE, samples)


def _windows(u: FloatArray, n: int) -> Iterator[FloatArray]:
    """Rows [u(k−n+1) … u(k)] of `u` (K, r), block by block; all inputs of one instant side by side."""
    if len(u) >= n:
        view = sliding_window_view(u, n, axis=0)  # (windows, r, n)
        for start in range(0, len(view), 8192):
            yield view[start : start + 8192].transpose(0, 2, 1).reshape(-1, n * u.shape[1])
