"""Does the input show in the output of the same sample?

    y(k) = Σ_{i=1}^{p} (Aᵢ y(k−i) + Bᵢ u(k−i)) + c [+ D u(k)] + e(k)

An F-test of D = 0 in a linear regression on the past. Where no input is made from the output, what of u(k) its past
does not tell is independent of all that a system without feedthrough has in y(k), linear or not. Under feedback u(k)
may also follow y(k), so a small p-value is a reason to try a feedthrough, not a proof of one.

Source: T. Söderström and P. Stoica, "System Identification", 1989, ch. 11 (comparison of nested structures).
"""

from __future__ import annotations

import numpy as np
import scipy.stats
from nnss_cli.datasets.record import Record

LAGS = 10  # p, where the record is long enough
SAMPLES_A_COEFFICIENT = 3
RANK = 1e-13  # a smooth input's past has singular values down to 1e-10, which count


def feedthrough_p_value(records: tuple[Record, ...]) -> float:
    """The p-value of D = 0, the smallest over the outputs times their number (Bonferroni).

    p is 10, or as many lags as leave three samples a coefficient. 1.0 where that is none.

    Args:
        records: experiments, in any units.
    """
    r, m = records[0].input_count, records[0].output_count
    for p in range(LAGS, 0, -1):
        coefficients = p * (r + m) + 1 + r
        if sum(max(0, len(record) - p) for record in records) >= SAMPLES_A_COEFFICIENT * coefficients:
            break
    else:
        return 1.0
    past, now, y = [], [], []
    for record in records:
        K, both = len(record), np.hstack([record.y, record.u])
        if p < K:
            past.append(np.hstack([both[p - i : K - i] for i in range(1, p + 1)]))
            now.append(record.u[p:])
            y.append(record.y[p:])
    X, U, Y = (signal - signal.mean(axis=0) for signal in map(np.vstack, (past, now, y)))
    left, sizes, _ = np.linalg.svd(X / np.maximum(np.linalg.norm(X, axis=0), np.finfo(float).tiny), full_matrices=False)
    Q = left[:, sizes > RANK * sizes[0]]
    U_new, Y_new = U - Q @ (Q.T @ U), Y - Q @ (Q.T @ Y)  # what the past does not tell
    freedom = len(X) - Q.shape[1] - 1 - r
    e = Y_new - U_new @ np.linalg.lstsq(U_new, Y_new, rcond=1e-8)[0]
    before, after = np.sum(Y_new**2, axis=0), np.sum(e**2, axis=0)
    known = before > np.finfo(float).eps * np.sum(Y**2, axis=0)  # else the past tells y(k) exactly
    if not known.any():
        return 1.0
    F = (before - after)[known] / r / np.maximum(after[known] / freedom, np.finfo(float).tiny)
    return min(1.0, m * float(scipy.stats.f.sf(F, r, freedom).min()))
