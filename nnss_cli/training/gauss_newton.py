"""Gauss–Newton training: the output error method with exact derivatives and free initial states.

    min over generator weights and x(0) of every window of  ‖e‖²,   e = ŷ − y

by Levenberg–Marquardt steps  min ‖e + J δ‖² + μ ‖S δ‖²  with S the columns' norms. The encoder has no part in
it: one output sample does not determine a state, and a model that is trained from the encoder's guess
bends its dynamics to make up for it. It is the regression of the states found on the outputs.

Sources: J. Nocedal and S. Wright, "Numerical Optimization", 2nd ed., 2006, ch. 10; H. B. Nielsen, "Damping
parameter in Marquardt's method", DTU, 1999; L. Ljung, "System Identification", 2nd ed., 1999, ch. 7.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy.linalg

from nnss_cli.datasets.record import FloatArray
from nnss_cli.training.encoder import Layers, encoder_map, regress_encoder, set_encoder
from nnss_cli.training.engine import Engine

FIRST_DAMPING = 1e-2
FLOOR = 1e-3  # smallest scale of a column, relative to the largest
LARGEST_DAMPING = 1e12  # no step helps any more
ACCEPTED = 1e-4  # decrease found over the decrease foreseen, at least


def gauss_newton(
    engine: Engine,
    y: Sequence[FloatArray],
    iterations: int,
    goes_on: Callable[[float], bool],
    fixed_encoder: bool = False,
) -> None:
    """Train the weights in `engine`.

    Args:
        engine: holds the weights and the windows.
        y: outputs of the windows, each (L, m), for the encoder.
        iterations: at most.
        goes_on: hears the mean square error of each accepted step; whether there is to be another.
        fixed_encoder: leave the encoder as it is.
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
    E, e0 = encoder_map(layers, y[0].shape[1])[-1]
    x0 = np.array([window[0] for window in y]) @ E.T + e0

    def evaluate(point: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        vector[:p] = point[:p]
        engine.place(vector)
        return engine.sensitivities(point[p:].reshape(x0.shape))

    def accepted(_: FloatArray, loss: float, x: FloatArray) -> bool:
        if not fixed_encoder and np.isfinite(loss):
            unscored = (sum(len(window) for window in y) - len(x)) // len(y)
            set_encoder(layers, *regress_encoder(np.concatenate([window[unscored:] for window in y]), x))
        engine.place(vector)
        return goes_on(loss)

    levenberg_marquardt(evaluate, np.concatenate([vector[:p], x0.ravel()]), iterations, accepted)


def levenberg_marquardt(
    evaluate: Callable[[FloatArray], tuple[FloatArray, FloatArray, FloatArray]],
    point: FloatArray,
    iterations: int,
    accepted: Callable[[FloatArray, float, FloatArray], bool],
) -> None:
    """Minimise ‖e‖² from `point`.

    Args:
        evaluate: a point's errors (q,), their derivatives (q, p), and the states that went with them.
        point: where to begin (p,).
        iterations: at most.
        accepted: hears of each step taken: point, mean square error, states; whether there is to be another.
    """
    damping = FIRST_DAMPING
    e, J, x = evaluate(point)
    for _ in range(iterations):
        norms = np.linalg.norm(J, axis=0)
        largest = float(norms.max())
        if not largest > 0 or not np.isfinite(largest):
            accepted(point, float(e @ e) / len(e), x)
            return
        scale = 1 / np.maximum(norms, FLOOR * largest)
        J *= scale
        many = J.shape[0] < J.shape[1]  # weights than errors: the smaller of the two forms
        gram = scipy.linalg.blas.dsyrk(1.0, J.T, trans=int(many), lower=1)
        descent = J.T @ e
        loss = float(e @ e)
        while True:
            damped = gram.copy(order="F")
            damped[np.diag_indices(len(gram))] += damping
            try:
                factor = scipy.linalg.cho_factor(damped, lower=True, overwrite_a=True, check_finite=False)
            except np.linalg.LinAlgError:  # rounding of a singular JᵀJ outweighs the damping
                damping = max(3 * damping, np.finfo(float).eps)
                continue
            step = scipy.linalg.cho_solve(factor, -e if many else -descent, check_finite=False)
            if many:
                step = J.T @ step
            candidate = point + scale * step
            errors, derivatives, x = evaluate(candidate)
            lower = float(errors @ errors)
            foreseen = damping * float(step @ step) - float(step @ descent)
            gain = (loss - lower) / foreseen if foreseen > 0 and np.isfinite(lower) else -1.0
            if gain > ACCEPTED:
                break
            damping *= 3
            if damping > LARGEST_DAMPING:
                return
        damping = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), np.finfo(float).eps)
        point, e, J = candidate, errors, derivatives
        if not accepted(point, lower / len(e), x):
            return
