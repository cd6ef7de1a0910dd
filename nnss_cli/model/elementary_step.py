"""NN-SS in elementary operations: the formulas of `nnss_cli.model.nnss` and `nnss_cli.model.schur` without a solver."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import accumulate, pairwise

import numpy as np

from nnss_cli.baselines.schur import schur_margin
from nnss_cli.datasets.record import FloatArray
from nnss_cli.elementary import Expression, cholesky, columns, dense, rows, solve, solve_lower, solve_upper
from nnss_cli.model.architecture import Architecture
from nnss_cli.system import Parts

NEAR = 1e-10  # keeps a secant's quotient of squares from 0/0; it moves the slope by a third of it at most


def nnss_parts(
    a: Architecture, weights: Mapping[str, FloatArray], layer: tuple[FloatArray, ...] | None = None
) -> Parts:
    """The formulas of an NN-SS model in normalised units.

    Args:
        a: its architecture.
        weights: its arrays by name, as they are kept on disk; those of lower precision count as they are.
        layer: A, B, F, G, H, b, C, D, E of an incrementally stable layer (`nnss_cli.model.incremental`).
    """
    n, r, m = a.order, a.inputs, a.outputs
    arrays = {name: np.asarray(array, dtype=np.float64) for name, array in weights.items()}

    def network(name: str, numbers: range) -> list[tuple[FloatArray, FloatArray]]:
        return [(arrays[f"{name}.{i}.weight"], arrays[f"{name}.{i}.bias"]) for i in numbers]

    encoder = network("encoder", range(len(a.encoder) + 1))
    generator = [] if layer else network("generator", range(0, 2 * len(a.hidden) + 1, 2))
    if a.integrator:
        step, drift = arrays["step_size"][:, None], arrays["generator_drift.bias"][:, None]
    scheduled = a.scheduling.split("+")
    E, e = np.eye(a.encoder_inputs), np.zeros(a.encoder_inputs)  # a chain of linear layers is one
    for weight, bias in encoder:
        E, e = weight @ E, weight @ e + bias

    def generated(x: Expression, u: Expression, y: Expression) -> tuple[Expression, ...]:
        """W (2n, 2n), V (n, n), B (n, r), C (m, n) and D (m, r)."""
        h = rows(x, *[u] * ("u" in scheduled), *[y] * ("y" in scheduled))
        for weight, bias in generator[:-1]:
            h = dense(weight, bias, h).sigmoid()
        theta = dense(*generator[-1], h)
        shapes = ((2 * n, 2 * n), (n, n), (n, r), (m, n), (m, r))
        ends = accumulate(a.parameter_sizes, initial=0)
        found = [
            theta[i:j, :].reshape(*shape) if j > i else x.constant(np.zeros(shape))
            for (i, j), shape in zip(pairwise(ends), shapes, strict=True)
        ]
        return tuple(found)

    def times_A(W: Expression, V: Expression, b: Expression) -> Expression:
        """A b, for b (n, c)."""
        if a.stability == "none":
            return W[:n, :n] @ b
        gram = W.T @ W
        size = (W * W).sum() / float(2 * n)  # tr(WᵀW)/2n
        one = np.eye(n)
        if a.stability == "schur":
            K = V - V.T
            margin = schur_margin(n, a.dtype)
            if n > 1:  # else K is 0, where its norm has no derivative
                size = size + (K * K).sum().root() / math.sqrt(2)
            added = size * margin + a.epsilon
            S11, S22 = gram[:n, :n] + added * b.constant(one), gram[n:, n:] + added * b.constant(one)
            M = (S11 / a.gamma**2 + S22) * 0.5 + K
            return gram[:n, n:] @ solve(M, b)
        added = (size + 1.0) * a.epsilon
        L1, L2 = (cholesky(part + added * b.constant(one)) for part in (gram[:n, :n], gram[n:, n:]))
        return solve_lower(L1, gram[:n, n:] @ solve_upper(L2, b)) * a.gamma

    def lpv_step(x: Expression, u: Expression, y: Expression) -> tuple[Expression, Expression]:
        """x(k+1) and y(k) of the part before an integrator."""
        if layer:
            A, B, F, G, H, b, C, D, E = map(x.constant, (*layer[:5], layer[5][:, None], *layer[6:]))
            z = tanh(G @ x + H @ u + b) - x.constant(np.tanh(layer[5])[:, None])
            output = C @ x + E @ z
            return A @ x + B @ u + F @ z, output + D @ u if a.feedthrough else output
        W, V, B, C, D = generated(x, u, y)
        output = C @ x
        return times_A(W, V, x) + B @ u, output + D @ u if a.feedthrough else output

    def lpv_matrices(x: Expression, u: Expression, y: Expression) -> tuple[Expression, ...]:
        """A, B, C and D of the part before an integrator."""
        if layer:
            A, B, F, G, H, b, C, D, E = map(x.constant, (*layer[:5], layer[5][:, None], *layer[6:]))
            v = G @ x + H @ u
            bent = tanh(v + b) - x.constant(np.tanh(layer[5])[:, None])
            flat = x.constant(1 - np.tanh(layer[5])[:, None] ** 2)  # of a secant through v = 0
            slope = (bent * v + flat * NEAR) / (v * v + NEAR)
            by_x, by_u = columns(*[slope] * n) * G, columns(*[slope] * r) * H
            return A + F @ by_x, B + F @ by_u, C + E @ by_x, D + E @ by_u
        W, V, B, C, D = generated(x, u, y)
        return times_A(W, V, x.constant(np.eye(n))), B, C, D

    def advance(x: Expression, u: Expression, y: Expression) -> tuple[Expression, Expression]:
        x, w = x[:n, :], x[n:, :] if a.integrator else x
        following, output = lpv_step(x, u, y)
        if a.integrator:
            return rows(following, w + (output + output.constant(drift)) * output.constant(step)), w
        return following, output

    def frozen(x: Expression, u: Expression, y: Expression) -> tuple[Expression, ...]:
        A, B, C, D = lpv_matrices(x[:n, :], u, y)
        if not a.integrator:
            return A, B, C, D
        zero, one, s = x.constant(np.zeros((n, m))), np.eye(m), x.constant(np.diag(step[:, 0]))
        outputs = x.constant(np.hstack([np.zeros((m, n)), one]))
        A = rows(columns(A, zero), columns(s @ C, x.constant(one)))
        return A, rows(B, s @ D), outputs, x.constant(np.zeros((m, r)))

    def initial(y0: Expression, u0: Expression) -> Expression:
        x = dense(E, e, y0 if a.encoder_window == 1 else rows(y0, u0))
        return rows(x, y0[:m, :]) if a.integrator else x

    return Parts(
        advance, initial, frozen, a.states, "y" in scheduled, a.feedthrough and not a.integrator, a.encoder_window
    )


def tanh(v: Expression) -> Expression:
    """tanh(v) = 2 σ(2v) − 1."""
    return (v * 2.0).sigmoid() * 2.0 - 1.0
