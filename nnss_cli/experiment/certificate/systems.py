"""A model as the certificate's searches see it: trajectories, A(ρ), bounds of its entries; in normalised units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import FloatArray, Record, Scaling
from nnss_cli.experiment.certificate import lti
from nnss_cli.experiment.certificate.affine import enclosed
from nnss_cli.experiment.certificate.dynamics import Dynamics
from nnss_cli.experiment.certificate.region import constant
from nnss_cli.iterative import named_random
from nnss_cli.model.incremental import Lure
from nnss_cli.model.nnss import NNSS
from nnss_cli.system import System, system_of
from nnss_cli.training.fast import Weights

HORIZON, ASCENTS, RESTARTS = 120, 25, 8  # of the adversarial input


@dataclass(frozen=True)
class Promise:
    """What a parametrisation promises at every ρ, for all weights."""

    radius: bool
    """ρ(A(ρ)) < γ."""
    norm: bool
    """‖A(ρ)‖₂ < γ, so that ‖x‖² is a Lyapunov function."""
    pairs: bool = False
    """‖x1(k) − x2(k)‖ ≤ γᵏ ‖x1(0) − x2(0)‖ under any one input."""


PROMISES = {
    "schur": Promise(radius=True, norm=False),
    "quadratic": Promise(radius=True, norm=True),
    "incremental": Promise(radius=True, norm=True, pairs=True),
    "none": Promise(radius=False, norm=False),
}  # fmt: skip
"""By the name of the option `--stability`."""


class Neural:
    kind = "nnss"

    def __init__(self, model: NNSS) -> None:
        integrates = model.architecture.integrator
        self.covers = (
            "the LPV part: the outputs integrate what it gives and have no bound" if integrates else "the model"
        )
        self.whole = Weights(model)
        self.integrates = integrates
        model = model.lpv_part()
        self.model, self.weights = model, Weights(model)
        a = self.architecture = model.architecture
        self.stability, self.promise = a.stability, PROMISES[a.stability]
        self.gamma = a.gamma if self.promise.radius else math.inf
        self.examined = model  # what runs is held to a promise; without one A is that of the weights, in float64
        if not self.promise.radius:
            self.examined = NNSS(replace(a, dtype="float64"), model.scaling, model.channels, model.Ts)
            self.examined.load_state_dict(model.state_dict())

    @property
    def finds_state(self) -> bool:
        """Whether a simulation from several outputs starts elsewhere than where the encoder says."""
        return self.architecture.encoder_window == 1

    def starts(self, records: int, w: int) -> str:
        """Which initial states are covered, in words."""
        W = self.architecture.encoder_window
        if W > 1:
            return f"x(0) = g of the first {W} samples of the {records} records given"
        window = f" or found from their first {w} samples" if w > 1 else ""
        return f"x(0) = g(y(0)) of the {records} records given{window}"

    def constant(self) -> LinearStateSpace | None:
        """The system, if A, B, C and D do not depend on ρ: nothing schedules, or nothing comes of it."""
        a = self.architecture
        layers: Any = self.model.generator
        if isinstance(layers, Lure):
            return None
        first, last = (layer.weight.detach().numpy() for layer in (layers[0], layers[-1]))
        W, V, *rest = np.split(last, np.cumsum(a.parameter_sizes[:-1]))
        if self.stability == "none":  # A is a quarter of W
            W = W.reshape(2 * a.order, 2 * a.order, -1)[: a.order, : a.order]
        used = [W, *rest, *[V] * (self.stability == "schur")]
        if first.any() and any(part.any() for part in used):
            return None
        parts = self.model.elementary_parts()
        system = system_of([parts], _unit(a.inputs, a.outputs))
        z, u = np.zeros(system.size), np.zeros(a.inputs)
        found = system.frozen(z=z[:, None], u=u[:, None])
        A, B, C, D = (found[name] for name in "ABCD")
        return LinearStateSpace(A, B, C, D, self.model.Ts)

    def dynamics(self) -> Dynamics | str:
        """What proofs over a region speak of, or why there are none."""
        a = self.architecture
        parts = a.scheduling.split("+")
        if "y" in parts:
            return "it is scheduled on its previous output, for which no region is proved"
        return Dynamics.of(self.model.elementary_parts(), a.inputs, a.outputs, "u" in parts)

    def in_elementary_operations(self) -> System:
        """The model in normalised units, to be differentiated."""
        a = self.architecture
        return system_of([self.model.elementary_parts()], _unit(a.inputs, a.outputs))

    def trajectory(self, record: Record) -> tuple[FloatArray, FloatArray]:
        """y (K, m) and x (K, n) of a record, simulated from the encoder's x(0)."""
        return self.weights.free_run(record.u, record.y[: self.architecture.encoder_window])

    def scheduling(self, record: Record, y: FloatArray, x: FloatArray) -> FloatArray:
        """ρ along the trajectory of a record (K, ·)."""
        previous = np.concatenate([record.y[:1], y[:-1]])
        parts = self.architecture.scheduling.split("+")
        rho = np.concatenate([x] + [record.u] * ("u" in parts) + [previous] * ("y" in parts), axis=1)
        finite = rho[np.isfinite(rho).all(axis=1)]
        return finite if len(finite) else rho[:1]

    def torch_matrices(self, rho: torch.Tensor) -> torch.Tensor:
        W, V, *_ = self.examined.matrices(rho)
        return self.examined.state_matrix(W, V)

    @torch.no_grad()
    def matrices(self, rho: FloatArray) -> FloatArray:
        """A(ρ) (N, n, n)."""
        return np.asarray(self.torch_matrices(torch.tensor(rho, dtype=self.examined.dtype)).numpy(), dtype=np.float64)

    def proved_radius(self, rho: FloatArray) -> tuple[float, float]:
        """ρ(A) at one ρ (·,), of the weights as they are stored, and its margin, with all rounding."""
        a = self.architecture
        system, parts = self.in_elementary_operations(), a.scheduling.split("+")
        u = rho[a.order :][: a.inputs] if "u" in parts else np.zeros(a.inputs)
        z = np.concatenate([rho[: a.order], rho[len(rho) - system.outputs_kept :]])
        A = enclosed(system.frozen, z=constant(z, 1), u=constant(u, 1))["A"]
        return lti.spectral_radius(A.c[0], A.spread()[0])

    def state_from_window(self, record: Record, w: int) -> FloatArray:
        """x(0) (n,) that explains the record's first w samples best, as a simulation from them starts."""
        found = self.whole.initial_state(record.u, record.y[:w])
        return np.asarray(found[: self.architecture.order], dtype=np.float64)

    def rounding(self) -> float:
        """Relative excess over `state_bound` that rounding explains: η/(1 − γ (1 + η)) where a step errs by η = k u.

        k counts the products that an entry of B and one of x(k+1) sum up, and a sigmoid's last bit.
        """
        a = self.architecture
        eta = (a.hidden[-1] + 2 * a.order + a.inputs + 2) * float(np.finfo(a.dtype).eps)
        return eta / max(1 - self.gamma * (1 + eta), eta)

    def output_bounds(self) -> tuple[float, float, float]:
        """sup‖B‖₂, sup‖C‖₂ and sup‖D‖₂: entry by entry over all outputs in [0, 1] of the last sigmoid layer."""
        a = self.architecture
        if isinstance(self.model.generator, Lure):
            of_B, of_C, of_D = (float(np.linalg.norm(part, 2)) for part in self.model.generator.output_bounds())
            return of_B, of_C, of_D
        layer: Any = self.model.generator[-1]
        weight, bias = (tensor.detach().numpy().astype(np.float64) for tensor in (layer.weight, layer.bias))
        highest = bias + np.maximum(weight, 0).sum(axis=1)
        lowest = bias + np.minimum(weight, 0).sum(axis=1)
        largest = np.maximum(np.abs(highest), np.abs(lowest))
        _, _, B, C, D = np.split(largest, np.cumsum(a.parameter_sizes[:-1]))
        B, C = B.reshape(a.order, a.inputs), C.reshape(a.outputs, a.order)
        D = D.reshape(a.outputs, a.inputs) if a.feedthrough else np.zeros((1, 1))
        return float(np.linalg.norm(B, 2)), float(np.linalg.norm(C, 2)), float(np.linalg.norm(D, 2))

    def run(self, u: FloatArray, y0: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.weights.free_runs(u, y0, x0)

    @torch.no_grad()
    def next_state(self, x: FloatArray, u: FloatArray, y_previous: FloatArray) -> FloatArray:
        """x(k+1) (n, b) from x(k) (n, b), u(k) (r, b) and y(k−1) (m, b)."""
        at = [torch.tensor(part.T.copy(), dtype=self.model.dtype) for part in (x, u, y_previous)]
        return np.asarray(self.model.step(*at)[0].numpy().T)

    def adversary(self, low: FloatArray, high: FloatArray, y0: FloatArray, x0: FloatArray) -> FloatArray:
        """Inputs (HORIZON, r) inside the range that drive ‖x‖ as far as gradient ascent finds, from x0 and y0."""
        a, dtype = self.architecture, self.model.dtype
        random = named_random(0, "adversary")
        middle, half = torch.tensor((high + low) / 2, dtype=dtype), torch.tensor((high - low) / 2, dtype=dtype)
        free = torch.tensor(random.uniform(-1, 1, (RESTARTS, HORIZON, a.inputs)), dtype=dtype)
        first, begin = (torch.tensor(np.tile(start, (RESTARTS, 1)), dtype=dtype) for start in (y0, x0))
        best, reached = free[0].clone(), -1.0
        for step in range(ASCENTS):
            free.requires_grad_(True)
            _, x = self.model(middle + half * free, first, x0=begin)
            norms = torch.linalg.norm(x[:, -1], dim=1)
            (slope,) = torch.autograd.grad(norms.sum(), free)
            with torch.no_grad():
                leader = int(torch.nan_to_num(norms, nan=-1.0).argmax())
                if float(norms[leader]) > reached:
                    best, reached = free[leader].detach().clone(), float(norms[leader])
                free = (free + 0.5 / (1 + step / 5) * torch.sign(torch.nan_to_num(slope))).clamp(-1, 1).detach()
        return np.asarray((middle + half * best).numpy(), dtype=np.float64)


class Linear:
    kind = stability = "linear"
    covers = "the model"
    gamma = math.inf  # a linear method promises nothing
    promise = PROMISES["none"]
    integrates = False
    finds_state = True

    def __init__(self, model: LinearModel) -> None:
        self.system = model.system

    def trajectory(self, record: Record) -> tuple[FloatArray, FloatArray]:
        """y (K, m) and x (K, n) of a record, simulated from y(0)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self.system.simulate(record.u, self.initial_state(record))

    def scheduling(self, record: Record, y: FloatArray, x: FloatArray) -> FloatArray:
        """Nothing schedules: one point stands for all."""
        del record, y, x
        return np.zeros((1, 1))

    def matrices(self, rho: FloatArray) -> FloatArray:
        return np.repeat(self.system.A[None], len(rho), axis=0)

    def initial_state(self, record: Record) -> FloatArray:
        return self.system.state_from_output(record.y[0], record.u[0])

    def state_from_window(self, record: Record, w: int) -> FloatArray:
        """x(0) (n,) that explains the record's first w samples best."""
        return self.system.state_from_outputs(record.y[:w], record.u)

    def constant(self) -> LinearStateSpace:
        """The system."""
        return self.system

    def output_bounds(self) -> tuple[float, float, float]:
        B, C, D = (float(np.linalg.norm(part, 2)) for part in (self.system.B, self.system.C, self.system.D))
        return B, C, D

    def run(self, u: FloatArray, y0: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        del y0
        both = [self.system.simulate(np.ascontiguousarray(u[:, :, c]), x0[:, c]) for c in range(u.shape[2])]
        return np.stack([y for y, _ in both], axis=2), np.stack([x for _, x in both], axis=2)

    def next_state(self, x: FloatArray, u: FloatArray, y_previous: FloatArray) -> FloatArray:
        del y_previous
        with np.errstate(over="ignore", invalid="ignore"):
            return self.system.A @ x + self.system.B @ u

    def adversary(self, low: FloatArray, high: FloatArray, y0: FloatArray, x0: FloatArray) -> FloatArray:
        """For a fixed direction d of x(K) the worst input is the sign of Bᵀ (Aᵀ)^(K−1−k) d; d follows x(K) then."""
        del y0
        A, B = self.system.A, self.system.B
        d = np.ones(len(A)) / np.sqrt(len(A))
        u = np.zeros((HORIZON, B.shape[1]))
        for _ in range(ASCENTS):
            with np.errstate(over="ignore", invalid="ignore"):
                back = d
                for k in range(HORIZON - 1, -1, -1):
                    u[k] = np.where(B.T @ back > 0, high, low)
                    back = A.T @ back
                x = x0
                for sample in u:
                    x = A @ x + B @ sample
            if not np.isfinite(x).all() or not np.linalg.norm(x) > 0:
                break
            d = x / np.linalg.norm(x)
        return u


def radii(matrices: FloatArray) -> FloatArray:
    return np.asarray(np.abs(np.linalg.eigvals(matrices)).max(axis=1))


def _unit(inputs: int, outputs: int) -> Scaling:
    """The scaling that changes nothing."""
    return Scaling(np.zeros(inputs), np.ones(inputs), np.zeros(outputs), np.ones(outputs))
