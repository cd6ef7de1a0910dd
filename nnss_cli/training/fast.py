"""The fast engine: `kernels` behind the interface of the reference engine."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.datasets.windows import Windows
from nnss_cli.lock import compiling
from nnss_cli.model import kernels
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.initial import spread_of, state_from_window
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors
from nnss_cli.training.encoder import Layers, encoder_gradient, encoder_map, seen_windows
from nnss_cli.training.least_squares import Block
from nnss_cli.training.lure import CompiledLure
from nnss_cli.training.recipe import Recipe

STRETCH = 2048  # samples whose derivatives are held at a time


class Weights:
    """All weights of an NN-SS model as one vector, with named views into it."""

    def __init__(self, model: NNSS) -> None:
        """Copy the model's weights."""
        a = self.architecture = model.architecture
        parameters = {name: parameter.detach().numpy() for name, parameter in model.named_parameters()}
        self.shapes = {name: array.shape for name, array in parameters.items()}
        self.vector = np.concatenate([array.ravel() for array in parameters.values()])
        self.generator_size = sum(array.size for name, array in parameters.items() if name.startswith("generator"))
        self.drift = slice(self.generator_size - a.outputs * a.integrator, self.generator_size)
        self.step_size = model.step_size.numpy() if a.integrator else np.ones(0)
        self.initial_spread = model.initial_spread.numpy().copy()
        self.widths = np.array([a.scheduling_size, *a.hidden, sum(a.parameter_sizes)])
        self.lure: CompiledLure | None = None
        if a.stability == "incremental":
            own = {name.partition(".")[2]: view for name, view in self.views(self.vector).items() if _of_layer(name)}
            self.lure = CompiledLure(a, own)

    def views(self, vector: FloatArray) -> dict[str, FloatArray]:
        """`vector` cut into the shapes of the weights, without copying."""
        cut, start = {}, 0
        for name, shape in self.shapes.items():
            size = int(np.prod(shape))
            cut[name] = vector[start : start + size].reshape(shape)
            start += size
        return cut

    def encoder(self, vector: FloatArray) -> Layers:
        """The encoder's layers in `vector`, as views."""
        arrays = [view for name, view in self.views(vector).items() if name.startswith("encoder")]
        return list(zip(arrays[::2], arrays[1::2], strict=True))

    def encode(self, seen: FloatArray) -> FloatArray:
        """Initial states (n, b) from what the encoder sees (·, b), y(0) first; an integrator's are these outputs."""
        a = self.architecture
        E, e = encoder_map(self.encoder(self.vector), a.encoder_inputs)[-1]
        x = E @ seen + e[:, None]
        return np.concatenate([x, seen[: a.outputs]]) if a.integrator else x

    def initial_state(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """x(0) (n,) from first outputs y (w, m) and inputs u (≥ w, r); see `NNSS.initial_state`."""
        W = self.architecture.encoder_window
        self.architecture.check_first(len(y))
        y = np.asarray(y, self.vector.dtype)
        guess = self.encode(seen_windows(np.asarray(u[:W], self.vector.dtype), y[:W], W).T)[:, 0]
        return guess if len(y) == 1 or W > 1 else self.state_from(u, y, guess)

    def free_run(self, u: FloatArray, y_init: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Simulated outputs (K, m) and states (K, n) in normalised units; see `Engine`."""
        known = np.atleast_2d(np.array(y_init, self.vector.dtype))
        y, x = self.free_runs(u[:, :, None], known[:1].T, self.initial_state(u, known)[:, None])
        return y[:, :, 0], x[:, :, 0]

    def state_from(self, u: FloatArray, y: FloatArray, guess: FloatArray) -> FloatArray:
        """The x(0) (n,) that explains first outputs y (w, m) best; see `nnss_cli.model.initial`."""
        n, p = self.architecture.states, self.generator_size

        def evaluate(x0: FloatArray) -> tuple[FloatArray, FloatArray]:
            parts = list(self.sensitivities(x0, u[: len(y)], y[0]))
            simulated, J = (np.concatenate([part[i] for part in parts]) for i in (0, 2))
            return (simulated - y).ravel().astype(np.float64), J[:, :, p:].reshape(-1, n).astype(np.float64)

        return state_from_window(evaluate, guess, float(np.finfo(self.vector.dtype).eps), self.initial_spread)

    def deviations(self, u: FloatArray, y: FloatArray) -> FloatArray:
        """x(k) − g(y(k)) (K, n) along a simulation of inputs u (K, r) from the guess g(y(0)) of outputs y (K, m)."""
        guesses = self.encode(np.asarray(y, self.vector.dtype).T)
        _, x = self.free_runs(u[:, :, None], y[:1].T, guesses[:, :1])
        with np.errstate(over="ignore", invalid="ignore"):
            return x[:, :, 0] - guesses.T

    def sensitivities(
        self, x0: FloatArray, u: FloatArray, y0: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """Of a simulation of u (K, r) from x0 (n,) and the output y0 (m,) before it, in stretches of k samples.

        Yields:
            Outputs (k, m), states (k, n) without an integrator's, and the outputs' derivatives (k, m, p + n) by the
            generator's weights and x0.
        """
        a, dtype, p = self.architecture, self.vector.dtype, self.drift.start
        n, m = a.order, a.outputs
        x0, w, u, y0 = (np.array(signal, dtype, order="C") for signal in (x0[:n], x0[n:], u, y0))
        by_w = np.eye(m, p + m + n + m, p + m + n, dtype)  # ∂w/∂(generator, drift, x0, w0)
        parts = self.lure.sensitivities(x0, u, STRETCH) if self.lure else self._stretches(x0, u, y0)
        for y, x, J in parts:
            if a.integrator:
                s, same = self.step_size, np.broadcast_to(np.eye(m, dtype=dtype), (len(y), m, m))
                J = np.concatenate([J[:, :, :p], same, J[:, :, p:], 0 * same], axis=2)
                y, w = integrated(s * (y + self.vector[self.drift]), w)
                J, by_w = integrated(s[:, None] * J, by_w)
            yield y, x, J

    def _stretches(
        self, x0: FloatArray, u: FloatArray, y0: FloatArray
    ) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        """`sensitivities` of the LPV part, with a generator network."""
        a, dtype, p = self.architecture, self.vector.dtype, self.drift.start
        n, m = a.order, a.outputs
        S = np.zeros((n + m, p + n), dtype)
        S[:n, p:] = np.eye(n)
        for start in range(0, len(u), STRETCH):
            part = u[start : start + STRETCH]
            k = len(part)
            y, x, J = np.empty((k, m), dtype), np.empty((k, n), dtype), np.empty((k, m, p + n), dtype)
            kernels.sensitivities(
                self.vector, self.widths, kernels.KINDS[a.stability], "u" in a.scheduling, "y" in a.scheduling, a.gamma,
                a.epsilon, x0, part, y0, S, y, x, J,
            )  # fmt: skip
            yield y, x, J

    def free_runs(self, u: FloatArray, y0: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Side by side: outputs (K, m, b) and states (K, n, b) from u (K, r, b), y0 (m, b) and x0 (n, b)."""
        a, dtype = self.architecture, self.vector.dtype
        K, _, b = u.shape
        y, x = np.empty((K, a.outputs, b), dtype), np.empty((K, a.order, b), dtype)
        with np.errstate(over="ignore", invalid="ignore"):  # what is beyond a float32 is infinite
            u, y0, w, x0 = (np.array(signal, dtype, order="C") for signal in (u, y0, x0[a.order :], x0[: a.order]))
        if self.lure:
            self.lure.free_run(u, x0, y, x)
        else:
            kernels.free_run(
                self.vector, self.widths, kernels.KINDS[a.stability], "u" in a.scheduling, "y" in a.scheduling, a.gamma,
                a.epsilon, x0, u, y0, y, x,
            )  # fmt: skip
        if a.integrator:
            with np.errstate(over="ignore", invalid="ignore"):
                steps = self.step_size[:, None] * (y + self.vector[self.drift][:, None])
            y, _ = integrated(steps, w)
            x = np.concatenate([x, y], axis=1)
        return y, x


def ready_to_run(model: NNSS) -> Weights:
    """The weights of a model whose `free_runs` are compiled, or read from numba's cache: one process does for all."""
    _warm_up_runs(model.architecture.dtype, model.architecture.stability)
    return Weights(model)


@functools.cache
def _warm_up_runs(dtype: str, stability: str) -> None:
    with compiling(kernels.free_run):
        Weights(_smallest(dtype, stability)).free_runs(np.ones((1, 1, 1)), np.ones((1, 1)), np.ones((1, 1)))


def _of_layer(name: str) -> bool:
    """Whether a weight is the incrementally stable layer's: neither the encoder's nor an integrator's drift."""
    return name.startswith("generator.")


def integrated(v: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """w(k) (K, …) with w(k+1) = w(k) + v(k), from v (K, …) and w(0) (…); and w(K)."""
    with np.errstate(over="ignore", invalid="ignore"):
        sums = w + np.cumsum(v, axis=0)
    return np.concatenate([w[None], sums[:-1]]), sums[-1]


@functools.cache
def warm_up(dtype: str, stability: str = "schur", second_order: bool = False) -> None:
    """Compile the kernels for a precision, or read them from numba's cache, on a problem of no size."""
    with compiling(kernels.loss_and_gradient):
        engine = FastEngine(
            _smallest(dtype, stability), [np.ones((3, 1))] * 2, [np.ones((3, 1))] * 2, Recipe(dtype=dtype)
        )
        engine.train_batch(np.arange(2), 1)
        engine.free_run(np.ones((2, 1)), np.ones(1))
        if second_order:
            list(engine.sensitivities(np.ones((2, 1))))


def _smallest(dtype: str, stability: str) -> NNSS:
    """A model of no size, by which kernels are compiled."""
    from nnss_cli.datasets.record import Channels, Scaling

    hidden = (9,) if stability == "incremental" else (9, 1)
    architecture = Architecture(1, 1, 1, hidden=hidden, encoder=(1,), dtype=dtype, stability=stability)
    one = np.ones(1)
    return NNSS(architecture, Scaling(one, one, one, one), Channels(("u",), ("y",), ("",), ("",)), 1.0)


class FastEngine:
    """Compiled steps; the same results as `ReferenceEngine` up to rounding."""

    def __init__(self, model: NNSS, u: Sequence[FloatArray], y: Sequence[FloatArray], recipe: Recipe) -> None:
        """Train from the model's weights on windows u (L, r), y (L, m), of any lengths, in normalised units."""
        self.model_weights = Weights(model)
        self.recipe = recipe
        dtype = self.model_weights.vector.dtype
        # where y schedules, a window's first sample only serves as previous output
        self.windows = Windows(u, y, dtype, unscored="y" in model.architecture.scheduling)
        self.gradient = np.zeros_like(self.model_weights.vector)
        self.moments = np.zeros_like(self.gradient), np.zeros_like(self.gradient)
        a: Architecture = model.architecture
        self.d_encoder = np.empty((a.order, a.encoder_inputs), dtype), np.empty(a.order, dtype)
        self.space = np.empty(0, dtype)
        self.layers = self.model_weights.encoder(self.model_weights.vector)
        self.layer_gradients = self.model_weights.encoder(self.gradient)

    def place(self, vector: FloatArray) -> None:
        """Take these weights; see `Engine`."""
        self.model_weights.vector[:] = vector

    def loss_and_gradient(self, vector: FloatArray) -> tuple[float, FloatArray]:
        """Loss over all windows; see `Engine`."""
        self.place(vector)
        loss = self.evaluate(np.arange(len(self.windows)))
        return loss, self.gradient.astype(np.float64)

    def evaluate(self, windows: NDArray[np.int64]) -> float:
        """The training loss of these windows, weighted by samples; its gradient is in `gradient`."""
        loss, gradient = 0.0, np.zeros_like(self.gradient)
        for batch in self.windows.batches(windows):
            loss += batch.share * self._evaluate(batch.u, batch.y)
            gradient += batch.share * self.gradient
        self.gradient[:] = gradient
        return loss

    def _evaluate(self, u: FloatArray, y: FloatArray) -> float:
        """The training loss of windows of one length, u (L, r, b) and y (L, m, b); its gradient is in `gradient`."""
        weights, a = self.model_weights, self.model_weights.architecture
        maps = encoder_map(self.layers, a.encoder_inputs)
        begin = int("y" in a.scheduling)  # the window then starts at its second sample
        seen = seen_windows(u[begin:], y[begin:], a.encoder_window)
        if weights.lure:
            loss = weights.lure.loss_and_gradient(
                *maps[-1], self.recipe.consistency, u, y, seen, self.gradient, *self.d_encoder
            )
        else:
            L, _, b = u.shape
            needed = kernels.workspace_size(
                [int(w) for w in weights.widths], a.order, a.outputs, L, b, self.gradient.itemsize
            )
            if needed > self.space.size:
                # zeros: what fills up a row to whole registers is computed with, and as leftover bytes it is often
                # subnormal, which made an epoch take up to eight times as long
                self.space = np.zeros(needed, self.gradient.dtype)
            loss = kernels.loss_and_gradient(
                weights.vector, weights.widths, kernels.KINDS[a.stability],
                *maps[-1], "u" in a.scheduling, "y" in a.scheduling, a.gamma, a.epsilon,
                self.recipe.consistency, u, y, seen, self.gradient, *self.d_encoder, self.space,
            )  # fmt: skip
        through = encoder_gradient(self.layers, maps, *self.d_encoder)
        for (d_W, d_bias), (W, bias) in zip(through, self.layer_gradients, strict=True):
            W[:], bias[:] = (0, 0) if self.recipe.fixed_encoder else (d_W, d_bias)
        return float(loss)

    def sensitivities(self, x0: FloatArray) -> Iterator[Block]:
        """Errors and their derivatives, in stretches of at most `STRETCH` samples; see `Engine`."""
        weights = self.model_weights
        for window in range(len(self.windows)):
            u, y = self.windows.window(window)
            first = y[0]
            if "y" in weights.architecture.scheduling:
                u, y = u[1:], y[1:]
            at = 0
            for simulated, x, J in weights.sensitivities(x0[window], u, first):
                errors = simulated - y[at : at + len(x)]
                yield Block(errors.reshape(-1), J.reshape(errors.size, -1), window, x)
                at += len(x)

    def train_batch(self, windows: NDArray[np.int64], epoch: int) -> float:
        """One Adam step; see `Engine`."""
        loss = self.evaluate(windows)
        # as in the released code, the bias is corrected by the epoch's number
        kernels.adam(self.model_weights.vector, self.gradient, *self.moments, self.recipe.learning_rate, epoch)
        return loss

    def free_run(self, u: FloatArray, y_init: FloatArray) -> FloatArray:
        """Free simulation; see `Engine`."""
        return self.model_weights.free_run(u, y_init)[0].astype(np.float64)

    def see(self, records: Sequence[Record]) -> FloatArray:
        """L of what the encoder's guesses are off by; see `Engine`."""
        own = self.model_weights
        if own.architecture.encoder_window == 1:
            own.initial_spread = spread_of(np.concatenate([own.deviations(each.u, each.y) for each in records]))
        return own.initial_spread

    def weights(self) -> Tensors:
        """A copy of the weights; see `Engine`."""
        return {name: view.copy() for name, view in self.model_weights.views(self.model_weights.vector).items()}
