"""Subspace identification: N4SID with past inputs as instruments and a simulation focus.

Sources: P. Van Overschee and B. De Moor, "N4SID: Subspace algorithms for the identification of
combined deterministic-stochastic systems", Automatica 30(1), 1994; L. Ljung, "System
Identification: Theory for the User", 2nd ed., 1999, section 10.6; W. E. Larimore, 1990, for CVA.
"""

from __future__ import annotations

import math

import numpy as np
from nnss_cli.baselines.statespace import LinearStateSpace, propagate
from nnss_cli.datasets.record import FloatArray, Record

from nnss_cli.errors import InputError

BLOCK = 4096  # columns of the Hankel matrix that are held at a time


def matlab_horizon(order: int, inputs: int, outputs: int) -> tuple[int, int]:
    """Future horizon f and number of past inputs p that MATLAB's n4sid takes with N4Horizon 'auto'.

    One output: f = ⌈1.5 n⌉, p = 4 n. For several outputs MATLAB's rule is not published; its
    choices for the power plant (5 inputs, 3 outputs) are known at n = 3, 4, 5, and elsewhere the
    rule of one output is used.
    """
    known = {3: (5, 6), 4: (5, 7), 5: (5, 7)}
    if (inputs, outputs) == (5, 3) and order in known:
        return known[order]
    return max(2, math.ceil(1.5 * order)), 4 * order


def n4sid(records: tuple[Record, ...], order: int) -> LinearStateSpace:
    """Identify x(k+1) = A x + B u, y = C x from input-output records (simulation focus, D = 0).

    1. Regress future outputs on past inputs with future inputs projected out,
       O = Y_f Π⊥(U_f) U_pᵀ (U_p Π⊥(U_f) U_pᵀ)⁻¹ U_p Π⊥(U_f), by one QR of the data.
    2. CVA weighting: W1 = (Y_f Π⊥ Y_fᵀ)^(−1/2); W1 O = U S Vᵀ; observability Γ = W1⁻¹ U1,
       without the singular values, as MATLAB scales it.
    3. C is the first block row of Γ; A by least squares from its shift; poles outside the unit
       disc are reflected into it.
    4. B and x0 of each record by least squares on the simulated output, with one reweighting by
       the residual covariance for several outputs.

    Args:
        records: experiments, in the units (usually normalised) that the model is to have.
        order: number of states n.

    Returns:
        The model in the basis of step 2.

    Raises:
        InputError: the records are too short for the order.
    """
    f, p = matlab_horizon(order, records[0].input_count, records[0].output_count)
    Gamma = observability(records, order, f, p)
    m = records[0].output_count
    C = Gamma[:m]
    A = reflect_unstable(np.linalg.lstsq(Gamma[:-m], Gamma[m:], rcond=None)[0])
    B = fit_input_matrix(A, C, records)
    return LinearStateSpace(A, B, C, np.zeros((m, B.shape[1])), records[0].Ts)


def observability(records: tuple[Record, ...], order: int, f: int, p: int) -> FloatArray:
    """Extended observability matrix Γ (f·m, n), steps 1 and 2 of `n4sid`.

    Args:
        records: experiments.
        order: number of states n.
        f: future horizon, samples.
        p: past inputs, samples.

    Raises:
        InputError: fewer Hankel columns than rows, or f·m ≤ n.
    """
    r, m = records[0].input_count, records[0].output_count
    rows = (f + p) * r + f * m
    columns = sum(max(0, len(record) - f - p + 1) for record in records)
    if columns < rows:
        raise InputError(
            f"order {order} is too large for n4sid on these records: horizons {p} + {f} need at least {rows} "
            f"windows, the data give {columns}; use a lower order or more data"
        )
    R = _compressed_hankel(records, f, p)
    a, b = f * r, (f + p) * r
    R32, R33 = R[b:, a:b], R[b:, b:]
    values, vectors = np.linalg.eigh(R32 @ R32.T + R33 @ R33.T)
    root = np.sqrt(np.maximum(values, values[-1] * np.finfo(float).eps))
    left = np.linalg.svd((vectors / root) @ vectors.T @ R32)[0]
    return np.asarray((vectors * root) @ vectors.T @ left[:, :order])


def _compressed_hankel(records: tuple[Record, ...], f: int, p: int) -> FloatArray:
    """Lower-triangular R of [U_f; U_p; Y_f] = R Q, one block of columns at a time."""
    triangle: FloatArray | None = None
    for record in records:
        for start in range(0, len(record) - f - p + 1, BLOCK):
            count = min(BLOCK, len(record) - f - p + 1 - start)
            rows = [record.u[start + p + i : start + p + i + count] for i in range(f)]
            rows += [record.u[start + i : start + i + count] for i in range(p)]
            rows += [record.y[start + p + i : start + p + i + count] for i in range(f)]
            block = np.concatenate(rows, axis=1)
            stacked = block if triangle is None else np.concatenate([triangle, block])
            triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
    assert triangle is not None
    return triangle.T


def reflect_unstable(A: FloatArray) -> FloatArray:
    """Mirror eigenvalues outside the unit disc into it: λ → 1/λ̄."""
    values, vectors = np.linalg.eig(A)
    outside = np.abs(values) > 1
    if not outside.any():
        return A
    values = np.where(outside, 1 / values.conj(), values)
    return np.real(vectors @ np.diag(values) @ np.linalg.inv(vectors))


def fit_input_matrix(A: FloatArray, C: FloatArray, records: tuple[Record, ...]) -> FloatArray:
    """B (n, r) that minimises the simulated output error, x0 of each record fitted along with it.

    The simulated output is linear in B and x0: y(k) = Σ_i,j B_ij C x_ij(k) + C A^k x0, where x_ij
    is driven by input j through unit vector i. With several outputs the problem is solved once
    more, weighted by the inverse covariance of the first residuals.
    """
    n, r, m = len(A), records[0].input_count, records[0].output_count
    regressors, targets = [], []
    for index, record in enumerate(records):
        K = len(record)
        regressor = np.zeros((K, m, n * r + n * len(records)))
        for i in range(n):
            for j in range(r):
                w = np.zeros((K, n))
                w[:, i] = record.u[:, j]
                regressor[:, :, i * r + j] = propagate(A, w, np.zeros(n))[:-1] @ C.T
            unit = np.eye(n)[i]
            free = propagate(A, np.zeros((K, n)), unit)[:-1]
            regressor[:, :, n * r + index * n + i] = free @ C.T
        regressors.append(regressor)
        targets.append(record.y)
    Phi, y = np.concatenate(regressors), np.concatenate(targets)

    def solve(weight: FloatArray) -> FloatArray:
        weighted = np.einsum("ab,kbp->kap", weight, Phi).reshape(-1, Phi.shape[2])
        return np.linalg.lstsq(weighted, (y @ weight.T).ravel(), rcond=None)[0]

    theta = solve(np.eye(m))
    if m > 1:
        residual = y - Phi @ theta
        covariance = residual.T @ residual / len(residual)
        floor = np.trace(covariance) / m * 1e-12  # an exact fit leaves no covariance to invert
        if floor > 0:
            theta = solve(np.linalg.cholesky(np.linalg.inv(covariance + floor * np.eye(m))).T)
    return theta[: n * r].reshape(n, r)
