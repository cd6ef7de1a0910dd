"""One sample of NN-SS in machine code: the sigmoid's exponential, the step and its adjoint.

Signals are (channel, batch) with the batch innermost, so that the n × n algebra vectorises over
it. A step never forms A:  M z = x,  q = W2 z,  A x = W1ᵀ q, with W = [W1 W2] and M by LU without
pivoting (its symmetric part is positive definite). Its adjoint, for μ = ∂J/∂x(k+1) and
λ = M⁻ᵀ W2ᵀ W1 μ:

    ∂J/∂x = λ + …,   ∂J/∂M = −λ zᵀ,   ∂J/∂W1 = q μᵀ − (W1 λ zᵀ + W1 z λᵀ)/(2γ²),
    ∂J/∂W2 = (W1 μ) zᵀ − (W2 λ zᵀ + q λᵀ)/2,   ∂J/∂V = z λᵀ − λ zᵀ
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic, overload

# Reordering and contraction are allowed; NaN and infinity are not assumed away, so that a
# divergence still reaches the loss.
FAST = {"reassoc", "contract", "arcp", "nsz"}


@intrinsic
def _bits_to_float(typingctx: Any, bits: Any) -> Any:
    """The float whose bit pattern is an integer: 2^k from k without a function call."""
    del typingctx
    result = types.float32 if bits == types.int32 else types.float64

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], context.get_value_type(signature.return_type))

    return result(bits), codegen


_float_from_bits: Any = _bits_to_float  # numba passes the first argument itself


def exp(x: float) -> float:
    """e^x without a library call, so that loops over it vectorise."""
    return math.exp(x)


@overload(exp, jit_options={"fastmath": FAST, "error_model": "numpy"})
def exp_compiled(x: Any) -> Any:
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
# Only the entry points are cached. A part that came from the cache would be linked into a caller
# in another form than one compiled along with it, and the last bits of results with it.
part = njit(**OPTIONS)
entry = njit(cache=True, **OPTIONS)


@part
def step(
    theta: Any, x: Any, u: Any, gamma: float, epsilon: float, LU: Any, z: Any, q: Any, x_next: Any, y: Any
) -> None:
    """One sample: x_next, y, and what the adjoint needs (LU of M, z, q), batch innermost."""
    n, b = x.shape
    r, m = u.shape[0], y.shape[0]
    g = theta.dtype.type(0.5 / gamma**2)
    half = theta.dtype.type(0.5)
    diagonal = theta.dtype.type(0.5 * epsilon * (1 + 1 / gamma**2))
    V, B, C = 4 * n * n, 5 * n * n, 5 * n * n + n * r
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
                    upper[s] += diagonal
            else:
                v1, v2 = theta[V + i * n + j], theta[V + j * n + i]
                for s in range(b):
                    skew = v1[s] - v2[s]
                    lower[s] = upper[s] - skew
                    upper[s] = upper[s] + skew
    for k in range(n):
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
        for s in range(b):
            z[i, s] = x[i, s]
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


@part
def step_adjoint(
    theta: Any,
    x: Any,
    u: Any,
    gamma: float,
    LU: Any,
    z: Any,
    q: Any,
    mu: Any,
    d_y: Any,
    d_theta: Any,
    d_x: Any,
    work: Any,
) -> None:
    """∂J/∂θ and ∂J/∂x of one sample from μ = ∂J/∂x(k+1) and ∂J/∂y; the module's docstring has the formulas.

    `d_x` is added to. `work` (5 n, b) holds λ, then W1 μ, W1 λ and W1 z, W2 λ row by row.
    """
    n, b = x.shape
    r, m = u.shape[0], d_y.shape[0]
    g = theta.dtype.type(0.5 / gamma**2)
    half = theta.dtype.type(0.5)
    V, B, C = 4 * n * n, 5 * n * n, 5 * n * n + n * r
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
            d_w1, d_w2 = d_theta[k * 2 * n + j], d_theta[k * 2 * n + n + j]
            for s in range(b):
                d_w1[s] = q[k, s] * mu[j, s] - g * (w1_lam[s] * z[j, s] + w1_z[s] * lam[j, s])
                d_w2[s] -= half * (w2_lam[s] * z[j, s] + q[k, s] * lam[j, s])
    for i in range(n):
        for j in range(n):
            d_v = d_theta[V + i * n + j]
            for s in range(b):
                d_v[s] = z[i, s] * lam[j, s] - lam[i, s] * z[j, s]
        for c in range(r):
            d_b = d_theta[B + i * r + c]
            for s in range(b):
                d_b[s] = mu[i, s] * u[c, s]
        for s in range(b):
            d_x[i, s] += lam[i, s]
    for o in range(m):
        for j in range(n):
            d_c, row = d_theta[C + o * n + j], theta[C + o * n + j]
            for s in range(b):
                d_c[s] = d_y[o, s] * x[j, s]
                d_x[j, s] += row[s] * d_y[o, s]
