"""The step of an NN-SS model for predictors and linearisations: in torch, and along many samples compiled."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch

from nnss_cli.datasets.record import FloatArray, Simulation
from nnss_cli.methods import compiled
from nnss_cli.model.initial import SINGULAR
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights, ready_to_run
from nnss_cli.validation.disturbance import Disturbance
from nnss_cli.validation.stepping import CHUNK, Step, observed


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
        return observed(self.step_along(len(u)), K, z0, u, y)

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
        return observed(lambda z, v: self._step(own, z, v), K, z0, u, y)
