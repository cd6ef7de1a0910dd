"""What the training loop asks of an engine, and the plain one: the readable reference.

Faster engines are checked against `ReferenceEngine`, so it stays close to the equations.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Protocol, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from nnss_cli.datasets.record import FloatArray, Record, unscored
from nnss_cli.model.initial import SINGULAR, spread_of
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors
from nnss_cli.training.least_squares import Block
from nnss_cli.training.recipe import Recipe


class Engine(Protocol):
    """Holds the weights while they are trained, and N windows of any lengths.

    The loss over several windows is that of `training_loss`, the mean over those of one length, weighted by samples.
    """

    def train_batch(self, windows: NDArray[np.int64], epoch: int) -> float:
        """One Adam step on the windows of these indices; the loss before the step."""
        ...

    def place(self, vector: FloatArray) -> None:
        """Take these weights, one vector in the order of `weights`."""
        ...

    def loss_and_gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Take these weights; the loss over all windows and its gradient."""
        ...

    def sensitivities(self, x0: FloatArray) -> Iterator[Block]:
        """Errors ŷ − y of all windows simulated from the initial states x0 (N, n), with derivatives.

        They come in blocks, window after window, sample after sample, with derivatives by the generator's weights and
        the window's initial state. Where y schedules, windows start at their second sample.
        """
        ...

    def free_run(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Simulated outputs (K, m) of inputs (K, r), in normalised units.

        From the encoder's x(0) for a first output (m,), or the x(0) that explains first outputs (w, m) best.
        """
        ...

    def see(self, records: Sequence[Record]) -> FloatArray:
        """Take from simulations of these records how far x(0) may be from the encoder's guess; L (n, n).

        `nnss_cli.model.initial` has what it is for. An encoder that sees a window is not asked: its guess stays.
        """
        ...

    def weights(self) -> Tensors:
        """A copy of the weights, by the names of `NNSS.state_dict`."""
        ...


def training_loss(model: NNSS, u: Tensor, y: Tensor, consistency: float) -> Tensor:
    """Response error plus λ times state consistency, in normalised units.

        J = mean (y − ŷ)² + λ mean (x(k) − g(y(k)))²,   k ≥ 1 in the second term

    An encoder that sees W samples from k on is asked as far as they are in the window, k ≤ L − W.
    Where y schedules, the first sample serves as previous output and the window starts at the
    second, as in the released code.

    Args:
        model: the model.
        u: inputs (b, L, r).
        y: measured outputs (b, L, m).
        consistency: λ.
    """
    y_previous, u, y = split_first(model, u, y)
    seen = model.seen(u, y)
    y_simulated, x = model(u, seen[:, 0], y_previous)
    response = (y_simulated - y).square().mean()
    if consistency == 0 or seen.shape[1] == 1:
        return response
    x = x[:, 1 : seen.shape[1], : model.architecture.order]  # an integrator's states are the outputs
    return response + consistency * (x - model.encoder(seen[:, 1:])).square().mean()


def split_first(model: NNSS, u: Tensor, y: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
    """Where y schedules: the first output (b, m), and the windows from their second sample on."""
    if "y" in model.architecture.scheduling:
        return y[:, 0], u[:, 1:], y[:, 1:]
    return None, u, y


class ReferenceEngine:
    """torch, one operation after the other."""

    def __init__(self, model: NNSS, u: Sequence[FloatArray], y: Sequence[FloatArray], recipe: Recipe) -> None:
        """Train `model` in place on windows u (L, r), y (L, m), of any lengths, in normalised units."""
        self.model = model
        self.recipe = recipe
        self.u = [torch.tensor(window, dtype=model.dtype) for window in u]
        self.y = [torch.tensor(window, dtype=model.dtype) for window in y]
        model.encoder.requires_grad_(not recipe.fixed_encoder)
        self.optimiser = torch.optim.Adam(model.parameters(), lr=recipe.learning_rate)

    def by_length(self, windows: Sequence[int]) -> list[list[int]]:
        """The windows of these indices, those of one length together."""
        lengths = [len(self.y[i]) for i in windows]
        return [[i for i in windows if len(self.y[i]) == L] for L in dict.fromkeys(lengths)]

    def loss(self, windows: Sequence[int]) -> Tensor:
        """The training loss of the windows of these indices, weighted by samples."""
        unscored = "y" in self.model.architecture.scheduling
        samples = sum(len(self.y[i]) - unscored for i in windows)
        parts = []
        for chosen in self.by_length(windows):
            u, y = (torch.stack([signal[i] for i in chosen]) for signal in (self.u, self.y))
            share = len(chosen) * (y.shape[1] - unscored) / samples
            parts.append(share * training_loss(self.model, u, y, self.recipe.consistency))
        return torch.stack(parts).sum()

    def train_batch(self, windows: NDArray[np.int64], epoch: int) -> float:
        """One Adam step; see `Engine`."""
        self.optimiser.zero_grad(set_to_none=True)
        loss = self.loss(windows.tolist())
        loss.backward()
        # The released code corrects Adam's bias by the epoch's number instead of the step's.
        for state in self.optimiser.state.values():
            state["step"].fill_(epoch - 1)
        self.optimiser.step()
        return loss.item()

    def place(self, vector: FloatArray) -> None:
        """Take these weights; see `Engine`."""
        torch.nn.utils.vector_to_parameters(torch.tensor(vector, dtype=self.model.dtype), self.model.parameters())

    def loss_and_gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Loss over all windows; see `Engine`."""
        self.place(vector)
        self.optimiser.zero_grad(set_to_none=False)
        loss = self.loss(range(len(self.u)))
        loss.backward()
        gradient = torch.cat(
            [p.grad.ravel() if p.grad is not None else p.new_zeros(p.numel()) for p in self.model.parameters()]
        )
        return loss.item(), gradient.numpy().astype(np.float64)

    def sensitivities(self, x0: FloatArray) -> Iterator[Block]:
        """Errors and their derivatives, a block a window; see `Engine`."""
        named = {name: p.detach() for name, p in self.model.named_parameters() if name.startswith("generator")}
        for window in range(len(self.u)):
            y_previous, u, y = split_first(self.model, self.u[window][None], self.y[window][None])
            y_first = y[:, 0] if y_previous is None else y_previous

            def run(*values: Tensor, u: Tensor = u, y_first: Tensor = y_first) -> tuple[Tensor, Tensor]:
                weights = dict(zip(named, values[:-1], strict=True))
                return cast(
                    tuple[Tensor, Tensor],
                    torch.func.functional_call(self.model, weights, (u, y_first), {"x0": values[-1]}),
                )

            at = (*named.values(), torch.tensor(x0[window : window + 1], dtype=self.model.dtype))
            y_simulated, states = run(*at)
            parts = torch.autograd.functional.jacobian(lambda *values, run=run: run(*values)[0], at)
            derivatives = torch.cat([part.flatten(3) for part in parts], dim=3).flatten(0, 2)
            own = states[0, :, : self.model.architecture.order]
            e, J, x = (part.numpy().astype(np.float64) for part in ((y_simulated - y).ravel(), derivatives, own))
            yield Block(e, J, window, x)

    @torch.no_grad()
    def free_run(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free simulation; see `Engine`."""
        inputs, known = (torch.tensor(signal, dtype=self.model.dtype) for signal in (u, np.atleast_2d(y_init)))
        y, _ = self.model(inputs[None], known[:1], x0=self.model.initial_state(inputs, known))
        return np.asarray(y[0].numpy(), dtype=np.float64)

    @torch.no_grad()
    def see(self, records: Sequence[Record]) -> FloatArray:
        """L of what the encoder's guesses are off by; see `Engine`."""
        if self.model.architecture.encoder_window == 1:
            deviations = []
            for record in records:
                u, y = (torch.tensor(signal, dtype=self.model.dtype) for signal in (record.u, record.y))
                try:
                    deviations.append((self.model(u[None], y[:1])[1][0] - self.model.encode(y)).numpy())
                except SINGULAR:  # as good as not finite
                    deviations.append(np.full((1, self.model.architecture.states), np.inf))
            self.model.initial_spread.copy_(torch.from_numpy(spread_of(np.concatenate(deviations))))
        return self.model.initial_spread.numpy()

    def weights(self) -> Tensors:
        """A copy of the weights; see `Engine`."""
        return {name: parameter.detach().numpy().copy() for name, parameter in self.model.named_parameters()}


def free_run_rmse(engine: Engine, records: tuple[Record, ...], init_window: int = 1) -> float:
    """Root mean square error of free simulations over all samples and outputs, in normalised units.

    Args:
        engine: holds the weights.
        records: in normalised units.
        init_window: first samples that tell x(0), w; where w > 1 they are not scored.
    """
    errors = free_run_errors(engine, records, init_window)
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(np.square(np.concatenate([each.ravel() for each in errors])))))


def free_run_errors(engine: Engine, records: tuple[Record, ...], init_window: int = 1) -> list[FloatArray]:
    """Errors (K, m) of a free simulation of each record, in normalised units; see `free_run_rmse`."""
    begin = unscored(init_window)
    with np.errstate(over="ignore", invalid="ignore"):
        return [(engine.free_run(record.u, record.y[:init_window]) - record.y)[begin:] for record in records]
