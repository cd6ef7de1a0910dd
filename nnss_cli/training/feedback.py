"""Start an NN-SS model as a linear one whose outputs feed back through saturations (a Lur'e model).

    x(k+1) = A x + B u + F tanh(G x),   ŷ = C x [+ D u],   G = g C₀

Dry friction of a drive is such a feedback. With tanh(s) = ψ(s) s, 0 < ψ ≤ 1, the model is LPV,

    A(x) = A + F ψ(Gx) G

and where one P satisfies γ²P − A(x) P A(x)ᵀ > 0 for all ψ there is a basis in which P = I and the closed form of
the Schur parametrisation is smooth in ψ, so that a small generator can be regressed on it. It has n weights
for each output beside the linear model's: where data are too poor in nonlinearity for a free
generator, which has thousands, these still generalise.

Sources: H. K. Khalil, "Nonlinear Systems", 3rd ed., 2002, ch. 7; for P, the bounded real lemma: C. E. de Souza and
L. Xie, "On the discrete-time bounded real lemma", Systems & Control Letters 18(1), 1992.
"""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import torch

from nnss_cli.baselines.schur import bounded_real_basis
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import FloatArray, Record, unscored
from nnss_cli.model.incremental import PlainArrays
from nnss_cli.model.initial import spread_of, state_from_window
from nnss_cli.model.nnss import NNSS
from nnss_cli.training import feedback_kernels as kernels
from nnss_cli.training.encoder import regress_encoder, set_encoder
from nnss_cli.training.least_squares import NormalEquations, levenberg_marquardt
from nnss_cli.training.lure_start import promising_bases, start_layer
from nnss_cli.training.warm import LinearStart, encoder_layers, free_matrices, set_generator

ITERATIONS = 80
PATIENCE = 25  # iterations without a lower validation error
GAIN = 2.0, 0.5  # median of g, for outputs of unit deviation, and deviation of its logarithm
SLOPES = 0.5, 4.0  # of the generator's sigmoids, relative to g
TARGETS = 1000  # training states at which the generator is regressed, about
CUT = 1e-4  # relative singular value below which the regression sees nothing
TOO_LARGE = 1e6  # a normalised state beyond it has diverged


def contiguous(array: FloatArray) -> FloatArray:
    """As the compiled loops take it."""
    return np.ascontiguousarray(array, dtype=np.float64)


