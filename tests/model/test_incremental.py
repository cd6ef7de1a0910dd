"""The incrementally stable layer: its promises for any weights, its inverse, torch and compiled."""

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.baselines.incremental import (
    contraction_with_zero,
    contraction_with_zero_inverse,
    incremental_margin,
)
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.errors import InputError
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.incremental import Lure, PlainArrays, secant, whole
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.engine import ReferenceEngine, training_loss
from nnss_cli.training.fast import FastEngine, Weights
from nnss_cli.training.recipe import Recipe

KINDS = [
    # scheduling, feedthrough, gain
    ("x", False, 0.0), ("x+u", False, 0.0), ("x+u", True, 0.0), ("x", True, 0.0),
    ("x", False, 2.0), ("x+u", False, 0.5), ("x+u", True, 1e-3), ("x", True, 30.0),
]  # fmt: skip


def layer(a: Architecture, seed: int = 0, size: float = 1.0, shape: str = "free") -> Lure:
    """A layer of random weights up to `size`; of rank one, or zero in places, by `shape`."""
    random, made = np.random.default_rng(seed), Lure(a)
    with torch.no_grad():
        for name, parameter in made.free().items():
            values = random.uniform(-size, size, tuple(parameter.shape))
            if shape == "rank one" and name in "XY":
                values = np.outer(random.uniform(-1, 1, len(values)), random.uniform(-size, size, values.shape[1]))
            if shape == "sparse":
                values *= random.uniform(size=values.shape) < 0.3
            parameter.copy_(torch.from_numpy(values))
    return made


def in_precision(made: Lure) -> tuple[PlainArrays, np.ndarray]:
    """The matrices as a step of the model has them, and Λ⁻¹."""
    with torch.no_grad():
        dtype = made.X.dtype
        arrays = (part.to(dtype).double().numpy() for part in made.plain())
        return PlainArrays(*arrays), np.exp(np.arcsinh(made.scale.double().numpy() / 2))


def norm_of(made: Lure) -> float:
    """‖K‖₂ of the matrices in the model's precision."""
    plain, scale = in_precision(made)
    K1, K21 = whole(plain, scale, made.a.gamma, made.a.gain)
    return float(np.linalg.norm(np.block([[K1], [K21, np.zeros((len(K21), len(K21)))]]), 2))


def excess(made: Lure, random: np.random.Generator) -> float:
    """Largest ‖·‖₂/bound of what the promise says of the matrices at slopes between 0 and 1, corners among them."""
    plain, _ = in_precision(made)
    a, q = made.a, made.a.hidden[0]
    corners = random.integers(0, 2, (8, q)).astype(float)
    worst = 0.0
    for slopes in (*corners, *random.uniform(0, 1, (8, q)), np.zeros(q), np.ones(q)):
        state = plain.A + (plain.F * slopes) @ plain.G
        worst = max(worst, float(np.linalg.norm(state, 2)) / a.gamma)
        if a.gain:
            both = [np.concatenate([plain.B + (plain.F * slopes) @ plain.H, state], axis=1) / a.gamma]
            both += [
                np.concatenate([plain.D + (plain.E * slopes) @ plain.H, plain.C + (plain.E * slopes) @ plain.G], axis=1)
                / a.gain
            ]
            worst = max(worst, float(np.linalg.norm(np.concatenate(both), 2)))
    return worst


def violations(draws: int, dtype: str, seed: int) -> list[str]:
    """Draws of sizes, kinds and weights up to 10⁴ for which a bound does not hold; and none where all do."""
    random, found = np.random.default_rng(seed), []
    for _ in range(draws):
        scheduling, feedthrough, gain = KINDS[random.integers(len(KINDS))]
        n, r, m, q = (int(random.integers(1, high)) for high in (7, 4, 4, 13))
        a = Architecture(
            n, r, m, (q,), (1,), scheduling, float(random.choice([1.0, 0.99, 0.5])), dtype=dtype,
            stability="incremental", feedthrough=feedthrough, gain=gain,
        )  # fmt: skip
        shape = str(random.choice(["free", "rank one", "sparse"]))
        made = layer(a, int(random.integers(2**31)), float(10 ** random.uniform(-3, 4)), shape)
        size, worst = norm_of(made), excess(made, random)
        if not (size < 1 and worst < 1):
            found.append(f"{a}, {shape}: ‖K‖ = 1 + {size - 1:.3g}, at slopes 1 + {worst - 1:.3g}")
    return found


