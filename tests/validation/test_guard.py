"""The guard against what a model was not trained for: its weights, its regret, what it knows, what it costs."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.record import Record

from nnss_cli.trained import load
from nnss_cli.validation import guard as module
from nnss_cli.validation.guard import PRIOR, prior_strength, weights
from nnss_cli.validation.predictor import Guard, persistence
from nnss_cli.validation.trained import forecaster


def signals(samples: int, seed: int, r1: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Errors of a model, and gaps to persistence, correlated by r1."""
    random = np.random.default_rng(seed)
    gaps = random.standard_normal((samples, 2))
    return r1 * gaps + 0.5 * random.standard_normal((samples, 2)), gaps


@pytest.mark.parametrize("horizon", [1, 4])
def test_weights_are_the_discounted_regression(horizon: int) -> None:
    e, d = signals(120, 0, 0.6)
    a, begin = np.array([3.0, 40.0]), 5
    v = weights(e, d, a, horizon, begin)
    assert not v[: begin + horizon].any()  # the model's own at first
    for k in (begin + horizon, 60, 119):
        j = np.arange(begin, k - horizon + 1)
        discount = (0.99 ** ((k - horizon - j) / horizon))[:, None]
        expected = np.sum(discount * e[j] * d[j], axis=0) / (a + np.sum(discount * d[j] ** 2, axis=0))
        np.testing.assert_allclose(v[k], np.clip(expected, 0, 1), rtol=1e-9)


@pytest.mark.parametrize("horizon", [1, 5])
def test_weights_know_errors_up_to_the_horizon_only(horizon: int) -> None:
    e, d = signals(200, 1, 0.5)
    plain = weights(e, d, np.ones(2), horizon, 2)
    later = e.copy()
    later[100:] += 5 * d[100:]
    changed = weights(later, d, np.ones(2), horizon, 2)
    np.testing.assert_array_equal(changed[: 100 + horizon], plain[: 100 + horizon])
    assert (changed[100 + horizon] > plain[100 + horizon]).all()
    shifted = weights(*(np.r_[signal[:9], signal] for signal in (e, d)), np.ones(2), horizon, 11)
    np.testing.assert_array_equal(shifted[9:], plain)  # whenever it begins


@pytest.mark.parametrize("r1", [-0.5, 0.0, 0.3, 1.0, 2.0])
def test_regret_against_every_fixed_mixture(r1: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without discount, one step ahead, with weights between 0 and 1."""
    monkeypatch.setattr(module, "MEMORY", np.inf)
    e, d = signals(300, 2, r1)
    a = np.array([1.0, 30.0])
    r = e - weights(e, d, a, 1, 0) * d
    allowed = np.max(r**2, axis=0) * np.log(1 + np.sum(d**2, axis=0) / a)
    for v in np.linspace(0, 1, 21):
        assert (np.sum(r**2, axis=0) <= np.sum((e - v * d) ** 2, axis=0) + a * v**2 + allowed).all()


def test_a_good_model_loses_next_to_nothing() -> None:
    """Errors that persistence does not explain: half a percent of RMSE at most on average."""
    lost = []
    for seed in range(30):
        e, d = signals(1000, seed)
        r = e - weights(e, d, prior_strength([d], 1), 1, 0) * d
        lost.append(np.sqrt(np.mean(r**2, axis=0) / np.mean(e**2, axis=0)))
    assert np.mean(lost) < 1.005


def test_where_the_model_is_lost_it_becomes_persistence() -> None:
    """A steady offset of ten times the usual gap, from sample 100 on."""
    random = np.random.default_rng(0)
    y = np.cumsum(0.1 * random.standard_normal((400, 1)), axis=0)
    predicted = y + 0.05 * random.standard_normal((400, 1))
    predicted[100:] += 10
    lasting = persistence(y, 1)
    guard = Guard({1: prior_strength([(lasting - predicted)[:100]], 1)}, 1)
    guarded, v = guard.applied(1, predicted, y)
    errors = [np.sqrt(np.mean((each - y)[110:] ** 2)) for each in (guarded, lasting, predicted)]
    assert errors[0] < 1.1 * errors[1] < 0.1 * errors[2]
    assert v[:101].max() < 0.3
    assert v[-1] > 0.95


def test_nothing_to_choose_between_stays_the_model() -> None:
    none = np.zeros((20, 1))
    assert not weights(none, none, np.zeros(1), 1, 0).any()


def test_units_and_offsets_do_not_matter(plant_run: Callable[..., Path]) -> None:
    found = forecaster(load(plant_run()))
    guard = found.guard((2,))
    record = found.trained.records()["test"][0]
    predicted = found.predict(record, 2) + 3
    plain, v = guard.applied(2, predicted, record.y)
    moved, same = guard.applied(2, predicted + 50, record.y + 50)
    np.testing.assert_allclose(moved, plain + 50)
    np.testing.assert_allclose(same, v, atol=1e-9)
    scaled = Guard({2: guard.strengths[2] * 1e6}, 1)
    np.testing.assert_allclose(scaled.applied(2, 1e3 * predicted, 1e3 * record.y)[1], v)


def test_the_prior_is_that_of_validation(plant_run: Callable[..., Path]) -> None:
    found = forecaster(load(plant_run()))
    (val,) = found.fitting.val
    for horizon in (1, 4):
        gaps = (persistence(val.y, horizon) - found.predict(val, horizon))[1:]
        expected = PRIOR * horizon * np.mean(gaps**2, axis=0)
        np.testing.assert_allclose(found.guard((horizon,)).strengths[horizon], expected)


@pytest.mark.parametrize("horizon", [1, 4])
def test_the_prior_counts_as_a_hundred_horizons(horizon: int) -> None:
    """Of a model that is off by the usual gap all along, so that persistence is right: v = D/(a + D)."""
    usual = np.full((50, 1), 3.0)
    a = prior_strength([usual], horizon)
    lost = np.full((101 * horizon + 1, 1), 3.0)
    v = weights(lost, lost, a, horizon, 0)
    forget = 0.99 ** (1 / horizon)
    seen = (1 - forget ** (100 * horizon + 1)) / (1 - forget)  # samples, discounted
    np.testing.assert_allclose(v[-1], seen / (100 * horizon + seen), rtol=1e-9)


@pytest.mark.system
def test_a_forecaster_is_guarded_where_it_is_asked_to_be(plant_run: Callable[..., Path]) -> None:
    """Predictions and their bands; the simulation is what it was."""
    trained = load(plant_run())
    plain, guarded = forecaster(trained), forecaster(trained, guarded=True)
    record = trained.records()["test"][0]
    lost = Record(record.u, record.y + 200, record.Ts)
    for horizon in (1, 3):
        own = plain.predict(lost, horizon)
        expected, _ = plain.guard((horizon,)).applied(horizon, own, lost.y)
        np.testing.assert_array_equal(guarded.predict(lost, horizon), expected)
        assert (expected != own).any()
        limits = guarded.limits(lost, horizon, 0.9)
        np.testing.assert_allclose((limits.low + limits.high) / 2, expected)
    simulated = (each.limits_of_simulation([lost], 0.9).low for each in (plain, guarded))
    np.testing.assert_array_equal(*simulated)
