"""An incrementally stable layer's matrices from its free weights, and what a loss owes to these, compiled.

The equations are those of `nnss_cli.model.incremental.Lure`, the oracle of this one, with blocks kept together: with
the rows of y above those of x(k+1), and u before x, Y = [D C E; B Y] and X = [H X] hold all free weights but b and
those of Λ, and

    M = [D C; B A],   N = [E; F],   V = [H G]

all matrices but b. Of these, the rows and columns that K spans, K₁ = [K₁₁ K₁₂] of Y and K₂₁ of X (all with a gain,
those of x alone without), follow by

    V = Λ⁻¹ K₂₁,   N = 2 f K₁₂ Λ,   M = f K₁₁ − N V/2,   f = Γ in rows of y, γ in rows of x(k+1)

and the others are the free weights. With R = L₂⁻¹, T = L₁⁻¹, Θ = T Y, ρ = 1 − δ and a bar for ∂J/∂, the adjoint is

    N̄ −= M̄ Vᵀ/2,   V̄ −= Nᵀ M̄/2,   K̄₁ = [f M̄, 2 f N̄ Λ],   K̄₂₁ = Λ⁻¹ V̄
    P₂ = ↓(K̄₁₁ᵀ K₁₁ + K̄₂₁ᵀ K₂₁),   Θ̄ = ρ [√s₂ K̄₁₁ R, K̄₁₂],   P₁ = ↓(Θ̄ Θᵀ)
    X̄ = (ρ K̄₂₁ − 2 K₂₁ P₂/ρ) R + 2σ s̄₂ X,   s̄₂ = ⟨K̄₁₁, K₁₁⟩/2s₂ − ⟨P₂, R Rᵀ⟩
    Ȳ = Tᵀ (Θ̄ − 2 P₁ Θ) + 2σ s̄₁ Y,   s̄₁ = −⟨P₁, T Tᵀ⟩

↓ being half the lower triangle, mirrored: with LLᵀ = S and L̄ = ∂J/∂L, ∂J/∂S = L⁻ᵀ ↓(Lᵀ L̄) L⁻¹.

X and V are held transposed, so that the innermost loops run over the units. Everything is in float64.

Source: S. F. Smith, "Differentiation of the Cholesky algorithm", J. Computational and Graphical Statistics 4(2), 1995.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from nnss_cli.baselines.incremental import RIDGE, incremental_margin
from nnss_cli.datasets.record import FloatArray
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.incremental import PlainArrays
from nnss_cli.model.kernels import entry, part


class Layout:
    """Where the free weights of an architecture stand in [Xᵀ; Y; Λ; b], and its matrices in [M; N; Vᵀ; b]."""

    def __init__(self, a: Architecture) -> None:
        n, r, m, q = a.order, a.inputs, a.outputs, a.hidden[0]
        self.sizes = np.array([n, r, m, q])
        self.constants = (RIDGE, incremental_margin(a.gain_columns, a.dtype), float(a.gamma), float(a.gain))
        blocks = _blocks(((r + n, q), (m + n, r + n + q), (q,), (q,)))
        X, Y, scale, bias = blocks
        free = {
            "X": X[r:].T, "Y": Y[m:, r:], "scale": scale, "bias": bias, "H": X[:r, : a.driven_units].T, "B": Y[m:, :r],
            "C": Y[:m, r : r + n], "E": Y[:m, r + n + q - a.shown_units :], "D": Y[:m, : r * a.feedthrough],
        }  # fmt: skip
        self.free = _joined([block for block in free.values() if block.size])
        M, N, V, b = _blocks(((m + n, r + n), (m + n, q), (r + n, q), (q,)))
        plain = PlainArrays(M[m:, r:], M[m:, :r], N[m:], V[r:].T, V[:r].T, b, M[:m, r:], M[:m, :r], N[:m])
        self.plain = _joined(plain)

    def matrices(self, weights: FloatArray) -> FloatArray:
        """A, B, F, G, H, b, C, D, E, row after row, from the free weights, in their order, both float64."""
        found = np.empty(len(self.plain))
        _matrices(weights, self.free, self.plain, self.sizes, *self.constants, found)
        return found

    def pulled_back(self, weights: FloatArray, towards: FloatArray) -> FloatArray:
        """Derivatives (k, p) by the free weights from those (k, P) by the matrices' entries, all float64."""
        found = np.empty((len(towards), len(weights)))
        _pull_back(weights, self.free, self.plain, self.sizes, *self.constants, towards, found)
        return found


def _blocks(shapes: tuple[tuple[int, ...], ...]) -> list[Any]:
    """Indices of each of some blocks that stand one after the other in a vector."""
    ends = np.cumsum([math.prod(shape) for shape in shapes])
    blocks = np.split(np.arange(ends[-1]), ends[:-1])
    return [block.reshape(shape) for block, shape in zip(blocks, shapes, strict=True)]


def _joined(blocks: Any) -> Any:
    return np.concatenate([block.ravel() for block in blocks])


