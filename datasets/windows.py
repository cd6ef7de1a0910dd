"""Sliding windows: the multi-step sequences that a training step sees."""

from __future__ import annotations

import numpy as np
from nnss_cli.datasets.record import FloatArray, Record

from nnss_cli.errors import InputError


def sliding_windows(records: tuple[Record, ...], L: int, stride: int) -> tuple[FloatArray, FloatArray]:
    """Windows of L samples that start every `stride` samples, none across two records.

    Args:
        records: experiments.
        L: window length, samples; 0 for whole records, cut to the shortest.
        stride: distance between starts, samples.

    Returns:
        u (N, L, r) and y (N, L, m), with N = Σ ⌊(K − L)/stride⌋ + 1 over records of K ≥ L samples.

    Raises:
        InputError: no record is as long as a window.
    """
    L = L or min(len(record) for record in records)
    longest = max(len(record) for record in records)
    if longest < L:
        raise InputError(f"window: expected at most the {longest} samples of the training record, found {L}")

    def cut(signals: list[FloatArray]) -> FloatArray:
        views = [np.lib.stride_tricks.sliding_window_view(signal, L, axis=0)[::stride] for signal in signals]
        return np.ascontiguousarray(np.concatenate(views).transpose(0, 2, 1))

    usable = [record for record in records if len(record) >= L]
    return cut([record.u for record in usable]), cut([record.y for record in usable])
