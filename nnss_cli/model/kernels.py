"""NN-SS in machine code: simulation, loss and hand-derived gradient.

The same equations as `nnss`, written for the CPU. `NNSS` is the readable version and the oracle of
this one. Sizes are arguments, so one compilation a precision serves every architecture; numba
keeps it on disk for later processes.

Layout: signals and the entries of W, V, B, C, D are (sample, channel, batch) with the batch innermost, so that the
n × n algebra vectorises over it. Activations are (sample, batch, channel) with rows of whole vectors: a layer and
its adjoint are then products without a transposed operand, and a weight's gradient is one product over a
block of samples and windows. The generator's weights come as one flat vector, layer by layer: matrix, then
bias. Of V only V − Vᵀ counts, so the last layer is computed for its n(n−1)/2 entries above the diagonal.

A Schur step never forms A:  M z = x,  q = W2 z,  A x = W1ᵀ q, with W = [W1 W2] and M by LU with pivoting. M's
symmetric part H is positive definite, so that no pivot is zero without it; but where V − Vᵀ = K outweighs H, the
factors grow like ‖K‖²/λmin(H), and rounding with them. Its adjoint, for μ = ∂J/∂x(k+1), λ = M⁻ᵀ W2ᵀ W1 μ and
t = ½(1 + 1/γ²) δ λᵀz, due to S's margin growing with W and K:

    ∂J/∂x = λ + …,   ∂J/∂M = −λ zᵀ,   ∂J/∂W1 = q μᵀ − (W1 λ zᵀ + W1 z λᵀ)/(2γ²) − t W1/n,
    ∂J/∂W2 = (W1 μ) zᵀ − (W2 λ zᵀ + q λᵀ)/2 − t W2/n,   ∂J/∂Kᵢⱼ = zᵢ λⱼ − λᵢ zⱼ − t √2 Kᵢⱼ/‖K‖_F for i < j

`_contraction_adjoint` has the formulas of the contraction.

All of it is one file on purpose: numba's cache looks at the file of the entry point alone, so a part
kept elsewhere could change without being compiled again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import njit, types
from numba.extending import intrinsic, overload

MARGIN = 16  # that of `baselines.schur`: numba's cache would not see it change there
PIVOT = 0.125  # rows are exchanged where a pivot is smaller than this share of its column: rarely, it costs time
ROWS = 64  # rows in a weight-gradient product, at least: a tile's sums stay in registers for so long
# Reordering and contraction are allowed; NaN and infinity are not assumed away, so that a
# divergence still reaches the loss.
FAST = {"reassoc", "contract", "arcp", "nsz"}
INLINE: Any = {"forceinline": True}  # why: see `part`


@intrinsic
def _bits_to_float(typingctx: Any, bits: Any) -> Any:
    """The float whose bit pattern is an integer: 2^k from k without a function call."""
    del typingctx
    result = types.float32 if bits == types.int32 else types.float64

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(signature.return_type))

    return result(bits), codegen


_float_from_bits: Any = _bits_to_float  # numba passes the first argument itself


def _exp(x: float) -> float:
    """e^x without a library call, so that loops over it vectorise."""
    return math.exp(x)


@overload(_exp, jit_options={"fastmath": FAST, "error_model": "numpy", **INLINE})
def _exp_compiled(x: Any) -> Any:
    # e^x = 2^k e^f with f = x − k ln 2 in two parts (Cody and Waite), e^f by its Taylor series:
    # |f| ≤ 0.35 leaves less than half a unit in the last place after 7 terms or 13.
    if x == types.float32:

        def single(x: Any) -> Any:
            clipped = np.float32(-87.0) if x < np.float32(-87.0) else x  # a NaN stays one
            clipped = np.float32(88.0) if clipped > np.float32(88.0) else clipped
            k = np.floor(clipped * np.float32(1.4426950408889634) + np.float32(0.5))
            f = clipped - k * np.float32(0.693359375)
            f = f - k * np.float32(-2.12194440e-4)
            p = np.float32(1 / 5040)
            p = p * f + np.float32(1 / 720)
            p = p * f + np.float32(1 / 120)
            p = p * f + np.float32(1 / 24)
            p = p * f + np.float32(1 / 6)
            p = p * f + np.float32(0.5)
            p = p * f + np.float32(1.0)
            p = p * f + np.float32(1.0)
            return p * _float_from_bits(np.int32((np.int32(k) + np.int32(127)) << np.int32(23)))

        return single

    def double(x: Any) -> Any:
        clipped = -708.0 if x < -708.0 else x
        clipped = 709.0 if clipped > 709.0 else clipped
        k = np.floor(clipped * 1.4426950408889634 + 0.5)
        f = clipped - k * 0.6931471803691238
        f = f - k * 1.9082149292705877e-10
        p = 1 / 6227020800
        p = p * f + 1 / 479001600
        p = p * f + 1 / 39916800
        p = p * f + 1 / 3628800
        p = p * f + 1 / 362880
        p = p * f + 1 / 40320
        p = p * f + 1 / 5040
        p = p * f + 1 / 720
        p = p * f + 1 / 120
        p = p * f + 1 / 24
        p = p * f + 1 / 6
        p = p * f + 0.5
        p = p * f + 1.0
        p = p * f + 1.0
        return p * _float_from_bits(np.int64((np.int64(k) + np.int64(1023)) << np.int64(52)))

    return double


OPTIONS: Any = {"nogil": True, "error_model": "numpy", "fastmath": FAST}
# Results are not to depend on whether this process compiled an entry or read it from numba's cache. A part that is a
# function of its own would be called as it was compiled by itself in the one case, and as it was optimised along with
# the entry in the other, and last bits differ. So parts are inlined, and the entries alone are cached.
part = njit(**OPTIONS, **INLINE)
entry = njit(cache=True, **OPTIONS)


@part
def _schur(theta: Any, x: Any, gamma: float, epsilon: float, LU: Any, z: Any, q: Any, x_next: Any) -> None:
    """x_next = A x for A of spectral radius below γ; LU of M and its n pivots' rows, z and q are for the adjoint."""
    n, b = x.shape
    g = theta.dtype.type(0.5 / gamma**2)
    half = theta.dtype.type(0.5)
    both = theta.dtype.type(0.5 * (1 + 1 / gamma**2))
    V = 4 * n * n
    added, size = q[0], q[1]
    _squares(theta, 0, V, added)
    _squares(theta, V, n * (n - 1) // 2, size)
    margin = _margin(theta, n)
    share, epsilon_here = theta.dtype.type(margin / (2 * n)), theta.dtype.type(epsilon)
    margin_here = theta.dtype.type(margin)
    for s in range(b):
        added[s] = both * (epsilon_here + share * added[s] + margin_here * math.sqrt(size[s]))
    for i in range(n):
        for j in range(i, n):
            upper, lower = LU[i * n + j], LU[j * n + i]
            for s in range(b):
                upper[s] = 0
            for k in range(2 * n):
                a1, a2 = theta[k * 2 * n + i], theta[k * 2 * n + j]
                b1, b2 = theta[k * 2 * n + n + i], theta[k * 2 * n + n + j]
                for s in range(b):
                    upper[s] += g * a1[s] * a2[s] + half * b1[s] * b2[s]
            if i == j:
                for s in range(b):
                    upper[s] += added[s]
            else:
                skew = theta[V + i * (2 * n - i - 1) // 2 + j - i - 1]
                for s in range(b):
                    lower[s] = upper[s] - skew[s]
                    upper[s] = upper[s] + skew[s]
    for i in range(n):
        for s in range(b):
            z[i, s] = x[i, s]
    for k in range(n):
        _pivot(LU, k, z, q[0])
        pivot = LU[k * n + k]
        for i in range(k + 1, n):
            factor = LU[i * n + k]
            for s in range(b):
                factor[s] = factor[s] / pivot[s]
            for j in range(k + 1, n):
                target, source = LU[i * n + j], LU[k * n + j]
                for s in range(b):
                    target[s] -= factor[s] * source[s]
    for i in range(n):
        for j in range(i):
            factor = LU[i * n + j]
            for s in range(b):
                z[i, s] -= factor[s] * z[j, s]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = LU[i * n + j]
            for s in range(b):
                z[i, s] -= factor[s] * z[j, s]
        pivot = LU[i * n + i]
        for s in range(b):
            z[i, s] = z[i, s] / pivot[s]
    for j in range(n):
        for s in range(b):
            x_next[j, s] = 0
    for k in range(2 * n):
        for s in range(b):
            q[k, s] = 0
        for j in range(n):
            w2 = theta[k * 2 * n + n + j]
            for s in range(b):
                q[k, s] += w2[s] * z[j, s]
        for j in range(n):
            w1 = theta[k * 2 * n + j]
            for s in range(b):
                x_next[j, s] += w1[s] * q[k, s]


@part
def _margin(theta: Any, n: int) -> float:
    """δ of `baselines.schur.schur_margin`."""
    return MARGIN * n * (2.0**-24 if theta.itemsize == 4 else 2.0**-53)


@part
def _squares(theta: Any, first: int, count: int, out: Any) -> None:
    """The sum of the squares of `count` rows of θ, for each window."""
    for s in range(out.size):
        out[s] = 0
    for k in range(first, first + count):
        row = theta[k]
        for s in range(out.size):
            out[s] += row[s] * row[s]


@part
def _pivot(LU: Any, k: int, z: Any, largest: Any) -> None:
    """Exchange row k of what is left of M, L so far and z for the one with the largest pivot, where k's is small.

    Row n² + k of LU gets that row's number.
    """
    n, b = z.shape
    chosen, pivot = LU[n * n + k], LU[k * n + k]
    share = LU.dtype.type(PIVOT)
    for s in range(b):
        chosen[s] = k
        largest[s] = 0
    for i in range(k + 1, n):
        entry = LU[i * n + k]
        for s in range(b):
            largest[s] = max(largest[s], abs(entry[s]))
    for s in range(b):
        if abs(pivot[s]) < share * largest[s]:
            row = k
            for i in range(k + 1, n):
                if abs(LU[i * n + k, s]) > abs(LU[row * n + k, s]):
                    row = i
            chosen[s] = row
            z[k, s], z[row, s] = z[row, s], z[k, s]
            for j in range(n):
                LU[k * n + j, s], LU[row * n + j, s] = LU[row * n + j, s], LU[k * n + j, s]


@part
def _schur_adjoint(
    theta: Any, x: Any, Ax: Any, gamma: float, epsilon: float, LU: Any, z: Any, q: Any, mu: Any,  # noqa: ARG001
    d_theta: Any, d_x: Any, work: Any,
) -> None:  # fmt: skip
    """∂J/∂W, ∂J/∂V and what ∂J/∂x has through A x; the module's docstring has the formulas.

    `work` (n + 5, b) holds λ, then W1 μ, W1 λ and W1 z, W2 λ row by row, and what is due to the margin.
    """
    n, b = x.shape
    g = theta.dtype.type(0.5 / gamma**2)
    half = theta.dtype.type(0.5)
    V = 4 * n * n
    lam = work[:n]
    for j in range(n):
        for s in range(b):
            lam[j, s] = 0
    for k in range(2 * n):
        d_q = work[n]
        for s in range(b):
            d_q[s] = 0
        for j in range(n):
            w1 = theta[k * 2 * n + j]
            for s in range(b):
                d_q[s] += w1[s] * mu[j, s]
        for j in range(n):
            w2 = theta[k * 2 * n + n + j]
            d_w2 = d_theta[k * 2 * n + n + j]
            for s in range(b):
                lam[j, s] += w2[s] * d_q[s]
                d_w2[s] = d_q[s] * z[j, s]
    for i in range(n):
        for j in range(i):
            factor = LU[j * n + i]
            for s in range(b):
                lam[i, s] -= factor[s] * lam[j, s]
        pivot = LU[i * n + i]
        for s in range(b):
            lam[i, s] = lam[i, s] / pivot[s]
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = LU[j * n + i]
            for s in range(b):
                lam[i, s] -= factor[s] * lam[j, s]
    for k in range(n - 2, -1, -1):
        chosen = LU[n * n + k]
        for s in range(b):
            row = int(chosen[s])
            if row != k:
                lam[k, s], lam[row, s] = lam[row, s], lam[k, s]
    t, t_skew = work[n + 3], work[n + 4]
    both = theta.dtype.type(0.5 * (1 + 1 / gamma**2) * _margin(theta, n))
    over_n, smallest = theta.dtype.type(1 / n), theta.dtype.type(1e-30)
    _squares(theta, V, n * (n - 1) // 2, t_skew)
    for s in range(b):
        t[s] = 0
    for i in range(n):
        for s in range(b):
            t[s] += lam[i, s] * z[i, s]
    for s in range(b):
        t_skew[s] = both * t[s] / max(math.sqrt(t_skew[s]), smallest)  # V = 0, an edge: no slope
        t[s] *= both * over_n
    for k in range(2 * n):
        w1_lam, w1_z, w2_lam = work[n], work[n + 1], work[n + 2]
        for s in range(b):
            w1_lam[s] = 0
            w1_z[s] = 0
            w2_lam[s] = 0
        for j in range(n):
            w1, w2 = theta[k * 2 * n + j], theta[k * 2 * n + n + j]
            for s in range(b):
                w1_lam[s] += w1[s] * lam[j, s]
                w1_z[s] += w1[s] * z[j, s]
                w2_lam[s] += w2[s] * lam[j, s]
        for j in range(n):
            w1, w2 = theta[k * 2 * n + j], theta[k * 2 * n + n + j]
            d_w1, d_w2 = d_theta[k * 2 * n + j], d_theta[k * 2 * n + n + j]
            for s in range(b):
                d_w1[s] = q[k, s] * mu[j, s] - g * (w1_lam[s] * z[j, s] + w1_z[s] * lam[j, s]) - t[s] * w1[s]
                d_w2[s] -= half * (w2_lam[s] * z[j, s] + q[k, s] * lam[j, s]) + t[s] * w2[s]
    for i in range(n):
        for j in range(i + 1, n):
            at = V + i * (2 * n - i - 1) // 2 + j - i - 1
            skew, d_skew = theta[at], d_theta[at]
            for s in range(b):
                d_skew[s] = z[i, s] * lam[j, s] - lam[i, s] * z[j, s] - t_skew[s] * skew[s]
    for i in range(n):
        for s in range(b):
            d_x[i, s] += lam[i, s]


@part
def _contraction(theta: Any, x: Any, gamma: float, epsilon: float, L: Any, z: Any, q: Any, x_next: Any) -> None:
    """x_next = γ L1⁻¹ S12 L2⁻ᵀ x; the two Cholesky factors, z = L2⁻ᵀ x and q = W2 z are for the adjoint.

    L1 is the lower triangle of the first n² rows of L, L2 of the others.
    """
    n, b = x.shape
    one, share = theta.dtype.type(epsilon), theta.dtype.type(epsilon / (2 * n))
    _squares(theta, 0, 4 * n * n, q[0])  # ε (1 + tr(WᵀW)/2n)
    for s in range(b):
        q[0, s] = one + share * q[0, s]
    for part in range(2):
        for i in range(n):
            for j in range(i + 1):
                entry = L[part * n * n + i * n + j]
                for s in range(b):
                    entry[s] = 0
                for k in range(2 * n):
                    w1, w2 = theta[k * 2 * n + part * n + i], theta[k * 2 * n + part * n + j]
                    for s in range(b):
                        entry[s] += w1[s] * w2[s]
                if i == j:
                    for s in range(b):
                        entry[s] += q[0, s]
        for j in range(n):
            pivot = L[part * n * n + j * n + j]
            for s in range(b):
                pivot[s] = math.sqrt(pivot[s])
            for i in range(j + 1, n):
                entry = L[part * n * n + i * n + j]
                for s in range(b):
                    entry[s] = entry[s] / pivot[s]
            for i in range(j + 1, n):
                for k in range(j + 1, i + 1):
                    entry = L[part * n * n + i * n + k]
                    f1, f2 = L[part * n * n + i * n + j], L[part * n * n + k * n + j]
                    for s in range(b):
                        entry[s] -= f1[s] * f2[s]
    for i in range(n):
        for s in range(b):
            z[i, s] = x[i, s]
            x_next[i, s] = 0
    _solve_transposed(L[n * n :], z)
    for k in range(2 * n):
        for s in range(b):
            q[k, s] = 0
        for j in range(n):
            w2 = theta[k * 2 * n + n + j]
            for s in range(b):
                q[k, s] += w2[s] * z[j, s]
        for j in range(n):
            w1 = theta[k * 2 * n + j]
            for s in range(b):
                x_next[j, s] += w1[s] * q[k, s]
    _solve(L, x_next)
    scale = theta.dtype.type(gamma)
    for i in range(n):
        for s in range(b):
            x_next[i, s] *= scale


@part
def _solve(L: Any, x: Any) -> None:
    """x = L⁻¹ x for the lower triangle L (n², b)."""
    n, b = x.shape
    for i in range(n):
        for j in range(i):
            factor = L[i * n + j]
            for s in range(b):
                x[i, s] -= factor[s] * x[j, s]
        pivot = L[i * n + i]
        for s in range(b):
            x[i, s] = x[i, s] / pivot[s]


@part
def _solve_transposed(L: Any, x: Any) -> None:
    """x = L⁻ᵀ x."""
    n, b = x.shape
    for i in range(n - 1, -1, -1):
        for j in range(i + 1, n):
            factor = L[j * n + i]
            for s in range(b):
                x[i, s] -= factor[s] * x[j, s]
        pivot = L[i * n + i]
        for s in range(b):
            x[i, s] = x[i, s] / pivot[s]


@part
def _cholesky_adjoint(L: Any, left: Any, right: Any, G: Any) -> None:
    """G = −2 ∂J/∂S for S = L Lᵀ with ∂J/∂L = −(L⁻ᵀ left) rightᵀ, or, the same in effect, −z rightᵀ for left = Lᵀ z.

    ∂J/∂S = ½ L⁻ᵀ (Φ + Φᵀ) L⁻¹ with Φ the lower triangle of −left rightᵀ, its diagonal halved. G (n, n, b).
    """
    n, b = left.shape
    for i in range(n):
        for j in range(i + 1):
            for s in range(b):
                G[i, j, s] = left[i, s] * right[j, s]
                G[j, i, s] = G[i, j, s]
    for _ in range(2):  # from the left, then, G being symmetric, from the right by way of its transpose
        for j in range(n):
            _solve_transposed(L, G[:, j])
        for i in range(n):
            for j in range(i):
                for s in range(b):
                    G[i, j, s], G[j, i, s] = G[j, i, s], G[i, j, s]


@part
def _contraction_adjoint(
    theta: Any, x: Any, Ax: Any, gamma: float, epsilon: float, L: Any, z: Any, q: Any, mu: Any,
    d_theta: Any, d_x: Any, work: Any,
) -> None:  # fmt: skip
    """∂J/∂W and what ∂J/∂x has through A x.

    With v = γ L1⁻ᵀ μ, λ = L2⁻¹ W2ᵀ W1 v and G1, G2 of `_cholesky_adjoint` for (μ, A x) and (x, λ):

        ∂J/∂x = λ + …,   ∂J/∂W1 = q vᵀ − W1 G1 − t W1,   ∂J/∂W2 = (W1 v) zᵀ − W2 G2 − t W2

    where t = (ε/2n) tr(G1 + G2) is due to ε's part of S growing with W. V has no part.
    `work` (2 n² + 2 n + 2, b).
    """
    n, b = x.shape
    scale, share = theta.dtype.type(gamma), theta.dtype.type(epsilon / (2 * n))
    v, lam, d_q, t = work[:n], work[n : 2 * n], work[2 * n], work[2 * n + 1]
    G = work[2 * n + 2 : 2 * n * (n + 1) + 2].reshape(2, n, n, b)
    for i in range(n):
        for s in range(b):
            v[i, s] = scale * mu[i, s]
            lam[i, s] = 0
    _solve_transposed(L, v)
    for k in range(2 * n):
        for s in range(b):
            d_q[s] = 0
        for j in range(n):
            w1 = theta[k * 2 * n + j]
            for s in range(b):
                d_q[s] += w1[s] * v[j, s]
        for j in range(n):
            w2, d_w1, d_w2 = theta[k * 2 * n + n + j], d_theta[k * 2 * n + j], d_theta[k * 2 * n + n + j]
            for s in range(b):
                lam[j, s] += w2[s] * d_q[s]
                d_w1[s] = q[k, s] * v[j, s]
                d_w2[s] = d_q[s] * z[j, s]
    _solve(L[n * n :], lam)
    _cholesky_adjoint(L, mu, Ax, G[0])
    _cholesky_adjoint(L[n * n :], x, lam, G[1])
    for s in range(b):
        t[s] = 0
    for part in range(2):
        for i in range(n):
            for s in range(b):
                t[s] += G[part, i, i, s]
    for s in range(b):
        t[s] *= share
    for part in range(2):
        for k in range(2 * n):
            for j in range(n):
                w, d_w = theta[k * 2 * n + part * n + j], d_theta[k * 2 * n + part * n + j]
                for s in range(b):
                    d_w[s] -= t[s] * w[s]
                for i in range(n):
                    w_i = theta[k * 2 * n + part * n + i]
                    for s in range(b):
                        d_w[s] -= w_i[s] * G[part, i, j, s]
    for k in range(4 * n * n, 4 * n * n + n * (n - 1) // 2):
        d_skew = d_theta[k]
        for s in range(b):
            d_skew[s] = 0
    for i in range(n):
        for s in range(b):
            d_x[i, s] += lam[i, s]


@part
def _free(
    theta: Any, x: Any, gamma: float, epsilon: float, factors: Any, z: Any, q: Any, x_next: Any,  # noqa: ARG001
) -> None:  # fmt: skip
    """x_next = A x with A the first n rows and columns of W."""
    n, b = x.shape
    for i in range(n):
        for s in range(b):
            x_next[i, s] = 0
        for j in range(n):
            row = theta[i * 2 * n + j]
            for s in range(b):
                x_next[i, s] += row[s] * x[j, s]


@part
def _free_adjoint(
    theta: Any, x: Any, Ax: Any, gamma: float, epsilon: float, factors: Any, z: Any, q: Any, mu: Any,  # noqa: ARG001
    d_theta: Any, d_x: Any, work: Any,  # noqa: ARG001
) -> None:  # fmt: skip
    """∂J/∂A = μ xᵀ, ∂J/∂x = Aᵀ μ + …"""
    n, b = x.shape
    for k in range(4 * n * n + n * (n - 1) // 2):
        row = d_theta[k]
        for s in range(b):
            row[s] = 0
    for i in range(n):
        for j in range(n):
            row, d_row = theta[i * 2 * n + j], d_theta[i * 2 * n + j]
            for s in range(b):
                d_row[s] = mu[i, s] * x[j, s]
                d_x[j, s] += row[s] * mu[i, s]


# How A follows from W and V is chosen by the *type* of `kind`, at compile time: nobody waits for the compilation
# of a parametrisation that he does not use.
KINDS: dict[str, Any] = {"schur": np.int8(0), "quadratic": np.int16(0), "none": np.int32(0)}


def _state_product(*_: Any) -> None:
    """x_next = A(ρ) x, for compiled code only."""


def _state_product_adjoint(*_: Any) -> None:
    """The adjoint of `_state_product`, for compiled code only."""


@overload(_state_product, jit_options=INLINE)
def _choose_product(kind: Any, *args: Any) -> Any:
    del args
    chosen = {types.int8: _schur, types.int16: _contraction, types.int32: _free}[kind]

    def product(kind: Any, *args: Any) -> None:  # noqa: ARG001
        chosen(*args)

    return product


@overload(_state_product_adjoint, jit_options=INLINE)
def _choose_adjoint(kind: Any, *args: Any) -> Any:
    del args
    chosen = {types.int8: _schur_adjoint, types.int16: _contraction_adjoint, types.int32: _free_adjoint}[kind]

    def adjoint(kind: Any, *args: Any) -> None:  # noqa: ARG001
        chosen(*args)

    return adjoint


@part
def _step(
    kind: Any, theta: Any, x: Any, u: Any, gamma: float, epsilon: float, factors: Any, z: Any, q: Any, x_next: Any,
    y: Any,
) -> None:  # fmt: skip
    """One sample: x_next, y, and what the adjoint needs (factors, z, q), batch innermost."""
    n, b = x.shape
    r, m = u.shape[0], y.shape[0]
    B = 4 * n * n + n * (n - 1) // 2
    C = B + n * r
    D = C + m * n  # there is one where the rows of theta reach so far
    _state_product(kind, theta, x, gamma, epsilon, factors, z, q, x_next)
    for j in range(n):
        for c in range(r):
            row = theta[B + j * r + c]
            for s in range(b):
                x_next[j, s] += row[s] * u[c, s]
    for o in range(m):
        for s in range(b):
            y[o, s] = 0
        for j in range(n):
            row = theta[C + o * n + j]
            for s in range(b):
                y[o, s] += row[s] * x[j, s]
        if len(theta) > D:
            for c in range(r):
                row = theta[D + o * r + c]
                for s in range(b):
                    y[o, s] += row[s] * u[c, s]


@part
def _step_adjoint(
    kind: Any, theta: Any, x: Any, u: Any, Ax: Any, gamma: float, epsilon: float, factors: Any, z: Any, q: Any,
    mu: Any, d_y: Any, d_theta: Any, d_x: Any, work: Any,
) -> None:  # fmt: skip
    """∂J/∂θ and ∂J/∂x of one sample from μ = ∂J/∂x(k+1) and ∂J/∂y. `d_x` is added to, `Ax` is overwritten.

    Ax (n, b) is x(k+1) at the start.
    """
    n, b = x.shape
    r, m = u.shape[0], d_y.shape[0]
    B = 4 * n * n + n * (n - 1) // 2
    C = B + n * r
    D = C + m * n
    for i in range(n):
        for c in range(r):
            row, d_b = theta[B + i * r + c], d_theta[B + i * r + c]
            for s in range(b):
                Ax[i, s] -= row[s] * u[c, s]
                d_b[s] = mu[i, s] * u[c, s]
    _state_product_adjoint(kind, theta, x, Ax, gamma, epsilon, factors, z, q, mu, d_theta, d_x, work)
    for o in range(m):
        for j in range(n):
            d_c, row = d_theta[C + o * n + j], theta[C + o * n + j]
            for s in range(b):
                d_c[s] = d_y[o, s] * x[j, s]
                d_x[j, s] += row[s] * d_y[o, s]
        if len(theta) > D:
            for c in range(r):
                row = d_theta[D + o * r + c]
                for s in range(b):
                    row[s] = d_y[o, s] * u[c, s]


def _tile(rows: int, vectors: int) -> Any:
    """An intrinsic for C = start + A B on a tile of `rows` × `vectors`, its sums kept in vector registers.

    The arguments are arrays, each with the tile's place and strides: A (rows, depth), B (depth, ·) with contiguous
    rows, `start` and C. BLAS libraries are slow for such small matrices, and choose their kernels by means that
    are out of our hands.
    """

    @intrinsic
    def tile(
        typingctx: Any, A: Any, a_at: Any, a_row: Any, a_step: Any, B: Any, b_at: Any, b_step: Any,  # noqa: ARG001
        start: Any, s_at: Any, s_row: Any, C: Any, c_at: Any, c_row: Any, depth: Any,  # noqa: ARG001
    ) -> Any:  # fmt: skip  # numba wants every argument by name
        del typingctx
        place = types.intp
        signature = types.void(A, place, place, place, B, place, place, start, place, place, C, place, place, place)

        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            builder.function.attributes.add("noinline")
            A, a_at, a_row, a_step, B, b_at, b_step, start, s_at, s_row, C, c_at, c_row, depth = args
            A, B, start, C = (
                context.make_array(signature.args[at])(context, builder, args[at]).data for at in (0, 4, 7, 10)
            )
            scalar = context.get_data_type(signature.args[0].dtype)
            size = signature.args[0].dtype.bitwidth // 8
            lanes = VECTOR // size
            vector = ir.VectorType(scalar, lanes)
            undefined, word = ir.Constant(vector, ir.Undefined), ir.IntType(32)
            all_first = ir.Constant(ir.VectorType(word, lanes), [0] * lanes)

            def number(value: int) -> Any:
                return ir.Constant(depth.type, value)

            def pointers(array: Any, at: Any, row: Any, count: int) -> list[Any]:
                firsts = [builder.add(at, builder.mul(row, number(i))) for i in range(count)]
                return [
                    builder.bitcast(builder.gep(array, [builder.add(first, number(v * lanes))]), vector.as_pointer())
                    for first in firsts
                    for v in range(vectors)
                ]

            begun = [builder.load(where, align=size) for where in pointers(start, s_at, s_row, rows)]
            a_rows = [builder.add(a_at, builder.mul(a_row, number(i))) for i in range(rows)]
            before, loop, after = builder.block, builder.append_basic_block(), builder.append_basic_block()
            builder.branch(loop)

            builder.position_at_end(loop)  # over the depth, which is at least 1
            k = builder.phi(depth.type)
            k.add_incoming(number(0), before)
            sums = []
            for value in begun:
                sums.append(builder.phi(vector))
                sums[-1].add_incoming(value, before)
            b_row = builder.add(b_at, builder.mul(k, b_step))
            columns = [builder.load(where, align=size) for where in pointers(B, b_row, b_row, 1)]
            a_column = builder.mul(k, a_step)
            added = []
            for i in range(rows):
                factor = builder.load(builder.gep(A, [builder.add(a_rows[i], a_column)]))
                factor = builder.insert_element(undefined, factor, ir.Constant(word, 0))
                factor = builder.shuffle_vector(factor, undefined, all_first)
                for v in range(vectors):
                    product = builder.fmul(factor, columns[v], flags=("contract",))
                    added.append(builder.fadd(product, sums[i * vectors + v], flags=("contract",)))
            following = builder.add(k, number(1))
            k.add_incoming(following, loop)
            for value, total in zip(added, sums, strict=True):
                total.add_incoming(value, loop)
            builder.cbranch(builder.icmp_signed("<", following, depth), loop, after)

            builder.position_at_end(after)
            for value, where in zip(added, pointers(C, c_at, c_row, rows), strict=True):
                builder.store(value, where, align=size)
            return context.get_dummy_value()

        return signature, codegen

    return tile


def _vector_bytes() -> tuple[int, bool]:
    """Bytes in a vector register of this machine, and whether there are 32 of them instead of 16."""
    features = get_host_cpu_features()
    if features.get("avx512f"):
        return 64, True
    return (32, False) if features.get("avx2") else (16, "neon" in features)


VECTOR, PAIRED = _vector_bytes()
TALL = 8  # rows of the large tiles
_tile_8x2, _tile_8x1, _tile_1x8, _tile_1x4, _tile_1x1 = _tile(8, 2), _tile(8, 1), _tile(1, 8), _tile(1, 4), _tile(1, 1)


@njit(**OPTIONS)  # its tiles mark it `noinline`, and spell out the order of each sum
def _gemm(
    A: Any, a_row: int, a_step: int, B: Any, b_step: int, start: Any, start_row: int, C: Any, c_row: int,
    rows: int, columns: int, depth: int,
) -> None:  # fmt: skip
    """C = start + A B, all flat: A (rows, depth) with strides `a_row` and `a_step`, B and C with contiguous rows.

    `columns` is a multiple of the lanes. Where `start` is C itself, the rows are a multiple of `TALL`.
    """
    lanes = VECTOR // C.itemsize
    whole = rows - rows % TALL
    j = 0
    while j < columns:
        wide = PAIRED and j + 2 * lanes <= columns
        for i in range(0, whole, TALL):
            at = i * start_row + j
            if wide:
                _tile_8x2(
                    A, i * a_row, a_row, a_step, B, j, b_step, start, at, start_row, C, i * c_row + j, c_row, depth
                )
            else:
                _tile_8x1(
                    A, i * a_row, a_row, a_step, B, j, b_step, start, at, start_row, C, i * c_row + j, c_row, depth
                )
        j += 2 * lanes if wide else lanes
    # The rows that are left, one by one; the last tile of a row may do some columns again.
    width = 8 * lanes if columns >= 8 * lanes else 4 * lanes if columns >= 4 * lanes else lanes
    for i in range(whole, rows):
        for j in range(0, columns, width):
            j = min(j, columns - width)
            at = i * start_row + j
            if width == 8 * lanes:
                _tile_1x8(
                    A, i * a_row, a_row, a_step, B, j, b_step, start, at, start_row, C, i * c_row + j, c_row, depth
                )
            elif width == 4 * lanes:
                _tile_1x4(
                    A, i * a_row, a_row, a_step, B, j, b_step, start, at, start_row, C, i * c_row + j, c_row, depth
                )
            else:
                _tile_1x1(
                    A, i * a_row, a_row, a_step, B, j, b_step, start, at, start_row, C, i * c_row + j, c_row, depth
                )


@part
def _sigmoid(z: Any) -> None:
    """σ in place, flat."""
    one = z.dtype.type(1)
    for i in range(z.size):
        z[i] = one / (one + _exp(-z[i]))


@part
def _through_sigmoid(delta: Any, activation: Any) -> None:
    """δ = ∂J/∂σ · σ (1 − σ) in place, all flat."""
    one = delta.dtype.type(1)
    for i in range(delta.size):
        delta[i] = delta[i] * activation[i] * (one - activation[i])


@part
def _add_rows(source: Any, row: int, rows: int, total: Any) -> None:
    """total += the sum of the rows of `source`."""
    for k in range(rows):
        at = source[k * row : k * row + total.size]
        for i in range(total.size):
            total[i] += at[i]


@part
def _clear(numbers: Any) -> None:
    """Set to zero; a slice assignment would do the same, but takes a quarter of a second to compile."""
    for i in range(numbers.size):
        numbers[i] = 0


@part
def _padded(width: int, lanes: int) -> int:
    """A row's length in memory: whole vectors."""
    return (width + lanes - 1) // lanes * lanes


@part
def _lay_out(weights: Any, widths: Any, n: int, forward: Any, biases: Any, backward: Any) -> None:
    """The generator's weights as the products want them: rows of whole vectors, zero beyond a layer's width.

    `forward` takes Wᵀ of each layer, `backward` W where it is not empty. Of V the last layer keeps V − Vᵀ above
    the diagonal, for nothing else of it counts: its rows are then W, V, B, C, D with n(n−1)/2 rows for V.
    """
    lanes = VECTOR // weights.itemsize
    last = len(widths) - 2
    at, row_at, bias_at, back_at = 0, 0, 0, 0
    for layer in range(last + 1):
        before, after = widths[layer], widths[layer + 1]
        rows = after if layer < last else after - n * (n + 1) // 2
        long, back = _padded(rows, lanes), _padded(before, lanes)
        W, bias = weights[at : at + after * before], weights[at + after * before : at + after * (before + 1)]
        WT, shift = forward[row_at : row_at + before * long], biases[bias_at : bias_at + long]
        _clear(shift)
        if long > rows:
            _clear(WT)
        for i in range(rows):
            plus, minus = (i, -1) if layer < last else _sources(i, n)
            shift[i] = bias[plus] if minus < 0 else bias[plus] - bias[minus]
            row = W[plus * before : (plus + 1) * before]
            if minus >= 0:
                other = W[minus * before : (minus + 1) * before]
                for j in range(before):
                    WT[j * long + i] = row[j] - other[j]
            else:
                for j in range(before):
                    WT[j * long + i] = row[j]
            if backward.size > 0:
                target = backward[back_at + i * back : back_at + (i + 1) * back]
                for j in range(before):
                    target[j] = row[j] if minus < 0 else row[j] - W[minus * before + j]
                _clear(target[before:])
        at += after * (before + 1)
        row_at += before * long
        bias_at += long
        if backward.size > 0:
            back_at += rows * back


@part
def _sources(i: int, n: int) -> tuple[int, int]:
    """Which rows of the last layer make row i of the collapsed one: their difference, or the first alone (−1)."""
    skew = n * (n - 1) // 2
    if i < 4 * n * n:
        return i, -1
    if i >= 4 * n * n + skew:
        return i + n * n - skew, -1
    i -= 4 * n * n
    row = 0
    while i >= n - 1 - row:
        i -= n - 1 - row
        row += 1
    column = row + 1 + i
    return 4 * n * n + row * n + column, 4 * n * n + column * n + row


@part
def _spread(collected: Any, sums: Any, widths: Any, n: int, gradient: Any) -> None:
    """The inverse of `_lay_out` for gradients: from padded rows of ∂J/∂W and ∂J/∂bias to the flat vector."""
    lanes = VECTOR // gradient.itemsize
    last = len(widths) - 2
    at, row_at, bias_at = 0, 0, 0
    for layer in range(last + 1):
        before, after = widths[layer], widths[layer + 1]
        rows = after if layer < last else after - n * (n + 1) // 2
        back = _padded(before, lanes)
        dW, d_bias = gradient[at : at + after * before], gradient[at + after * before : at + after * (before + 1)]
        if layer == last:
            _clear(dW)
            _clear(d_bias)
        for i in range(rows):
            plus, minus = (i, -1) if layer < last else _sources(i, n)
            source, target = collected[row_at + i * back :], dW[plus * before :]
            for j in range(before):
                target[j] = source[j]
            d_bias[plus] = sums[bias_at + i]
            if minus >= 0:
                target = dW[minus * before :]
                for j in range(before):
                    target[j] = -source[j]
                d_bias[minus] = -sums[bias_at + i]
        at += after * (before + 1)
        row_at += _padded(rows, TALL) * back
        bias_at += _padded(rows, lanes)


@part
def _set_rho(x: Any, u: Any, y_previous: Any, with_u: bool, with_y: bool, rho: Any) -> None:
    """The scheduling vectors, a row each: x, then u, then the previous output."""
    n, b = x.shape
    for s in range(b):
        row = rho[s]
        for i in range(n):
            row[i] = x[i, s]
        at = n
        if with_u:
            for i in range(len(u)):
                row[at + i] = u[i, s]
            at += len(u)
        if with_y:
            for i in range(len(y_previous)):
                row[at + i] = y_previous[i, s]


@part
def _transpose(rows: Any, row: int, columns: Any) -> None:
    """columns (P, b) from b rows that begin `row` apart."""
    P, b = columns.shape
    for i in range(P):
        target = columns[i]
        for s in range(b):
            target[s] = rows[s * row + i]


@part
def _transpose_back(columns: Any, rows: Any, row: int) -> None:
    """The inverse of `_transpose`."""
    P, b = columns.shape
    for s in range(b):
        target = rows[s * row : s * row + P]
        for i in range(P):
            target[i] = columns[i, s]


@part
def _aligned(count: int, dtype: Any) -> Any:
    """Zeros that begin at a whole cache line."""
    space = np.zeros(count + 16, dtype)
    skip = (-space.ctypes.data % 64) // space.itemsize
    return space[skip : skip + count]


@part
def _take(space: Any, used: int, count: int) -> Any:
    """The next `count` numbers of the workspace, and how many are taken now."""
    return space[used : used + count], used + count


@entry
def free_run(
    weights: Any, widths: Any, kind: Any, with_u: bool, with_y: bool, gamma: float, epsilon: float,
    x0: Any, u: Any, y0: Any, y: Any, x: Any,
) -> None:  # fmt: skip
    """Free simulations of b records side by side, in normalised units.

    Args:
        weights: of the generator, flat; what follows them is not read.
        widths: of the generator: scheduling size, hidden layers, number of entries of W, V, B, C, D.
        kind: one of `KINDS`: how A follows from W and V.
        with_u: whether u schedules.
        with_y: whether the previous output schedules.
        gamma: bound on the spectral radius.
        epsilon: of the Schur parametrisation.
        x0: initial states (n, b).
        u: inputs (K, r, b).
        y0: outputs before the first sample (m, b), for scheduling on them.
        y: simulated outputs (K, m, b), written.
        x: states (K, n, b), written.
    """
    K, m = len(u), len(y0)
    n, b = x0.shape
    dtype, lanes = weights.dtype, VECTOR // weights.itemsize
    layers = len(widths) - 1
    long = np.empty(layers + 1, np.int64)
    count, total, widest = 0, 0, 0
    P = widths[layers] - n * (n + 1) // 2
    for layer in range(layers + 1):
        long[layer] = _padded(widths[layer] if layer < layers else P, lanes)
        widest = max(widest, long[layer])
        total += long[layer]
        if layer > 0:
            count += widths[layer - 1] * long[layer]
    forward, biases = _aligned(count, dtype), _aligned(total - long[0], dtype)
    _lay_out(weights, widths, n, forward, biases, forward[:0])
    one, two = _aligned(b * widest, dtype), _aligned(b * widest, dtype)
    state, following = x0.copy(), np.empty((n, b), dtype)
    previous, theta = y0.copy(), np.empty((P, b), dtype)
    LU, z, q = np.empty((2 * n * n, b), dtype), np.empty((n, b), dtype), np.empty((2 * n, b), dtype)
    for k in range(K):
        source, target = one, two
        _set_rho(state, u[k], previous, with_u, with_y, source[: b * long[0]].reshape(b, long[0]))
        at, bias_at = 0, 0
        for layer in range(layers):
            after = long[layer + 1]
            _gemm(
                source, long[layer], 1, forward[at:], after, biases[bias_at:], 0, target, after, b, after, widths[layer]
            )  # fmt: skip
            at += widths[layer] * after
            bias_at += after
            if layer < layers - 1:
                _sigmoid(target[: b * after])
            source, target = target, source
        _transpose(source, long[layers], theta)
        _step(kind, theta, state, u[k], gamma, epsilon, LU, z, q, following, y[k])
        for i in range(n):
            for c in range(b):
                x[k, i, c] = state[i, c]
                state[i, c] = following[i, c]
        for i in range(m):
            for c in range(b):
                previous[i, c] = y[k, i, c]


@entry
def loss_and_gradient(
    weights: Any, widths: Any, kind: Any, E: Any, e: Any, with_u: bool, with_y: bool, gamma: float, epsilon: float,
    consistency: float, u: Any, y: Any, seen: Any, gradient: Any, d_E: Any, d_e: Any, space: Any,
) -> float:  # fmt: skip
    """J = mean (y − ŷ)² + λ mean (x(k) − E s(k) − e)² of a batch of windows, and its gradient.

    The linear encoder is one affine map here, x(0) = E s(0) + e, of what it sees, s(k) = y(k) in the paper.

    Args:
        weights: of the generator, flat; what follows them is not read.
        widths: of the generator; see `free_run`.
        kind: one of `KINDS`: how A follows from W and V.
        E: of the encoder (n, ·).
        e: of the encoder (n,).
        with_u: whether u schedules.
        with_y: whether the previous output schedules; the window then starts at its second sample.
        gamma: bound on the spectral radius.
        epsilon: of the Schur parametrisation.
        consistency: λ.
        u: inputs (L, r, b).
        y: measured outputs (L, m, b).
        seen: s (S, ·, b), S ≤ L, likewise from the second sample on where y schedules.
        gradient: ∂J/∂weights, written as far as the generator reaches.
        d_E: ∂J/∂E, written.
        d_e: ∂J/∂e, written.
        space: at least `workspace_size` numbers, overwritten; fresh memory each step would cost more
            in page faults than the algebra.
    """
    dtype, lanes = weights.dtype, VECTOR // weights.itemsize
    first_previous = y[0]
    if with_y:
        u, y = u[1:], y[1:]
    L, b = len(u), u.shape[2]
    (n, encoded), m, S = E.shape, y.shape[1], len(seen)
    depth, rho = len(widths) - 2, widths[0]
    P = widths[depth + 1] - n * (n + 1) // 2  # V counts by its skew part alone
    rows, long, longest = np.empty(depth + 2, np.int64), np.empty(depth + 2, np.int64), 0
    for layer in range(depth + 2):
        rows[layer] = widths[layer] if layer <= depth else P
        long[layer] = _padded(rows[layer], lanes)
        longest = max(longest, long[layer])
    span = max(1, ROWS // b)  # samples that make one weight-gradient product
    # where each layer's parts begin: Wᵀ, bias, W, ∂J/∂W, activations, δ
    ahead, shifts, back = np.zeros(depth + 2, np.int64), np.zeros(depth + 2, np.int64), np.zeros(depth + 2, np.int64)
    found, places, errors = np.zeros(depth + 2, np.int64), np.zeros(depth + 2, np.int64), np.zeros(depth + 2, np.int64)
    for layer in range(depth + 1):
        ahead[layer + 1] = ahead[layer] + rows[layer] * long[layer + 1]
        shifts[layer + 1] = shifts[layer] + long[layer + 1]
        back[layer + 1] = back[layer] + rows[layer + 1] * long[layer]
        found[layer + 1] = found[layer] + _padded(rows[layer + 1], TALL) * long[layer]
        places[layer + 1] = places[layer] + L * b * long[layer]
        errors[layer + 1] = errors[layer] + span * b * long[layer + 1]
    used = (-space.ctypes.data % 64) // space.itemsize
    kept, used = _take(space, used, places[depth + 1])
    forward, used = _take(space, used, ahead[depth + 1])
    biases, used = _take(space, used, shifts[depth + 1])
    backward, used = _take(space, used, back[depth + 1])
    collected, used = _take(space, used, found[depth + 1])
    sums, used = _take(space, used, shifts[depth + 1])
    deltas, used = _take(space, used, errors[depth + 1])
    zeros, used = _take(space, used, longest)
    out, used = _take(space, used, b * long[depth + 1])
    d_rho, used = _take(space, used, b * long[0])
    flat, used = _take(space, used, L * P * b)
    theta = flat.reshape(L, P, b)
    flat, used = _take(space, used, P * b)
    d_theta = flat.reshape(P, b)
    flat, used = _take(space, used, (L + 1) * n * b)
    x = flat.reshape(L + 1, n, b)
    flat, used = _take(space, used, L * m * b)
    y_sim = flat.reshape(L, m, b)
    flat, used = _take(space, used, L * 2 * n * n * b)
    LU = flat.reshape(L, 2 * n * n, b)
    flat, used = _take(space, used, L * n * b)
    z = flat.reshape(L, n, b)
    flat, used = _take(space, used, L * 2 * n * b)
    q = flat.reshape(L, 2 * n, b)
    _lay_out(weights, widths, n, forward, biases, backward)

    # forwards: everything that the adjoint needs is kept
    for i in range(n):
        for s in range(b):
            total = e[i]
            for o in range(encoded):
                total += E[i, o] * seen[0, o, s]
            x[0, i, s] = total
    for k in range(L):
        previous = (first_previous if with_y else y[0]) if k == 0 else y_sim[k - 1]
        here = k * b
        _set_rho(x[k], u[k], previous, with_u, with_y, kept[here * long[0] : (here + b) * long[0]].reshape(b, long[0]))
        for layer in range(depth + 1):
            after = long[layer + 1]
            target = out if layer == depth else kept[places[layer + 1] + here * after :][: b * after]
            _gemm(
                kept[places[layer] + here * long[layer] :], long[layer], 1, forward[ahead[layer] :], after,
                biases[shifts[layer] :], 0, target, after, b, after, rows[layer],
            )  # fmt: skip
            if layer < depth:
                _sigmoid(target)
        _transpose(out, long[depth + 1], theta[k])
        _step(kind, theta[k], x[k], u[k], gamma, epsilon, LU[k], z[k], q[k], x[k + 1], y_sim[k])

    # backwards
    _clear(collected)
    _clear(sums)
    _clear(deltas)
    _clear(zeros)
    _clear(d_E.reshape(d_E.size))
    _clear(d_e)
    per_output = dtype.type(2.0 / (b * L * m))
    per_state = dtype.type(2.0 * consistency / (b * (S - 1) * n)) if S > 1 else dtype.type(0)
    response, drift = 0.0, 0.0
    mu, d_x = np.zeros((n, b), dtype), np.empty((n, b), dtype)
    d_y, d_previous = np.empty((m, b), dtype), np.zeros((m, b), dtype)
    work = np.empty((2 * n * (n + 1) + 3, b), dtype)
    filled = 0  # samples in `deltas`, the latest first from the back
    for k in range(L - 1, -1, -1):
        for o in range(m):
            d_row, y_row, sim_row, previous_row = d_y[o], y[k, o], y_sim[k, o], d_previous[o]
            squares = dtype.type(0)
            for s in range(b):
                error = sim_row[s] - y_row[s]
                squares += error * error
                d_row[s] = per_output * error + previous_row[s]
            response += squares
        for i in range(n):
            d_row, x_row = d_x[i], x[k, i]
            if k == 0 or k >= S:
                for s in range(b):
                    d_row[s] = 0
                continue
            for s in range(b):
                d_row[s] = x_row[s] - e[i]
            for o in range(encoded):
                seen_row, factor = seen[k, o], E[i, o]
                for s in range(b):
                    d_row[s] -= factor * seen_row[s]
            total, squares = dtype.type(0), dtype.type(0)
            for s in range(b):
                squares += d_row[s] * d_row[s]
                d_row[s] *= per_state
                total += d_row[s]
            drift += squares
            d_e[i] -= total
            for o in range(encoded):
                seen_row = seen[k, o]
                total = dtype.type(0)
                for s in range(b):
                    total += d_row[s] * seen_row[s]
                d_E[i, o] -= total
        _step_adjoint(
            kind, theta[k], x[k], u[k], x[k + 1], gamma, epsilon, LU[k], z[k], q[k], mu, d_y, d_theta, d_x, work
        )

        # through the generator; the earliest sample of a block stands first
        filled += 1
        row = (span - filled) * b
        _transpose_back(d_theta, deltas[errors[depth] + row * long[depth + 1] :], long[depth + 1])
        for layer in range(depth, -1, -1):
            before, after = long[layer], long[layer + 1]
            target = d_rho if layer == 0 else deltas[errors[layer - 1] + row * before :][: b * before]
            _gemm(
                deltas[errors[layer] + row * after :], after, 1, backward[back[layer] :], before,
                zeros, 0, target, before, b, before, rows[layer + 1],
            )  # fmt: skip
            if layer > 0:
                _through_sigmoid(target, kept[places[layer] + k * b * before :][: b * before])
        for i in range(n):
            for s in range(b):
                mu[i, s] = d_x[i, s] + d_rho[s * long[0] + i]
        if with_y:
            for o in range(m):
                for s in range(b):
                    d_previous[o, s] = d_rho[s * long[0] + rho - m + o]

        if filled == span or k == 0:
            for layer in range(depth + 1):
                before, after = long[layer], long[layer + 1]
                delta, C = deltas[errors[layer] + row * after :], collected[found[layer] :]
                _gemm(
                    delta, 1, after, kept[places[layer] + k * b * before :], before, C, before, C, before,
                    _padded(rows[layer + 1], TALL), before, filled * b,
                )  # fmt: skip
                _add_rows(delta, after, filled * b, sums[shifts[layer] :][: rows[layer + 1]])
            filled = 0
    _spread(collected, sums, widths, n, gradient)
    for i in range(n):
        for s in range(b):
            d_e[i] += mu[i, s]
            for o in range(encoded):
                d_E[i, o] += mu[i, s] * seen[0, o, s]
    loss = response / (b * L * m)
    if S > 1:
        loss += consistency * drift / (b * (S - 1) * n)
    return loss


@entry
def sensitivities(
    weights: Any, widths: Any, kind: Any, with_u: bool, with_y: bool, gamma: float, epsilon: float,
    x0: Any, u: Any, y0: Any, S: Any, y: Any, x_all: Any, J: Any,
) -> None:  # fmt: skip
    """Simulated outputs of a stretch of a record and their derivatives by all weights.

    With S = ∂[x(k); y(k−1)]/∂weights

        ∂[x(k+1); y(k)]/∂weights = F S + ∂[x(k+1); y(k)]/∂weights at fixed x(k), y(k−1)

    where F and the last term come from the step's adjoint, seeded with the n + m unit vectors.

    Args:
        weights: as one vector, the generator's first.
        widths: of the generator; see `free_run`.
        kind: one of `KINDS`: how A follows from W and V.
        with_u: whether u schedules.
        with_y: whether the previous output schedules.
        gamma: bound on the spectral radius.
        epsilon: of the Schur parametrisation.
        x0: initial state (n,); becomes the one after the stretch.
        u: inputs (K, r).
        y0: output before the first sample (m,), for scheduling on it; becomes the last one.
        S: the derivatives (n + m, p) of x0 and y0 by the p weights; become those of what x0 and y0 become.
        y: simulated outputs (K, m), written.
        x_all: states (K, n), written.
        J: derivatives of the outputs (K, m, p), written.
    """
    dtype, lanes = weights.dtype, VECTOR // weights.itemsize
    K, m, n, r, p = len(u), len(y0), len(x0), u.shape[1], S.shape[1]
    layers, s = len(widths) - 1, n + m
    P = widths[layers] - n * (n + 1) // 2
    rows, long, longest = np.empty(layers + 1, np.int64), np.empty(layers + 1, np.int64), 0
    ahead, shifts, back, places = (
        np.zeros(layers + 1, np.int64), np.zeros(layers + 1, np.int64),
        np.zeros(layers + 1, np.int64), np.zeros(layers + 1, np.int64),
    )  # fmt: skip
    for layer in range(layers + 1):
        rows[layer] = widths[layer] if layer < layers else P
        long[layer] = _padded(rows[layer], lanes)
        longest = max(longest, long[layer])
    for layer in range(layers):
        ahead[layer + 1] = ahead[layer] + rows[layer] * long[layer + 1]
        shifts[layer + 1] = shifts[layer] + long[layer + 1]
        back[layer + 1] = back[layer] + rows[layer + 1] * long[layer]
        places[layer + 1] = places[layer] + s * long[layer]
    forward, biases, backward = (
        _aligned(ahead[layers], dtype), _aligned(shifts[layers], dtype), _aligned(back[layers], dtype)
    )  # fmt: skip
    _lay_out(weights, widths, n, forward, biases, backward)
    kept, out, zeros = _aligned(places[layers], dtype), _aligned(s * longest, dtype), _aligned(longest, dtype)
    _clear(zeros)
    delta, d_in = _aligned(s * longest, dtype), _aligned(s * longest, dtype)
    _clear(delta)
    theta, d_theta = np.empty((P, s), dtype), np.empty((P, s), dtype)
    LU, z, q = np.empty((2 * n * n, s), dtype), np.empty((n, s), dtype), np.empty((2 * n, s), dtype)
    x, x_next, u_now = np.empty((n, s), dtype), np.empty((n, s), dtype), np.empty((r, s), dtype)
    previous, output = np.empty((m, s), dtype), np.empty((m, s), dtype)
    d_x, work = np.empty((n, s), dtype), np.empty((2 * n * (n + 1) + 3, s), dtype)
    mu, d_y, Ax = np.zeros((n, s), dtype), np.zeros((m, s), dtype), np.empty((n, s), dtype)
    for i in range(n):
        mu[i, i] = 1
    for o in range(m):
        d_y[o, n + o] = 1
    wide = _padded(p, lanes)
    past, now, F = _aligned(s * wide, dtype), _aligned(s * wide, dtype), _aligned(s * s, dtype)
    _clear(past)
    for c in range(s):
        for w in range(p):
            past[c * wide + w] = S[c, w]
    for i in range(n):
        for c in range(s):
            x[i, c] = x0[i]
    for o in range(m):
        for c in range(s):
            previous[o, c] = y0[o]
    for k in range(K):
        for i in range(r):
            for c in range(s):
                u_now[i, c] = u[k, i]
        _set_rho(x, u_now, previous, with_u, with_y, kept[: s * long[0]].reshape(s, long[0]))
        for layer in range(layers):
            after = long[layer + 1]
            target = out if layer == layers - 1 else kept[places[layer + 1] :]
            _gemm(
                kept[places[layer] :], long[layer], 1, forward[ahead[layer] :], after,
                biases[shifts[layer] :], 0, target, after, s, after, rows[layer],
            )  # fmt: skip
            if layer < layers - 1:
                _sigmoid(target[: s * after])
        _transpose(out, long[layers], theta)
        _step(kind, theta, x, u_now, gamma, epsilon, LU, z, q, x_next, output)
        for i in range(n):
            for c in range(s):
                d_x[i, c] = 0
                Ax[i, c] = x_next[i, c]
        _step_adjoint(kind, theta, x, u_now, Ax, gamma, epsilon, LU, z, q, mu, d_y, d_theta, d_x, work)

        # the derivatives at fixed x(k) and y(k−1), a row for each of x(k+1) and y(k)
        _clear(now)
        _transpose_back(d_theta, delta, long[layers])
        end = 0
        for layer in range(layers):
            end += widths[layer + 1] * (widths[layer] + 1)
        for layer in range(layers - 1, -1, -1):
            before, after = widths[layer], widths[layer + 1]
            end -= after * (before + 1)
            for c in range(s):
                at = now[c * wide + end : c * wide + end + after * (before + 1)]
                z_in = kept[places[layer] + c * long[layer] :][:before]
                for i in range(rows[layer + 1]):
                    d = delta[c * long[layer + 1] + i]
                    plus, minus = (i, -1) if layer < layers - 1 else _sources(i, n)
                    target = at[plus * before : (plus + 1) * before]
                    for j in range(before):
                        target[j] = d * z_in[j]
                    at[after * before + plus] = d
                    if minus >= 0:
                        target = at[minus * before : (minus + 1) * before]
                        for j in range(before):
                            target[j] = -d * z_in[j]
                        at[after * before + minus] = -d
            _gemm(
                delta, long[layer + 1], 1, backward[back[layer] :], long[layer],
                zeros, 0, d_in, long[layer], s, long[layer], rows[layer + 1],
            )  # fmt: skip
            if layer > 0:
                flat = d_in[: s * long[layer]]
                _through_sigmoid(flat, kept[places[layer] :][: s * long[layer]])
                delta, d_in = d_in, delta
        for c in range(s):
            for i in range(n):
                F[c * s + i] = d_x[i, c] + d_in[c * long[0] + i]
            for o in range(m):
                F[c * s + n + o] = d_in[c * long[0] + rows[0] - m + o] if with_y else 0
        _gemm(F, s, 1, past, wide, now, wide, now, wide, s - s % TALL, wide, s)
        for c in range(s - s % TALL, s):  # rows that are added to may not be done again
            target = now[c * wide : (c + 1) * wide]
            for i in range(s):
                factor, source = F[c * s + i], past[i * wide : (i + 1) * wide]
                for w in range(wide):
                    target[w] += factor * source[w]
        for o in range(m):
            y[k, o] = output[o, 0]
            row, source = J[k, o], now[(n + o) * wide : (n + o + 1) * wide]
            for w in range(p):
                row[w] = source[w]
            for c in range(s):
                previous[o, c] = output[o, c]
        for i in range(n):
            x_all[k, i] = x[i, 0]
            for c in range(s):
                x[i, c] = x_next[i, c]
        past, now = now, past
    for i in range(n):
        x0[i] = x[i, 0]
    for o in range(m):
        y0[o] = previous[o, 0]
    for c in range(s):
        for w in range(p):
            S[c, w] = past[c * wide + w]


@entry
def adam(weights: Any, gradient: Any, first: Any, second: Any, rate: float, counter: int) -> None:
    """One Adam step in place, the bias corrected for `counter` steps."""
    dtype = weights.dtype
    one = dtype.type(1)
    beta1, beta2, small = dtype.type(0.9), dtype.type(0.999), dtype.type(1e-8)
    scale = dtype.type(rate / (1 - 0.9**counter))
    correction = dtype.type(1 / math.sqrt(1 - 0.999**counter))
    for i in range(weights.size):
        first[i] = beta1 * first[i] + (one - beta1) * gradient[i]
        second[i] = beta2 * second[i] + (one - beta2) * gradient[i] * gradient[i]
        weights[i] -= scale * first[i] / (math.sqrt(second[i]) * correction + small)


def workspace_size(widths: Sequence[int], n: int, m: int, L: int, b: int, itemsize: int) -> int:
    """Numbers that `loss_and_gradient` needs to keep for windows of L samples in batches of b, at most."""
    span, rounding = max(1, ROWS // b), max(VECTOR // itemsize, TALL)
    long = [width + rounding for width in widths]
    layers = sum(after * before for before, after in pairwise(long))
    P = widths[-1]
    kept = b * L * (sum(long) + P + m + 2 * n * n + 4 * n) + b * (sum(long[1:]) * span + 2 * long[-1] + long[0] + n)
    return kept + 3 * layers + 2 * sum(long) + max(long) + 2 * rounding
