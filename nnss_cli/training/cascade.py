"""Start an incrementally stable layer at two linear parts with tanh units between them (a Wiener–Hammerstein model).

    x₂(k+1) = A₂ x₂ + B₂ u,   x₁(k+1) = A₁ x₁ + A₁₂ x₂ + B₁ u + F₁ z,   z = tanh(G₂x₂ + b) − tanh(b),   ŷ = C x [+ D u]

The units see the upstream states x₂ alone and drive the downstream ones alone, so that A(x) is block triangular, with
the eigenvalues of A₁ and A₂ whatever the units do, and in some basis contracts wherever these two are stable.

SSEST's model has this form, with F₁ = 0, for every way to divide its poles between the two parts: in real Schur form.
A complex pair may be divided, too, as two real poles near it. Divisions into halves are fitted by Gauss–Newton for a
few iterations each; those that validate best go on.

Sources: J. Sjöberg and J. Schoukens, "Initializing Wiener–Hammerstein models based on partitioning of the best linear
approximation", Automatica 48(2), 2012; G. Golub and C. Van Loan, "Matrix Computations", 4th ed., 2013, 7.6, for the
order of a Schur form.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import scipy.linalg
import torch

from nnss_cli.baselines.statespace import LinearStateSpace, spectral_radius
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.incremental import Lure, PlainArrays
from nnss_cli.model.initial import spread_of
from nnss_cli.model.nnss import NNSS
from nnss_cli.training import lure_kernels as kernels
from nnss_cli.training.encoder import fit_encoder, regress_encoder
from nnss_cli.training.engine import Engine
from nnss_cli.training.fast import STRETCH, Weights
from nnss_cli.training.feedback import TOO_LARGE, FromWindows
from nnss_cli.training.gauss_newton import ahead
from nnss_cli.training.least_squares import Block, NormalEquations, levenberg_marquardt
from nnss_cli.training.lure import plain_sensitivities
from nnss_cli.training.lure_start import SLOPES, matrix, midway_basis, start_layer, transformed
from nnss_cli.training.warm import INSIDE, LinearStart, encoder_layers, encoder_of_states

APART = 0.02
"""Distance of each of the two real poles that a complex pair becomes from its real part."""
ROUNDS = ((15, 24), (25, 4), (60, 2))
"""Iterations, and how many divisions have them, the best by validation of the round before."""
FIRST = 50
"""Samples of a training record that tell the x(0) from which a fit begins."""
ROUNDING = 1e-9
"""Of entries that are zero in this form, once a layer has held them."""
DELTAS = np.geomspace(1, 1e-5, 21)
"""Of the downstream states, in the basis in which a cascade contracts."""
SHARES = np.geomspace(0.5, 0.005, 9)
"""Norm of what the units see there."""

Division = tuple[FloatArray, FloatArray, int]
"""T (n, n) upper triangular by blocks, orthogonal Q with QᵀAQ ≈ T, and the number of downstream states."""


@dataclass(frozen=True, eq=False)
class Cascade(FromWindows):
    """A model of this form in normalised units, and the matrix that takes y(0) to its x(0)."""

    plain: PlainArrays
    downstream: int
    """Number of the first states, which the units drive."""
    initial: FloatArray
    """(n, m)."""
    error: float = np.inf
    """Validation error, a mean square; inf before it was fitted."""

    @property
    def radius(self) -> float:
        """The larger one of ρ(A₁) and ρ(A₂)."""
        return max(spectral_radius(part) for part in parts(self.plain.A, self.downstream))

    def states(self, u: FloatArray, x0: FloatArray) -> FloatArray:
        """x (K, n) of inputs (K, r); not finite where it leaves the range."""
        n, m = len(self.plain.A), len(self.plain.C)
        y, x = np.empty((len(u), m, 1)), np.empty((len(u), n, 1))
        kernels.free_run(*self.plain, np.array(x0)[:, None], np.ascontiguousarray(u[:, :, None]), y, x)
        return x[:, :, 0]

    def outputs(self, u: FloatArray, x: FloatArray) -> FloatArray:
        """ŷ (K, m) at states x (K, n)."""
        return x @ self.plain.C.T + u @ self.plain.D.T

    def sensitivities(self, u: FloatArray, x0: FloatArray) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """ŷ (k, m), x (k, n) and ∂ŷ/∂[all matrices; x(0)] (k, m, P + n), in stretches of k samples."""
        return plain_sensitivities(self.plain, x0, u, STRETCH)

    def response(self, u: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ŷ (K, m) for inputs (K, r), and its derivatives by x(0) (K, m, n)."""
        stretches = [(simulated, J[:, :, -len(x0) :]) for simulated, _, J in self.sensitivities(u, x0)]
        simulated, J = (np.concatenate(each) for each in zip(*stretches, strict=True))
        return simulated, J


