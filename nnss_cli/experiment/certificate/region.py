"""A region that no input of a box leaves: a polytope, proposed from samples, proved by branch and bound.

X = {c + T z: h_k·z ≤ β_k for all k} is never left, from any x(0) in it and under any inputs of the box, if at every
x = c + T z of it and every corner u of the box z₊ = T⁻¹(f(x, u) − c) has h_k·z₊ ≤ β_k. (f is affine in u, where u does
not schedule, so that the corners decide.) Each box of z must show h_k·z₊ ≤ β_k, or h_k·z₊ ≤ h_k·z, for each k: a box at
the rim pokes out of X, its image may too.

The proposal: the h_k are spread evenly, the β_k start a little outside of what simulations reached and grow as far as
the images of points of the rim ask for, until there is nothing left to grow (F. Blanchini and S. Miani,
"Set-theoretic methods in control", 2nd ed., 2015, ch. 5, for invariant polytopes).
"""

from __future__ import annotations

import itertools
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.elementary import Node
from nnss_cli.experiment.certificate.affine import EPS, OPERATIONS, Affine, over_boxes
from nnss_cli.experiment.certificate.branch import Proof, prove
from nnss_cli.experiment.certificate.dynamics import Dynamics

PRODUCT = Node("product", (), (0, 0))
FACES = {1: 2, 2: 32, 3: 120, 4: 240}  # by order
PART = 4096  # reached states whose heights are taken at once
RIM = 2000  # points of the rim that are looked at in a round
ROUNDS, TRIES = 400, 25
BACK, ALIKE = 60, 0.9995  # samples that normals go back; cosine above which two are one
FIRST, FARTHEST = 1.03, 4.0  # the faces' first and last distance, relative to what samples reach
CLEAR = 1e-4  # distance that images of the rim keep from a face, relative
SETTLED = 1e-6  # growth of a face that is none, relative
ROOM = 0.03  # by which the faces are moved out in the end, relative