@part
def _inverse_factor(S: Any) -> Any:
    """L⁻¹ of LLᵀ = S; of S only the lower triangle is read, and overwritten with L."""
    c = len(S)
    inverse = np.zeros((c, c))
    for j in range(c):
        for i in range(j, c):
            total = S[i, j]
            for k in range(j):
                total -= S[i, k] * S[j, k]
            S[i, j] = math.sqrt(total) if i == j else total / S[j, j]
    for j in range(c):
        inverse[j, j] = 1 / S[j, j]
        for i in range(j + 1, c):
            total = 0.0
            for k in range(j, i):
                total -= S[i, k] * inverse[k, j]
            inverse[i, j] = total / S[i, i]
    return inverse


@part
def _whitened(rows: Any, ridge: float, out: Any) -> Any:
    """L⁻¹ of LLᵀ = sI + rows rowsᵀ, and s = 1 + σ ‖rows‖²; L⁻¹ rows is written."""
    c = len(rows)
    S, s = np.empty((c, c)), 1.0
    for i in range(c):
        for j in range(i + 1):
            S[i, j] = _dot(rows[i], rows[j])
        s += ridge * S[i, i]
    for i in range(c):
        S[i, i] += s
    inverse = _inverse_factor(S)
    for i in range(c):
        out[i] = 0
        for j in range(i + 1):
            _add(inverse[i, j], rows[j], out[i])
    return inverse, s


@part
def _dot(x: Any, y: Any) -> float:
    total = 0.0
    for k in range(x.size):
        total += x[k] * y[k]
    return total


@part
def _add(factor: float, x: Any, out: Any) -> None:
    for k in range(x.size):
        out[k] += factor * x[k]


@part
def _cut(held: Any, rows: int, columns: int, q: int) -> Any:
    """Xᵀ (columns, q), Y (rows, columns + q), the free scale (q,) and b (q,) in one vector, as views."""
    at, end = columns * q, columns * q + rows * (columns + q)
    return held[:at].reshape(columns, q), held[at:end].reshape(rows, columns + q), held[end : end + q], held[end + q :]


@part
def _cut_plain(held: Any, rows: int, columns: int, q: int) -> Any:
    """M (rows, columns), N (rows, q), Vᵀ (columns, q) and b (q,) in one vector, as views."""
    first, second = rows * columns, rows * (columns + q)
    third = second + columns * q
    M, N = held[:first].reshape(rows, columns), held[first:second].reshape(rows, q)
    return M, N, held[second:third].reshape(columns, q), held[third:]


@part
def _form(weights: Any, free: Any, sizes: Any, ridge: float, margin: float, gamma: float, gain: float) -> Any:
    """All matrices in one vector, and what their adjoint needs of the way there."""
    n, r, m, q = sizes[0], sizes[1], sizes[2], sizes[3]
    rows, columns = m + n, r + n
    top, first = (0, 0) if gain > 0 else (m, r)  # where K's rows and columns begin
    keep = 1 - margin
    held = np.zeros(columns * q + rows * (columns + q) + 2 * q)
    for k in range(len(weights)):
        held[free[k]] = weights[k]
    X, Y, scale, bias = _cut(held, rows, columns, q)
    plain = np.empty(rows * columns + (rows + columns) * q + q)
    M, N, V, b = _cut_plain(plain, rows, columns, q)
    b[:] = bias
    M[:], N[:], V[:] = Y[:, :columns], Y[:, columns:], X
    c = columns - first
    K21, theta = np.empty((c, q)), np.empty((rows - top, c + q))
    R, s = _whitened(X[first:], ridge, K21)
    T, _ = _whitened(np.ascontiguousarray(Y[top:, first:]), ridge, theta)
    K11 = np.empty((rows - top, c))
    over = np.empty(q)  # Λ⁻¹
    for k in range(q):
        over[k] = math.exp(math.asinh(scale[k] / 2))
    for j in range(c):
        for k in range(q):
            K21[j, k] *= keep
            V[first + j, k] = over[k] * K21[j, k]
    root = keep * math.sqrt(s)
    for i in range(rows - top):
        factor = gain if top + i < m else gamma
        for k in range(q):
            N[top + i, k] = 2 * factor * keep * theta[i, c + k] / over[k]
        for j in range(c):
            K11[i, j] = root * _dot(theta[i, : j + 1], R[j, : j + 1])
            M[top + i, first + j] = factor * K11[i, j] - 0.5 * _dot(N[top + i], V[first + j])
    return held, plain, over, K11, K21, theta, R, T, s


@entry
def _matrices(
    weights: Any, free: Any, order: Any, sizes: Any, ridge: float, margin: float, gamma: float, gain: float, found: Any
) -> None:
    """The matrices' entries in the order asked for."""
    plain = _form(weights, free, sizes, ridge, margin, gamma, gain)[1]
    for k in range(len(order)):
        found[k] = plain[order[k]]


