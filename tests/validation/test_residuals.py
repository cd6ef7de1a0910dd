"""Residual tests: the size that they claim, the power to see a wrong order, a second implementation."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.n4sid import n4sid
from nnss_cli.datasets.record import Dataset, Record, Scaling
from statsmodels.stats.diagnostic import acorr_ljungbox

from nnss_cli.validation.gain import ALONE, INCREMENTS, estimate_gain
from nnss_cli.validation.predictor import Predictor, steppers_of
from nnss_cli.validation.residuals import (
    LEVEL,
    autocovariance,
    dependence,
    lags_of_tests,
    profile,
    whiteness,
)


def coloured(pole: float, samples: int, seed: int) -> np.ndarray:
    return scipy.signal.lfilter([1], [1, -pole], np.random.default_rng(seed).standard_normal(samples + 200))[200:]


@pytest.mark.parametrize("samples", [100, 1000])
def test_white_residuals_are_rejected_as_often_as_said(samples: int) -> None:
    """1,000 records at the level of 1 %: 5 to 15 of them."""
    p = [whiteness([coloured(0, samples, seed)]).p_value for seed in range(1000)]
    assert 0.005 <= np.mean(np.array(p) < LEVEL) <= 0.015
    assert np.mean(np.array(p) < 0.5) == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("error", "signal"), [(0.0, 0.9), (0.9, 0.9), (0.7, 0.0)])
def test_independent_signals_are_rejected_as_often_as_said(error: float, signal: float) -> None:
    """Coloured or not: prewhitened, they do not seem to depend on each other."""
    pairs = [(coloured(error, 400, seed), coloured(signal, 400, 5000 + seed)) for seed in range(1000)]
    p = [dependence([e], [u]).p_value for e, u in pairs]
    assert 0.005 <= np.mean(np.array(p) < LEVEL) <= 0.015


def test_a_memory_of_eight_samples_is_no_dependence() -> None:
    """Of signals that each repeat what they were eight samples ago: at 1 %, more than 11 of 400 have 0.1 %."""
    season = [1.0, *[0.0] * 7, -0.8]
    white = np.random.default_rng(0).standard_normal((400, 2, 600))
    p = [dependence([e], [u]).p_value for e, u in scipy.signal.lfilter([1], season, white)[..., 200:]]
    assert np.sum(np.array(p) < LEVEL) <= 11


def test_the_statistic_is_that_of_statsmodels() -> None:
    """Box and Pierce's there, with what Li and McLeod add for one record: L (L + 1)/(2 N)."""
    e = coloured(0.2, 700, 3)
    found = whiteness([e])
    L = found.lags
    other = float(acorr_ljungbox(e - e.mean(), lags=[L], boxpierce=True)["bp_stat"].iloc[0]) + L * (L + 1) / 1400
    assert found.statistic == pytest.approx(other, rel=1e-9)
    assert found.p_value == pytest.approx(float(scipy.stats.chi2.sf(other, L)), rel=1e-9)


def test_of_many_short_records_pairs_within_them_count() -> None:
    """Both statistics have χ²'s mean, the degrees of freedom, where a fifth of N − l pairs run over their ends."""
    white, own = [], []
    for seed in range(150):
        e, u = np.random.default_rng(seed).standard_normal((2, 20, 25))
        white.append(whiteness(list(e)).statistic)
        own.append(dependence(list(e), list(u)).statistic)
    L = lags_of_tests(500)
    assert np.mean(white) / L == pytest.approx(1, abs=0.1)
    assert np.mean(own) / (L + 1) == pytest.approx(1, abs=0.1)


@pytest.mark.system
@pytest.mark.parametrize("records", [20, pytest.param(100, marks=pytest.mark.slow)])
def test_a_wrong_order_is_found(records: int, plant_data: Callable[..., Dataset], linear: LinearModel) -> None:
    """A model of order 1 of a plant of order 2, with its best gain: on 95 % of records. The plant itself: 5 %."""
    wrong = right = 0
    for seed in range(records):
        dataset = plant_data(K=900, seed=seed)
        fitting, (test,) = dataset.fitting, dataset.tests["test"]
        model = LinearModel.of(n4sid(fitting.normalised()[0], 1), fitting)
        gain = estimate_gain(steppers_of(model)[0], fitting.train, fitting.val)
        unaided = gain.origin in (INCREMENTS, ALONE)  # which fails by itself
        wrong += unaided or found(test, Predictor(model, (gain.K,), (gain.disturbance,)))
        same = Scaling(*(np.array([value]) for value in (0.0, 1.0, 0.0, 1.0)))
        right += found(test, Predictor(replace(linear, scaling=same), (np.zeros((2, 1)),)))
    assert wrong >= 0.95 * records
    assert right <= 0.05 * records


