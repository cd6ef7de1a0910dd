"""A model's step and its Jacobians on arrays, in normalised units: what a predictor and a linearisation need of it.

    z(k+1) = f(z(k), u(k)),   y(k) = h(z(k), u(k)),   F = ∂f/∂z,   H = ∂h/∂z

z is the state x, and the previous output after it where that schedules. `disturbed` puts the state of a disturbance of
the outputs below it (`nnss_cli.validation.disturbance`), which a gain can let follow what the model misses.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Protocol, TypeAlias

import numpy as np
import torch

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace, propagate
from nnss_cli.datasets.record import FloatArray, Scaling, Simulation
from nnss_cli.errors import InputError
from nnss_cli.methods import Model, compiled
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.initial import SINGULAR
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights, ready_to_run
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
    """An NN-SS model by its own torch step; along `LONG` samples by the compiled one, equal up to rounding."""

    def __init__(self, model: NNSS) -> None:
        self.model, self.scaling = model, model.scaling
        a = model.architecture
        self.outputs, self.order, self.sees = a.outputs, a.states, a.encoder_window
        self.with_y = "y" in a.scheduling.split("+")
        self.size = a.states + a.outputs * self.with_y

    def disturbed(self, by: Disturbance) -> DisturbedNeural:
        """See `Stepper`."""
        return DisturbedNeural(self, by)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """See `Stepper`."""
        return compiled.free_run(self.model, u, y_init)

    @cached_property
    def _compiled(self) -> Weights:
        return ready_to_run(self.model)

    def _compiled_step(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """As `step`, of a few points: two samples of a free run; the second tells the state after the first."""
        n, m = self.order, self.outputs
        before = z[:, n : n + m] if self.with_y else np.zeros((len(z), m))
        y, x = self._compiled.free_runs(np.stack([u.T, u.T]), before.T, z[:, :n].T)
        output, following = y[0].T.astype(np.float64), x[1].T.astype(np.float64)
        return np.concatenate([following, output], axis=1) if self.with_y else following, output

    def step_along(self, samples: int) -> Step:
        """What steps along a record of so many samples."""
        return self.step if samples < compiled.LONG else self._compiled_step

    def start(self, x0: FloatArray, y0: FloatArray, u0: FloatArray) -> FloatArray:
        """See `Stepper`."""
        del u0
        return np.concatenate([x0, y0]) if self.with_y else x0

    def _torch_step(self, z: torch.Tensor, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x, before = z.split([self.order, self.outputs * self.with_y], dim=1)
        following, y = self.model.step(x, u, before)
        return torch.cat([following, y], dim=1) if self.with_y else following, y

    @torch.no_grad()
    def step(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        try:
            following, y = self._torch_step(self._tensor(z), self._tensor(u))
        except SINGULAR:  # where torch refuses a point, compiled code has numbers that are not finite
            return self._compiled_step(z, u)
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
        return _observed(self.step_along(len(u)), K, z0, u, y)

    def _tensor(self, values: FloatArray) -> torch.Tensor:
        return torch.tensor(values, dtype=self.model.dtype)


class DisturbedNeural:
    """An NN-SS model and a disturbance of its outputs."""

    def __init__(self, own: Neural, by: Disturbance) -> None:
        self.own, self.by = own, by
        self.model, self.scaling, self.outputs, self.sees = own.model, own.scaling, own.outputs, own.sees
        self.size = own.size + by.size

    def disturbed(self, by: Disturbance) -> DisturbedNeural:
        """See `Stepper`; in place of the one it has."""
        return self.own.disturbed(by)

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """See `Stepper`; of the model alone."""
        return self.own.simulate(u, y_init)

    def start(self, x0: FloatArray, y0: FloatArray, u0: FloatArray) -> FloatArray:
        """See `Stepper`."""
        z = self.own.start(x0, y0, u0)
        h = self.own.step(z[None], u0[None])[1][0]
        return np.concatenate([z, self.by.begin @ np.concatenate([y0, u0, h])])

    def step(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        return self._step(self.own.step, z, u)

    def _step(self, own: Step, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        by, n = self.by, self.own.size
        following, h = own(z[:, :n], u)
        w, v = z[:, n:], np.concatenate([u, h], axis=1)
        with np.errstate(over="ignore", invalid="ignore"):
            return np.concatenate([following, w @ by.A.T + v @ by.B.T], axis=1), w @ by.C.T + v @ by.D.T

    def jacobians(self, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        by, n, r = self.by, self.own.size, self.by.inputs
        own, h = self.own.jacobians(z[:, :n], u)
        F, H = np.zeros((len(z), self.size, self.size)), np.zeros((len(z), self.outputs, self.size))
        F[:, :n, :n], F[:, n:, :n], F[:, n:, n:] = own, by.B[:, r:] @ h, by.A
        H[:, :, :n], H[:, :, n:] = by.D[:, r:] @ h, by.C
        return F, H

    def observe(self, K: FloatArray, z0: FloatArray, u: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """See `Stepper`."""
        own = self.own.step_along(len(u))
        return _observed(lambda z, v: self._step(own, z, v), K, z0, u, y)


def _observed(
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
