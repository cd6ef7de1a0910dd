"""x(0) from a window of outputs: against least squares, finite differences and the state that made the window."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.model.architecture import SCHEDULING, STABILITIES, Architecture
from nnss_cli.model.initial import response, spread_of, state_from_window
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.engine import ReferenceEngine
from nnss_cli.training.fast import FastEngine, Weights
from nnss_cli.training.feedback import Feedback
from nnss_cli.training.recipe import Recipe
from nnss_cli.training.warm import warm_start

NETWORKS = tuple(each for each in STABILITIES if each != "incremental")
"""Those with a generator network; test_incremental.py has the other."""

EPS = float(np.finfo(float).eps)
ONE = np.ones(1)
SLOW = LinearStateSpace(  # every state shows in the output for long
    np.array([[0.95, 0.2, 0.0], [-0.2, 0.95, 0.1], [0.0, 0.0, 0.9]]), np.array([[0.1], [0.2], [0.3]]),
    np.array([[1.0, 0.3, 0.5]]), np.zeros((1, 1)), 1.0,
)  # fmt: skip


def make(
    scheduling: str = "x", stability: str = "schur", dtype: str = "float64", gamma: float = 1.0, m: int = 1
) -> NNSS:
    """A nonlinear model near `SLOW`, observable, with a poor encoder."""
    C = np.concatenate([SLOW.C, [[0.2, -0.5, 0.1]]])[:m]
    linear = LinearStateSpace(SLOW.A, SLOW.B, C, np.zeros((m, 1)), 1.0)
    a = Architecture(3, 1, m, (6,), (4,), scheduling, gamma=gamma, dtype=dtype, stability=stability)
    scaling = Scaling(ONE, 2 * ONE, 3.0 * np.ones(m), 0.5 * np.ones(m))
    model = NNSS(a, scaling, Channels(("u",), ("y",) * m, ("",), ("",) * m), 1.0)
    random = np.random.default_rng(0)
    model.initialise(random)
    warm_start(model, (linear, random.standard_normal((3, m))))
    with torch.no_grad():
        last = model.generator[-1].weight
        last.copy_(torch.from_numpy(0.02 * random.standard_normal(tuple(last.shape))))
    return model


def simulated(model: NNSS, x0: np.ndarray, K: int = 120, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """u and y in physical units, from a state of one's own."""
    random, m = np.random.default_rng(seed), model.architecture.outputs
    u = 1 + 2 * random.standard_normal((K, 1))
    inputs = torch.tensor(model.scaling.normalise_u(u), dtype=model.dtype)[None]
    first = torch.zeros(1, m, dtype=model.dtype)
    with torch.no_grad():
        for _ in range(3):  # where y schedules, y(0) stands before the first sample, but C may depend on it
            first = model(inputs[:, :1], first, x0=torch.tensor(x0, dtype=model.dtype)[None])[0][:, 0]
        y = model(inputs, first, x0=torch.tensor(x0, dtype=model.dtype)[None])[0][0]
    return u, model.scaling.restore_y(y.numpy().astype(float))


@pytest.mark.parametrize("stability", NETWORKS)
@pytest.mark.parametrize("scheduling", SCHEDULING)
def test_the_state_that_made_a_window_is_found(scheduling: str, stability: str) -> None:
    model = make(scheduling, stability, m=1 + ("y" in scheduling))
    x0 = np.array([1.0, -0.7, 0.5])
    u, y = simulated(model, x0)
    found, guessed = model.simulate(u, y[:50]), model.simulate(u, y[0])
    np.testing.assert_allclose(found.x[0], x0, atol=1e-6)
    np.testing.assert_allclose(found.y, y, atol=1e-6)
    assert np.abs(guessed.x[0] - x0).max() > 0.3


def test_in_float32_it_is_found_up_to_rounding() -> None:
    model = make(dtype="float32")
    x0 = np.array([1.0, -0.7, 0.5])
    u, y = simulated(model, x0)
    np.testing.assert_allclose(model.simulate(u, y[:50]).x[0], x0, atol=1e-3)


