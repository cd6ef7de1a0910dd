"""NN-SS: a neural LPV state-space model that is Schur at every scheduling point, or quadratically stable.

    x(k+1) = A(ρ) x(k) + B(ρ) u(k),   y(k) = C(ρ) x(k) [+ D(ρ) u(k)],   x(0) = g(y(0))

With an integrator, another option beyond the paper, the outputs sum up what that part gives, v for y above,

    w(k+1) = w(k) + s (v(k) + d),   y(k) = w(k),   w(0) = y(0)

with s the usual size of an output's steps, and d, which is trained, its drift while u is at its mean. So m eigenvalues
are exactly 1, whatever the weights, and the others stay what they are: w feeds nothing back.
The state is then [x; w].

ρ = x by default. A generator network f with sigmoid hidden layers maps ρ to W, V, B, C, and A
follows from W and V by the Schur parametrisation; `nnss_cli.model.incremental` has another one.
The encoder g is a chain of linear layers. D is an option
beyond the paper: without it an input cannot show in the output of the same sample. So is an encoder that sees a window
of W > 1 samples, x(0) = g(y(0), …, y(W−1), u(0), …, u(W−1)), as one output does not determine a state.

Source: A. E. Sertbaş and T. Kumbasar, "Stable-by-Design Neural Network-Based LPV State-Space
Models for System Identification", arXiv:2510.24757, 2025, and the code released with it.
"""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from nnss_cli.datasets.record import Channels, FloatArray, Scaling, Simulation, first_outputs
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.elementary_step import nnss_parts
from nnss_cli.model.incremental import Lure, Plain, advance
from nnss_cli.model.initial import SINGULAR, Step, response, state_from_window
from nnss_cli.model.schur import contraction_matrix, schur_matrix, schur_terms
from nnss_cli.modelfile import Tensors, require_arrays, scaling_arrays, write_model
from nnss_cli.system import Parts, System, system_of

SPREAD = "initial_spread"


class Drift(nn.Module):
    """What an integrator's outputs gain in a sample while the LPV part gives nothing: d (m,), in steps."""

    def __init__(self, outputs: int, dtype: torch.dtype) -> None:
        """No drift."""
        super().__init__()
        self.bias = nn.Parameter(torch.zeros(outputs, dtype=dtype))


