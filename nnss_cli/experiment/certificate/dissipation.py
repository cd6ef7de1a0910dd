"""One quadratic storage function for all matrices over a region: proposed by an LMI, proved by branch and bound.

With x = S z and V(x) = ‖z‖², and with [A, B; C, D] that of the model at a point (or its Jacobians, for differences of
trajectories), V(Ax + Bu) − V(x) ≤ γ²‖u‖² − ‖Cx + Du‖² for all x and u says just

    ‖ [S⁻¹AS, S⁻¹B/γ; CS, D/γ] ‖₂ ≤ 1

and with the first block alone, divided by a rate, V(Ax) ≤ rate² V(x). S comes from an LMI over points, to which those
where the proof fails are added; of γ and S nothing is believed but what the proof bears out.
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.elementary import Program
from nnss_cli.experiment.certificate import lmi
from nnss_cli.experiment.certificate.affine import Affine
from nnss_cli.experiment.certificate.branch import prove
from nnss_cli.experiment.certificate.dynamics import Dynamics
from nnss_cli.experiment.certificate.region import Region, constant, inverse, product

FIRST, ADDED = 60, 24  # points of the LMI: at first, and added where it fails
SAMPLED = 3000  # points that a proposal must hold at before it is proved
ROUNDS = 12
# shares of the decay that are left for the enclosures' excess: the first costs less, the second is proved sooner
ROOM = (0.04, 0.2)
LARGER = 1.01  # the γ that is proved, relative to the LMI's


@dataclass(frozen=True, eq=False)
class Storage:
    """What was proved over a region."""

    number: float
    """γ, or the rate."""
    S: FloatArray
    """x = S z, V(x) = ‖z‖² (n, n)."""
    boxes: int
    """Boxes enclosed."""


@dataclass(frozen=True, eq=False)
class _Search:
    dynamics: Dynamics
    program: Program
    region: Region
    gain: bool  # γ, else the rate

    @property
    def by_corner(self) -> bool:
        """Whether the matrices are affine in u rather than scheduled by it or free of it."""
        return self.program is self.dynamics.tangent and not self.dynamics.bends

    @property
    def corners(self) -> FloatArray:
        return self.region.corners if self.by_corner else self.region.corners[:1]

    def matrices(self, z: FloatArray, u: FloatArray) -> FloatArray:
        """[A, B; C, D] (N, n + m, n + r) at points of the region, z (N, n) or (N, n + r) where u schedules."""
        n = self.dynamics.n
        if self.dynamics.bends:
            u = (self.region.high + self.region.low) / 2 + (self.region.high - self.region.low) / 2 * z[:, n:]
        return self.dynamics.at(self.program, self.region.points(z[:, :n]), u)


def storage(
    dynamics: Dynamics, program: Program, region: Region, gain: bool, limit: int, deadline: float,
    random: np.random.Generator,
) -> tuple[Storage | None, str]:  # fmt: skip
    """The smallest γ, or rate below 1, for which a storage function is found and proved over a region.

    Args:
        dynamics: the model.
        program: its `frozen` or `tangent`.
        region: proved not to be left, if the result is to speak of trajectories.
        gain: search γ; else the rate.
        limit: most boxes.
        deadline: on `time.perf_counter`.
        random: for points.

    Returns:
        It, or None and why.
    """
    search = _Search(dynamics, program, region, gain)
    reason = "no time was left"
    best: Storage | None = None
    for room in ROOM:
        found, reason = _attempt(search, room, limit, deadline, random)
        if found is not None:
            return found, ""
        if time.perf_counter() > deadline:
            break
    return best, reason


def _attempt(
    search: _Search, room: float, limit: int, deadline: float, random: np.random.Generator
) -> tuple[Storage | None, str]:
    points = _points(FIRST, search, random)
    blocks = np.concatenate([search.matrices(points, u) for u in search.corners])
    boxes = 0
    for _ in range(ROUNDS):
        if time.perf_counter() > deadline:
            return None, "the time was over"
        proposed = _proposed(search, blocks, room, deadline)
        if proposed is None:
            if time.perf_counter() > deadline:
                return None, "the time was over"
            return None, f"no storage function for {len(blocks)} sampled points"
        number, S = proposed
        samples = _points(SAMPLED, search, random)
        worst = []
        for u in search.corners:
            own = search.matrices(samples, u)
            sizes = np.linalg.norm(_weighted(own, S, number, search), 2, axis=(1, 2))
            order = np.argsort(-sizes)[: ADDED // len(search.corners) + 1]
            worst.append(own[order][sizes[order] > 1])
        if sum(map(len, worst)):
            blocks = np.concatenate([blocks, *worst])
            continue
        against = []
        for u in search.corners:
            proof, bad = _proved(search, S, number, u, limit - boxes, deadline)
            boxes += proof
            if bad is None:
                break
            against.append(bad)
            if len(bad):
                break
        if bad is None:
            return None, f"not decided with {boxes} boxes"
        if not len(against[-1]):
            return Storage(number, S, boxes), ""
        blocks = np.concatenate([blocks, against[-1]])
    return None, f"after {ROUNDS} rounds there were still points against it"


def _points(count: int, search: _Search, random: np.random.Generator) -> FloatArray:
    """In the region, a third of them on its rim, and in the box of u where it schedules."""
    n, r = search.dynamics.n, search.dynamics.r * search.dynamics.bends
    size = random.uniform(0, 1, (count, 1)) ** (1 / n)
    size[::3] = 1.0
    return np.concatenate([size * search.region.rim(count, random), random.uniform(-1, 1, (count, r))], axis=1)


def _weighted(blocks: FloatArray, S: FloatArray, number: float, search: _Search) -> FloatArray:
    n = search.dynamics.n
    A, B, C, D = blocks[:, :n, :n], blocks[:, :n, n:], blocks[:, n:, :n], blocks[:, n:, n:]
    inside = np.linalg.inv(S)
    if not search.gain:
        return np.asarray(inside @ A @ S / number)
    top = np.concatenate([inside @ A @ S, inside @ B / number], axis=2)
    return np.concatenate([top, np.concatenate([C @ S, D / number], axis=2)], axis=1)


def _proposed(search: _Search, blocks: FloatArray, room: float, deadline: float) -> tuple[float, FloatArray] | None:
    """γ (or the rate), a little above the LMI's, and S."""
    import cvxpy as cp

    n = search.dynamics.n
    decay = 1 - float(np.abs(np.linalg.eigvals(blocks[:, :n, :n])).max()) ** 2
    if decay <= 0:
        return None
    size = blocks.shape[2]
    first = np.eye(n, size)
    P = cp.Variable((n, n), symmetric=True)

    def solved(problem: cp.Problem) -> FloatArray | None:
        if not lmi.solved(problem, deadline):
            return None
        return lmi.factor(P)

    if search.gain:
        square = cp.Variable()
        level = np.zeros((size, size))
        level[n:, n:] = np.eye(size - n)
        constraints = [P >> 1e-9 * np.eye(n)]
        for M in blocks:
            top, bottom = M[:n], M[n:]
            kept = (1 - room * decay) * (first.T @ P @ first) - top.T @ P @ top
            constraints.append(kept + square * level - bottom.T @ bottom >> 0)
        S = solved(cp.Problem(cp.Minimize(square), constraints))
        if S is None or square.value is None or not square.value > 0:
            return None
        return float(np.sqrt(square.value)) * LARGER, S
    low, high, best = float(np.sqrt(1 - decay)), 1.0, None
    while high - low > 0.02 * (1 - low) + 1e-6 or best is None:
        rate = (low + high) / 2 if best is not None else 1.0 - 1e-6
        t = cp.Variable()
        constraints = [P >> np.eye(n), P << t * np.eye(n)]
        constraints += [rate**2 * P - M[:n, :n].T @ P @ M[:n, :n] >> 0 for M in blocks]
        S = solved(cp.Problem(cp.Minimize(t), constraints))
        if S is None:
            if best is None:
                return None
            low = rate
        else:
            high, best = rate, S
    rate = 1 - (1 - room) * (1 - high)
    return rate, best


