"""Prediction-error minimisation of the simulated error in data-driven local coordinates.

    min over (A, B, C, G[, D]) of  Σ_k |y(k) − ŷ(k)|²   (trace criterion)   or   K log det Λ   (several outputs)

for x(k+1) = A x + B u, ŷ = C x + D u, x(0) = G (y(0) − D u(0)). A model is scored from
x(0) = C⁺ (y(0) − D u(0)), so G takes the place of a free x(0): with C G = I there is a basis in
which C⁺ = G, and the scored initial state is the fitted one.

A full parametrisation has n² directions that only change the basis; each step is taken in the
orthogonal complement of these. Sources: L. Ljung, "System Identification", 2nd ed., 1999,
chapters 7 and 10; T. McKelvey, A. Helmersson and T. Ribarits, "Data driven local coordinates for
multivariable linear systems", Automatica 40(9), 2004.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from nnss_cli.baselines import kernels
from nnss_cli.baselines.n4sid import matlab_horizon, n4sid_candidates
from nnss_cli.baselines.statespace import LONG, LinearStateSpace, scored_residuals, simulation_rms, spectral_radius
from nnss_cli.baselines.subspace import BLOCK, inverse_root, triangularise
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.datasets.windows import beginnings

from nnss_cli.lock import compiling

Criterion: TypeAlias = Literal["trace", "det"]

CONSTRAINT = 1e3  # weight of C G = I against residuals of about one deviation
STARTS = 3  # candidates of the subspace grid that are refined, besides MATLAB's
LEAD = 10_000  # samples on which the starts for a longer record are refined first
SAME = 1e-5  # relative difference of the criterion below which two optima are one
CACHED = 2**17  # numbers of a block of sensitivities: they stay in the cache
TOLERANCE = 1e-3  # relative: an optimum counts as no worse than that of MATLAB's start


@dataclass(frozen=True, eq=False)
class _Point:
    """One point of the search."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    G: FloatArray
    D: FloatArray

    def vector(self, feedthrough: bool) -> FloatArray:
        parts = [self.A, self.B, self.C, self.G] + [self.D] * feedthrough
        return np.concatenate([part.ravel() for part in parts])

    def moved(self, step: FloatArray) -> _Point:
        parts, start = [], 0
        for part in (self.A, self.B, self.C, self.G, self.D):
            taken = step[start : start + part.size]
            start += part.size
            parts.append(part + taken.reshape(part.shape) if len(taken) else part)
        return _Point(*parts)

    def directions(self, Q: FloatArray) -> list[FloatArray]:
        """The columns of Q (parameters, P') as changes of A, B, C, G and D, each (P', rows, columns)."""
        parts, start = [], 0
        for part in (self.A, self.B, self.C, self.G, self.D):
            taken = Q[start : start + part.size]
            start += part.size
            parts.append(taken.T.reshape(-1, *part.shape) if len(taken) else np.zeros((Q.shape[1], *part.shape)))
        return parts

    def basis_directions(self, feedthrough: bool) -> FloatArray:
        """Columns: how the parameters move when the state's basis does (n² of them)."""
        n = len(self.A)
        columns = []
        for i in range(n):
            for j in range(n):
                T = np.zeros((n, n))
                T[i, j] = 1
                parts = [T @ self.A - self.A @ T, T @ self.B, -self.C @ T, T @ self.G]
                parts += [np.zeros_like(self.D)] * feedthrough
                columns.append(np.concatenate([part.ravel() for part in parts]))
        return np.array(columns).T


