"""The step in elementary operations: the model's own simulation, for every kind of model, and its exact derivatives."""

import copy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import control
import numpy as np
import pytest
import torch
from nnss_cli.baselines.schur import schur_margin, schur_matrix
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.elementary import OPERATIONS, cholesky, rows, solve, solve_lower, solve_upper, trace
from nnss_cli.errors import InputError
from nnss_cli.model.architecture import COMBINATIONS, SCHEDULING, STABILITIES
from nnss_cli.system import Parts, system_of
from nnss_cli.trained import TrainedModel, load
from nnss_cli.trained.linear import _newton, equilibrium


def signals(model: TrainedModel, K: int = 40, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return (
        random.standard_normal((K, len(model.channels.inputs))),
        random.standard_normal((3, len(model.channels.outputs))),
    )


def largest_error(model: TrainedModel, w: int = 1) -> float:
    """Of the program against the model's own simulation, relative to the outputs."""
    u, y_init = signals(model, 16)
    expected = model.simulate(u, y_init[:w]).y
    y, _ = model.system.simulate(u, model.initial_state(u, y_init[:w]))
    return float(np.abs(y - expected).max() / max(1.0, np.abs(expected).max()))


@pytest.mark.parametrize(("stability", "scheduling"), COMBINATIONS)
def test_parity_with_simulate(stability: str, scheduling: str, untrained: Callable[..., TrainedModel]) -> None:
    for n in range(1, 7):
        for r, m in ((1, 1), (2, 3)):
            model = untrained(stability, scheduling, n, r, m, feedthrough=n % 2 == 0)
            assert largest_error(model) < 1e-13, (n, r, m)
            assert n != 3 or largest_error(model, w=3) < 1e-13, (n, r, m)
            nodes = model.system.step.nodes
            assert {node.operation for node in nodes} <= set(OPERATIONS)


@pytest.mark.parametrize(("r", "m"), [(1, 1), (2, 3)])
def test_parity_of_linear_models_and_ensembles(
    r: int, m: int, trained_folder: Callable[..., Path], untrained: Callable[..., TrainedModel], ensemble_of: Callable
) -> None:
    for method in ("n4sid", "ssest"):
        linear = load(trained_folder(method, 3, r, m))
        assert largest_error(linear) < 1e-13
        assert largest_error(linear, w=3) < 1e-12
    for scheduling in ("x", "x+u+y"):
        first = untrained("schur", scheduling, 2, r, m).model
        others = [untrained("none", "x+y", 3, r, m, seed=seed).model for seed in (1, 2)]
        for rule in ("clipped", "mean"):
            ensemble = ensemble_of((first, *others), rule)
            assert largest_error(ensemble) < 1e-13
            assert ensemble.system.n == 8


def test_less_is_strict_and_has_no_slope() -> None:
    program = trace(lambda a, b: {"one": a.less(b), "other": b.less(0.5)}, a=(3, 1), b=(3, 1))
    a, b = np.array([[1.0], [2.0], [3.0]]), np.array([[1.0], [2.5], [0.2]])
    found = program(a=a + 1e-30j, b=b - 1e-30j)
    np.testing.assert_array_equal(found["one"][:, 0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(found["other"][:, 0], [0.0, 0.0, 1.0])
    assert not np.iscomplexobj(found["one"])


@pytest.mark.system
@pytest.mark.parametrize("count", [2, 4, 5, 8])
def test_an_ensembles_frozen_matrices_and_jacobians_are_those_of_the_members_that_count(
    count: int, untrained: Callable[..., TrainedModel], ensemble_of: Callable
) -> None:
    members = [untrained("schur", "x", 2, 2, 3, seed=seed, feedthrough=True).model for seed in range(count)]
    model = ensemble_of(members)
    random = np.random.default_rng(0)
    for _ in range(20):
        z, u = random.standard_normal(2 * count), random.standard_normal(2)
        z_next, y = model.system.advance(z, u)
        each = np.array([TrainedModel(one).system.advance(z[2 * i : 2 * i + 2], u)[1] for i, one in enumerate(members)])
        np.testing.assert_allclose(y, model.model.together(each), rtol=1e-13, atol=1e-13)
        f = model.matrices(z, u)
        np.testing.assert_allclose(f.A @ z + f.B @ (u - f.u_mean), z_next, atol=1e-12)
        np.testing.assert_allclose(f.C @ z + f.D @ (u - f.u_mean) + f.y_mean, y, atol=1e-12)
        _, _, H, D = model.system.jacobians(z, u)
        steps = 1e-7 * np.eye(2 * count + 2)
        moved = [model.system.advance(z + step[:-2], u + step[-2:])[1] - y for step in steps]
        np.testing.assert_allclose(np.array(moved).T / 1e-7, np.hstack([H, D]), atol=1e-5)


def test_float32_models_are_their_weights_in_float64(untrained: Callable[..., TrainedModel]) -> None:
    for stability in STABILITIES:
        assert 1e-9 < largest_error(untrained(stability, n=3, dtype="float32")) < 1e-5


def test_elimination_without_pivoting_is_backward_stable() -> None:
    """For M of a positive definite symmetric part, however large its skew part."""
    random = np.random.default_rng(0)
    for n in range(1, 7):
        W, V = random.standard_normal((2000, n, n)), random.standard_normal((2000, n, n))
        M = W.swapaxes(1, 2) @ W + 1e-3 * np.eye(n) + 10 ** random.uniform(-2, 1, (2000, 1, 1)) * (V - V.swapaxes(1, 2))
        b = random.standard_normal((2000, n, 1))
        z = trace(lambda M, b: {"z": solve(M, b)}, M=(n, n), b=(n, 1))(M=M, b=b)["z"]
        norms = np.linalg.norm(M, axis=(1, 2)) * np.linalg.norm(z, axis=(1, 2)) + np.linalg.norm(b, axis=(1, 2))
        assert (np.linalg.norm(M @ z - b, axis=(1, 2)) / norms).max() < 1e-13


def test_triangular_solutions() -> None:
    random = np.random.default_rng(0)
    for n in (1, 2, 5):
        W = random.standard_normal((n, n))
        S, b = W @ W.T + np.eye(n), random.standard_normal((n, 2))
        program = trace(
            lambda S, b: {"lower": solve_lower(cholesky(S), b), "upper": solve_upper(cholesky(S), b)},
            S=(n, n),
            b=(n, 2),
        )
        L = np.linalg.cholesky(S)
        found = program(S=S, b=b)
        np.testing.assert_allclose(found["lower"], np.linalg.solve(L, b), rtol=1e-12)
        np.testing.assert_allclose(found["upper"], np.linalg.solve(L.T, b), rtol=1e-12)


def test_shapes_that_do_not_fit_are_refused() -> None:
    for wrong in (lambda a: a + a.T, lambda a: a @ a, lambda a: a.reshape(3, 3)):
        with pytest.raises(ValueError, match="shape|reshape"):
            trace(lambda a, wrong=wrong: {"b": wrong(a)}, a=(2, 3))
    assert trace(lambda a: {"b": rows(a)}, a=(2, 3)).outputs == {"b": 0}


@pytest.mark.parametrize(("stability", "scheduling"), COMBINATIONS)
def test_jacobians_are_the_derivatives(stability: str, scheduling: str, untrained: Callable[..., TrainedModel]) -> None:
    system = untrained(stability, scheduling, 3, 2, 2, feedthrough=True).system
    random = np.random.default_rng(0)
    z, u, h = random.standard_normal(system.size), random.standard_normal(2), 1e-5
    A, B, C, D = system.jacobians(z, u)
    for matrix, output, state in ((A, 0, True), (B, 0, False), (C, 1, True), (D, 1, False)):
        for i, direction in enumerate(h * np.eye(matrix.shape[1])):
            ahead, behind = (
                system.advance(z + sign * direction, u) if state else system.advance(z, u + sign * direction)
                for sign in (1, -1)
            )
            np.testing.assert_allclose(matrix[:, i], (ahead[output] - behind[output]) / (2 * h), atol=1e-8)


@pytest.mark.parametrize(("stability", "scheduling"), COMBINATIONS)
def test_frozen_matrices_give_the_step(stability: str, scheduling: str, untrained: Callable[..., TrainedModel]) -> None:
    """In physical units: x(k+1) = A x + B (u − ū), y = C x + D (u − ū) + ȳ."""
    for feedthrough in (False, True):
        model = untrained(stability, scheduling, 3, 2, 2, feedthrough=feedthrough)
        random = np.random.default_rng(0)
        x, u, y = (random.standard_normal(size) for size in (3, 2, 2))
        f = model.matrices(x, u, y)
        z_next, y_now = model.system.advance(model.system.state(x, y), u)
        np.testing.assert_allclose(f.A @ x + f.B @ (u - f.u_mean), z_next[:3], atol=1e-12)
        np.testing.assert_allclose(f.C @ x + f.D @ (u - f.u_mean) + f.y_mean, y_now, atol=1e-12)
        assert len(list(f)) == (4 if feedthrough else 3)
        if stability == "schur":
            assert np.abs(np.linalg.eigvals(f.A)).max() < 0.97
    assert model.matrices(x).A.shape == (3, 3)


@pytest.mark.parametrize(
    "kind", [("schur", "x"), ("quadratic", "x+u"), ("schur", "x+u+y"), ("none", "x+y"), ("incremental", "x+u")]
)
def test_control_responds_as_simulate(kind: tuple[str, str], untrained: Callable[..., TrainedModel]) -> None:
    model = untrained(*kind, 3, 2, 2)
    u, y_init = signals(model)
    expected = model.simulate(u, y_init[:1]).y
    t = np.arange(len(u)) * model.Ts
    response = control.input_output_response(model.to_control(), t, u.T, model.initial_state(u, y_init[:1]))
    np.testing.assert_allclose(response.y.T, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("inputs", "outputs", "expected"),
    [
        (("pump.speed", "u"), ("u.1", "level"), (["pump_speed", "u"], ["u_1", "level"])),
        (("a.b", "a_b"), ("a_b.", "a.b."), (["a_b_2", "a_b"], ["a_b_", "a_b__2"])),
        (("a.b_", "a_b."), ("a.b.", "a_b__2"), (["a_b_", "a_b__3"], ["a_b__4", "a_b__2"])),
    ],
)
def test_names_with_a_point_become_such_that_control_accepts(
    inputs: tuple[str, ...], outputs: tuple[str, ...], expected: tuple[list[str], list[str]],
    untrained: Callable[..., TrainedModel],
) -> None:  # fmt: skip
    """No two alike, inputs and outputs together, since control connects what has one name; others stay as they are."""
    model = untrained("schur", "x", 2, 2, 2)
    model.model.channels = Channels(inputs, outputs, ("–", "–"), ("–", "–"))
    for system in (model.to_control(), model.linearise([0.1, 0.2])):
        assert (system.input_labels, system.output_labels) == expected
    assert len({*expected[0], *expected[1]}) == 4


@pytest.mark.parametrize("scheduling", SCHEDULING)
def test_linearisation_at_an_equilibrium(scheduling: str, untrained: Callable[..., TrainedModel]) -> None:
    """Its DC gain is the slope of the static curve; the curve is where simulations come to rest."""
    model = untrained("quadratic", scheduling, 3, 2, 2)
    u, h = np.array([0.4, -0.8]), 1e-4
    at = model.equilibrium(u)
    np.testing.assert_allclose(model.system.advance(at.z, u)[0], at.z, atol=1e-9)
    np.testing.assert_allclose(model.simulate(np.tile(u, (600, 1)), np.zeros(2)).y[-1], at.y, atol=1e-8)
    slope = [(model.equilibrium(u + d).y - model.equilibrium(u - d).y) / (2 * h) for d in h * np.eye(2)]
    linear = model.linearise(u)
    np.testing.assert_allclose(linear.dcgain(), np.transpose(slope), atol=1e-6)
    assert linear.dt == 0.1
    assert (linear.input_labels, linear.output_labels) == (["u1", "u2"], ["y1", "y2"])
    np.testing.assert_allclose(model.simulate(np.tile(u, (5, 1))).y, np.tile(at.y, (5, 1)), atol=1e-9)  # at rest


def test_a_linear_model_is_its_own_linearisation(trained_folder: Callable[..., Path]) -> None:
    model = load(trained_folder("ssest"))
    linear, frozen = model.linearise(u=0.3), model.matrices([0.0, 0.0])
    for name in "ABCD":
        np.testing.assert_allclose(getattr(linear, name), getattr(frozen, name), atol=1e-12)
    u, s = np.random.default_rng(0).standard_normal(30), model.system
    steps = control.forced_response(linear, np.arange(30) * 0.5, u).y[0] + model.equilibrium(0.0).y[0]
    shifted = model.simulate(u, x0=s.simulate(np.zeros((1, 1)), model.equilibrium(0.0).z)[1][0]).y[:, 0]
    np.testing.assert_allclose(shifted, steps, atol=1e-10)


def test_a_simulation_goes_on_from_its_last_state(untrained: Callable[..., TrainedModel]) -> None:
    model = untrained("schur", "x+y", 2, 2, 2)
    u, y_init = signals(model)
    whole = model.simulate(u, y_init[:1])
    z = np.concatenate([whole.x[20], whole.y[19]])
    np.testing.assert_allclose(model.simulate(u[20:], x0=z).y, whole.y[20:], atol=1e-12)
    with pytest.raises(InputError, match="expected 4 values, x1, x2, y_previous1, y_previous2, .* found 2"):
        model.simulate(u, x0=[0.0, 0.0])
    with pytest.raises(InputError, match="found both"):
        model.simulate(u, y_init, x0=z)


def test_what_cannot_be_linearised_is_one_line(trained_folder: Callable[..., Path], untrained: Callable) -> None:
    model = load(trained_folder())
    integrator = model.model.system.__class__(np.eye(1), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 0.5)
    drifting = TrainedModel(type(model.model)(integrator, model.model.scaling, model.channels))
    messages = []
    for call in (
        lambda: drifting.linearise(u=1.0),
        lambda: drifting.simulate([1.0, 1.0]),
        lambda: model.linearise(u=[1.0, 2.0]),
        lambda: model.linearise(u=float("nan")),
        lambda: model.matrices([1.0]),
        lambda: TrainedModel(object()).system,
    ):
        with pytest.raises(InputError) as error:
            call()
        messages.append(str(error.value))
    assert all("\n" not in message for message in messages)
    assert "u = 1: expected an equilibrium of the model, found none" in messages[0]
    assert "expected a finite number for each of u1, found" in messages[2]
    assert "for each of x1, x2" in messages[4]
    assert "elementary()" in messages[5]


def test_the_margin_is_that_of_the_models_precision(untrained: Callable[..., TrainedModel]) -> None:
    """A model in float32 keeps its S, and so its A, when it is computed in float64."""
    model = untrained("schur", n=3, dtype="float32")
    x = np.random.default_rng(0).standard_normal(3)
    generator = copy.deepcopy(model.model).double()
    W, V, *_ = (part.detach().numpy()[0] for part in generator.matrices(torch.tensor(x)[None])[:4])
    a = model.model.architecture
    expected, without = (
        schur_matrix(W, V, a.gamma, a.epsilon, margin)
        for margin in (schur_margin(3, "float32"), schur_margin(3, "float64"))
    )
    np.testing.assert_allclose(model.matrices(x).A, expected, atol=1e-13)
    assert np.abs(expected - without).max() > 1e-8


def test_of_several_equilibria_the_one_that_is_reached() -> None:
    """x(k+1) = x + (x − x³)/2 goes from 0.4 to 1, Newton's steps from there to 0."""
    parts = Parts(
        advance=lambda x, u, _: (x + (x - x * x * x) * 0.5 + u, x),
        initial=lambda y0, _: y0.constant(0.4),
        frozen=lambda x, *_: (x, x, x, x),
        n=1, keeps_output=False, feedthrough=False,
    )  # fmt: skip
    system = system_of([parts], Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1)))
    assert equilibrium(system, np.zeros(1)).y == pytest.approx(1.0, abs=1e-9)
    assert _newton(system, np.array([0.4]), np.zeros(1))[0] == pytest.approx(0.0, abs=1e-9)
    # 3.9 x (1 − x) never settles: one of its equilibria, 0 and 1 − 1/3.9, by chance
    chaotic = replace(
        parts, advance=lambda x, u, _: (x * 3.9 - x * x * 3.9 + u, x), initial=lambda y0, _: y0.constant(0.3)
    )
    system = system_of([chaotic], Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1)))
    (y,) = equilibrium(system, np.zeros(1)).y
    assert min(abs(y), abs(y - (1 - 1 / 3.9))) < 1e-9
