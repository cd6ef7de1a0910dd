"""Statistics against values known from elsewhere, and against what they claim."""

import itertools
import math

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binom

from nnss_cli.report.statistics import (
    MIN_RECORDS,
    mean_ranks,
    median_interval,
    paired_tests,
    quantile,
    quartile_interval,
    ratio,
    ratio_interval,
    smallest_adjusted,
    verdict,
)


def test_the_interval_of_a_median_is_the_order_statistics_of_the_textbook() -> None:
    # David and Nagaraja, section 7.1: x(2)–x(9) of ten has 97.9 %, x(3)–x(8) only 89.1 %
    bounds = median_interval([5, 3, 1, 4, 2, 10, 9, 8, 7, 6])
    assert (bounds.low, bounds.high) == (2, 9)
    assert bounds.coverage == pytest.approx(1 - 2 * 11 / 1024)
    assert [median_interval(range(n)).coverage for n in (1, 2, 3, 5)] == pytest.approx([0, 0.5, 0.75, 0.9375])


@pytest.mark.parametrize("n", [2, 3, 5, 6, 9, 10, 12, 20])
def test_the_interval_covers_the_median_as_often_as_it_says(n: int) -> None:
    random = np.random.default_rng(n)
    drawn = [median_interval(np.exp(2 * random.standard_normal(n))) for _ in range(2000)]
    covered = np.mean([bounds.low <= 1 <= bounds.high for bounds in drawn])
    claimed = drawn[0].coverage
    assert covered == pytest.approx(claimed, abs=3.5 * math.sqrt(claimed * (1 - claimed) / 2000) + 1e-9)
    assert claimed >= 0.95 or n < 6


@pytest.mark.parametrize(("n", "m"), [(10, 10), (10, 1), (1, 8), (5, 5), (7, 7)])
def test_the_interval_of_a_ratio_covers_it_at_least_as_often_as_it_says(n: int, m: int) -> None:
    random = np.random.default_rng(n + 100 * m)
    covered = 0
    for _ in range(1000):
        a = np.exp(random.standard_normal(n)) if n > 1 else np.ones(1)
        b = np.exp(random.standard_normal(m)) if m > 1 else np.ones(1)
        bounds = ratio_interval(a, b, (n == 1, m == 1))
        covered += bounds.low <= 1 <= bounds.high
    assert covered / 1000 >= bounds.coverage - 0.02
    assert bounds.coverage >= 0.95 or min(n, m) in (5,)


def test_failed_runs_enter_medians_and_ratios_as_infinity() -> None:
    lost = math.inf
    assert quantile([1.0, 2.0, lost], 0.5) == 2.0
    assert quantile([1.0, lost, lost], 0.5) == lost
    assert quantile([1.0, 2.0, 3.0, lost], 0.75) == lost
    assert ratio([1.0, lost, lost], [2.0]) == lost
    assert ratio([1.0], [2.0, lost, lost]) == 0.0
    assert median_interval([1.0, 2, 3, 4, 5, 6, 7, 8, lost, lost]).high == lost


def test_a_ratio_is_of_medians_and_not_of_means() -> None:
    assert ratio([1.0, 2.0, 30.0], [4.0, 5.0, 9.0]) == 2 / 5


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=12), st.floats(0, 1))
def test_without_failures_a_quantile_is_numpys(values: list[float], q: float) -> None:
    assert quantile(values, q) == np.quantile(values, q)


def test_a_notch_is_mcgills() -> None:
    assert quartile_interval(10.0, 8.0, 12.0, 16) == pytest.approx((10 - 1.57, 10 + 1.57))


@pytest.fixture
def no_collecting(monkeypatch: pytest.MonkeyPatch) -> None:
    """statsmodels collects garbage at each correction: 80 ms in a process as large as this one."""
    monkeypatch.setattr("gc.collect", lambda *_: 0)


def records(columns: dict[str, list[float]]) -> pd.DataFrame:
    return pd.DataFrame(columns)