class FromWindows(ABC):
    """What a model of normalised signals does from first outputs."""

    @abstractmethod
    def states(self, u: FloatArray, x0: FloatArray) -> FloatArray:
        """x (K, n) for inputs (K, r); not finite, or beyond `TOO_LARGE`, where it diverges."""

    @abstractmethod
    def outputs(self, u: FloatArray, x: FloatArray) -> FloatArray:
        """ŷ (K, m) at states x (K, n) under inputs u (K, r)."""

    @abstractmethod
    def response(self, u: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ŷ (K, m) for inputs (K, r), and its derivatives by x(0) (K, m, n)."""

    def state_from(
        self, u: FloatArray, y: FloatArray, guess: FloatArray, spread: FloatArray | None = None
    ) -> FloatArray:
        """The x(0) (n,) that explains first outputs y (w, m) best; see `nnss_cli.model.initial`."""

        def evaluate(x0: FloatArray) -> tuple[FloatArray, FloatArray]:
            simulated, J = self.response(u[: len(y)], x0)
            return (simulated - y).ravel(), J.reshape(-1, len(x0))

        return state_from_window(evaluate, guess, float(np.finfo(np.float64).eps), spread) if len(y) > 1 else guess

    def validated(
        self, val: Sequence[Record], w: int, E: FloatArray, e: FloatArray, spread: FloatArray | None
    ) -> float:
        """Mean square error of free simulations from w first outputs, guessed by E y(0) + e; ∞ where one diverges.

        LLᵀ is the covariance of what such guesses are off by, L the spread (n, n); of no use where w = 1.
        """
        errors = []
        with np.errstate(over="ignore", invalid="ignore"):
            for record in val:
                x = self.states(record.u, self.state_from(record.u, record.y[:w], E @ record.y[0] + e, spread))
                errors.append((self.outputs(record.u, x) - record.y)[unscored(w) :])
            error = float(np.mean(np.square(np.concatenate(errors))))
        return error if np.isfinite(error) else np.inf


@dataclass(frozen=True, eq=False)
class Feedback(FromWindows):
    """x(k+1) = A x + B u + F tanh(G x), ŷ = C x + D u, in normalised units; D = 0 without feedthrough."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    F: FloatArray
    G: FloatArray

    def states(self, u: FloatArray, x0: FloatArray) -> FloatArray:
        """x (K, n) for inputs (K, r)."""
        path = np.empty((len(u), len(x0)))
        kernels.simulate(*map(contiguous, (self.A, u @ self.B.T, self.F, self.G, x0)), TOO_LARGE, path)
        return path

    def response(self, u: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ŷ (K, m) for inputs (K, r), and its derivatives by x(0) (K, m, n)."""
        path = self.states(u, x0)
        return self.outputs(u, path), self.sensitivities(path, np.empty((len(u), 0)))

    def sensitivities(self, path: FloatArray, z: FloatArray) -> FloatArray:
        """C ∂x/∂[θ; x(0)] (K, m, n q + n) along states (K, n), for x(k+1) = θ z(k) with θ (n, q) and z (K, q).

        z is empty where only x(0) counts.
        """
        J = np.empty((len(path), len(self.C), len(path[0]) * (z.shape[1] + 1)))
        slopes = 1 - np.tanh(path @ self.G.T) ** 2
        kernels.sensitivities(*map(contiguous, (self.A, self.F, self.G, self.C, slopes, z)), z.shape[1], J)
        return J

    def outputs(self, u: FloatArray, x: FloatArray) -> FloatArray:
        """ŷ (K, m) at states x (K, n) under inputs u (K, r)."""
        return x @ self.C.T + u @ self.D.T

    def state_matrix(self, x: FloatArray) -> FloatArray:
        """A(x) = A + F ψ(Gx) G, with ψ(s) = tanh(s)/s."""
        s = self.G @ x
        near = np.abs(s) < 1e-8
        psi = np.where(near, 1.0, np.tanh(s) / np.where(near, 1.0, s))
        return self.A + (self.F * psi) @ self.G

    def plain(self) -> PlainArrays:
        """As the matrices of an incrementally stable layer."""
        m, r = self.D.shape
        q = len(self.G)
        return PlainArrays(
            self.A, self.B, self.F, self.G, np.zeros((q, r)), np.zeros(q), self.C, self.D, np.zeros((m, q))
        )

    def transform(self, T: FloatArray) -> Feedback:
        """The same model with states T x."""
        inverse = np.linalg.inv(T)
        return Feedback(T @ self.A @ inverse, T @ self.B, self.C @ inverse, self.D, T @ self.F, self.G @ inverse)

    def contracting_bases(self, gamma: float, epsilon: float) -> Iterator[tuple[float, FloatArray]]:
        """T (n, n) with ‖T A(x) T⁻¹‖₂ < γ (1 − 4ε) at every x, each after the largest such norm, over γ.

        A(x) lies within A + ½FG + ½F δ G, |δ| ≤ 1. P = TᵀT is the solution of the bounded real
        lemma's Riccati equation for these, over a range of margins λ.
        """
        n, m = self.F.shape
        A, F = (self.A + self.F @ self.G / 2) / gamma, self.F / gamma
        corners = [(self.A + (self.F * psi) @ self.G) / gamma for psi in itertools.product((0.0, 1.0), repeat=m)]
        spread = self.G.T @ self.G / 4
        for margin in np.geomspace(1e-5, 1, 26) * np.trace(spread) / m:
            T = bounded_real_basis(A, F, spread + margin * np.eye(n), -np.eye(m))
            if T is None:
                continue
            inverse = np.linalg.inv(T)
            norm = max(float(np.linalg.norm(T @ corner @ inverse, 2)) for corner in corners)
            if norm < 1 - 4 * epsilon:
                yield norm, T


class Problem:
    """Errors of a feedback model over the training records, and their derivatives by its parameters and x(0)."""

    def __init__(
        self,
        start: LinearStateSpace,
        E: FloatArray,
        G: FloatArray,
        records: tuple[Record, ...],
        feedthrough: bool = False,
    ) -> None:
        self.G, self.records, self.feedthrough = G, records, feedthrough
        self.n, self.r, self.m = start.order, start.B.shape[1], len(start.C)
        theta = np.concatenate([start.A, start.B, np.zeros((self.n, self.m))], axis=1)  # of [x; u; tanh(Gx)]
        outputs = np.concatenate([start.C, start.D], axis=1) if feedthrough else start.C  # of [x; u], or of x
        self.inner, self.seen = theta.shape[1], outputs.shape[1]
        begin = [E @ (record.y[0] - start.D @ record.u[0]) for record in records]
        self.start = np.concatenate([theta.ravel(), outputs.ravel(), *begin])

    def parts(self, point: FloatArray) -> tuple[Feedback, FloatArray]:
        """The model of a point, and x(0) of each record (N, n)."""
        n, r, m = self.n, self.r, self.m
        theta, outputs, begin = np.split(point, np.cumsum([n * self.inner, m * self.seen]))
        theta, outputs = theta.reshape(n, self.inner), outputs.reshape(m, self.seen)
        D = outputs[:, n:] if self.feedthrough else np.zeros((m, r))
        model = Feedback(theta[:, :n], theta[:, n : n + r], outputs[:, :n], D, theta[:, n + r :], self.G)
        return model, begin.reshape(-1, n)

    def evaluate(self, point: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Errors ŷ − y (q,), derivatives (q, p) and states (K, n) of all records.

        With θ = [A B F], z = [x; u; tanh(Gx)] and F' = F diag(1 − tanh²(Gx)):
        ∂x(k+1)/∂θ = (A + F'G) ∂x(k)/∂θ + ∂θ z, and likewise by x(0).
        """
        model, begin = self.parts(point)
        n, m, inner = self.n, self.m, self.inner
        theta_size = n * inner
        errors, derivatives, paths = [], [], []
        for index, record in enumerate(self.records):
            path = model.states(record.u, begin[index])
            if not np.isfinite(path).all():
                return np.full(1, np.inf), np.zeros((1, len(point))), path
            paths.append(path)
            errors.append((model.outputs(record.u, path) - record.y).ravel())
            bent = np.tanh(path @ self.G.T)
            z = np.concatenate([path, record.u, bent], axis=1)
            own = theta_size + m * self.seen + index * n  # where this record's x(0) stands
            J = np.zeros((len(path), m, len(point)))
            through = model.sensitivities(path, z)
            J[:, :, :theta_size], J[:, :, own : own + n] = through[:, :, :theta_size], through[:, :, theta_size:]
            for output in range(m):
                at = theta_size + output * self.seen
                J[:, output, at : at + self.seen] = z[:, : self.seen]
            derivatives.append(J.reshape(-1, len(point)))
        return np.concatenate(errors), np.concatenate(derivatives), np.concatenate(paths)


def fit_feedback(
    start: LinearStart,
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    gamma: float,
    epsilon: float,
    gain: float,
    init_window: int = 1,
    feedthrough: bool = False,
    bases: Callable[[Feedback], Iterator[tuple[float, FloatArray]]] | None = None,
    in_time: Callable[[], bool] = lambda: True,
) -> tuple[Feedback, FloatArray] | None:
    """Levenberg–Marquardt from SSEST's model; the iterate that validates best among those that share a P.

    Args:
        start: SSEST's model, and the map from y(0) to its x(0).
        train: experiments in normalised units.
        val: validation experiments.
        gamma: bound on ‖A(x)‖₂ in the basis of the result.
        epsilon: as in `schur_matrix`.
        gain: g.
        init_window: first samples of a validation experiment that tell x(0); where several, they are not scored.
        feedthrough: whether D is estimated.
        bases: norms and bases T (n, n) that will do for an iterate; by default `contracting_bases`.
        in_time: whether there is time for another iteration.

    Returns:
        The model in the basis in which A(x) contracts, and its states (K, n) over the training records, of unit mean
        square; None where no iterate validates better than the linear model, from either of its encoders.
    """
    if not in_time():
        return None
    model, E = start
    problem = Problem(model, E, gain * model.C, train, feedthrough)
    y = np.concatenate([record.y for record in train])

    def val_error(model: Feedback, x: FloatArray, E: FloatArray, e: FloatArray) -> float:
        spread = spread_of(x - y @ E.T - e) if init_window > 1 else None
        return model.validated(val, init_window, E, e, spread)

    linear, begin = problem.parts(problem.start)
    x = np.concatenate([linear.states(record.u, x0) for record, x0 in zip(train, begin, strict=True)])
    if not np.isfinite(x).all():
        return None
    lowest = min(val_error(linear, x, E, np.zeros(model.order)), val_error(linear, x, *regress_encoder(y, x)))
    waited = 0
    best: tuple[Feedback, FloatArray, Iterator[tuple[float, FloatArray]]] | None = None

    def bases_of(model: Feedback) -> Iterator[tuple[float, FloatArray]]:
        return model.contracting_bases(gamma, epsilon) if bases is None else bases(model)

    def accepted(point: FloatArray, _: float, x: FloatArray) -> bool:
        nonlocal lowest, best, waited
        model = problem.parts(point)[0]
        error = val_error(model, x, *regress_encoder(y, x))
        waited += 1
        if error < lowest and (first := next(offered := bases_of(model), None)):  # the best is sought of the last alone
            lowest, best, waited = error, (model, x, itertools.chain([first], offered)), 0
        return waited < PATIENCE and in_time()

    def evaluate(point: FloatArray) -> tuple[NormalEquations, FloatArray]:
        errors, J, x = problem.evaluate(point)
        return NormalEquations.of(errors, J), x

    levenberg_marquardt(evaluate, problem.start, ITERATIONS, accepted)
    if best is None:
        return None
    found, x, offered = best
    _, T = min(offered, key=lambda each: each[0])
    T = T / np.sqrt(np.mean((x @ T.T) ** 2))
    return found.transform(T), x @ T.T


def feedback_start(
    model: NNSS,
    linear: LinearStart,
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    random: np.random.Generator,
    init_window: int = 1,
    in_time: Callable[[], bool] = lambda: True,
) -> bool:
    """Set `model` such that it simulates like a linear one with feedback from its outputs.

    A generator's first sigmoids get the directions of the outputs, with slopes and centres at random, layers between
    keep their weights, and the last layer is regressed on W and V of A(x) at the training states. A layer is that of
    `lure_start`. The encoder is the regression of these states on the outputs.

    Args:
        model: initialised weights, changed in place; beside x, what schedules gets no weight.
        linear: of `linear_start`.
        train: experiments in normalised units.
        val: validation experiments.
        random: draws g, slopes and centres.
        init_window: first samples of a validation experiment that tell x(0).
        in_time: whether there is time for another iteration.

    Returns:
        Whether there is such a model that validates better than the linear one; else nothing is changed.
    """
    a = model.architecture
    middle, spread = GAIN
    gain = middle * np.exp(spread * random.standard_normal())
    layered = a.stability == "incremental"

    def bases(model: Feedback) -> Iterator[tuple[float, FloatArray]]:
        return ((norm, T) for norm, T, _ in promising_bases(model.plain(), a))

    found = fit_feedback(
        linear, train, val, a.gamma, a.epsilon, gain, init_window, a.feedthrough, bases if layered else None, in_time
    )
    if found is None:
        return False
    feedback, x = found
    if layered:
        T, _ = start_layer(model, feedback.plain(), x, random)
        set_encoder(encoder_layers(model), *regress_encoder(np.concatenate([record.y for record in train]), x @ T.T))
        return True
    G, width = feedback.G, a.hidden[0]
    low, high = np.log(SLOPES)
    slopes = np.exp(random.uniform(low, high, width)) * random.choice([-1.0, 1.0], width)
    directions = np.resize(G, (width, a.order)) * slopes[:, None]
    centres = x[random.integers(len(x), size=width)]
    network = cast(torch.nn.Sequential, model.generator)
    first = cast(torch.nn.Linear, network[0])
    at = x[:: max(1, len(x) // TARGETS)]
    targets = np.array([np.concatenate(free_matrices(a, feedback.state_matrix(k), np.eye(a.order))) for k in at])
    rho = torch.zeros(len(at), a.scheduling_size, dtype=model.dtype)
    rho[:, : a.order] = torch.from_numpy(at)
    with torch.no_grad():
        first.weight.zero_()
        first.weight[:, : a.order] = torch.from_numpy(directions)
        first.bias.copy_(torch.from_numpy(-np.sum(directions * centres, axis=1)))
        features = network[:-1](rho).numpy().astype(np.float64)
    affine, *_ = np.linalg.lstsq(np.column_stack([features, np.ones(len(at))]), targets, rcond=CUT)
    set_generator(model, affine[-1], feedback, affine[:-1].T)
    set_encoder(encoder_layers(model), *regress_encoder(np.concatenate([record.y for record in train]), x))
    return True
