"""The registry: every method that `compare` knows, behind one protocol.

To add one, write a class like `N4SID` below and put an instance into `METHODS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from nnss_cli.datasets.record import Channels, FittingData, FloatArray, Presets, Simulation
from nnss_cli.datasets.windows import check_window
from nnss_cli.errors import InputError, unknown
from nnss_cli.iterative import EpochCallback

if TYPE_CHECKING:
    from nnss_cli.baselines.simba import SimbaOptions
    from nnss_cli.baselines.statespace import LinearStateSpace

Settings = dict[str, Any]


class Model(Protocol):
    """A fitted model: physical units in and out."""

    @property
    def channels(self) -> Channels:
        """Names and units."""
        ...

    @property
    def Ts(self) -> float:
        """Sampling time [s]."""
        ...

    def simulate(self, u: FloatArray, y_init: FloatArray) -> Simulation:
        """Free simulation of inputs (K, r) from the x(0) that explains the first w ≥ 1 output samples (w, m) best."""
        ...

    def save(self, folder: Path) -> None:
        """Write the model into `folder`; `load_model` reads it."""
        ...


@dataclass(frozen=True)
class Fit:
    """What fitting gave: a model, or the reason why there is none."""

    model: Model | None
    """The fitted model; None when the fit failed."""
    epochs: int = 0
    """Epochs that were run; 0 for methods that have none."""
    diverged: str = ""
    """Why an iterative method was given up, or ""."""
    history: dict[str, list[float]] = field(default_factory=dict)
    """Values per epoch, by name."""
    remarks: tuple[str, ...] = ()
    """What a reader of the result must know of how it came about, such as a start that was refused."""
    best_epoch: int = 0
    """Epoch of the model kept, from 1; 0 for methods that have none, and where the start was kept."""


class Method(Protocol):
    """A way to get a model of a given order from data."""

    name: str
    """Name on the command line and in tables."""
    seeded: bool
    """Whether the result depends on the seed; others run once, as seed 0."""
    version: str = "1"
    """To be raised whenever the same settings give other numbers: runs of different versions are not mixed."""
    members: str = ""
    """Name of the method whose runs it combines; "" for one that fits by itself."""

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Every option of a fit, resolved: it is kept with the run and decides whether one can be reused.

        Raises:
            InputError: an override that this method has is out of range. Others are ignored.
        """
        ...

    def paper_settings(self, presets: Presets, order: int) -> Settings | None:
        """The settings with which the paper uses this method; None where it does not."""
        return None

    def prepare(self, settings: Settings) -> None:
        """Do once what is no part of a fit's time: compile, import."""
        ...

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Fit a model. `data` holds no test record."""
        ...

    def combine(self, members: Sequence[Any], data: FittingData) -> Fit:
        """One model of the models of several seeds, at least one; only asked of a method with `members`."""
        del members, data
        raise NotImplementedError(f"{self.name} combines no runs")


class NNSS(Method):
    """The paper's method: `nnss_cli.model` trained by `nnss_cli.training`, with one of its recipes."""

    seeded = True

    def __init__(self, name: str, recipe: str | None = None) -> None:
        """`recipe` fixes it; without, it is the user's choice and `best` by default."""
        self.name = name
        self.recipe = recipe

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """The recipe for the dataset and order, with the user's changes."""
        from nnss_cli.training.recipe import Recipe, recipe_of

        own = {f.name for f in fields(Recipe)}
        changes = {name: value for name, value in overrides.items() if name in own}
        name = self.recipe or str(overrides.get("recipe", "best"))
        known = recipe_of(name, data.presets, order, data.output_count)
        recipe = known.replace(**changes)
        recipe.architecture(order, data.input_count, data.output_count)
        check_window(data.train, recipe.window)
        # the label is the recipe's only where every field is; engines compute the same
        changed = [f for f in own if f != "engine" and getattr(recipe, f) != getattr(known, f)]
        return asdict(recipe) | {"recipe": f"{name}, changed: {', '.join(sorted(changed))}" if changed else name}

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """The paper's recipe."""
        from nnss_cli.training.recipe import recipe_of

        return asdict(recipe_of("paper", presets, order)) | {"recipe": "paper"}

    def prepare(self, settings: Settings) -> None:
        """Compile the fast engine, or read it from numba's cache."""
        if settings["engine"] == "fast":
            from nnss_cli.training.fast import warm_up

            warm_up(
                settings["dtype"],
                settings["stability"],
                settings["optimiser"] == "gauss-newton" or settings["refine"] > 0,
            )

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train an NN-SS model."""
        from nnss_cli.training.fit import train_nnss
        from nnss_cli.training.recipe import Recipe

        recipe = Recipe(**{name: value for name, value in settings.items() if name != "recipe"})
        training = train_nnss(data, order, seed, recipe, on_epoch)
        return Fit(
            None if training.diverged else training.model,
            epochs=training.epochs,
            best_epoch=training.best_epoch,
            diverged=training.diverged,
            history={"train_loss": training.train_loss, "val_rmse": training.val_rmse},
            remarks=training.remarks,
        )


HORIZONS = ("matlab", "auto")


def chosen_horizon(data: FittingData, overrides: Settings) -> str:
    """matlab under protocol paper, which repeats the paper's tables; auto elsewhere; or what the user says."""
    name = str(overrides.get("horizon", "matlab" if data.protocol == "paper" else "auto"))
    if name not in HORIZONS:
        raise unknown("horizon", name, HORIZONS)
    return name


def subspace_model(data: FittingData, order: int, horizon: str) -> LinearStateSpace:
    """N4SID in normalised units, with MATLAB's horizons or those that validate best."""
    from nnss_cli.baselines.n4sid import n4sid, n4sid_auto

    train, val = data.normalised()
    return n4sid(train, order) if horizon == "matlab" else n4sid_auto(train, val, order, data.init_window)[0]


