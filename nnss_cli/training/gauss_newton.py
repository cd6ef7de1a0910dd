"""Gauss–Newton training: the output error method with exact derivatives and free initial states.

    min over generator weights and x(0) of every window of  ‖e‖²,   e = ŷ − y

by Levenberg–Marquardt steps (`least_squares`). The encoder has no part in it: one output sample does not determine a
state, and a model that is trained from the encoder's guess bends its dynamics to make up for it. It is the regression
of the states found on the outputs, or on the windows of samples that it sees.

Source: L. Ljung, "System Identification", 2nd ed., 1999, ch. 7.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.training.encoder import Layers, encoder_map, fit_encoder, seen_windows
from nnss_cli.training.engine import Engine
from nnss_cli.training.least_squares import NormalEquations, levenberg_marquardt

Item = TypeVar("Item")

ERRORS_A_PARAMETER = 8  # from which the curvature is taken, at least; all where there are fewer than twice as many


def gauss_newton(
    engine: Engine,
    u: Sequence[FloatArray],
    y: Sequence[FloatArray],
    iterations: int,
    goes_on: Callable[[float], bool],
    encoder_window: int = 1,
    fixed_encoder: bool = False,
    integrator: bool = False,
    threads: int = 1,
    begin: FloatArray | None = None,
) -> list[FloatArray]:
    """Train the weights in `engine`.

    Args:
        engine: holds the weights and the windows.
        u: inputs of the windows, each (L, r), for the encoder.
        y: their outputs (L, m).
        iterations: at most.
        goes_on: hears the mean square error of each accepted step; whether there is to be another.
        encoder_window: samples W that the encoder sees.
        fixed_encoder: leave the encoder as it is.
        integrator: whether the initial states end with the first outputs, which are then free as well.
        threads: 2 for derivatives that are found while others are summed up; the numbers are the same.
        begin: x(0) of each window (N, n) to begin from, without an integrator's; the encoder's guess where it is None.

    Returns:
        States of each window (L, n) after the last step taken; none where none was.
    """
    weights = engine.weights()
    vector = np.concatenate([array.ravel() for array in weights.values()]).astype(np.float64)
    p = sum(array.size for name, array in weights.items() if name.startswith("generator"))
    layers: Layers = []  # the encoder's, as views into `vector`
    at = p
    for name, array in weights.items():
        if name.startswith("encoder") and name.endswith("weight"):
            bias = at + array.size
            at = bias + len(array)
            layers.append((vector[bias - array.size : bias].reshape(array.shape), vector[bias:at]))
    E, e0 = encoder_map(layers, layers[0][0].shape[1])[-1]
    W = encoder_window
    x0: FloatArray = np.array([seen_windows(a[:W], b[:W], W)[0] for a, b in zip(u, y, strict=True)]) @ E.T + e0
    if begin is not None:
        x0 = begin
    if integrator:
        x0 = np.concatenate([x0, [window[0] for window in y]], axis=1)

    last: list[FloatArray] = []
    errors = sum(window.size for window in y)
    every = max(1, errors // (ERRORS_A_PARAMETER * (p + x0.size)))

    def evaluate(point: FloatArray) -> tuple[NormalEquations, FloatArray]:
        vector[:p] = point[:p]
        engine.place(vector)
        blocks = engine.sensitivities(point[p:].reshape(x0.shape))
        if threads > 1:
            blocks = ahead(blocks)
        equations, states = NormalEquations.summed(blocks, p, len(y), every)
        return equations, np.concatenate(states)

    def accepted(_: FloatArray, loss: float, x: FloatArray) -> bool:
        unscored = (sum(len(window) for window in y) - len(x)) // len(y)
        inputs, outputs = ([window[unscored:] for window in signal] for signal in (u, y))
        last[:] = np.split(x, np.cumsum([len(window) for window in outputs])[:-1])
        if not fixed_encoder and np.isfinite(loss):
            fit_encoder(layers, inputs, outputs, last, W)
        engine.place(vector)
        return goes_on(loss)

    levenberg_marquardt(evaluate, np.concatenate([vector[:p], x0.ravel()]), iterations, accepted)
    return last


def ahead(items: Iterator[Item]) -> Iterator[Item]:
    """The same items in the same order, the next being made by a thread while one is used."""
    with ThreadPoolExecutor(1) as thread:
        coming = thread.submit(next, items, None)
        while (item := coming.result()) is not None:
            coming = thread.submit(next, items, None)
            yield item
