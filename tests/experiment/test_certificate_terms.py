"""No term of a bound may be left out: each bound against exact fractions, or a model for which it is just enough."""

import math
import re
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nnss_cli.baselines.schur import schur_inverse
from nnss_cli.datasets.record import Channels, FloatArray, Scaling
from scipy.optimize import brentq

from nnss_cli.experiment.certificate import lti, multipliers
from nnss_cli.experiment.certificate import search as searched
from nnss_cli.experiment.certificate.branch import prove
from nnss_cli.experiment.certificate.dissipation import Storage, _proved, _Search
from nnss_cli.experiment.certificate.dynamics import Dynamics
from nnss_cli.experiment.certificate.region import Region, directions, surrounding
from nnss_cli.experiment.certificate.result import Gain
from nnss_cli.experiment.certificate.systems import Neural
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.incremental import Lure, PlainArrays
from nnss_cli.model.nnss import NNSS
from nnss_cli.system import Parts

LATER = math.inf  # no deadline
UNIT = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
LOW, HIGH = np.array([-1.0]), np.array([1.0])


def exact(M: Any) -> Any:
    return np.vectorize(Fraction, otypes=[object])(np.asarray(M))


def inverse(S: Any) -> Any:
    n = len(S)
    M = np.concatenate([S, exact(np.eye(n))], axis=1)
    for i in range(n):
        p = i + int(np.argmax([abs(x) for x in M[i:, i]]))
        M[[i, p]] = M[[p, i]]
        M[i] = M[i] / M[i, i]
        for j in set(range(n)) - {i}:
            M[j] = M[j] - M[j, i] * M[i]
    return M[:, n:]


def norm_is_at_most(M: Any, bound: float) -> bool:
    """Whether bound² I − MᵀM is positive definite, by elimination in fractions."""
    K = Fraction(bound) ** 2 * exact(np.eye(M.shape[1])) - M.T @ M
    while len(K):
        if K[0, 0] <= 0:
            return False
        K = K[1:, 1:] - np.outer(K[1:, 0], K[0, 1:]) / K[0, 0]
    return True


def nearly_singular(random: np.random.Generator, n: int) -> FloatArray:
    Q, _ = np.linalg.qr(random.standard_normal((n, n)))
    P, _ = np.linalg.qr(random.standard_normal((n, n)))
    return Q * np.logspace(0, -3, n) @ P


def test_norms_in_a_nearly_singular_basis_are_bounded_with_their_rounding() -> None:
    """S⁻¹AS has some ten digits there: without the remainder half of these would be no bounds."""
    random = np.random.default_rng(0)
    n, q, gamma, rate = 2, 2, 1.5, 0.9
    for _ in range(12):
        S, slopes, weights = nearly_singular(random, n), random.uniform(0.2, 1, q), random.uniform(1, 2, q)
        A = S @ np.linalg.qr(random.standard_normal((n, n)))[0] @ np.linalg.inv(S)
        B, F, G, H, C, D, E = (
            0.1 * random.standard_normal(size) for size in ((n, 1), (n, q), (q, n), (q, 1), (1, n), (1, 1), (1, q))
        )
        B, F = S @ B, S @ F
        plain = PlainArrays(A, B, F, G, H, np.zeros(q), C, D, E)
        T, s, L = exact(S), exact(slopes) / 2, exact(np.diag(weights))
        back, (A, B, F, G, H, _, C, D, E) = inverse(T), map(exact, plain)
        u, w = 1 / Fraction(gamma), inverse(L)
        linear = np.block([[back @ A @ T, back @ B * u], [C @ T, D * u]])
        inner, seen = np.concatenate([back @ F, E]) * s, np.concatenate([G @ T, H * u], axis=1)
        whole = np.block([[linear + inner @ seen, inner @ w], [L @ seen, exact(np.zeros((q, q)))]])
        states = whole[np.ix_([0, 1, 3, 4], [0, 1, 3, 4])]
        states[:, :n] /= Fraction(rate)
        for M, found in (
            (linear, lti.weighted_norm(np.block([[plain.A, plain.B], [plain.C, plain.D]]), S, gamma)),
            (linear[:n, :n], lti.weighted_norm(plain.A, S)),
            (whole, multipliers.norm(plain, slopes, S, weights, gamma, None)),
            (states, multipliers.norm(plain, slopes, S, weights, gamma, rate)),
        ):
            assert norm_is_at_most(M, found)
            assert not norm_is_at_most(M, found * 0.99)


