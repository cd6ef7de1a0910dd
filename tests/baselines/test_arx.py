"""The test for a feedthrough has its level and power; where outputs rest is told, and only where it is sure."""

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from conftest import slow_but
from nnss_cli.baselines import arx
from nnss_cli.baselines.arx import feedthrough_p_value, longest_time_constant, steady_estimate, steady_outputs
from nnss_cli.datasets.record import Record


def record(random: np.random.Generator, K: int, D: float, r: int = 1, m: int = 1, held: int = 1) -> Record:
    """A saturating system with measurement noise; the input is held for `held` samples."""
    u = np.repeat(random.standard_normal((K // held + 1, r)), held, axis=0)[:K]
    x, y = np.zeros(2), np.empty((K, m))
    B = np.array([0.0, 0.3])
    for k in range(K):
        y[k] = x[0] + np.arange(m) * x[1] + D * u[k].sum()
        x = np.array([[0.9, 0.2], [-0.2, 0.8]]) @ x + B * u[k].sum() - np.array([0.0, 0.2]) * np.tanh(3 * x[1])
    return Record(u, y + 0.1 * random.standard_normal(y.shape), 1.0)


@pytest.mark.system
@pytest.mark.parametrize(
    ("K", "r", "m", "held"), slow_but((0, 3), [(300, 1, 1, 1), (300, 2, 3, 1), (600, 1, 1, 20), (40, 1, 1, 1)])
)
def test_no_feedthrough_is_found_where_there_is_none(K: int, r: int, m: int, held: int) -> None:
    """At most 1 in 100, and some, over 400 records: more than 11 would have a probability below 0.1 %."""
    random = np.random.default_rng(0)
    found = sum(feedthrough_p_value((record(random, K, 0.0, r, m, held),)) < 0.01 for _ in range(400))
    assert found <= 11


def test_a_feedthrough_of_the_size_of_the_noise_is_found() -> None:
    random = np.random.default_rng(1)
    assert all(feedthrough_p_value((record(random, 300, 0.1),)) < 0.01 for _ in range(100))


def test_several_experiments_count_together_and_short_ones_say_nothing() -> None:
    random = np.random.default_rng(2)
    halves = tuple(record(random, 60, 0.1) for _ in range(5))
    assert feedthrough_p_value(halves) < 1e-6
    assert feedthrough_p_value((record(random, 9, 1.0),)) == 1.0
    assert (
        feedthrough_p_value((record(random, 100, 1.0), record(random, 5, 1.0))) < 0.01
    )  # the short one is passed over


def test_units_have_no_part_in_it() -> None:
    """Nor has an offset, for an input as smooth as a sum of slow sines, whose past is nearly of low rank."""
    random = np.random.default_rng(3)
    k = np.arange(400)[:, None]
    u = np.sin(0.11 * k) + np.sin(0.071 * k + 1) + np.sin(0.043 * k + 2) + 1e-6 * random.standard_normal(k.shape)
    y = np.cumsum(u, axis=0) / 20 + 0.01 * random.standard_normal(u.shape)
    scaled = Record(1e3 * u + 5e4, 1e-4 * y - 7, 1.0)
    assert feedthrough_p_value((scaled,)) == pytest.approx(feedthrough_p_value((Record(u, y, 1.0),)), rel=0.02)


def test_it_is_the_f_test_of_nested_models_by_least_squares() -> None:
    """Of a record that climbs from rest: its past has another mean than its present, so the constant counts."""
    random = np.random.default_rng(8)
    u = np.linspace(0, 3, 60)[:, None] + 0.3 * random.standard_normal((60, 1))
    y = 7 + scipy.signal.lfilter([0.02, 0.5], [1, -0.8], u, axis=0) + 0.1 * random.standard_normal((60, 1))
    p, z = 7, np.hstack([y, u])  # three samples a coefficient
    past = np.hstack([np.ones((60 - p, 1)), *(z[p - i : 60 - i] for i in range(1, p + 1))])
    squares = [np.linalg.lstsq(X, y[p:])[1][0] for X in (past, np.hstack([past, u[p:]]))]
    freedom = 60 - p - 2 * p - 2
    expected = scipy.stats.f.sf((squares[0] - squares[1]) / (squares[1] / freedom), 1, freedom)
    assert feedthrough_p_value((Record(u, y, 1.0),)) == pytest.approx(expected, rel=1e-9)


def test_of_several_outputs_the_smallest_p_value_counts_as_often() -> None:
    """Bonferroni: of three outputs, three times that of the one in which the input shows most."""
    given = record(np.random.default_rng(11), 200, 0.02, m=3)
    p, z = 10, np.hstack([given.y, given.u])
    past = np.hstack([np.ones((200 - p, 1)), *(z[p - i : 200 - i] for i in range(1, p + 1))])
    without, along = (
        np.sum((given.y[p:] - X @ np.linalg.lstsq(X, given.y[p:])[0]) ** 2, axis=0)
        for X in (past, np.hstack([past, given.u[p:]]))
    )
    freedom = 200 - p - 4 * p - 2
    smallest = scipy.stats.f.sf((without - along) / (along / freedom), 1, freedom).min()
    assert smallest < 0.3
    assert feedthrough_p_value((given,)) == pytest.approx(3 * smallest, rel=1e-9)


@pytest.mark.parametrize("sines", range(1, 6))
def test_an_input_that_its_past_tells_shows_nothing(sines: int) -> None:
    """What is left of it is rounding: of four sines its p-value was 3e-10, of others it depended on the machine."""
    random = np.random.default_rng(3)
    k = np.arange(400)[:, None]
    u = sum(np.sin(0.02 * (i + 1) * k + i) for i in range(sines))
    y = np.cumsum(u, axis=0) / 20 + 0.01 * random.standard_normal(k.shape)
    noise = random.standard_normal(k.shape)
    for scale, offset in ((1, 0), (1e3, 5e4)):
        assert feedthrough_p_value((Record(scale * u + offset, y, 1.0),)) == 1.0
        two = Record(np.hstack([noise, scale * u + offset]), y + noise, 1.0)
        assert feedthrough_p_value((two,)) < 1e-9  # the other one is asked


def test_data_that_tell_nothing_are_no_reason_to_try() -> None:
    constant = Record(np.ones((100, 1)), np.ones((100, 1)), 1.0)
    assert feedthrough_p_value((constant,)) == 1.0
    still = Record(np.ones((100, 1)), np.random.default_rng(0).standard_normal((100, 1)), 1.0)
    assert feedthrough_p_value((still,)) > 0.01


def from_rest(random: np.random.Generator, K: int, noise: float, r: int = 1, m: int = 1) -> tuple[Record, np.ndarray]:
    """A linear plant at rest until the inputs step, with offsets; its outputs at rest under the mean inputs."""
    u = np.repeat(random.uniform(0, 8, (K // 40 + 1, r)), 40, axis=0)[:K]
    u[:40] = 0
    A, B, C = 0.9 * np.eye(2) + [[0, 0.05], [0, 0]], random.standard_normal((2, r)), random.standard_normal((m, 2))
    offset, x, y = 10 * random.standard_normal(m), np.zeros(2), np.empty((K, m))
    for k in range(K):
        y[k] = C @ x + offset
        x = A @ x + B @ u[k]
    rest = C @ np.linalg.solve(np.eye(2) - A, B) @ u.mean(axis=0) + offset
    return Record(u, y + noise * y.std(axis=0) * random.standard_normal(y.shape), 1.0), rest - y.mean(axis=0)


@pytest.mark.parametrize(("r", "m"), [(1, 1), (2, 1), (1, 2), (2, 3)])
def test_where_a_plant_from_rest_would_rest_is_exact_without_noise(r: int, m: int) -> None:
    for seed in range(10):
        given, off = from_rest(np.random.default_rng(seed), 300, 0.0, r, m)
        np.testing.assert_allclose(steady_outputs((given,)), off, rtol=1e-5, atol=1e-8)
        halves = given[:150], given[150:]
        mean = steady_outputs(halves) + np.concatenate([half.y for half in halves]).mean(axis=0)
        np.testing.assert_allclose(mean, off + given.y.mean(axis=0), rtol=1e-5)


def test_with_noise_it_is_nearer_than_the_mean_and_told_where_it_is_sure() -> None:
    left, taken = [], 0
    for seed in range(100):
        given, off = from_rest(np.random.default_rng(seed), 300, 0.02)
        found = steady_outputs((given,))
        left.append(np.abs(found - off)[0] / np.abs(off)[0])
        taken += found[0] != 0
    assert taken > 70
    assert np.median(left) < 0.2


def test_its_standard_error_is_that_over_many_records_of_such_a_model() -> None:
    """A third too small on records as short as this."""
    random, scores = np.random.default_rng(7), []
    for _ in range(300):
        u = np.repeat([0.0, 3, 9], 40)[:, None]
        y = np.zeros((120, 1))
        for k in range(1, 120):
            y[k] = 0.9 * y[k - 1] + 0.5 * u[k - 1] + 0.3 * random.standard_normal()
        found, deviation = steady_estimate((Record(u, y, 1.0),))
        scores.append((found[0] - (5 * u.mean() - y.mean())) / deviation[0])
    assert 0.8 < np.std(scores) < 1.5


@pytest.mark.system
def test_a_record_that_moves_around_its_means_keeps_them() -> None:
    """A nonlinear plant under noise: 3 in 1000 would be the level; over 7 of 400 have a probability below 0.1 %."""
    random = np.random.default_rng(5)
    assert sum(steady_outputs((record(random, 300, 0.0, 1, 2, 5),)).any() for _ in range(400)) <= 7


def test_units_and_offsets_move_a_steady_output_with_them() -> None:
    given, off = from_rest(np.random.default_rng(0), 300, 0.01)
    found = steady_outputs((given,))
    assert found == pytest.approx(off, rel=0.3)
    scaled = Record(1e3 * given.u + 5e4, 1e-4 * given.y - 7, 1.0)
    np.testing.assert_allclose(steady_outputs((scaled,)), 1e-4 * found, rtol=1e-4)


def test_standard_errors_are_of_least_squares_by_the_delta_method() -> None:
    """Of noise that has the samples less the coefficients for its degrees of freedom: a third of them here."""
    given, _ = from_rest(np.random.default_rng(1), 76, 0.02)
    p, z = 10, np.hstack([given.y, given.u]) - [given.y.mean(), given.u.mean()]
    X = np.hstack([*(z[p - i : 76 - i] for i in range(1, p + 1)), z[p:, 1:], np.ones((66, 1))])
    c = np.linalg.lstsq(X, z[p:, 0])[0]
    at_rest = 1 - c[: 2 * p : 2].sum()
    d = c[-1] / at_rest
    slope = np.concatenate([np.tile([d, 0.0], p), [0.0, 1.0]]) / at_rest
    variance = np.sum((z[p:, 0] - X @ c) ** 2) / (66 - 22)
    found, deviation = steady_estimate((given,))
    assert found == pytest.approx(d, rel=1e-6)
    assert deviation == pytest.approx(np.sqrt(variance * slope @ np.linalg.solve(X.T @ X, slope)), rel=1e-4)


def test_where_it_rests_is_told_beyond_three_standard_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    given, _ = from_rest(np.random.default_rng(1), 76, 0.02)
    monkeypatch.setattr(arx, "steady_estimate", lambda _: (np.array([2.9, -2.9, 3.1, -3.1]), np.ones(4)))
    np.testing.assert_array_equal(steady_outputs((given,)), [0, 0, 3.1, -3.1])


def test_stretches_are_of_no_account(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sample is in one of them, wherever it is cut: sums of squares are those of all at once."""
    random = np.random.default_rng(3)
    records = tuple(from_rest(random, K, 0.02, 2, 2)[0] for K in (300, 137, 9))
    found = []
    for length in (1000, 50, 41):
        monkeypatch.setattr(arx, "BLOCK", length)
        told = longest_time_constant(records), feedthrough_p_value(records)
        found.append([*np.concatenate(steady_estimate(records)), *told])
    np.testing.assert_allclose(found[1:], found[:1] * 2, rtol=1e-7)


def test_where_there_is_no_rest_or_nothing_is_told_it_is_the_mean() -> None:
    random = np.random.default_rng(0)
    u = 1 + random.standard_normal((300, 1))
    constant = np.ones((100, 1))
    for each in (
        Record(u, np.cumsum(u, axis=0), 1.0), Record(u[:5], u[:5], 1.0), Record(constant, constant, 1.0),
        Record(u, np.cumsum(u, axis=0) + 0.01 * random.standard_normal(u.shape), 1.0),
        Record(u, scipy.signal.lfilter([0, 1.0], [1, -0.998], u, axis=0), 1.0),  # 500 samples of time constant
    ):  # fmt: skip
        np.testing.assert_array_equal(steady_outputs((each,)), 0)
