"""Prediction-error minimisation."""

from __future__ import annotations

from dataclasses import dataclass

from nnss_cli.datasets.record import FittingData, Presets
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.linear import LINEAR
from nnss_cli.methods.protocol import Fit, Method, Settings


@dataclass(frozen=True)
class SSESTOptions:
    """What SSEST can be told."""

    feedthrough: bool = False
    """Estimate D as well."""


class SSEST(Method):
    """Prediction-error minimisation; see `nnss_cli.baselines.ssest`."""

    name = "ssest"
    seeded = False
    position = 60
    options = SSESTOptions
    models = LINEAR

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """Without D."""
        return {"feedthrough": False}

    def prepare(self, settings: Settings) -> None:
        """Import it."""
        import nnss_cli.baselines.ssest  # noqa: F401

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Refine subspace models to convergence."""
        from nnss_cli.baselines.linear_model import LinearModel
        from nnss_cli.baselines.ssest import ssest

        train, val = data.normalised()
        return Fit(LinearModel.of(ssest(train, val, order, settings["feedthrough"], data.init_window), data))


METHODS = (SSEST(),)