@dataclass(frozen=True, eq=False)
class Region:
    """A polytope of states and a box of inputs, in normalised units."""

    centre: FloatArray
    """c (n,)."""
    shape: FloatArray
    """T (n, n), x = c + T z; X lies in |z_i| ≤ 1."""
    normals: FloatArray
    """h (k, n), those of |z_i| ≤ 1 among them."""
    offsets: FloatArray
    """β (k,), positive."""
    low: FloatArray
    """Least inputs (r,)."""
    high: FloatArray
    """Largest inputs (r,)."""

    @property
    def radius(self) -> float:
        """Bound on ‖x‖ in X."""
        reach = np.abs(self.centre) + np.abs(self.shape).sum(axis=1)
        return float(np.linalg.norm(reach)) * (1 + 1e-12)

    @property
    def corners(self) -> FloatArray:
        """Of the box of inputs (2^r, r), each once."""
        return np.unique(np.array(list(itertools.product(*zip(self.low, self.high, strict=True)))), axis=0)

    def points(self, z: FloatArray) -> FloatArray:
        """x (N, n) of z (N, n)."""
        return np.asarray(self.centre + z @ self.shape.T)

    def depth(self, centre: FloatArray, half: FloatArray) -> FloatArray:
        """Lower bound over boxes of z on the largest h_k·z/β_k, at most 1 in X; further dimensions do not count."""
        n = len(self.centre)
        z, width = centre[:, :n], half[:, :n]
        least = z @ self.normals.T - width @ np.abs(self.normals).T
        return np.asarray((least / self.offsets).max(axis=1)) - 1e-9

    def holds(self, x: FloatArray) -> bool:
        """Whether states x (N, n) lie inside for certain."""
        z = np.linalg.solve(self.shape, (x - self.centre).T).T
        return bool(((z @ self.normals.T) / self.offsets).max() <= 1 - 1e-6)

    def level(self, S: FloatArray) -> float:
        """Largest l such that {S z: ‖z‖ ≤ l} lies inside, a little less for rounding."""
        a = np.linalg.solve(self.shape.T, self.normals.T).T
        room = self.offsets + a @ self.centre
        return float((room / np.linalg.norm(a @ S, axis=1)).min()) * (1 - 1e-6)

    def rim(self, count: int, random: np.random.Generator) -> FloatArray:
        """Points z (count, n) of the rim: those along random directions and, half of them, near its corners."""
        d = random.standard_normal((count, len(self.centre)))
        picked = random.integers(0, len(self.normals), (count // 2, len(self.centre)))
        near = self.normals[picked[:, 0]]
        d[: count // 2] = near + 0.2 * d[: count // 2]
        return self.along(d)

    def along(self, d: FloatArray) -> FloatArray:
        """Points z (N, n) of the rim along directions d (N, n)."""
        with np.errstate(divide="ignore"):
            length = np.where((h := d @ self.normals.T) > 0, self.offsets / h, np.inf).min(axis=1, initial=np.inf)
        return np.asarray(d * length[:, None])

    def over(self, centre: FloatArray, half: FloatArray, d: int) -> Affine:
        """x over boxes of z; d − n further slopes belong to other dimensions."""
        n = len(self.centre)
        slopes = np.zeros((len(centre), n, d))
        slopes[:, :, :n] = self.shape[None] * half[:, None, :n]
        lost = 8 * n * EPS * (np.abs(self.centre) + np.abs(self.shape).sum(axis=1))
        found = over_boxes(self.points(centre[:, :n]), slopes)
        return Affine(found.c, found.l, found.r + lost[None, :, None])

    def inputs_over(self, centre: FloatArray, half: FloatArray, d: int) -> Affine:
        """u over boxes whose last r dimensions are [−1, 1] from `low` to `high`."""
        r = len(self.low)
        middle, width = (self.high + self.low) / 2, (self.high - self.low) / 2 * (1 + 4 * EPS)
        slopes = np.zeros((len(centre), r, d))
        slopes[:, :, d - r :] = np.eye(r) * (width * half[:, d - r :])[:, None, :]
        found = over_boxes(middle + width * centre[:, d - r :], slopes)
        return Affine(found.c, found.l, found.r + 8 * EPS * (np.abs(middle) + width)[None, :, None])


def inverse(T: FloatArray) -> Affine:
    """T⁻¹ with all rounding: S ≈ T⁻¹ and E = I − S T give |T⁻¹ − S| ≤ ‖E‖/(1 − ‖E‖) ‖S‖."""
    S = np.linalg.inv(T)
    n = len(T)
    E = np.abs(np.eye(n) - S @ T) + (n + 4) * EPS * (np.abs(S) @ np.abs(T) + 1)
    size = float(np.linalg.norm(E))
    off = size / (1 - size) * float(np.linalg.norm(S)) * (1 + 1e-9) if size < 1 else np.inf
    return Affine(S, np.zeros((1, n, n)), np.full((n, n), off))


def constant(a: FloatArray, d: int) -> Affine:
    """A column that does not depend on the box, exactly."""
    return Affine(a[None, :, None], np.zeros((d, 1, len(a), 1)), np.zeros((1, len(a), 1)))


def product(a: Affine | FloatArray, b: Affine | FloatArray) -> Affine:
    """Matrix product of enclosures."""
    if isinstance(a, Affine) and isinstance(b, Affine) and len(a.l) != len(b.l):  # an interval has no slopes
        d = max(len(a.l), len(b.l))
        a, b = (Affine(x.c, np.broadcast_to(x.l, (d, *x.l.shape[1:])) if len(x.l) == d else
                       np.zeros((d, *(1,) * (max(len(a.l.shape), len(b.l.shape)) - 1 - x.c.ndim), *x.c.shape)), x.r)
                for x in (a, b))  # fmt: skip
    return OPERATIONS["product"](PRODUCT, a, b)  # type: ignore[return-value]


def never_left(dynamics: Dynamics, region: Region, limit: int, deadline: float) -> Proof:
    """Prove that no input of the region's box leads out of it."""
    n, bends = dynamics.n, dynamics.bends
    d = n + dynamics.r * bends
    back = inverse(region.shape)
    boxes = 0
    proof = Proof(False, 0, np.zeros((0, d)))
    for corner in region.corners[: 1 if bends else None]:

        def check(centre: FloatArray, half: FloatArray, u: FloatArray = corner) -> Any:
            x = region.over(centre, half, d)
            inputs = region.inputs_over(centre, half, d) if bends else constant(u, d)
            moved = dynamics.over(dynamics.step, x, inputs)
            off = OPERATIONS["subtract"](PRODUCT, moved, region.centre[:, None])
            after = product(back, off)
            slopes = np.zeros((d, len(centre), n, 1))
            slopes[np.arange(n), :, np.arange(n), 0] = half[:, :n].T
            before = Affine(centre[:, :n, None], slopes, np.zeros((len(centre), n, 1)))
            rise = product(region.normals, OPERATIONS["subtract"](PRODUCT, after, before))
            level = product(region.normals, after)
            beyond = (level.c + level.spread())[:, :, 0] - region.offsets * (1 - EPS)
            bound = np.fmin(beyond, (rise.c + rise.spread())[:, :, 0]).max(axis=1)
            value = np.minimum(level.c[:, :, 0] - region.offsets, rise.c[:, :, 0]).max(axis=1) - 1e-9
            effect = np.abs(level.l[:, :, :, 0]).max(axis=2).T
            finite = np.isfinite(level.spread()).all(axis=(1, 2))
            return np.where(finite, bound, np.inf), np.where(finite, value, -1.0), effect + 1e-3 * half

        proof = prove(check, region.depth, d, limit - boxes, deadline)
        boxes += proof.boxes
        if not proof.proved:
            break
    return Proof(proof.proved, boxes, proof.against)


def invariant(
    dynamics: Dynamics, reached: FloatArray, low: FloatArray, high: FloatArray, random: np.random.Generator,
    limit: int, deadline: float,
) -> tuple[Region | None, int]:  # fmt: skip
    """A polytope that is proved never to be left, and the boxes it took; None where none was found.

    Points at which a proof fails move the faces, and it is tried again.

    Args:
        dynamics: the model.
        reached: states (N, n) that simulations under such inputs reached from 0, among them 0.
        low: least inputs.
        high: largest.
        random: for points.
        limit: most boxes.
        deadline: on `time.perf_counter`.
    """
    against = np.zeros((0, dynamics.n))
    hull = _hull(dynamics, reached, low, high)
    offsets: FloatArray | None = hull.offsets
    boxes = 0
    for _ in range(TRIES):
        assert offsets is not None
        offsets = _grown(
            dynamics, replace(hull, offsets=offsets), FARTHEST * hull.offsets.max(), against, random, deadline
        )
        if offsets is None or time.perf_counter() > deadline:
            return None, boxes
        region = _scaled(replace(hull, offsets=offsets))
        proof = never_left(dynamics, region, limit - boxes, deadline)
        boxes += proof.boxes
        if proof.proved:
            return region, boxes
        if not len(proof.against):
            return None, boxes
        off = (region.points(proof.against[:, : dynamics.n]) - hull.centre).T
        against = np.concatenate([against, np.linalg.solve(hull.shape, off).T])
    return None, boxes


def surrounding(dynamics: Dynamics, reached: FloatArray, low: FloatArray, high: FloatArray) -> Region:
    """A polytope closely around states that were reached; inputs may lead out of it."""
    return _scaled(_hull(dynamics, reached, low, high))


def _hull(dynamics: Dynamics, reached: FloatArray, low: FloatArray, high: FloatArray) -> Region:
    centre = (reached.max(axis=0) + reached.min(axis=0)) / 2
    T = np.linalg.cholesky(np.cov(reached.T).reshape(dynamics.n, dynamics.n) + 1e-9 * np.eye(dynamics.n))
    normals = _normals(dynamics, reached, T, (low + high) / 2)
    z = np.linalg.solve(T, (reached - centre).T).T
    # by parts, for all heights at once would be gigabytes
    heights = [(part @ normals.T).max(axis=0) for part in np.array_split(z, len(z) // PART + 1)]
    offsets = np.maximum(np.max(heights, axis=0), 1e-3)
    return Region(centre, T, normals, FIRST * offsets, low, high)


def _grown(
    dynamics: Dynamics, region: Region, farthest: float, against: FloatArray, random: np.random.Generator,
    deadline: float,
) -> FloatArray | None:  # fmt: skip
    """Offsets at which no point of the rim that is looked at leads out; None where they grow too far."""
    offsets, room = region.offsets, ROOM if not len(against) else ROOM / 100
    for _ in range(ROUNDS):
        if time.perf_counter() > deadline:
            return None
        tried = replace(region, offsets=offsets)
        x = tried.points(np.concatenate([tried.rim(RIM, random), tried.along(against)]))
        level = np.full(len(offsets), -np.inf)
        for u in tried.corners:
            moved = dynamics.at(dynamics.step, x, u)[:, :, 0] - tried.centre
            level = np.maximum(level, (np.linalg.solve(tried.shape, moved.T).T @ tried.normals.T).max(axis=0))
        if not np.isfinite(level).all() or (offsets > farthest).any():
            return None
        grown = np.maximum(level * (1 + CLEAR) - offsets, 0.0)
        if (grown <= SETTLED * offsets).all():
            return np.asarray(offsets * (1 + room))
        offsets = offsets + 3.0 * grown
    return None


def _scaled(region: Region) -> Region:
    """The same in coordinates with |z_i| ≤ 1, in which it is branched on."""
    n = len(region.centre)
    normals, offsets = region.normals, region.offsets
    size = np.array([offsets[(normals == sign * unit).all(axis=1)].max() for unit in np.eye(n) for sign in (1, -1)])
    scale = size.reshape(n, 2).max(axis=1)
    normals = normals * scale
    length = np.linalg.norm(normals, axis=1)
    return replace(region, shape=region.shape * scale, normals=normals / length[:, None], offsets=offsets / length)


def _normals(dynamics: Dynamics, reached: FloatArray, T: FloatArray, u: FloatArray) -> FloatArray:
    """Evenly spread ones, and those along which a face's height depends on the state some samples before.

    h·z₊ = (Fᵀh)·z + … asks for a face with the normal Fᵀh: closed under it, a linear model's polytope is exact.
    """
    n = dynamics.n
    some = reached[:: max(1, len(reached) // 200)]
    F = np.linalg.solve(T, dynamics.at(dynamics.tangent, some, u)[:, :n, :n].mean(axis=0) @ T)
    found = list(directions(n))
    for h in np.concatenate([np.eye(n), -np.eye(n)]):
        for _ in range(BACK):
            h = F.T @ h
            size = float(np.linalg.norm(h))
            if not size > 1e-9:
                break
            h = h / size
            if max(float(h @ other) for other in found) < ALIKE:
                found.append(h)
    return np.array(found)


def directions(n: int) -> FloatArray:
    """Unit vectors (k, n), evenly spread, those along the axes among them."""
    axes = np.concatenate([np.eye(n), -np.eye(n)])
    if n == 1:
        return axes
    if n == 2:
        angle: FloatArray = 2 * np.pi * np.arange(FACES[2]) / FACES[2]
        spread: FloatArray = np.column_stack([np.cos(angle), np.sin(angle)])
    elif n == 3:  # a Fibonacci lattice
        k = np.arange(FACES[3]) + 0.5
        height, angle = 1 - 2 * k / FACES[3], np.pi * (1 + 5**0.5) * k
        spread = np.column_stack([np.sqrt(1 - height**2) * f(angle) for f in (np.cos, np.sin)] + [height])
    else:
        spread = np.random.default_rng(0).standard_normal((FACES.get(n, 60 * n), n))
        spread /= np.linalg.norm(spread, axis=1, keepdims=True)
    return np.concatenate([axes, spread[~(np.abs(spread).max(axis=1) > 1 - 1e-9)]])
