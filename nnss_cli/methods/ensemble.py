"""Several seeds of NN-SS as one model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from nnss_cli.datasets.record import FittingData
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.compiled import free_run
from nnss_cli.methods.nnss import NNSS
from nnss_cli.methods.protocol import Fit, Method, Model, Settings
from nnss_cli.modelfile import Tensors


def _read(description: dict[str, Any], tensors: Tensors) -> Model:
    from nnss_cli.model.ensemble import Ensemble as Mean

    return Mean.from_file(description, tensors)


class Ensemble(Method):
    """The mean of the simulated outputs of the seeds of NN-SS that validate better."""

    name = "nnss-ensemble"
    seeded = False
    position = 20
    members = "nnss"
    models = {"ensemble": _read}  # noqa: RUF012 - never changed
    one = NNSS("nnss", 10)
    """What trains a member."""

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
        from nnss_cli.model.ensemble import Ensemble as Mean

        return Fit(Mean.chosen(members, data, free_run))

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train one member and take it alone; `combine` is for those that are trained already."""
        trained = self.one.fit(data, order, seed, settings, on_epoch)
        return self.combine([trained.model], data) if trained.model else trained


METHODS = (Ensemble(),)
