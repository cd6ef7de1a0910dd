"""x(0) from the first w > 1 output samples, by Levenberg–Marquardt through a model's own simulation.

    min over z of  E + μ ‖z‖²,   x(0) = g + L z,   E = Σ_{k<w} ‖ŷ(k) − y(k)‖²,   μ = E / (w m − n)

in normalised units, g the encoder's guess from y(0), LLᵀ = P the covariance of what that guess is off by. One sample
does not determine a state, a window does as far as the state is observable in it; what is not stays where the guess
and P have it. μ is what Bayes' rule asks for: the variance of an error over that of z, which is 1. The window's own
errors tell the former, so a model that explains the window exactly is not held back. Stationary points are those of
(w m − n) log E + ‖z‖², which falls with every step, since log is concave. Where the window has no more outputs than
there are states, a fit says nothing of the errors, and μ is taken at the guess.

P is the second moment of x(k) − g(y(k)) along simulations of the training records that begin at the guess: training
leaves states of any size, dozens where a slow one is hardly seen in y, and sizes of one would hold that at its guess.
With P the fit is the same in every basis of the states.

Sources: J. Nocedal and S. Wright, "Numerical Optimization", 2nd ed., 2006, ch. 10, for the steps; D. R. Hunter and
K. Lange, "A tutorial on MM algorithms", The American Statistician 58(1), 2004, for the concave bound.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from nnss_cli.datasets.record import FloatArray

SINGULAR = torch.linalg.LinAlgError  # type: ignore[attr-defined]  # torch does not list it as exported

FLOOR = 1e-12  # of P, relative to its trace: a state that is never off its guess stays there
FIRST_DAMPING = 1e-3  # relative to the largest squared singular value of the derivatives
LARGEST_DAMPING = 1e8  # no step helps any more
EVALUATIONS = 30  # at most; four to eight are usual

Evaluate: TypeAlias = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""From x(0) (n,): the errors ŷ − y over the window (q,), and their derivatives by x(0) (q, n)."""
Step: TypeAlias = Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]
"""x(k+1) (b, n) and y(k) (b, m) from x(k) (b, n), u(k) (b, r) and y(k−1) (b, m)."""


def spread_of(deviations: FloatArray) -> FloatArray:
    """L (n, n), lower triangular, LLᵀ the second moment of deviations x − g (K, n); I where it tells nothing.

    That is where some are not finite, or all are zero.
    """
    D = np.asarray(deviations, dtype=np.float64)
    n = D.shape[1]
    largest = float(np.abs(D).max(initial=0))
    if not 0 < largest < np.inf:
        return np.eye(n)
    D = D / largest
    P = D.T @ D / len(D)
    return np.asarray(largest * np.linalg.cholesky(P + FLOOR * np.trace(P) * np.eye(n)))


def state_from_window(
    evaluate: Evaluate, guess: FloatArray, precision: float, spread: FloatArray | None = None
) -> FloatArray:
    """The x(0) that explains a window best; see above.

    A step is taken only if it lowers the cost. Where the simulation from the guess is not finite, the guess stays.

    Args:
        evaluate: errors over the window and their derivatives; not finite where the simulation is not.
        guess: g (n,).
        precision: eps of the arithmetic behind `evaluate`. A relative decrease of the cost below √eps is not sought: in
            float64 it moves x(0) by a thousandth of what the errors leave open, in float32 by a few hundredths.
        spread: L (n, n) of `spread_of`; I where it is None.

    Returns:
        x(0) (n,).
    """
    with np.errstate(over="ignore", invalid="ignore"):
        x = guess = np.asarray(guess, dtype=np.float64)
        e, J = evaluate(x)
        if not (np.isfinite(x).all() and np.isfinite(e).all() and np.isfinite(J).all()):
            return x
        q, n = J.shape
        L, z = np.eye(n) if spread is None else spread, np.zeros(n)
        mu, damping = float(e @ e) / q, FIRST_DAMPING
        linearised = None
        for _ in range(EVALUATIONS - 1):
            cost = float(e @ e) + mu * float(z @ z)
            if linearised is None:
                extra = np.sqrt(mu)
                U, s, Vt = np.linalg.svd(np.concatenate([J @ L, extra * np.eye(n)]), full_matrices=False)
                linearised = s, Vt, U.T @ np.concatenate([e, extra * z])
            s, Vt, target = linearised
            factor = s**2 / (s**2 + damping * s[0] ** 2) if s[0] > 0 else s
            # the linearised cost falls by Σ t² f (2 − f) for the step −V (f/s) t
            if not float(np.sum(target**2 * factor * (2 - factor))) > precision**0.5 * cost + q * precision**1.5:
                break
            candidate = z - Vt.T @ (factor / s * target)
            errors, derivatives = evaluate(guess + L @ candidate)
            lower = float(errors @ errors) + mu * float(candidate @ candidate)
            if lower < cost and np.isfinite(derivatives).all():
                z, x, e, J, linearised = candidate, guess + L @ candidate, errors, derivatives, None
                damping /= 100
                mu = float(e @ e) / (q - n) if q > n else mu
            else:
                damping *= 10
                if damping > LARGEST_DAMPING:
                    break
        return x


@torch.no_grad()
def response(step: Step, x0: Tensor, u: Tensor, y0: Tensor) -> tuple[Tensor, Tensor]:
    """Outputs of a free simulation and their derivatives by x(0).

    With S = ∂x(k)/∂x(0) and R = ∂y(k−1)/∂x(0), from S = I and R = 0,

        [∂x(k+1); ∂y(k)]/∂x(0) = F(k) [S; R],   F(k) = ∂[x(k+1); y(k)]/∂[x(k); y(k−1)]

    where F is taken at all samples side by side, once the simulation has gone through them.

    Args:
        step: of the model.
        x0: initial state (n,).
        u: inputs (w, r).
        y0: output before the first sample (m,), for scheduling on it.

    Returns:
        y (w, m) and ∂y/∂x(0) (w, m, n).
    """
    n, m = len(x0), len(y0)
    points = []  # x(k) and y(k−1)
    x, y = x0[None], y0[None]
    outputs = []
    for k in range(len(u)):
        points.append(torch.cat([x, y], dim=1))
        x, y = step(x, u[k : k + 1], y)
        outputs.append(y)
    at = torch.cat(points).requires_grad_()
    with torch.enable_grad():
        reached = torch.cat(step(at[:, :n], u, at[:, n:]), dim=1)
        rows = [torch.autograd.grad(reached[:, i].sum(), at, retain_graph=True)[0] for i in range(n + m)]
    F = torch.stack(rows, dim=1)
    S = torch.cat([torch.eye(n, dtype=x0.dtype), torch.zeros(m, n, dtype=x0.dtype)])
    J = []
    for k in range(len(u)):
        S = F[k] @ S
        J.append(S[n:])
    return torch.cat(outputs), torch.stack(J)
