"""The linear encoder as one affine map x(0) = E y(0) + e: forwards, backwards, set, and estimated from states."""

from __future__ import annotations

import numpy as np

from nnss_cli.datasets.record import FloatArray

Layers = list[tuple[FloatArray, FloatArray]]
"""Weight and bias of each linear layer."""


def encoder_map(layers: Layers, outputs: int) -> Layers:
    """The affine maps A_i y + c_i after 0, 1, … layers: A_0 = I, A_i = W_i A_{i−1}, c_i = W_i c_{i−1} + b_i."""
    dtype = layers[0][0].dtype
    maps = [(np.eye(outputs, dtype=dtype), np.zeros(outputs, dtype))]
    for W, bias in layers:
        A, c = maps[-1]
        maps.append((W @ A, W @ c + bias))
    return maps


def encoder_gradient(layers: Layers, maps: Layers, d_E: FloatArray, d_e: FloatArray) -> Layers:
    """∂J/∂(W_i, b_i) from ∂J/∂E and ∂J/∂e: dW_i = G_i A_{i−1}ᵀ + g_i c_{i−1}ᵀ, G_{i−1} = W_iᵀ G_i, likewise g."""
    G, g = d_E, d_e
    gradients: Layers = []
    for (W, _), (A, c) in zip(reversed(layers), reversed(maps[:-1]), strict=True):
        gradients.append((G @ A.T + np.outer(g, c), g))
        G, g = W.T @ G, W.T @ g
    return gradients[::-1]


def set_encoder(layers: Layers, E: FloatArray, e: FloatArray) -> None:
    """Write the chain E y + e, with E (n, m) and e (n,).

    Where the layers before let all m outputs through, the last is set and they stay. Else, with w the narrowest
    width, they pass on V_wᵀ y of E ≈ U_w S_w V_wᵀ, the nearest map of rank w: E itself if its rank is no more.
    """
    weight, bias = layers[-1]
    m = E.shape[1]
    A, c = encoder_map(layers, m)[-2]
    if np.linalg.matrix_rank(A) < m:
        U, S, Vt = np.linalg.svd(E, full_matrices=False)
        r = min(len(S), *(len(W) for W, _ in layers))
        for index, (W, b) in enumerate(layers[:-1]):
            b[:] = 0
            W[:] = 0
            W[:r] = Vt[:r] if index == 0 else np.eye(r, W.shape[1])
        weight[:] = 0
        weight[:, :r] = U[:, :r] * S[:r]
        bias[:] = e
        return
    weight[:] = E @ np.linalg.pinv(A)
    bias[:] = e - weight @ c


def regress_encoder(y: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """E (n, m) and e (n,) of least squares between outputs y (K, m) and states x (K, n)."""
    affine, *_ = np.linalg.lstsq(np.column_stack([y, np.ones(len(y))]), x, rcond=None)
    return affine[:-1].T, affine[-1]
