"""The Schur parametrisation in NumPy, and its closed-form inverse.

    S = WᵀW + εI (2n × 2n) = [[S11, S12], [S12ᵀ, S22]],   M = ½(S11/γ² + S22) + V − Vᵀ,   A = S12 M⁻¹

has ρ(A) < γ for every W and V: A v = μ v with v = M z gives |μ| = |z*S12 z| / |z*M z| < γ. Rounding moves S and M by
about n u times their size, u the unit roundoff, so NN-SS, which runs in float32 too, adds a margin to ε,

    S = WᵀW + (ε + δ (tr(WᵀW)/2n + ‖V − Vᵀ‖_F/√2)) I,   δ = 16 n u      (`schur_margin`)

With the Cholesky factors S11 = L1 L1ᵀ, S22 = L2 L2ᵀ and, in S, ε (1 + tr(WᵀW)/2n) in the place of ε

    A = γ L1⁻¹ S12 L2⁻ᵀ

has ‖A‖₂ < γ for every W, so that ‖x‖² is a Lyapunov function that all such A share. ε grows with W there, for
the factors would lose the bound to rounding otherwise. Source: L. Di Natale et al., "Stable linear subspace
identification: a machine learning approach" (SIMBa), ECC 2024. The formula printed in the NN-SS
paper (a block-diagonal 2n × 2n term plus an n × n one) does not fit in its dimensions; the code
released with it computes this one.
"""

from __future__ import annotations

import math

import numpy as np
import scipy.linalg
from nnss_cli.baselines.statespace import spectral_radius
from nnss_cli.datasets.record import FloatArray

from nnss_cli.errors import InputError

EPSILON = math.exp(-10.0)
# A step's rounding errors are those of an S off by up to 7 n u (tr(WᵀW)/2n + ‖V − Vᵀ‖_F/√2), so it was measured
# (docs/stability.md): 2n products a sum, ‖WᵀW‖ up to its trace, the elimination, S12 z. Twice that is room.
MARGIN = 16


def schur_margin(n: int, dtype: str | np.dtype) -> float:
    """δ = 16 n u: the share of the weights' size by which S exceeds WᵀW + εI, in this precision."""
    return float(MARGIN * n * np.finfo(dtype).eps / 2)


def schur_matrix(
    W: FloatArray, V: FloatArray, gamma: float = 1.0, epsilon: float = EPSILON, margin: float = 0.0
) -> FloatArray:
    """A (n, n) from W (2n, 2n) and V (n, n); `margin` is δ."""
    n = len(V)
    S, K = W.T @ W, V - V.T
    S += (epsilon + margin * (np.trace(S) / (2 * n) + np.linalg.norm(K) / math.sqrt(2))) * np.eye(2 * n)
    M = 0.5 * (S[:n, :n] / gamma**2 + S[n:, n:]) + K
    return np.linalg.solve(M.T, S[:n, n:].T).T


def schur_inverse(
    A: FloatArray,
    gamma: float = 1.0,
    epsilon: float = EPSILON,
    P: FloatArray | None = None,
    margin: float = 0.0,
) -> tuple[FloatArray, FloatArray]:
    """W (2n, 2n) and V (n, n) with `schur_matrix(W, V)` = A, in closed form.

    With γ²P − A P Aᵀ positive definite, so is S = c [[γ²P, AP], [PAᵀ, P]], which
    gives M = c P, S12 = c A P, V = 0, hence A. Any c with λmin(S) > η = (ε + δ tr(S)/2n)/(1 + δ) will do, for
    W = chol(S − ηI)ᵀ to exist; the one taken makes the mean of S's diagonal 2, as SIMBa's random W has it, unless a
    larger one is needed. With the smallest possible c an optimiser's first steps would be far
    larger than W itself and lose the start.

    Args:
        A: matrix (n, n) with ρ(A) < γ.
        gamma: bound on the spectral radius.
        epsilon: as in `schur_matrix`.
        P: positive definite (n, n); the solution of γ²P − A P Aᵀ = I where it is None.
        margin: δ as in `schur_matrix`.

    Raises:
        InputError: ρ(A) ≥ γ, or so little below that S has no room for the margin; no W, V are known then.
    """
    n, radius = len(A), _radius_below(A, gamma)
    if P is None:
        P = scipy.linalg.solve_discrete_lyapunov(A / gamma, np.eye(n)) / gamma**2
    S = np.block([[gamma**2 * P, A @ P], [P @ A.T, P]])
    S = (S + S.T) / 2
    mean = np.trace(S) / (2 * n)
    room = (1 + margin) * np.linalg.eigvalsh(S)[0] - 2 * margin * mean
    if not room > 0:
        raise InputError(
            f"A has spectral radius {radius:.8g}: expected one further below gamma = {gamma:g}, for weights with a "
            f"margin of {margin:.1g} for rounding; draw A in, or use float64"
        )
    S *= max(2 * epsilon / room, 2 / mean)
    added = (epsilon + margin * np.trace(S) / (2 * n)) / (1 + margin)
    return np.linalg.cholesky(S - added * np.eye(2 * n)).T, np.zeros((n, n))


