"""What a linear regression on the past (an ARX model) tells before a model is chosen.

    y(k) = Σ_{i=1}^{p} (Aᵢ y(k−i) + Bᵢ u(k−i)) + c [+ D u(k)] + e(k)

*Does the input show in the output of the same sample?* An F-test of D = 0. Where no input is made from the output, what
of u(k) its past does not tell is independent of all that a system without feedthrough has in y(k), linear or not. Under
feedback u(k) may also follow y(k), so a small p-value is a reason to try a feedthrough, not a proof of one.

*Does the output integrate?* The poles are the roots of det(I − Σ Aᵢ z⁻ⁱ). A real one whose time constant is as
long as the record cannot be told from an integrator. Output noise draws poles inwards, so a short one proves nothing.

*Where does the output rest under the mean input?* At d = (I − Σ Aᵢ)⁻¹ c, in deviations from the means. A record that
moves around its means has d = 0 but for its ends. One that climbs from rest and ends elsewhere has not, and a linear
model in deviations from the means, without an offset, cannot be the plant then, whatever its order.

Sources: T. Söderström and P. Stoica, "System Identification", 1989, ch. 11 (comparison of nested structures); L. Ljung,
"System Identification", 2nd ed., 1999, ch. 14.1 (offsets in data).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import scipy.special
from nnss_cli.baselines.subspace import BLOCK, triangularise
from nnss_cli.datasets.record import FloatArray, Record, Scaling

LAGS = 10  # p, where the record is long enough
SAMPLES_A_COEFFICIENT = 3
RANK = 1e-13  # a smooth input's past has singular values down to 1e-10, which count
NEW = 1e-10  # of u(k) beside its past, relative; below it is rounding, as of a sum of a few sines
REAL = 1e-6  # largest imaginary part of a real pole
SURE = 3.0  # standard errors beyond which a steady output is not the mean


def feedthrough_p_value(records: tuple[Record, ...]) -> float:
    """The p-value of D = 0, the smallest over the outputs times their number (Bonferroni).

    p is 10, or as many lags as leave three samples a coefficient. 1.0 where that is none, or the past tells u(k).

    Args:
        records: experiments, in any units.
    """
    r, m = records[0].input_count, records[0].output_count
    p = _lags(records)
    if p == 0:
        return 1.0
    q, triangle = _triangle(records, p)
    constant = triangle[:, [-m - 1]]
    triangle = triangle - constant @ (constant.T @ triangle) / q
    X, U, Y = triangle[:, : p * (r + m)], triangle[:, p * (r + m) : -m - 1], triangle[:, -m:]
    left, sizes, _ = np.linalg.svd(X / np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny), full_matrices=False)
    Q = left[:, sizes > RANK * sizes[0]]
    U_new, Y_new = U - Q @ (Q.T @ U), Y - Q @ (Q.T @ Y)  # what the past does not tell
    U_new = U_new[:, np.linalg.norm(U_new, axis=0) > NEW * np.linalg.norm(U, axis=0)]
    r = U_new.shape[1]
    if r == 0:
        return 1.0
    freedom = q - Q.shape[1] - 1 - r
    e = Y_new - U_new @ np.linalg.lstsq(U_new, Y_new, rcond=1e-8)[0]
    before, after = np.sum(Y_new**2, axis=0), np.sum(e**2, axis=0)
    known = before > np.finfo(float).eps * np.sum(Y**2, axis=0)  # else the past tells y(k) exactly
    if not known.any():
        return 1.0
    F = (before - after)[known] / r / np.maximum(after[known] / freedom, np.finfo(float).tiny)
    return min(1.0, m * float(scipy.special.fdtrc(r, freedom, F).min()))


def longest_time_constant(records: tuple[Record, ...]) -> float:
    """−1/ln z of the largest real pole z, in samples; inf for z ≥ 1, 0.0 where there is none above 0.

    Args:
        records: experiments, in any units.
    """
    p = _lags(records)
    return _Fitted(records, p).longest_time_constant() if p else 0.0


def scaling_at_rest(records: tuple[Record, ...]) -> Scaling:
    """Their statistics, but about the outputs at rest under the mean inputs, where they are surely not the means.

    Args:
        records: experiments, in any units.
    """
    scaling = Scaling.of(records)
    return replace(scaling, y_mean=scaling.y_mean + steady_outputs(records))


def steady_outputs(records: tuple[Record, ...]) -> FloatArray:
    """Outputs at rest under the mean inputs, less the mean outputs (m,); 0 for one that is not surely another.

    That is where it is within `SURE` standard errors.

    Args:
        records: experiments, in any units.
    """
    found, deviation = steady_estimate(records)
    return np.where(np.abs(found) > SURE * deviation, found, 0.0)


def steady_estimate(records: tuple[Record, ...]) -> tuple[FloatArray, FloatArray]:
    """d (m,) and its standard errors (m,), of least squares by the delta method: a third too small on short records.

    Those are infinite where the outputs integrate, and where the records are too short for any model.
    """
    m, p = records[0].output_count, _lags(records)
    nothing = np.zeros(m), np.full(m, np.inf)
    if p == 0:
        return nothing
    model = _Fitted(records, p)
    if model.longest_time_constant() >= max(map(len, records)):
        return nothing
    at_rest = np.eye(m) - sum(model.by_outputs)
    try:
        found, through = np.linalg.solve(at_rest, model.constant), np.linalg.inv(at_rest)
    except np.linalg.LinAlgError:
        return nothing
    return found, np.sqrt(np.diag(through @ model.covariance(found) @ through.T))


class _Fitted:
    """The model by least squares, in deviations from the means."""

    def __init__(self, records: tuple[Record, ...], p: int) -> None:
        self.r, self.m, self.p = records[0].input_count, records[0].output_count, p
        q, triangle = _triangle(records, p)
        X, Y = triangle[:, : -self.m], triangle[:, -self.m :]
        self.scale = np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny)  # columns may be of any size
        left, sizes, right = np.linalg.svd(X / self.scale, full_matrices=False)
        seen = sizes > RANK * sizes[0]  # a past that tells nothing new makes them collinear
        self.back = right[seen].T / sizes[seen]
        coefficients = self.back @ (left[:, seen].T @ Y) / self.scale[:, None]
        lag = self.m + self.r
        self.by_outputs = [coefficients[i * lag : i * lag + self.m].T for i in range(p)]
        """A₁ … A_p (m, m)."""
        self.constant = coefficients[-1]
        """c (m,)."""
        errors = Y - X @ coefficients
        self.noise = errors.T @ errors / max(1, q - X.shape[1])
        """Covariance of e (m, m)."""

    def longest_time_constant(self) -> float:
        companion = np.eye(self.m * self.p, k=-self.m)
        companion[: self.m] = np.hstack(self.by_outputs)
        poles = np.linalg.eigvals(companion)
        real = poles[(np.abs(poles.imag) < REAL) & (poles.real > 0)].real
        if not len(real):
            return 0.0
        return float("inf") if real.max() >= 1 else -1 / float(np.log(real.max()))

    def covariance(self, y: FloatArray) -> FloatArray:
        """Of c + Σ Aᵢ y (m, m), for outputs at rest y (m,) under the mean inputs."""
        by_coefficients = np.concatenate(
            [np.tile(np.concatenate([y, np.zeros(self.r)]), self.p), np.zeros(self.r), [1.0]]
        )
        return self.noise * float(np.sum((self.back.T @ (by_coefficients / self.scale)) ** 2))


def _lags(records: tuple[Record, ...]) -> int:
    """p; 0 where the records are too short for any."""
    r, m = records[0].input_count, records[0].output_count
    for p in range(LAGS, 0, -1):
        coefficients = p * (r + m) + 1 + r
        if sum(max(0, len(record) - p) for record in records) >= SAMPLES_A_COEFFICIENT * coefficients:
            return p
    return 0


def _triangle(records: tuple[Record, ...], p: int) -> tuple[int, FloatArray]:
    """How many samples q have p before them, and R of QR = [y(k−1) u(k−1) … y(k−p) u(k−p), u(k), 1, y(k)] of these.

    Sums of squares and products are RᵀR. y and u are in deviations from their means.
    """
    return sum(max(0, len(record) - p) for record in records), triangularise(_rows(records, p))


def _rows(records: tuple[Record, ...], p: int) -> Iterator[FloatArray]:
    """The rows that `_triangle` is of, at most `BLOCK` at a time."""
    y_mean, u_mean = (np.concatenate(z).mean(axis=0) for z in zip(*((a.y, a.u) for a in records), strict=True))
    for record in records:
        for start in range(0, len(record) - p, BLOCK):
            piece = record[start : start + BLOCK + p]
            y, u = piece.y - y_mean, piece.u - u_mean
            both, K = np.hstack([y, u]), len(y)
            yield np.hstack([*(both[p - i : K - i] for i in range(1, p + 1)), u[p:], np.ones((K - p, 1)), y[p:]])