def divisions(A: FloatArray) -> list[Division]:
    """Ways to divide the poles of A (n, n) into halves, those that divide the fewest complex pairs first."""
    poles, n = np.linalg.eigvals(A), len(A)
    pairs, reals = poles[poles.imag > 0].tolist(), poles[poles.imag == 0].real.tolist()
    found: list[tuple[int, Division]] = []
    for sides in itertools.product("udbB", repeat=len(pairs)):
        for real_sides in itertools.product("ud", repeat=len(reals)):
            upstream = sum({"u": 2, "d": 0}.get(side, 1) for side in sides) + real_sides.count("u")
            if upstream not in (n // 2, n - n // 2) or not 0 < upstream < n:
                continue
            try:
                division = _divided(A, pairs, sides, reals, real_sides)
            except np.linalg.LinAlgError:  # poles too near each other to be told apart
                continue
            if division[2] == n - upstream:
                found.append((sum(side in "bB" for side in sides), division))
    return [division for _, division in sorted(found, key=lambda each: each[0])]


def _divided(
    A: FloatArray, pairs: Sequence[complex], sides: Sequence[str], reals: Sequence[float], real_sides: Sequence[str]
) -> Division:
    """The Schur form whose last block has the upstream poles: those of side u, and one of each pair of side b or B."""
    upstream: list[complex] = []
    downstream: list[complex] = []
    for pole, side in zip(pairs, sides, strict=True):
        if side in "bB":
            T, Q, _ = _ordered(A, [pole], [other for other in np.linalg.eigvals(A) if abs(other - pole) > 1e-6])
            T[1, 0], T[0, 0], T[1, 1] = 0, pole.real + APART, pole.real - APART
            A = Q @ T @ Q.T
            ahead = APART if side == "b" else -APART
            upstream.append(pole.real + ahead)
            downstream.append(pole.real - ahead)
        else:
            (upstream if side == "u" else downstream).append(pole)
    for real, side in zip(reals, real_sides, strict=True):
        (upstream if side == "u" else downstream).append(real)
    T, Q, first = _ordered(A, downstream, upstream)
    return T, Q, first


def _ordered(A: FloatArray, first: Sequence[complex], last: Sequence[complex]) -> tuple[FloatArray, FloatArray, int]:
    """A's real Schur form with the poles nearest to `first` first, the orthogonal Q, and how many these are."""

    def nearer(real: float, imaginary: float) -> bool:
        pole = real + 1j * abs(imaginary)
        here, there = (min((abs(pole - other) for other in each), default=np.inf) for each in (first, last))
        return bool(here < there)

    T, Q, count = scipy.linalg.schur(A, output="real", sort=nearer)
    return T, Q, int(count)


def at_division(
    linear: LinearStart, division: Division, units: int, train: Sequence[Record], random: np.random.Generator
) -> Cascade:
    """The linear model in this form, with units that drive nothing yet, at random where its upstream states are."""
    model, E = linear
    T, Q, first = division
    n, (m, r) = len(T), model.D.shape
    no_units = PlainArrays(
        T, Q.T @ model.B, np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, r)), np.zeros(0), model.C @ Q, model.D,
        np.zeros((m, 0)),
    )  # fmt: skip
    begun = Cascade(no_units, first, Q.T @ E)
    x = np.concatenate([begun.states(record.u, begun.initial @ record.y[0]) for record in train])
    G = np.zeros((units, n))
    G[:, first:] = random.standard_normal((units, n - first))
    low, high = np.log(SLOPES)
    spans = np.sqrt(np.mean((x @ G.T) ** 2, axis=0))
    G *= (np.exp(random.uniform(low, high, units)) / np.maximum(spans, 1e-12))[:, None]
    b = -np.sum(G * x[random.integers(len(x), size=units)], axis=1)
    plain = no_units._replace(F=np.zeros((n, units)), G=G, H=np.zeros((units, r)), b=b, E=np.zeros((m, units)))
    return replace(begun, plain=plain)


