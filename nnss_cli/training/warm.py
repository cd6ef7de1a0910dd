"""Start an NN-SS model as a good linear one.

With the last layer of the generator zero but for its bias, W, V, B and C do not depend on ρ: the
model is linear, and the closed-form inverse of the Schur parametrisation makes it any stable linear
model that one likes. Training then begins at that model's error and leaves linearity as it pays.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Protocol, TypeAlias, cast

import numpy as np
import torch

from nnss_cli.baselines.schur import contracting_basis, contraction_inverse, schur_inverse, schur_margin
from nnss_cli.baselines.ssest import ssest
from nnss_cli.baselines.statespace import LinearStateSpace, spectral_radius
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.encoder import Layers, encoder_map, fit_encoder, seen_windows, set_encoder

INSIDE = 1e-4  # relative distance of the start's spectral radius from gamma, at least
DRAWN_IN = (0.0, *INSIDE * 2.0 ** np.arange(14))  # shares that are taken off A until it keeps its promise

LinearStart: TypeAlias = tuple[LinearStateSpace, FloatArray]
"""A linear model in normalised units, and the matrix (n, m) that takes y(0) to its x(0)."""


def linear_start(
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    order: int,
    gamma: float,
    init_window: int = 1,
    feedthrough: bool = False,
) -> LinearStart:
    """SSEST's model with ρ(A) < γ, in the basis in which its states over the training records have unit covariance.

    Args:
        train: experiments in normalised units.
        val: validation experiments.
        order: number of states n.
        gamma: γ.
        init_window: first samples of a validation experiment that tell x(0).
        feedthrough: estimate D as well.

    Returns:
        The model in normalised units, and the matrix that takes y(0) to the x(0) from which it is scored.
    """
    model = ssest(train, val, order, feedthrough, init_window)
    radius, limit = model.spectral_radius(), gamma * (1 - INSIDE)
    if radius > limit:
        model = LinearStateSpace(model.A * (limit / radius), model.B, model.C, model.D, model.Ts)
    x = np.concatenate(
        [model.simulate(record.u, model.state_from_output(record.y[0], record.u[0]))[1] for record in train]
    )
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    T = (vectors / np.sqrt(np.maximum(values, 1e-12 * values[-1]))) @ vectors.T
    scaled, initial = model.transform(T), T @ np.linalg.pinv(model.C)
    spare = order - scaled.order  # poor data determine fewer states: the others start at rest, unconnected
    if spare > 0:
        A, B = np.pad(scaled.A, (0, spare)), np.pad(scaled.B, ((0, spare), (0, 0)))
        scaled = LinearStateSpace(A, B, np.pad(scaled.C, ((0, 0), (0, spare))), scaled.D, scaled.Ts)
        initial = np.pad(initial, ((0, spare), (0, 0)))
    return scaled, initial


def warm_start(model: NNSS, linear: LinearStart) -> None:
    """Set the last layers of `model` such that it simulates like SSEST's; the layers before keep their weights.

    The encoder gets the map from y(0) to the initial state from which the linear model is scored.

    Args:
        model: initialised weights, changed in place.
        linear: of `linear_start`.
    """
    a = model.architecture
    start, E = linear
    A = start.A
    if a.stability == "quadratic":
        T = contracting_basis(A, a.gamma)
        start, E = start.transform(T), T @ E
        # a slow pole leaves no room for ε: what is taken off is no more than INSIDE takes elsewhere
        limit = a.gamma * (1 - 4 * a.epsilon)
        A = start.A * min(1.0, limit / float(np.linalg.norm(start.A, 2)))
    set_generator(model, np.concatenate(free_matrices(a, A)), start)
    set_encoder(encoder_layers(model), E, np.zeros(a.order))


def free_matrices(a: Architecture, A: FloatArray, P: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """W (4n²,) and V (n²,), flat, for which the parametrisation gives A.

    A so near to γ that the precision leaves no room for S's margin is drawn in, by the fewest doublings of INSIDE.

    Args:
        a: which parametrisation.
        A: ρ(A) < γ for schur, ‖A‖₂ < γ for quadratic.
        P: of `schur_inverse`.
    """
    W: FloatArray = np.zeros((2 * a.order, 2 * a.order))
    V: FloatArray = np.zeros((a.order, a.order))
    if a.stability == "schur":
        margin = schur_margin(a.order, a.dtype)
        for inside in DRAWN_IN:
            try:
                W, V = schur_inverse(A * (1 - inside), a.gamma, a.epsilon, P, margin)
            except InputError:
                if spectral_radius(A) >= a.gamma or inside > 0.5:
                    raise
            else:
                break
    elif a.stability == "quadratic":
        W = contraction_inverse(A, a.gamma, a.epsilon)
    else:
        W[: a.order, : a.order] = A
    return W.ravel(), V.ravel()


def step_size(records: tuple[Record, ...]) -> FloatArray:
    """Root mean square (m,) of the outputs' differences; 1 for one that never moves."""
    size = np.sqrt(np.mean(np.concatenate([np.diff(record.y, axis=0) for record in records]) ** 2, axis=0))
    return np.where(size > 0, size, 1.0)


