"""What residuals still hold: correlation with themselves and with the inputs, and a mean that depends on a signal.

A model that has all dynamics leaves white one-step errors, and errors that are independent of the inputs. Source:
L. Ljung, "System Identification", 2nd ed., 1999, section 16.6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.special
from numpy.lib.stride_tricks import sliding_window_view

from nnss_cli.datasets.record import FloatArray

LAGS = 25  # looked at, or fewer where the record is short
TESTED = 10  # lags of a test: with 25 of 300 samples, 1 % is 1.4 %
WHITENER = 10  # order of the AR models that prewhiten
LEVEL = 0.01  # of each test
BAND = 2.5758293035489004  # Φ⁻¹(0.995): 99 % of white residuals' correlations lie within ±BAND/√N, lag by lag
BINS = 10


@dataclass(frozen=True, eq=False)
class Whiteness:
    """Autocorrelation of one output's residuals, and the test that there is none."""

    correlation: FloatArray
    """r(1) … r(25), or fewer for a short record."""
    band: float
    """99 % band of a single lag of white residuals, 2.58/√N."""
    statistic: float
    """Q = N Σ r(l)² + Σ (N − n(l))/N, l = 1 … L, with n(l) pairs of samples l apart."""
    lags: int
    """L."""
    p_value: float
    """Of Q under χ² with L degrees of freedom: small where residuals are coloured; 1 where they do not vary."""


@dataclass(frozen=True, eq=False)
class Dependence:
    """Cross-correlation of one output's residuals with one input, and the test that there is none."""

    correlation: FloatArray
    """Between ε(k) and u(k − l), each prewhitened by an AR model of its own, l = 0 … 25, or fewer."""
    band: float
    """99 % band of a single lag for residuals that are independent of the input, 2.58/√N."""
    statistic: float
    """N² Σ r(l)²/n(l), l = 0 … L, with n(l) pairs of samples l apart."""
    lags: int
    """L."""
    p_value: float
    """Of it under χ² with L + 1 degrees of freedom; 1 where a signal does not vary."""


@dataclass(frozen=True, eq=False)
class Profile:
    """Mean residual by the value of another signal."""

    centres: FloatArray
    """Mean of the signal in each bin (B,)."""
    means: FloatArray
    """Mean residual in each bin (B,)."""
    bands: FloatArray
    """99 % of the means of white residuals lie within ± this (B,)."""
    share: float
    """Share of the residuals' variance that the bins explain beyond a straight line over the signal, less what they
    explain of white noise; at least 0. A line is what a linear model, or feedback, leaves."""
    p_value: float
    """Of the F test that a straight line is all there is, which takes residuals for white; 1 of two bins."""


