"""Derivatives of an incrementally stable layer's matrices by its free weights, in NumPy: the oracle is torch's `Lure`.

With LLᵀ = S the differential of Cholesky's factor is dL = L Φ(L⁻¹ dS L⁻ᵀ), Φ the lower triangle with half the diagonal.
All directions are side by side: a batch of differentials, one for each free weight.

Source: S. F. Smith, "Differentiation of the Cholesky algorithm", J. Computational and Graphical Statistics 4(2), 1995.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from nnss_cli.baselines.incremental import RIDGE, incremental_margin
from nnss_cli.datasets.record import FloatArray
from nnss_cli.model.architecture import Architecture


def plain_and_slopes(a: Architecture, free: Mapping[str, FloatArray]) -> tuple[list[FloatArray], FloatArray]:
    """A, B, F, G, H, b, C, D, E; and the derivatives (P, p) of all their entries, row after row, by all free weights.

    Args:
        a: of the layer.
        free: its weights by name, in their order.
    """
    n, r, m, q = a.order, a.inputs, a.outputs, a.hidden[0]
    p = sum(part.size for part in free.values())
    values, moves, at = {}, {}, 0
    for name, part in free.items():  # each with its differentials (p, ·, ·)
        values[name] = np.asarray(part, dtype=np.float64)
        moves[name] = np.zeros((p, part.size))
        moves[name][np.arange(at, at + part.size), np.arange(part.size)] = 1
        moves[name] = moves[name].reshape(p, *part.shape)
        at += part.size

    def of(name: str, *size: int) -> Pair:
        if name in values:
            return Pair(values[name], moves[name])
        return Pair(np.zeros(size), np.zeros((p, *size)))

    def zeros(*size: int) -> Pair:
        return Pair(np.zeros(size), np.zeros((p, *size)))

    X, Y, b, B, C = (of(name) for name in ("X", "Y", "bias", "B", "C"))
    H = below(of("H", 0, r), zeros(q - a.driven_units, r))
    E = beside(zeros(m, q - a.shown_units), of("E", m, 0))
    D = of("D", m, r)
    if a.gain:
        X = beside(H, X)
        Y = below(beside(D, C, E), beside(B, Y))
    K1, K21 = _contraction_with_zero(X, Y, incremental_margin(a.gain_columns, a.dtype))
    free_scale = of("scale")
    value = np.exp(np.arcsinh(free_scale.value / 2))
    slope = value / np.sqrt(free_scale.value**2 + 4)
    scale, over = Pair(value, free_scale.move * slope), Pair(1 / value, -free_scale.move * slope / value**2)
    first = r * (a.gain > 0)
    G = K21.columns(first, first + n).rows_times(scale)
    state = K1.rows(len(K1.value) - n, len(K1.value))
    F = 2 * a.gamma * state.columns(first + n, first + n + q).columns_times(over)
    A = a.gamma * state.columns(first, first + n) - 0.5 * (F @ G)
    if a.gain:
        H = K21.columns(0, r).rows_times(scale)
        out = a.gain * K1.rows(0, m)
        E = 2 * out.columns(r + n, r + n + q).columns_times(over)
        B = a.gamma * state.columns(0, r) - 0.5 * (F @ H)
        C = out.columns(r, r + n) - 0.5 * (E @ G)
        D = out.columns(0, r) - 0.5 * (E @ H)
    found = (A, B, F, G, H, b, C, D, E)
    return [part.value for part in found], np.concatenate([part.move.reshape(p, -1) for part in found], axis=1).T


class Pair:
    """A matrix (·, ·) and its differentials (p, ·, ·)."""

    def __init__(self, value: FloatArray, move: FloatArray) -> None:
        self.value, self.move = value, move

    @property
    def T(self) -> Pair:
        """Transposed."""
        return Pair(self.value.T, self.move.swapaxes(1, 2))

    def __matmul__(self, other: Pair) -> Pair:
        return Pair(self.value @ other.value, self.move @ other.value + self.value @ other.move)

    def __rmul__(self, factor: float) -> Pair:
        return Pair(factor * self.value, factor * self.move)

    def __sub__(self, other: Pair) -> Pair:
        return Pair(self.value - other.value, self.move - other.move)

    def rows(self, first: int, last: int) -> Pair:
        """Some of the rows."""
        return Pair(self.value[first:last], self.move[:, first:last])

    def columns(self, first: int, last: int) -> Pair:
        """Some of the columns."""
        return Pair(self.value[:, first:last], self.move[:, :, first:last])

    def rows_times(self, factor: Pair) -> Pair:
        """Each row times an entry of a vector."""
        return Pair(
            self.value * factor.value[:, None], self.move * factor.value[:, None] + self.value * factor.move[:, :, None]
        )

    def columns_times(self, factor: Pair) -> Pair:
        """Each column times an entry of a vector."""
        return self.T.rows_times(factor).T


def beside(*parts: Pair) -> Pair:
    """Side by side."""
    return Pair(
        np.concatenate([part.value for part in parts], axis=1), np.concatenate([part.move for part in parts], axis=2)
    )


def below(*parts: Pair) -> Pair:
    """One below the other."""
    return Pair(
        np.concatenate([part.value for part in parts], axis=0), np.concatenate([part.move for part in parts], axis=1)
    )


def _contraction_with_zero(X: Pair, Y: Pair, margin: float) -> tuple[Pair, Pair]:
    """`nnss_cli.baselines.incremental.contraction_with_zero`."""
    c = X.value.shape[1]
    right, s = _inverse_factor(X.T)
    left, _ = _inverse_factor(Y)
    root = np.sqrt(s.value)
    theta = left @ Y
    Z = Pair(
        root * right.value.T, root * right.move.swapaxes(1, 2) + s.move[:, None, None] / (2 * root) * right.value.T
    )
    K1 = beside(theta.columns(0, c) @ Z, theta.columns(c, theta.value.shape[1]))
    return (1 - margin) * K1, (1 - margin) * (X @ right.T)


def _inverse_factor(Y: Pair) -> tuple[Pair, Pair]:
    """L⁻¹ of LLᵀ = sI + YYᵀ, and s = 1 + σ ‖Y‖²."""
    one = np.eye(len(Y.value))
    s = Pair(np.asarray(1 + RIDGE * np.sum(Y.value**2)), 2 * RIDGE * np.tensordot(Y.move, Y.value, axes=2))
    gram = Y @ Y.T
    inverse = np.linalg.inv(np.linalg.cholesky(s.value * one + gram.value))
    inner = inverse @ (gram.move + s.move[:, None, None] * one) @ inverse.T
    return Pair(inverse, -(np.tril(inner, -1) + 0.5 * inner * one) @ inverse), s
