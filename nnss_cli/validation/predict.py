"""A file predicted k steps ahead, with its errors by horizon."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.validation.limits import Limits
from nnss_cli.validation.predictor import StepTable, step_table
from nnss_cli.validation.trained import Forecaster

HORIZONS = 1, 2, 5, 10, 20, 50


@dataclass(frozen=True, eq=False)
class Predicted:
    """What became of a record."""

    horizon: int
    """Steps ahead."""
    y: FloatArray
    """ŷ(k | k − h) (K, m), physical units."""
    limits: Limits | None
    """The band, where one was asked for."""
    steps: StepTable
    """Errors at the horizons up to this one, with and without guard."""
    weight: FloatArray | None
    """Weight v(k) of persistence (K, m) in the prediction; None without guard."""

    def seconds(self, Ts: float) -> FloatArray:
        """The instants (K,) [s], from 0."""
        return np.arange(len(self.y)) * Ts


def predict_record(
    found: Forecaster, record: Record, horizon: int, level: float | None = None, scale: str = "residuals"
) -> Predicted:
    """Predict a record `horizon` steps ahead.

    Args:
        found: the predictor, guarded or not.
        record: with complete outputs, physical units.
        horizon: steps ahead, at least 1.
        level: share of samples that a band is to hold; None for no band.
        scale: of the band: residuals, ensemble or adaptive.

    Raises:
        InputError: the horizon is out of range, or the band cannot be had.
    """
    if len(record) < found.trained.init_window + 2:
        raise InputError(
            f"{len(record)} samples are too few to predict: expected {found.trained.init_window + 2} or more, two "
            "beyond those that tell the initial state"
        )
    if not 1 <= horizon < len(record):
        raise InputError(
            f"--horizon: expected 1 to {len(record) - 1} steps ahead, fewer than the file's {len(record)} samples, "
            f"found {horizon}"
        )
    limits = None if level is None else found.limits(record, horizon, level, scale)
    horizons = sorted({h for h in HORIZONS if h < horizon} | {horizon})
    guard = found.guard(horizons)
    steps = step_table(found.predictor, (record,), horizons, found.trained.init_window, guard)
    predicted, weight = found.predictor.predict(record.u, record.y, horizon, found.trained.init_window), None
    if found.guarded:
        predicted, weight = guard.applied(horizon, predicted, record.y)
    return Predicted(horizon, predicted, limits, steps, weight)