def make(a: Architecture, seed: int = 0) -> NNSS:
    r, m = a.inputs, a.outputs
    scaling = Scaling(np.zeros(r), np.ones(r), np.zeros(m), np.ones(m))
    model = NNSS(a, scaling, Channels(("u",) * r, ("y",) * m, ("V",) * r, ("m",) * m), 1.0)
    random = np.random.default_rng(seed)
    model.initialise(random)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.from_numpy(0.5 * random.standard_normal(tuple(parameter.shape))))
    return model


def architecture(kind: tuple[str, bool, float], dtype: str = "float64", **more: Any) -> Architecture:
    scheduling, feedthrough, gain = kind
    sizes = {"order": 3, "inputs": 2, "outputs": 2, "hidden": (5,), "encoder": (4,)} | more
    return Architecture(
        **{"gamma": 0.95} | sizes, scheduling=scheduling, feedthrough=feedthrough, gain=gain, dtype=dtype,
        stability="incremental",
    )  # fmt: skip


@pytest.mark.system
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_bounds_hold_for_weights_to_ten_thousand(dtype: str) -> None:
    assert violations(400, dtype, 0) == []


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_the_bounds_hold_in_forty_thousand_draws(dtype: str) -> None:
    assert violations(40_000, dtype, 1) == []


@given(st.integers(0, 2**31 - 1), st.sampled_from(KINDS), st.floats(-3, 4), st.sampled_from(["float32", "float64"]))
def test_no_weights_break_the_bounds(seed: int, kind: tuple, size: float, dtype: str) -> None:
    made = layer(architecture(kind, dtype), seed, 10**size)
    assert norm_of(made) < 1
    assert excess(made, np.random.default_rng(seed)) < 1


@given(st.integers(0, 2**31 - 1), st.integers(1, 5), st.integers(1, 4), st.integers(1, 9))
def test_every_contraction_with_a_zero_has_weights(seed: int, p: int, c: int, q: int) -> None:
    random = np.random.default_rng(seed)
    K = np.block([[random.standard_normal((p, c + q))], [random.standard_normal((q, c)), np.zeros((q, q))]])
    K *= random.uniform(0.01, 0.999) / np.linalg.norm(K, 2)
    margin = incremental_margin(c + q, "float32")
    K1, K21 = K[:p], K[p:, :c]
    again = contraction_with_zero(*contraction_with_zero_inverse(K1, K21, margin), margin)
    np.testing.assert_allclose(again[0], K1, atol=1e-10)
    np.testing.assert_allclose(again[1], K21, atol=1e-10)
    with pytest.raises(InputError, match="norm below 1"):
        contraction_with_zero_inverse(K1 * 1.01 / np.linalg.norm(K, 2), K21 * 1.01 / np.linalg.norm(K, 2), margin)


