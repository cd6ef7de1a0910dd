"""From raw columns to uniform samples: time axis, missing samples, resampling, decimation, trends, splits.

Pure functions of arrays; time runs along the first axis. `where(k)` names sample k in a message, so that it can be
the row of a file.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from nnss_cli.datasets.record import FloatArray

from nnss_cli.errors import InputError

Where: TypeAlias = Callable[[int], str]

JITTER = 0.01
"""A time axis is uniform if no step differs from their median by more than this part of it."""
AGREEMENT = 1e-3
"""Two sampling times are one if they differ by no more than this part."""
ATTENUATION = 60.5
"""Of the anti-alias filter, by Kaiser's formula [dB]: 60 above the new Nyquist frequency, for all N; 0.1 % below."""
TRANSITION = 0.2
"""Width of the filter's transition band below the new Nyquist frequency, as a part of it."""
HALF_LENGTH = 19
"""Half the filter's length in new samples, from Kaiser's formula for the two numbers above."""
OVERSAMPLING = 8
"""Points that a straight line between two samples is filtered at: what its kinks fold back is 40 dB down."""
LARGEST_GRID = 10_000_000
"""Samples that resampling may make, or a hundred for each given one where that is more."""

TREND_KINDS = ("none", "constant", "linear")


def sample(k: int) -> str:
    """Sample k, counted from 1."""
    return f"sample {k + 1}"


def check_increasing(t: FloatArray, where: Where = sample) -> None:
    """Refuse a time axis with a missing value, a step back or a repeated time, or fewer than two samples.

    Raises:
        InputError: names the first such place.
    """
    if len(t) < 2:
        raise InputError(f"{where(0)}: a time axis needs at least two samples, found {len(t)}")
    if np.isnan(t).any():
        raise InputError(f"{where(int(np.isnan(t).argmax()))}: the time is missing: fill it in or cut the row")
    back = np.diff(t) <= 0
    if back.any():
        k = int(back.argmax())
        raise InputError(
            f"{where(k + 1)}: time goes from {t[k]:.10g} to {t[k + 1]:.10g}: expected it to grow; sort or cut the rows"
        )


def usual_step(steps: FloatArray) -> float:
    """The mean of the steps within `JITTER` of their median, so that a gap does not move it, to nine digits."""
    median = float(np.median(steps))
    near = steps[np.abs(steps - median) <= JITTER * median]
    return float(f"{near.mean() if len(near) else median:.9g}")


def uniform_Ts(t: FloatArray, where: Where = sample, remedy: str = "") -> float:
    """Sampling time of a uniform time axis: its `usual_step`, which is the mean of all.

    Args:
        t: instants (K,).
        where: names a sample.
        remedy: what can be done at hand; to resample it, unless told otherwise.

    Raises:
        InputError: some step differs from the median by more than `JITTER` (the first such is named), or time
            does not increase.
    """
    check_increasing(t, where)
    steps = np.diff(t)
    Ts, median = usual_step(steps), float(np.median(steps))
    off = np.abs(steps - median) > JITTER * median
    if off.any():
        k = int(off.argmax())
        raise InputError(
            f"{where(k + 1)}: time is not uniform: the step is {steps[k]:.6g} s, expected {Ts:.6g} s within "
            f"{JITTER:.0%} ({int(off.sum())} of {len(steps)} steps are off): "
            + (remedy or f"resample (--resample {Ts:.9g}), or leave the time column out and give Ts where the times "
            "are only rounded")
        )  # fmt: skip
    return Ts


def check_agreement(Ts: float, found: float, what: str, remedy: str = "leave one out, or resample") -> None:
    """Refuse two sampling times that differ by more than `AGREEMENT`.

    Args:
        Ts: the one that is expected [s].
        found: the other.
        what: has it.
        remedy: what can be done at hand.

    Raises:
        InputError: names both.
    """
    if not abs(found - Ts) <= AGREEMENT * Ts:
        raise InputError(f"{what}: sampling time {found:.9g} s, expected {Ts:.9g} s: {remedy}")