def bowl() -> Dynamics:
    """x+ = A(x) x + B(x) u, y = x/2 + u/10, A = 0.1 + 0.2 x², B = 0.3 + 0.1 x²: all largest at |x| = 1."""
    parts = Parts(
        advance=lambda x, u, _: ((x * x * 0.2 + 0.1) * x + (x * x * 0.1 + 0.3) * u, x * 0.5 + u * 0.1),
        initial=None,
        frozen=lambda x, *_: (x * x * 0.2 + 0.1, x * x * 0.1 + 0.3, x * 0.0 + 0.5, x * 0.0 + 0.1),
        n=1, keeps_output=False, feedthrough=True,
    )  # fmt: skip
    return Dynamics.of(parts, 1, 1, False)


@pytest.mark.parametrize("S", [1.0, 0.7])
def test_what_a_box_leaves_beside_its_slopes_counts(S: float) -> None:
    """In the middle of the region the slopes are 0, and so small that the first box would be proved."""
    dynamics, region = bowl(), Region(np.zeros(1), np.eye(1), directions(1), np.ones(2), LOW, HIGH)

    def gain(gamma: float) -> float:
        return float(np.linalg.norm([[0.3, 0.4 / gamma / S], [0.5 * S, 0.1 / gamma]], 2))

    least = brentq(lambda gamma: gain(gamma) - 1, 0.1, 10)
    for program, of_gain, number in (
        (dynamics.frozen, False, 0.3),
        (dynamics.tangent, False, 0.1 + 0.6 + 0.2),  # d/dx (A x + B u) at x = u = 1
        (dynamics.frozen, True, least),
    ):
        search = _Search(dynamics, program, region, of_gain)
        for share, expected in ((1.001, True), (0.999, False)):
            _, against = _proved(search, np.array([[S]]), share * number, HIGH, 10_000, LATER)
            assert (against is not None and not len(against)) == expected


def plane(A: Any = ((0.5, 0.2), (0.0, 0.6))) -> Dynamics:
    A, B = np.array(A), np.ones((2, 1))
    parts = Parts(
        advance=lambda x, u, _: (x.constant(A) @ x + x.constant(B) @ u, x[:1, :]), initial=None,
        frozen=lambda x, *_: (x.constant(A), x.constant(B), x.constant(np.eye(1, 2)), x.constant(np.zeros((1, 1)))),
        n=2, keeps_output=False, feedthrough=False,
    )  # fmt: skip
    return Dynamics.of(parts, 1, 1, False)


def test_the_size_and_the_levels_of_a_region_count_its_centre() -> None:
    random = np.random.default_rng(0)
    region = surrounding(plane(), random.uniform((-1, -3), (8, 1), (4000, 2)), LOW, HIGH)
    assert np.linalg.norm(region.centre) > 3
    rim = np.linalg.norm(region.points(region.rim(20_000, random)), axis=1).max()
    assert rim <= region.radius <= 1.5 * rim
    angle = np.linspace(0, 2 * np.pi, 5000)
    for S in (np.eye(2), np.array([[1.0, 0.0], [0.9, 0.3]])):
        ellipse = region.level(S) * np.column_stack([np.cos(angle), np.sin(angle)]) @ S.T
        z = np.linalg.solve(region.shape, (ellipse - region.centre).T).T
        assert 1 - 1e-4 <= ((z @ region.normals.T) / region.offsets).max() <= 1


def test_a_box_whose_centre_alone_lies_outside_is_not_dropped() -> None:
    """What holds in all boxes but those is proved of no region: nearly all of its rim is in such boxes."""
    random = np.random.default_rng(0)
    region = Region(np.zeros(2), np.eye(2), directions(2), random.uniform(0.5, 1.0, 32), LOW, HIGH)
    centre, half = random.uniform(-1.5, 1.5, (300, 2)), random.uniform(0, 0.6, (300, 2))
    inside = centre + half * random.uniform(-1, 1, (400, 300, 2))
    reached = ((inside @ region.normals.T) / region.offsets).max(axis=2).min(axis=0)
    assert (region.depth(centre, half) <= reached).all()
    assert np.sum((region.depth(centre, 0 * half) > 1) & (reached <= 1)) > 20
    at_points = ((centre @ region.normals.T) / region.offsets).max(axis=1)
    np.testing.assert_allclose(region.depth(centre, 0 * half), at_points, atol=1e-8)  # and it is no trivial bound


