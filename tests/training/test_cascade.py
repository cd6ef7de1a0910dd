"""A layer that starts at two linear parts with units between them: the form, the basis, the fit, when it is tried."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import slow_but
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Dataset, FittingData, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.iterative import named_random
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.incremental import PlainArrays
from nnss_cli.model.nnss import NNSS
from nnss_cli.training import cascade as module
from nnss_cli.training.attempt import Attempt, Clock
from nnss_cli.training.candidates import worth_trying
from nnss_cli.training.cascade import Cascade, Problem, basis, cascade_start, divisions, train_cascade
from nnss_cli.training.engine import free_run_rmse
from nnss_cli.training.fast import FastEngine, Weights
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.lure_start import matrix, transformed
from nnss_cli.training.recipe import Recipe, recipe_of
from nnss_cli.training.warm import linear_start

POLES = (0.8 + 0.3j, 0.5 + 0.6j, 0.9 + 0.1j, 0.7, -0.4)
UNIT = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))


def with_poles(poles: tuple[complex, ...], seed: int = 0) -> np.ndarray:
    """A matrix with these eigenvalues, complex ones with their conjugates, in a basis at random."""
    n = sum(1 + (complex(pole).imag != 0) for pole in poles)
    A, at = np.zeros((n, n)), 0
    for pole in map(complex, poles):
        size = 1 + (pole.imag != 0)
        A[at : at + size, at : at + size] = (
            [[pole.real, pole.imag], [-pole.imag, pole.real]] if size == 2 else pole.real
        )
        at += size
    T = np.random.default_rng(seed).standard_normal((n, n))
    return T @ A @ np.linalg.inv(T)


def plant(u: np.ndarray, x0: np.ndarray | None = None) -> np.ndarray:
    """Second order, a saturation, second order: y (K, 1)."""
    up = LinearStateSpace(
        with_poles((0.8 + 0.3j,)), np.array([[1.0], [0.3]]), np.array([[0.5, 0.2]]), np.zeros((1, 1)), 1
    )
    down = LinearStateSpace(
        with_poles((0.6 + 0.5j,), 1), np.array([[1.0], [0.2]]), np.array([[0.4, -0.3]]), np.zeros((1, 1)), 1
    )
    between = up.simulate(u, np.zeros(2) if x0 is None else x0)[0]
    return down.simulate(np.tanh(1.5 * between), np.zeros(2))[0]


@pytest.fixture
def between(small_data: Callable[..., Dataset]) -> FittingData:
    """Records of it without noise; 600 samples for training."""
    random = np.random.default_rng(4)

    def record(K: int) -> Record:
        u = 1.5 * random.standard_normal((K, 1))
        return Record(u, plant(u), 0.5)

    train, val = record(600), record(300)
    return replace(small_data().fitting, train=(train,), val=(val,), scaling=Scaling.of((train,)), init_window=10)


def layer(n: int = 4, q: int = 5, **changes: Any) -> NNSS:
    a = Architecture(n, 1, 1, (q,), (4,), dtype="float64", stability="incremental", **changes)
    model = NNSS(a, UNIT, Channels(("u",), ("y",), ("",), ("",)), 1.0)
    model.initialise(named_random(0, "weights"))
    return model


@pytest.mark.parametrize(("poles", "ways"), [
    ((0.9, 0.5), 2), (POLES[:1], 2), (POLES[:2], 2 + 4), (POLES[:3], 12 + 8), ((*POLES[:1], 0.7), 6), (POLES, None),
    ((0.9,), 0),
])  # fmt: skip
def test_poles_are_divided_into_halves_the_fewest_pairs_divided_first(
    poles: tuple[complex, ...], ways: int | None
) -> None:
    A = with_poles(poles)
    found = divisions(A)
    assert ways is None or len(found) == ways
    own = np.linalg.eigvals(A)
    shared = []
    for T, Q, first in found:
        n = len(A)
        assert first in (n // 2, n - n // 2)
        assert not T[first:, :first].any()
        np.testing.assert_allclose(Q @ Q.T, np.eye(n), atol=1e-12)
        parts = [np.linalg.eigvals(T[:first, :first]), np.linalg.eigvals(T[first:, first:])]
        new = np.concatenate(parts)
        distance = np.abs(new[:, None] - own).min(axis=1)
        kept = distance < 1e-7
        shared.append(int((~kept).sum()))
        for pole in new[~kept]:  # of a pair that was divided, on the real axis beside it
            assert abs(pole.imag) < 1e-6
            assert np.abs(np.abs(own.real - pole.real) - module.APART).min() < 1e-6
        if not shared[-1]:
            np.testing.assert_allclose(Q @ T @ Q.T, A, atol=1e-10)
    assert shared == sorted(shared)


def test_the_linear_model_in_this_form_simulates_as_it_did(between: FittingData) -> None:
    train, val = between.normalised()
    linear = linear_start(train, val, 4, 1.0, 10)
    division = divisions(linear[0].A)[0]
    begun = module.at_division(linear, division, 6, train, np.random.default_rng(0))
    assert not begun.plain.F.any()
    assert not begun.plain.G[:, : begun.downstream].any()
    x0 = begun.initial @ val[0].y[0]
    expected, _ = linear[0].simulate(val[0].u, linear[1] @ val[0].y[0])
    np.testing.assert_allclose(begun.outputs(val[0].u, begun.states(val[0].u, x0)), expected, atol=1e-9)
    seen = np.abs(begun.states(train[0].u, x0) @ begun.plain.G.T).std(axis=0)
    assert (seen > 0.1).all()  # within what makes a unit bend
    assert (seen < 10).all()


def random_cascade(seed: int, radius: float = 0.9, strength: float = 1.0, n: int = 5, q: int = 4) -> Cascade:
    random, first = np.random.default_rng(seed), n // 2
    A = random.standard_normal((n, n))
    for part in (slice(None, first), slice(first, None)):
        A[part, part] *= radius / np.abs(np.linalg.eigvals(A[part, part])).max()
    A[first:, :first] = 0
    F, G = strength * random.standard_normal((n, q)), strength * random.standard_normal((q, n))
    F[first:], G[:, :first] = 0, 0
    B, C = random.standard_normal((n, 1)), random.standard_normal((1, n))
    D, b = random.standard_normal((1, 1)), random.standard_normal(q)
    return Cascade(PlainArrays(A, B, F, G, np.zeros((q, 1)), b, C, D, np.zeros((1, q))), first, np.zeros((n, 1)))


@pytest.mark.system
@pytest.mark.parametrize(
    ("gamma", "strength"), slow_but((2, 4), [(1.0, 0.1), (1.0, 1.0), (1.0, 10.0), (0.91, 0.1), (0.91, 1.0)])
)
def test_there_is_a_basis_in_which_a_cascade_of_stable_parts_contracts(gamma: float, strength: float) -> None:
    """However strong the units: their slopes enter no eigenvalue of A(x)."""
    for seed in range(20):
        given, a = random_cascade(seed, 0.9, strength), layer(5, 4, gamma=gamma).architecture
        found = basis(given.plain, given.downstream, a)
        assert found is not None
        T, weight = found
        assert not T[: given.downstream, given.downstream :].any()
        assert np.linalg.norm(matrix(transformed(given.plain, T), np.full(4, 2 / weight), a), 2) < 1
        model = layer(5, 4, gamma=gamma, feedthrough=True)
        x = np.random.default_rng(seed).standard_normal((50, 5))
        T = module._placed(model, given, x)
        placed = model.generator.arrays()
        for ours, theirs in zip(placed, transformed(given.plain, T), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-6 * max(1, np.abs(theirs).max()))
        assert model.generator.promised_norm() < 1
    for part in (slice(0, 2), slice(2, 5)):
        unstable = random_cascade(0)
        unstable.plain.A[part, part] *= 1.2
        assert basis(unstable.plain, 2, layer(5, 4).architecture) is None


def test_the_basis_leaves_half_of_the_room_there_is_and_scales_no_further() -> None:
    a = layer(5, 4).architecture
    for seed in range(10):
        given = random_cascade(seed)
        T, weight = basis(given.plain, given.downstream, a)

        def norm(delta: float, T: np.ndarray = T, weight: float = weight, given: Cascade = given) -> float:
            scale = np.diag([delta] * given.downstream + [1.0] * (5 - given.downstream))
            return float(np.linalg.norm(matrix(transformed(given.plain, scale @ T), np.full(4, 2 / weight), a), 2))

        own = [np.abs(np.linalg.eigvals(part)).max() for part in module.parts(given.plain.A, given.downstream)]
        least = np.sqrt((max(own) ** 2 + 1) / 2)  # what the parts have by themselves, at most
        assert 1 - norm(1.0) >= (1 - least) / 2 * 0.9
        assert norm(2.0) > norm(1.0)
        upstream = slice(given.downstream, None)
        seen = float(np.linalg.norm(given.plain.G[:, upstream] @ np.linalg.inv(T[upstream, upstream]), 2))
        weights = [2 * share / seen for share in module.SHARES]
        half = (1 - min(norm(delta, weight=each) for delta in module.DELTAS for each in weights)) / 2
        larger = module.DELTAS[0] / module.DELTAS[1]
        assert all(1 - norm(larger, weight=each) <= half for each in weights)
    assert basis(given.plain, given.downstream, layer(5, 4, gain=1e-6).architecture) is None  # no such gain


def test_a_layer_holds_the_cascade_that_was_placed_in_it() -> None:
    model, given, random = layer(5, 4), random_cascade(3), np.random.default_rng(0)
    given = replace(given, plain=given.plain._replace(D=np.zeros((1, 1))))
    module._placed(model, given, random.standard_normal((50, 5)))
    u, x0 = random.standard_normal((80, 1)), random.standard_normal(5)
    held, scale = module._held(model, [u], [x0])
    first = held.downstream
    assert first == given.downstream
    assert not (held.plain.A[first:, :first].any())
    assert not (held.plain.F[first:].any())
    assert not (held.plain.G[:, :first].any())
    y, x = Weights(model).free_runs(u[:, :, None], np.zeros((1, 1)), x0[:, None])
    states = held.states(u, scale * x0)
    np.testing.assert_allclose(states, scale * x[:, :, 0], atol=1e-9)
    np.testing.assert_allclose(held.outputs(u, states), y[:, :, 0], atol=1e-9)
    np.testing.assert_allclose(np.sqrt(np.mean(states**2, axis=0)), 1, atol=1e-6)


@pytest.mark.parametrize("radius", [0.9999, 1.0])
def test_iterates_with_a_pole_that_is_not_within_gamma_are_not_taken(
    radius: float, between: FittingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROUNDS", ((3, 1),))
    monkeypatch.setattr(Cascade, "radius", property(lambda _: radius))
    train, val = between.normalised()
    model = layer(4, 4)
    before = [p.clone() for p in model.parameters()]
    assert not cascade_start(model, linear_start(train, val, 4, 1.0, 10), train, val, named_random(0, "cascade"), 10)
    assert all(torch.equal(one, other) for one, other in zip(before, model.parameters(), strict=True))


def test_derivatives_are_those_of_differences() -> None:
    given, random = random_cascade(1, 0.7, 0.5), np.random.default_rng(2)
    u = [random.standard_normal((K, 1)) for K in (12, 9)]
    y = [random.standard_normal((K, 1)) for K in (12, 9)]
    for feedthrough in (True, False):
        problem = Problem(given, u, y, feedthrough)
        point = np.concatenate([problem.whole[problem.chosen], random.standard_normal(10)])
        assert len(problem.chosen) == 4 + 6 + 9 + 5 + 2 * 4 + 4 * 3 + 4 + 5 + feedthrough

        def errors(at: np.ndarray, problem: Problem = problem) -> np.ndarray:
            model, begin = problem.at(at), at[-10:].reshape(2, 5)
            return np.concatenate(
                [(model.outputs(a, model.states(a, x0)) - b).ravel() for a, b, x0 in zip(u, y, begin, strict=True)]
            )

        J = np.array([(errors(point + d) - errors(point - d)) / 2e-6 for d in 1e-6 * np.eye(len(point))]).T
        equations, x = problem.evaluate(point)
        e = errors(point)
        assert equations.squares == pytest.approx(e @ e)
        np.testing.assert_allclose(equations.slope, J.T @ e, atol=1e-7 * np.abs(J.T @ e).max())
        np.testing.assert_allclose(np.tril(equations.gram), np.tril(J.T @ J), atol=1e-6 * np.abs(J.T @ J).max())
        assert x.shape == (21, 5)


def test_a_fit_begins_at_the_states_that_explain_a_records_first_samples() -> None:
    given, random = random_cascade(1, 0.7, 0.5), np.random.default_rng(2)
    u, truth = [random.standard_normal((K, 1)) for K in (80, 60)], random.standard_normal((2, 5))
    y = [given.outputs(inputs, given.states(inputs, x0)) for inputs, x0 in zip(u, truth, strict=True)]
    y[0][module.FIRST :] += 1  # is not asked
    problem = Problem(given, u, y, feedthrough=True)
    point = problem.point(truth + 0.3 * random.standard_normal((2, 5)))
    np.testing.assert_allclose(point[-10:].reshape(2, 5), truth, atol=1e-6)
    assert np.array_equal(point[:-10], problem.whole[problem.chosen])


def test_training_begins_at_the_layers_own_guess_in_the_cascades_states(monkeypatch: pytest.MonkeyPatch) -> None:
    model, random = layer(5, 4), np.random.default_rng(0)
    given = random_cascade(3)
    module._placed(
        model, replace(given, plain=given.plain._replace(D=np.zeros((1, 1)))), random.standard_normal((50, 5))
    )
    u, y = random.standard_normal((80, 1)), random.standard_normal((80, 1))
    engine = FastEngine(model, [u], [y], Recipe(dtype="float64"))
    own, begun = engine.free_run(u, y[0]), []

    def point(problem: Problem, begin: list[np.ndarray]) -> np.ndarray:
        begun.append(problem.start.outputs(u, problem.start.states(u, begin[0])))
        return np.concatenate([problem.whole[problem.chosen], *begin])

    monkeypatch.setattr(Problem, "point", point)
    train_cascade(model, engine, [u], [y], 1, lambda _: False)
    np.testing.assert_allclose(begun[0], own, atol=1e-8)


@pytest.mark.parametrize(("growth", "finite"), [(0.7, True), (1.6, False)])
def test_a_step_whose_states_leave_the_range_is_refused(growth: float, finite: bool) -> None:
    """However small the outputs: 1.6⁶⁰ is 2·10¹², whose square is a number."""
    given, random = random_cascade(1, growth, 0.0), np.random.default_rng(2)
    u = [random.standard_normal((60, 1))]
    problem = Problem(given, u, [np.zeros((60, 1))], feedthrough=False)
    equations, x = problem.evaluate(np.concatenate([problem.whole[problem.chosen], np.ones(5)]))
    assert (np.abs(x).max() > module.TOO_LARGE) != finite
    assert np.isfinite(equations.squares) == finite


@pytest.mark.parametrize("feedthrough", [False, True])
def test_each_round_keeps_the_divisions_that_validate_best(
    feedthrough: bool, between: FittingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROUNDS", ((3, 5), (7, 3), (9, 2)))
    train, val = between.normalised()
    start, E = linear_start(train, val, 4, 1.0, 10)
    linear = LinearStateSpace(start.A, start.B, start.C, np.array([[0.5]]), start.Ts), E
    model, errors, asked = layer(4, 4, feedthrough=feedthrough), iter((5.0, 3.0, 4.0, 1.0, 2.0)), []

    def fitted(
        given: Cascade, _: object, __: object, iterations: int, window: int, free: bool, gamma: float, ___: object
    ) -> Cascade:
        assert (window, free, gamma) == (10, feedthrough, 1.0)
        assert given.plain.D.item() == 0.5 * feedthrough  # a model without a feedthrough begins without one
        asked.append((iterations, given.error))
        return replace(given, error=next(errors) if iterations == 3 else given.error - 0.1)

    monkeypatch.setattr(module, "fit_cascade", fitted)
    assert cascade_start(model, linear, train, val, named_random(0, "cascade"), 10)
    assert asked[:5] == [(3, np.inf)] * 5
    assert asked[5:8] == [(7, 1.0), (7, 2.0), (7, 3.0)]
    assert asked[8:] == [(9, 0.9), (9, 1.9)]


def test_when_the_time_is_up_no_further_division_and_no_further_iteration_begins(
    between: FittingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    train, val = between.normalised()
    linear, left, evaluated = linear_start(train, val, 4, 1.0, 10), [5], [0]

    def in_time() -> bool:
        left[0] -= 1
        return left[0] >= 0

    def counted(*given: object) -> object:
        evaluated[0] += 1
        return evaluate(*given)

    evaluate = Problem.evaluate
    monkeypatch.setattr(Problem, "evaluate", counted)
    random = named_random(0, "cascade")
    assert cascade_start(layer(4, 4), linear, train, val, random, 10, in_time)  # of what there was time for, the best
    assert 0 < evaluated[0] < 12  # one division's, with steps that were refused
    assert not cascade_start(layer(4, 4), linear, train, val, random, 10, lambda: False)


@pytest.mark.parametrize("threads", [1, 2])
def test_derivatives_are_found_ahead_with_two_threads_alone(threads: int, monkeypatch: pytest.MonkeyPatch) -> None:
    used = []
    monkeypatch.setattr(module, "ahead", lambda blocks: used.append(1) or blocks)
    given, signal = random_cascade(1, 0.7, 0.5), [np.ones((12, 1))]
    problem = Problem(given, signal, signal, False, threads)
    problem.evaluate(np.concatenate([problem.whole[problem.chosen], np.zeros(5)]))
    assert bool(used) == (threads == 2)


def test_the_rounds_are_those_that_are_told() -> None:
    (first, _), (more, four), (last, two) = module.ROUNDS
    told = " ".join((Path(__file__).parents[2] / "docs" / "recipes.md").read_text(encoding="utf-8").split())
    words = {4: "four", 2: "two"}
    assert (
        f"Each division has {first} iterations on the first stage, the best {words[four]} {more} more, the best "
        f"{words[two]} {last}."
    ) in told


@pytest.mark.parametrize("w", [1, 10])
def test_a_validation_error_leaves_out_the_samples_that_tell_the_start(w: int, between: FittingData) -> None:
    (val,) = between.normalised()[1]
    given, E, e = random_cascade(2, 0.7, 0.5), np.full((5, 1), 0.2), np.full(5, 0.1)
    x0 = given.state_from(val.u, val.y[:w], E @ val.y[0] + e, 2 * np.eye(5))
    errors = given.outputs(val.u, given.states(val.u, x0)) - val.y
    assert given.validated([val], w, E, e, 2 * np.eye(5)) == pytest.approx(np.mean(errors[w if w > 1 else 0 :] ** 2))


def test_an_iterate_is_judged_with_the_spread_of_its_own_states(
    between: FittingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    spreads: list[np.ndarray] = []
    plain = Cascade.validated

    def noting(self: Cascade, val: tuple[Record, ...], w: int, E: np.ndarray, e: np.ndarray, L: np.ndarray) -> float:
        x = np.concatenate([self.states(record.u, E @ record.y[0] + e) for record in train])
        P = L @ L.T
        off = x - train[0].y @ E.T - e
        np.testing.assert_allclose(
            P, off.T @ off / len(off), atol=0.1 * np.abs(P).max()
        )  # but for x(0), which is fitted
        spreads.append(L)
        return plain(self, val, w, E, e, L)

    monkeypatch.setattr(module, "ROUNDS", ((5, 1),))
    monkeypatch.setattr(Cascade, "validated", noting)
    train, val = between.normalised()
    cascade_start(layer(4, 6), linear_start(train, val, 4, 1.0, 10), train, val, named_random(0, "cascade"), 10)
    assert len(spreads) >= 5


@pytest.mark.system
def test_a_plant_of_this_form_is_found_and_the_layer_stays_of_it(between: FittingData) -> None:
    train, val = between.normalised()
    model = layer(4, 6)
    linear = linear_start(train, val, 4, 1.0, 10)
    assert cascade_start(model, linear, train, val, named_random(0, "cascade"), 10)
    engine = FastEngine(model, [train[0].u], [train[0].y], Recipe(dtype="float64"))
    begun = free_run_rmse(engine, val, 10)
    assert begun < 0.01
    errors: list[float] = []

    def goes_on(loss: float) -> bool:
        errors.append(loss)
        assert model.generator.promised_norm() < 1
        A, F, G = (getattr(model.generator.arrays(), name) for name in "AFG")
        assert np.abs(A[2:, :2]).max() < 1e-9
        assert np.abs(F[2:]).max() < 1e-9 * np.abs(F).max()
        assert np.abs(G[:, :2]).max() < 1e-9 * np.abs(G).max()
        return True

    train_cascade(model, engine, [train[0].u], [train[0].y], 40, goes_on)
    assert len(errors) > 5
    assert errors == sorted(errors, reverse=True)
    assert free_run_rmse(engine, val, 10) < begun


@pytest.mark.parametrize("fixed", [False, True])
def test_the_encoder_is_the_regression_of_the_layers_own_states(
    fixed: bool, between: FittingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROUNDS", ((5, 2),))
    train, val = between.normalised()
    model, (record,) = layer(4, 4), train
    assert cascade_start(model, linear_start(train, val, 4, 1.0, 10), train, val, named_random(0, "cascade"), 10)

    def offset() -> float:
        """Of the encoder's guesses from the states, on the mean and relative: a regression leaves none."""
        with torch.no_grad():
            x = Weights(model).free_run(record.u, record.y[:50])[1]
            off = model.encoder(torch.tensor(record.y)).numpy() - x
        return float((np.abs(off.mean(axis=0)) / x.std(axis=0)).max())

    assert offset() < 0.05
    before = [layer.weight.clone() for layer in model.encoder]
    engine = FastEngine(model, [record.u], [record.y], Recipe(dtype="float64"))
    train_cascade(model, engine, [record.u], [record.y], 3, lambda _: True, fixed_encoder=fixed)
    same = [torch.equal(one, layer.weight) for one, layer in zip(before, model.encoder, strict=True)]
    assert all(same) == fixed
    assert fixed or offset() < 0.05


