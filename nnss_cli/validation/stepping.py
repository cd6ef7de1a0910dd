"""A model's step and its Jacobians on arrays, in normalised units: what a predictor and a linearisation need of it.

    z(k+1) = f(z(k), u(k)),   y(k) = h(z(k), u(k)),   F = ∂f/∂z,   H = ∂h/∂z

z is the state x, and the previous output after it where that schedules. `disturbed` puts a constant disturbance of
each output below it, y(k) = h(z(k), u(k)) + d(k), d(k+1) = d(k), which a gain can let follow what the model misses.
"""

from __future__ import annotations

from functools import cached_property
from typing import Protocol

import numpy as np
import scipy.linalg
import torch

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace, propagate
from nnss_cli.datasets.record import FloatArray, Scaling, Simulation
from nnss_cli.errors import InputError
from nnss_cli.methods import Model, compiled
from nnss_cli.methods.compiled import free_run
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights

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

    def disturbed(self) -> Stepper:
        """The same with a disturbance of each output in z."""
        ...

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """The model's free simulation, in physical units; of a long record in compiled code, equal up to rounding."""
        ...

    def start(self, x0: FloatArray, y0: FloatArray) -> FloatArray:
        """z (s,) of a state x0 (n,) and the first output y0 (m,); no disturbance."""
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


def steppers_of(model: Model) -> tuple[Stepper, ...]:
    """The members of an ensemble, or the one system that a model is.

    Raises:
        InputError: the model is of a plug-in's kind, which has no step to look at.
    """
    members = model.members if isinstance(model, Ensemble) else (model,)
    return tuple(_stepper(member) for member in members)


def _stepper(model: Model) -> Stepper:
    if isinstance(model, NNSS):
        return Neural(model)
    if isinstance(model, LinearModel):
        return Linear(model)
    raise InputError(
        f"expected an NN-SS or linear model, or an ensemble of them, found {type(model).__name__}: of other kinds only "
        "the simulation is known, not the step"
    )


class Neural:
    """An NN-SS model by its own torch step; along a long record by the compiled one, which is equal up to rounding."""

    def __init__(self, model: NNSS, disturbed: bool = False) -> None:
        self.model, self.scaling = model, model.scaling
        a = model.architecture
        self.outputs, self.order, self.has_disturbance = a.outputs, a.states, disturbed
        self.with_y = "y" in a.scheduling.split("+")
        self.size = a.states + a.outputs * (self.with_y + disturbed)

    def disturbed(self) -> Neural:
        """See `Stepper`."""
        return Neural(self.model, True)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """See `Stepper`."""
        return free_run(self.model, u, y_init)

    @cached_property
    def _compiled(self) -> Weights:
        return Weights(self.model)

    def _compiled_step(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `step`, of a few points: two samples of a free run; the second tells the state after the first."""
        n, m = self.order, self.outputs
        before = z[:, n : n + m] if self.with_y else np.zeros((len(z), m))
        y, x = self._compiled.free_runs(np.stack([u.T, u.T]), before.T, z[:, :n].T)
        d = z[:, self.size - m * self.has_disturbance :]
        output = y[0].T.astype(np.float64)
        following = [x[1].T.astype(np.float64), output, d] if self.with_y else [x[1].T.astype(np.float64), d]
        return np.concatenate(following, axis=1), output + d if self.has_disturbance else output

    def start(self, x0: FloatArray, y0: FloatArray) -> FloatArray:
        """See `Stepper`."""
        none = np.zeros(self.outputs * self.has_disturbance)
        return np.concatenate([x0, y0, none] if self.with_y else [x0, none])

    def _torch_step(self, z: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x, before, d = z.split([self.order, self.outputs * self.with_y, self.outputs * self.has_disturbance], dim=1)
        following, y = self.model.step(x, u, before)
        parts = [following, y, d] if self.with_y else [following, d]
        return torch.cat(parts, dim=1), y + d if self.has_disturbance else y

    @torch.no_grad()
    def step(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        following, y = self._torch_step(self._tensor(z), self._tensor(u))
        return following.numpy().astype(np.float64), y.numpy().astype(np.float64)

    def jacobians(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`; by reverse differentiation of the step, a row at a time for all points."""
        parts = [self._jacobian(z[i : i + CHUNK], u[i : i + CHUNK]) for i in range(0, len(z), CHUNK)]
        J = np.concatenate(parts)
        return J[:, : self.size], J[:, self.size :]

    def _jacobian(self, z: FloatArray, u: FloatArray) -> FloatArray:
        at = self._tensor(z).requires_grad_(True)
        both = torch.cat(self._torch_step(at, self._tensor(u)), dim=1)
        rows = [torch.autograd.grad(both[:, i].sum(), at, retain_graph=True)[0] for i in range(both.shape[1])]
        return np.asarray(torch.stack(rows, dim=1).numpy(), dtype=np.float64)

    def observe(self, K: FloatArray, z0: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        z, predicted = np.full((len(u) + 1, *z0.shape), np.nan), np.full(y.shape, np.nan)
        z[0] = z0
        step = self.step if len(u) < compiled.LONG else self._compiled_step
        for k in range(len(u)):
            following, predicted[k] = step(z[k], u[k])
            with np.errstate(over="ignore", invalid="ignore"):
                z[k + 1] = following + (K @ (y[k] - predicted[k])[..., None])[..., 0]
        return z, predicted

    def _tensor(self, values: FloatArray) -> torch.Tensor:
        return torch.tensor(values, dtype=self.model.dtype)


class Linear:
    """A linear model: F = A, H = C everywhere."""

    def __init__(self, model: LinearModel, disturbed: bool = False) -> None:
        self.model, self.scaling, system = model, model.scaling, model.system
        self.outputs = len(system.C)
        if disturbed:
            one = np.eye(self.outputs)
            B = np.concatenate([system.B, np.zeros_like(system.D)])
            A, C = scipy.linalg.block_diag(system.A, one), np.concatenate([system.C, one], axis=1)
            system = LinearStateSpace(A, B, C, system.D, system.Ts)
        self.system, self.size = system, system.order

    def disturbed(self) -> Linear:
        """See `Stepper`."""
        return Linear(self.model, True)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """See `Stepper`."""
        return self.model.simulate(u, y_init)

    def start(self, x0: FloatArray, y0: FloatArray) -> FloatArray:
        """See `Stepper`."""
        del y0
        return np.concatenate([x0, np.zeros(self.size - len(x0))])

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
