"""Compiled loops over the samples of a Lur'e model, for `feedback`: its states, and what they owe to its parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

from nnss_cli.datasets.record import FloatArray

OPTIONS: Any = {"cache": True, "nogil": True, "error_model": "numpy"}


@njit(**OPTIONS)
def simulate(
    A: FloatArray, driven: FloatArray, F: FloatArray, G: FloatArray, x0: FloatArray, largest: float, path: FloatArray
) -> None:
    """x(k+1) = A x + d(k) + F tanh(G x) into `path` (K, n), from d (K, n); ∞ from where a state exceeds `largest`."""
    n, m = F.shape
    x, bent = x0.copy(), np.empty(m)
    for k in range(len(path)):
        path[k] = x
        for i in range(m):
            s = 0.0
            for j in range(n):
                s += G[i, j] * x[j]
            bent[i] = np.tanh(s)
        within = True
        for i in range(n):
            s = driven[k, i]
            for j in range(n):
                s += A[i, j] * path[k, j]
            for j in range(m):
                s += F[i, j] * bent[j]
            x[i] = s
            within = within and abs(s) < largest
        if not within:
            path[k:] = np.inf
            return


@njit(**OPTIONS)
def sensitivities(
    A: FloatArray,
    F: FloatArray,
    G: FloatArray,
    C: FloatArray,
    slopes: FloatArray,
    z: FloatArray,
    rows: int,
    J: FloatArray,
) -> None:
    """C ∂x(k)/∂[θ; x(0)] into J (K, m, rows n + n), θ (n, rows) of x(k+1) = θ z(k); z holds x and tanh(Gx).

    S(k+1) = (A + F diag(slopes(k)) G) S(k), and z(k) where a row of θ acts; S(0) = [0 I]. Without rows, of x(0) alone.

    Args:
        A: (n, n), the part of θ that multiplies x.
        F: (n, q), that of tanh(Gx).
        G: (q, n).
        C: (m, n).
        slopes: 1 − tanh²(Gx) (K, q).
        z: (K, rows).
        rows: entries of a row of θ.
        J: filled.
    """
    n, q = F.shape
    m, P = len(C), n * rows + n
    S, following, M = np.zeros((n, P)), np.empty((n, P)), np.empty((n, n))
    for i in range(n):
        S[i, n * rows + i] = 1.0
    for k in range(len(J)):
        for o in range(m):
            for p in range(P):
                s = 0.0
                for j in range(n):
                    s += C[o, j] * S[j, p]
                J[k, o, p] = s
        for i in range(n):
            for j in range(n):
                s = A[i, j]
                for o in range(q):
                    s += F[i, o] * slopes[k, o] * G[o, j]
                M[i, j] = s
        for i in range(n):
            for p in range(P):
                following[i, p] = M[i, 0] * S[0, p]
            for j in range(1, n):
                for p in range(P):
                    following[i, p] += M[i, j] * S[j, p]
            for p in range(rows):
                following[i, i * rows + p] += z[k, p]
        S, following = following, S
