"""The registry: every method that `compare` knows, behind one protocol.

To add one, write a class like `N4SID` below and put an instance into `METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Protocol

from nnss_cli.datasets.record import Channels, FittingData, FloatArray, Simulation
from nnss_cli.errors import InputError, unknown

Settings = dict[str, Any]
EpochCallback = Callable[[int, float, float], None]


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

    def simulate(self, u: FloatArray, y0: FloatArray) -> Simulation:
        """Free simulation of inputs (K, r) from the first output sample (m,)."""
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


class Method(Protocol):
    """A way to get a model of a given order from data."""

    name: str
    """Name on the command line and in tables."""
    seeded: bool
    """Whether the result depends on the seed; others run once, as seed 0."""

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """Every option of a fit, resolved: it is kept with the run and decides whether one can be reused.

        Raises:
            InputError: an override that this method has is out of range. Others are ignored.
        """
        ...

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Fit a model. `data` holds no test record."""
        ...


class NNSS:
    """The paper's method: `nnss_cli.model` trained by `nnss_cli.training`."""

    name = "nnss"
    seeded = True

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """The paper's recipe for the dataset and order, with the user's changes."""
        from nnss_cli.training.recipe import Recipe, paper_recipe

        own = {f.name for f in fields(Recipe)}
        changes = {name: value for name, value in overrides.items() if name in own}
        recipe = paper_recipe(data.dataset, order).replace(**changes)
        recipe.architecture(order, data.input_count, data.output_count)
        longest = max(len(record) for record in data.train)
        if recipe.window > longest:
            raise InputError(
                f"window: expected at most the {longest} samples of {data.dataset}'s training record, "
                f"found {recipe.window}; use --window"
            )
        return asdict(recipe)

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train an NN-SS model."""
        from nnss_cli.training.fit import train_nnss
        from nnss_cli.training.recipe import Recipe

        training = train_nnss(data, order, seed, Recipe(**settings), on_epoch)
        return Fit(
            None if training.diverged else training.model,
            training.epochs,
            training.diverged,
            {"train_loss": training.train_loss, "val_rmse": training.val_rmse},
        )


class N4SID:
    """Subspace identification with MATLAB's horizons; see `nnss_cli.baselines.n4sid`."""

    name = "n4sid"
    seeded = False

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """The horizons."""
        from nnss_cli.baselines.n4sid import matlab_horizon

        future, past = matlab_horizon(order, data.input_count, data.output_count)
        return {"future": future, "past": past}

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Identify a linear model in normalised units."""
        from nnss_cli.baselines.linear_model import LinearModel
        from nnss_cli.baselines.n4sid import n4sid

        records = tuple(data.scaling.apply(record) for record in data.train)
        return Fit(LinearModel.of(n4sid(records, order), data))


METHODS: dict[str, Method] = {method.name: method for method in (NNSS(), N4SID())}


def select(names: Sequence[str]) -> list[Method]:
    """The methods of these names, all of them where `names` is empty.

    Raises:
        InputError: a name is unknown; the message lists the valid ones.
    """
    for name in names:
        if name not in METHODS:
            raise unknown("method", name, METHODS)
    return [METHODS[name] for name in dict.fromkeys(names or METHODS)]


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
    except (KeyError, TypeError, RuntimeError, ValueError) as error:
        raise InputError(f"'{folder}' holds an incomplete {kind} model: {error}; train it again") from error
    raise unknown("kind of model", str(kind), ("nnss", "linear"))
