"""A guard for a predictor outside its training range: what it errs by is weighed against persistence as it goes on.

    ŷ_g(k | k − h) = ŷ + v(k) d(k),   d(k) = y(k − h) − ŷ(k | k − h)

v = 0 is the model's prediction, v = 1 is persistence. v(k) is the ridge regression of the errors e = y − ŷ on d, over
what is known at k − h, discounted, and held between 0 and 1:

    v(k) = Σ λ^((k − h − j)/h) e(j) d(j) / (a + Σ λ^((k − h − j)/h) d(j)²),   j ≤ k − h;   v = 0 at first

Each output has its own. a counts as `PRIOR` horizons of validation, where d was of its usual size: a model that is as
good as there keeps v near 0, and one that has lost its way is soon left. λ = 1 − 1/`MEMORY` for each horizon.

Regret, for λ = 1, h = 1 and v not held: with r(k) the error of ŷ_g,

    Σ r(k)² ≤ min over v of (Σ (e(k) − v d(k))² + a v²) + max r² log(1 + Σ d²/a),

so that over a record it is hardly worse than the better of the two, or than any fixed mixture. Proof: Σ r(k)² (1 −
d(k)²/a(k)) with a(k) = a + Σ d² up to k is that minimum exactly. Discounting gives this up for mixtures that change.

Sources: V. Vovk, "Competitive on-line statistics", International Statistical Review 69, 2001; K. Azoury and M. Warmuth,
"Relative loss bounds for on-line density estimation with the exponential family of distributions", Machine Learning 43,
2001; discounted: A. Jacobsen and A. Cutkosky, "Online linear regression in dynamic environments via discounting",
ICML 2024.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nnss_cli.datasets.record import FloatArray

PRIOR = 100.0  # horizons of validation that a counts for; how it was chosen: docs/validation.md
MEMORY = 100.0  # horizons after which what was seen counts for a third


def prior_strength(gaps: Sequence[FloatArray], horizon: int) -> FloatArray:
    """a of each output (m,), from d (K, m) on each validation record."""
    return np.asarray(PRIOR * horizon * np.mean(np.square(np.concatenate(gaps)), axis=0))


def weights(errors: FloatArray, gaps: FloatArray, strength: FloatArray, horizon: int, begin: int) -> FloatArray:
    """v(k) (K, m).

    Args:
        errors: e = y − ŷ (K, m).
        gaps: d (K, m).
        strength: a (m,).
        horizon: steps ahead h.
        begin: first sample that counts, after the init window.
    """
    v, forget = np.zeros_like(errors), (1 - 1 / MEMORY) ** (1 / horizon)
    products, squares = errors * gaps, np.square(gaps)
    S, D = np.zeros_like(strength), np.zeros_like(strength)
    for k in range(begin + horizon, len(errors)):
        S = forget * S + products[k - horizon]
        D = forget * D + squares[k - horizon]
        total = strength + D
        v[k] = np.clip(S / np.where(total > 0, total, 1), 0, 1)
    return v