@pytest.mark.parametrize("kind", KINDS)
def test_matrices_are_placed_exactly_and_torch_is_numpy(kind: tuple) -> None:
    made = layer(architecture(kind))
    plain, scale = in_precision(made)
    before = {name: part.detach().clone() for name, part in made.free().items()}
    made.place(plain, scale)
    for name, part in made.free().items():
        torch.testing.assert_close(part.detach(), before[name], atol=1e-9, rtol=1e-9)
    if not kind[2]:  # the second implementation
        K1, K21 = contraction_with_zero(
            before["X"].numpy(), before["Y"].numpy(), incremental_margin(made.a.gain_columns, "float64")
        )
        ours = whole(plain, scale, made.a.gamma, 0)
        np.testing.assert_allclose(ours[0], K1, atol=1e-12)
        np.testing.assert_allclose(ours[1], K21, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_an_lpv_model_with_an_equilibrium_at_zero(kind: tuple) -> None:
    a = architecture(kind)
    model = make(a)
    x, u = torch.randn(9, 3, dtype=torch.float64), torch.randn(9, 2, dtype=torch.float64)
    x[0], u[0] = 0, 0
    x_next, y = (part.detach() for part in model.step(x, u, x[:, :2]))
    with torch.no_grad():
        W, V, B, C, D = model.matrices(model.rho(x, u, y))
    assert not V.any()
    as_lpv = (model.state_matrix(W, V) @ x[..., None] + B @ u[..., None])[..., 0]
    seen = (C @ x[..., None])[..., 0] + (0 if D is None else (D @ u[..., None])[..., 0])
    torch.testing.assert_close(as_lpv, x_next, atol=1e-13, rtol=0)
    torch.testing.assert_close(seen, y, atol=1e-13, rtol=0)
    assert not x_next[0].any()
    assert not y[0].any()
    if not a.feedthrough:  # u never shows in the same output
        other = model.step(x, u + 1, y)[1].detach()
        torch.testing.assert_close(other, y, atol=0, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(3))
def test_the_bounds_of_the_matrices_are_what_slopes_of_zero_and_one_reach(kind: tuple, seed: int) -> None:
    """B + F Δ H and the like are affine in each slope of Δ, so that their largest entries are at corners."""
    made = layer(architecture(kind), seed)
    _, B, F, G, H, _, C, D, E = made.arrays()
    corners = [np.diag(slopes) for slopes in itertools.product((0.0, 1.0), repeat=5)]
    of = ((B, F, H), (C, E, G), (D, E, H))
    for bound, (M, left, right) in zip(made.output_bounds(), of, strict=True):
        reached = np.max([np.abs(M + left @ corner @ right) for corner in corners], axis=0)
        np.testing.assert_allclose(bound, reached, rtol=1e-12, atol=1e-15)


def test_the_secant_is_smooth_through_zero() -> None:
    v = torch.tensor([-2.0, -1e-3, -1e-9, 0.0, 1e-12, 9.99e-4, 1e-3, 3.0], dtype=torch.float64, requires_grad=True)
    b = torch.tensor(0.7, dtype=torch.float64)
    far = v.detach().abs() > 1e-4
    expected = (torch.tanh(v + b) - torch.tanh(b)) / v
    torch.testing.assert_close(secant(v, b)[far], expected[far], atol=1e-12, rtol=0)
    torch.testing.assert_close(secant(v, b)[3], 1 - torch.tanh(b) ** 2)
    assert torch.autograd.gradcheck(lambda v: secant(v, b), v)


@pytest.mark.parametrize("kind", [KINDS[1], KINDS[5], KINDS[6]])
def test_derivatives_of_the_matrices(kind: tuple) -> None:
    made = layer(architecture(kind, order=2, hidden=(3,)))
    names = list(made.free())
    values = tuple(part.detach().requires_grad_() for part in made.free().values())
    assert torch.autograd.gradcheck(lambda *given: tuple(made.plain(dict(zip(names, given, strict=True)))), values)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("n", "r", "m", "q", "batch", "L"), [(1, 1, 1, 1, 3, 4), (3, 1, 1, 8, 64, 12), (4, 2, 3, 5, 1, 40)]
)
def test_the_compiled_gradient_is_that_of_torch(
    n: int, r: int, m: int, q: int, batch: int, L: int, kind: tuple
) -> None:
    random = np.random.default_rng(1)
    u, y = random.standard_normal((batch, L, r)), random.standard_normal((batch, L, m))
    for dtype, allowed in (("float64", 1e-12), ("float32", 2e-4)):
        a = architecture(kind, dtype, order=n, inputs=r, outputs=m, hidden=(q,))
        model = make(a)
        engine = FastEngine(model, u, y, Recipe(consistency=0.3))
        loss = engine.evaluate(np.arange(batch))
        found = engine.model_weights.views(engine.gradient)
        expected = training_loss(model, torch.tensor(u, dtype=model.dtype), torch.tensor(y, dtype=model.dtype), 0.3)
        expected.backward()
        assert loss == pytest.approx(expected.item(), rel=allowed)
        scale = max(float(parameter.grad.abs().max()) for parameter in model.parameters())
        for name, parameter in model.named_parameters():
            slope = parameter.grad.numpy()
            assert np.abs(found[name] - slope).max() / scale < allowed, name


