"""The linear encoder as one affine map x(0) = E s + e of what it sees: forwards, backwards, set, and estimated.

It sees s = y(0), or with a window of W samples s = [y(0) … y(W−1), u(0) … u(W−1)].
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nnss_cli.datasets.record import FloatArray

Layers = list[tuple[FloatArray, FloatArray]]
"""Weight and bias of each linear layer."""


def seen_windows(u: FloatArray, y: FloatArray, W: int) -> FloatArray:
    """What the encoder sees from each sample on (K − W + 1, ·, …), of inputs u (K, r, …) and outputs y (K, m, …)."""
    if W == 1:
        return y
    whole = len(y) - W + 1
    return np.concatenate([signal[k : k + whole] for signal in (y, u) for k in range(W)], axis=1)


def encoder_map(layers: Layers, size: int) -> Layers:
    """The affine maps A_i s + c_i after 0, 1, … layers: A_0 = I, A_i = W_i A_{i−1}, c_i = W_i c_{i−1} + b_i."""
    dtype = layers[0][0].dtype
    maps = [(np.eye(size, dtype=dtype), np.zeros(size, dtype))]
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
    """Write the chain E s + e, with E (n, ·) and e (n,); an E for y(0) alone has fewer columns, and sees no more.

    Where the layers before let all of s through, the last is set and they stay. Else, with w the narrowest
    width, they pass on V_wᵀ s of E ≈ U_w S_w V_wᵀ, the nearest map of rank w: E itself if its rank is no more.
    """
    weight, bias = layers[-1]
    m = layers[0][0].shape[1]
    E = np.pad(E, ((0, 0), (0, m - E.shape[1])))
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


def regress_encoder(seen: FloatArray, x: FloatArray) -> tuple[FloatArray, FloatArray]:
    """E (n, ·) and e (n,) of least squares between what the encoder sees (K, ·) and states x (K, n)."""
    affine, *_ = np.linalg.lstsq(np.column_stack([seen, np.ones(len(seen))]), x, rcond=None)
    return affine[:-1].T, affine[-1]


def fit_encoder(
    layers: Layers, u: Sequence[FloatArray], y: Sequence[FloatArray], x: Sequence[FloatArray], W: int = 1
) -> None:
    """Set the encoder to the regression of states on what it sees of each record.

    Args:
        layers: changed in place.
        u: inputs, each (K, r).
        y: outputs, each (K, m).
        x: states, each (K, n).
        W: samples that it sees; the last W − 1 states of a record have no whole window.
    """
    seen = [seen_windows(*record, W) for record in zip(u, y, strict=True)]
    known = [own[: len(part)] for own, part in zip(x, seen, strict=True)]
    set_encoder(layers, *regress_encoder(np.concatenate(seen), np.concatenate(known)))