def found(test: Record, predictor: Predictor) -> bool:
    e = (test.y - predictor.predict(test.u, test.y, 1))[60:, 0]
    return min(whiteness([e]).p_value, dependence([e], [test.u[60:, 0]]).p_value) < LEVEL


def test_records_do_not_run_into_each_other() -> None:
    e = np.tile([1.0, -1.0, 2.0, -2.0, 3.0], 8)
    parts = [e[:15], e[15:]]
    centred = e - e.mean()
    expected = centred[1:15] @ centred[:14] + centred[16:] @ centred[15:-1]
    np.testing.assert_allclose(autocovariance(parts, 1)[1], expected / len(e))
    assert not np.isclose(autocovariance([e], 1)[1], expected / len(e))


def test_signals_that_do_not_vary_pass() -> None:
    e, flat = coloured(0, 50, 1), np.zeros(50)
    assert whiteness([flat]).p_value == 1
    assert dependence([e], [flat + 3]).p_value == 1
    assert dependence([flat], [e]).p_value == 1
    assert profile(e, flat) is None


def test_a_dependence_is_seen_at_its_lag() -> None:
    u = coloured(0.5, 500, 1)
    e = coloured(0, 500, 2) + 0.5 * np.roll(u, 4)
    found = dependence([e], [u])
    assert found.p_value < 1e-6
    assert int(np.argmax(np.abs(found.correlation))) == 4
    assert abs(found.correlation[4]) > found.band


def test_lags_follow_the_length() -> None:
    assert [lags_of_tests(samples) for samples in (30, 150, 300, 10**6)] == [3, 5, 10, 10]


def test_a_mean_that_follows_a_signal_is_told_apart_from_noise() -> None:
    x, e = np.random.default_rng(0).uniform(-1, 1, 2000), coloured(0, 2000, 1)
    plain, bent = profile(e, x), profile(e + 2 * x**2, x)
    assert plain is not None
    assert bent is not None
    assert plain.p_value > 0.01
    assert plain.share < 0.01
    assert bent.p_value < 1e-10
    assert bent.share == pytest.approx(4 * np.var(x**2) / (1 + 4 * np.var(x**2)), abs=0.05)
    leaning = profile(e + 2 * x, x)
    assert leaning is not None
    assert (leaning.share, leaning.p_value) == (pytest.approx(plain.share), pytest.approx(plain.p_value))
    levels = profile(e, np.repeat([1.0, 2.0, 5.0], [500, 500, 1000]))
    assert levels is not None
    np.testing.assert_allclose(levels.centres, [1, 2, 5])
    two = profile(e, np.repeat([1.0, 2.0], [500, 1500]))
    assert two is not None
    assert (two.share, two.p_value) == (0, 1)  # a line goes through both


@pytest.mark.parametrize("levels", [0, 4])
def test_bands_of_a_profile_hold_99_percent_of_white_residuals_means(levels: int) -> None:
    """Of ten bins with equally many samples, and of four levels with few and with many."""
    random, beyond = np.random.default_rng(5), []
    for _ in range(300):
        x = np.repeat([1.0, 2.0, 5.0, 6.0], [20, 40, 80, 160]) if levels else random.standard_normal(300)
        found = profile(random.standard_normal(300), x)
        assert found is not None
        beyond.append(np.abs(found.means) > found.bands)
    assert 0.005 <= np.mean(beyond) <= 0.015
    assert np.mean(beyond, axis=0).max() <= 0.03  # 3 of 300 each: more than 9 would have a probability below 0.1 %


def test_a_profile_is_the_f_test_of_bins_beside_a_line() -> None:
    """Of 400 records of white residuals some 4 fall below 1 %: more than 11 would have a probability below 0.1 %."""
    random, low = np.random.default_rng(4), 0
    for _ in range(400):
        x, e = random.standard_normal(200), random.standard_normal(200)
        found = profile(e + 3 * x, x)
        assert found is not None
        low += found.p_value < 0.01
    assert 0 < low <= 11
    for x in (random.standard_normal(300), np.repeat([1.0, 2.0, 5.0, 6.0], 75)):
        e = random.standard_normal(300) + 0.1 * x**2
        edges = np.quantile(x, np.linspace(0, 1, 11))
        bins = np.unique(x, return_inverse=True)[1] if len(np.unique(x)) < 10 else np.digitize(x, edges[1:-1])
        lines = np.column_stack([np.ones(300), x])
        of_bins = np.column_stack([x, *(bins == i for i in range(bins.max() + 1))])
        squares = [float(np.sum((e - X @ np.linalg.lstsq(X, e)[0]) ** 2)) for X in (lines, of_bins)]
        rank = int(np.linalg.matrix_rank(of_bins))
        F = (squares[0] - squares[1]) / (rank - 2) / (squares[1] / (300 - rank))
        found = profile(e, x)
        assert found is not None
        assert found.p_value == pytest.approx(scipy.stats.f.sf(F, rank - 2, 300 - rank), rel=1e-9)
