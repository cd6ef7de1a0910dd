"""What a linear regression on the past (an ARX model) tells before a model is chosen.

    y(k) = Σ_{i=1}^{p} (Aᵢ y(k−i) + Bᵢ u(k−i)) + c [+ D u(k)] + e(k)

*Does the input show in the output of the same sample?* An F-test of D = 0. Where no input is made from the output, what
of u(k) its past does not tell is independent of all that a system without feedthrough has in y(k), linear or not. Under
feedback u(k) may also follow y(k), so a small p-value is a reason to try a feedthrough, not a proof of one.

*Does the output integrate?* The poles are the roots of det(I − Σ Aᵢ z⁻ⁱ). A real one whose time constant is as
long as the record cannot be told from an integrator. Output noise draws poles inwards, so a short one proves nothing.

Source: T. Söderström and P. Stoica, "System Identification", 1989, ch. 11 (comparison of nested structures).
"""

from __future__ import annotations

import numpy as np
import scipy.special
from nnss_cli.datasets.record import FloatArray, Record

LAGS = 10  # p, where the record is long enough
SAMPLES_A_COEFFICIENT = 3
RANK = 1e-13  # a smooth input's past has singular values down to 1e-10, which count
NEW = 1e-10  # of u(k) beside its past, relative; below it is rounding, as of a sum of a few sines
REAL = 1e-6  # largest imaginary part of a real pole


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
    past, U, Y = _regression(records, p)
    X, U, Y = (signal - signal.mean(axis=0) for signal in (past, U, Y))
    left, sizes, _ = np.linalg.svd(X / np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny), full_matrices=False)
    Q = left[:, sizes > RANK * sizes[0]]
    U_new, Y_new = U - Q @ (Q.T @ U), Y - Q @ (Q.T @ Y)  # what the past does not tell
    U_new = U_new[:, np.linalg.norm(U_new, axis=0) > NEW * np.linalg.norm(U, axis=0)]
    r = U_new.shape[1]
    if r == 0:
        return 1.0
    freedom = len(X) - Q.shape[1] - 1 - r
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
    m, p = records[0].output_count, _lags(records)
    if p == 0:
        return 0.0
    X, U, Y = _regression(records, p)
    X = np.hstack([X, U, np.ones((len(X), 1))])
    scale = np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny)
    coefficients = np.linalg.lstsq(X / scale, Y, rcond=RANK)[0] / scale[:, None]
    lag = m + records[0].input_count
    companion = np.eye(m * p, k=-m)
    companion[:m] = np.hstack([coefficients[i * lag : i * lag + m].T for i in range(p)])
    poles = np.linalg.eigvals(companion)
    real = poles[(np.abs(poles.imag) < REAL) & (poles.real > 0)].real
    if not len(real):
        return 0.0
    return float("inf") if real.max() >= 1 else -1 / float(np.log(real.max()))


def _lags(records: tuple[Record, ...]) -> int:
    """p; 0 where the records are too short for any."""
    r, m = records[0].input_count, records[0].output_count
    for p in range(LAGS, 0, -1):
        coefficients = p * (r + m) + 1 + r
        if sum(max(0, len(record) - p) for record in records) >= SAMPLES_A_COEFFICIENT * coefficients:
            return p
    return 0


def _regression(records: tuple[Record, ...], p: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """[y(k−1) u(k−1) … y(k−p) u(k−p)] (q, p (m + r)), u(k) (q, r) and y(k) (q, m) of all samples with p before them."""
    past, now, y = [], [], []
    for record in records:
        K, both = len(record), np.hstack([record.y, record.u])
        if p < K:
            past.append(np.hstack([both[p - i : K - i] for i in range(1, p + 1)]))
            now.append(record.u[p:])
            y.append(record.y[p:])
    return np.vstack(past), np.vstack(now), np.vstack(y)
