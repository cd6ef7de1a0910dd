"""Statistics against values known from elsewhere."""

import numpy as np
import pandas as pd
import pytest

from nnss_cli.report.statistics import (
    critical_difference,
    holm,
    mean_ranks,
    median_interval,
    paired_tests,
    verdict,
)


def test_the_interval_of_a_median_covers_it_as_often_as_it_says() -> None:
    random = np.random.default_rng(0)
    inside = 0
    for _ in range(60):
        low, high = median_interval(random.standard_normal(25))
        inside += low <= 0.0 <= high
    assert inside >= 52  # 95 % of 60 is 57
    assert median_interval([3.0, 1.0, 2.0]) == median_interval([3.0, 1.0, 2.0])
    assert median_interval([4.0]) == (4.0, 4.0)


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.9, 0.8]) == [1.0, 1.0]


def test_the_critical_difference_is_demsars() -> None:
    # J. Demsar, JMLR 7, 2006: four classifiers on 14 data sets, q = 2.569, CD = 1.25
    assert critical_difference(4, 14) == pytest.approx(1.25, abs=0.005)


def test_ranks_and_paired_tests() -> None:
    table = pd.DataFrame({"a": [1.0, 1, 1, 1, 1, 1], "b": [2.0, 2, 3, 2, 4, 5], "c": [2.0, 3, 2, 4, 2, 6]})
    assert list(mean_ranks(table).index) == ["a", "b", "c"]
    tests = {(t.first, t.second): t for t in paired_tests(table)}
    assert tests["a", "b"].wins == tests["a", "b"].pairs == 6
    assert tests["a", "b"].p == pytest.approx(2 / 2**6)  # all six of one sign
    assert tests["b", "c"].pairs == 5  # the tie says nothing
    assert tests["a", "b"].adjusted == pytest.approx(3 * 2 / 2**6)


@pytest.mark.parametrize(
    ("ours", "theirs", "unit", "word"),
    [(1.09, 1.0, 0, "reproduced"), (0.8, 1.0, 0, "better"), (1.2, 1.0, 0, "worse"), (0.014, 0.01, 0.01, "reproduced")],
)
def test_verdicts(ours: float, theirs: float, unit: float, word: str) -> None:
    assert verdict(ours, theirs, unit) == word