def differences(records: tuple[Record, ...], size: FloatArray) -> tuple[Record, ...]:
    """What an integrator sums up, v(k) = y(k+1) − y(k), in units of `size` (m,)."""
    return tuple(Record(record.u[:-1], np.diff(record.y, axis=0) / size, record.Ts) for record in records)


def sum_up(model: NNSS, size: FloatArray, train: tuple[Record, ...]) -> None:
    """From a start for `differences` to one for the outputs: the size of their steps, their drift, the encoder.

    Args:
        model: with an integrator; changed in place.
        size: the unit (m,) of the differences.
        train: experiments in normalised units, outputs as they are.
    """
    from nnss_cli.training.fast import Weights

    a, layers = model.architecture, encoder_layers(model)
    model.step_size.copy_(torch.from_numpy(size))
    weights, x, missing = Weights(model), [], []
    for record, difference in zip(train, differences(train, size), strict=True):
        E, e = encoder_map(layers, a.encoder_inputs)[-1]
        x0 = np.concatenate([E[:, : a.outputs] @ difference.y[0] + e, record.y[0]])
        y, states = weights.free_runs(record.u[:, :, None], record.y[:1].T, x0[:, None])
        x.append(states[:, : a.order, 0].astype(np.float64))
        missing.append(difference.y - np.diff(y[:, :, 0], axis=0) / size)
    drift = np.concatenate(missing).mean(axis=0)
    if all(np.isfinite(states).all() for states in x) and np.isfinite(drift).all():
        encoder_of_states(model, train, x)
        with torch.no_grad():
            model.generator_drift.bias.copy_(torch.from_numpy(drift))


def see_windows(model: NNSS, train: tuple[Record, ...]) -> None:
    """From a start whose encoder sees y(0) alone to one that sees windows: the regression of its own states on them.

    Args:
        model: changed in place.
        train: experiments in normalised units.
    """
    from nnss_cli.training.fast import Weights

    weights, W = Weights(model), model.architecture.encoder_window
    x = []
    for record in train:
        x0 = weights.encode(seen_windows(record.u[:W], record.y[:W], W).T)
        _, states = weights.free_runs(record.u[:, :, None], record.y[:1].T, x0)
        x.append(states[:, : model.architecture.order, 0].astype(np.float64))
    if all(np.isfinite(states).all() for states in x):
        encoder_of_states(model, train, x)


def encoder_of_states(model: NNSS, train: tuple[Record, ...], x: Sequence[FloatArray]) -> None:
    """Set the encoder of `model` to the regression of states, each (K, n), on what it sees of these experiments."""
    u, y = ([getattr(record, signal) for record in train] for signal in "uy")
    fit_encoder(encoder_layers(model), u, y, x, model.architecture.encoder_window)


class OutputMatrices(Protocol):
    """What beside A makes a start."""

    @property
    def B(self) -> FloatArray:
        """Input matrix (n, r)."""

    @property
    def C(self) -> FloatArray:
        """Output matrix (m, n)."""

    @property
    def D(self) -> FloatArray:
        """Feedthrough (m, r); left out where the model has none."""


def set_generator(model: NNSS, free: FloatArray, start: OutputMatrices, weights: FloatArray | None = None) -> None:
    """Write the last layer: W, V (5n²,), B, C and D as its bias; `weights` (5n², h) of W and V, all others zero."""
    output = cast(torch.nn.Linear, cast(torch.nn.Sequential, model.generator)[-1])
    with torch.no_grad():
        output.weight.zero_()
        if weights is not None:
            output.weight[: len(weights)] = torch.from_numpy(weights)
        parts = [free, start.B.ravel(), start.C.ravel()] + [start.D.ravel()] * model.architecture.feedthrough
        output.bias.copy_(torch.from_numpy(np.concatenate(parts)))


def encoder_layers(model: NNSS) -> Layers:
    """Weight and bias of each layer of the encoder, as views."""
    layers = cast(Iterable[torch.nn.Linear], model.encoder)
    return [(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in layers]