def contraction_matrix(W: FloatArray, gamma: float = 1.0, epsilon: float = EPSILON) -> FloatArray:
    """A (n, n) with ‖A‖₂ < γ from W (2n, 2n)."""
    n = len(W) // 2
    S = W.T @ W
    S = S + epsilon * (1 + np.trace(S) / (2 * n)) * np.eye(2 * n)
    L1, L2 = np.linalg.cholesky(S[:n, :n]), np.linalg.cholesky(S[n:, n:])
    left = scipy.linalg.solve_triangular(L1, S[:n, n:], lower=True)
    return gamma * scipy.linalg.solve_triangular(L2, left.T, lower=True).T


def contraction_inverse(A: FloatArray, gamma: float = 1.0, epsilon: float = EPSILON) -> FloatArray:
    """W (2n, 2n) with `contraction_matrix(W)` = A, in closed form: S = 2 [[I, A/γ], [Aᵀ/γ, I]].

    Args:
        A: matrix (n, n) with ‖A‖₂ < γ, by a margin of about 2 γ ε.
        gamma: bound on the norm.
        epsilon: as in `contraction_matrix`.

    Raises:
        InputError: the norm is too large, so no W exists; `contracting_basis` finds a basis in which it is not.
    """
    n = len(A)
    K = A / gamma
    S = 2 * np.block([[np.eye(n), K], [K.T, np.eye(n)]])
    added = epsilon * (1 + np.trace(S) / (2 * n)) / (1 + epsilon)
    norm = float(np.linalg.norm(K, 2))
    if 2 * (1 - norm) <= added:
        raise InputError(f"A has norm {norm * gamma:.6g}: expected less than gamma = {gamma:g} by {gamma * added:.1g}")
    return np.linalg.cholesky(S - added * np.eye(2 * n)).T


def bounded_real_basis(
    A: FloatArray, B: FloatArray, Q: FloatArray, R: FloatArray, S: FloatArray | None = None
) -> FloatArray | None:
    """T (n, n), symmetric, with TᵀT = P, the solution of the Riccati equation of a bounded real lemma.

    P = AᵀPA − (AᵀPB + S)(R + BᵀPB)⁻¹(BᵀPA + Sᵀ) + Q; None where there is none, or none that is definite enough to
    be a norm.

    Args:
        A: (n, n).
        B: (n, q).
        Q: (n, n).
        R: (q, q), negative definite.
        S: (n, q); 0 where it is None.
    """
    try:
        P = scipy.linalg.solve_discrete_are(A, B, Q, R, s=S)
    except (np.linalg.LinAlgError, ValueError):
        return None
    values, vectors = np.linalg.eigh((P + P.T) / 2)
    if not values[0] > 1e-9 * values[-1]:
        return None
    return np.asarray((vectors * np.sqrt(values)) @ vectors.T)


def _radius_below(A: FloatArray, gamma: float) -> float:
    radius = spectral_radius(A)
    if not radius < gamma:
        raise InputError(f"A has spectral radius {radius:.6g}: expected less than gamma = {gamma:g}; raise gamma")
    return radius


def contracting_basis(A: FloatArray, gamma: float = 1.0) -> FloatArray:
    """T (n, n) such that ‖T A T⁻¹‖₂ < γ: T = P^(−1/2) with γ²P − A P Aᵀ = I.

    Raises:
        InputError: ρ(A) ≥ γ, so there is none, or so near to it that rounding leaves none.
    """
    radius = _radius_below(A, gamma)
    P = scipy.linalg.solve_discrete_lyapunov(A / gamma, np.eye(len(A)))
    values, vectors = np.linalg.eigh((P + P.T) / 2)
    if not values[0] > 0:
        raise InputError(f"A has spectral radius {radius:.6g}, too near to gamma = {gamma:g} for its precision")
    return np.sqrt(values[0]) * (vectors / np.sqrt(values)) @ vectors.T
