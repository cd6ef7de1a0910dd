"""Prediction bands by split conformal prediction, blocks of samples at a time.

Errors of neighbouring samples are alike, so single samples are not exchangeable; blocks longer than the errors'
memory nearly are. The validation record is cut into n blocks of b samples. For a band ŷ ± q s(k), the share of a
block's samples outside it is a loss that falls with q, so that the smallest q with

    n/(n + 1) · (mean share outside over the n blocks) + 1/(n + 1) ≤ α

leaves an expected share of at most α outside in a further block that is exchangeable with these: one of the same plant
under inputs of the same kind, and of a model that was not chosen to fit the validation record. It holds on average over
records and blocks, not at each instant, and for each output by itself.

s(k) is 1, or the spread of an ensemble's members with a floor: the band is then wide where they disagree.

Sources: A. Angelopoulos, S. Bates, A. Fisch, L. Lei and T. Schuster, "Conformal risk control", ICLR 2024; blocks:
V. Chernozhukov, K. Wüthrich and Y. Zhu, "Exact and robust conformal inference methods for predictive machine learning
with dependent data", COLT 2018.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.errors import InputError
from nnss_cli.validation.residuals import autocovariance

FLOOR = 0.1  # of an ensemble's mean spread: the members' agreement by chance is no certainty
REACH = 200  # lags of the memory, at most


@dataclass(frozen=True, eq=False)
class Band:
    """ŷ ± half_width s(k)."""

    level: float
    """Share of samples 1 − α that the band is to hold."""
    half_width: FloatArray
    """q of each output (m,), in physical units, or in spreads."""
    blocks: tuple[int, ...]
    """Number of blocks n of each output."""
    length: tuple[int, ...]
    """Samples b of a block, of each output."""
    memory: tuple[int, ...]
    """Samples that the errors of each output remember: where blocks had to be shorter, they are not exchangeable."""
    floor: FloatArray | None
    """Smallest spread (m,), where the band follows an ensemble's; None where s(k) = 1."""

    def assured(self, output: int) -> bool:
        """Whether the blocks of an output are long enough for what the band promises."""
        return self.length[output] >= self.memory[output]

    def limits(self, predicted: FloatArray, spread: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """Lower and upper limit (K, m).

        Args:
            predicted: ŷ (K, m).
            spread: deviation of the members (K, m), where the band follows it.
        """
        scale = self.half_width if self.floor is None or spread is None else self.half_width * (spread + self.floor)
        return predicted - scale, predicted + scale


def calibrate(errors: Sequence[FloatArray], level: float, spreads: Sequence[FloatArray] | None = None) -> Band:
    """A band from errors on validation.

    Args:
        errors: y − ŷ of each validation record (K, m).
        level: 1 − α, between 0 and 1.
        spreads: deviation of an ensemble's members (K, m) of each record, where the band is to follow it.

    Raises:
        InputError: the level is not between 0 and 1, or there are too few samples for it.
    """
    if not 0 < level < 1:
        raise InputError(f"interval: expected a share between 0 and 1, such as 0.9, found {level:g}")
    needed = math.ceil(level / (1 - level) - 1e-6)  # with fewer blocks no width is enough
    samples = sum(map(len, errors))
    if samples < needed:
        raise InputError(
            f"interval: {level:g} needs at least {needed} validation samples, found {samples}: ask for less, or give a "
            "longer record"
        )
    floor = None if spreads is None else FLOOR * np.concatenate(spreads).mean(axis=0)
    if floor is not None and spreads is not None:
        floor = np.maximum(floor, np.finfo(float).tiny)
        errors = [part / (spread + floor) for part, spread in zip(errors, spreads, strict=True)]
    found = [_half_width([np.abs(part[:, i]) for part in errors], level, needed) for i in range(errors[0].shape[1])]
    widths, counts, lengths, memories = zip(*found, strict=True)
    return Band(level, np.array(widths), counts, lengths, memories, floor)


def memory(parts: Sequence[FloatArray]) -> int:
    """Integrated autocorrelation time 1 + 2 Σ r(l) of a signal, up to the first r(l) ≤ 0, in samples, at least 1."""
    reach = min(REACH, max(map(len, parts)) - 1)
    R = autocovariance(parts, reach)
    if not R[0] > 0:
        return 1
    r = R[1:] / R[0]
    ends = np.flatnonzero(r <= 0)
    return max(1, math.ceil(1 + 2 * float(np.sum(r[: ends[0] if len(ends) else len(r)])) - 1e-9))


def _half_width(scores: Sequence[FloatArray], level: float, needed: int) -> tuple[float, int, int, int]:
    """q of one output, the number of blocks, their length and the scores' memory.

    Blocks are as long as the memory. Where there would be too few, no finite q is assured: q is the largest error then,
    those beyond whole blocks among them.
    """
    samples, remembered = sum(map(len, scores)), memory(scores)
    length = max(1, min(remembered, samples // needed))
    while True:  # what is left of a record beyond whole blocks may cost one that is needed
        blocks = np.concatenate([part[: len(part) // length * length].reshape(-1, length) for part in scores])
        if len(blocks) >= needed or length == 1:
            break
        length -= 1
    n = len(blocks)
    if length < remembered:
        return float(np.concatenate(scores).max()), n, length, remembered
    allowed = ((1 - level) * (n + 1) - 1) / n  # mean share outside
    ordered = np.sort(blocks.ravel())
    outside = math.floor(allowed * len(ordered) + 1e-9)
    return float(ordered[len(ordered) - 1 - outside]), n, length, remembered
