"""Seeds are samples: intervals of medians, paired tests between methods, ranks.

Sources: B. Efron and R. Tibshirani, "An Introduction to the Bootstrap", 1993; J. Demšar, "Statistical comparisons
of classifiers over multiple data sets", JMLR 7, 2006.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from nnss_cli.iterative import named_random

LEVEL = 0.95
DRAWS = 10_000
REPRODUCED = 10.0  # percent


@dataclass(frozen=True)
class Comparison:
    """A paired test between two methods."""

    first: str
    """The one with the lower mean rank."""
    second: str
    """The other."""
    wins: int
    """Pairs in which the first is lower."""
    pairs: int
    """Pairs in which they differ."""
    p: float
    """Two-sided Wilcoxon signed-rank test."""
    adjusted: float
    """The same after Holm's correction for all comparisons."""


def median_interval(values: Sequence[float]) -> tuple[float, float]:
    """The 95 % percentile bootstrap interval of the median; the same values give the same interval."""
    sample = np.asarray(values, dtype=float)
    drawn = named_random(0, "bootstrap").choice(sample, (DRAWS, len(sample)))
    low, high = np.quantile(np.median(drawn, axis=1), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return float(low), float(high)


def verdict(ours: float, theirs: float, unit: float = 0.0) -> str:
    """reproduced (within 10 %, or within half a printed unit), better (lower) or worse (higher)."""
    if abs(ours - theirs) <= max(REPRODUCED / 100 * theirs, unit / 2):
        return "reproduced"
    return "better" if ours < theirs else "worse"


def holm(p: Sequence[float]) -> list[float]:
    """Holm's step-down adjustment of p values."""
    order = np.argsort(p)
    adjusted, largest = np.empty(len(p)), 0.0
    for position, index in enumerate(order):
        largest = max(largest, min(1.0, (len(p) - position) * p[index]))
        adjusted[index] = largest
    return [float(value) for value in adjusted]


def mean_ranks(table: pd.DataFrame) -> pd.Series:
    """Mean rank of each method (1 is the lowest error); ties share.

    Args:
        table: errors, a row per dataset and order, a column per method, none missing.
    """
    return table.rank(axis=1).mean().sort_values(kind="stable")


def critical_difference(methods: int, blocks: int) -> float:
    """Nemenyi's: mean ranks further apart than this differ at the 5 % level.

    CD = q √(k (k + 1) / (6 N)) for k methods and N blocks, q the studentised range over √2.
    """
    from scipy.stats import studentized_range

    q = float(studentized_range.ppf(LEVEL, methods, np.inf)) / np.sqrt(2)
    return float(q * np.sqrt(methods * (methods + 1) / (6 * blocks)))


def paired_tests(table: pd.DataFrame) -> list[Comparison]:
    """Every two methods over the rows of `table`: Wilcoxon's signed-rank test on log errors, Holm's correction.

    Args:
        table: as in `mean_ranks`.
    """
    from scipy.stats import wilcoxon

    ordered = list(mean_ranks(table).index)
    found = []
    for first, second in itertools.combinations(ordered, 2):
        difference = np.log(table[first]) - np.log(table[second])
        difference = difference[difference != 0]
        p = float(wilcoxon(difference).pvalue) if len(difference) else 1.0
        found.append((first, second, int((difference < 0).sum()), len(difference), p))
    adjusted = holm([row[-1] for row in found])
    return [Comparison(*row, value) for row, value in zip(found, adjusted, strict=True)]
