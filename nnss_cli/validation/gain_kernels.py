"""The compiled loop over the samples of a linearised predictor, for `gain`."""

from __future__ import annotations

import numpy as np
from numba import njit

from nnss_cli.datasets.record import FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def sensitivities(
    F: FloatArray, H: FloatArray, driven: FloatArray, before: FloatArray, errors: FloatArray, J: FloatArray
) -> None:
    """ε̃(k) = ε(k) − H(k) ξ(k) into `errors` (L, b, m) and ∂ε̃(k)/∂K into `J` (L, b, m, s, m), of b pieces by themselves.

        ξ(k+1) = F(k) ξ(k) + d(k),   S(k+1) = F(k) S(k) + I ⊗ ε̃(k)ᵀ,   ∂ε̃(k)/∂K = −H(k) S(k),   ξ(0) = S(0) = 0

    Args:
        F: closed-loop matrices F − K H (L, b, s, s).
        H: (L, b, m, s).
        driven: d (L, b, s).
        before: ε (L, b, m), the errors of the gain at which the line was drawn.
        errors: filled.
        J: filled.
    """
    L, b, m, s = H.shape
    for piece in range(b):
        xi, S = np.zeros(s), np.zeros((s, s, m))
        xi_next, S_next = np.empty(s), np.empty((s, s, m))
        for k in range(L):
            for i in range(m):
                error = before[k, piece, i]
                for j in range(s):
                    error -= H[k, piece, i, j] * xi[j]
                errors[k, piece, i] = error
            J[k, piece] = 0
            for i in range(m):
                for j in range(s):
                    h = H[k, piece, i, j]
                    for row in range(s):
                        for column in range(m):
                            J[k, piece, i, row, column] -= h * S[j, row, column]
            for i in range(s):
                total = driven[k, piece, i]
                for j in range(s):
                    total += F[k, piece, i, j] * xi[j]
                xi_next[i] = total
                S_next[i] = 0
                for column in range(m):
                    S_next[i, i, column] = errors[k, piece, column]
                for j in range(s):
                    f = F[k, piece, i, j]
                    for row in range(s):
                        for column in range(m):
                            S_next[i, row, column] += f * S[j, row, column]
            xi, xi_next = xi_next, xi
            S, S_next = S_next, S
