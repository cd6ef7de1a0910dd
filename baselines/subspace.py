"""The parts of subspace identification: compressed data, observability, realisation, input matrix.

Sources: P. Van Overschee and B. De Moor, "N4SID: Subspace algorithms for the identification of
combined deterministic-stochastic systems", Automatica 30(1), 1994; M. Verhaegen, "Identification
of the deterministic part of MIMO state space models", Automatica 30(1), 1994 (MOESP);
W. E. Larimore, "Canonical variate analysis", CDC 1990 (CVA); L. Ljung, "System Identification:
Theory for the User", 2nd ed., 1999, section 10.6.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from nnss_cli.baselines.statespace import propagate
from nnss_cli.datasets.record import FloatArray, Record

from nnss_cli.errors import InputError

BLOCK = 4096  # samples of a regression that are held at a time: memory stays linear in the record

Weighting: TypeAlias = Literal["cva", "moesp", "n4sid"]


@dataclass(frozen=True)
class Horizon:
    """How far a subspace method looks, and how it weights what it sees."""

    future: int
    """Future samples f."""
    past: int
    """Past samples p of the instruments."""
    past_outputs: bool = False
    """Whether past outputs are instruments too: exact without noise, also from a non-zero state."""
    weighting: Weighting = "cva"
    """cva, moesp or n4sid."""


def triangularise(blocks: Iterable[FloatArray]) -> FloatArray:
    """R of the QR decomposition of all rows of `blocks`, one block in memory at a time."""
    R: FloatArray | None = None
    for block in blocks:
        R = np.asarray(np.linalg.qr(block if R is None else np.concatenate([R, block]), mode="r"))
    if R is None:
        raise InputError("expected at least one sample, found none")
    return R


def least_squares(R: FloatArray) -> FloatArray:
    """Solution θ of [Φ y] θ ≈ … from R of [Φ y], y in the last column; the shortest one if Φ is rank-deficient."""
    P = R.shape[1] - 1
    return np.asarray(np.linalg.lstsq(R[:P, :P], R[:P, P], rcond=None)[0])


def constant_channels(records: tuple[Record, ...]) -> list[str]:
    """Which inputs and outputs do not vary within any record, such as "input u1" and "output y2"."""
    found = []
    for kind, name in (("input", "u"), ("output", "y")):
        spreads = np.max([np.ptp(getattr(record, name), axis=0) for record in records], axis=0)
        found += [f"{kind} {name}{i + 1}" for i in np.flatnonzero(spreads == 0)]
    return found


def observability(records: tuple[Record, ...], order: int, horizon: Horizon) -> FloatArray:
    """Extended observability matrix Γ (f·m, n).

    Future outputs are regressed on the instruments Z (past inputs, perhaps past outputs) with
    future inputs projected out, all from R of the data's QR:

        O = Y_f Π Zᵀ (Z Π Zᵀ)⁻¹ Z,   Π = projection off U_f,   W1 O W2 = U S Vᵀ,   Γ = W1⁻¹ U1

    with W1 = (Y_f Π Y_fᵀ)^(−1/2), W2 = Π (cva); W1 = I, W2 = Π (moesp); W1 = I, W2 = I (n4sid).
    Γ carries no singular values: the scale that MATLAB's n4sid takes.

    Raises:
        InputError: fewer Hankel columns than rows, f·m ≤ n, or outputs that are constant.
    """
    r, m = records[0].input_count, records[0].output_count
    f, p = horizon.future, horizon.past
    channels = r + m * horizon.past_outputs
    rows = f * (r + m) + p * channels
    columns = sum(max(0, len(record) - f - p + 1) for record in records)
    if columns < rows or f * m <= order:
        raise InputError(
            f"order {order} is too large for these records: horizons of {p} past and {f} future samples need at "
            f"least {rows} windows, the data give {columns}; use a lower order or more data"
        )
    if not any(np.ptp(record.y[p:], axis=0).any() for record in records if len(record) > p):
        names = [name for name in constant_channels(records) if name.startswith("output")]
        if len(names) < m:
            raise InputError(f"no output varies after the first {p} samples of the training records: use a lower order")
        verb = "is" if m == 1 else "are"
        raise InputError(f"{' and '.join(names)} {verb} constant over the training records: nothing to identify")
    L = triangularise(_hankel_blocks(records, horizon)).T
    a, b = f * r, f * r + p * channels
    if horizon.weighting == "cva":
        values, vectors = np.linalg.eigh(L[b:, a:] @ L[b:, a:].T)
        kept = values > values[-1] * len(values) * np.finfo(float).eps  # without noise it is singular
        root, vectors = np.sqrt(values[kept]), vectors[:, kept]
        left = np.linalg.svd((vectors / root).T @ L[b:, a:b])[0]
        # In the basis of the eigenvectors: the same Γ as with the symmetric root.
        return np.asarray((vectors * root) @ left[:, :order])
    weighted = L[b:, a:b]
    if horizon.weighting == "n4sid":
        weighted = np.linalg.lstsq(L[a:b, a:b].T, weighted.T, rcond=None)[0].T @ L[a:b, :b]
    return np.asarray(np.linalg.svd(weighted)[0][:, :order])


def _hankel_blocks(records: tuple[Record, ...], horizon: Horizon) -> Iterator[FloatArray]:
    """Columns of [U_f; Z; Y_f], transposed: rows of the regression."""
    f, p = horizon.future, horizon.past
    for record in records:
        for start in range(0, len(record) - f - p + 1, BLOCK):
            count = min(BLOCK, len(record) - f - p + 1 - start)
            parts = [record.u[start + p + i : start + p + i + count] for i in range(f)]
            parts += [record.u[start + i : start + i + count] for i in range(p)]
            if horizon.past_outputs:
                parts += [record.y[start + i : start + i + count] for i in range(p)]
            parts += [record.y[start + p + i : start + p + i + count] for i in range(f)]
            yield np.concatenate(parts, axis=1)


def realise(Gamma: FloatArray, outputs: int) -> tuple[FloatArray, FloatArray]:
    """A from the shift of Γ by least squares, unstable poles reflected, and C, its first block row."""
    A = np.linalg.lstsq(Gamma[:-outputs], Gamma[outputs:], rcond=None)[0]
    return reflect_unstable(np.asarray(A)), Gamma[:outputs]


def reflect_unstable(A: FloatArray) -> FloatArray:
    """Mirror eigenvalues outside the unit disc into it: λ → 1/λ̄."""
    values, vectors = np.linalg.eig(A)
    outside = np.abs(values) > 1
    if not outside.any():
        return A
    values = np.where(outside, 1 / values.conj(), values)
    return np.real(vectors @ np.diag(values) @ np.linalg.inv(vectors))


def fit_input_matrix(A: FloatArray, C: FloatArray, records: tuple[Record, ...]) -> tuple[FloatArray, FloatArray]:
    """B (n, r) and the initial state of each record (E, n) that minimise the simulated output error.

    The simulated output is linear in them: y(k) = Σ_ij B_ij C x_ij(k) + C A^k x0, where x_ij is
    driven by input j through unit vector i. With several outputs the problem is solved once
    more, weighted by the inverse covariance of the first residuals.
    """
    n, r, m = len(A), records[0].input_count, records[0].output_count

    def solve(weight: FloatArray) -> FloatArray:
        return least_squares(triangularise(_input_regression(A, C, records, weight)))

    theta = solve(np.eye(m))
    if m > 1:
        B, x0 = theta[: n * r].reshape(n, r), theta[n * r :].reshape(-1, n)
        residuals = [
            record.y - propagate(A, record.u @ B.T, start)[:-1] @ C.T for record, start in zip(records, x0, strict=True)
        ]
        whitener = inverse_root(np.concatenate(residuals))
        if whitener is not None:
            theta = solve(whitener)
    return theta[: n * r].reshape(n, r), theta[n * r :].reshape(-1, n)


def _input_regression(
    A: FloatArray, C: FloatArray, records: tuple[Record, ...], weight: FloatArray
) -> Iterator[FloatArray]:
    """Rows [Φ y] of the regression for vec(B) and the initial states, weighted, block by block."""
    n, r, m = len(A), records[0].input_count, records[0].output_count
    for index, record in enumerate(records):
        # n·r states driven by one input each, then n free ones
        x = np.concatenate([np.zeros((n * r, n)), np.eye(n)])
        for start in range(0, len(record), BLOCK):
            u, y = record.u[start : start + BLOCK], record.y[start : start + BLOCK]
            w = np.zeros((n * r + n, len(y), n))
            for i in range(n):
                for j in range(r):
                    w[i * r + j, :, i] = u[:, j]
            states = propagate(A, w, x)
            x = states[:, -1]
            outputs = states[:, :-1] @ (weight @ C).T
            block = np.zeros((len(y), m, n * r + n * len(records) + 1))
            block[:, :, : n * r] = outputs[: n * r].transpose(1, 2, 0)
            block[:, :, n * r + index * n : n * r + (index + 1) * n] = outputs[n * r :].transpose(1, 2, 0)
            block[:, :, -1] = y @ weight.T
            yield block.reshape(-1, block.shape[2])


def inverse_root(residuals: FloatArray) -> FloatArray | None:
    """W with WᵀW = Λ⁻¹, Λ the covariance of `residuals` (K, m); None where they are exactly zero."""
    covariance = residuals.T @ residuals / len(residuals)
    floor = np.trace(covariance) / len(covariance) * 1e-12  # outputs that depend on each other
    if not floor > 0 or not np.isfinite(floor):
        return None
    return np.linalg.cholesky(np.linalg.inv(covariance + floor * np.eye(len(covariance)))).T