@pytest.mark.parametrize("angle", [0.3, 0.7, 1.1])
def test_what_holds_but_in_a_corner_of_a_region_is_not_proved(angle: float) -> None:
    """Of a turned square: z1 is at most that of its outermost corner, and not a thousandth less."""
    turned = np.array([[np.cos(angle + k * np.pi / 2), np.sin(angle + k * np.pi / 2)] for k in range(4)])
    square = Region(np.zeros(2), np.eye(2), turned, np.full(4, 0.7), LOW, HIGH)
    corner = 0.7 * (np.cos(angle) + np.sin(angle))
    for limit, holds in ((corner * 1.001, True), (corner * 0.999, False)):

        def check(centre: FloatArray, half: FloatArray, limit: float = limit) -> Any:
            beyond = centre[:, 0] - limit
            return beyond + half[:, 0], beyond - 1e-9, half * [1.0, 1e-3]

        assert prove(check, square.depth, 2, 20_000, LATER).proved == holds


def test_a_region_without_the_state_of_rest_says_nothing_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    elsewhere = Region(np.full(1, 3.0), np.eye(1), directions(1), np.ones(2), LOW, HIGH)
    monkeypatch.setattr(searched, "_reached", lambda *_: np.zeros((1, 1)))
    monkeypatch.setattr(searched, "invariant", lambda *_: (elsewhere, 1))
    monkeypatch.setattr(searched, "surrounding", lambda *_: elsewhere)
    system: Any = SimpleNamespace(integrates=False)
    random = np.random.default_rng(0)
    assert searched._region(system, bowl(), LOW, HIGH, LATER, random)[0] is None
    monkeypatch.setattr(searched, "storage", lambda *_: (Storage(2.0, np.eye(1), 1), ""))
    assert searched._of_small_energy(system, bowl(), LOW, HIGH, UNIT, LATER, random).status == "unknown"


