"""A model's step and its Jacobians on arrays, in normalised units: what a predictor and a linearisation need of it.

    z(k+1) = f(z(k), u(k)),   y(k) = h(z(k), u(k)),   F = ∂f/∂z,   H = ∂h/∂z

z is the state x, and the previous output after it where that schedules. `disturbed` puts the state of a disturbance of
the outputs below it (`nnss_cli.validation.disturbance`), which a gain can let follow what the model misses.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeAlias

import numpy as np

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace, propagate
from nnss_cli.datasets.record import FloatArray, Scaling, Simulation
from nnss_cli.methods import Model
from nnss_cli.validation.disturbance import Disturbance

Step: TypeAlias = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""z(k+1) (b, s) and y(k) (b, m) from z (b, s) and u (b, r)."""
CHUNK = 4096  # points whose step is taken at a time


class Stepper(Protocol):
    """One model; b points side by side."""

    @property
    def model(self) -> Model:
        """Whose step it is."""
        ...

    @property
    def scaling(self) -> Scaling:
        """Between physical and normalised units."""
        ...

    @property
    def size(self) -> int:
        """Length s of z."""
        ...

    @property
    def outputs(self) -> int:
        """Number of outputs m."""
        ...

    @property
    def sees(self) -> int:
        """First outputs without which there is no x(0)."""
        ...

    def disturbed(self, by: Disturbance) -> Stepper:
        """The same with a disturbance of the outputs, whose state is the end of z."""
        ...

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """The model's free simulation, in physical units; of a long record in compiled code, equal up to rounding."""
        ...

    def start(self, x0: FloatArray, y0: FloatArray, u0: FloatArray) -> FloatArray:
        """z (s,) of a state x0 (n,), the first output y0 (m,) and the first input u0 (r,)."""
        ...

    def step(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """z(k+1) (b, s) and y(k) (b, m) from z (b, s) and u (b, r)."""
        ...

    def jacobians(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """F (b, s, s) and H (b, m, s) at z (b, s) and u (b, r)."""
        ...

    def observe(self, K: FloatArray, z0: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """ẑ(k+1) = f(ẑ, u) + K (y − ŷ),  ŷ(k) = h(ẑ, u).

        Args:
            K: gains (b, s, m).
            z0: where each begins (b, s).
            u: inputs (N, b, r).
            y: measured outputs (N, b, m).

        Returns:
            ẑ (N + 1, b, s) and ŷ (N, b, m); not finite from where they leave the range of numbers.
        """
        ...


def observed(
    step: Step,
    K: FloatArray, z0: FloatArray, u: FloatArray, y: FloatArray,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """`Stepper.observe`, sample by sample."""
    z, predicted = np.full((len(u) + 1, *z0.shape), np.nan), np.full(y.shape, np.nan)
    z[0] = z0
    for k in range(len(u)):
        following, predicted[k] = step(z[k], u[k])
        with np.errstate(over="ignore", invalid="ignore"):
            z[k + 1] = following + (K @ (y[k] - predicted[k])[..., None])[..., 0]
    return z, predicted


class Linear:
    """A linear model: F = A, H = C everywhere."""

    def __init__(self, model: LinearModel, by: Disturbance | None = None) -> None:
        self.model, self.scaling, self.by, system = model, model.scaling, by, model.system
        self.outputs, self.sees = len(system.C), 1
        if by is not None:
            r = by.inputs
            driven, shown = by.B[:, r:], by.D[:, r:]  # by the model's own outputs
            A = np.block([[system.A, np.zeros((system.order, by.size))], [driven @ system.C, by.A]])
            B = np.concatenate([system.B, by.B[:, :r] + driven @ system.D])
            C = np.concatenate([shown @ system.C, by.C], axis=1)
            system = LinearStateSpace(A, B, C, by.D[:, :r] + shown @ system.D, system.Ts)
        self.system, self.size = system, system.order

    def disturbed(self, by: Disturbance) -> Linear:
        """See `Stepper`; in place of the one it has."""
        return Linear(self.model, by)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """See `Stepper`."""
        return self.model.simulate(u, y_init)

    def start(self, x0: FloatArray, y0: FloatArray, u0: FloatArray) -> FloatArray:
        """See `Stepper`."""
        if self.by is None:
            return x0
        own = self.model.system
        return np.concatenate([x0, self.by.begin @ np.concatenate([y0, u0, own.C @ x0 + own.D @ u0])])

    def step(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        A, B, C, D = self.system.A, self.system.B, self.system.C, self.system.D
        with np.errstate(over="ignore", invalid="ignore"):
            return z @ A.T + u @ B.T, z @ C.T + u @ D.T

    def jacobians(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        del u
        return np.repeat(self.system.A[None], len(z), axis=0), np.repeat(self.system.C[None], len(z), axis=0)

    def observe(self, K: FloatArray, z0: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`; as x(k+1) = (A − KC) x + (B − KD) u + K y."""
        A, B, C, D = self.system.A, self.system.B, self.system.C, self.system.D
        z, predicted = np.empty((len(u) + 1, *z0.shape)), np.empty(y.shape)
        for i, gain in enumerate(K):
            z[:, i] = propagate(A - gain @ C, u[:, i] @ (B - gain @ D).T + y[:, i] @ gain.T, z0[i])
            with np.errstate(over="ignore", invalid="ignore"):
                predicted[:, i] = z[:-1, i] @ C.T + u[:, i] @ D.T
        return z, predicted