@pytest.mark.parametrize("scheduling", SCHEDULING)
@pytest.mark.parametrize("stability", NETWORKS)
def test_derivatives_against_finite_differences_and_the_compiled_ones(scheduling: str, stability: str) -> None:
    model = make(scheduling, stability, m=2)
    random = np.random.default_rng(3)
    x0, u, y0 = random.standard_normal(3), random.standard_normal((12, 1)), random.standard_normal(2)

    def run(x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        y, J = response(model.step, *(torch.tensor(signal) for signal in (x0, u, y0)))
        return y.numpy(), J.numpy()

    y, J = run(x0)
    step = 1e-6 * np.eye(3)
    differences = np.stack([(run(x0 + d)[0] - run(x0 - d)[0]) / 2e-6 for d in step], axis=-1)
    np.testing.assert_allclose(J, differences, atol=1e-8)
    with torch.no_grad():
        plain = model(torch.tensor(u)[None], torch.tensor(y0)[None], x0=torch.tensor(x0)[None])[0][0]
    np.testing.assert_allclose(y, plain.numpy(), atol=1e-13)
    weights = Weights(model)
    ((y_compiled, _, J_compiled),) = weights.sensitivities(x0, u, y0)
    np.testing.assert_allclose(y_compiled, y, atol=1e-10)
    np.testing.assert_allclose(J_compiled[:, :, weights.generator_size :], J, atol=1e-10)


def linear_problem(q: int, n: int, seed: int) -> tuple[Callable, np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    J, b, guess = random.standard_normal((q, n)), random.standard_normal(q), random.standard_normal(n)
    return lambda x: (J @ x - b, J), J, b, guess


@given(n=st.integers(1, 6), more=st.integers(1, 40), noise=st.sampled_from([0.0, 1e-3, 0.3]), seed=st.integers(0, 999))
def test_on_a_linear_system_it_is_the_regularised_least_squares(n: int, more: int, noise: float, seed: int) -> None:
    """Against the fixed point of ridge regression and the variance of its residuals; lstsq where there is no noise."""
    random = np.random.default_rng(seed)
    q = 2 * n + more
    J, x_true, guess = random.standard_normal((q, n)), random.standard_normal(n), random.standard_normal(n)
    b = J @ x_true + noise * random.standard_normal(q)
    x = state_from_window(lambda x: (J @ x - b, J), guess, EPS)
    if noise == 0:
        np.testing.assert_allclose(x, np.linalg.lstsq(J, b, rcond=None)[0], atol=1e-8)
        return
    expected = guess
    for _ in range(200):
        mu = np.sum((J @ expected - b) ** 2) / (q - n)
        expected = guess + np.linalg.solve(J.T @ J + mu * np.eye(n), J.T @ (b - J @ guess))
    np.testing.assert_allclose(x, expected, atol=1e-3 * noise)  # a thousandth of its uncertainty


@given(n=st.integers(2, 6), seed=st.integers(0, 999))
def test_what_a_window_does_not_show_stays_at_the_guess(n: int, seed: int) -> None:
    """Too short a window: exactly the ridge whose weight is the guess's own error; and no motion in its kernel."""
    evaluate, J, b, guess = linear_problem(n - 1, n, seed)
    x = state_from_window(evaluate, guess, EPS)
    mu = np.sum((J @ guess - b) ** 2) / (n - 1)
    expected = guess + np.linalg.solve(J.T @ J + mu * np.eye(n), J.T @ (b - J @ guess))
    np.testing.assert_allclose(x, expected, atol=1e-5)
    kernel = np.linalg.svd(J)[2][n - 1 :]
    np.testing.assert_allclose(kernel @ (x - guess), 0, atol=1e-9)


def test_an_unobservable_state_stays_at_the_guess_however_long_the_window() -> None:
    J = np.zeros((60, 2))
    J[:, 0] = 0.9 ** np.arange(60)
    for b in (J @ [2.0, 0.0], J @ [2.0, 0.0] + 0.1):
        x = state_from_window(lambda x, b=b: (J @ x - b, J), np.array([0.5, 0.25]), EPS)
        assert abs(x[0] - 2) < 0.3
        assert x[1] == pytest.approx(0.25, abs=1e-9)


@given(n=st.integers(1, 5), more=st.integers(1, 30), seed=st.integers(0, 999))
def test_a_fit_is_the_same_in_every_basis(n: int, more: int, seed: int) -> None:
    """With states T x, the guess T g and deviations T d give T times the state, however different their sizes."""
    random = np.random.default_rng(seed)
    evaluate, J, b, guess = linear_problem(n + more, n, seed)
    deviations = random.standard_normal((50, n)) * 10.0 ** random.uniform(-1, 1, n)
    T = random.standard_normal((n, n)) + 2 * np.eye(n)
    T *= 10.0 ** random.uniform(-1, 1, n)[:, None]
    if np.linalg.cond(T) > 1e4:
        return
    own = np.linalg.solve(T.T, J.T).T
    x = state_from_window(evaluate, guess, EPS, spread_of(deviations))
    z = state_from_window(lambda z: (own @ z - b, own), T @ guess, EPS, spread_of(deviations @ T.T))
    scale = np.abs(T) @ np.abs(x - guess)
    np.testing.assert_allclose(z, T @ x, atol=1e-6 * scale.max())  # step by step
    mu = np.sum((J @ x - b) ** 2) / more
    covariance = np.linalg.inv(J.T @ J / mu + np.linalg.inv(deviations.T @ deviations / 50))
    expected = guess + covariance @ J.T @ (b - J @ guess) / mu
    np.testing.assert_allclose(x, expected, atol=0.01 * np.sqrt(np.diag(covariance)).max())


@pytest.mark.parametrize("size", [1e-200, 1.0, 1e200])
def test_the_spread_is_a_factor_of_the_second_moment(size: float) -> None:
    random = np.random.default_rng(0)
    D = random.standard_normal((40, 3)) @ random.standard_normal((3, 3)) + 1
    L = spread_of(size * D) / size
    np.testing.assert_array_equal(np.triu(L, 1), 0)
    np.testing.assert_allclose(L @ L.T, D.T @ D / 40, rtol=1e-9)
    D[:, 1] = 0  # a state that is never off its guess
    L = spread_of(size * D) / size
    assert 0 < np.abs(L[1]).max() < 1e-5


@pytest.mark.parametrize("off", [[[np.nan, 1.0]], [[1.0, np.inf]], [[0.0, 0.0]], np.empty((0, 2))])
def test_where_simulations_tell_nothing_the_spread_is_one(off: list) -> None:
    np.testing.assert_array_equal(spread_of(np.array(off)), np.eye(2))


def hardly_seen(size: float = 40.0) -> NNSS:
    """A linear model with a slow state of that size, which the output hardly shows at first; g knows the other."""
    A, B = np.array([[0.7, 0.2 / size], [0.0, 0.995]]), np.array([[0.3], [0.1 * size]])
    linear = LinearStateSpace(A, B, np.array([[1.0, 0.0]]), np.zeros((1, 1)), 1.0)
    a = Architecture(2, 1, 1, (2,), (2,), dtype="float64", stability="none")
    model = NNSS(a, Scaling(*(number * ONE for number in (0, 1, 0, 1))), Channels(("u",), ("y",), ("",), ("",)), 1.0)
    warm_start(model, (linear, np.array([[1.0], [0.0]])))
    return model


@pytest.mark.system
@pytest.mark.parametrize("engine", [ReferenceEngine, FastEngine])
def test_a_slow_state_of_any_size_is_found(engine: type) -> None:
    """What a state of size one would have held at its guess; told from the training record alone."""
    random, errors = np.random.default_rng(3), {}
    for size in (1.0, 40.0):
        model, at = hardly_seen(size), np.array([0.0, -1.2 * size])
        random = np.random.default_rng(3)
        u, _ = simulated(model, at, K=400)
        y, _ = run(model, u, at)
        noisy = y + 0.05 * random.standard_normal(y.shape)
        built = engine(model, [u], [y], Recipe(dtype="float64"))
        before = built.free_run(u, noisy[:30])
        training = Record(random.standard_normal((2000, 1)), np.zeros((2000, 1)), 1.0)
        training = replace(training, y=run(model, training.u, np.zeros(2))[0])
        built.see((training,))
        errors[size] = [np.sqrt(np.mean((each - y)[30:] ** 2)) for each in (before, built.free_run(u, noisy[:30]))]
    assert errors[40.0][0] > 5 * errors[40.0][1]
    assert errors[40.0][1] == pytest.approx(errors[1.0][1], rel=1e-3)


def run(model: NNSS, u: np.ndarray, x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    with torch.no_grad():
        y, x = model(torch.tensor(u)[None], torch.zeros(1, 1, dtype=model.dtype), x0=torch.tensor(x0)[None])
    return y[0].numpy(), x[0].numpy()


@pytest.mark.parametrize("scheduling", SCHEDULING)
def test_the_engines_see_the_same_spread(scheduling: str) -> None:
    model = make(scheduling, m=2)
    records = []
    for seed, K in ((1, 120), (2, 70)):
        u, y = simulated(model, np.ones(3), K, seed)
        records.append(Record(model.scaling.normalise_u(u), model.scaling.normalise_y(y), 1.0))
    windows = [record.u for record in records], [record.y for record in records], Recipe(dtype="float64")
    fast = FastEngine(model, *windows).see(records)
    plain = ReferenceEngine(model, *windows).see(records)
    np.testing.assert_allclose(fast, plain, rtol=1e-8, atol=1e-10)
    off = []
    for record in records:
        with torch.no_grad():
            y = torch.tensor(record.y)
            _, x = model(torch.tensor(record.u)[None], y[:1])
            off.append((x[0] - model.encode(y)).numpy())
    np.testing.assert_allclose(fast @ fast.T, np.mean([np.outer(d, d) for d in np.concatenate(off)], axis=0), rtol=1e-6)


def test_a_singular_simulation_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make()
    u, y = simulated(model, np.ones(3))
    engine = ReferenceEngine(model, [u], [y], Recipe(dtype="float64"))
    engine.see((Record(u, y, 1.0),))
    assert np.abs(engine.see((Record(u, y, 1.0),)) - np.eye(3)).max() > 0.1

    def failing(*_: object) -> None:
        raise torch.linalg.LinAlgError("singular")

    monkeypatch.setattr(NNSS, "step", failing)
    np.testing.assert_array_equal(engine.see((Record(u, y, 1.0),)), np.eye(3))


def test_no_evaluation_raises_the_cost_and_what_is_not_finite_leaves_the_guess() -> None:
    guess = np.array([1.0, 2.0])
    np.testing.assert_array_equal(
        state_from_window(lambda _: (np.full(5, np.nan), np.full((5, 2), np.nan)), guess, EPS), guess
    )
    calls = []

    def cliff(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        calls.append(x)
        out = x[0] < 0.5  # the full step lands here
        return (np.full(4, np.inf) if out else np.full(4, x[0])), np.tile([1.0, 0.0], (4, 1))

    x = state_from_window(cliff, guess, EPS)
    assert 0.5 <= x[0] < 1
    assert len(calls) <= 30


def test_one_sample_is_the_encoders_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nnss_cli.model.nnss.state_from_window", None)  # never called
    monkeypatch.setattr("nnss_cli.training.fast.state_from_window", None)
    for dtype in ("float32", "float64"):
        model = make("x+u+y", dtype=dtype, m=2)
        u, y = simulated(model, np.zeros(3))
        scaled = [
            torch.tensor(s, dtype=model.dtype) for s in (model.scaling.normalise_u(u), model.scaling.normalise_y(y))
        ]
        with torch.no_grad():
            expected, x = model(scaled[0][None], scaled[1][:1])
        expected = model.scaling.restore_y(expected[0].numpy().astype(float))
        for y_init in (y[0], y[:1]):
            np.testing.assert_array_equal(model.simulate(u, y_init).y, expected)
            np.testing.assert_array_equal(model.simulate(u, y_init).x, x[0].numpy().astype(float))


def test_the_engines_find_the_models_state() -> None:
    model = make("x+y", m=2)
    u, y = simulated(model, np.array([1.0, -0.7, 0.5]))
    y = y + 0.05 * np.random.default_rng(0).standard_normal(y.shape)
    u_scaled, y_scaled = model.scaling.normalise_u(u), model.scaling.normalise_y(y)
    compiled, x = Weights(model).free_run(u_scaled, y_scaled[:30])
    found = model.simulate(u, y[:30])
    np.testing.assert_allclose(x[0], found.x[0], atol=1e-7)
    np.testing.assert_allclose(compiled, model.scaling.normalise_y(found.y), atol=1e-6)


@settings(max_examples=10)
@given(seed=st.integers(0, 999))
def test_a_model_with_feedback_finds_its_state(seed: int) -> None:
    random = np.random.default_rng(seed)
    model = Feedback(SLOW.A, SLOW.B, SLOW.C, SLOW.D, -0.1 * SLOW.B, 2 * SLOW.C)
    u, x0 = random.standard_normal((60, 1)), random.standard_normal(3)
    y = model.states(u, x0) @ model.C.T
    np.testing.assert_allclose(model.state_from(u, y[:50], np.zeros(3)), x0, atol=1e-6)
    np.testing.assert_array_equal(model.state_from(u, y[:1], x0 + 1), x0 + 1)
    differences = [(model.response(u, x0 + d)[0] - model.response(u, x0 - d)[0]) / 2e-6 for d in 1e-6 * np.eye(3)]
    np.testing.assert_allclose(model.response(u, x0)[1], np.stack(differences, axis=-1), atol=1e-8)


@given(n=st.integers(1, 5), m=st.integers(1, 2), w=st.integers(2, 40), seed=st.integers(0, 999))
def test_linear_models_take_the_smallest_least_squares_state(n: int, m: int, w: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    system = LinearStateSpace(
        A, random.standard_normal((n, 1)), random.standard_normal((m, n)), ONE * np.ones((m, 1)), 1
    )
    u, y = random.standard_normal((50, 1)), random.standard_normal((w, m))
    observability = np.concatenate([system.C @ np.linalg.matrix_power(A, k) for k in range(w)])
    forced = system.simulate(u[:w], np.zeros(n))[0]
    expected = np.linalg.pinv(observability, rcond=1e-13) @ (y - forced).ravel()
    if np.linalg.svd(observability)[1].min() > 1e-6:
        np.testing.assert_allclose(system.state_from_outputs(y, u), expected, rtol=1e-6, atol=1e-6)


def test_an_unstable_linear_model_that_overflows_takes_one_sample() -> None:
    system = LinearStateSpace(1e8 * np.eye(2), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), 1.0)
    u, y = np.ones((60, 1)), np.ones((60, 1))
    np.testing.assert_array_equal(system.state_from_outputs(y[:50], u), system.state_from_output(y[0], u[0]))


def models() -> list:
    scaling = Scaling(ONE, ONE, ONE, ONE)
    return [make(), LinearModel(SLOW, scaling, Channels(("u",), ("y",), ("",), ("",)))]


@pytest.mark.parametrize("model", models(), ids=["nnss", "linear"])
@pytest.mark.parametrize(
    ("y_init", "found"),
    [(np.empty((0, 1)), r"\(0, 1\)"), (np.ones((11, 1)), r"\(11, 1\)"), (np.ones(3), r"\(3,\)"), (np.ones((2, 2)), "")],
)
def test_a_window_that_does_not_fit_is_refused(model: object, y_init: np.ndarray, found: str) -> None:
    with pytest.raises(InputError, match=f"y_init: expected 1 to 10 samples .* of 1 output each, found .*{found}") as e:
        model.simulate(np.ones((10, 1)), y_init)
    assert "\n" not in str(e.value)


def test_a_step_that_is_singular_leaves_the_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    model = make()
    u, y = simulated(model, np.ones(3))

    def failing(*_: object) -> None:
        raise torch.linalg.LinAlgError("singular")

    monkeypatch.setattr("nnss_cli.model.nnss.response", failing)
    np.testing.assert_array_equal(model.simulate(u, y[:50]).x, model.simulate(u, y[0]).x)


def test_a_window_costs_a_few_simulations_of_it() -> None:
    """Counted, not timed: noisy windows need few evaluations."""
    model = make()
    u, y = simulated(model, np.array([1.0, -0.7, 0.5]))
    y = model.scaling.normalise_y(y + 0.1 * np.random.default_rng(0).standard_normal(y.shape))
    count, weights = 0, Weights(model)

    def evaluate(x0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal count
        count += 1
        ((simulated, _, J),) = weights.sensitivities(x0, model.scaling.normalise_u(u)[:50], y[0])
        return (simulated - y[:50]).ravel(), J[:, :, weights.generator_size :].reshape(50, 3)

    state_from_window(evaluate, np.zeros(3), EPS)
    assert 2 < count <= 12