def _proved(
    search: _Search, S: FloatArray, number: float, u: FloatArray, limit: int, deadline: float
) -> tuple[int, FloatArray | None]:
    """Boxes used, and the matrices where it fails: none of them where it is proved, None where nothing was decided."""
    dynamics, region = search.dynamics, search.region
    n, bends = dynamics.n, dynamics.bends
    d = n + dynamics.r * bends
    outputs, inputs = dynamics.m * search.gain, dynamics.r * search.gain
    back, right = inverse(S), np.zeros((n + inputs, n + inputs))
    right[:n, :n] = S if search.gain else S / number
    right[n:, n:] = np.eye(inputs) / number
    c, r = (np.zeros((1, n + outputs, n + outputs)) for _ in range(2))
    c[0, :n, :n], r[0, :n, :n] = back.c, back.r
    c[0, n:, n:] = np.eye(outputs)
    left = Affine(c, np.zeros((d, *c.shape)), r)
    vertices = np.array(list(itertools.product((1.0, -1.0), repeat=d)))

    def check(centre: FloatArray, half: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        x = region.over(centre, half, d)
        at = region.inputs_over(centre, half, d) if bends else constant(u, d)
        blocks = dynamics.over(search.program, x, at)
        if not search.gain:
            blocks = Affine(blocks.c[:, :n, :n], blocks.l[:, :, :n, :n], blocks.r[:, :n, :n])
        found = product(product(left, blocks), right)
        finite = np.asarray(np.isfinite(found.spread()).all(axis=(1, 2)))
        c, slopes, rest = (np.where(finite[:, None, None], part, 1e9) for part in (found.c, found.l, found.r))
        # a norm is largest in a corner of what is affine
        corners = [np.linalg.norm(c + np.tensordot(v, slopes, 1), 2, axis=(1, 2)) for v in vertices]
        bound = (np.max(corners, axis=0) + np.linalg.norm(rest, axis=(1, 2))) * (1 + 1e-12) - 1
        value = np.linalg.norm(c, 2, axis=(1, 2)) - 1 - 1e-9
        effect = np.linalg.norm(slopes, axis=(2, 3)).T + 1e-3 * half
        return np.where(finite, bound, np.inf), np.where(finite, value, -1.0), np.where(finite[:, None], effect, np.inf)

    proof = prove(check, region.depth, d, limit, deadline)
    if proof.proved:
        return proof.boxes, np.zeros((0, dynamics.n + dynamics.m, dynamics.n + dynamics.r))
    return proof.boxes, search.matrices(proof.against, u) if len(proof.against) else None
