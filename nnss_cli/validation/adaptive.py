"""Bands whose width follows the coverage that is seen: adaptive conformal inference.

The band is ŷ(k | k − h) ± q e^θ(k) with q from the validation record (`nnss_cli.validation.bands`) and θ = 0 at first.
With err(j) = 1 where y(j) lay outside its band and 0 where it did not,

    θ(k) = max(θ(k − 1) + η(i) (err(i) − α), −B),   i = k − h: the last sample that is known

so that it is wider after a miss, by η (1 − α), and narrower after a hit, by η α. The step falls from 1/h,

    η(i) = max(min(η, 1/h), (1 + i/h)^−0.6/h),

since what a new record begins with may be far from validation, and what it goes on with less so. It is never above 1/h,
since h misses are to come before the first is known. η is chosen on validation.

What is promised, of any record, whatever its errors depend on: of T samples the share of misses is at most

    α + (log⁺(b/q) + 1 − α + B)/(η(T) T),   η(T) ≥ min(η, 1/h)

with b the largest error. Proof: Σ (err − α) ≤ Σ Δθ/η, since Δθ ≥ η (err − α); θ lies between −B and log⁺(b/q)
+ 1 − α, since from log⁺(b/q) on nothing is outside and at most h steps are on their way, of 1/h each at most; and 1/η
grows (summation by parts). That fewer are outside
than α is not excluded: where errors are smaller than e^−B q, the band does not follow. Nothing is promised of an
instant, of a stretch that is short against 1/η and h, or of a kind of situation.

Sources: I. Gibbs and E. Candès, "Adaptive conformal inference under distribution shift", NeurIPS 2021; the width itself
as what is moved: A. Angelopoulos, E. Candès and R. Tibshirani, "Conformal PID control for time series prediction",
NeurIPS 2023; the falling step: A. Angelopoulos, R. Barber and S. Bates, "Online conformal prediction with decaying step
sizes", ICML 2024. The logarithm makes it independent of units and of how far the errors are from those of validation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from nnss_cli.datasets.record import FloatArray
from nnss_cli.validation.bands import Band, calibrate

STEPS = 0.05, 0.1, 0.2, 0.5  # η that validation chooses from
DECAY = 0.6  # 1/2 + ε of the third source, ε = 0.1
NARROWEST = 0.01  # e^−B: of the width that validation gave
RESOLUTION = 1e-9  # of the outputs' deviation on validation: the least q, since a width of 0 cannot grow


@dataclass(frozen=True, eq=False)
class AdaptiveBand:
    """ŷ ± q e^θ(k), θ moved by the coverage seen."""

    start: Band
    """What it starts with: q of each output, from validation."""
    steps: FloatArray
    """η of each output (m,)."""
    horizon: int
    """Steps ahead h of the predictions."""

    def half_widths(self, errors: FloatArray, begin: int) -> FloatArray:
        """q e^θ(k) (K, m); that of k depends on the errors up to k − h.

        Args:
            errors: y − ŷ (K, m).
            begin: first sample that counts: those of the init window tell the initial state.
        """
        h, alpha, least = self.horizon, 1 - self.start.level, math.log(NARROWEST)
        eta = _step(self.steps, np.arange(len(errors))[:, None], h)
        widths = np.empty_like(errors)
        for i, q in enumerate(self.start.half_width.tolist()):
            # Python's numbers: several times quicker than arrays of one for each output
            sizes, steps, theta = np.abs(errors[:, i]).tolist(), eta[:, i].tolist(), 0.0
            width = [q] * min(begin + h, len(errors))
            for known in range(begin, len(errors) - h):
                theta = max(theta + steps[known - begin] * ((sizes[known] > width[known]) - alpha), least)
                width.append(q * math.exp(theta))
            widths[:, i] = width
        return widths

    def bound(self, errors: FloatArray) -> FloatArray:
        """Largest share (m,) of such errors y − ŷ (T, m), of which all count, that may lie outside."""
        T, h, alpha = len(errors), self.horizon, 1 - self.start.level
        growth = np.log(np.maximum(np.abs(errors).max(axis=0) / self.start.half_width, 1))
        last = _step(self.steps, np.array(T - 1), h)
        return np.asarray(alpha + (growth + (1 - alpha) - math.log(NARROWEST)) / (last * T))


def adapt(errors: Sequence[FloatArray], outputs: Sequence[FloatArray], level: float, horizon: int) -> AdaptiveBand:
    """A band from errors on validation, which chooses η of each output, too.

    The η with the least quantile loss of the width along the validation records, each begun anew, is taken; its
    minimiser in expectation is the quantile of the errors' sizes.

    Args:
        errors: y − ŷ of each validation record (K, m), h steps ahead.
        outputs: y of each (K, m), for the scale of what is not 0.
        level: 1 − α, between 0 and 1.
        horizon: steps ahead h.

    Raises:
        InputError: as `nnss_cli.validation.bands.calibrate`.
    """
    start = calibrate(errors, level)
    least = np.maximum(RESOLUTION * np.concatenate(outputs).std(axis=0), np.finfo(float).tiny)
    start = Band(
        level, np.maximum(start.half_width, least), start.blocks, start.length, start.memory, None
    )  # fmt: skip
    losses = []
    for eta in STEPS:
        steps = np.full(len(least), eta)
        band, loss = AdaptiveBand(start, steps, horizon), np.zeros(len(least))
        for part in errors:
            beyond = np.abs(part) - band.half_widths(part, 0)
            loss += np.sum(np.where(beyond > 0, level * beyond, (level - 1) * beyond), axis=0)
        losses.append(loss)
    return AdaptiveBand(start, np.array(STEPS)[np.argmin(losses, axis=0)], horizon)


def _step(eta: FloatArray, known: NDArray[np.integer], horizon: int) -> FloatArray:
    """η(i) of the i-th sample that counts."""
    return np.asarray(np.maximum(np.minimum(eta, 1 / horizon), (1 + known / horizon) ** -DECAY / horizon))
