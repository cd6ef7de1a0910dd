"""Loops over the samples of linear models, in machine code.

The states that `statespace` propagates; for SSEST the residuals and what they owe to its directions; for SIMBa the loss
on a batch of windows and its gradient, by the adjoint. Directions and the batch are innermost, so that they vectorise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

EXACT: Any = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"contract"}}  # keeps inf and nan
NOTHING = 1e-250  # states below are zero: subnormal numbers, to which they decay, take twenty times as long


@njit(**EXACT)
def _not_subnormal(x: float) -> float:
    """x, or 0 where it is next to nothing."""
    return 0.0 if abs(x) < NOTHING else x


@njit(**EXACT)
def recursion(A: Any, w: Any, x: Any) -> None:
    """x(k+1) = A x(k) + w(k) for k = 0 … K − 1, from the initial states that x begins with.

    Args:
        A: (n, n).
        w: driving terms (b, K, n).
        x: states (b, K + 1, n), filled.
    """
    n = len(A)
    for run in range(len(w)):
        for k in range(w.shape[1]):
            for i in range(n):
                total = w[run, k, i]
                for j in range(n):
                    total += A[i, j] * x[run, k, j]
                x[run, k + 1, i] = _not_subnormal(total)


@njit(**EXACT)
def _advance(A: Any, B: Any, x: Any, u: Any, following: Any) -> None:
    """x(k+1) = A x + B u of one sample into `following`."""
    for i in range(len(A)):
        total = 0.0
        for j in range(len(x)):
            total += A[i, j] * x[j]
        for j in range(len(u)):
            total += B[i, j] * u[j]
        following[i] = _not_subnormal(total)


@njit(**EXACT)
def _residual(C: Any, D: Any, x: Any, u: Any, y: Any, e: Any) -> None:
    """y − C x − D u of one sample into `e`."""
    for o in range(len(C)):
        total = y[o]
        for j in range(len(x)):
            total -= C[o, j] * x[j]
        for j in range(len(u)):
            total -= D[o, j] * u[j]
        e[o] = total


@njit(**EXACT)
def residuals(A: Any, B: Any, C: Any, D: Any, x0: Any, u: Any, y: Any, e: Any) -> None:
    """y − ŷ (K, m) of a free simulation into `e`, from inputs u (K, r) and the state x0 (n,)."""
    x, following = x0.copy(), np.empty_like(x0)
    for k in range(len(u)):
        _residual(C, D, x, u[k], y[k], e[k])
        _advance(A, B, x, u[k], following)
        x, following = following, x


@njit(**EXACT)
def _directions(M: Any, S: Any, driven: Any, x: Any, u: Any, out: Any) -> None:
    """out (q, P …) = M S + driven [x; u] of one sample, for M (q, n), S (n, P) and driven (q, n + r, P)."""
    n, P = S.shape
    for i in range(len(M)):
        row = out[i]
        for p in range(P):
            row[p] = 0.0
        for j in range(n):
            factor, source = M[i, j], S[j]
            for p in range(P):
                row[p] += factor * source[p]
        for j in range(n + len(u)):
            factor = x[j] if j < n else u[j - n]
            source = driven[i, j]
            for p in range(P):
                row[p] += factor * source[p]
        for p in range(P):
            row[p] = _not_subnormal(row[p])


@njit(**EXACT)
def sensitivities(
    A: Any, B: Any, C: Any, D: Any, driven: Any, seen: Any, u: Any, y: Any, x: Any, S: Any, J: Any
) -> None:  # fmt: skip
    """Derivatives of ŷ along P directions, and y − ŷ behind them, of consecutive samples.

        S(k+1) = A S(k) + Σ_j driven_j z_j(k),   J(k) = [C S(k) + Σ_j seen_j z_j(k),  y(k) − ŷ(k)],   z = [x; u]

    Args:
        A, B, C, D: the model (n, n), (n, r), (m, n), (m, r).
        driven: [dA dB] of each direction (n, n + r, P).
        seen: [dC dD] of each direction (m, n + r, P).
        u: inputs (K, r).
        y: outputs (K, m).
        x: state (n,) before the first sample; after it, that before the next.
        S: dx (n, P), likewise.
        J: (K, m, P + 1), filled.
    """
    state, following = x.copy(), np.empty_like(x)
    moving, next_moving = S.copy(), np.empty_like(S)
    for k in range(len(u)):
        _directions(C, moving, seen, state, u[k], J[k])
        _residual(C, D, state, u[k], y[k], J[k, :, -1])
        _directions(A, moving, driven, state, u[k], next_moving)
        _advance(A, B, state, u[k], following)
        state, following = following, state
        moving, next_moving = next_moving, moving
    x[:] = state
    S[:] = moving


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
