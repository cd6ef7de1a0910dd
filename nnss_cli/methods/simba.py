"""A stable linear model trained by gradient."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any

from nnss_cli.datasets.record import FittingData, Presets
from nnss_cli.datasets.windows import chosen_window, shortened
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.linear import LINEAR, Horizon, chosen_horizon, subspace_model
from nnss_cli.methods.options import chosen_options
from nnss_cli.methods.protocol import Fit, Method, Settings

if TYPE_CHECKING:
    from nnss_cli.baselines.simba import SimbaOptions


@cache
def _options() -> type[SimbaOptions]:
    """SIMBa's own options and the start's; made at need, since SIMBa brings its compiler along."""
    from nnss_cli.baselines.simba import SimbaOptions

    @dataclass(frozen=True)
    class SIMBaOptions(SimbaOptions):
        """What SIMBa can be told."""

        horizon: Horizon | None = None
        """Horizons of N4SID where it starts there: matlab (default of protocol paper) or auto."""

    SIMBaOptions.__annotations__["horizon"] = Horizon | None  # the name is out of reach of a class in a function
    return SIMBaOptions


class SIMBa(Method):
    """A stable linear model trained by gradient; see `nnss_cli.baselines.simba`."""

    name = "simba"
    seeded = True
    position = 40
    models = LINEAR

    @property
    def options(self) -> type[Any]:
        """SIMBa's own, and the horizons of N4SID where it starts there."""
        return _options()

    def training(self, presets: Presets, order: int, overrides: Settings) -> SimbaOptions:
        """The windows and steps of the paper's recipe, with the user's changes, and the start."""
        from nnss_cli.baselines.simba import SimbaOptions
        from nnss_cli.training.recipe import recipe_of

        recipe = asdict(recipe_of("paper", presets, order))
        del recipe["patience_unit"]  # of NN-SS: what SIMBa's patience counts is its own
        own = {f.name for f in fields(SimbaOptions)}
        changed = recipe | chosen_options(SimbaOptions, overrides)
        return SimbaOptions(**{name: value for name, value in changed.items() if name in own})

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Its options, and the horizons of N4SID where it starts there."""
        options = self.training(data.presets, order, overrides)
        asked = chosen_options(self.options, overrides).get("window")
        window = chosen_window(data.train, options.window, asked, self.name)
        return asdict(options) | {"window": window, "horizon": chosen_horizon(data, overrides)}

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """The paper's windows, from N4SID with MATLAB's horizons."""
        return asdict(self.training(presets, order, {})) | {"horizon": "matlab"}

    def prepare(self, settings: Settings) -> None:
        """Compile its gradient, or read it from numba's cache."""
        from nnss_cli.baselines.simba import warm_up

        warm_up()

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train a linear model."""
        from nnss_cli.baselines.linear_model import LinearModel
        from nnss_cli.baselines.simba import SimbaOptions, train_simba

        options = SimbaOptions(**{name: value for name, value in settings.items() if name != "horizon"})
        start = subspace_model(data, order, settings["horizon"]) if options.start == "n4sid" else None
        training = train_simba(*data.normalised(), order, seed, options, start, on_epoch, data.init_window)
        model = None if training.diverged else LinearModel.of(training.system, data)
        remarks = shortened(data.train, options.window, self.training(data.presets, order, {}).window)
        return Fit(model, training.epochs, training.diverged, training.history, remarks, training.best_epoch)


METHODS = (SIMBa(),)