INTERPOLATE = 'repair the file, or interpolate (--missing interpolate, or missing = "interpolate" in a description)'
"""What can be done about missing samples of a record that is described."""


def check_complete(values: FloatArray, names: Sequence[str], where: Where = sample, remedy: str = INTERPOLATE) -> None:
    """Refuse values (K, c) with missing samples (NaN).

    Args:
        values: to be looked at.
        names: of the columns.
        where: names a sample.
        remedy: what can be done at hand.

    Raises:
        InputError: names the first column, its first gap and its longest, how many samples are missing, and the other
            columns that miss some.
    """
    gaps: list[str] = []
    for name, column in zip(names, values.T, strict=True):
        missing = np.isnan(column)
        if missing.any():
            first, (start, length) = int(missing.argmax()), _longest_run(missing)
            begins = f"{where(first)}, column '{name}': " if not gaps else f"column '{name}': "
            elsewhere = f", from {where(start)} on" * (start != first or bool(gaps))
            told = f"{int(missing.sum())} of {len(missing)} samples are missing, the longest gap is {length}"
            gaps.append(begins + told + elsewhere)
    if gaps:
        raise InputError(f"{'; '.join(gaps)}: {remedy}")


def _longest_run(flags: np.ndarray) -> tuple[int, int]:
    """Where the first of the longest runs of true begins, and its length."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    lengths = edges[1::2] - edges[::2]
    k = int(lengths.argmax())
    return int(edges[::2][k]), int(lengths[k])


def interpolate_missing(t: FloatArray, values: FloatArray, names: Sequence[str], where: Where = sample) -> FloatArray:
    """Values (K, c) with each gap filled by the straight line in t between its neighbours.

    Raises:
        InputError: a gap at the start or the end, which has one neighbour only; a column without samples.
    """
    filled = np.array(values, dtype=np.float64)
    for name, column in zip(names, filled.T, strict=True):
        missing = np.isnan(column)
        for end, k in (("starts", 0), ("ends", len(column) - 1)):
            if missing[k]:
                raise InputError(
                    f"{where(k)}, column '{name}': the record {end} with a missing sample, which has a neighbour on "
                    "one side only: cut the rows there"
                )
        if missing.any():
            column[missing] = np.interp(t[missing], t[~missing], column[~missing])
    return filled


def downsample(values: FloatArray, N: int) -> FloatArray:
    """Samples 0, N, 2N, … of values (K, c) behind a zero-phase anti-alias filter: ⌈K/N⌉ rows, no delay.

    The filter is a linear-phase FIR (Kaiser window) of 2·19·N + 1 taps, centred: flat to 0.1 % up to 0.8 of the new
    Nyquist frequency, 60 dB down above it. At the ends the record is continued by its point reflection
    (2x(0) − x(k)), which keeps constants and straight lines exactly. Within 19 new samples of an end the result
    leans on that, and everywhere on 19 new samples ahead: cut the record first where that matters.

    Raises:
        InputError: N is not positive, or the record is no longer than half the filter.
    """
    if N < 1:
        raise InputError(f"downsample: expected a whole number from 1 on, found {N}")
    if N == 1:
        return values
    half = HALF_LENGTH * N
    K = len(values)
    if half >= K:
        raise InputError(
            f"downsample {N}: the filter needs more than {half} samples, found {K}: take a longer record or a smaller N"
        )
    from scipy.signal import firwin, kaiser_beta, upfirdn

    taps = firwin(2 * half + 1, (1 - TRANSITION / 2) / N, window=("kaiser", kaiser_beta(ATTENUATION)))
    before = 2 * values[0] - values[half:0:-1]
    after = 2 * values[-1] - values[-2 : -half - 2 : -1]
    extended = np.concatenate([before, values, after])
    # The full convolution is centred on sample 0 at index 2·half, a multiple of N.
    start = 2 * half // N
    return np.asarray(upfirdn(taps, extended, down=N, axis=0)[start : start + -(-K // N)])


def resample(t: FloatArray, values: FloatArray, Ts: float) -> FloatArray:
    """Values (K, c) at t(0), t(0) + Ts, … up to t(K−1), by straight lines between the samples.

    Where the new grid is coarser than the usual step, they are put on a grid q times finer first, eight times as
    fine as the samples, and `downsample` takes every q-th behind its anti-alias filter.

    Raises:
        InputError: Ts is not positive, makes fewer than two samples or far more than were given; time does
            not increase.
    """
    check_increasing(t)
    if not (np.isfinite(Ts) and Ts > 0):
        raise InputError(f"resample: expected a positive sampling time in seconds, found {Ts}")
    span = float(t[-1] - t[0])
    usual = float(np.median(np.diff(t)))
    if Ts > span:
        raise InputError(
            f"resample: {Ts:.6g} s makes fewer than two samples of a record of {span:.6g} s: give a shorter one"
        )
    q = int(np.ceil(OVERSAMPLING * Ts / usual)) if Ts > (1 + JITTER) * usual else 1
    count = span / Ts * q
    if count > max(LARGEST_GRID, 100 * len(t)):
        raise InputError(
            f"resample: {Ts:.6g} s makes {count:.0f} samples of {len(t)}: give a longer sampling time, or cut the "
            "record at its gaps"
        )
    # A last sample that rounding would put just behind the end still counts.
    grid = t[0] + np.arange(int(np.floor(count + 1e-6)) + 1) * (Ts / q)
    fine = np.column_stack([np.interp(grid, t, column) for column in values.T])
    return downsample(fine, q)


@dataclass(frozen=True)
class Drift:
    """A drift of the signals: slope·(t − middle), t in seconds since the start of the file."""

    slope: FloatArray
    """Per second, (c,), physical units."""
    middle: float
    """When it is zero [s]."""

    def at(self, t: FloatArray) -> FloatArray:
        """The drift (K, c) at times t (K,)."""
        return np.outer(t - self.middle, self.slope)


def fit_drift(parts: Sequence[tuple[FloatArray, FloatArray]]) -> Drift:
    """The least-squares line of all parts (t, values (K, c)) together, without the mean.

    It is to be fitted on training parts only, and taken off the others as it is: it goes on beyond the part that it
    was fitted to, in a file of its own from that file's start. A drift that does not go on like that is none to
    take off by a line.
    """
    t = np.concatenate([t for t, _ in parts])
    values = np.concatenate([values for _, values in parts])
    middle = float(t.mean())
    centred = t - middle
    return Drift(centred @ (values - values.mean(axis=0)) / (centred @ centred), middle)


Split: TypeAlias = tuple[float, float, float]
PartName: TypeAlias = Literal["train", "val", "test"]


def parse_split(text: str) -> Split:
    """ "60/20/20" (percent) or "0.6/0.2/0.2" (fractions) as fractions of train, validation and test.

    Raises:
        InputError: not three numbers that sum to 100 or 1, or an empty train part.
    """
    expected = "expected train/validation/test in percent or fractions, as 60/20/20"
    parts = text.split("/")
    if len(parts) != 3 or not all(re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*", part, re.ASCII) for part in parts):
        raise InputError(f"split '{text}': {expected}")
    train, val, test = (float(part) for part in parts)
    total = train + val + test
    whole = 100.0 if total > 1.5 else 1.0
    if not abs(total - whole) <= 1e-6 * whole:
        raise InputError(f"split '{text}': the parts sum to {total:g}, expected 100 (or 1 as fractions)")
    if train == 0:
        raise InputError(f"split '{text}': the train part is empty; {expected}")
    return train / total, val / total, test / total


def cut(K: int, split: Split) -> dict[PartName, slice]:
    """The samples of each part of K, in time order; each sample is in one part."""
    first, second = round(K * split[0]), round(K * (split[0] + split[1]))
    return {"train": slice(0, first), "val": slice(first, second), "test": slice(second, K)}
