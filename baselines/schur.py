"""The Schur parametrisation in NumPy, and its closed-form inverse.

    S = WᵀW + εI (2n × 2n) = [[S11, S12], [S12ᵀ, S22]],   M = ½(S11/γ² + S22) + V − Vᵀ,   A = S12 M⁻¹

has ρ(A) < γ for every W and V. Source: L. Di Natale et al., "Stable linear subspace
identification: a machine learning approach" (SIMBa), ECC 2024. The formula printed in the NN-SS
paper (a block-diagonal 2n × 2n term plus an n × n one) does not fit in its dimensions; the code
released with it computes this one.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
from nnss_cli.datasets.record import FloatArray

from nnss_cli.errors import InputError

EPSILON = math.exp(-10.0)


def schur_matrix(W: FloatArray, V: FloatArray, gamma: float = 1.0, epsilon: float = EPSILON) -> FloatArray:
    """A (n, n) from W (2n, 2n) and V (n, n)."""
    n = len(V)
    S = W.T @ W + epsilon * np.eye(2 * n)
    M = 0.5 * (S[:n, :n] / gamma**2 + S[n:, n:]) + V - V.T
    return np.linalg.solve(M.T, S[:n, n:].T).T


def schur_inverse(A: FloatArray, gamma: float = 1.0, epsilon: float = EPSILON) -> tuple[FloatArray, FloatArray]:
    """W (2n, 2n) and V (n, n) with `schur_matrix(W, V)` = A, in closed form.

    With P from γ²P − A P Aᵀ = I, the matrix S = c [[γ²P, AP], [PAᵀ, P]] is positive definite and
    gives M = c P, S12 = c A P, V = 0, hence A. Any c with λmin(S) > ε will do, for W = chol(S − εI)ᵀ
    to exist; the one taken makes the mean of S's diagonal 2, as SIMBa's random W has it, unless a
    larger one is needed. With the smallest possible c an optimiser's first steps would be far
    larger than W itself and lose the start.

    Args:
        A: matrix (n, n) with ρ(A) < γ.
        gamma: bound on the spectral radius.
        epsilon: as in `schur_matrix`.

    Raises:
        InputError: ρ(A) ≥ γ, so no W, V exist.
    """
    n = len(A)
    radius = float(np.abs(np.linalg.eigvals(A)).max())
    if not radius < gamma:
        raise InputError(f"A has spectral radius {radius:.6g}: expected less than gamma = {gamma:g}; raise gamma")
    P = scipy.linalg.solve_discrete_lyapunov(A / gamma, np.eye(n)) / gamma**2
    S = np.block([[gamma**2 * P, A @ P], [P @ A.T, P]])
    S = (S + S.T) / 2
    S *= max(2 * epsilon / np.linalg.eigvalsh(S)[0], 4 * n / np.trace(S))
    return np.linalg.cholesky(S - epsilon * np.eye(2 * n)).T, np.zeros((n, n))
