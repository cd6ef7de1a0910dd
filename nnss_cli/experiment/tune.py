"""Search of NN-SS's hyperparameters on validation, kept in an SQLite file so that it can go on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nnss_cli.datasets.record import FittingData
from nnss_cli.errors import InputError, unknown
from nnss_cli.methods import METHODS, Settings

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
    values: dict[str, Any]
    """What was searched."""


def suggest(trial: optuna.Trial, shortest: int) -> Settings:
    """Widths, depths, λ, learning rate and window, as the paper's Bayesian optimisation varies them."""
    depth = trial.suggest_int("depth", 1, 6)
    width = trial.suggest_int("width", 8, 200, log=True)
    encoder_depth = trial.suggest_int("encoder_depth", 1, 4)
    encoder_width = trial.suggest_int("encoder_width", 4, 128, log=True)
    window = trial.suggest_int("window", min(20, shortest), min(400, shortest), log=True)
    return {
        "hidden": (width,) * depth,
        "encoder": (encoder_width,) * encoder_depth,
        "consistency": trial.suggest_float("lambda", 1e-4, 1.0, log=True),
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 1e-2, log=True),
        "window": window,
        "stride": max(1, window // 20),
        "batch": trial.suggest_categorical("batch", [1, 8, 32, 64]),
        "optimiser": "adam",
        "initial": "random",
    }


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
    except ModuleNotFoundError as error:
        raise InputError("tuning needs optuna, which is not installed: pip install 'nnss[tune]'") from error
    if sampler not in SAMPLERS:
        raise unknown("sampler", sampler, SAMPLERS)
    method = METHODS["nnss"]
    shortest = min(len(record) for record in data.train)
    about = {
        "dataset": data.dataset,
        "protocol": data.protocol,
        "order": order,
        "seed": seed,
        "options": str(overrides),
    }
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    storage.parent.mkdir(parents=True, exist_ok=True)
    done = optuna.load_study if storage.exists() else optuna.create_study
    options: dict[str, Any] = {
        "study_name": "nnss", "storage": f"sqlite:///{storage.resolve()}", "pruner": optuna.pruners.MedianPruner(5, 50),
    }  # fmt: skip
    study = done(**options)
    # each call searches on with a stream of its own: the same stream would try the same recipes again
    stream = seed + 1000 * len(study.trials)
    kind = optuna.samplers.TPESampler if sampler == "tpe" else optuna.samplers.GPSampler
    study.sampler = kind(seed=stream)
    kept = study.user_attrs.get("about")
    if kept is not None and kept != about:
        changed = ", ".join(
            f"{name} {kept[name]} instead of {about[name]}" for name in about if kept[name] != about[name]
        )
        raise InputError(f"'{storage}' holds a study with {changed}: take another folder with --out, or remove it")
    study.set_user_attr("about", about)

    def objective(trial: optuna.Trial) -> float:
        settings = method.settings(data, order, suggest(trial, shortest) | overrides)
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
        return best

    study.optimize(
        objective, n_trials=trials, catch=(ValueError, ArithmeticError),
        callbacks=[lambda _, finished: on_trial(_trial(finished))],
    )  # fmt: skip
    return sorted((_trial(t) for t in study.trials), key=lambda t: (t.state != "complete", t.val_rmse))


def options_of(values: dict[str, Any]) -> str:
    """The command-line options that train what a trial found."""
    settings = {
        "--hidden": " ".join([str(values["width"])] * values["depth"]),
        "--encoder": " ".join([str(values["encoder_width"])] * values["encoder_depth"]),
        "--lambda": f"{values['lambda']:.3g}", "--learning-rate": f"{values['learning_rate']:.3g}",
        "--window": values["window"], "--stride": max(1, values["window"] // 20), "--batch": values["batch"],
    }  # fmt: skip
    return "--optimiser adam --start random " + " ".join(f"{name} {value}" for name, value in settings.items())


def _trial(trial: optuna.trial.FrozenTrial) -> Trial:
    reached = list(trial.intermediate_values.values())
    value = trial.value if trial.value is not None else min(reached, default=math.inf)
    return Trial(trial.number, trial.state.name.lower(), float(value), trial.params)
