"""A linear model's loss on a batch of windows and its gradient, in machine code.

The recursion of `statespace` and its adjoint, the batch innermost so that it vectorises.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "arcp", "nsz"})
def linear_adjoint(A: Any, B: Any, C: Any, D: Any, x0: Any, u: Any, y: Any, space: Any) -> Any:
    """J = mean (y − ŷ)² of free simulations and its derivatives.

    Args:
        A, B, C, D: the model (n, n), (n, r), (m, n), (m, r).
        x0: initial states (n, b).
        u: inputs (L, r, b).
        y: measured outputs (L, m, b).
        space: at least L·(n + m)·b numbers, overwritten.

    Returns:
        J, then ∂J/∂A, ∂J/∂B, ∂J/∂C, ∂J/∂D and ∂J/∂x0 (n, b).
    """
    L, r, b = u.shape
    n, m = len(A), len(C)
    x = space[: L * n * b].reshape(L, n, b)
    e = space[L * n * b : L * (n + m) * b].reshape(L, m, b)
    x[0] = x0
    loss = 0.0
    for k in range(L):
        for o in range(m):
            error, measured = e[k, o], y[k, o]
            for s in range(b):
                error[s] = -measured[s]
            for j in range(n):
                factor, source = C[o, j], x[k, j]
                for s in range(b):
                    error[s] += factor * source[s]
            for j in range(r):
                factor, source = D[o, j], u[k, j]
                for s in range(b):
                    error[s] += factor * source[s]
            for s in range(b):
                loss += error[s] * error[s]
        if k + 1 < L:
            for i in range(n):
                target = x[k + 1, i]
                for s in range(b):
                    target[s] = 0
                for j in range(n):
                    factor, source = A[i, j], x[k, j]
                    for s in range(b):
                        target[s] += factor * source[s]
                for j in range(r):
                    factor, source = B[i, j], u[k, j]
                    for s in range(b):
                        target[s] += factor * source[s]
    d_A, d_B, d_C, d_D = np.zeros_like(A), np.zeros_like(B), np.zeros_like(C), np.zeros_like(D)
    adjoint, following = np.zeros((n, b)), np.zeros((n, b))
    scale = 2.0 / (L * m * b)
    for k in range(L - 1, -1, -1):
        # `following` is λ(k + 1)
        for i in range(n):
            row = following[i]
            for j in range(n):
                source = x[k, j]
                total = 0.0
                for s in range(b):
                    total += row[s] * source[s]
                d_A[i, j] += total
            for j in range(r):
                source = u[k, j]
                total = 0.0
                for s in range(b):
                    total += row[s] * source[s]
                d_B[i, j] += total
        for j in range(n):
            row = adjoint[j]
            for s in range(b):
                row[s] = 0
            for i in range(n):
                factor, source = A[i, j], following[i]
                for s in range(b):
                    row[s] += factor * source[s]
            for o in range(m):
                factor, source = scale * C[o, j], e[k, o]
                for s in range(b):
                    row[s] += factor * source[s]
        for o in range(m):
            row = e[k, o]
            for j in range(n):
                source = x[k, j]
                total = 0.0
                for s in range(b):
                    total += row[s] * source[s]
                d_C[o, j] += scale * total
            for j in range(r):
                source = u[k, j]
                total = 0.0
                for s in range(b):
                    total += row[s] * source[s]
                d_D[o, j] += scale * total
        adjoint, following = following, adjoint
    return loss / (L * m * b), d_A, d_B, d_C, d_D, following
