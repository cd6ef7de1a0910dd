"""Proofs over regions: enclosures enclose, what is false is not proved, what is proved is close to what is true."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from conftest import slow_but
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.elementary import NUMPY, Node
from nnss_cli.experiment.certificate import attack, certify, lti
from nnss_cli.experiment.certificate import search as searched
from nnss_cli.experiment.certificate.affine import OPERATIONS, Affine, over_boxes
from nnss_cli.experiment.certificate.branch import prove
from nnss_cli.experiment.certificate.dissipation import _proved, _Search, storage
from nnss_cli.experiment.certificate.dynamics import Dynamics
from nnss_cli.experiment.certificate.equilibria import equilibrium
from nnss_cli.experiment.certificate.region import Region, directions, invariant, inverse, never_left, surrounding
from nnss_cli.experiment.certificate.result import Gain
from nnss_cli.experiment.certificate.statements import of_one_matrix, small_gain
from nnss_cli.experiment.certificate.systems import Neural
from nnss_cli.model.architecture import STABILITIES, Architecture
from nnss_cli.model.incremental import Lure
from nnss_cli.model.nnss import NNSS
from nnss_cli.system import Parts

UNIT = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
CHANNELS = Channels(("u",), ("y",), ("",), ("",))
LATER = math.inf  # no deadline


def model_of(seed: int, stability: str, n: int, scheduling: str = "x", feedthrough: bool = True) -> NNSS:
    a = Architecture(
        n, 1, 1, (5,), (3,), scheduling, 0.9, dtype="float64", stability=stability, feedthrough=feedthrough
    )
    model = NNSS(a, UNIT, CHANNELS, 1.0)
    random = np.random.default_rng(seed)
    model.initialise(random)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.from_numpy(0.4 * random.standard_normal(tuple(parameter.shape))))
    return model


def dynamics_of(model: NNSS) -> Dynamics:
    found = Neural(model).dynamics()
    assert isinstance(found, Dynamics)
    return found


def linear_dynamics(A: Any, B: Any, C: Any, D: Any) -> Dynamics:
    A, B, C, D = (np.atleast_2d(np.array(M, dtype=float)) for M in (A, B, C, D))
    parts = Parts(
        advance=lambda x, u, _: (x.constant(A) @ x + x.constant(B) @ u, x.constant(C) @ x + x.constant(D) @ u),
        initial=None,
        frozen=lambda x, *_: tuple(x.constant(M) for M in (A, B, C, D)),
        n=len(A), keeps_output=False, feedthrough=True,
    )  # fmt: skip
    return Dynamics.of(parts, B.shape[1], len(C), False)


def interval(reach: float, low: float = -1.0, high: float = 1.0) -> Region:
    """|x| ≤ reach."""
    return Region(np.zeros(1), np.array([[reach]]), directions(1), np.ones(2), np.array([low]), np.array([high]))


@pytest.mark.system
@pytest.mark.parametrize("scheduling", slow_but((1,), ["x", "x+u"]))
@pytest.mark.parametrize("stability", STABILITIES)
def test_enclosures_hold_the_program_at_every_point(stability: str, scheduling: str) -> None:
    random = np.random.default_rng(3)
    for n in (1, 2, 3):
        dynamics = dynamics_of(model_of(n, stability, n, scheduling))
        centre, half = 2 * random.standard_normal((20, n)), 10 ** random.uniform(-6, -0.5, (20, n))
        slopes = np.zeros((20, n, n + 1))
        slopes[:, np.arange(n), np.arange(n)] = half
        x = over_boxes(centre, slopes)
        along_u = np.zeros((n + 1, 20, 1, 1))
        along_u[n] = 0.01
        u = Affine(np.full((20, 1, 1), 0.3), along_u, np.zeros((20, 1, 1)))
        narrow = 0
        for program in (dynamics.step, dynamics.frozen, dynamics.tangent):
            found = dynamics.over(program, x, u)
            s = random.uniform(-1, 1, (200, 20, n + 1))
            s[:40] = np.sign(s[:40])
            for k in range(200):
                value = dynamics.at(program, centre + half * s[k, :, :n], 0.3 + 0.01 * s[k, :, n:])
                off = np.abs(value - found.c - np.einsum("nd,dnij->nij", s[k], found.l))
                assert not (off > found.r).any()  # where a box is too wide, there is no number
            narrow += int((found.r < 0.1).sum())
        assert narrow > 30  # and they say something


def test_enclosures_fall_with_the_square_of_the_box() -> None:
    dynamics = dynamics_of(model_of(0, "schur", 2))
    sizes = []
    for h in (1e-2, 1e-3):
        x = over_boxes(np.array([[0.3, -0.2]]), h * np.eye(2)[None])
        u = Affine(np.zeros((1, 1, 1)), np.zeros((2, 1, 1, 1)), np.zeros((1, 1, 1)))
        sizes.append(float(dynamics.over(dynamics.frozen, x, u).r.max()))
    assert 50 < sizes[0] / sizes[1] < 200


@pytest.mark.parametrize("name", ["multiply", "divide", "root", "sigmoid", "product"])
def test_each_operation_alone_and_over_wide_boxes(name: str) -> None:
    random = np.random.default_rng(1)
    node = Node(name, (), (2, 2))
    for _ in range(50):
        d, size = 2, 10 ** random.uniform(-3, 1)
        parts = [
            Affine(random.uniform(1, 3, (2, 2)) * random.choice([1, 1 if name == "root" else -1]),
                   size * random.uniform(-1, 1, (d, 2, 2)), size * random.uniform(0, 0.1, (2, 2)))
            for _ in range(1 if name in ("root", "sigmoid") else 2)
        ]  # fmt: skip
        found = OPERATIONS[name](node, *parts)
        assert isinstance(found, Affine)
        for _ in range(100):
            s = random.uniform(-1, 1, d)
            values = [p.c + np.tensordot(s, p.l, 1) + p.r * random.uniform(-1, 1, (2, 2)) for p in parts]
            with np.errstate(invalid="ignore"):
                off = np.abs(NUMPY[name](node, *values) - found.c - np.tensordot(s, found.l, 1))
            assert (~np.isfinite(off) | (off <= found.r)).all()


@pytest.mark.parametrize("scheduling", ["x", "x+u"])
@pytest.mark.parametrize("stability", STABILITIES)
def test_derivatives_of_programs_are_those_of_the_complex_step(stability: str, scheduling: str) -> None:
    model = model_of(5, stability, 3, scheduling)
    dynamics, system = dynamics_of(model), Neural(model).in_elementary_operations()
    random = np.random.default_rng(0)
    x, u = random.standard_normal((10, 3)), random.standard_normal((10, 1))
    F, G, H, J = attack.jacobians(system, x, u)
    expected = np.concatenate([np.concatenate([F, G], axis=2), np.concatenate([H, J], axis=2)], axis=1)
    np.testing.assert_allclose(dynamics.at(dynamics.tangent, x, u), expected, rtol=1e-10, atol=1e-12)


def test_branch_and_bound_proves_what_holds_and_nothing_else() -> None:
    def parabola(level: float) -> Callable:
        def check(centre: np.ndarray, half: np.ndarray) -> tuple:
            size = np.abs(centre) + half
            return (size**2).sum(axis=1) - level, (centre**2).sum(axis=1) - level, half

        return check

    def disc(centre: np.ndarray, half: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.maximum(np.abs(centre) - half, 0), axis=1)

    assert prove(parabola(1.02), disc, 2, 100_000, LATER).proved  # true in the disc, false in the square
    failed = prove(parabola(0.98), disc, 2, 100_000, LATER)
    assert not failed.proved
    assert (np.linalg.norm(failed.against, axis=1) ** 2 > 0.98 - 1e-3).all()
    assert len(failed.against)
    assert not prove(parabola(1.02), disc, 2, 50, LATER).proved  # too few boxes
    assert not prove(parabola(1.02), disc, 2, 100_000, time.perf_counter() - 1).proved
    nothing = prove(lambda c, h: (np.full(len(c), np.nan), np.zeros(len(c)), h), disc, 2, 100_000, LATER)
    assert not nothing.proved


def test_an_inverse_is_enclosed() -> None:
    T = np.array([[1.0, 1.0], [1.0, 1.0 + 1e-6]])
    found = inverse(T)
    exact = np.array([[1 + 1e-6, -1.0], [-1.0, 1.0]]) / ((1 + 1e-6) - 1.0)
    assert (np.abs(found.c - exact) <= found.r).all()
    assert 0 < found.r.max() < 1e3


def test_the_region_of_a_linear_model_is_its_reachable_set() -> None:
    dynamics = linear_dynamics(0.9, 1.0, 1.0, 0.0)  # from 0, |u| ≤ 1 reaches every |x| < 10
    for reach, expected in ((10.01, True), (9.99, False), (20.0, True)):
        assert never_left(dynamics, interval(reach), 10_000, LATER).proved == expected
    assert not never_left(dynamics, interval(10.01, high=1.01), 10_000, LATER).proved  # each corner of u counts
    assert not never_left(dynamics, interval(10.01, low=-1.01), 10_000, LATER).proved
    reached = np.linspace(-9.8, 9.8, 200)[:, None]
    ends = np.array([-1.0]), np.array([1.0])
    found, _ = invariant(dynamics, reached, *ends, np.random.default_rng(0), 10_000, LATER)
    assert found is not None
    assert found.holds(np.array([[9.99], [-9.99]]))
    assert found.radius < 11
    A = np.array([[0.9, 0.3], [-0.3, 0.8]])
    turning = linear_dynamics(A, [[1.0], [0.0]], [[1.0, 0.0]], 0.0)
    states = np.zeros((50, 2))
    for k in range(1, 50):
        states[k] = A @ states[k - 1] + [1.0 if k // 5 % 2 else -1.0, 0.0]
    found, _ = invariant(turning, states, *ends, np.random.default_rng(0), 100_000, LATER)
    assert found is not None
    x = np.zeros((500, 2))
    random = np.random.default_rng(1)
    for _ in range(300):
        x = x @ A.T + np.array([1.0, 0.0]) * np.sign(random.uniform(-1, 1, (500, 1)))
        z = np.linalg.solve(found.shape, (x - found.centre).T).T
        assert ((z @ found.normals.T) <= found.offsets * (1 + 1e-9)).all()


@pytest.mark.system
def test_a_storage_function_bounds_the_gain_and_no_smaller_one_is_proved() -> None:
    # x+ = a x + u, y = x + d u: the gain is 1/(1 − a) + d, reached by held inputs
    dynamics = linear_dynamics(0.9, 1.0, 1.0, 0.5)
    random = np.random.default_rng(0)
    for program in (dynamics.frozen, dynamics.tangent):
        found, why = storage(dynamics, program, interval(10.01), True, 10_000, LATER, random)
        assert found is not None, why
        assert 10.5 <= found.number <= 10.5 * 1.1
        _, bad = _proved(_Search(dynamics, program, interval(10.01), True), found.S, 10.49, np.ones(1), 10_000, LATER)
        assert bad is None or len(bad)
        found, why = storage(dynamics, program, interval(10.01), False, 10_000, LATER, random)
        assert found is not None, why
        assert 0.9 <= found.number < 0.95


def bent(gamma: float = 0.99, low: float = 0.0, high: float = 0.9, b: float = 0.5) -> NNSS:
    """x+ = a(x) x + b u with |a| < γ rising from `low` to `high` at x = 2: the slope of a(x) x is beyond 1 there."""
    a = Architecture(1, 1, 1, (1,), (1,), dtype="float64", stability="contraction", gamma=gamma)
    model = NNSS(a, UNIT, CHANNELS, 1.0)
    ends = [(share / gamma) / math.sqrt(1 - (share / gamma) ** 2) for share in (low, high)]  # W = [1 w; 0 1]
    with torch.no_grad():
        model.generator[0].weight.fill_(8.0)
        model.generator[0].bias.fill_(-16.0)
        model.generator[2].bias.copy_(torch.tensor([1.0, ends[0], 0.0, 1.0, 0.0, b, 1.0]))
        model.generator[2].weight[1] = ends[1] - ends[0]
        model.encoder[0].weight.fill_(1.0)
        model.encoder[1].weight.fill_(1.0)
    return model


def record(level: float = 1.0, K: int = 60) -> Record:
    random = np.random.default_rng(0)
    return Record(random.uniform(-level, level, (K, 1)), 0.1 * np.ones((K, 1)), 1.0)


@pytest.mark.slow
def test_a_model_that_is_stable_quadratically_and_not_incrementally() -> None:
    pytest.importorskip("cvxpy")
    model = bent()
    found = certify(model, {"train": (record(),)}, steps=0, budget=4)
    assert found.statement("quadratic").status == "proved"
    refuted = found.statement("incremental")
    assert refuted.status == "refuted"
    assert "Krawczyk" in refuted.how
    assert refuted.value is not None
    assert refuted.value > 1
    assert found.incremental_gain.status == "unknown"
    assert found.incremental_gain.bound is None
    # the pair: two states that a constant input holds apart for ever
    dynamics = dynamics_of(model)
    u = np.array([1.0])
    ends = [equilibrium(dynamics, np.array([x0]), u) for x0 in (0.5, 5.0)]
    assert ends[0] is not None
    assert ends[1] is not None
    for x, margin in ends:
        moved = dynamics.at(dynamics.step, x[None], u)[0, :, 0]
        assert abs(moved - x) <= 2 * margin
        assert margin < 1e-6
    assert abs(ends[0][0] - ends[1][0]) > 3
    # a model without the bend has one equilibrium, and its differences are proved to vanish
    tame = certify(bent(high=0.1), {"train": (record(),)}, steps=0, budget=30)
    assert tame.statement("incremental").status == "proved"
    assert tame.incremental_gain.status == "proved"
    assert tame.incremental_gain.bound is not None


def test_no_equilibrium_is_proved_where_there_is_none() -> None:
    shift = linear_dynamics(1.0, 1.0, 1.0, 0.0)  # x+ = x + u
    assert equilibrium(shift, np.array([0.3]), np.array([1.0])) is None
    assert equilibrium(linear_dynamics(0.5, 1.0, 1.0, 0.0), np.array([7.0]), np.array([1.0])) is not None


@pytest.mark.slow
def test_what_is_proved_of_a_gain_is_reached_by_the_attack() -> None:
    pytest.importorskip("cvxpy")
    model = bent(low=0.2, high=0.5)
    scaling = Scaling(np.zeros(1), np.full(1, 4.0), np.ones(1), np.full(1, 0.5))
    for name in ("u_std", "y_std", "y_mean"):
        getattr(model, name).copy_(torch.from_numpy(getattr(scaling, name)))
    given = Record(4 * record().u, record().y, 1.0)
    found = certify(model, {"train": (given,)}, steps=0, budget=20)
    gain = found.gain
    assert gain.status == "proved"
    assert gain.bound is not None
    assert gain.attack is not None
    assert gain.attack <= gain.bound
    assert gain.tightness == pytest.approx(gain.attack / gain.bound)
    assert gain.tightness > 0.5
    assert gain.bound_physical == pytest.approx(gain.bound / 8)
    assert gain.attack_physical == pytest.approx(gain.attack / 8)
    assert "x(0) = 0" in gain.holds_for
    assert "records' range" in gain.holds_for
    # at the frozen end of the range, the gain is b/(1 − a): the bound cannot be below what held inputs show at rest
    assert gain.bound >= 0.5 / (1 - 0.2)
    # the bound holds, in its units, for inputs of its range
    random = np.random.default_rng(1)
    for _ in range(20):
        u = np.clip(np.repeat(random.uniform(-6, 6, (40, 1)), 10, axis=0), -4, 4) * found.input_bound
        y = model.simulate(u * 0 + u / found.input_bound * 0.9, np.array([1.0])).y
        assert np.linalg.norm(y - 1.0) <= gain.bound_physical * np.linalg.norm(u / found.input_bound * 0.9) * (1 + 1e-9)


def test_weak_inputs_stay_where_the_storage_function_was_proved() -> None:
    dynamics = linear_dynamics(0.9, 1.0, 1.0, 0.0)
    reached = np.linspace(-3, 3, 100)[:, None]
    region = surrounding(dynamics, reached, np.array([-1.0]), np.array([1.0]))
    found, _ = storage(dynamics, dynamics.frozen, region, True, 10_000, LATER, np.random.default_rng(0))
    assert found is not None
    level = region.level(found.S)
    assert float(np.abs(found.S[0, 0]) * level) == pytest.approx(3 * 1.03, rel=1e-3)  # the rim, from within
    # the weakest input that leads to the rim has the energy of the reachability Gramian, and that is allowed no more
    assert level / found.number <= 3.1 * math.sqrt(1 - 0.9**2)


def test_an_attack_is_not_held_against_a_bound_for_weaker_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    weak = Gain("proved", 9.0, 9.0, None, None, None, "x(0) = 0, ‖u‖₂ ≤ 0.1", "")
    monkeypatch.setattr(searched, "_region", lambda *_: (None, 1.0))
    monkeypatch.setattr(searched, "_of_small_energy", lambda *_: weak)
    found = certify(bent(gamma=1.0), {"train": (record(),)}, steps=0, budget=1).gain
    assert (found.bound, found.holds_for) == (9.0, weak.holds_for)
    assert found.attack is not None
    assert found.tightness is None


@pytest.mark.parametrize("pole", [0.5, -0.9, 0.999])
def test_the_norm_of_a_linear_model_is_exact(pole: float) -> None:
    system = LinearStateSpace(np.array([[pole]]), np.ones((1, 1)), np.array([[2.0]]), np.zeros((1, 1)), 1.0)
    exact = 2 / (1 - abs(pole))
    found = lti.norm(system)
    assert found.high is not None
    assert found.low <= exact <= found.high
    assert found.high == pytest.approx(exact, rel=1e-5)
    proved = lti.lyapunov(system.A)
    assert proved is not None
    assert abs(pole) <= proved[0] < abs(pole) + 1e-4


@pytest.mark.parametrize(("B", "C", "D"), [(1e-200, 1e-200, 0), (1e-160, 1e-165, 0), (1e200, 1e200, 0), (1, 1, 1e200)])
def test_of_numbers_whose_products_vanish_or_overflow_nothing_is_proved(B: float, C: float, D: float) -> None:
    """A response that is 0 by rounding alone is no proof of 0."""
    one = np.ones((1, 1))
    found = lti.norm(LinearStateSpace(0.999999 * one, B * one, C * one, D * one, 1.0))
    assert (found.low, found.high) == (0.0, None)


def test_a_norm_is_zero_where_the_matrices_say_so() -> None:
    one, none = np.ones((1, 1)), np.zeros((1, 1))
    for B, C in ((none, one), (one, none), (1e-200 * one, none)):
        assert lti.norm(LinearStateSpace(0.5 * one, B, C, none, 1.0)).high == 0
    for B in (none, one):  # the feedthrough alone, and with the state
        found = lti.norm(LinearStateSpace(0.5 * one, B, one, 3 * one, 1.0)).high
        assert found == pytest.approx(3 + 2 * B.item(), rel=1e-5)
    chain, first, last = np.diag([0.5, 0.8, 0.2]), np.array([[2.0], [0.0], [0.0]]), np.array([[0.0, 0.0, 4.0]])
    assert lti.norm(LinearStateSpace(chain, first, last, none, 1.0)).high == 0  # no input reaches the output
    chain[1, 0] = chain[2, 1] = 0.1
    found = lti.norm(LinearStateSpace(chain, first, last, none, 1.0)).high  # by way of all three states
    assert found == pytest.approx(2 * 0.1 * 0.1 * 4 / (0.5 * 0.2 * 0.8), rel=1e-5)
    equal = LinearStateSpace(0.5 * np.eye(2), np.ones((2, 1)), np.array([[1.0, -1.0]]), none, 1.0)
    assert lti.norm(equal).high is None  # what cancels may do so by rounding


def test_the_norm_is_that_of_the_frequency_response() -> None:
    random = np.random.default_rng(2)
    for n in (2, 4):
        A = random.standard_normal((n, n))
        A *= 0.97 / np.abs(np.linalg.eigvals(A)).max()
        parts = (random.standard_normal(shape) for shape in ((n, 2), (3, n), (3, 2)))
        system = LinearStateSpace(A, *parts, 1.0)
        found = lti.norm(system)
        sizes = lti.response(system, np.linspace(0, np.pi, 20_000))
        assert found.high is not None
        assert sizes.max() <= found.high
        assert found.low <= sizes.max() * (1 + 1e-4)
        assert found.high <= sizes.max() * (1 + 1e-3)


def test_statements_of_linear_models_are_exact_and_those_of_unstable_ones_refuted() -> None:
    def of(pole: float, model: Any = None) -> Any:
        system = LinearStateSpace(np.array([[pole]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
        scaling = Scaling(np.zeros(1), np.full(1, 4.0), np.zeros(1), np.full(1, 0.5))
        return certify(LinearModel(system, scaling, CHANNELS), {"train": (record(4.0),)}, steps=0)

    found = of(0.9)
    assert {each.status for each in found.statements} == {"proved"}
    assert [each.name for each in found.statements] == ["frozen", "quadratic", "state", "incremental"]
    assert found.statement("quadratic").claim.endswith(" for u = 0")  # under u = 1 it grows from x(0) = 0
    assert found.statement("quadratic").holds_for == "every x(0)"
    assert found.gain == found.incremental_gain
    assert found.gain.bound == pytest.approx(10, rel=1e-5)
    assert found.gain.bound_physical == pytest.approx(10 / 8, rel=1e-5)
    assert found.gain.tightness == pytest.approx(1, rel=1e-5)
    bound = found.statement("state").value
    assert bound is not None
    assert 10 * found.input_bound <= bound <= 10.1 * found.input_bound  # reached by a held input
    for pole in (1.05, -1.0001):
        unstable = of(pole)
        assert {each.status for each in unstable.statements} == {"refuted"}
        assert unstable.gain.bound is None
        assert unstable.gain.status == "unknown"
    assert {each.status for each in of(1.0).statements} == {"unknown"}  # on the circle, rounding decides
    twice = LinearStateSpace(
        np.array([[3.0, -1.0], [4.0, -1.0]]), np.ones((2, 1)), np.ones((1, 2)), np.zeros((1, 1)), 1.0
    )
    radius, margin = lti.spectral_radius(twice.A)  # 1, and 1 again: found 3e-8 beyond it
    assert 1 < radius < 1 + margin
    assert {each.status for each in of_one_matrix(twice, 1.0)} == {"unknown"}


def test_a_model_whose_matrices_do_not_vary_gets_the_exact_answer() -> None:
    model = bent(low=0.4, high=0.4)
    constant = Neural(model).constant()
    assert constant is not None
    assert constant.A[0, 0] == pytest.approx(0.4, abs=1e-3)
    found = certify(model, {"train": (record(),)}, steps=0)
    assert found.gain.status == found.statement("incremental").status == "proved"
    assert found.gain.bound == pytest.approx(0.5 / (1 - constant.A[0, 0]), rel=1e-5)
    assert "only one" in found.lyapunov
    with torch.no_grad():
        model.generator[2].weight[5] = 1e-3  # B varies
    assert Neural(model).constant() is None
    with torch.no_grad():
        model.generator[0].weight.fill_(0.0)  # with nothing
    assert Neural(model).constant() is not None


def test_without_a_region_what_follows_by_construction_stays_and_the_rest_is_unknown() -> None:
    found = certify(bent(gamma=0.95), {"train": (record(),)}, steps=0)  # no budget
    assert found.gain.status == "proved"
    assert found.gain.bound == pytest.approx(found.C_bound * found.B_bound / 0.05 + found.D_bound)
    assert found.gain.holds_for == "x(0) = 0, every input"
    assert found.statement("incremental").status == "unknown"
    schur = certify(model_of(0, "schur", 2), {"train": (record(),)}, steps=0, search_lyapunov=False)
    assert schur.statement("frozen").status == "proved"
    assert schur.statement("quadratic").status == schur.statement("state").status == schur.gain.status == "unknown"
    assert schur.gain.how == "not searched"


@pytest.mark.usefixtures("weak_adversary")
def test_states_found_from_a_window_are_covered_and_said_to_be() -> None:
    model = bent(gamma=0.95, low=0.85)
    with torch.no_grad():
        model.encoder[1].weight.fill_(0.0)  # the encoder says 0 whatever it sees
    u = np.zeros((40, 1))
    far = 3.0 * 0.87 ** np.arange(40)[:, None]  # about as the model moves from x(0) = 3
    given = {"test": (Record(u + 0.01 * np.sin(np.arange(40))[:, None], far, 1.0),)}
    alone, found = certify(model, given, steps=100), certify(model, given, steps=100, init_window=5)
    assert alone.initial_state == pytest.approx(0.0, abs=1e-9)
    assert found.initial_state == pytest.approx(3, rel=0.1)
    assert alone.state_bound is not None
    assert found.state_bound is not None
    assert alone.state_bound < found.initial_state <= found.state_bound
    assert found.state["test"] == pytest.approx(found.initial_state)
    assert found.broken == ()
    assert "found from their first 5 samples" in found.holds_for
    assert "first" not in alone.holds_for
    assert all(run.state >= found.initial_state * (1 - 1e-9) for run in found.stress)
    system = LinearStateSpace(np.array([[0.9]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    linear = certify(LinearModel(system, UNIT, CHANNELS), given, steps=0, init_window=5)
    assert linear.initial_state == pytest.approx(3, rel=0.05)


def test_a_gain_below_the_norm_is_not_proved() -> None:
    system = LinearStateSpace(np.array([[0.9]]), np.ones((1, 1)), np.array([[2.0]]), np.zeros((1, 1)), 1.0)
    assert lti._bounded_real(system, 20 * 1.001, 1e-3)
    assert not lti._bounded_real(system, 20 * 0.999, 1e-3)
    assert lti.weighted_norm(np.array([[0.9, 1.0], [2.0, 0.0]]), np.eye(1), 20.0) > 1  # with another S it is not shown


def test_the_small_gain_counts_every_term() -> None:
    assert small_gain(0.9, 2.0, 3.0, 0.5) == pytest.approx(60.5)


@pytest.mark.parametrize("scheduling", ["x", "x+u", "x+y", "x+u+y"])
def test_adjoint_gradients_are_those_of_differences(scheduling: str) -> None:
    model = model_of(1, "schur", 2, scheduling)
    neural = Neural(model)
    system = neural.in_elementary_operations()
    random = np.random.default_rng(0)
    u, x0, last = (random.standard_normal(shape) for shape in ((8, 1, 2), (2, 2), (2, 2)))

    def cost(u: np.ndarray, x0: np.ndarray) -> float:
        y, x = neural.run(u, np.zeros((1, 2)), x0)
        after = neural.next_state(x[-1], u[-1], y[-2])
        return 0.5 * float((y**2).sum()) + float((last * after).sum())

    y, x = neural.run(u, np.zeros((1, 2)), x0)
    of_u, of_x = attack.gradients(system, u, y, x, y, last)
    for at in ((0, 0, 0), (3, 0, 1), (7, 0, 0)):
        step = np.zeros_like(u)
        step[at] = 1e-6
        assert of_u[at] == pytest.approx((cost(u + step, x0) - cost(u - step, x0)) / 2e-6, rel=1e-5, abs=1e-7)
    step = np.zeros_like(x0)
    step[1, 0] = 1e-6
    assert of_x[1, 0] == pytest.approx((cost(u, x0 + step) - cost(u, x0 - step)) / 2e-6, rel=1e-5, abs=1e-7)


def test_the_riccati_equation_is_not_believed_without_its_inequality(monkeypatch: pytest.MonkeyPatch) -> None:
    system = LinearStateSpace(np.array([[0.9]]), np.ones((1, 1)), np.array([[2.0]]), np.zeros((1, 1)), 1.0)
    monkeypatch.setattr(lti, "weighted_norm", lambda *_: 1.0 + 1e-15)
    assert not lti._bounded_real(system, 20 * 1.001, 1e-3)


def incremental_model(gain: float = 0.0, n: int = 2, gamma: float = 0.9) -> NNSS:
    architecture = Architecture(
        n, 1, 1, hidden=(4,), encoder=(2,), dtype="float64", stability="incremental", gamma=gamma, gain=gain
    )
    one = np.ones(1)
    scaling = Scaling(0 * one, 2 * one, 0 * one, 3 * one)
    model = NNSS(architecture, scaling, Channels(("u",), ("y",), ("",), ("",)), 1.0)
    model.initialise(np.random.default_rng(1))
    return model


def noise() -> Record:
    random = np.random.default_rng(0)
    return Record(random.uniform(-2, 2, (80, 1)), random.uniform(-1, 1, (80, 1)), 1.0)


def test_what_an_incremental_layer_has_by_construction_is_said_to_be_proved() -> None:
    for gain in (0.0, 2.0):
        found = certify(incremental_model(gain), {"train": (noise(),)}, steps=0)
        together = found.statement("incremental")
        assert (together.status, together.value) == ("proved", 0.9)
        assert found.broken == ()
        differences = found.incremental_gain
        if gain:
            assert (differences.status, differences.bound) == ("proved", 2.0)
            assert differences.bound_physical == pytest.approx(2.0 * 3 / 2)
            assert found.gain.bound is not None
            assert found.gain.bound <= 2.0
            assert "--gain" in differences.how
        else:
            assert (differences.status, differences.bound) == ("unknown", None)


@pytest.mark.system
@pytest.mark.parametrize(("n", "gain", "gamma"), slow_but((0,), [(2, 0.0, 0.9), (2, 2.0, 0.9), (6, 0.0, 1.0)]))
def test_an_incremental_layer_gets_a_gain_for_every_input_that_was_not_asked_for(
    n: int, gain: float, gamma: float
) -> None:
    pytest.importorskip("cvxpy")
    model = incremental_model(gain, n, gamma)
    with torch.no_grad():
        for parameter in model.generator.parameters():
            parameter.add_(torch.from_numpy(0.6 * np.random.default_rng(3).standard_normal(tuple(parameter.shape))))
    found = certify(model, {"train": (noise(),)}, steps=0, budget=20)  # which ends before, however busy the machine
    assert found.broken == ()
    rest, differences = found.gain, found.incremental_gain
    for each, where in ((rest, "x(0) = 0, every input"), (differences, "one x(0) for both, every two inputs")):
        assert (each.status, each.holds_for) == ("proved", where)
        assert "multiplier" in each.how
        assert each.bound is not None
        assert each.attack is not None
        assert 0.3 * each.bound < each.attack <= each.bound
        assert each.tightness == pytest.approx(each.attack / each.bound)
        assert each.bound_physical == pytest.approx(each.bound * 3 / 2)
    assert rest.bound <= differences.bound  # type: ignore[operator]
    assert rest.attack <= differences.attack  # type: ignore[operator]
    if gain:
        assert differences.bound < gain  # type: ignore[operator]
    together, state = found.statement("incremental"), found.statement("state")
    assert together.value is not None
    assert (together.status, together.value < 1) == ("proved", True)
    assert ("S⁻¹" in together.claim) == (gamma == 1)  # else the construction says it of the model's own states
    assert state.status == "proved"
    assert state.value is not None
    # pairs of trajectories far apart, under inputs beyond the records' range
    random = np.random.default_rng(0)
    u = 30 * random.standard_normal((200, 1, 2)) * np.exp(random.uniform(-3, 0, (1, 1, 2)))
    y, x = Neural(model).run(u, np.zeros((1, 2)), np.zeros((n, 2)))
    for one, other in ((y[:, :, 0], u[:, :, 0]), (y[:, :, 1], u[:, :, 1])):
        assert np.linalg.norm(one) <= rest.bound * np.linalg.norm(other)  # type: ignore[operator]
    moved, off = y[:, :, 0] - y[:, :, 1], u[:, :, 0] - u[:, :, 1]
    assert np.linalg.norm(moved) <= differences.bound * np.linalg.norm(off)  # type: ignore[operator]
    inside = u / np.abs(u).max() * found.input_bound
    _, x = Neural(model).run(inside, np.zeros((1, 2)), np.zeros((n, 2)))
    assert np.linalg.norm(x, axis=1).max() <= state.value


def test_nothing_is_proved_by_a_layer_whose_promise_does_not_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Lure, "promised_norm", lambda _: 1.0)
    found = certify(incremental_model(2.0), {"train": (noise(),)}, steps=0)
    assert any("layer's promise" in line for line in found.broken)
    assert found.statement("incremental").status == "unknown"
    assert (found.gain.bound, found.incremental_gain.bound) == (None, None)
