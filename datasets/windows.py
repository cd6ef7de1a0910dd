"""Windows: the multi-step sequences that a training step sees, and those of one length side by side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from nnss_cli.datasets.record import FloatArray, Record
from numpy.typing import NDArray

from nnss_cli.errors import InputError

SHORTEST = 3  # samples of a window: the first may only schedule, and the consistency term begins at its second


def check_window(records: tuple[Record, ...], L: int, method: str = "") -> None:
    """Refuse windows that some training record cannot fill: its samples would not be trained on.

    Args:
        records: training experiments.
        L: window length, samples; 0 for whole records.
        method: that trains on them, to be named.

    Raises:
        InputError: a record is shorter than L or than `SHORTEST`.
    """
    index = min(range(len(records)), key=lambda i: len(records[i]))
    K, name = len(records[index]), f"training record {index + 1} of {len(records)}"
    if K < SHORTEST:
        raise InputError(f"{name}: expected at least {SHORTEST} samples, found {K}; leave it out")
    if K < L:
        alone = f" for all methods, --set {method}.window={K} for it alone" if method else ""
        raise InputError(
            f"{method}{': ' * bool(method)}window: expected at most the {K} samples of {name}, found {L}; "
            f"use --window {K} or less{alone}, or 0 for whole records"
        )


def chosen_window(records: tuple[Record, ...], usual: int, asked: int | None, method: str) -> int:
    """The window length that is asked for; else the usual one, or the shortest record where that has fewer samples.

    Args:
        records: training experiments.
        usual: samples; 0 for whole records.
        asked: likewise; None where nothing is asked for.
        method: that trains on them, to be named.

    Raises:
        InputError: see `check_window`.
    """
    L = min(usual, max(SHORTEST, min(map(len, records)))) if asked is None else asked
    check_window(records, L, method)
    return L


def shortened(records: tuple[Record, ...], L: int, usual: int) -> tuple[str, ...]:
    """The remark on a fit whose windows are the shortest record, where the usual ones are longer."""
    short = L == min(map(len, records)) < usual
    return (f"windows of {L} samples, the shortest training record, where {usual} are usual",) if short else ()


def beginnings(records: tuple[Record, ...], length: int, shortest: int) -> tuple[Record, ...]:
    """What experiments begin with: `length` samples of all together, by their lengths, rounded up.

    Args:
        records: experiments, of more samples than that.
        length: samples.
        shortest: samples of each, at least, where it has as many.
    """
    total = sum(len(record) for record in records)
    return tuple(record[: max(shortest, math.ceil(len(record) * length / total))] for record in records)


def sliding_windows(records: tuple[Record, ...], L: int, stride: int) -> tuple[list[FloatArray], list[FloatArray]]:
    """Windows of L samples that start every `stride` samples, none across two records; or each record as it is.

    Args:
        records: experiments.
        L: window length, samples; 0 for whole records, each of its own length.
        stride: distance between starts, samples; without meaning for whole records.

    Returns:
        u (L, r) and y (L, m) of each of Σ ⌊(K − L)/stride⌋ + 1 windows (one a record for L = 0), as views.

    Raises:
        InputError: see `check_window`.
    """
    check_window(records, L)
    u: list[FloatArray] = []
    y: list[FloatArray] = []
    for record in records:
        length = L or len(record)
        for start in range(0, len(record) - length + 1, stride):
            u.append(record.u[start : start + length])
            y.append(record.y[start : start + length])
    return u, y


@dataclass(frozen=True, eq=False)
class Batch:
    """Windows of one length, to be run side by side."""

    u: FloatArray
    """Inputs (L, r, b)."""
    y: FloatArray
    """Outputs (L, m, b)."""
    share: float
    """Its samples over those of all windows it was chosen with: what its mean error counts."""


class Windows:
    """Windows of any lengths, stored by length: sample, channel, window, so that a mini-batch gathers the last axis."""

    def __init__(
        self, u: Sequence[FloatArray], y: Sequence[FloatArray], dtype: Any = np.float64, unscored: int = 0
    ) -> None:
        """Copy the windows u (L, r), y (L, m), one of each a window.

        Args:
            u: inputs.
            y: outputs.
            dtype: of the copies.
            unscored: first samples of each window that enter no error.
        """
        self.lengths = np.array([len(window) for window in y])
        self.unscored = unscored
        self.group = np.empty(len(y), np.int64)  # of each window: which length it has
        self.column = np.empty(len(y), np.int64)  # of each window: its place among those of its length
        self.u: list[FloatArray] = []
        self.y: list[FloatArray] = []
        for index, L in enumerate(dict.fromkeys(self.lengths)):
            own = np.flatnonzero(self.lengths == L)
            self.group[own], self.column[own] = index, np.arange(len(own))
            for stored, windows in ((self.u, u), (self.y, y)):
                stacked = np.array([windows[int(i)] for i in own], dtype)
                stored.append(np.ascontiguousarray(stacked.transpose(1, 2, 0)))

    def __len__(self) -> int:
        return len(self.lengths)

    def window(self, index: int) -> tuple[FloatArray, FloatArray]:
        """u (L, r) and y (L, m) of one window, contiguous."""
        group, column = self.group[index], self.column[index]
        u, y = (np.ascontiguousarray(stored[group][:, :, column]) for stored in (self.u, self.y))
        return u, y

    def batches(self, chosen: NDArray[np.int64]) -> list[Batch]:
        """The windows of these indices, one batch a length; the shares add up to 1."""
        scored = self.lengths[chosen] - self.unscored
        groups, total = self.group[chosen], scored.sum()
        found = []
        for group in np.unique(groups):
            own = groups == group
            columns = self.column[chosen[own]]
            u, y = (np.take(stored[group], columns, axis=2) for stored in (self.u, self.y))
            found.append(Batch(u, y, float(scored[own].sum() / total)))
        return found