@pytest.mark.system
def test_two_threads_give_the_same_numbers(between: FittingData, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ROUNDS", ((5, 2),))
    monkeypatch.setattr(module, "STRETCH", 64)
    train, val = between.normalised()
    found = []
    for threads in (1, 2):
        model = layer(4, 4)
        assert cascade_start(model, linear_start(train, val, 4, 1.0, 10), train, val, named_random(0, "cascade"), 10)
        engine = FastEngine(model, [train[0].u], [train[0].y], Recipe(dtype="float64"))
        train_cascade(model, engine, [train[0].u], [train[0].y], 3, lambda _: True, threads=threads)
        found.append(engine.model_weights.vector.copy())
    assert np.array_equal(*found)


@pytest.mark.system
def test_it_is_tried_on_long_records_alone_and_must_be_clearly_ahead(
    between: FittingData, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROUNDS", ((15, 6), (25, 2)))
    recipe = recipe_of("best", {}, 4).replace(
        epochs=6, hidden=(3,), feedthrough="no", integrator="no", lead=200, lengthen="no"
    )
    first = tuple(record[:200] for record in between.train)
    assert worth_trying(between, 4, recipe, first) == ("cascade",)
    assert worth_trying(between, 1, recipe, first) == ()
    assert "cascade" not in worth_trying(between, 4, recipe, between.train)  # where one stage is all there is
    for open_no_more in ({"stability": "schur"}, {"initial": "linear"}, {"hidden": (5, 5)}, {"scheduling": "x+y"}):
        assert "cascade" not in recipe.replace(**open_no_more).alternatives(600)
    training = train_nnss(between, 4, 0, recipe)
    assert training.model.architecture.stability == "incremental"
    name = "incremental layer from a cascade"
    assert training.candidates[name] < 0.8 * training.candidates["as it is"]
    assert f"{name} taken: it lowers the validation error by more than 20%" in training.remarks
    assert np.abs(training.model.generator.arrays().A[2:, :2]).max() < 1e-9


@pytest.mark.system
def test_a_cascade_has_all_epochs_in_every_stage(between: FittingData) -> None:
    """Its weights are few, so a stage of a long record costs little; others have half as many in each."""
    train, val = between.normalised()
    base = recipe_of("best", {}, 4).replace(feedthrough="no", integrator="no", hidden=(3,), epochs=10)
    found = {}
    for changes in ({"stability": "schur", "initial": "linear"}, {"stability": "incremental", "initial": "cascade"}):
        recipe = base.replace(**changes)
        attempt = Attempt(between, 4, 0, recipe, train, val, None, Clock(0), None, linear_start)
        found[attempt.start] = [attempt.epochs(stage) for stage in (1, 2, 5)]
    assert found == {"linear": [5, 2, 1], "cascade": [10, 10, 10]}


def test_where_it_cannot_be_the_start_is_linear_and_that_is_told(between: FittingData) -> None:
    recipe = recipe_of("best", {}, 1).replace(
        stability="incremental", initial="cascade", feedthrough="no", integrator="no", epochs=2, hidden=(3,)
    )
    training = train_nnss(between, 1, 0, recipe)
    assert "cascade start refused: no iterate keeps the layer's promise" in training.remarks
    with pytest.raises(
        InputError, match="start cascade: expected stability incremental, whose units it sets, found schur"
    ):
        recipe.replace(stability="schur")


@pytest.mark.system
def test_beside_an_integrator_the_layer_itself_is_trained(between: FittingData) -> None:
    summed = tuple(
        Record(r.u, np.cumsum(np.concatenate([np.zeros((1, 1)), r.y[:-1]]), axis=0), r.Ts)
        for r in (*between.train, *between.val)
    )
    data = replace(between, train=summed[:1], val=summed[1:], scaling=Scaling.of(summed[:1]))
    recipe = recipe_of("best", {}, 5).replace(
        stability="incremental", initial="cascade", feedthrough="no", integrator="yes", epochs=10, hidden=(6,)
    )
    training = train_nnss(data, 5, 0, recipe)
    assert training.best_epoch > 0
    assert min(training.val_rmse) < 0.1
    assert torch.isfinite(training.model.generator.X).all()
