"""Compiled loops over the samples of an incrementally stable layer: simulation, loss and gradient, sensitivities.

    x(k+1) = A x + B u + F z,   z = tanh(Gx + Hu + b) − tanh(b),   y = C x + D u + E z

Everything is of the plain matrices; what they owe to the free weights is one matrix for all samples (`lure`). Signals
are (sample, channel, batch) with the batch innermost, as in `nnss_cli.model.kernels`, so that loops vectorise over it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from nnss_cli.model.kernels import _exp, entry, part


@part
def _add_product(M: Any, x: Any, out: Any) -> None:
    """out (p, b) += M (p, q) x (q, b)."""
    for i in range(M.shape[0]):
        row = out[i]
        for j in range(M.shape[1]):
            factor, source = M[i, j], x[j]
            for s in range(row.size):
                row[s] += factor * source[s]


@part
def _add_transposed(M: Any, x: Any, out: Any) -> None:
    """out (q, b) += Mᵀ x for M (p, q), x (p, b)."""
    for i in range(M.shape[0]):
        source = x[i]
        for j in range(M.shape[1]):
            factor, row = M[i, j], out[j]
            for s in range(row.size):
                row[s] += factor * source[s]


@part
def _add_outer(x: Any, y: Any, out: Any) -> None:
    """out (p, q) += x (p, b) yᵀ (b, q)."""
    for i in range(out.shape[0]):
        left = x[i]
        for j in range(out.shape[1]):
            right = y[j]
            total = out.dtype.type(0)
            for s in range(left.size):
                total += left[s] * right[s]
            out[i, j] += total


@part
def _units(G: Any, H: Any, b: Any, x: Any, u: Any, bent: Any) -> None:
    """bent (q, b) = tanh(G x + H u + b), as 1 − 2/(e^2v + 1)."""
    one, two = bent.dtype.type(1), bent.dtype.type(2)
    for i in range(len(b)):
        row = bent[i]
        for s in range(row.size):
            row[s] = b[i]
    _add_product(G, x, bent)
    _add_product(H, u, bent)
    for i in range(len(b)):
        row = bent[i]
        for s in range(row.size):
            row[s] = one - two / (_exp(two * row[s]) + one)


@part
def _advance(
    A: Any, B: Any, F: Any, G: Any, H: Any, b: Any, C: Any, D: Any, E: Any, rest: Any,
    x: Any, u: Any, bent: Any, z: Any, following: Any, y: Any,
) -> None:  # fmt: skip
    """One sample: x(k+1) into `following`, y, and tanh(Gx + Hu + b) and z, of which rest = tanh(b) is taken off."""
    _units(G, H, b, x, u, bent)
    for i in range(len(b)):
        for s in range(z.shape[1]):
            z[i, s] = bent[i, s] - rest[i]
    following[:] = 0
    y[:] = 0
    _add_product(A, x, following)
    _add_product(B, u, following)
    _add_product(F, z, following)
    _add_product(C, x, y)
    _add_product(D, u, y)
    _add_product(E, z, y)


@part
def _rest(b: Any) -> Any:
    """tanh(b) (q,), by the formula of `_units`."""
    one, two = b.dtype.type(1), b.dtype.type(2)
    rest = np.empty_like(b)
    for i in range(len(b)):
        rest[i] = one - two / (_exp(two * b[i]) + one)
    return rest


@entry
def free_run(
    A: Any, B: Any, F: Any, G: Any, H: Any, b: Any, C: Any, D: Any, E: Any, x0: Any, u: Any, y: Any, x: Any
) -> None:
    """Simulations side by side: y (K, m, b) and x (K, n, b) are written, from x0 (n, b) and u (K, r, b)."""
    rest = _rest(b)
    state, following = x0.copy(), np.empty_like(x0)
    bent, z = np.empty((len(b), x0.shape[1]), x0.dtype), np.empty((len(b), x0.shape[1]), x0.dtype)
    for k in range(len(u)):
        x[k] = state
        _advance(A, B, F, G, H, b, C, D, E, rest, state, u[k], bent, z, following, y[k])
        state, following = following, state


@entry
def loss_and_gradient(
    A: Any, B: Any, F: Any, G: Any, H: Any, b: Any, C: Any, D: Any, E: Any, encoder: Any, shift: Any,
    consistency: float, u: Any, y: Any, seen: Any,
    d_A: Any, d_B: Any, d_F: Any, d_G: Any, d_H: Any, d_b: Any, d_C: Any, d_D: Any, d_E: Any,
    d_encoder: Any, d_shift: Any,
) -> float:  # fmt: skip
    """J = mean (y − ŷ)² + λ mean (x(k) − g(s(k)))², g(s) = encoder s + shift, of windows u (L, r, b) and y (L, m, b).

    What the encoder sees, s (S, ·, b), is y in the paper.
    All that begins with d_ gets its derivative added, from zero.
    """
    L, m, batch = y.shape
    n, q, S = len(A), len(b), len(seen)
    dtype = A.dtype
    rest = _rest(b)
    x, z = np.empty((L + 1, n, batch), dtype), np.empty((L, q, batch), dtype)
    bent, error = np.empty((L, q, batch), dtype), np.empty((L, m, batch), dtype)
    for i in range(n):
        for s in range(batch):
            x[0, i, s] = shift[i]
    _add_product(encoder, seen[0], x[0])
    response, drift = 0.0, 0.0
    for k in range(L):
        _advance(A, B, F, G, H, b, C, D, E, rest, x[k], u[k], bent[k], z[k], x[k + 1], error[k])
        for o in range(m):
            squares = dtype.type(0)
            for s in range(batch):
                error[k, o, s] -= y[k, o, s]
                squares += error[k, o, s] ** 2
            response += squares
    per_output = dtype.type(2.0 / (batch * L * m))
    per_state = dtype.type(2.0 * consistency / (batch * (S - 1) * n)) if S > 1 else dtype.type(0)
    mu, d_x = np.zeros((n, batch), dtype), np.empty((n, batch), dtype)
    d_v, off, d_rest = np.empty((q, batch), dtype), np.empty((n, batch), dtype), np.zeros(q, dtype)
    for k in range(L - 1, -1, -1):
        d_y = error[k]
        for o in range(m):
            for s in range(batch):
                d_y[o, s] *= per_output
        d_v[:] = 0
        _add_transposed(F, mu, d_v)
        _add_transposed(E, d_y, d_v)
        for i in range(q):
            through, lost = dtype.type(0), dtype.type(0)
            for s in range(batch):
                lost += d_v[i, s]
                d_v[i, s] *= 1 - bent[k, i, s] ** 2
                through += d_v[i, s]
            d_b[i] += through
            d_rest[i] += lost
        _add_outer(mu, x[k], d_A)
        _add_outer(mu, u[k], d_B)
        _add_outer(mu, z[k], d_F)
        _add_outer(d_v, x[k], d_G)
        _add_outer(d_v, u[k], d_H)
        _add_outer(d_y, x[k], d_C)
        _add_outer(d_y, u[k], d_D)
        _add_outer(d_y, z[k], d_E)
        d_x[:] = 0
        _add_transposed(A, mu, d_x)
        _add_transposed(C, d_y, d_x)
        _add_transposed(G, d_v, d_x)
        if 0 < k < S and consistency > 0:
            for i in range(n):
                for s in range(batch):
                    off[i, s] = shift[i]
            _add_product(encoder, seen[k], off)
            for i in range(n):
                squares, total = dtype.type(0), dtype.type(0)
                for s in range(batch):
                    off[i, s] = x[k, i, s] - off[i, s]
                    squares += off[i, s] ** 2
                    off[i, s] *= -per_state
                    d_x[i, s] -= off[i, s]
                    total += off[i, s]
                drift += squares
                d_shift[i] += total
            _add_outer(off, seen[k], d_encoder)
        mu, d_x = d_x, mu
    for i in range(q):
        d_b[i] -= d_rest[i] * (1 - rest[i] ** 2)
    _add_outer(mu, seen[0], d_encoder)
    for i in range(n):
        total = dtype.type(0)
        for s in range(batch):
            total += mu[i, s]
        d_shift[i] += total
    penalty = consistency * drift / (batch * (S - 1) * n) if S > 1 else 0.0
    return response / (batch * L * m) + penalty


@entry
def sensitivities(
    A: Any,
    B: Any,
    F: Any,
    G: Any,
    H: Any,
    b: Any,
    C: Any,
    D: Any,
    E: Any,
    x0: Any,
    u: Any,
    S: Any,
    y: Any,
    x: Any,
    J: Any,
) -> None:
    """Outputs y (K, m), states x (K, n) and ∂y/∂[A, B, F, G, H, b, C, D, E; x(0)] (K, m, p + n), each row after row.

    S (n, p + n) is ∂x/∂ of the same at x0 (n,), 0 but for the last n columns at a window's start; it and x0 are left as
    they are after the last sample.
    """
    n, r, m, q = len(A), B.shape[1], len(C), len(b)
    dtype = A.dtype
    rest = _rest(b)
    at_B, at_F, at_G = n * n, n * (n + r), n * (n + r + q)
    at_H, at_b = at_G + q * n, at_G + q * (n + r)
    at_C = at_b + q
    at_D, at_E = at_C + m * n, at_C + m * (n + r)
    end = at_E + m * q
    states = end + n
    bent, z = np.empty((q, 1), dtype), np.empty((q, 1), dtype)
    state, following, out = np.empty((n, 1), dtype), np.empty((n, 1), dtype), np.empty((m, 1), dtype)
    slope, M, N = np.empty(q, dtype), np.empty((n, n), dtype), np.empty((m, n), dtype)
    T = np.empty_like(S)
    state[:, 0] = x0
    for k in range(len(u)):
        driving = u[k].reshape(r, 1)
        _advance(A, B, F, G, H, b, C, D, E, rest, state, driving, bent, z, following, out)
        x[k], y[k] = state[:, 0], out[:, 0]
        for i in range(q):
            slope[i] = 1 - bent[i, 0] ** 2
        for i in range(n):
            for j in range(n):
                total = A[i, j]
                for o in range(q):
                    total += F[i, o] * slope[o] * G[o, j]
                M[i, j] = total
        for i in range(m):
            for j in range(n):
                total = C[i, j]
                for o in range(q):
                    total += E[i, o] * slope[o] * G[o, j]
                N[i, j] = total
        J[k] = 0
        for rows, through, factor, target in ((m, N, E, J[k]), (n, M, F, T)):
            for i in range(rows):
                row = target[i]
                for p in range(states):
                    row[p] = 0
                for j in range(n):
                    scale, source = through[i, j], S[j]
                    for p in range(at_C):
                        row[p] += scale * source[p]
                    for p in range(end, states):
                        row[p] += scale * source[p]
                for o in range(q):  # the units' own weights
                    bent_by = factor[i, o] * slope[o]
                    for j in range(n):
                        row[at_G + o * n + j] += bent_by * state[j, 0]
                    for j in range(r):
                        row[at_H + o * r + j] += bent_by * driving[j, 0]
                    row[at_b + o] += bent_by - factor[i, o] * (1 - rest[o] ** 2)
        for first, second, third, rows, target in ((0, at_B, at_F, n, T), (at_C, at_D, at_E, m, J[k])):
            for i in range(rows):
                for j in range(n):
                    target[i, first + i * n + j] += state[j, 0]
                for j in range(r):
                    target[i, second + i * r + j] += driving[j, 0]
                for j in range(q):
                    target[i, third + i * q + j] += z[j, 0]
        S[:] = T
        state, following = following, state
    x0[:] = state[:, 0]
