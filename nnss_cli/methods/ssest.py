"""Prediction-error minimisation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from nnss_cli.datasets.record import FittingData, Presets
from nnss_cli.iterative import EpochCallback, waiting_for
from nnss_cli.methods.linear import LINEAR
from nnss_cli.methods.options import chosen_options
from nnss_cli.methods.protocol import Fit, Method, Settings


@dataclass(frozen=True)
class SSESTOptions:
    """What SSEST can be told."""

    feedthrough: Literal["auto", "yes", "no"] | None = None
    """Whether D is estimated: yes, no (default of protocol paper), or auto, where validation decides."""


class SSEST(Method):
    """Prediction-error minimisation; see `nnss_cli.baselines.ssest`."""

    name = "ssest"
    version = "3"
    seeded = False
    position = 60
    options = SSESTOptions
    models = LINEAR

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Without D under protocol paper, which repeats the paper's tables; elsewhere validation decides."""
        default = "no" if data.protocol == "paper" else "auto"
        return {"feedthrough": default} | chosen_options(SSESTOptions, overrides)

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """Without D."""
        return {"feedthrough": "no"}

    def prepare(self, settings: Settings) -> None:
        """Compile its loops, or read them from numba's cache."""
        from nnss_cli.baselines.ssest import warm_up

        warm_up()

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Refine subspace models to convergence."""
        from nnss_cli.baselines.linear_model import LinearModel
        from nnss_cli.baselines.ssest import ssest, ssest_by_validation

        waiting_for("SSEST from several starts")
        train, val = data.normalised()
        if settings["feedthrough"] == "auto":
            model = ssest_by_validation(train, val, order, data.init_window)
        else:
            model = ssest(train, val, order, settings["feedthrough"] == "yes", data.init_window)
        return Fit(LinearModel.of(model, data))


METHODS = (SSEST(),)