def lags_of_tests(samples: int) -> int:
    """L of the tests: 10, or fewer than samples/30, but 3 at least."""
    return max(3, min(TESTED, samples // 30))


def _shown_lags(samples: int) -> int:
    return max(lags_of_tests(samples), min(LAGS, samples // 5))


def autocovariance(parts: Sequence[FloatArray], lags: int) -> FloatArray:
    """R(0) … R(lags) (lags + 1,) of a signal in several stretches (K,), about its common mean, over all N samples."""
    mean, count = np.concatenate(parts).mean(), sum(map(len, parts))
    found = np.zeros(lags + 1)
    for part in parts:
        centred = part - mean
        for lag in range(min(lags, len(part) - 1) + 1):
            found[lag] += centred[lag:] @ centred[: len(part) - lag]
    return found / count


def _pairs(parts: Sequence[FloatArray], lags: int) -> FloatArray:
    """n(0) … n(lags): pairs of samples so far apart within a record; N − l of one record, fewer of several."""
    return np.array([sum(max(0, len(part) - lag) for part in parts) for lag in range(lags + 1)], dtype=float)


def whiteness(parts: Sequence[FloatArray]) -> Whiteness:
    """Li and McLeod's test of residuals (K,), of one or several records.

    Ljung and Box's weights N (N + 2)/(N − l) give Q the mean of χ², but a larger variance: at 1 % they reject 1.2 % of
    white records of 200 samples. Li and McLeod add what is missing of the mean instead: 1.0 %. Source: W. K. Li and
    A. I. McLeod, J. Royal Statistical Society B 43(2), 1981. No degrees of freedom are taken off, so the level is right
    for records on which nothing was fitted.
    """
    N = sum(map(len, parts))
    R = autocovariance(parts, _shown_lags(N))
    L, band = lags_of_tests(N), BAND / math.sqrt(N)
    if not R[0] > 0:
        return Whiteness(np.zeros(len(R) - 1), band, 0.0, L, 1.0)
    r = R[1:] / R[0]
    Q = float(N * np.sum(r[:L] ** 2) + np.sum(1 - _pairs(parts, L)[1:] / N))
    return Whiteness(r, band, Q, L, float(scipy.special.chdtrc(L, Q)))


def dependence(errors: Sequence[FloatArray], inputs: Sequence[FloatArray]) -> Dependence:
    """Whether residuals (K,) depend on an input (K,), record by record.

    Both are coloured, as a rule, and so would be their cross-correlation; prewhitened they are independent at all lags
    where there is nothing. Source: L. D. Haugh, "Checking the independence of two covariance-stationary time series",
    J. American Statistical Association 71(354), 1976.
    """
    white = [_prewhitened(parts) for parts in (errors, inputs)]
    N = sum(map(len, white[0])) if white[0] else sum(map(len, errors))
    L, band = lags_of_tests(N), BAND / math.sqrt(N)
    sums = np.zeros(_shown_lags(N) + 1)
    powers = [sum(float(part @ part) for part in parts) for parts in white]
    if not min(powers) > 0:
        return Dependence(sums, band, 0.0, L, 1.0)
    for e, u in zip(*white, strict=True):
        for lag in range(min(len(sums), len(e))):
            sums[lag] += e[lag:] @ u[: len(u) - lag]
    r = sums / math.sqrt(powers[0] * powers[1])
    statistic = float(N**2 * np.sum(r[: L + 1] ** 2 / np.maximum(_pairs(white[0], L), 1)))
    return Dependence(r, band, statistic, L, float(scipy.special.chdtrc(L + 1, statistic)))


def _prewhitened(parts: Sequence[FloatArray]) -> list[FloatArray]:
    """What an AR model of the signal leaves of each record, without the first samples; [] for a constant."""
    mean, shortest = np.concatenate(parts).mean(), min(map(len, parts))
    p = max(0, min(WHITENER, shortest // 10))
    centred = [part - mean for part in parts]
    rows = [sliding_window_view(part, p + 1) for part in centred]
    both = np.concatenate(rows)
    scale = float(np.sqrt(np.mean(both**2)))
    if not scale > 0:
        return []
    a = np.linalg.lstsq(both[:, :-1], both[:, -1], rcond=1e-6)[0]
    left = [part[:, -1] - part[:, :-1] @ a for part in rows]
    # of a signal that its past foretells, a step or a sine, nothing but rounding is left
    return left if float(np.sqrt(np.mean(np.concatenate(left) ** 2))) > 1e-6 * scale else []


def profile(errors: FloatArray, signal: FloatArray) -> Profile | None:
    """Mean residual (N,) in ten bins of a signal (N,) with equally many samples; None where the signal is constant."""
    edges = np.unique(np.quantile(signal, np.linspace(0, 1, BINS + 1)))
    if len(edges) < 2:
        return None
    levels = np.unique(signal)
    few = len(levels) <= BINS
    bins = np.searchsorted(levels, signal) if few else np.clip(np.searchsorted(edges, signal, "right") - 1, 0, None)
    bins = np.minimum(bins, (len(levels) if few else len(edges) - 1) - 1)
    counts = np.bincount(bins)
    used = counts > 0
    counts = counts[used]
    centres, means = (np.bincount(bins, values)[used] / counts for values in (signal, errors))
    B, N = len(counts), len(errors)
    of_bin = (np.cumsum(used) - 1)[bins]
    inside_bins = errors - means[of_bin]
    total, within = (float(np.sum(part**2)) for part in (errors - errors.mean(), inside_bins))
    # what a straight line leaves, and what one leaves together with the bins, among which it is where they are values
    line = total - _explained(errors - errors.mean(), signal - signal.mean())
    both = within if few else within - _explained(inside_bins, signal - centres[of_bin])
    bent, freedom = B - 2 + (not few), N - B - (not few)
    if B < 2 or freedom < 1 or not both > 0:
        return None
    inside = both / freedom
    bands = BAND * np.sqrt(within / (N - B) / counts)
    if bent == 0:
        return Profile(centres, means, bands, 0.0, 1.0)
    F, share = (line - both) / bent / inside, max(0.0, (line - both - bent * inside) / total)
    return Profile(centres, means, bands, share, float(scipy.special.fdtrc(bent, freedom, F)))


def _explained(errors: FloatArray, signal: FloatArray) -> float:
    """Sum of squares that a multiple of a signal (N,) explains of errors (N,)."""
    return float(errors @ signal) ** 2 / float(signal @ signal)