class N4SID(Method):
    """Subspace identification; see `nnss_cli.baselines.n4sid`."""

    name = "n4sid"
    seeded = False

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


class SSEST(Method):
    """Prediction-error minimisation; see `nnss_cli.baselines.ssest`."""

    name = "ssest"
    seeded = False

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Whether D is estimated."""
        return {"feedthrough": bool(overrides.get("feedthrough", False))}

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


class SSREGEST(Method):
    """Regularised ARX, reduced; see `nnss_cli.baselines.ssregest`."""

    name = "ssregest"
    seeded = False

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """The kernel."""
        from nnss_cli.baselines.ssregest import KERNELS

        kernel = str(overrides.get("kernel", "tc"))
        if kernel not in KERNELS:
            raise unknown("kernel", kernel, KERNELS)
        return {"kernel": kernel}

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


class SIMBa(Method):
    """A stable linear model trained by gradient; see `nnss_cli.baselines.simba`."""

    name = "simba"
    seeded = True

    def options(self, presets: Presets, order: int, overrides: Settings) -> SimbaOptions:
        """The windows and steps of the paper's recipe, with the user's changes, and the start."""
        from nnss_cli.baselines.simba import SimbaOptions
        from nnss_cli.training.recipe import recipe_of

        recipe = asdict(recipe_of("paper", presets, order))
        del recipe["patience_unit"]  # of NN-SS: what SIMBa's patience counts is its own
        own = {f.name for f in fields(SimbaOptions)}
        return SimbaOptions(**{name: value for name, value in (recipe | overrides).items() if name in own})

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Its options, and the horizons of N4SID where it starts there."""
        options = self.options(data.presets, order, overrides)
        check_window(data.train, options.window)
        return asdict(options) | {"horizon": chosen_horizon(data, overrides)}

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """The paper's windows, from N4SID with MATLAB's horizons."""
        return asdict(self.options(presets, order, {})) | {"horizon": "matlab"}

    def prepare(self, settings: Settings) -> None:
        """Compile its gradient, or read it from numba's cache."""
        import numpy as np

        from nnss_cli.baselines.simba import initial_parameters, loss_and_gradient

        parameters = initial_parameters(None, 1, 1, 1, 1.0, np.random.default_rng(0))
        loss_and_gradient(parameters, np.ones((2, 1, 2)), np.ones((2, 1, 2)))

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train a linear model."""
        from nnss_cli.baselines.linear_model import LinearModel
        from nnss_cli.baselines.simba import SimbaOptions, train_simba

        options = SimbaOptions(**{name: value for name, value in settings.items() if name != "horizon"})
        start = subspace_model(data, order, settings["horizon"]) if options.start == "n4sid" else None
        training = train_simba(*data.normalised(), order, seed, options, start, on_epoch, data.init_window)
        model = None if training.diverged else LinearModel.of(training.system, data)
        return Fit(model, training.epochs, training.diverged, training.history, best_epoch=training.best_epoch)


class Ensemble(Method):
    """The mean of the simulated outputs of the seeds of NN-SS that validate better."""

    name = "nnss-ensemble"
    seeded = False
    members = "nnss"

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Those of the members."""
        return METHODS[self.members].settings(data, order, overrides)

    def prepare(self, settings: Settings) -> None:
        """Import what members need."""
        METHODS[self.members].prepare(settings)

    def combine(self, members: Sequence[Any], data: FittingData) -> Fit:
        """Choose among models of several seeds, on validation."""
        from nnss_cli.model.ensemble import Ensemble as Mean

        return Fit(Mean.chosen(members, data))

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train one member and take it alone; `combine` is for those that are trained already."""
        trained = METHODS[self.members].fit(data, order, seed, settings, on_epoch)
        return self.combine([trained.model], data) if trained.model else trained


_ALL: tuple[Method, ...] = (
    NNSS("nnss"),
    Ensemble(),
    NNSS("nnss-paper", "paper"),
    SIMBa(),
    N4SID(),
    SSEST(),
    SSREGEST(),
)
METHODS: dict[str, Method] = {method.name: method for method in _ALL}
DEFAULT = tuple(name for name in METHODS if name != "nnss-paper")
"""What `compare` takes unless told: the paper's recipe is an option of nnss, and a method for use beside it."""


def select(names: Sequence[str]) -> list[Method]:
    """The methods of these names, in this order; `DEFAULT` where `names` is empty.

    Raises:
        InputError: a name is unknown; the message lists the valid ones.
    """
    for name in names:
        if name not in METHODS:
            raise unknown("method", name, METHODS)
    return [METHODS[name] for name in dict.fromkeys(names or DEFAULT)]


def load_model(folder: Path) -> Model:
    """Read a trained model.

    Raises:
        InputError: missing, damaged or of an unknown kind.
    """
    from nnss_cli.modelfile import read_model

    description, tensors = read_model(folder)
    kind = description.get("kind")
    try:
        if kind == "nnss":
            from nnss_cli.model.nnss import NNSS as NNSSModel

            return NNSSModel.from_file(description, tensors)
        if kind == "linear":
            from nnss_cli.baselines.linear_model import LinearModel

            return LinearModel.from_file(description, tensors)
        if kind == "ensemble":
            from nnss_cli.model.ensemble import Ensemble as Mean

            return Mean.from_file(description, tensors)
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise InputError(f"'{folder}' holds an incomplete {kind} model: {error}; train it again") from error
    raise unknown("kind of model", str(kind), ("nnss", "linear", "ensemble"))
