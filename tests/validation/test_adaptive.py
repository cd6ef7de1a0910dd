"""Adaptive bands: coverage where the errors are not those of validation, the bound of any record, no look ahead."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from nnss_cli.errors import InputError
from nnss_cli.trained import load
from nnss_cli.trained.simulate import Simulated
from nnss_cli.validation.adaptive import STEPS, AdaptiveBand, _step, adapt
from nnss_cli.validation.bands import Band, calibrate
from nnss_cli.validation.limits import Limits
from nnss_cli.validation.trained import forecaster, simulation_limits


def noise(pole: float, samples: int, seed: int) -> np.ndarray:
    white = np.random.default_rng(seed).standard_normal((samples + 300, 1))
    return scipy.signal.lfilter([1], [1, -pole], white, axis=0)[300:]


def adapted(errors: np.ndarray, horizon: int, level: float = 0.9) -> AdaptiveBand:
    return adapt([errors], [errors], level, horizon)


@pytest.mark.parametrize("horizon", [1, 10])
@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_coverage_on_records_that_have_shifted(factor: float, horizon: int) -> None:
    """Autoregressive errors, larger or smaller than on validation from some sample on: 88 to 92 % all the same."""
    held, fixed = [], []
    for seed in range(25):
        e = noise(0.6, 5000, seed)
        e[2000:] *= factor
        band, static = adapted(e[:1000], horizon), calibrate([e[:1000]], 0.9)
        new = e[1000:]
        held.append(np.mean(np.abs(new) <= band.half_widths(new, 0)))
        fixed.append(np.mean(np.abs(new) <= static.half_width))
    assert 0.88 <= np.mean(held) <= 0.92
    assert not 0.85 <= np.mean(fixed) <= 0.95


def test_coverage_where_nothing_has_shifted() -> None:
    held, widths = [], []
    for seed in range(40):
        e = noise(0.6, 3000, seed)
        band = adapted(e[:1000], 1)
        half = band.half_widths(e[1000:], 0)
        held.append(np.mean(np.abs(e[1000:]) <= half))
        widths.append(half.mean() / band.start.half_width)
    assert 0.88 <= np.mean(held) <= 0.92
    assert np.mean(widths) < 1.15  # what adapting costs


def hostile(band: AdaptiveBand, samples: int, largest: float, begin: int = 0) -> np.ndarray:
    """Errors that lie just outside wherever they may, from `begin` on: each is chosen after its band."""
    e = np.zeros((samples, 1))
    for k in range(begin, samples):
        half = band.half_widths(e[: k + 1], 0)[k, 0]
        e[k] = min(1.001 * half, largest)
    return e


def test_the_step_is_never_longer_than_one_over_the_horizon() -> None:
    """Else a width that had fallen far would stay below the errors for longer than the bound allows."""
    start = Band(0.9, np.ones(1), 10, 30, 1, None)
    band, e = AdaptiveBand(start, np.array([0.5]), 20), np.full((20, 1), 1.001)
    assert np.mean(np.abs(e) > band.half_widths(e, 0)) <= band.bound(e)[0]
    steps = _step(np.array([0.5, 0.01]), np.array([[0], [10**9]]), 20)
    np.testing.assert_allclose(steps, [[1 / 20, 1 / 20], [1 / 20, 0.01]])


@pytest.mark.parametrize("horizon", [1, 7])
@pytest.mark.parametrize("kind", ["hostile", "jumps", "grows", "nothing"])
def test_no_errors_break_the_bound(kind: str, horizon: int) -> None:
    samples = 600
    steady = np.random.default_rng(3).standard_normal((samples, 1))
    band = adapted(noise(0.0, 300, 0), horizon)
    e = {
        "hostile": lambda: hostile(band, samples, 1e3),
        "jumps": lambda: np.where(np.arange(samples) // 60 % 2, 500.0, 1e-4)[:, None] * steady,
        "grows": lambda: 1.02 ** np.arange(samples)[:, None],
        "nothing": lambda: np.zeros((samples, 1)),
    }[kind]()  # fmt: skip
    outside = np.mean(np.abs(e) > band.half_widths(e, 0), axis=0)
    assert (outside <= band.bound(e)).all()
    if kind == "hostile" and horizon == 1:
        assert outside > 0.1  # it was


def test_a_width_that_fell_as_far_as_it_may_is_counted_in_the_bound() -> None:
    """It falls in long steps at first, and in short ones, a miss each, grows back to what it began with."""
    band = AdaptiveBand(Band(0.5, np.ones(1), (10,), (1,), (1,), None), np.array([0.05]), 1)
    e = hostile(band, 250, 1.0, 60)
    widths = band.half_widths(e, 0)
    assert widths.min() == pytest.approx(0.01)
    outside = np.mean(np.abs(e) > widths)
    assert 0.75 * band.bound(e)[0] <= outside <= band.bound(e)[0]


def test_the_bound_falls_to_what_is_promised() -> None:
    band = adapted(noise(0.0, 300, 0), 2)
    limits = [float(band.bound(np.full((T, 1), 30.0))[0]) for T in (1_000, 100_000, 10_000_000)]
    assert limits == sorted(limits, reverse=True)
    assert limits[-1] == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("horizon", [1, 5])
def test_a_width_knows_errors_up_to_the_horizon_only(horizon: int) -> None:
    e, begin, K = noise(0.5, 400, 1), 3, 200
    band = adapted(e, horizon)
    plain = band.half_widths(e, begin)
    later = e.copy()
    later[K:] = 100
    changed = band.half_widths(later, begin)
    np.testing.assert_array_equal(changed[: K + horizon], plain[: K + horizon])
    assert changed[K + horizon] > plain[K + horizon]
    np.testing.assert_array_equal(plain[: begin + horizon], np.tile(band.start.half_width, (begin + horizon, 1)))
    np.testing.assert_array_equal(band.half_widths(np.r_[e[:7], e], 7 + begin)[7:], plain)  # whenever it begins


def test_a_miss_widens_and_a_hit_narrows() -> None:
    band = adapted(noise(0.0, 400, 1), 1)
    q = float(band.start.half_width[0])
    after = [float(band.half_widths(np.array([[e], [0.0]]), 0)[1, 0]) for e in (2 * q, 0.5 * q)]
    np.testing.assert_allclose(after, [q * np.exp(0.9), q * np.exp(-0.1)])


def test_units_and_outputs_are_apart() -> None:
    e = np.hstack([noise(0.9, 900, 1), 10 * noise(0.0, 900, 2)])
    both = adapt([e[:500], e[500:]], [e[:500], e[500:]], 0.9, 2)
    half = both.half_widths(3 * e, 0)
    for i in range(2):
        own = 1e-3 * e[:, i : i + 1]
        alone = adapt([own[:500], own[500:]], [own[:500], own[500:]], 0.9, 2)
        assert both.steps[i] == alone.steps[0]
        np.testing.assert_allclose(1e-3 * half[:, i], alone.half_widths(3 * own, 0)[:, 0])


@pytest.mark.parametrize("level", [0.9, 0.6])
def test_the_step_is_that_with_the_least_quantile_loss(level: float) -> None:
    """Of misses, level times how far the errors lie beyond; of hits, the rest times how far they lie within."""
    taken, medians = [], []
    for seed in range(6):
        e = noise(0.5, 1500, seed) * np.where(np.arange(1500) // 150 % 2, 1 + seed, 1.0)[:, None]
        band = adapted(e, 1, level)
        beyond = [np.abs(e) - replace(band, steps=np.array([eta])).half_widths(e, 0) for eta in STEPS]
        assert band.steps[0] == STEPS[np.argmin([np.sum(np.maximum(level * b, (level - 1) * b)) for b in beyond])]
        taken.append(band.steps[0])
        medians.append(STEPS[np.argmin([np.sum(np.abs(b)) for b in beyond])])
    assert len(set(taken)) > 1
    assert taken != medians


def test_the_bound_is_the_one_that_is_documented() -> None:
    """α + (log⁺(b/q) + 1 − α + 4.6)/(η(T) T), with the η that is reached at the last sample."""
    for step, reached, largest in ((0.2, 0.2, 6.0), (1e-3, 400**-0.6, 6.0), (0.2, 0.2, 0.5)):
        band = AdaptiveBand(Band(0.8, np.full(1, 2.0), (9,), (1,), (1,), None), np.array([step]), 1)
        e = np.full((400, 1), -largest)
        expected = 0.2 + (max(math.log(largest / 2), 0) + 0.8 + math.log(100)) / (reached * 400)
        assert band.bound(e)[0] == pytest.approx(expected)


def test_the_step_is_chosen_on_validation() -> None:
    """Slow where the errors stay as they are, quick where they come in bursts."""
    random = np.random.default_rng(0)
    steady = random.standard_normal((4000, 1))
    bursts = np.where(np.arange(4000) // 200 % 2, 20.0, 1.0)[:, None] * steady
    assert adapted(steady, 1).steps[0] == STEPS[0]
    assert adapted(bursts, 1).steps[0] >= 0.2


@pytest.mark.parametrize("seed", range(4))
def test_the_step_has_the_least_quantile_loss_along_validation(seed: int) -> None:
    """Mean absolute differences of widths and errors, whose minimiser is the median, choose another for most."""
    random = np.random.default_rng(seed)
    louder = np.where(np.arange(300) // 50 % 2, 3.0, 1.0)
    e = np.exp(1.5 * random.standard_normal((2, 300, 1))) * random.standard_normal((2, 300, 1)) * louder[:, None]
    found = adapt(e, e, 0.9, 1)
    beyond = [np.abs(e) - [AdaptiveBand(found.start, np.array([eta]), 1).half_widths(p, 0) for p in e] for eta in STEPS]
    losses = [np.mean(np.maximum(0.9 * each, -0.1 * each)) for each in beyond]
    assert found.steps[0] == STEPS[int(np.argmin(losses))]


def test_a_validation_record_without_errors_leaves_a_width_that_can_grow() -> None:
    y = np.random.default_rng(0).standard_normal((500, 1))
    band = adapt([0 * y], [y], 0.9, 1)
    held = np.abs(0.1 * y) <= band.half_widths(0.1 * y, 0)
    assert np.mean(held[250:]) == pytest.approx(0.9, abs=0.05)


def test_a_predictors_band(plant_run: Callable[..., Path]) -> None:
    """Where the new record is another plant's, as wide as it has to be; around simulations there is none."""
    found = forecaster(load(plant_run()))
    record = found.trained.records()["test"][0]
    other = type(record)(record.u, 3 * record.y, record.Ts)
    for horizon in (1, 3):
        fixed, adaptive = (found.limits(other, horizon, 0.9, by) for by in ("residuals", "adaptive"))
        assert fixed.held is not None
        assert adaptive.held is not None
        assert fixed.held[0] < 0.7
        assert 0.85 <= adaptive.held[0] <= 0.95
        predicted = found.predict(other, horizon)
        np.testing.assert_allclose((adaptive.low + adaptive.high) / 2, predicted)
        assert adaptive.adaptive is not None
        widths = adaptive.adaptive.half_widths(other.y - predicted, 1)
        np.testing.assert_allclose(adaptive.high - predicted, widths)
    (line,) = adaptive.told(found.trained.channels)
    assert f"± {fixed.band.half_width[0]:.4g} m at first, then {widths.min():.4g} to {widths.max():.4g}" in line
    assert f"it holds {100 * adaptive.held[0]:.1f} % here" in line
    with pytest.raises(InputError, match="expected predictions, .* found a simulation"):
        simulation_limits(found.trained, Simulated(record.u, record.y, record.y, record.y, ()), 0.9, "adaptive")


def test_limits_count_what_lies_within() -> None:
    band = adapted(noise(0.0, 400, 1), 1)
    y = noise(0.0, 50, 2)
    found = Limits.following(band, 0 * y, y, 4)
    assert found.held == pytest.approx(np.mean(np.abs(y) <= band.half_widths(y, 4), axis=0), abs=0.2)
    np.testing.assert_allclose(found.held, np.mean((np.abs(y) <= band.half_widths(y, 4))[4:], axis=0))
