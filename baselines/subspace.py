"""The parts of subspace identification: compressed data, observability, realisation, input matrix.

Sources: P. Van Overschee and B. De Moor, "N4SID: Subspace algorithms for the identification of
combined deterministic-stochastic systems", Automatica 30(1), 1994; M. Verhaegen, "Identification
of the deterministic part of MIMO state space models", Automatica 30(1), 1994 (MOESP);
W. E. Larimore, "Canonical variate analysis", CDC 1990 (CVA); L. Ljung, "System Identification:
Theory for the User", 2nd ed., 1999, section 10.6.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
import scipy.linalg.lapack
from nnss_cli.baselines.statespace import propagate
from nnss_cli.datasets.record import FloatArray, Record

from nnss_cli.errors import InputError

BLOCK = 4096  # samples of a regression that are held at a time: memory stays linear in the record
DEPENDENT = 1e8  # condition of a covariance beyond which outputs count as depending on each other
ROWS = 1024  # of a regression that are eliminated at a time: they stay in the cache
PANEL = 16  # columns that are eliminated before the others follow in a matrix product

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
    """R of the QR decomposition of all rows of `blocks`, one block in memory at a time.

    Once R is square, further rows are eliminated against it by LAPACK's tpqrt, which makes use of its zeros.
    """
    R: FloatArray | None = None
    for block in blocks:
        height = max(ROWS, block.shape[1])
        for start in range(0, len(block), height):
            rows = block[start : start + height]
            if R is None or len(R) < R.shape[1]:
                R = np.asarray(np.linalg.qr(rows if R is None else np.concatenate([R, rows]), mode="r"))
            else:
                R = scipy.linalg.lapack.dtpqrt(0, min(PANEL, len(R)), R, rows, overwrite_a=True)[0]
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


class WindowFactors:
    """R of the windows of past and future samples, of several horizons, from one pass over the records.

    p past and f future samples lie within P ≥ p and F ≥ f about the same sample, all but those near the ends of a
    record: what the widest windows' R has in their columns, with these few rows below, has the same R as all rows.
    """

    def __init__(self, records: tuple[Record, ...], horizons: Iterable[Horizon]) -> None:
        """For the horizons that `observability` will be asked for; those too wide for the records are left out."""
        self.records = records
        usable = [horizon for horizon in horizons if window_count(records, horizon) >= row_count(records, horizon)]
        self.widest = Horizon(
            max((horizon.future for horizon in usable), default=0),
            max((horizon.past for horizon in usable), default=0),
            any(horizon.past_outputs for horizon in usable),
        )
        self._R: FloatArray | None = None
        self._last: tuple[tuple[int, int, bool], FloatArray] | None = None  # weightings of a horizon follow each other

    def triangle(self, horizon: Horizon) -> FloatArray:
        """R of the rows [U_f Z Y_f], Z the past inputs and perhaps past outputs, of a horizon given at the start."""
        key = horizon.future, horizon.past, horizon.past_outputs
        if self._last is None or self._last[0] != key:
            self._last = key, self._triangle(horizon)
        return self._last[1]

    def _triangle(self, horizon: Horizon) -> FloatArray:
        F, P = self.widest.future, self.widest.past
        if self._R is None:
            # a record too short for the widest windows has them all in the loop below
            central = [_window_rows(record, self.widest, P, len(record) - F + 1) for record in self.records]
            none = np.empty((0, row_count(self.records, self.widest)))
            self._R = triangularise(itertools.chain(*central)) if window_count(self.records, self.widest) else none
        f, p = horizon.future, horizon.past
        if (F, P, self.widest.past_outputs) == (f, p, horizon.past_outputs):
            return self._R
        r, m = self.records[0].input_count, self.records[0].output_count
        starts = np.cumsum([0, F * r, P * r, P * m * self.widest.past_outputs])
        spans = [(0, f * r), ((P - p) * r, P * r), ((P - p) * m, P * m), (0, f * m)]
        columns = [np.arange(start + first, start + stop) for start, (first, stop) in zip(starts, spans, strict=True)]
        if not horizon.past_outputs:
            del columns[2]
        edges = []
        for record in self.records:
            K = len(record)
            edges.append(_window_rows(record, horizon, p, min(P, K - f + 1)))
            edges.append(_window_rows(record, horizon, max(P, K - F + 1), K - f + 1))
        return triangularise(itertools.chain([self._R[:, np.concatenate(columns)]], *edges))


def window_count(records: tuple[Record, ...], horizon: Horizon) -> int:
    """Windows of p past and f future samples in the records."""
    return sum(max(0, len(record) - horizon.future - horizon.past + 1) for record in records)


def row_count(records: tuple[Record, ...], horizon: Horizon) -> int:
    """Signals in a window: f future samples of all channels, p past ones of the instruments."""
    r, m = records[0].input_count, records[0].output_count
    return horizon.future * (r + m) + horizon.past * (r + m * horizon.past_outputs)


def observability(
    records: tuple[Record, ...], order: int, horizon: Horizon, factors: WindowFactors | None = None
) -> FloatArray:
    """Extended observability matrix Γ (f·m, n).

    Future outputs are regressed on the instruments Z (past inputs, perhaps past outputs) with
    future inputs projected out, all from R of the data's QR:

        O = Y_f Π Zᵀ (Z Π Zᵀ)⁻¹ Z,   Π = projection off U_f,   W1 O W2 = U S Vᵀ,   Γ = W1⁻¹ U1

    with W1 = (Y_f Π Y_fᵀ)^(−1/2), W2 = Π (cva); W1 = I, W2 = Π (moesp); W1 = I, W2 = I (n4sid).
    Γ carries no singular values: the scale that MATLAB's n4sid takes.

    Args:
        records: experiments.
        order: number of states n.
        horizon: f, p and what weights them.
        factors: of these records, for several horizons; of this one where it is None.

    Raises:
        InputError: fewer Hankel columns than rows, f·m ≤ n, or outputs that are constant.
    """
    r, m = records[0].input_count, records[0].output_count
    f, p = horizon.future, horizon.past
    rows, columns = row_count(records, horizon), window_count(records, horizon)
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
    L = (factors or WindowFactors(records, [horizon])).triangle(horizon).T
    a, b = f * r, rows - f * m
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


def _window_rows(record: Record, horizon: Horizon, first: int, stop: int) -> Iterator[FloatArray]:
    """Rows [U_f Z Y_f] of the windows whose future begins at samples `first` … `stop` − 1, block by block."""
    f, p = horizon.future, horizon.past
    lags = [(record.u, range(f)), (record.u, range(-p, 0))]
    lags += [(record.y, range(-p, 0))] * horizon.past_outputs + [(record.y, range(f))]
    for start in range(first, stop, BLOCK):
        count = min(BLOCK, stop - start)
        parts = [signal[start + lag : start + lag + count] for signal, each in lags for lag in each]
        block = np.empty((count, sum(part.shape[1] for part in parts)), order="F")
        yield np.concatenate(parts, axis=1, out=block)


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
    values[outside] = 1 / values[outside].conj()
    return np.real(vectors @ np.diag(values) @ np.linalg.inv(vectors))


def fit_input_matrix(A: FloatArray, C: FloatArray, records: tuple[Record, ...]) -> tuple[FloatArray, FloatArray]:
    """B (n, r) and the initial state of each record (E, n) that minimise the simulated output error.

    The simulated output is linear in them: y_o(k) = Σ_ij B_ij ξ_oj(k)_i + ξ_o(k)ᵀ x0 with

        ξ_oj(k+1) = Aᵀ ξ_oj(k) + c_o u_j(k), ξ_oj(0) = 0,   ξ_o(k) = (Aᵀ)^k c_o,   c_oᵀ = row o of C

    With several outputs the problem is solved once more, weighted by the inverse covariance of the first residuals.
    """
    n, r, m = len(A), records[0].input_count, records[0].output_count

    def solve(weight: FloatArray) -> tuple[FloatArray, FloatArray]:
        triangles = [triangularise(_input_regression(A, C, record, weight)) for record in records]
        # What a record's own x0 explains is taken off first: with columns for each, time would grow with their cube.
        theta = least_squares(triangularise(_unexplained(R, n) for R in triangles))
        x0 = [np.linalg.lstsq(R[:, :n], R[:, -1] - R[:, n:-1] @ theta, rcond=None)[0] for R in triangles]
        return theta.reshape(n, r), np.array(x0)

    B, x0 = solve(np.eye(m))
    if m > 1:
        residuals = [
            record.y - propagate(A, record.u @ B.T, start)[:-1] @ C.T for record, start in zip(records, x0, strict=True)
        ]
        whitener = inverse_root(np.concatenate(residuals))
        if whitener is not None:
            B, x0 = solve(whitener)
    return B, x0


def _input_regression(A: FloatArray, C: FloatArray, record: Record, weight: FloatArray) -> Iterator[FloatArray]:
    """Rows [Φ_x0 Φ_B y] of a record's regression for its initial state and vec(B), weighted, block by block."""
    n, r, m = len(A), record.input_count, record.output_count
    x: FloatArray = np.zeros((m, 1 + r, n))  # the free ξ, and that of every input
    x[:, 0] = weight @ C
    for start in range(0, len(record), BLOCK):
        u, y = record.u[start : start + BLOCK], record.y[start : start + BLOCK]
        w = np.zeros((m, 1 + r, len(y), n))
        w[:, 1:] = u.T[:, :, None] * (weight @ C)[:, None, None]
        states = propagate(A.T, w, x)
        x = states[:, :, -1]
        block = np.empty((len(y), m, n + n * r + 1))
        block[:, :, :n] = states[:, 0, :-1].transpose(1, 0, 2)
        block[:, :, n:-1] = states[:, 1:, :-1].transpose(2, 0, 3, 1).reshape(len(y), m, n * r)
        block[:, :, -1] = y @ weight.T
        yield block.reshape(-1, block.shape[2])


def _unexplained(R: FloatArray, n: int) -> FloatArray:
    """The columns of R from n on, in the orthogonal complement of its first n."""
    U, s, _ = np.linalg.svd(R[:, :n])
    rank = int(np.sum(s > s[0] * max(R.shape) * np.finfo(float).eps))
    return np.asarray(U[:, rank:].T @ R[:, n:])


def inverse_root(residuals: FloatArray) -> FloatArray | None:
    """W with WᵀW = Λ⁻¹, Λ the covariance of `residuals` (K, m); None where it is zero or not finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        covariance = residuals.T @ residuals / len(residuals)
    floor = np.trace(covariance) / len(covariance) * 1e-12  # outputs that depend on each other
    if not floor > 0 or not np.isfinite(floor):
        return None
    covariance += floor * np.eye(len(covariance))
    if np.linalg.cond(covariance) > DEPENDENT:  # its inverse has no digit left, and may have no root
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))
    return np.linalg.cholesky(np.linalg.inv(covariance)).T
