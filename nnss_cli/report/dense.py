"""Long records on paper: an envelope of least and largest values in the place of a solid band."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FloatArray

BINS = 240
"""Pieces that a record's width is divided into: a few points of ink each, in a column of a page."""
PIXELS = 2000
"""Samples from which a line is thinned; it passes through the extremes of each piece, so nothing is lost to the eye."""
BAND = 0.1  # of the range: what oscillates by more than this within most pieces is a band, not a line


@dataclass(frozen=True)
class Envelope:
    """The least and the largest value in each piece of a record."""

    time: FloatArray
    """Instants (p,)."""
    low: FloatArray
    """(p,)"""
    high: FloatArray
    """(p,)"""


def is_dense(values: FloatArray) -> bool:
    """Whether a signal (K,) goes up and down so often that its line would be a band of ink."""
    if len(values) < 4 * BINS:
        return False
    found = envelope(np.arange(len(values), dtype=float), values)
    span = float(np.max(found.high) - np.min(found.low))
    return bool(np.median(found.high - found.low) > BAND * span)


def envelope(time: FloatArray, values: FloatArray, bins: int = BINS) -> Envelope:
    """Least and largest values over pieces of a record, which differ by one sample in length at most.

    Missing samples are left out, and a piece of nothing else is a gap.

    Args:
        time: instants (K,).
        values: (K,), K at least `bins`.
        bins: pieces.
    """
    edges = np.linspace(0, len(values), bins + 1).astype(int)[:-1]
    return Envelope(time[edges], np.fmin.reduceat(values, edges), np.fmax.reduceat(values, edges))


def thinned(time: FloatArray, values: FloatArray, bins: int = PIXELS // 2) -> tuple[FloatArray, FloatArray]:
    """A line that looks like all of it: each piece's least and largest value, in their order in time, and a gap where
    samples are missing.

    Args:
        time: instants (K,).
        values: (K,).
        bins: pieces; a line of no more than twice as many samples is left as it is.
    """
    if len(values) <= 2 * bins:
        return time, values
    edges = np.linspace(0, len(values), bins + 1).astype(int)
    missing = np.isnan(values)
    low, high = np.where(missing, np.inf, values), np.where(missing, -np.inf, values)
    kept = np.concatenate(
        [
            start + np.unique([np.argmin(low[start:stop]), np.argmax(high[start:stop])])
            for start, stop in itertools.pairwise(edges)
        ]
    )
    gaps = np.flatnonzero(np.diff(missing.astype(int)) == 1) + 1  # one sample of each breaks the line
    kept = np.unique([0, *kept, *gaps, len(values) - 1])
    return time[kept], values[kept]


def rms(time: FloatArray, values: FloatArray, bins: int = BINS // 3) -> tuple[FloatArray, FloatArray]:
    """Root mean squares over pieces of a record (bins,), each at its first instant.

    Args:
        time: instants (K,).
        values: (K,), K at least `bins`.
        bins: pieces.
    """
    edges = np.linspace(0, len(values), bins + 1).astype(int)
    return time[edges[:-1]], np.sqrt(np.add.reduceat(values**2, edges[:-1]) / np.diff(edges))
