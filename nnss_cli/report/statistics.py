"""Seeds are samples, records are blocks: intervals of medians over seeds, rank tests over records.

An interval over seeds says how far a result depends on initial weights and shuffling, on one record and split. It says
nothing about another record: for that the unit is the record, and fewer than `MIN_RECORDS` of them support no test.

Sources: H. A. David and H. N. Nagaraja, "Order Statistics", 3rd ed., 2003, section 7.1; R. McGill, J. W. Tukey and
W. A. Larsen, "Variations of box plots", The American Statistician 32(1), 1978; J. Demšar, "Statistical comparisons of
classifiers over multiple data sets", JMLR 7, 2006; A. Benavoli, G. Corani and F. Mangili, "Should we really use
post-hoc tests based on mean-ranks?", JMLR 17, 2016.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

LEVEL = 0.95
REPRODUCED = 10.0  # percent
MIN_RECORDS = 6  # with five, no signed-rank test of two methods can reach 5 %


@dataclass(frozen=True)
class Interval:
    """Bounds of a quantity, and how often such bounds hold."""

    low: float
    """Lower bound."""
    high: float
    """Upper bound; ∞ where failed runs reach into it."""
    coverage: float
    """Probability that it covers, at least; 0 for a single value, of which nothing is known."""


@dataclass(frozen=True)
class Comparison:
    """A paired test between two methods over records."""

    first: str
    """The one with the lower mean rank."""
    second: str
    """The other."""
    wins: int
    """Records on which the first is lower."""
    pairs: int
    """Records on which they differ."""
    p: float
    """Two-sided Wilcoxon signed-rank test."""
    adjusted: float
    """The same after Holm's correction for all comparisons."""

    @property
    def differ(self) -> bool:
        """Whether the two are shown to differ, at a family-wise error of 5 %."""
        return self.adjusted <= 1 - LEVEL


def median_interval(values: Sequence[float], level: float = LEVEL) -> Interval:
    """Distribution-free bounds of the median: [x₍ₖ₎, x₍ₙ₊₁₋ₖ₎] of the ordered values, with the largest k that will do.

        coverage = 1 − 2 P(B < k),   B binomial (n, ½)

    Too few values for the level (fewer than six for 95 %) give smallest and largest, with the coverage these have.
    """
    ordered = sorted(values)
    n = len(ordered)
    every = 2**n  # outcomes, counted in whole numbers: from a thousand values on they exceed a float's range
    k, tail, outcomes = 1, 1, 1  # tail/every = P(B < k), outcomes = n over (k − 1)
    while k < n:
        outcomes = outcomes * (n - k + 1) // k
        if (tail + outcomes) / every > (1 - level) / 2:
            break
        k, tail = k + 1, tail + outcomes
    return Interval(ordered[k - 1], ordered[n - k], max(0.0, 1 - 2 * (tail / every)))


def ratio_interval(first: Sequence[float], second: Sequence[float], exact: tuple[bool, bool]) -> Interval:
    """Bounds of the ratio of two medians, from the intervals of both, each at half the error (Bonferroni).

    Args:
        first: errors of the seeds of one method.
        second: of the other.
        exact: whether each has no seed, so that its one value is all there is to know.
    """
    level = LEVEL if any(exact) else (1 + LEVEL) / 2
    a, b = (
        Interval(values[0], values[0], 1.0) if known else median_interval(values, level)
        for values, known in zip((first, second), exact, strict=True)
    )
    return Interval(_ratio(a.low, b.high), _ratio(a.high, b.low), max(0.0, a.coverage + b.coverage - 1))


def ratio(first: Sequence[float], second: Sequence[float]) -> float:
    """The first median over the second; failed runs enter as ∞."""
    return _ratio(quantile(first, 0.5), quantile(second, 0.5))


def _ratio(a: float, b: float) -> float:
    if math.isinf(b):
        return math.nan if math.isinf(a) else 0.0
    return a / b if b > 0 else (1.0 if a == 0 else math.inf)


def quantile(values: Sequence[float], q: float) -> float:
    """As NumPy's, between order statistics; ∞ where an infinite value has a part in it."""
    if len(values) == 1:  # of a method without seeds, which most are
        return float(values[0])
    ordered = np.sort(np.asarray(values, dtype=float))
    if np.isfinite(ordered).all():
        return float(np.quantile(ordered, q))
    at = q * (len(ordered) - 1)
    low = math.floor(at)
    if at == low or math.isinf(ordered[low + 1]):
        return float(ordered[low] if at == low else math.inf)
    return float(ordered[low] + (at - low) * (ordered[low + 1] - ordered[low]))


def quartile_interval(median: float, q1: float, q3: float, count: int) -> tuple[float, float]:
    """About 95 % bounds of a median of which only quartiles are known: ± 1.57 (q3 − q1)/√n, a box plot's notch."""
    half = 1.57 * (q3 - q1) / math.sqrt(count)
    return median - half, median + half


def verdict(ours: float, theirs: float, unit: float = 0.0) -> str:
    """reproduced (within 10 %, or within half a printed unit), better (lower) or worse (higher)."""
    if abs(ours - theirs) <= max(REPRODUCED / 100 * theirs, unit / 2):
        return "reproduced"
    return "better" if ours < theirs else "worse"


def mean_ranks(table: pd.DataFrame) -> pd.Series:
    """Mean rank of each method (1 is the lowest error); ties share.

    Args:
        table: errors, a row per record, a column per method, none missing.
    """
    return table.rank(axis=1).mean().sort_values(kind="stable")


def smallest_adjusted(records: int, methods: int) -> float:
    """The smallest p that Holm's correction can give: 2/2ᴺ of the signed-rank test, times all pairs."""
    return min(1.0, 2.0 ** (1 - records) * math.comb(methods, 2))


def paired_tests(table: pd.DataFrame) -> list[Comparison]:
    """Every two methods over the rows of `table`: Wilcoxon's signed-rank test on log errors, Holm's correction.

    Args:
        table: as in `mean_ranks`.

    Raises:
        ValueError: fewer than `MIN_RECORDS` rows, which support no test.
    """
    from scipy.stats import wilcoxon
    from statsmodels.stats.multitest import multipletests

    if len(table) < MIN_RECORDS:
        raise ValueError(f"expected at least {MIN_RECORDS} records, found {len(table)}: they support no test")
    pairs = list(itertools.combinations(mean_ranks(table).index, 2))
    logs = {name: np.log(table[name].to_numpy()) for name in table}
    difference = np.array([logs[first] - logs[second] for first, second in pairs])
    tied = (difference == 0).any(axis=1)  # ties say nothing: these pairs have fewer records
    p = np.ones(len(pairs))
    if not tied.all():
        p[~tied] = wilcoxon(difference[~tied], axis=1).pvalue
    for index in np.flatnonzero(tied):
        left = difference[index][difference[index] != 0]
        p[index] = wilcoxon(left).pvalue if len(left) else 1.0
    adjusted = multipletests(p, method="holm")[1]
    wins, differing = (difference < 0).sum(axis=1), (difference != 0).sum(axis=1)
    return [
        Comparison(*pair, int(w), int(d), float(one), float(holm))
        for pair, w, d, one, holm in zip(pairs, wins, differing, p, adjusted, strict=True)
    ]
