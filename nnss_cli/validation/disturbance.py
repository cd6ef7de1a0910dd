"""What outputs do beside a model's own: a linear model of the difference, which a predictor's gain lets follow them.

    w(k+1) = A w(k) + B [u(k); h(k)],   y(k) = C w(k) + D [u(k); h(k)],   h the model's own output

Two kinds are known here. A *constant* of each output, y(k) = h(k) + d(k), d(k+1) = d(k): for where a model is off by
an amount that hardly varies. And *increments*:

    Δy(k) = S Δh(k) + Σ_{i=1}^{L} Aᵢ Δy(k−i) + Σ_{i=0}^{L} Bᵢ Δu(k−i) + e(k),   Δs(k) = s(k) − s(k−1)

by least squares on the training records, h being simulated there. S = I and no more is the model with a constant,
S = 0 an ARX model of increments: for where levels are not to be trusted at all, only how inputs and outputs move.

Sources: K. R. Muske and T. A. Badgwell, "Disturbance modeling for offset-free linear model predictive control",
J. Process Control 12, 2002; for a model of what a model leaves, L. Ljung, "Model validation and model error modeling",
Linköping, 1999, and for increments, G. Box and G. Jenkins, "Time series analysis", 1976.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FloatArray

SAMPLES_A_COEFFICIENT = 3
RANK = 1e-10  # relative singular value below which the regression sees nothing


@dataclass(frozen=True, eq=False)
class Disturbance:
    """w(k+1) = A w + B [u; h],  y = C w + D [u; h], in normalised units."""

    A: FloatArray
    """(q, q)."""
    B: FloatArray
    """(q, r + m)."""
    C: FloatArray
    """(m, q)."""
    D: FloatArray
    """(m, r + m)."""
    begin: FloatArray
    """w(0) = begin [y(0); u(0); h(0)], (q, m + r + m)."""

    @property
    def size(self) -> int:
        """Length q of w."""
        return len(self.A)

    @property
    def inputs(self) -> int:
        """Number of inputs r."""
        return self.B.shape[1] - len(self.C)


def constant(inputs: int, outputs: int) -> Disturbance:
    """y(k) = h(k) + d(k), d(k+1) = d(k), d(0) = 0."""
    r, m = inputs, outputs
    one, none = np.eye(m), np.zeros((m, r + m))
    return Disturbance(one, none, one, np.concatenate([np.zeros((m, r)), one], axis=1), np.zeros((m, m + r + m)))


@dataclass(frozen=True, eq=False)
class Increments:
    """Coefficients of a regression of increments, in normalised units."""

    S: FloatArray
    """Of the model's own (m, m)."""
    past: FloatArray
    """A₁ … A_L of the outputs' (L, m, m)."""
    driven: FloatArray
    """B₀ … B_L of the inputs' (L + 1, m, r)."""

    @classmethod
    def fitted(
        cls, u: Sequence[FloatArray], y: Sequence[FloatArray], h: Sequence[FloatArray], lags: int, alone: bool = False
    ) -> Increments | None:
        """By least squares; None where there are fewer than three samples a coefficient.

        Args:
            u: inputs of each record (K, r), normalised.
            y: measured outputs (K, m).
            h: the model's own outputs (K, m).
            lags: L.
            alone: without the model's own increments, S = 0.
        """
        r, m = u[0].shape[1], y[0].shape[1]
        rows, targets = [], []
        for parts in zip(u, y, h, strict=True):
            du, dy, dh = (np.diff(part, axis=0) for part in parts)
            K = len(dy)
            before = [signal[lags - i : K - i] for i in range(1, lags + 1) for signal in (dy, du)]
            rows.append(np.concatenate([np.zeros_like(dh[lags:]) if alone else dh[lags:], du[lags:], *before], axis=1))
            targets.append(dy[lags:])
        X, Y = np.concatenate(rows), np.concatenate(targets)
        if len(X) < SAMPLES_A_COEFFICIENT * (X.shape[1] - m * alone) or not np.isfinite(X).all():
            return None
        scale = np.linalg.norm(X, axis=0)
        scale[scale == 0] = 1
        theta = (np.linalg.lstsq(X / scale, Y, rcond=RANK)[0] / scale[:, None]).T
        of_lags = theta[:, m + r :].reshape(m, lags, m + r).transpose(1, 0, 2)
        driven = np.concatenate([theta[None, :, m : m + r], of_lags[:, :, m:]])
        return cls(theta[:, :m], of_lags[:, :, :m], driven)

    def disturbance(self) -> tuple[Disturbance, FloatArray]:
        """As a state-space model, and the gain (q, m) that puts what was measured in the place of what was predicted.

        w = [y(k−1); h(k−1); u(k−1); Δy(k−1) … Δy(k−L); Δu(k−1) … Δu(k−L)].
        """
        L, m, r = len(self.past), len(self.S), self.driven.shape[2]
        own = 2 * m + r
        q = own + L * (m + r)
        y, h, u = slice(0, m), slice(m, 2 * m), slice(2 * m, own)
        C, D = np.zeros((m, q)), np.concatenate([self.driven[0], self.S], axis=1)
        C[:, y], C[:, h], C[:, u] = np.eye(m), -self.S, -self.driven[0]
        C[:, own : own + L * m] = self.past.transpose(1, 0, 2).reshape(m, L * m)
        C[:, own + L * m :] = self.driven[1:].transpose(1, 0, 2).reshape(m, L * r)
        A, B, K = np.zeros((q, q)), np.zeros((q, r + m)), np.zeros((q, m))
        A[y], B[y], K[y] = C, D, np.eye(m)  # y(k): as predicted, until it is measured
        B[h, r:], B[u, :r] = np.eye(m), np.eye(r)
        begin = np.zeros((q, m + r + m))
        begin[y, :m], begin[u, m : m + r], begin[h, m + r :] = np.eye(m), np.eye(r), np.eye(m)
        if L > 0:
            dy, du = slice(own, own + m), slice(own + L * m, own + L * m + r)
            A[dy], B[dy], K[dy] = C, D, np.eye(m)
            A[dy, y] -= np.eye(m)
            B[du, :r], A[du, u] = np.eye(r), -np.eye(r)
            for first, width in ((own, m), (own + L * m, r)):
                later = slice(first + width, first + L * width)
                A[later, first : first + (L - 1) * width] = np.eye((L - 1) * width)
        return Disturbance(A, B, C, D, begin), K