def test_inputs_of_the_energy_that_is_said_do_not_leave_the_region() -> None:
    """x+ = a x + u, a = 0.8 where weak inputs lead and 1.2 beyond: what leads there is never small again."""
    pytest.importorskip("cvxpy")
    limit = 0.5 / (1 - 0.8) * 1.04  # a little more than |u| ≤ 0.5 reaches

    def a(x: Any) -> Any:
        return (x * x * 40.0 + -40.0 * limit**2).sigmoid() * 0.4 + 0.8

    parts = Parts(
        advance=lambda x, u, _: (a(x) * x + u, x), initial=None,
        frozen=lambda x, *_: (a(x), x.constant(np.eye(1)), x.constant(np.eye(1)), x.constant(np.zeros((1, 1)))),
        n=1, keeps_output=False, feedthrough=False,
    )  # fmt: skip
    dynamics = Dynamics.of(parts, 1, 1, False)

    def run(u: FloatArray, _: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        x = np.empty((len(u), *x0.shape))
        x[0] = x0
        for k in range(1, len(u)):
            x[k] = dynamics.at(dynamics.step, x[k - 1].T, u[k - 1].T)[:, :, 0].T
        return x, x

    system: Any = SimpleNamespace(run=run, integrates=False, architecture=SimpleNamespace(order=1, outputs=1))
    found = searched._of_small_energy(system, dynamics, LOW, HIGH, UNIT, LATER, np.random.default_rng(0))
    assert found.status == "proved", found.how
    assert found.bound is not None
    energy = float(re.findall(r"‖u‖₂ ≤ (\S+) in", found.holds_for)[0])
    best = 0.8 ** np.arange(60.0)[::-1]  # the weakest way to any state
    for share, stays in ((0.999, True), (limit / (energy * np.linalg.norm(best)) * 1.1, False)):
        u = np.concatenate([share * energy * best / np.linalg.norm(best), np.zeros(60)])
        y, _ = run(u[:, None, None], np.zeros((1, 1)), np.zeros((1, 1)))
        assert (np.linalg.norm(y) <= found.bound * np.linalg.norm(u)) == stays
    assert energy * np.linalg.norm(best) > 0.7 * limit  # and it is not much less than could be said


def steep(bias: float) -> NNSS:
    """x+ = 0.3 x + 0.3 u1 + 0.5 (tanh(x + 0.4 u1 + bias) − tanh(bias)), y1 = x, of two inputs and outputs.

    Where the unit has slope 1 its pole is 0.8, its gain (0.3 + 0.5·0.4)/(1 − 0.8) = 2.5.
    """
    a = Architecture(1, 2, 2, (1,), (2,), "x+u", dtype="float64", stability="incremental", gamma=1.0)
    scaling = Scaling(np.zeros(2), np.array([0.5, 4.0]), np.zeros(2), np.array([3.0, 1.0]))
    model = NNSS(a, scaling, Channels(("u", "v"), ("y", "z"), ("", ""), ("", "")), 1.0)
    layer = model.generator
    assert isinstance(layer, Lure)
    first = np.array([[1.0, 0.0]])
    layer.place(
        PlainArrays(
            np.array([[0.3]]), 0.3 * first, np.array([[0.5]]), np.ones((1, 1)), 0.4 * first, np.array([bias]),
            first.T, np.zeros((2, 2)), np.zeros((2, 1)),
        ),
        np.array([2.0]),
    )  # fmt: skip
    return model


def of_layer(model: NNSS, size: float) -> Any:
    system = Neural(model)
    begun = searched.not_searched(system, system.output_bounds(), model.scaling, "")
    high = np.array([size, 0.0])
    return searched._of_layer(system, begun, model.scaling, -high, high, LATER)


def test_a_layers_bounds_are_just_what_its_steepest_slopes_reach() -> None:
    pytest.importorskip("cvxpy")
    gain, differences, together, state = of_layer(steep(0.0), 0.01)
    for each in (gain, differences):
        assert 2.5 <= each.bound <= 2.5 * 1.01
        assert each.bound_physical == pytest.approx(each.bound * 3.0 / 0.5)  # y1 by u1, in their units
    assert 0.8 <= together.value <= 0.81
    assert 2.5 * 0.01 <= state.value <= 1.05 * 2.5 * 0.01  # which is reached by a held input, but for tanh's bend

    model = steep(2.0)  # at rest the unit is nearly saturated; inputs about −1.6 bring it to its steepest
    gain, differences, *_ = of_layer(model, 3.0)
    assert gain.bound < 2.0
    x, u = -2 + 0.4 * 1.5827, -1.5827
    held = np.full((4000, 2, 2), 0.0)
    held[:, 0] = u
    held[200:2200, 0, 1] += 1e-3
    y, _ = Neural(model).run(held, np.zeros((2, 2)), np.full((1, 2), x))
    reached = np.linalg.norm(y[:, 0, 0] - y[:, 0, 1]) / np.linalg.norm(held[:, 0, 0] - held[:, 0, 1])
    assert reached > 2.49
    assert reached <= differences.bound <= 2.5 * 1.01


@pytest.mark.parametrize(("low", "high", "said"), [(0.5, 1.0, "[0, 1]"), (-1.0, -0.5, "[-1, 0]")])
def test_rest_is_among_the_inputs_of_every_claim(
    low: float, high: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Records whose inputs never rest, and x+ = −0.8 x + u, y = (1 + σ(x)/1000) x, which swings further then."""
    a = Architecture(1, 1, 1, (1,), (1,), dtype="float64", stability="schur")
    model = NNSS(a, UNIT, Channels(("u",), ("y",), ("",), ("",)), 1.0)
    last: Any = model.generator[2]
    with torch.no_grad():
        model.generator[0].weight.fill_(1.0)
        last.bias.copy_(
            torch.from_numpy(np.concatenate([*map(np.ravel, schur_inverse(np.array([[-0.8]]))), [1.0, 1.0]]))
        )
        last.weight[-1] = 1e-3
    nothing = Gain("unknown", None, None, None, None, None, "", "")
    for name, found in (
        ("_gain", nothing),
        ("_attacked", nothing),
        ("_rate", None),
        ("_pairs", searched.not_searched(Neural(model), (1.0, 1.0, 0.0), UNIT, "").incremental),
    ):  # only the region is asked for
        monkeypatch.setattr(searched, name, lambda *_, found=found: found)
    system, ends = Neural(model), (np.array([low]), np.array([high]))
    state = searched.search(system, system.output_bounds(), UNIT, *ends, 0.8, 3.0, LATER).state
    assert state is not None
    assert state.holds_for == f"x(0) = 0, inputs within {said} (the records' range)"
    assert state.value is not None
    assert 1 / (1 - 0.8**2) <= state.value <= 1.2 / (1 - 0.8**2)  # reached by an end and rest in turn


@pytest.mark.parametrize(
    ("pairs", "told"),
    [
        ([0.2717, 0.1], "after 60 samples a distance was 0.2717 times what it began with, at most"),
        ([], "no pair stayed finite for 60 samples"),
    ],
)
def test_what_pairs_of_trajectories_came_to_is_told_as_it_is(
    pairs: list[float], told: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A distance that shrank did not grow."""
    found = [SimpleNamespace(growth=growth) for growth in pairs]
    monkeypatch.setattr(searched.attack, "widest_pair", lambda *_: found)
    monkeypatch.setattr(searched, "two_equilibria", lambda *_: None)
    system = SimpleNamespace(in_elementary_operations=lambda: None, run=None)
    statement = searched._pairs(system, None, np.zeros(1), np.ones(1), 1.0)  # type: ignore[arg-type]
    assert (statement.status, statement.value) == ("unknown", None)
    assert statement.how == f"attack on pairs: no two equilibria under one input were found; {told}"