def test_ranks_and_paired_tests() -> None:
    table = records({"a": [1.0, 1, 1, 1, 1, 1], "b": [2.0, 2, 3, 2, 4, 5], "c": [2.0, 3, 2, 4, 2, 6]})
    assert list(mean_ranks(table).index) == ["a", "b", "c"]
    tests = {(t.first, t.second): t for t in paired_tests(table)}
    assert tests["a", "b"].wins == tests["a", "b"].pairs == 6
    assert tests["a", "b"].p == pytest.approx(2 / 2**6)  # all six of one sign
    assert tests["b", "c"].pairs == 5  # the tie says nothing
    assert tests["a", "b"].adjusted == pytest.approx(3 * 2 / 2**6)
    assert not tests["a", "b"].differ
    assert smallest_adjusted(6, 3) == pytest.approx(3 * 2 / 2**6)


def test_holms_correction_is_the_textbooks() -> None:
    from statsmodels.stats.multitest import multipletests

    assert multipletests([0.01, 0.04, 0.03], method="holm")[1] == pytest.approx([0.03, 0.06, 0.06])


def test_the_paired_test_compares_ratios_not_differences() -> None:
    # the last record's errors are a thousand times larger: in logarithms its ratio of 1.01 is the smallest of all
    a = [1.0, 1, 1, 1, 1, 1, 1, 1010]
    b = [1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.7, 1000]
    (found,) = paired_tests(records({"a": a, "b": b}))
    assert found.p == pytest.approx(4 / 2**8)  # rank sum 1 against 35; of the differences, 8 against 28


def test_too_few_records_support_no_test() -> None:
    with pytest.raises(ValueError, match="at least 6 records, found 5"):
        paired_tests(records({"a": [1.0] * 5, "b": [2.0] * 5}))
    assert MIN_RECORDS == 6
    assert smallest_adjusted(5, 2) > 0.05 >= smallest_adjusted(6, 2)


@pytest.mark.parametrize(("n", "methods"), list(itertools.product([6, 9, 20], [2, 7])))
@pytest.mark.usefixtures("no_collecting")
def test_where_nothing_differs_it_is_said_to_in_five_percent_of_studies_at_most(n: int, methods: int) -> None:
    """The family-wise error on records; three standard errors of 300 studies are allowed."""
    random = np.random.default_rng(1000 * n + methods)
    false = 0
    for _ in range(300):
        table = pd.DataFrame(np.exp(random.standard_normal((n, methods)) + 3 * random.standard_normal((n, 1))))
        false += any(found.differ for found in paired_tests(table))
    assert false / 300 <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / 300)


def test_where_methods_differ_it_is_found() -> None:
    random = np.random.default_rng(0)
    noise = 0.2 * random.standard_normal((12, 4))
    table = pd.DataFrame(
        np.exp(noise + [0.0, 0.0, 1.0, 1.0] + 3 * random.standard_normal((12, 1))), columns=list("abcd")
    )
    differing = {frozenset((t.first, t.second)) for t in paired_tests(table) if t.differ}
    assert differing == {frozenset(pair) for pair in ("ac", "ad", "bc", "bd")}


@pytest.mark.parametrize(
    ("ours", "theirs", "unit", "word"),
    [(1.09, 1.0, 0, "reproduced"), (0.8, 1.0, 0, "better"), (1.2, 1.0, 0, "worse"), (0.014, 0.01, 0.01, "reproduced")],
)
def test_verdicts(ours: float, theirs: float, unit: float, word: str) -> None:
    assert verdict(ours, theirs, unit) == word


@pytest.mark.parametrize("n", [7, 100, 1000, 10_000])
def test_the_interval_of_many_values_is_the_binomials(n: int) -> None:
    """From 1030 values on the binomial coefficients left the range of a float."""
    found = median_interval(range(n))
    k = int(binom.ppf(0.025, n, 0.5))
    k = k if binom.cdf(k, n, 0.5) <= 0.025 else k - 1  # the largest with P(B ≤ k) ≤ 2.5 %
    assert (found.low, found.high) == (k, n - 1 - k)
    assert found.coverage == pytest.approx(1 - 2 * binom.cdf(k, n, 0.5), rel=1e-9)