@entry
def _pull_back(
    weights: Any, free: Any, order: Any, sizes: Any, ridge: float, margin: float, gamma: float, gain: float,
    towards: Any, found: Any,
) -> None:  # fmt: skip
    """The adjoint of the module's docstring, for each row of derivatives."""
    n, r, m, q = sizes[0], sizes[1], sizes[2], sizes[3]
    rows, columns = m + n, r + n
    top, first = (0, 0) if gain > 0 else (m, r)
    held, plain, over, K11, K21, theta, R, T, s = _form(weights, free, sizes, ridge, margin, gamma, gain)
    X, Y, scale, _ = _cut(held, rows, columns, q)
    _, N, V, _ = _cut_plain(plain, rows, columns, q)
    by_held, by_plain = np.empty_like(held), np.empty_like(plain)
    d_X, d_Y, d_scale, d_bias = _cut(by_held, rows, columns, q)
    d_M, d_N, d_V, d_b = _cut_plain(by_plain, rows, columns, q)
    for row in range(len(towards)):
        for k in range(len(order)):
            by_plain[order[k]] = towards[row, k]
        d_X[:], d_Y[:, :columns], d_Y[:, columns:] = d_V, d_M, d_N  # what K does not span
        d_bias[:] = d_b
        d_scale[:] = 0
        for i in range(top, rows):
            for j in range(first, columns):
                _add(-0.5 * d_M[i, j], V[j], d_N[i])
                _add(-0.5 * d_M[i, j], N[i], d_V[j])
        for i in range(top, rows):  # from here on, by K
            factor = gain if i < m else gamma
            for j in range(first, columns):
                d_M[i, j] *= factor
            for k in range(q):
                d_scale[k] -= d_N[i, k] * N[i, k]
                d_N[i, k] *= 2 * factor / over[k]
        for j in range(first, columns):
            for k in range(q):
                d_scale[k] += d_V[j, k] * V[j, k]
                d_V[j, k] *= over[k]
        for k in range(q):
            d_scale[k] /= math.sqrt(scale[k] ** 2 + 4)
        _contraction_adjoint(
            X[first:], Y[top:, first:], K11, K21, theta, R, T, s, ridge, 1 - margin,
            d_M[top:, first:], d_N[top:], d_V[first:], d_X[first:], d_Y[top:, first:],
        )  # fmt: skip
        for k in range(len(free)):
            found[row, k] = by_held[free[k]]


@part
def _contraction_adjoint(
    X: Any, Y: Any, K11: Any, K21: Any, theta: Any, R: Any, T: Any, s: float, ridge: float, keep: float,
    d_K11: Any, d_K12: Any, d_K21: Any, d_X: Any, d_Y: Any,
) -> None:  # fmt: skip
    """d_X and d_Y are written, from the others; X, K21 and theirs are transposed."""
    p, c = K11.shape
    P, d_theta, d_s = np.empty((c, c)), np.empty_like(theta), 0.0
    for i in range(c):
        for j in range(i + 1):
            total = _dot(d_K21[i], K21[j])
            for k in range(p):
                total += d_K11[k, i] * K11[k, j]
            P[i, j], P[j, i] = 0.5 * total, 0.5 * total
    root = keep * math.sqrt(s)
    for k in range(p):
        d_s += _dot(d_K11[k], K11[k]) / (2 * s)
        for j in range(c):
            total = 0.0
            for i in range(j, c):
                total += d_K11[k, i] * R[i, j]
            d_theta[k, j] = root * total
        for j in range(d_K12.shape[1]):
            d_theta[k, c + j] = keep * d_K12[k, j]
    inner = np.empty_like(K21)
    for i in range(c):
        for k in range(inner.shape[1]):
            inner[i, k] = keep * d_K21[i, k]
        for j in range(c):
            _add(-2 * P[i, j] / keep, K21[j], inner[i])
    _unwhitened(X, R, P, inner, d_s, ridge, d_X)
    P = np.empty((p, p))
    for i in range(p):
        for j in range(i + 1):
            half = 0.5 * _dot(d_theta[i], theta[j])
            P[i, j], P[j, i] = half, half
    for i in range(p):
        for j in range(p):
            _add(-2 * P[i, j], theta[j], d_theta[i])
    _unwhitened(Y, T, P, d_theta, 0.0, ridge, d_Y)


@part
def _unwhitened(rows: Any, inverse: Any, P: Any, inner: Any, d_s: float, ridge: float, out: Any) -> None:
    """out = L⁻ᵀ inner + 2σ s̄ rows, s̄ = d_s − ⟨P, L⁻¹ L⁻ᵀ⟩."""
    c = len(rows)
    for i in range(c):
        for j in range(c):
            d_s -= P[i, j] * _dot(inverse[i], inverse[j])
    for i in range(c):
        for k in range(out.shape[1]):
            out[i, k] = 2 * ridge * d_s * rows[i, k]
        for j in range(i, c):
            _add(inverse[j, i], inner[j], out[i])