class Problem:
    """Errors of a cascade over records and their derivatives by what this form leaves free, then by x(0) of each."""

    def __init__(
        self, start: Cascade, u: Sequence[FloatArray], y: Sequence[FloatArray], feedthrough: bool, threads: int = 1
    ) -> None:
        """From a cascade, for inputs (K, r) and outputs (K, m) of each record; with a feedthrough D is free."""
        self.start, self.u, self.y, self.threads = start, u, y, threads
        first = start.downstream
        free = PlainArrays(*(np.zeros(part.shape, dtype=bool) for part in start.plain))
        free.A[:first], free.A[first:, first:], free.F[:first], free.G[:, first:] = True, True, True, True
        free.B[:], free.b[:], free.C[:], free.D[:] = True, True, True, feedthrough
        self.chosen = np.flatnonzero(np.concatenate([part.ravel() for part in free]))
        self.whole = np.concatenate([part.ravel() for part in start.plain])

    def point(self, begin: Sequence[FloatArray]) -> FloatArray:
        """Where the cascade is, with these guesses of x(0), after a fit to each record's first `FIRST` outputs."""
        own = (self.start.state_from(u, y[:FIRST], x0) for u, y, x0 in zip(self.u, self.y, begin, strict=True))
        return np.concatenate([self.whole[self.chosen], *own])

    def at(self, point: FloatArray) -> Cascade:
        """The cascade of a point."""
        vector, plain = self.whole.copy(), self.start.plain
        vector[self.chosen] = point[: len(self.chosen)]
        cuts = np.split(vector, np.cumsum([part.size for part in plain])[:-1])
        return replace(
            self.start, plain=PlainArrays(*(cut.reshape(part.shape) for cut, part in zip(cuts, plain, strict=True)))
        )

    def _blocks(self, point: FloatArray) -> Iterator[Block]:
        model, n = self.at(point), len(self.start.plain.A)
        begin = point[len(self.chosen) :].reshape(-1, n)
        for window, (u, y, x0) in enumerate(zip(self.u, self.y, begin, strict=True)):
            done = 0
            for simulated, x, J in model.sensitivities(u, x0):
                errors = (simulated - y[done : done + len(x)]).ravel()
                if not np.abs(x).max(initial=0) < TOO_LARGE:
                    errors = np.full_like(errors, np.inf)
                flat = J.reshape(len(errors), -1)
                yield Block(errors, np.concatenate([flat[:, self.chosen], flat[:, -n:]], axis=1), window, x)
                done += len(x)

    def evaluate(self, point: FloatArray) -> tuple[NormalEquations, FloatArray]:
        """Normal equations of a point, and the states (K, n) of all records."""
        blocks = self._blocks(point)
        if self.threads > 1:
            blocks = ahead(blocks)
        equations, states = NormalEquations.summed(blocks, len(self.chosen), len(self.y))
        return equations, np.concatenate(states)


