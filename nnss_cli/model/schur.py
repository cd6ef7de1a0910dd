"""The Schur and the contraction parametrisation in torch, batched; `baselines.schur` has the formulas and sources."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nnss_cli.baselines.schur import EPSILON, schur_margin


def schur_terms(W: Tensor, V: Tensor, gamma: float = 1.0, epsilon: float = EPSILON) -> tuple[Tensor, Tensor]:
    """S12 and M, both (…, n, n), of which A = S12 M⁻¹, with the margin for the rounding of W's precision in S.

    Args:
        W: free matrices (…, 2n, 2n).
        V: free matrices (…, n, n).
        gamma: bound on the spectral radius, 0 < γ ≤ 1.
        epsilon: added to the diagonal of S, so that S is positive definite for every W.
    """
    n = V.shape[-1]
    gram, K = W.mT @ W, V - V.mT
    size = gram.diagonal(dim1=-2, dim2=-1).sum(-1) / (2 * n) + torch.linalg.matrix_norm(K) / math.sqrt(2)
    added = epsilon + schur_margin(n, str(W.dtype).removeprefix("torch.")) * size
    S = gram + added[..., None, None] * torch.eye(2 * n, dtype=W.dtype, device=W.device)
    M = 0.5 * (S[..., :n, :n] / gamma**2 + S[..., n:, n:]) + K
    return S[..., :n, n:], M


def schur_matrix(W: Tensor, V: Tensor, gamma: float = 1.0, epsilon: float = EPSILON) -> Tensor:
    """A = S12 M⁻¹ (…, n, n), ρ(A) < γ for every W and V."""
    S12, M = schur_terms(W, V, gamma, epsilon)
    return torch.linalg.solve(M, S12, left=False)


def contraction_matrix(W: Tensor, gamma: float = 1.0, epsilon: float = EPSILON) -> Tensor:
    """A = γ L1⁻¹ S12 L2⁻ᵀ (…, n, n), ‖A‖₂ < γ for every W (…, 2n, 2n)."""
    n = W.shape[-1] // 2
    gram = W.mT @ W
    scale = epsilon * (1 + gram.diagonal(dim1=-2, dim2=-1).sum(-1) / (2 * n))
    S = gram + scale[..., None, None] * torch.eye(2 * n, dtype=W.dtype, device=W.device)
    L1, L2 = torch.linalg.cholesky(S[..., :n, :n]), torch.linalg.cholesky(S[..., n:, n:])
    left = torch.linalg.solve_triangular(L1, S[..., :n, n:], upper=False)
    return gamma * torch.linalg.solve_triangular(L2.mT, left, upper=True, left=False)