@dataclass
class _Problem:
    """Residuals and their derivatives for given records and criterion."""

    records: tuple[Record, ...]
    criterion: Criterion
    feedthrough: bool
    noise: float  # deviation of the residuals that the prior on G is weighed against

    def residuals(self, point: _Point) -> FloatArray | None:
        """y − ŷ of all records (K, m); None for an unstable point."""
        if spectral_radius(point.A) >= 1:
            return None
        parts = []
        for record in self.records:
            x0 = point.G @ (record.y[0] - point.D @ record.u[0])
            parts.append(np.empty_like(record.y))
            kernels.residuals(point.A, point.B, point.C, point.D, x0, record.u, record.y, parts[-1])
        e = np.concatenate(parts)
        return e if np.isfinite(e).all() else None

    def value(self, e: FloatArray, point: _Point) -> float:
        """Criterion plus constraint and prior."""
        extra = float(np.sum(self._extra(point) ** 2))
        if self.criterion == "trace":
            return float(np.sum(e**2)) + extra
        covariance = e.T @ e / len(e)
        floor = np.finfo(float).tiny * np.eye(len(covariance))
        return len(e) * float(np.linalg.slogdet(covariance + floor)[1]) + extra

    def _extra(self, point: _Point) -> FloatArray:
        """Rows for C G = I, and the prior: a unit output tells of states of unit size, not of huge ones."""
        scale = self.noise if self.criterion == "trace" else 1.0
        constraint = CONSTRAINT * scale * (point.C @ point.G - np.eye(len(point.C)))
        return np.concatenate([constraint.ravel(), scale * point.G.ravel()])

    def _extra_jacobian(self, point: _Point) -> FloatArray:
        n, m = point.G.shape
        scale = self.noise if self.criterion == "trace" else 1.0
        zero = np.zeros((m * m + n * m, point.A.size + point.B.size))
        d_C = CONSTRAINT * scale * np.kron(np.eye(m), point.G.T)
        d_G = CONSTRAINT * scale * np.kron(point.C, np.eye(m))
        first = np.concatenate([d_C, d_G], axis=1)
        second = np.concatenate([np.zeros((n * m, m * n)), scale * np.eye(n * m)], axis=1)
        parts = [zero, np.concatenate([first, second])]
        if self.feedthrough:
            parts.append(np.zeros((len(zero), point.D.size)))
        return np.concatenate(parts, axis=1)

    def linearise(self, point: _Point, e: FloatArray, Q: FloatArray) -> FloatArray:
        """R of [J Q, e], rows weighted by the criterion."""
        W = inverse_root(e) if self.criterion == "det" and len(point.C) > 1 else None

        def rows() -> Iterator[FloatArray]:
            for block in self._sensitivities(point, Q, np.eye(len(point.C)) if W is None else W):
                yield block.reshape(-1, block.shape[2])
            yield np.concatenate([self._extra_jacobian(point) @ Q, -self._extra(point)[:, None]], axis=1)

        return triangularise(rows())

    def _sensitivities(self, point: _Point, Q: FloatArray, weight: FloatArray) -> Iterator[FloatArray]:
        """W [∂ŷ along the columns of Q, y − ŷ], (k, m, P' + 1), block by block, for a weight W (m, m).

        Along a direction (dA, dB, dC, dG, dD)

            dx(k+1) = A dx(k) + dA x(k) + dB u(k),   dŷ(k) = C dx(k) + dC x(k) + dD u(k)

        so all of them are propagated side by side.
        """
        d_A, d_B, d_C, d_G, d_D = point.directions(Q)
        C, D = weight @ point.C, weight @ point.D
        driven = np.concatenate([d_A, d_B], axis=2).transpose(2, 1, 0)  # (n + r, n, P')
        seen = np.concatenate([d_C, d_D], axis=2).transpose(2, 1, 0)  # (n + r, m, P')
        seen = np.concatenate([weight @ seen, -np.hstack([C, D]).T[:, :, None]], axis=2)  # y − ŷ behind
        length = min(BLOCK, max(64, CACHED // driven[0].size))
        for record in self.records:
            u0 = record.u[0]
            v = record.y[0] - point.D @ u0
            x, state = point.G @ v, np.ascontiguousarray((d_G @ v - d_D @ u0 @ point.G.T).T)
            for start in range(0, len(record), length):
                u, y = record.u[start : start + length], record.y[start : start + length]
                z = np.empty((len(u), len(driven)))
                kernels.states_and_inputs(point.A, point.B, x, u, z)
                forced, block = (z @ M.reshape(len(M), -1) for M in (driven, seen))
                forced, block = forced.reshape(len(z), *driven.shape[1:]), block.reshape(len(z), *seen.shape[1:])
                block[:, :, -1] += y @ weight.T
                kernels.sensitivities(point.A, C, state, forced, block)
                state = np.where(np.abs(forced[-1]) < kernels.NOTHING, 0, forced[-1])
                yield block


def refine(
    start: LinearStateSpace,
    records: tuple[Record, ...],
    criterion: Criterion = "trace",
    feedthrough: bool = False,
    iterations: int = 100,
    tolerance: float = 1e-7,
) -> LinearStateSpace:
    """Levenberg–Marquardt from `start`, in a basis in which C⁺ gives the fitted initial state.

    Args:
        start: a stable model, in the units of the records.
        records: experiments.
        criterion: trace, or det for several outputs.
        feedthrough: estimate D as well; else it stays that of `start`.
        iterations: at most.
        tolerance: relative decrease of the criterion below which it has converged.

    Returns:
        A model whose criterion is not above that of `start` (with its initial state fitted).
    """
    point = _normalised(start, records)
    problem = _Problem(records, criterion, feedthrough, np.inf)
    e = problem.residuals(point)
    if e is None:
        return start
    # The prior on G is weighed against the residuals: as these fall, so does its weight.
    while 0 < (noise := float(np.sqrt(np.mean(e**2)))) < 0.5 * problem.noise:
        problem.noise = noise
        point, e = _levenberg_marquardt(problem, point, e, iterations, tolerance)
    return _scored_basis(point, start.Ts)


def _levenberg_marquardt(
    problem: _Problem, point: _Point, e: FloatArray, iterations: int, tolerance: float
) -> tuple[_Point, FloatArray]:
    """Descend from `point` with residuals `e` until the criterion falls by less than `tolerance`."""
    value = problem.value(e, point)
    damping = 1e-3
    for _ in range(iterations):
        U, s, _ = np.linalg.svd(point.basis_directions(problem.feedthrough))
        Q = U[:, int(np.sum(s > 1e-10 * s[0])) :]
        R = problem.linearise(point, e, Q)
        P = Q.shape[1]
        left, singular, right = np.linalg.svd(R[:P, :P])
        target = left.T @ R[:P, P]
        accepted = None
        for _ in range(30):
            step = right.T @ (singular * target / (singular**2 + damping * singular[0] ** 2))
            candidate = point.moved(Q @ step)
            moved = problem.residuals(candidate)
            if moved is not None and (lower := problem.value(moved, candidate)) < value:
                accepted = candidate, moved, lower
                break
            damping = max(damping, 1e-16) * 4
        if accepted is None:
            break
        # log det has no scale of its own: its decrease is compared with the number of samples
        scale = abs(value) if problem.criterion == "trace" else len(e)
        gain = (value - accepted[2]) / max(scale, np.finfo(float).tiny)
        point, e, value = accepted
        damping = max(damping / 6, 1e-16)
        if gain < tolerance:
            break
    return point, e


def _normalised(start: LinearStateSpace, records: tuple[Record, ...]) -> _Point:
    """`start` in a basis of unit state covariance, with G the best linear guess Σ Cᵀ (C Σ Cᵀ)⁻¹."""
    squares, samples = np.zeros((start.order, start.order)), sum(len(record) for record in records)
    for record in records:
        _, states = start.simulate(record.u, start.initial_state(record))
        squares += states.T @ states
    values, vectors = np.linalg.eigh(squares / samples)
    root = np.sqrt(np.maximum(values, values[-1] * 1e-10 + np.finfo(float).tiny))
    model = start.transform((vectors / root).T)
    return _Point(model.A, model.B, model.C, np.linalg.pinv(model.C), model.D)


def _scored_basis(point: _Point, Ts: float) -> LinearStateSpace:
    """The basis in which C⁺ = G: the columns of G and of the kernel of C become orthogonal."""
    m, n = point.C.shape
    model = LinearStateSpace(point.A, point.B, point.C, point.D, Ts)
    if m >= n:
        return model
    kernel = np.linalg.svd(point.C)[2][m:].T
    # exact C G = I; the constraint has brought it close
    G = point.G @ np.linalg.inv(point.C @ point.G)
    return model.transform(np.linalg.inv(np.concatenate([G, kernel], axis=1)))


def ssest(
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    order: int,
    feedthrough: bool = False,
    init_window: int = 1,
    starts: list[LinearStateSpace] | None = None,
) -> LinearStateSpace:
    """Refine several subspace models to convergence and choose one on validation.

    Started from MATLAB's n4sid and from the best of the grid of horizons by training error, with
    both criteria where there are several outputs. An optimum is eligible if its criterion is not above
    the one that MATLAB's start leads to; among these, validation decides, so that neither the fit
    is given up nor an overfitted optimum taken.

    Args:
        train: experiments, in normalised units.
        val: validation experiments.
        order: number of states n.
        feedthrough: estimate D as well.
        init_window: first samples of a validation experiment that tell x(0); see `scored_residuals`.
        starts: `subspace_starts` of these data, where they are known.

    Raises:
        InputError: the records are too short for the order.
    """
    starts = starts or subspace_starts(train, order)
    criteria: tuple[Criterion, ...] = ("trace", "det") if train[0].output_count > 1 else ("trace",)
    eligible = []
    for criterion in criteria:
        optima = [refine(start, train, criterion, feedthrough) for start in led(starts, train, criterion, feedthrough)]
        values = [criterion_value(model, train, criterion) for model in optima]
        bar = values[0] + TOLERANCE * (abs(values[0]) if criterion == "trace" else 1.0)
        eligible += [model for model, value in zip(optima, values, strict=True) if value <= bar]
    return min(eligible, key=lambda model: simulation_rms(model, val, init_window))


def subspace_starts(train: tuple[Record, ...], order: int) -> list[LinearStateSpace]:
    """MATLAB's n4sid, where the data allow its horizon, and the best of the grid by training error.

    Args:
        train: experiments, in normalised units.
        order: number of states n.

    Raises:
        InputError: the records are too short for the order.
    """
    candidates = dict(n4sid_candidates(train, order))
    matlab = matlab_horizon(order, train[0].input_count, train[0].output_count)
    ranked = sorted(candidates, key=lambda horizon: simulation_rms(candidates[horizon], train))
    # MATLAB's first: what it converges to is the bar for the others.
    chosen = dict.fromkeys([matlab, *ranked[:STARTS]])
    return [candidates[horizon] for horizon in chosen if horizon in candidates]


def led(
    starts: list[LinearStateSpace], train: tuple[Record, ...], criterion: Criterion, feedthrough: bool
) -> list[LinearStateSpace]:
    """Starts for records of more than twice `LEAD` samples: refined on their beginnings, two at most.

    A long record costs as much an iteration as all those that its beginning needs, and the starts mostly meet there.
    What MATLAB's becomes stays the first; the best of the others follows if it is another optimum and none the worse.
    Shorter records keep the starts as they are.

    Args:
        starts: models in normalised units.
        train: experiments.
        criterion: trace or det.
        feedthrough: estimate D as well.
    """
    if sum(len(record) for record in train) <= 2 * LEAD:
        return starts
    first = beginnings(train, LEAD, starts[0].order + 2)
    refined = [refine(start, first, criterion, feedthrough) for start in starts]
    values = [criterion_value(model, first, criterion) for model in refined]
    best = int(np.argmin(values))
    scale = abs(values[0]) if criterion == "trace" else 1.0
    return [refined[0]] if values[0] - values[best] <= SAME * scale else [refined[0], refined[best]]


@functools.cache
def warm_up() -> None:
    """Compile the loops, or read them from numba's cache, on a model of order 1."""
    one = np.ones((1, 1))
    u = np.random.default_rng(0).standard_normal(LONG)  # long enough for those of `propagate`
    with compiling(kernels.residuals):
        refine(LinearStateSpace(0.5 * one, one, one, 0 * one, 1.0), (Record(u, np.tanh(u), 1.0),), iterations=1)


def ssest_by_validation(
    train: tuple[Record, ...], val: tuple[Record, ...], order: int, init_window: int = 1
) -> LinearStateSpace:
    """Of `ssest` without and with feedthrough, the model that validates better; see there for the arguments."""
    starts = subspace_starts(train, order)
    models = [ssest(train, val, order, feedthrough, init_window, starts) for feedthrough in (False, True)]
    return min(models, key=lambda model: simulation_rms(model, val, init_window))


def criterion_value(model: LinearStateSpace, records: tuple[Record, ...], criterion: Criterion) -> float:
    """trace or log det of the residual covariance of scored simulations."""
    e = scored_residuals(model, records)
    covariance = e.T @ e / len(e)
    return float(np.trace(covariance) if criterion == "trace" else np.linalg.slogdet(covariance)[1])