def fit_cascade(
    start: Cascade,
    train: Sequence[Record],
    val: Sequence[Record],
    iterations: int,
    init_window: int,
    feedthrough: bool,
    gamma: float,
    in_time: Callable[[], bool] = lambda: True,
) -> Cascade:
    """Levenberg–Marquardt of what this form leaves free, and of x(0); the iterate that validates best.

    Args:
        start: where to begin.
        train: experiments in normalised units.
        val: validation experiments.
        iterations: at most.
        init_window: first samples of a validation experiment that tell x(0).
        feedthrough: whether D is free.
        gamma: what the poles of both parts are to stay within.
        in_time: whether there is time for another iteration.
    """
    if not in_time():
        return start
    problem = Problem(start, [record.u for record in train], [record.y for record in train], feedthrough)
    y, best = np.concatenate(problem.y), start

    def accepted(point: FloatArray, _: float, x: FloatArray) -> bool:
        nonlocal best
        model = problem.at(point)
        E, e = (model.initial, np.zeros(len(model.initial))) if init_window > 1 else regress_encoder(y, x)
        error = model.validated(val, init_window, E, e, spread_of(x - y @ E.T - e))
        if error < best.error and model.radius < gamma * (1 - INSIDE):
            best = replace(model, error=error)
        return in_time()

    begin = problem.point([start.initial @ record.y[0] for record in train])
    levenberg_marquardt(problem.evaluate, begin, iterations, accepted)
    return best


def train_cascade(
    model: NNSS,
    engine: Engine,
    u: Sequence[FloatArray],
    y: Sequence[FloatArray],
    iterations: int,
    goes_on: Callable[[float], bool],
    fixed_encoder: bool = False,
    threads: int = 1,
) -> None:
    """Gauss–Newton on whole records of a layer that holds a cascade, which it stays.

    A layer's own weights lead out of this form, slowly, since in the basis in which a cascade contracts its states are
    of very different size.

    Args:
        model: of the engine's architecture; its weights are overwritten.
        engine: holds the weights.
        u: inputs of the windows, each (L, r).
        y: their outputs (L, m).
        iterations: at most.
        goes_on: hears the mean square error of each accepted step; whether there is to be another.
        fixed_encoder: leave the encoder as it is.
        threads: 2 for derivatives that are found while others are summed up; the numbers are the same.
    """
    a = model.architecture
    model.load_state_dict({name: torch.from_numpy(array) for name, array in engine.weights().items()}, strict=False)
    weights, W = Weights(model), a.encoder_window
    guesses = [weights.initial_state(inputs, outputs[:W]) for inputs, outputs in zip(u, y, strict=True)]
    held, scale = _held(model, u, guesses)
    problem = Problem(held, u, y, a.feedthrough, threads)
    ends = np.cumsum([len(window) for window in y])[:-1]

    def accepted(point: FloatArray, loss: float, x: FloatArray) -> bool:
        if np.isfinite(loss):
            T = _placed(model, problem.at(point), x)
            if not fixed_encoder:
                fit_encoder(encoder_layers(model), u, y, np.split(x @ T.T, ends), W)
            engine.place(np.concatenate([p.detach().numpy().ravel() for p in model.parameters()]))
        return goes_on(loss)

    levenberg_marquardt(problem.evaluate, problem.point([scale * x0 for x0 in guesses]), iterations, accepted)


def _placed(model: NNSS, cascade: Cascade, x: FloatArray) -> FloatArray:
    """Set the layer of `model` to a cascade of as many units, whose states are x (K, n); T of its own states T x."""
    a = model.architecture
    T, _ = start_layer(
        model, cascade.plain, x, np.random.default_rng(0), lambda plain: basis(plain, cascade.downstream, a)
    )
    return T


