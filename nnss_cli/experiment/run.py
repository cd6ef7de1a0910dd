"""A run: one dataset, protocol, method, order and seed, and what came of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from nnss_cli.datasets.record import FloatArray, Scaling, about_mean

Status: TypeAlias = Literal["ok", "diverged", "failed", "timeout", "memory", "crashed"]

FORBID = {"extra": "forbid"}  # of what is read from disk (schema.py): an unknown field is a fault


@dataclass(frozen=True)
class RunSpec:
    """Which run. `settings` and `data` decide whether a finished one may be reused."""

    __pydantic_config__ = FORBID

    dataset: str
    """Name of the dataset."""
    protocol: str
    """Split and statistics."""
    method: str
    """Name of the method."""
    order: int
    """Number of states n."""
    seed: int
    """Seed; 0 for deterministic methods."""
    settings: dict[str, Any]
    """Every option of the fit, resolved."""
    data: str
    """Fingerprint of the samples and statistics."""
    version: str = ""
    """Version of the method."""

    @property
    def label(self) -> str:
        """Name of the run's folder."""
        return f"{self.method}-n{self.order}-s{self.seed}"

    @property
    def name(self) -> str:
        """The run's name, as `nnss results` takes it: DATASET/PROTOCOL/METHOD-nORDER-sSEED."""
        return f"{self.dataset}/{self.protocol}/{self.label}"


@dataclass(frozen=True)
class Score:
    """The error of one output in one split."""

    __pydantic_config__ = FORBID

    split: str
    """train, val, or the name of a test set."""
    output: str
    """y1, y2, …"""
    rmse: float
    """Root mean square error, physical units."""
    nrmse: float
    """rmse over the protocol's standard deviation of the output."""
    fit_percent: float
    """100 (1 − ‖y − ŷ‖/‖y − mean(y)‖) over all records of the split, y of each about its own mean, so that
    a model has no credit for telling the levels of experiments apart; 0 for a constant output."""


@dataclass(frozen=True)
class RunResult:
    """What came of a run; a failed one is a result too."""

    __pydantic_config__ = FORBID

    spec: RunSpec
    """Which run."""
    status: Status
    """ok; diverged (numbers left the finite range); failed (the method could not be applied); timeout, memory (it took
    more than it may); crashed (its process ended, twice, or the method has a fault)."""
    reason: str
    """Why the status is not ok, or ""."""
    scores: tuple[Score, ...]
    """By split and output; empty unless ok."""
    epochs: int
    """Epochs run; 0 for methods without."""
    fit_seconds: float
    """Wall time of the fit [s]."""
    provenance: dict[str, str]
    """Versions, platform, time."""
    history: dict[str, list[float]]
    """Values per epoch, by name."""
    channels: dict[str, Any]
    """Names and units, for figures."""
    notes: tuple[str, ...] = ()
    """What a reader of the scores must know about the split."""
    remarks: tuple[str, ...] = ()
    """What the fit has to tell, such as that the start was kept."""
    title: str = ""
    """The dataset's, for the heads of tables and figures."""

    def renamed(self, method: str) -> RunResult:
        """The same result under another method's name."""
        return replace(self, spec=replace(self.spec, method=method))

    def to_json(self) -> dict[str, Any]:
        """As plain data, which `schema.parse_result` reads back."""
        return asdict(self)


def score_outputs(
    split: str, y: Sequence[FloatArray], simulated: Sequence[FloatArray], scaling: Scaling
) -> list[Score]:
    """Errors per output, pooled over the records of a split.

    Args:
        split: name of the split.
        y: measured outputs, one (K, m) a record, physical units.
        simulated: simulated outputs of the same shapes.
        scaling: gives the deviation for nrmse.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.concatenate(simulated) - np.concatenate(y)
        rmse = np.sqrt(np.mean(error**2, axis=0))
        spread = np.sqrt(np.mean(np.concatenate([about_mean(part) for part in y]) ** 2, axis=0))
    return [
        Score(
            split,
            f"y{i + 1}",
            float(rmse[i]),
            float(rmse[i] / scaling.y_std[i]),
            float(100 * (1 - rmse[i] / spread[i])) if spread[i] > 0 else 0.0,
        )
        for i in range(len(rmse))
    ]
