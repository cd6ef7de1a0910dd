"""The paper's method, with a recipe of one's choice or the paper's."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from functools import cache
from typing import TYPE_CHECKING, Any

from nnss_cli.datasets.record import FittingData, Presets
from nnss_cli.datasets.windows import chosen_window, shortened
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods.options import chosen_options
from nnss_cli.methods.protocol import Fit, Method, Model, Settings
from nnss_cli.modelfile import Tensors

if TYPE_CHECKING:
    from nnss_cli.training.recipe import Recipe


@cache
def _options() -> type[Recipe]:
    """A recipe's fields and which recipe they change; made at need, since recipes bring scipy along."""
    from nnss_cli.training.recipe import Recipe

    @dataclass(frozen=True)
    class NNSSOptions(Recipe):
        """What NN-SS can be told."""

        recipe: str = "best"
        """The recipe to start from: best, or paper for that of the paper."""

    return NNSSOptions


def _read(description: dict[str, Any], tensors: Tensors) -> Model:
    from nnss_cli.model.nnss import NNSS as NNSSModel

    return NNSSModel.from_file(description, tensors)


class NNSS(Method):
    """The paper's method: `nnss_cli.model` trained by `nnss_cli.training`, with one of its recipes."""

    seeded = True
    version = "6"
    models = {"nnss": _read}  # noqa: RUF012 - never changed

    def __init__(self, name: str, position: int, recipe: str | None = None) -> None:
        """`recipe` fixes it; without, it is the user's choice and `best` by default."""
        self.name = name
        self.position = position
        self.recipe = recipe

    @property
    def options(self) -> type[Any]:
        """A recipe's, and which recipe where that is open."""
        from nnss_cli.training.recipe import Recipe

        return Recipe if self.recipe else _options()

    def settings(self, data: FittingData, order: int, overrides: Settings) -> Settings:
        """The recipe for the dataset and order, with the user's changes."""
        from nnss_cli.training.recipe import COLD, Recipe, recipe_of

        changes = chosen_options(Recipe, overrides)
        if changes.get("engine") == "auto":
            del changes["engine"]
        name = self.recipe or str(overrides.get("recipe", "best"))
        known = recipe_of(name, data.presets, order, data.output_count, data.input_count)
        recipe = known.replace(**changes)
        if recipe.initial == "auto" and "initial" not in changes and COLD & changes.keys():
            recipe = recipe.replace(initial="feedback")  # what is asked for holds for every candidate
        recipe.architecture(order, data.input_count, data.output_count)
        recipe = recipe.replace(window=chosen_window(data.train, known.window, changes.get("window"), self.name))
        recipe.check_encoder_window(data)
        # the label is the recipe's only where every field is; engines and threads compute the same
        own = {f.name for f in fields(Recipe)}
        changed = [f for f in own if f not in ("engine", "threads") and getattr(recipe, f) != getattr(known, f)]
        return asdict(recipe) | {"recipe": f"{name}, changed: {', '.join(sorted(changed))}" if changed else name}

    def current(self, settings: Settings) -> Settings:
        """Of an older nnss, in today's names and with the options that were added since, as they were then."""
        if "stability" not in settings:
            return settings
        from nnss_cli.model.architecture import FORMERLY

        named = str(settings["stability"])
        return (
            {"gain": 0.0, "judge": "validation", "threads": 1, "encoder_window": 1, "lengthen": "no"}
            | settings
            | {"stability": FORMERLY.get(named, named)}
        )

    def paper_settings(self, presets: Presets, order: int) -> Settings:
        """The paper's recipe."""
        from nnss_cli.training.recipe import recipe_of

        return asdict(recipe_of("paper", presets, order)) | {"recipe": "paper"}

    def prepare(self, settings: Settings) -> None:
        """Compile the fast engine, or read it from numba's cache."""
        if settings["engine"] == "fast":
            from nnss_cli.training.fast import warm_up

            second_order = settings["optimiser"] == "gauss-newton" or settings["refine"] > 0
            stabilities = ("schur", "incremental") if settings["stability"] == "auto" else (settings["stability"],)
            for stability in stabilities:
                warm_up(settings["dtype"], stability, second_order)

    def fit(self, data: FittingData, order: int, seed: int, settings: Settings, on_epoch: EpochCallback | None) -> Fit:
        """Train an NN-SS model."""
        from nnss_cli.training.fit import train_nnss
        from nnss_cli.training.recipe import Recipe, recipe_of

        recipe = Recipe(**{name: value for name, value in settings.items() if name != "recipe"})
        training = train_nnss(data, order, seed, recipe, on_epoch)
        usual = recipe_of(str(settings.get("recipe", "best")).partition(",")[0], data.presets, order).window
        return Fit(
            None if training.diverged else training.model,
            epochs=training.epochs,
            best_epoch=training.best_epoch,
            diverged=training.diverged,
            history={"train_loss": training.train_loss, "val_rmse": training.val_rmse}
            | {f"{training.judged_by}, {name}": [error] for name, error in training.candidates.items()},
            remarks=(*shortened(data.train, recipe.window, usual), *training.remarks),
        )


METHODS = (NNSS("nnss", 10), NNSS("nnss-paper", 30, "paper"))
