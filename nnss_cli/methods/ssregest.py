"""Regularised ARX, reduced."""

from __future__ import annotations

from dataclasses import dataclass

from nnss_cli.datasets.record import FittingData, Presets
from nnss_cli.errors import unknown
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.linear import LINEAR
from nnss_cli.methods.protocol import Fit, Method, Settings


@dataclass(frozen=True)
class SSREGESTOptions:
    """What SSREGEST can be told."""

    kernel: str = "tc"
    """Prior of the impulse responses: tc, dc or ss."""

    def __post_init__(self) -> None:
        from nnss_cli.baselines.ssregest import KERNELS

        if self.kernel not in KERNELS:
            raise unknown("kernel", self.kernel, KERNELS)


class SSREGEST(Method):
    """Regularised ARX, reduced; see `nnss_cli.baselines.ssregest`."""

    name = "ssregest"
    seeded = False
    position = 70
    options = SSREGESTOptions
    models = LINEAR

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """MATLAB's default kernel."""
        return {"kernel": "tc"}

    def prepare(self, settings: Settings) -> None:
        """Import it."""
        import nnss_cli.baselines.ssregest  # noqa: F401

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Identify a linear model."""
        from nnss_cli.baselines.linear_model import LinearModel
        from nnss_cli.baselines.ssregest import ssregest

        train, _ = data.normalised()
        return Fit(LinearModel.of(ssregest(train, order, settings["kernel"]), data))


METHODS = (SSREGEST(),)
