"""Search of NN-SS's hyperparameters on validation, kept in an SQLite file so that it can go on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nnss_cli.datasets.record import FittingData
from nnss_cli.errors import InputError, unknown
from nnss_cli.experiment.execute import NUMERICAL
from nnss_cli.methods import METHODS, Settings, version_of
from nnss_cli.methods.options import for_method
from nnss_cli.version import __version__

if TYPE_CHECKING:
    import optuna

SAMPLERS = ("tpe", "gp")


@dataclass(frozen=True)
class Trial:
    """One recipe that was tried."""

    number: int
    """From 0."""
    state: str
    """complete, pruned or fail."""
    val_rmse: float
    """Lowest validation error, normalised units; of a pruned trial, as far as it came."""
    settings: Settings
    """What was searched and what was given: the options that train it."""


def searched(given: Settings) -> list[str]:
    """The settings that a search draws: those of its optimiser that are not given."""
    adam = given.get("optimiser", "adam") == "adam"
    names = ["hidden", "encoder", "window", "consistency", *["learning_rate", "batch"] * adam]
    return [name for name in names if name not in given]


def draw(trial: optuna.Trial, shortest: int, given: Settings) -> dict[str, Any]:
    """Widths, depths, λ, learning rate and window, as the paper's Bayesian optimisation varies them, where not given.

    Of Gauss–Newton, whose iterations cost the weights' square, generators are small ones.

    Args:
        trial: draws the values.
        shortest: samples of the shortest training record.
        given: settings that are not searched.
    """
    values: dict[str, Any] = {}
    names = searched(given)
    depth, least, most = (2, 2, 16) if given.get("optimiser") == "gauss-newton" else (6, 8, 200)
    if "hidden" in names:
        values["depth"] = trial.suggest_int("depth", 1, depth)
        values["width"] = trial.suggest_int("width", least, most, log=True)
    if "encoder" in names:
        values["encoder_depth"] = trial.suggest_int("encoder_depth", 1, 4)
        values["encoder_width"] = trial.suggest_int("encoder_width", 4, 128, log=True)
    if "window" in names:
        values["window"] = trial.suggest_int("window", min(20, shortest), min(400, shortest), log=True)
    if "consistency" in names:
        values["consistency"] = trial.suggest_float("consistency", 1e-4, 1.0, log=True)
    if "learning_rate" in names:
        values["learning_rate"] = trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True)
    if "batch" in names:
        values["batch"] = trial.suggest_categorical("batch", [1, 8, 32, 64])
    return values


def settings_of(values: dict[str, Any], given: Settings) -> Settings:
    """The settings that values of a search stand for, with those that were given."""
    found: Settings = {"optimiser": "adam", "initial": "random", "feedthrough": "no"}
    for name, value in values.items():
        if name == "depth":
            found["hidden"] = (values["width"],) * value
        elif name == "encoder_depth":
            found["encoder"] = (values["encoder_width"],) * value
        elif name not in ("width", "encoder_width"):
            found[name] = value
    found |= given
    if "window" in found and "stride" not in given:
        found["stride"] = max(1, found["window"] // 20)
    return found


def tune(
    data: FittingData,
    order: int,
    trials: int,
    sampler: str,
    seed: int,
    overrides: Settings,
    storage: Path,
    on_trial: Callable[[Trial], None],
) -> list[Trial]:
    """Add trials to the study in `storage`, and return all of them, the best first.

    A trial trains with one seed and is pruned when its best validation error is above the median of
    those that came as far.

    Args:
        data: train and validation records; there is no test in it.
        order: number of states n.
        trials: how many to add.
        sampler: tpe (tree-structured Parzen estimator) or gp (Gaussian process).
        seed: of the weights and of the search.
        overrides: settings that are not searched.
        storage: SQLite file, made where it is missing.
        on_trial: hears of each trial that ends.

    Raises:
        InputError: optuna is not installed, the sampler is unknown, or the study is of another dataset or options.
    """
    try:
        import optuna
        import sqlalchemy.exc
    except ModuleNotFoundError as error:
        raise InputError("tuning needs optuna, which is not installed: pip install 'nnss[tune]'") from error
    if sampler not in SAMPLERS:
        raise unknown("sampler", sampler, SAMPLERS)
    method = METHODS["nnss"]
    overrides = for_method(overrides, method.name)
    shortest = min(len(record) for record in data.train)
    if overrides.get("judge", "validation") != "validation":
        raise InputError(
            f"judge: tune compares trials epoch by epoch on validation, found {overrides['judge']}: leave --judge out, "
            "and give it to the training of the best one"
        )
    if not searched(overrides):
        raise InputError("tune: every option that it searches is given; leave one of them out, or use 'nnss train'")
    about = {
        "dataset": data.dataset,
        "protocol": data.protocol,
        "data": data.fingerprint(),
        "nnss": __version__,
        "method": version_of(method),
        "order": order,
        "seed": seed,
        "options": str(overrides),
    }
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage.parent.mkdir(parents=True, exist_ok=True)
    try:
        study = optuna.create_study(
            study_name="nnss", storage=f"sqlite:///{storage.resolve()}", pruner=optuna.pruners.MedianPruner(5, 50),
            load_if_exists=True,
        )  # fmt: skip
    except sqlalchemy.exc.DatabaseError as error:
        raise InputError(f"'{storage}' is no file of a search: remove it, or take another folder with --out") from error
    # each call searches on with a stream of its own: the same stream would try the same recipes again
    stream = seed + 1000 * len(study.trials)
    kind = optuna.samplers.TPESampler if sampler == "tpe" else optuna.samplers.GPSampler
    study.sampler = kind(seed=stream)
    kept = study.user_attrs.get("about")
    if kept is not None and kept != about:
        changed = ", ".join(
            f"{name} {kept.get(name, 'unknown')} instead of {about[name]}"
            for name in about
            if kept.get(name) != about[name]
        )
        raise InputError(f"'{storage}' holds a study with {changed}: take another folder with --out, or remove it")
    study.set_user_attr("about", about)

    def objective(trial: optuna.Trial) -> float:
        settings = method.settings(data, order, settings_of(draw(trial, shortest, overrides), overrides))
        best = math.inf

        def after_epoch(epoch: int, _: float, val_rmse: float) -> None:
            nonlocal best
            best = min(best, val_rmse)
            trial.report(best, epoch)
            if trial.should_prune():
                raise optuna.TrialPruned

        method.prepare(settings)
        fit = method.fit(data, order, seed, settings, after_epoch)
        if fit.diverged:
            raise ValueError(fit.diverged)
        return min(fit.history.get("val_rmse", ()), default=best)  # of the candidate taken alone

    study.optimize(
        objective, n_trials=trials, catch=NUMERICAL,
        callbacks=[lambda _, finished: on_trial(_trial(finished, overrides))],
    )  # fmt: skip
    return sorted((_trial(t, overrides) for t in study.trials), key=lambda t: (t.state != "complete", t.val_rmse))


def _trial(trial: optuna.trial.FrozenTrial, given: Settings) -> Trial:
    reached = list(trial.intermediate_values.values())
    value = trial.value if trial.value is not None else min(reached, default=math.inf)
    return Trial(trial.number, trial.state.name.lower(), float(value), settings_of(trial.params, given))
