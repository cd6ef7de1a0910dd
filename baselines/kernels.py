"""Loops over the samples of linear models, in machine code.

The states that `statespace` propagates; for SSEST the residuals and what they owe to its directions; for SIMBa the loss
on a batch of windows and its gradient, by the adjoint. Directions and the batch are innermost, so that they vectorise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

EXACT: Any = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}}  # keeps inf and nan
part = njit(forceinline=True, **EXACT)  # why: see `nnss_cli.model.kernels`
entry = njit(cache=True, **EXACT)
NOTHING = 1e-250  # states below are zero: subnormal numbers, to which they decay, take twenty times as long


@part
def _not_subnormal(x: float) -> float:
    """x, or 0 where it is next to nothing."""
    return 0.0 if abs(x) < NOTHING else x


@entry
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


@part
def _advance(A: Any, B: Any, x: Any, u: Any, following: Any) -> None:
    """x(k+1) = A x + B u of one sample into `following`."""
    for i in range(len(A)):
        total = 0.0
        for j in range(len(x)):
            total += A[i, j] * x[j]
        for j in range(len(u)):
            total += B[i, j] * u[j]
        following[i] = _not_subnormal(total)


@entry
def residuals(A: Any, B: Any, C: Any, D: Any, x0: Any, u: Any, y: Any, e: Any) -> None:
    """y − ŷ (K, m) of a free simulation into `e`, from inputs u (K, r) and the state x0 (n,)."""
    x, following = x0.copy(), np.empty_like(x0)
    for k in range(len(u)):
        for o in range(len(C)):
            total = y[k, o]
            for j in range(len(x)):
                total -= C[o, j] * x[j]
            for j in range(u.shape[1]):
                total -= D[o, j] * u[k, j]
            e[k, o] = total
        _advance(A, B, x, u[k], following)
        x, following = following, x


@entry
def states_and_inputs(A: Any, B: Any, x: Any, u: Any, z: Any) -> None:
    """z(k) = [x(k); u(k)] (K, n + r), from inputs u (K, r) and x(0) in x (n,), which becomes x(K)."""
    n = len(A)
    for k in range(len(u)):
        z[k, :n] = x
        z[k, n:] = u[k]
        _advance(A, B, z[k, :n], u[k], x)


@part
def _add_product(M: Any, X: Any, out: Any) -> None:
    """out (q, P …) += M (q, n) X (n, P); four rows of X at a time, so that out is read and written less often."""
    n, P = X.shape
    whole = n - n % 4
    for i in range(len(M)):
        row = out[i]
        for j in range(0, whole, 4):
            a, b, c, d = M[i, j], M[i, j + 1], M[i, j + 2], M[i, j + 3]
            at_a, at_b, at_c, at_d = X[j], X[j + 1], X[j + 2], X[j + 3]
            for p in range(P):
                row[p] += a * at_a[p] + b * at_b[p] + c * at_c[p] + d * at_d[p]
        for j in range(whole, n):
            a, at_a = M[i, j], X[j]
            for p in range(P):
                row[p] += a * at_a[p]


@entry
def sensitivities(A: Any, C: Any, S: Any, forced: Any, J: Any) -> None:
    """J(k) += C S(k) along P directions, S(k+1) = A S(k) + forced(k), for consecutive samples.

    Args:
        A: (n, n).
        C: (m, n).
        S: S(0) (n, P).
        forced: (K, n, P), overwritten by S(1) … S(K).
        J: (K, m, at least P).
    """
    for k in range(len(J)):
        _add_product(C, S, J[k])
        _add_product(A, S, forced[k])
        S = forced[k]


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
