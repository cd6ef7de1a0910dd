"""All strict contractions with a zero block: what makes a slope-restricted Lur'e model incrementally stable.

    x(k+1) = A x + B u + F z,   z = φ(Gx + Hu + b) − φ(b),   y = C x + D u + E z,   0 ≤ φ' ≤ 1

Two trajectories under one input differ by Δx, and Δz by slopes between 0 and 1 of G Δx. About the middle of these,
w = Λ(2Δz − GΔx) has ‖w‖ ≤ ‖v‖, v = Λ G Δx, for any positive diagonal Λ, and

    [Δx(k+1)/γ; v] = K [Δx; w],   K = [Ā/γ F̄; Ḡ 0],   Ā = A + FG/2,  F̄ = FΛ⁻¹/2γ,  Ḡ = ΛG

so that ‖K‖₂ < 1 gives ‖Δx(k+1)‖ ≤ γ ‖Δx‖. With columns for u and rows for y/Γ beside them,

    [y/Γ; Δx(k+1)/γ; v] = K [u; Δx; w],   K = [D̄ C̄ Ē; B̄ Ā/γ F̄; H̄ Ḡ 0],   C̄ = (C + EG/2)/Γ,  Ē = EΛ⁻¹/2Γ, …

‖K‖₂ < 1 gives ‖Δx(k+1)‖² + ‖Δy‖²/Γ² ≤ ‖Δx‖² + ‖Δu‖² as well, γ ≤ 1, hence an incremental ℓ2 gain of Γ at most.

K₂₁ and K₁ = [K₁₁ K₁₂] being the rows below and above, ‖K‖₂ < 1 means ‖K₂₁‖₂ < 1 and K₁ = Θ diag(Z, I), ‖Θ‖₂ < 1, with
ZᵀZ = I − K₂₁ᵀK₂₁. Each strict contraction is X L⁻ᵀ with LLᵀ = sI + XᵀX, or L⁻¹Y with LLᵀ = sI + YYᵀ, s = 1 + σ ‖·‖²:

    K₂₁ = X L₂⁻ᵀ,   Z = √s L₂⁻ᵀ,   Θ = L₁⁻¹ Y

for any X and Y. Triangular factors keep zeros: rows of X that do not see u, and rows of Y for y that see neither u nor
some of w, give such rows of K. K is then taken times 1 − δ, which is more than rounding can take from it.

Sources: R. Wang, N. Barabanov and I. Manchester, "Recurrent equilibrium networks", IEEE Trans. Automatic Control 69(5),
2024, and N. Barbara, R. Wang and I. Manchester, "R2DN", arXiv:2504.01250, 2025, for the condition and its free forms;
A. Megretski and A. Rantzer, "System analysis via IQCs", IEEE Trans. Automatic Control 42(6), 1997, for the multiplier.
"""

from __future__ import annotations

import numpy as np
import scipy.linalg
from nnss_cli.datasets.record import FloatArray

from nnss_cli.errors import InputError

RIDGE = 1e-6
"""σ: X and Y so large that rounding in their Gram matrices outweighs 1 are held back by this share of them."""
UNIT_ROUNDOFF = {"float32": 2.0**-24, "float64": 2.0**-53}


def incremental_margin(size: int, dtype: str) -> float:
    """δ: what the rounding of K's blocks (size columns) to a precision, and of their making in float64, may take."""
    return 16 * size * max(UNIT_ROUNDOFF[dtype], 2 * UNIT_ROUNDOFF["float64"] / RIDGE)


def contraction_with_zero(X: FloatArray, Y: FloatArray, margin: float) -> tuple[FloatArray, FloatArray]:
    """K₁ (p, c + q) and K₂₁ (q, c) of K = [K₁₁ K₁₂; K₂₁ 0] with ‖K‖₂ < 1, for any X and Y.

    Args:
        X: (q, c).
        Y: (p, c + q).
        margin: δ.
    """
    c = X.shape[1]
    s = 1 + RIDGE * np.sum(X**2)
    inverse = np.linalg.inv(np.linalg.cholesky(s * np.eye(c) + X.T @ X))
    L = np.linalg.cholesky((1 + RIDGE * np.sum(Y**2)) * np.eye(len(Y)) + Y @ Y.T)
    K1 = scipy.linalg.solve_triangular(L, Y, lower=True)
    K1 = np.concatenate([K1[:, :c] @ (np.sqrt(s) * inverse.T), K1[:, c:]], axis=1)
    return (1 - margin) * K1, (1 - margin) * X @ inverse.T


def contraction_with_zero_inverse(K1: FloatArray, K21: FloatArray, margin: float) -> tuple[FloatArray, FloatArray]:
    """X and Y of `contraction_with_zero`, in closed form.

    Raises:
        InputError: ‖K‖₂ is too near to 1, or above.
    """
    c = K21.shape[1]
    K1, K21 = K1 / (1 - margin), K21 / (1 - margin)
    try:
        M = np.linalg.cholesky(np.eye(c) - K21.T @ K21)
        X = scipy.linalg.solve_triangular(M, K21.T, lower=True).T
        theta = np.concatenate([scipy.linalg.solve_triangular(M, K1[:, :c].T, lower=True).T, K1[:, c:]], axis=1)
        N = np.linalg.cholesky(np.eye(len(K1)) - theta @ theta.T)
    except np.linalg.LinAlgError:
        raise InputError("incremental: expected a matrix K of norm below 1 with room for its margin") from None
    Y = scipy.linalg.solve_triangular(N, theta, lower=True)
    scaled = []
    for part in (X, Y):  # of unit s; the s that they have then is 1 + σ s ‖·‖²
        room = 1 - RIDGE * float(np.sum(part**2))
        if not room > RIDGE:
            raise InputError("incremental: expected a matrix K of norm below 1 with room for its margin")
        scaled.append(part / np.sqrt(room))
    return scaled[0], scaled[1]
