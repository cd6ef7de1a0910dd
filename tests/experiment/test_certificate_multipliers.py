"""Gain and rate of a slope-restricted layer by multipliers: what is proved is true, close, and of any order."""

import math
import time

import numpy as np
import pytest
from nnss_cli.baselines.statespace import LinearStateSpace

from nnss_cli.experiment.certificate import lmi, lti, multipliers
from nnss_cli.model.incremental import PlainArrays

LATER = math.inf  # no deadline


def layer(seed: int, n: int = 3, r: int = 2, m: int = 2, q: int = 4, size: float = 0.06) -> PlainArrays:
    """A layer that comes together, with units that see x and u and are seen by x and y."""
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= 0.8 / np.linalg.norm(A, 2)
    F, E = size * random.standard_normal((n, q)), random.standard_normal((m, q))
    G, H, B = (random.standard_normal(shape) for shape in ((q, n), (q, r), (n, r)))
    return PlainArrays(
        A, B, F, G, H, random.uniform(-2, 2, q), random.standard_normal((m, n)), random.standard_normal((m, r)), E
    )


def at(plain: PlainArrays, slopes: np.ndarray) -> LinearStateSpace:
    """The model with units of these slopes."""
    A, B, F, G, H, _, C, D, E = plain
    return LinearStateSpace(A + F * slopes @ G, B + F * slopes @ H, C + E * slopes @ G, D + E * slopes @ H, 1.0)


def corners(plain: PlainArrays, slopes: np.ndarray) -> list[LinearStateSpace]:
    q = len(slopes)
    return [at(plain, slopes * np.array([i >> k & 1 for k in range(q)])) for i in range(2**q)]


def test_secants_are_no_steeper_than_is_said() -> None:
    b = np.concatenate([np.linspace(-4, 4, 41), [1e-9, 8.0, 30.0, -700.0]])
    v = np.concatenate([np.geomspace(1e-3, 1500, 20_000), -np.geomspace(1e-3, 1500, 20_000)])[:, None]
    steepest = ((np.tanh(v + b) - np.tanh(b)) / v).max(axis=0)
    found = multipliers.steepest_secants(b)
    assert (found >= steepest).all()
    np.testing.assert_allclose(found, steepest, atol=1e-5)
    assert found[20] == pytest.approx(1.0)  # b = 0


def test_without_units_gain_and_rate_are_those_of_a_linear_model() -> None:
    pytest.importorskip("cvxpy")
    plain = layer(1)
    none = plain._replace(F=0 * plain.F, E=0 * plain.E)
    exact = lti.norm(at(none, np.zeros(4)))
    found = multipliers.gain(none, np.ones(4), LATER)
    assert found is not None
    assert exact.low <= found.number <= exact.low * 1.001
    radius = float(np.abs(np.linalg.eigvals(plain.A)).max())
    slowest = multipliers.rate(none, LATER)
    assert slowest is not None
    assert radius <= slowest.number <= radius + 0.01


@pytest.mark.system
@pytest.mark.parametrize("seed", range(3))
def test_what_is_proved_holds_at_all_slopes_and_is_close_to_what_they_reach(seed: int) -> None:
    pytest.importorskip("cvxpy")
    plain = layer(seed)
    for slopes in (np.ones(4), np.array([0.9, 0.5, 1.0, 0.2])):
        found = multipliers.gain(plain, slopes, LATER)
        assert found is not None
        reached = max(lti.norm(system).low for system in corners(plain, slopes))
        assert reached <= found.number <= 1.6 * reached
    slowest = multipliers.rate(plain, LATER)
    assert slowest is not None
    sizes = [np.linalg.norm(np.linalg.solve(slowest.S, s.A @ slowest.S), 2) for s in corners(plain, np.ones(4))]
    assert max(sizes) <= slowest.number < 1


