"""SIMBa: a linear model, stable by parametrisation, trained by gradient on windows.

    x(k+1) = A(W, V) x + B u,   y = C x + D u,   x(0) = C⁺ (y(0) − D u(0))

A is Schur for every W, V (`schur`); B, C and D are free. All gradients are written out: the
adjoint λ(k) = Aᵀ λ(k+1) + Cᵀ ∂J/∂ŷ(k) runs backwards through the recursion (`kernels`), then
through C⁺ and the Schur map.

Source: L. Di Natale, M. Zakwan, P. Heer, G. Ferrari-Trecate and C. N. Jones, "SIMBa: System
identification methods leveraging backpropagation", IEEE TCST, 2024; training as in the code
released with the NN-SS paper.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field

import numpy as np
from nnss_cli.baselines.kernels import linear_adjoint
from nnss_cli.baselines.schur import EPSILON, schur_inverse, schur_matrix
from nnss_cli.baselines.statespace import LinearStateSpace, simulation_rms
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.datasets.windows import Windows, sliding_windows

from nnss_cli.errors import InputError, unknown
from nnss_cli.iterative import PATIENCE_UNITS, EarlyStopping, EpochCallback, named_random
from nnss_cli.lock import compiling

STARTS = ("n4sid", "random")
INSIDE = 1 - 1e-6  # poles of a start on the unit circle are drawn in this far, relative to gamma


@dataclass(frozen=True)
class SimbaOptions:
    """How SIMBa is trained. The defaults are those of the NN-SS paper's code."""

    start: str = "n4sid"
    """n4sid: the closed-form W, V of a given model; random: as in SIMBa's own paper."""
    window: int = 80
    """Window length L, samples; 0 for whole records."""
    stride: int = 2
    """Samples between the starts of neighbouring windows."""
    batch: int = 64
    """Windows in a mini-batch."""
    learning_rate: float = 1e-3
    """Step size of Adam."""
    epochs: int = 1000
    """Epochs at most."""
    patience: int = 400
    """Epochs or steps without an improvement of the validation error before training stops."""
    patience_unit: str = "epochs"
    """What patience counts: epochs, or steps of the optimiser (mini-batches)."""
    gamma: float = 1.0
    """Bound on the spectral radius."""

    def __post_init__(self) -> None:
        if self.start not in STARTS:
            raise unknown("start of simba", self.start, STARTS)
        if self.patience_unit not in PATIENCE_UNITS:
            raise unknown("unit of patience", self.patience_unit, PATIENCE_UNITS)
        for name in ("stride", "batch", "epochs", "patience"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: expected at least 1, found {getattr(self, name)}")
        if self.window < 0:
            raise InputError(f"window: expected a length in samples, or 0 for whole records, found {self.window}")
        if not self.learning_rate > 0 or not 0 < self.gamma <= 1:
            raise InputError(
                f"expected a positive learning rate and 0 < gamma ≤ 1, found {self.learning_rate} and {self.gamma}"
            )


@dataclass(frozen=True)
class SimbaFit:
    """How a training went."""

    system: LinearStateSpace
    """The model of the best validation epoch."""
    epochs: int
    """Epochs that were run."""
    best_epoch: int
    """Epoch of the model kept, from 1; 0 when none was finite."""
    diverged: str = ""
    """Why training was given up, or ""."""
    history: dict[str, list[float]] = field(default_factory=dict)
    """Loss and validation error of each epoch."""


Parameters = dict[str, FloatArray]


def initial_parameters(
    start: LinearStateSpace | None, n: int, r: int, m: int, gamma: float, random: np.random.Generator
) -> Parameters:
    """W, V, B, C, D: exactly `start` where it is given, else random as in SIMBa's own layer."""
    if start is None:
        return {
            "W": random.standard_normal((2 * n, 2 * n)) * math.sqrt(1 / n),
            "V": random.standard_normal((n, n)) * math.sqrt(2 / n),
            "B": random.standard_normal((n, r)) * math.sqrt(2 / r),
            "C": random.standard_normal((m, n)) * math.sqrt(2 / n),
            "D": random.standard_normal((m, r)) * math.sqrt(2 / r),
        }
    radius = start.spectral_radius()
    A = start.A * min(1.0, INSIDE * gamma / radius) if radius > 0 else start.A
    W, V = schur_inverse(A, gamma)
    # Adam's step is absolute: a scalar change of basis gives B and C equal size, and leaves C⁺ y(0) what it was.
    sizes = np.linalg.norm(start.B), np.linalg.norm(start.C)
    s = math.sqrt(sizes[1] / sizes[0]) if min(sizes) > 0 else 1.0
    return {"W": W, "V": V, "B": start.B * s, "C": start.C / s, "D": start.D.copy()}


@functools.cache
def warm_up() -> None:
    """Compile the gradient, or read it from numba's cache, on a model of order 1."""
    parameters = initial_parameters(None, 1, 1, 1, 1.0, np.random.default_rng(0))
    with compiling(linear_adjoint):
        loss_and_gradient(parameters, np.ones((2, 1, 2)), np.ones((2, 1, 2)))


def loss_and_gradient(
    parameters: Parameters, u: FloatArray, y: FloatArray, gamma: float = 1.0, space: FloatArray | None = None
) -> tuple[float, Parameters]:
    """J = mean (y − ŷ)² over windows, and its gradient.

    Args:
        parameters: W (2n, 2n), V (n, n), B (n, r), C (m, n), D (m, r).
        u: inputs (L, r, b).
        y: measured outputs (L, m, b).
        gamma: bound on the spectral radius.
        space: at least L·(n + m)·b numbers to work in; made where it is None.
    """
    W, V, B, C, D = (parameters[name] for name in "WVBCD")
    n = len(V)
    S = W.T @ W + EPSILON * np.eye(2 * n)
    M = 0.5 * (S[:n, :n] / gamma**2 + S[n:, n:]) + V - V.T
    M_inverse = np.linalg.inv(M)
    A = S[:n, n:] @ M_inverse

    pinv = np.linalg.pinv(C)
    v = y[0] - D @ u[0]
    if space is None:
        space = np.empty(len(u) * (n + len(C)) * u.shape[2])
    loss, d_A, d_B, d_C, d_D, d_x0 = linear_adjoint(A, B, C, D, pinv @ v, u, y, space)
    d_C += _pinv_gradient(C, pinv, d_x0 @ v.T)
    d_D -= pinv.T @ d_x0 @ u[0].T

    d_M = -A.T @ d_A @ M_inverse.T
    d_S = np.zeros_like(S)
    d_S[:n, :n] = d_M / (2 * gamma**2)
    d_S[n:, n:] = d_M / 2
    d_S[:n, n:] = d_A @ M_inverse.T
    return float(loss), {"W": W @ (d_S + d_S.T), "V": d_M - d_M.T, "B": d_B, "C": d_C, "D": d_D}


def _pinv_gradient(C: FloatArray, pinv: FloatArray, d_pinv: FloatArray) -> FloatArray:
    """∂J/∂C from ∂J/∂C⁺ (n, m), C of full rank. Source: Golub and Pereyra, SIAM J. Numer. Anal. 10(2), 1973."""
    m, n = C.shape
    kernel, cokernel = np.eye(n) - pinv @ C, np.eye(m) - C @ pinv
    first = -pinv.T @ d_pinv @ pinv.T
    return first + pinv.T @ pinv @ d_pinv.T @ kernel + cokernel @ d_pinv.T @ pinv @ pinv.T


def train_simba(
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    order: int,
    seed: int,
    options: SimbaOptions,
    start: LinearStateSpace | None,
    on_epoch: EpochCallback | None = None,
    init_window: int = 1,
) -> SimbaFit:
    """Train from `start` (or at random where it is None) with Adam, and keep the best validation epoch.

    Args:
        train: experiments, in normalised units.
        val: validation experiments, simulated freely after each epoch.
        order: number of states n.
        seed: of the shuffling, and of the weights of a random start.
        options: how.
        start: the model to start from.
        on_epoch: called after each epoch.
        init_window: first samples of a validation experiment that tell x(0); see `scored_residuals`.

    Raises:
        InputError: a training record is shorter than the window.
    """
    windows = Windows(*sliding_windows(train, options.window, options.stride))
    count, r, m = len(windows), train[0].input_count, train[0].output_count
    parameters = initial_parameters(start, order, r, m, options.gamma, named_random(seed, "weights"))
    space = np.empty(int(windows.lengths.max()) * (order + m) * min(options.batch, count))
    first = {name: np.zeros_like(value) for name, value in parameters.items()}
    second = {name: np.zeros_like(value) for name, value in parameters.items()}
    shuffling = named_random(seed, "shuffling")
    stopping = EarlyStopping(options.patience, improvement=0.0)
    history: dict[str, list[float]] = {"train_loss": [], "val_rmse": []}
    kept, best_epoch, diverged = _system(parameters, options.gamma, train[0].Ts), 0, ""
    batches = max(1, count // options.batch)
    epoch_waits = batches if options.patience_unit == "steps" else 1
    for epoch in range(1, options.epochs + 1):
        shuffled = shuffling.permutation(count)
        total = 0.0
        for index in range(batches):
            chosen = shuffled[index * options.batch : (index + 1) * options.batch]
            gradients = {name: np.zeros_like(value) for name, value in parameters.items()}
            for batch in windows.batches(chosen):
                loss, gradient = loss_and_gradient(parameters, batch.u, batch.y, options.gamma, space)
                total += batch.share * loss
                for name, g in gradient.items():
                    gradients[name] += batch.share * g
            for name, g in gradients.items():
                first[name] = 0.9 * first[name] + 0.1 * g
                second[name] = 0.999 * second[name] + 0.001 * g**2
                # the bias is corrected by the epoch's number, as in the code released with the paper
                step = first[name] / (1 - 0.9**epoch) / (np.sqrt(second[name] / (1 - 0.999**epoch)) + 1e-8)
                parameters[name] = parameters[name] - options.learning_rate * step
        if not math.isfinite(total):
            diverged = f"the loss became {total} in epoch {epoch}"
            break
        system = _system(parameters, options.gamma, train[0].Ts)
        error = simulation_rms(system, val, init_window)
        history["train_loss"].append(total / batches)
        history["val_rmse"].append(error)
        if stopping.is_best(error, epoch_waits):
            kept, best_epoch = system, epoch
        if on_epoch:
            on_epoch(epoch, total / batches, error)
        if stopping.stop:
            break
    return SimbaFit(kept, len(history["val_rmse"]), best_epoch, diverged, history)


def _system(parameters: Parameters, gamma: float, Ts: float) -> LinearStateSpace:
    A = schur_matrix(parameters["W"], parameters["V"], gamma)
    return LinearStateSpace(A, parameters["B"], parameters["C"], parameters["D"], Ts)