@pytest.mark.parametrize("integrator", [False, True])
@pytest.mark.parametrize("kind", KINDS[:4] + KINDS[5:7])
def test_compiled_simulations_and_sensitivities_are_those_of_torch(
    kind: tuple, integrator: bool, whole_of: Any
) -> None:
    if integrator and kind[2]:
        pytest.skip("refused: an integrator has no gain")
    a = replace(architecture(kind), integrator=integrator)
    model = make(a)
    random = np.random.default_rng(2)
    u, y = random.standard_normal((2, 30, 2)), random.standard_normal((2, 30, 2))
    recipe = Recipe(dtype="float64")
    fast, plain = FastEngine(model, u, y, recipe), ReferenceEngine(model, u, y, recipe)
    np.testing.assert_allclose(fast.free_run(u[0], y[0, 0]), plain.free_run(u[0], y[0, 0]), atol=1e-12)
    np.testing.assert_allclose(fast.free_run(u[0], y[0, :9]), plain.free_run(u[0], y[0, :9]), atol=1e-8)
    x0 = random.standard_normal((2, a.states))
    for ours, theirs in zip(whole_of(fast, x0), whole_of(plain, x0), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-11)


@pytest.fixture
def whole_of(whole: Any) -> Any:
    return lambda engine, x0: whole(engine.sensitivities(x0), x0)


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_of_the_outputs_matrices_are_what_corners_of_the_slopes_reach(kind: tuple) -> None:
    """Each entry of B + F diag(d) H is affine in d, so a corner has its largest modulus, of either sign."""
    for seed in range(5):
        made = layer(architecture(kind), seed)
        plain, _ = in_precision(made)
        corners = [np.array(d) for d in itertools.product((0.0, 1.0), repeat=5)]
        for found, constant, left, right in zip(
            made.output_bounds(), (plain.B, plain.C, plain.D), (plain.F, plain.E, plain.E),
            (plain.H, plain.G, plain.H), strict=True,
        ):  # fmt: skip
            reached = np.max([np.abs(constant + (left * d) @ right) for d in corners], axis=0)
            np.testing.assert_allclose(found, reached, rtol=1e-12, atol=1e-15)


def distances(model: NNSS, u: np.ndarray, x: np.ndarray, others: np.ndarray) -> np.ndarray:
    """‖x1(k) − x2(k)‖ (K, b) from states (n, b) and (n, b) under one input (K, r, b)."""
    weights, y = Weights(model), np.zeros((model.architecture.outputs, x.shape[1]))
    one, two = (weights.free_runs(u, y, start)[1].astype(np.float64) for start in (x, others))
    return np.linalg.norm(one - two, axis=1)


