"""Several seeds of NN-SS as one model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from nnss_cli.datasets.record import FittingData, unscored
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.compiled import free_run
from nnss_cli.methods.nnss import NNSS
from nnss_cli.methods.protocol import Fit, Method, Model, Settings
from nnss_cli.modelfile import Tensors

if TYPE_CHECKING:
    from nnss_cli.model.ensemble import Rule


def _read(description: dict[str, Any], tensors: Tensors) -> Model:
    from nnss_cli.model.ensemble import Ensemble as Combined

    return Combined.from_file(description, tensors)


def better_half(candidates: Sequence[Any], data: FittingData) -> tuple[Any, ...]:
    """The better half of some models by validation, the best first, the middle one included.

    The error is the root mean square over all outputs in units of their deviation, after the init window. Of the
    rules tried (the k whose mean validates best, the best three, half, all), half held up best from one
    half of the validation record to the other.
    """
    w = data.init_window
    begin = unscored(w)
    y = np.concatenate([record.y[begin:] for record in data.val])

    def error(model: Any) -> float:
        simulated = np.concatenate([free_run(model, record.u, record.y[:w]).y[begin:] for record in data.val])
        return float(np.sqrt(np.mean(((simulated - y) / data.scaling.y_std) ** 2)))

    return tuple(sorted(candidates, key=error)[: (len(candidates) + 1) // 2])


class Ensemble(Method):
    """The seeds of NN-SS that validate better as one model: the mean, or clipped mean, of their simulated outputs."""

    seeded = False
    members = "nnss"
    models = {"ensemble": _read}  # noqa: RUF012 - never changed
    one = NNSS("nnss", 10)
    """What trains a member."""

    def __init__(self, name: str, position: int, rule: Rule) -> None:
        """`rule`: how a model of its members puts their outputs together."""
        self.name, self.position, self.rule = name, position, rule

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Those of the members."""
        return self.one.settings(data, order, overrides)

    def current(self, settings: Settings) -> Settings:
        """Those of the members."""
        return self.one.current(settings)

    def prepare(self, settings: Settings) -> None:
        """Import what members need."""
        self.one.prepare(settings)

    def combine(self, members: Sequence[Any], data: FittingData) -> Fit:
        """Choose among models of several seeds, on validation."""
        from nnss_cli.model.ensemble import Ensemble as Combined

        return Fit(Combined(better_half(members, data), self.rule))

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train one member and take it alone; `combine` is for those that are trained already."""
        trained = self.one.fit(data, order, seed, settings, on_epoch)
        return self.combine([trained.model], data) if trained.model else trained


METHODS = (Ensemble("nnss-ensemble", 20, "mean"), Ensemble("nnss-clipped", 25, "clipped"))
