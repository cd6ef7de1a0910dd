"""Samples of a record that others hold, too: what a model is tested on may have had a part in its making."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from nnss_cli.datasets.record import Record

STRETCH = 20
"""Samples in a row that must be equal."""
FACTOR = np.uint64(0x9E3779B97F4A7C15)  # odd; of the hashes


def samples_in(record: Record, others: Sequence[Record]) -> NDArray[np.bool_]:
    """Which samples (K,) of a record lie in a stretch that another one has, too: all inputs and outputs, bit by bit.

    A stretch has `STRETCH` samples, or is the whole of the shorter record, and at least half of its samples differ from
    those before them: two experiments may well rest at the same values. Samples are compared by hashes of 64 bits.
    """
    own, held = _hashes(record), np.zeros(len(record), dtype=bool)
    moves = np.cumsum(np.concatenate([[False], own[1:] != own[:-1]]))
    for other in others:
        w = min(STRETCH, len(record), len(other))
        moving = 2 * (moves[w - 1 :] - moves[: len(own) - w + 1]) >= w - 1
        for begin in np.flatnonzero(np.isin(_rolled(own, w), _rolled(_hashes(other), w)) & moving):
            held[begin : begin + w] = True
    return held


def _hashes(record: Record) -> NDArray[np.uint64]:
    """A number for each sample."""
    samples = np.concatenate([record.u, record.y], axis=1) + 0.0  # −0 is 0
    found = np.zeros(len(samples), dtype=np.uint64)
    for bits in np.ascontiguousarray(samples.T).view(np.uint64):
        found = (found ^ bits ^ (bits >> np.uint64(29))) * FACTOR
        found ^= found >> np.uint64(32)
    return found


def _rolled(hashes: NDArray[np.uint64], w: int) -> NDArray[np.uint64]:
    """A number for each stretch of w samples."""
    found = np.zeros(len(hashes) - w + 1, dtype=np.uint64)
    for j in range(w):
        found = found * FACTOR + hashes[j : j + len(found)]
    return found
