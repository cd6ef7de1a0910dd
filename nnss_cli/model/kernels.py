"""NN-SS in machine code: simulation, loss and hand-derived gradient.

The same equations as `nnss`, written for the CPU. `NNSS` is the readable version and the oracle of
this one. Sizes are arguments, so one compilation a precision serves every architecture; numba
keeps it on disk for later processes.

Layout: signals and activations are (sample, channel, batch) with the batch innermost, so that the
n × n algebra vectorises over it and a layer is one matrix product. For a single window a weight's
gradient is one product over a block of samples. The generator's weights are one flat
vector, layer by layer: matrix, then bias.

A step never forms A:  M z = x,  q = W2 z,  A x = W1ᵀ q, with W = [W1 W2] and M by LU without pivoting
(its symmetric part is positive definite). Its adjoint, for μ = ∂J/∂x(k+1) and λ = M⁻ᵀ W2ᵀ W1 μ:

    ∂J/∂x = λ + …,   ∂J/∂M = −λ zᵀ,   ∂J/∂W1 = q μᵀ − (W1 λ zᵀ + W1 z λᵀ)/(2γ²),
    ∂J/∂W2 = (W1 μ) zᵀ − (W2 λ zᵀ + q λᵀ)/2,   ∂J/∂V = z λᵀ − λ zᵀ

All of it is one file on purpose: numba's cache looks at the file of the entry point alone, so a part
kept elsewhere could change without being compiled again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numba import njit, types
from numba.extending import intrinsic, overload

ROWS = 64  # samples in a weight-gradient product of a single window: enough for the matrix kernel
NARROW = 8  # inputs up to which a plain loop beats the matrix kernel
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


def _exp(x: float) -> float:
    """e^x without a library call, so that loops over it vectorise."""
    return math.exp(x)


@overload(_exp, jit_options={"fastmath": FAST, "error_model": "numpy"})
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
# Only the entry points are cached. A part that came from the cache would be linked into a caller
# in another form than one compiled along with it, and the last bits of results with it.
part = njit(**OPTIONS)
entry = njit(cache=True, **OPTIONS)


@part
def _step(
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
def _step_adjoint(
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


@part
def _product(W: Any, z: Any, out: Any) -> None:
    """out = W z for columns z (h_in, b)."""
    after, before = W.shape
    b = z.shape[1]
    if b == 1:
        np.dot(W, z.reshape(before), out.reshape(after))
    elif before > NARROW:
        np.dot(W, z, out)
    else:  # the matrix kernel does not pay for a few columns
        for i in range(after):
            row = out[i]
            for s in range(b):
                row[s] = 0
            for j in range(before):
                w, source = W[i, j], z[j]
                for s in range(b):
                    row[s] += w * source[s]


@part
def _affine(z: Any, W: Any, bias: Any, sigmoid: bool, out: Any) -> None:
    """out = W z + bias, or its sigmoid."""
    _product(W, z, out)
    after, b = out.shape
    flat = out.reshape(after * b)
    if b == 1:
        for i in range(after):
            flat[i] += bias[i]
    else:
        for i in range(after):
            row, shift = out[i], bias[i]
            for s in range(b):
                row[s] += shift
    if sigmoid:
        one = out.dtype.type(1)
        for i in range(flat.size):
            flat[i] = one / (one + _exp(-flat[i]))


@part
def _add_outer(delta: Any, z: Any, product: Any, target: Any, bias: Any) -> None:
    """target += Σ δ zᵀ and bias += Σ δ over (T, h, b): one product for b = 1, else one a sample."""
    T, after, b = delta.shape
    before = z.shape[1]
    if b == 1:
        rows = delta.reshape(T, after)
        np.dot(rows.T, z.reshape(T, before), product)
        for i in range(after):
            for j in range(before):
                target[i, j] += product[i, j]
        for k in range(T):
            for i in range(after):
                bias[i] += rows[k, i]
        return
    for k in range(T):
        for i in range(after):
            row = delta[k, i]
            total = bias.dtype.type(0)
            for s in range(b):
                total += row[s]
            bias[i] += total
        if before > NARROW:
            np.dot(delta[k], z[k].T, product)
            source, to = product.reshape(product.size), target.reshape(target.size)
            for i in range(source.size):
                to[i] += source[i]
        else:
            for i in range(after):
                row = delta[k, i]
                for j in range(before):
                    column = z[k, j]
                    total = bias.dtype.type(0)
                    for s in range(b):
                        total += row[s] * column[s]
                    target[i, j] += total


@part
def _through_sigmoid(d_out: Any, activation: Any, delta: Any) -> None:
    """δ = ∂J/∂σ · σ (1 − σ), all flat."""
    one = delta.dtype.type(1)
    for i in range(delta.size):
        delta[i] = d_out[i] * activation[i] * (one - activation[i])


@part
def _back_narrow(W: Any, delta: Any, d_rho: Any) -> None:
    """d_rho = Wᵀ δ for a few inputs."""
    after, rho = W.shape
    for i in range(rho):
        row = d_rho[i]
        for s in range(row.size):
            row[s] = 0
        for j in range(after):
            w, source = W[j, i], delta[j]
            for s in range(row.size):
                row[s] += w * source[s]


@part
def _set_rho(x: Any, u: Any, y_previous: Any, with_u: bool, with_y: bool, rho: Any) -> None:
    """The scheduling vector (ρ, b): x, then u, then the previous output."""
    n, r = len(x), len(u)
    rho[:n] = x
    if with_u:
        rho[n : n + r] = u
    if with_y:
        rho[len(rho) - len(y_previous) :] = y_previous


@part
def _take(space: Any, used: int, count: int) -> Any:
    """The next `count` numbers of the workspace, and how many are taken now."""
    return space[used : used + count], used + count


@entry
def free_run(
    weights: Any, widths: Any, with_u: bool, with_y: bool, gamma: float, epsilon: float,
    x0: Any, u: Any, y0: Any, y: Any, x: Any,
) -> None:  # fmt: skip
    """Free simulation of one record in normalised units.

    Args:
        weights: of the generator, flat; what follows them is not read.
        widths: of the generator: scheduling size, hidden layers, number of entries of W, V, B, C.
        with_u: whether u schedules.
        with_y: whether the previous output schedules.
        gamma: bound on the spectral radius.
        epsilon: of the Schur parametrisation.
        x0: initial state (n,).
        u: inputs (K, r).
        y0: output before the first sample (m,), for scheduling on it.
        y: simulated outputs (K, m), written.
        x: states (K, n), written.
    """
    K, m, n, r = len(u), len(y0), len(x0), u.shape[1]
    depth = len(widths) - 2
    P = widths[-1]
    state, following = np.empty((n, 1), weights.dtype), np.empty((n, 1), weights.dtype)
    state[:, 0] = x0
    previous, output, u_now = (
        np.empty((m, 1), weights.dtype),
        np.empty((m, 1), weights.dtype),
        np.empty((r, 1), weights.dtype),
    )
    previous[:, 0] = y0
    theta = np.empty((P, 1), weights.dtype)
    LU, z, q = np.empty((n * n, 1), weights.dtype), np.empty((n, 1), weights.dtype), np.empty((2 * n, 1), weights.dtype)
    offsets = np.zeros(depth + 2, np.int64)
    for layer in range(depth + 1):
        offsets[layer + 1] = offsets[layer] + widths[layer]
    columns = np.empty(offsets[depth + 1], weights.dtype)
    for k in range(K):
        for c in range(r):
            u_now[c, 0] = u[k, c]
        z_in = columns[: widths[0]].reshape(widths[0], 1)
        _set_rho(state, u_now, previous, with_u, with_y, z_in)
        at = 0
        for layer in range(depth + 1):
            before, after = widths[layer], widths[layer + 1]
            W = weights[at : at + after * before].reshape(after, before)
            bias = weights[at + after * before : at + after * before + after]
            at += after * (before + 1)
            if layer < depth:
                z_out = columns[offsets[layer + 1] : offsets[layer + 1] + after].reshape(after, 1)
                _affine(z_in, W, bias, True, z_out)
                z_in = z_out
            else:
                _affine(z_in, W, bias, False, theta)
        for i in range(n):
            x[k, i] = state[i, 0]
        _step(theta, state, u_now, gamma, epsilon, LU, z, q, following, output)
        for i in range(n):
            state[i, 0] = following[i, 0]
        for i in range(m):
            y[k, i] = output[i, 0]
            previous[i, 0] = output[i, 0]


@entry
def loss_and_gradient(
    weights: Any, widths: Any, E: Any, e: Any, with_u: bool, with_y: bool, gamma: float, epsilon: float,
    consistency: float, u: Any, y: Any, gradient: Any, d_E: Any, d_e: Any, space: Any,
) -> float:  # fmt: skip
    """J = mean (y − ŷ)² + λ mean (x(k) − E y(k) − e)² of a batch of windows, and its gradient.

    The linear encoder is one affine map here, x(0) = E y(0) + e.

    Args:
        weights: of the generator, flat; what follows them is not read.
        widths: of the generator; see `free_run`.
        E: of the encoder (n, m).
        e: of the encoder (n,).
        with_u: whether u schedules.
        with_y: whether the previous output schedules; the window then starts at its second sample.
        gamma: bound on the spectral radius.
        epsilon: of the Schur parametrisation.
        consistency: λ.
        u: inputs (L, r, b).
        y: measured outputs (L, m, b).
        gradient: ∂J/∂weights, written as far as the generator reaches.
        d_E: ∂J/∂E, written.
        d_e: ∂J/∂e, written.
        space: at least `workspace_size` numbers, overwritten; fresh memory each step would cost more
            in page faults than the algebra.
    """
    dtype = weights.dtype
    first_previous = y[0]
    if with_y:
        u, y = u[1:], y[1:]
    L, b = len(u), u.shape[2]
    n, m = E.shape
    depth, P, rho = len(widths) - 2, widths[-1], widths[0]
    starts = np.zeros(depth + 2, np.int64)  # of each layer's weights
    places = np.zeros(depth + 2, np.int64)  # of each layer's activations: ρ first
    for layer in range(depth + 1):
        starts[layer + 1] = starts[layer] + widths[layer + 1] * (widths[layer] + 1)
        places[layer + 1] = places[layer] + L * b * widths[layer]
    # forwards: everything that the adjoint needs is kept
    span = ROWS if b == 1 else 1  # samples that make one weight-gradient product
    widest, total_width = 0, 0
    for layer in range(1, depth + 2):
        widest = max(widest, widths[layer])
        total_width += widths[layer]
    used = 0
    kept, used = _take(space, used, places[depth + 1])
    flat, used = _take(space, used, L * P * b)
    theta = flat.reshape(L, P, b)
    flat, used = _take(space, used, (L + 1) * n * b)
    x = flat.reshape(L + 1, n, b)
    flat, used = _take(space, used, L * m * b)
    y_sim = flat.reshape(L, m, b)
    flat, used = _take(space, used, L * n * n * b)
    LU = flat.reshape(L, n * n, b)
    flat, used = _take(space, used, L * n * b)
    z = flat.reshape(L, n, b)
    flat, used = _take(space, used, L * 2 * n * b)
    q = flat.reshape(L, 2 * n, b)
    deltas, used = _take(space, used, total_width * span * b)  # δ of every layer, for `span` samples
    transposed, used = _take(space, used, starts[depth + 1])
    product, used = _take(space, used, widest * max(widest, rho))
    d_in, used = _take(space, used, b * widest)
    flat, used = _take(space, used, P * b)
    d_theta = flat.reshape(P, b)
    for i in range(n):
        for s in range(b):
            total = e[i]
            for o in range(m):
                total += E[i, o] * y[0, o, s]
            x[0, i, s] = total
    for k in range(L):
        previous = (first_previous if with_y else y[0]) if k == 0 else y_sim[k - 1]
        z_in = kept[k * b * rho : (k + 1) * b * rho].reshape(rho, b)
        _set_rho(x[k], u[k], previous, with_u, with_y, z_in)
        for layer in range(depth + 1):
            before, after = widths[layer], widths[layer + 1]
            W = weights[starts[layer] : starts[layer] + after * before].reshape(after, before)
            bias = weights[starts[layer] + after * before : starts[layer + 1]]
            if layer < depth:
                at = places[layer + 1] + k * b * after
                z_out = kept[at : at + b * after].reshape(after, b)
                _affine(z_in, W, bias, True, z_out)
                z_in = z_out
            else:
                _affine(z_in, W, bias, False, theta[k])
        _step(theta[k], x[k], u[k], gamma, epsilon, LU[k], z[k], q[k], x[k + 1], y_sim[k])

    # backwards
    if b > 1:  # products run faster on weights that are transposed once
        for layer in range(1, depth + 1):
            before, after = widths[layer], widths[layer + 1]
            W = weights[starts[layer] : starts[layer] + after * before].reshape(after, before)
            WT = transposed[starts[layer] : starts[layer] + after * before].reshape(before, after)
            for j in range(before):
                for i in range(after):
                    WT[j, i] = W[i, j]
    gradient[: starts[depth + 1]] = 0
    d_E[:] = 0
    d_e[:] = 0
    per_output = dtype.type(2.0 / (b * L * m))
    per_state = dtype.type(2.0 * consistency / (b * (L - 1) * n)) if L > 1 else dtype.type(0)
    response, drift = 0.0, 0.0
    mu, d_x = np.zeros((n, b), dtype), np.empty((n, b), dtype)
    d_y, d_previous = np.empty((m, b), dtype), np.zeros((m, b), dtype)
    work = np.empty((n + 3, b), dtype)
    d_rho = np.empty((rho, b), dtype)
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
            if k == 0:
                for s in range(b):
                    d_row[s] = 0
                continue
            for s in range(b):
                d_row[s] = x_row[s] - e[i]
            for o in range(m):
                y_row, factor = y[k, o], E[i, o]
                for s in range(b):
                    d_row[s] -= factor * y_row[s]
            total, squares = dtype.type(0), dtype.type(0)
            for s in range(b):
                squares += d_row[s] * d_row[s]
                d_row[s] *= per_state
                total += d_row[s]
            drift += squares
            d_e[i] -= total
            for o in range(m):
                y_row = y[k, o]
                total = dtype.type(0)
                for s in range(b):
                    total += d_row[s] * y_row[s]
                d_E[i, o] -= total
        _step_adjoint(theta[k], x[k], u[k], gamma, LU[k], z[k], q[k], mu, d_y, d_theta, d_x, work)

        # through the generator; the earliest sample of a block stands first
        sample = span - 1 - filled
        block = 0
        for layer in range(depth, -1, -1):
            before, after = widths[layer], widths[layer + 1]
            low = block + sample * b * after
            block += span * b * after
            delta = deltas[low : low + b * after].reshape(after, b)
            if layer == depth:
                delta[:] = d_theta
            else:
                at = places[layer + 1] + k * b * after
                _through_sigmoid(d_in, kept[at : at + b * after], deltas[low : low + b * after])
            W = weights[starts[layer] : starts[layer] + after * before].reshape(after, before)
            if b == 1:
                np.dot(delta.reshape(after), W, (d_in if layer > 0 else d_rho.reshape(rho))[:before])
            elif layer == 0:
                _back_narrow(W, delta, d_rho)
            else:
                WT = transposed[starts[layer] : starts[layer] + after * before].reshape(before, after)
                np.dot(WT, delta, d_in[: b * before].reshape(before, b))
        for i in range(n):
            for s in range(b):
                mu[i, s] = d_x[i, s] + d_rho[i, s]
        if with_y:
            for o in range(m):
                for s in range(b):
                    d_previous[o, s] = d_rho[rho - m + o, s]
        filled += 1

        if filled == span or k == 0:
            block = 0
            for layer in range(depth, -1, -1):
                before, after = widths[layer], widths[layer + 1]
                low = block + (span - filled) * b * after
                block += span * b * after
                at = places[layer] + k * b * before
                _add_outer(
                    deltas[low:block].reshape(filled, after, b),
                    kept[at : at + filled * b * before].reshape(filled, before, b),
                    product[: after * before].reshape(after, before),
                    gradient[starts[layer] : starts[layer] + after * before].reshape(after, before),
                    gradient[starts[layer] + after * before : starts[layer + 1]],
                )
            filled = 0
    for i in range(n):
        for s in range(b):
            d_e[i] += mu[i, s]
            for o in range(m):
                d_E[i, o] += mu[i, s] * y[0, o, s]
    loss = response / (b * L * m)
    if L > 1:
        loss += consistency * drift / (b * (L - 1) * n)
    return loss


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


def workspace_size(widths: Sequence[int], n: int, m: int, L: int, b: int) -> int:
    """Numbers that `loss_and_gradient` needs to keep for windows of L samples in batches of b."""
    P, hidden = widths[-1], sum(widths[:-1])
    widest = max(widths[1:])
    span = ROWS if b == 1 else 1
    kept = L * b * (hidden + P + m + n * n + 3 * n) + (L + 1) * n * b
    kept += sum(after * (before + 1) for before, after in pairwise(widths))
    return kept + sum(widths[1:]) * span * b + widest * max(widest, widths[0]) + b * (widest + P)
