"""Subspace identification."""

from __future__ import annotations

from dataclasses import dataclass

from nnss_cli.datasets.record import FittingData, Presets
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.linear import LINEAR, Horizon, chosen_horizon, subspace_model
from nnss_cli.methods.protocol import Fit, Method, Settings


@dataclass(frozen=True)
class N4SIDOptions:
    """What N4SID can be told."""

    horizon: Horizon | None = None
    """Horizons: matlab (MATLAB's, default of protocol paper) or auto (those that validate best)."""


class N4SID(Method):
    """Subspace identification; see `nnss_cli.baselines.n4sid`."""

    name = "n4sid"
    seeded = False
    position = 50
    options = N4SIDOptions
    models = LINEAR

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """How the horizons are chosen."""
        return {"horizon": chosen_horizon(data, overrides)}

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """MATLAB's horizons."""
        return {"horizon": "matlab"}

    def prepare(self, settings: Settings) -> None:
        """Import it."""
        import nnss_cli.baselines.n4sid  # noqa: F401

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Identify a linear model."""
        from nnss_cli.baselines.linear_model import LinearModel

        return Fit(LinearModel.of(subspace_model(data, order, settings["horizon"]), data))


METHODS = (N4SID(),)