@pytest.mark.parametrize("name", ["A", "B", "F", "G", "H", "C", "D", "E"])
def test_every_matrix_counts(name: str) -> None:
    """The norm for one layer says nothing of another: each matrix moves it, and rounding only adds to it."""
    plain, slopes = layer(5), np.array([0.9, 0.5, 1.0, 0.2])
    random = np.random.default_rng(0)
    S, weights, gamma = np.linalg.qr(random.standard_normal((3, 3)))[0] + 0.1, random.uniform(0.5, 2, 4), 3.0

    def exact(p: PlainArrays, rate: float | None) -> float:
        s, back, L = slopes, np.linalg.inv(S), np.diag(weights)
        inner, seen = np.concatenate([p.F, p.E]) * s / 2, np.concatenate([p.G, p.H], axis=1)
        outer = np.block([[p.A, p.B], [p.C, p.D]]) + inner @ seen
        K = np.block([
            [back @ outer[:3, :3] @ S, back @ outer[:3, 3:] / gamma, back @ inner[:3] / weights],
            [outer[3:, :3] @ S, outer[3:, 3:] / gamma, inner[3:] / weights],
            [L @ p.G @ S, L @ p.H / gamma, np.zeros((4, 4))],
        ])  # fmt: skip
        if rate is not None:
            K = np.delete(np.delete(K, [3, 4], axis=0), [3, 4], axis=1)
            K[:, :3] /= rate
        return float(np.linalg.norm(K, 2))

    moved = plain._replace(**{name: getattr(plain, name) + 0.1})
    for rate in (None, 0.9):
        sizes = []
        for p in (plain, moved):
            found = multipliers.norm(p, slopes, S, weights, gamma, rate)
            assert exact(p, rate) < found < exact(p, rate) * (1 + 1e-9)
            sizes.append(found)
        assert (sizes[0] != sizes[1]) == (rate is None or name in "AFG")


def test_a_gain_that_slopes_exceed_is_not_proved() -> None:
    pytest.importorskip("cvxpy")
    plain = layer(2)
    found = multipliers.gain(plain, np.ones(4), LATER)
    assert found is not None
    S, weights, least = multipliers._proposed(plain, np.ones(4), None, 1e-9, LATER)  # type: ignore[misc]
    assert multipliers.norm(plain, np.ones(4), S, weights, least * 1.01, None) <= 1
    assert multipliers.norm(plain, np.ones(4), S, weights, least * 0.99, None) > 1
    growing = plain._replace(A=1.3 * np.eye(3))
    assert multipliers.gain(growing, np.ones(4), LATER) is None
    assert multipliers.rate(growing, LATER) is None


def test_a_proposal_is_not_believed_without_its_inequality(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("cvxpy")
    monkeypatch.setattr(multipliers, "norm", lambda *_: 1.0 + 1e-15)
    assert multipliers.gain(layer(2), np.ones(4), LATER) is None
    assert multipliers.rate(layer(2), LATER) is None


def test_a_semidefinite_program_is_interrupted(monkeypatch: pytest.MonkeyPatch) -> None:
    cp = pytest.importorskip("cvxpy")
    random = np.random.default_rng(0)
    size = 20
    P = cp.Variable((size, size), symmetric=True)
    constraints = [P >> np.eye(size)]
    for _ in range(3):
        A = random.standard_normal((size, size))
        A *= 0.5 / np.linalg.norm(A, 2)
        constraints.append(P - A.T @ P @ A >> np.eye(size))
    problem = cp.Problem(cp.Minimize(cp.trace(P)), constraints)
    assert lmi.solved(problem)
    whole = problem.solver_stats.num_iters
    monkeypatch.setattr(time, "perf_counter", lambda: 5.0)  # a clock that stands: what is left is what is given
    assert lmi.solved(problem, 5.0 + 1000)
    assert not lmi.solved(problem, 5.0 + 1e-6)
    assert problem.status == cp.USER_LIMIT
    assert problem.solver_stats.num_iters < whole
    assert not lmi.solved(problem, 5.0)