class NNSS(nn.Module):
    """The model: two networks, the step they define, and the scaling to physical units."""

    KIND = "nnss"

    def __init__(self, architecture: Architecture, scaling: Scaling, channels: Channels, Ts: float) -> None:
        """Build with zero weights; `initialise` or `load_state_dict` fills them."""
        super().__init__()
        self.architecture = architecture
        self.channels = channels
        self.Ts = Ts
        self.dtype: torch.dtype = getattr(torch, architecture.dtype)
        a = architecture
        self.generator = Lure(a) if a.stability == "incremental" else self._network()
        if a.integrator:
            self.generator_drift = Drift(a.outputs, self.dtype)
        self.encoder = nn.Sequential(
            *(
                nn.Linear(before, width, dtype=self.dtype)
                for before, width in pairwise((a.encoder_inputs, *a.encoder, a.order))
            )
        )
        for name, statistic in asdict(scaling).items():
            self.register_buffer(name, torch.tensor(statistic, dtype=torch.float64))
        self.initial_spread: Tensor  # of the encoder's guess, `nnss_cli.model.initial`
        self.register_buffer(SPREAD, torch.eye(a.states, dtype=torch.float64))
        if a.integrator:
            self.step_size: Tensor
            self.register_buffer("step_size", torch.ones(a.outputs, dtype=self.dtype))
        with torch.no_grad():
            for parameter in self.parameters():
                parameter.zero_()

    def _network(self) -> nn.Sequential:
        a = self.architecture
        layers: list[nn.Module] = []
        for before, width in pairwise((a.scheduling_size, *a.hidden)):
            layers += [nn.Linear(before, width, dtype=self.dtype), nn.Sigmoid()]
        layers.append(nn.Linear(a.hidden[-1], sum(a.parameter_sizes), dtype=self.dtype))
        return nn.Sequential(*layers)

    def initialise(self, random: np.random.Generator) -> None:
        """Glorot-uniform weights and zero biases, as MATLAB's fully connected layers start.

        Drawn in NumPy and float64, so that every precision and engine starts from one point.
        """
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                if name.endswith("bias"):
                    parameter.zero_()
                else:
                    bound = np.sqrt(6.0 / sum(parameter.shape))
                    parameter.copy_(torch.from_numpy(random.uniform(-bound, bound, tuple(parameter.shape))))

    def lpv_part(self) -> NNSS:
        """The model without its integrator, whose output is what the integrator sums up; itself where it has none."""
        if not self.architecture.integrator:
            return self
        part = NNSS(replace(self.architecture, integrator=False), self.scaling, self.channels, self.Ts)
        whole, n = self.state_dict(), self.architecture.order
        whole[SPREAD] = whole[SPREAD][:n, :n]  # lower triangular: its own states come first
        part.load_state_dict({name: whole[name] for name in part.state_dict()})
        return part

    @property
    def scaling(self) -> Scaling:
        """The scaling, from the buffers."""
        return Scaling(*(getattr(self, field.name).numpy() for field in fields(Scaling)))

    def matrices(self, rho: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
        """W (b, 2n, 2n), V (b, n, n), B (b, n, r), C (b, m, n) and D (b, m, r) at scheduling points rho (b, ·).

        D is None for a model without feedthrough.
        """
        n, r, m = self.architecture.order, self.architecture.inputs, self.architecture.outputs
        W, V, B, C, D = self.generator(rho).split(self.architecture.parameter_sizes, dim=-1)
        return (
            W.reshape(-1, 2 * n, 2 * n),
            V.reshape(-1, n, n),
            B.reshape(-1, n, r),
            C.reshape(-1, m, n),
            D.reshape(-1, m, r) if self.architecture.feedthrough else None,
        )

    def state_matrix(self, W: Tensor, V: Tensor) -> Tensor:
        """A (b, n, n) from the generator's W (b, 2n, 2n) and V (b, n, n)."""
        a = self.architecture
        if a.stability == "schur":
            return schur_matrix(W, V, a.gamma, a.epsilon)
        if a.stability == "quadratic":
            return contraction_matrix(W, a.gamma, a.epsilon)
        return W[:, : a.order, : a.order]

    def rho(self, x: Tensor, u: Tensor, y_previous: Tensor) -> Tensor:
        """The scheduling vector: x, and u or the previous output where they are asked for."""
        parts = self.architecture.scheduling.split("+")
        return torch.cat([x] + [u] * ("u" in parts) + [y_previous] * ("y" in parts), dim=-1)

    def step(self, x: Tensor, u: Tensor, y_previous: Tensor) -> tuple[Tensor, Tensor]:
        """One sample, in normalised units: x(k+1) (b, n) and y(k) (b, m) from x (b, n), u (b, r).

        A x = S12 (M⁻¹ x), so A itself is not formed.
        """
        a = self.architecture
        if isinstance(self.generator, Lure):
            return self._lure_step(self._lure_matrices(), x, u)
        x, w = x[..., : a.order], x[..., a.order :]
        W, V, B, C, D = self.matrices(self.rho(x, u, y_previous))
        if a.stability == "schur":
            S12, M = schur_terms(W, V, a.gamma, a.epsilon)
            Ax = S12 @ torch.linalg.solve(M, x.unsqueeze(-1))
        else:
            Ax = self.state_matrix(W, V) @ x.unsqueeze(-1)
        x_next = (Ax + B @ u.unsqueeze(-1)).squeeze(-1)
        y = (C @ x.unsqueeze(-1)).squeeze(-1)
        if D is not None:
            y = y + (D @ u.unsqueeze(-1)).squeeze(-1)
        return self._summed(x_next, w, y)

    def _summed(self, x_next: Tensor, w: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """The whole state and the output: those of an integrator where there is one."""
        if self.architecture.integrator:
            return torch.cat([x_next, w + self.step_size * (y + self.generator_drift.bias)], dim=-1), w
        return x_next, y

    def _lure_matrices(self) -> Plain:
        generator = cast(Lure, self.generator)
        return Plain(*(part.to(self.dtype) for part in generator.plain()))

    def _lure_step(self, plain: Plain, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        n = self.architecture.order
        x_next, y = advance(plain, x[..., :n], u)
        return self._summed(x_next, x[..., n:], y)

    def stepper(self) -> Step:
        """`step` for many samples: what does not depend on them is done once."""
        if not isinstance(self.generator, Lure):
            return self.step
        plain = self._lure_matrices()
        return lambda x, u, _: self._lure_step(plain, x, u)

    def encode(self, seen: Tensor) -> Tensor:
        """x(0) (…, n) from what the encoder sees (…, ·): the encoder's, and y(0) itself for an integrator's.

        It begins with y(0); see `seen`.
        """
        x = self.encoder(seen)
        return torch.cat([x, seen[..., : self.architecture.outputs]], dim=-1) if self.architecture.integrator else x

    def seen(self, u: Tensor, y: Tensor) -> Tensor:
        """What the encoder sees from each sample on (…, K − W + 1, ·), of inputs (…, K, r) and outputs (…, K, m)."""
        W = self.architecture.encoder_window
        return y if W == 1 else torch.cat([part.unfold(-2, W, 1).mT.flatten(-2) for part in (y, u)], dim=-1)

    def forward(
        self, u: Tensor, seen: Tensor, y_previous: Tensor | None = None, x0: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Free simulation of a batch, in normalised units.

        Args:
            u: inputs (b, K, r).
            seen: what the encoder sees from the first sample on (b, ·): y(0), or a window of outputs and inputs.
            y_previous: output before the first (b, m), for scheduling on y; y(0) where it is None.
            x0: initial state (b, n); the encoder's where it is None.

        Returns:
            y (b, K, m) and x (b, K, n).
        """
        x = self.encode(seen) if x0 is None else x0
        y_previous = seen[:, : self.architecture.outputs] if y_previous is None else y_previous
        xs, ys = [], []
        step = self.stepper()
        for k in range(u.shape[1]):
            xs.append(x)
            x, y_previous = step(x, u[:, k], y_previous)
            ys.append(y_previous)
        return torch.stack(ys, dim=1), torch.stack(xs, dim=1)

    def initial_state(self, u: Tensor, y: Tensor) -> Tensor:
        """x(0) (1, n) from first outputs y (w, m) and inputs u (≥ w, r), in normalised units.

        The encoder's where w = 1 or where it sees a window itself; else the one that explains the outputs best
        (`nnss_cli.model.initial`).

        Raises:
            InputError: fewer outputs than the encoder sees.
        """
        W = self.architecture.encoder_window
        self.architecture.check_first(len(y))
        guess = self.encode(self.seen(u[:W], y[:W]))
        if len(y) == 1 or W > 1:
            return guess
        step = self.stepper()

        def evaluate(x0: FloatArray) -> tuple[FloatArray, FloatArray]:
            try:
                simulated, J = response(step, torch.tensor(x0, dtype=self.dtype), u[: len(y)], y[0])
            except SINGULAR:  # as good as not finite
                return np.full(y.numel(), np.inf), np.full((y.numel(), len(x0)), np.inf)
            return (simulated - y).ravel().numpy().astype(np.float64), J.flatten(0, 1).numpy().astype(np.float64)

        x0 = state_from_window(
            evaluate, guess[0].numpy().astype(np.float64), torch.finfo(self.dtype).eps, self.initial_spread.numpy()
        )
        return torch.tensor(x0, dtype=self.dtype)[None]

    @torch.no_grad()
    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """Free simulation in physical units, from the x(0) of `initial_state`.

        Args:
            u: inputs (K, r).
            y_init: first output samples (w, m), or (m,) for one.

        Raises:
            InputError: there is no such sample, or there are more than inputs, or fewer than the encoder sees.
        """
        scaling = self.scaling
        u_scaled = torch.tensor(scaling.normalise_u(u), dtype=self.dtype)[None]
        known = torch.tensor(scaling.normalise_y(first_outputs(y_init, u, self.architecture.outputs)), dtype=self.dtype)
        y, x = self(u_scaled, known[:1], x0=self.initial_state(u_scaled[0], known))
        return Simulation(scaling.restore_y(y[0].numpy().astype(np.float64)), x[0].numpy().astype(np.float64))

    def elementary_parts(self) -> Parts:
        """Its formulas in elementary operations, in normalised units."""
        layer = None
        if isinstance(self.generator, Lure):
            layer = tuple(part.detach().numpy() for part in self.generator.plain())
        weights = {name: tensor.numpy() for name, tensor in self.state_dict().items()}
        return nnss_parts(self.architecture, weights, layer)

    def elementary(self) -> System:
        """The model in elementary operations and physical units, float64 whatever its own precision."""
        return system_of([self.elementary_parts()], self.scaling)

    def to_file(self) -> tuple[dict[str, Any], Tensors]:
        """What is kept of the model on disk: its description and its arrays."""
        description = {
            "kind": self.KIND,
            "Ts": self.Ts,
            "channels": asdict(self.channels),
            "architecture": asdict(self.architecture),
        }
        return description, {name: tensor.numpy() for name, tensor in self.state_dict().items()}

    def save(self, folder: Path) -> None:
        """Write model.json and model.safetensors into `folder`."""
        write_model(folder, *self.to_file())

    @classmethod
    def from_file(cls, description: dict[str, Any], tensors: Tensors) -> NNSS:
        """The inverse of `save`."""
        settings = description["architecture"]
        settings |= {"hidden": tuple(settings["hidden"]), "encoder": tuple(settings["encoder"])}
        channels = Channels(**{name: tuple(names) for name, names in description["channels"].items()})
        scaling = Scaling(*(tensors[field.name] for field in fields(Scaling)))
        architecture = Architecture(**settings)
        model = cls(architecture, scaling, channels, description["Ts"])
        expected = {name: (tuple(own.shape), architecture.dtype) for name, own in model.named_parameters()}
        if architecture.integrator:
            expected["step_size"] = ((architecture.outputs,), architecture.dtype)
        expected[SPREAD] = (tuple(model.initial_spread.shape), "float64")
        tensors = {SPREAD: model.initial_spread.numpy()} | tensors  # a folder of format 2 or 1 has none
        require_arrays(tensors, expected | scaling_arrays(architecture.inputs, architecture.outputs))
        model.load_state_dict({name: torch.from_numpy(array.copy()) for name, array in tensors.items()})
        return model