def _held(model: NNSS, u: Sequence[FloatArray], begin: Sequence[FloatArray]) -> tuple[Cascade, FloatArray]:
    """The cascade that a layer holds, with states of unit size along the records, and its states over the layer's."""
    plain = cast(Lure, model.generator).arrays()
    first = int(np.sum(np.abs(plain.F).max(axis=1) > ROUNDING * np.abs(plain.F).max()))
    plain.A[first:, :first], plain.F[first:], plain.G[:, :first] = 0, 0, 0  # but for rounding
    n, m = len(plain.A), len(plain.C)
    own = Cascade(plain, first, np.zeros((n, m)))
    x = np.concatenate([own.states(inputs, x0) for inputs, x0 in zip(u, begin, strict=True)])
    size = np.sqrt(np.mean(x**2, axis=0))
    scale = np.where((size > 0) & np.isfinite(size), 1 / np.where(size > 0, size, 1), 1.0)
    return replace(own, plain=transformed(plain, np.diag(scale))), scale


def basis(plain: PlainArrays, downstream: int, a: Architecture) -> tuple[FloatArray, float] | None:
    """T (n, n) and λ in which the cascade contracts, as `promising_basis` has them; None where a part is not stable.

    Each part gets a basis in which it contracts by itself, and the downstream states are scaled by δ, so that what
    reaches them from the other part weighs less. K's norm falls to the larger one of the parts' as δ and λ fall. The
    largest δ is taken that leaves half of the room that the smallest one leaves.

    Args:
        plain: block triangular, with D and the units as in this module's equations.
        downstream: number of states that the units drive.
        a: γ and Γ.
    """
    upper, lower = (midway_basis(part, a.gamma) for part in parts(plain.A, downstream))
    if upper is None or lower is None:
        return None
    found: list[tuple[float, FloatArray, float]] = []
    seen = float(np.linalg.norm(plain.G[:, downstream:] @ np.linalg.inv(lower), 2))
    for delta in DELTAS:
        T = scipy.linalg.block_diag(delta * upper, lower)
        moved = transformed(plain, T)
        for share in SHARES:
            weight = 2 * share / max(seen, 1e-12)
            norm = float(np.linalg.norm(matrix(moved, np.full(len(plain.G), 2.0 / weight), a), 2))
            found.append((norm, T, weight))
    smallest = min(norm for norm, *_ in found)
    if smallest >= 1:
        return None
    _, T, weight = next(each for each in found if 1 - each[0] >= (1 - smallest) / 2)
    return T, weight


def parts(A: FloatArray, downstream: int) -> tuple[FloatArray, FloatArray]:
    """A₁ and A₂."""
    return A[:downstream, :downstream], A[downstream:, downstream:]


def cascade_start(
    model: NNSS,
    linear: LinearStart,
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    random: np.random.Generator,
    init_window: int = 1,
    in_time: Callable[[], bool] = lambda: True,
) -> bool:
    """Set the incrementally stable layer of `model` to the cascade that validates best.

    Args:
        model: initialised weights, changed in place; beside x, what schedules gets no weight.
        linear: of `linear_start`.
        train: experiments in normalised units.
        val: validation experiments.
        random: draws what the units see.
        init_window: first samples of a validation experiment that tell x(0).
        in_time: whether there is time for another iteration, or division.

    Returns:
        Whether there is one; else nothing is changed. There is none of one state, nor where no iterate is stable.
    """
    a = model.architecture
    start, E = linear
    given = (LinearStateSpace(start.A, start.B, start.C, start.D * a.feedthrough, start.Ts), E)
    ways = divisions(start.A)[: ROUNDS[0][1]]
    tried = [at_division(given, way, a.hidden[0], train, random) for way in ways]
    for iterations, count in ROUNDS:
        tried = sorted(tried, key=lambda each: each.error)[:count]
        tried = [
            fit_cascade(each, train, val, iterations, init_window, a.feedthrough, a.gamma, in_time) for each in tried
        ]
    best = min(tried, key=lambda each: each.error, default=None)
    if best is None or not np.isfinite(best.error):
        return False
    begin = [best.state_from(record.u, record.y[:FIRST], best.initial @ record.y[0]) for record in train]
    x = [best.states(record.u, x0) for record, x0 in zip(train, begin, strict=True)]
    T = _placed(model, best, np.concatenate(x))
    encoder_of_states(model, train, [own @ T.T for own in x])
    return True