def worst_over_promise(pairs: int, seed: int, steps: int = 60) -> float:
    """Largest distance over γᵏ d(0), of pairs under white, constant and adversarial inputs, as far as numbers reach."""
    random, worst = np.random.default_rng(seed), 0.0
    for kind, size in itertools.product((KINDS[0], KINDS[1], KINDS[6]), (0.3, 3.0, 1e3)):
        a = architecture(kind, gamma=float(random.choice([0.9, 0.99, 1.0])))
        model = make(a, int(random.integers(2**31)))
        with torch.no_grad():
            for parameter in model.generator.parameters():
                parameter.mul_(size)
        b = pairs // 9
        x = random.standard_normal((3, b)) * 10 ** random.uniform(-2, 2, b)
        others = x + random.standard_normal((3, b)) * 10 ** random.uniform(-3, 1, b)
        u = random.standard_normal((steps, 2, b)) * 10 ** random.uniform(-2, 2, b)
        u[:, :, : b // 4] = u[:1, :, : b // 4]
        u[:, :, b // 4 : b // 2] = ascended(model, u[:, :, b // 4 : b // 2], x, others, b // 4)
        d = distances(model, u, x, others)
        noise = (
            1e-13 * (1 + np.abs(x).max(axis=0) + np.abs(others).max(axis=0)) * (1 + size * np.abs(u).max(axis=(0, 1)))
        )
        promised = a.gamma ** np.arange(steps)[:, None] * d[0] + noise / (1 - min(a.gamma, 0.99))
        worst = max(worst, float((d / promised).max()))
    return worst


def ascended(model: NNSS, u: np.ndarray, x: np.ndarray, others: np.ndarray, first: int, ascents: int = 8) -> np.ndarray:
    """Inputs by gradient ascent of the distance after some samples, as large as those given."""
    at, reach = torch.tensor(u.transpose(2, 0, 1)), torch.tensor(np.abs(u).max(axis=(0, 1)))[:, None, None]
    starts = [torch.tensor(part[:, first : first + len(at)].T.copy()) for part in (x, others)]
    unused = torch.zeros(len(at), model.architecture.outputs, dtype=torch.float64)
    for _ in range(ascents):
        at.requires_grad_(True)
        one, two = (model(at[:, :12], unused, x0=start)[1] for start in starts)
        (slope,) = torch.autograd.grad((one[:, -1] - two[:, -1]).norm(dim=1).sum(), at)
        at = (at + 0.3 * reach * torch.sign(slope)).clamp(-reach, reach).detach()
    return at.numpy().transpose(1, 2, 0)


def test_trajectories_come_together_as_promised() -> None:
    assert worst_over_promise(900, 0) <= 1


@pytest.mark.slow
def test_a_hundred_thousand_pairs_come_together_as_promised() -> None:
    assert worst_over_promise(100_000, 1) <= 1


@pytest.mark.parametrize("kind", KINDS[4:])
def test_outputs_differ_by_no_more_than_the_gain(kind: tuple) -> None:
    random = np.random.default_rng(0)
    for seed in range(5):
        model = make(architecture(kind, gamma=1.0), seed)
        weights, b = Weights(model), 200
        u = random.standard_normal((150, 2, b)) * 10 ** random.uniform(-2, 2, b)
        others = u + random.standard_normal((150, 2, b)) * 10 ** random.uniform(-3, 1, b)
        start = random.standard_normal((3, b)), np.zeros((2, b))
        one, two = (weights.free_runs(each, start[1], start[0])[0] for each in (u, others))
        ratio = np.linalg.norm(one - two, axis=(0, 1)) / np.linalg.norm(u - others, axis=(0, 1))
        assert ratio.max() <= kind[2]
        assert ratio.max() > 0.02 * kind[2]  # it is no trivial bound


def test_a_folder_keeps_it(tmp_path: Any) -> None:
    model = make(architecture(KINDS[5]))
    model.save(tmp_path)
    from nnss_cli.methods import load_model

    again = load_model(tmp_path)
    u = np.random.default_rng(0).standard_normal((20, 2))
    np.testing.assert_array_equal(again.simulate(u, np.ones(2)).y, model.simulate(u, np.ones(2)).y)
    assert again.architecture == model.architecture


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"scheduling": "x+y"}, r"expected scheduling x or x\+u, found x\+y"),
        ({"hidden": (4, 4)}, "expected one hidden layer, found 2"),
        ({"gain": -1.0}, "gain: expected a positive bound"),
        ({"gain": float("nan")}, "gain: expected a positive bound"),
        ({"gain": 1.0, "integrator": True}, "gain: expected no integrator"),
        ({"gain": 1.0, "stability": "schur"}, "gain: expected stability incremental"),
    ],
)
def test_what_cannot_be_promised_is_refused(changes: dict, told: str) -> None:
    with pytest.raises(InputError, match=told):
        Architecture(**{"order": 2, "inputs": 1, "outputs": 1, "hidden": (4,), "stability": "incremental"} | changes)
