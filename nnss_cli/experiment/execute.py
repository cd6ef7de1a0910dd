"""Execute one run: fit, simulate every split, score, keep."""

from __future__ import annotations

import time
from dataclasses import asdict, replace

import numpy as np

from nnss_cli.datasets.record import Dataset, unscored
from nnss_cli.errors import InputError
from nnss_cli.experiment.origin import with_origin
from nnss_cli.experiment.provenance import Watch, here
from nnss_cli.experiment.run import RunResult, RunSpec, Score, Status, score_outputs
from nnss_cli.experiment.store import Store
from nnss_cli.files import together
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods import METHODS, Fit, Method, Model, load_model
from nnss_cli.methods.compiled import free_run
from nnss_cli.methods.registry import sound_fit
from nnss_cli.modelfile import Tensors

# Singular, too short, out of range. torch's errors of linear algebra are RuntimeErrors.
NUMERICAL = (ValueError, ArithmeticError, np.linalg.LinAlgError, RuntimeError)


def execute(
    spec: RunSpec,
    dataset: Dataset,
    store: Store,
    on_epoch: EpochCallback | None = None,
    method: Method | None = None,
    command: str | None = None,
) -> RunResult:
    """Fit, simulate, score and write one run. Numerical failure is a result, not an exception.

    Whoever else may execute the same run at once holds its lock (`Store.lock`).

    Args:
        spec: which run.
        dataset: what is fitted and scored.
        store: where it is kept.
        on_epoch: hears of each epoch.
        method: what fits; the registered one of the run's method unless given.
        command: the command line that asked for it; this process's own unless given.

    Raises:
        InputError: it cannot be kept: no space, no permission.
    """
    watch = Watch()
    with store.writing():
        store.clear(spec)
    status: Status = "ok"
    reason = ""
    scores: list[Score] = []
    signals: Tensors = {}
    fit = Fit(None)
    method = method or METHODS[spec.method]
    method.prepare(spec.settings)
    trained = 0.0  # seconds that the members of a combination have taken
    started = time.perf_counter()
    try:
        if "members" in spec.settings:
            members = _members(method, spec, store)
            fit = combined(method, members, dataset, store)
            trained = sum(member.fit_seconds for member in members)
        else:
            fit = method.fit(dataset.fitting, spec.order, spec.seed, spec.settings, on_epoch)
        fit = sound_fit(fit, method)
        if fit.diverged:
            status, reason = "diverged", fit.diverged
        elif fit.model is None:
            status, reason = "failed", "the method gave no model and no reason"
    except NUMERICAL as error:
        status, reason = "failed", sentence(error)
    except MemoryError as error:
        status, reason = "memory", sentence(error)
    fit_seconds = time.perf_counter() - started + trained
    if fit.model is not None:
        try:
            scores, signals = simulate_splits(fit.model, dataset)
            bad = [score.split for score in scores if not np.isfinite(score.rmse)]
            if bad:
                status, reason = (
                    "diverged",
                    f"the simulation of {', '.join(dict.fromkeys(bad))} left the finite range",
                )
        except NUMERICAL as error:
            status, reason = "failed", f"its simulation failed: {sentence(error)}"
        if status != "ok":
            scores = []
    made = watch.provenance(command)
    result = RunResult(
        spec, status, reason, tuple(scores), fit.epochs, round(fit_seconds, 3), made, fit.history,
        asdict(dataset.fitting.channels), dataset.notes, fit.remarks, dataset.title,
    )  # fmt: skip
    with store.writing(), together():
        if fit.model is not None:
            with with_origin(spec, dataset.fitting.init_window, here(), dataset.notes, fit.remarks):
                fit.model.save(store.run_folder(spec))
        store.write(result, signals)
    return result


def _members(method: Method, spec: RunSpec, store: Store) -> list[RunResult]:
    """The finished runs that a combination was planned with, by seed."""
    found = (store.find(replace(spec, method=method.members, seed=seed)) for seed in spec.settings["members"])
    return [result for result in found if result is not None]


def combined(method: Method, members: list[RunResult], dataset: Dataset, store: Store) -> Fit:
    """What a method makes of other runs. Those without a model are left out, and that is said."""
    sound = [member for member in members if member.status == "ok"]
    lost = [f"seed {member.spec.seed} {member.status}" for member in members if member.status != "ok"]
    if not sound:
        return Fit(None, diverged=f"none of its {len(members)} members has a model: {', '.join(lost) or 'none ran'}")
    try:
        models = [load_model(store.run_folder(member.spec)) for member in sound]
    except InputError as error:  # a damaged member costs this run, not the command
        raise ValueError(str(error)) from error
    fit = method.combine(models, dataset.fitting)
    if lost:
        fit = replace(fit, remarks=(*fit.remarks, f"{len(lost)} of {len(members)} members left out: {', '.join(lost)}"))
    return fit


def sentence(error: BaseException) -> str:
    """An exception's words on one line; its type where it has none."""
    return " ".join(str(error).split()) or type(error).__name__


def simulate_splits(model: Model, dataset: Dataset) -> tuple[list[Score], Tensors]:
    """Free simulation of every record from its first output samples: the scores and the signals.

    Where more than one sample tells x(0), these are not scored.
    """
    window = dataset.fitting.init_window
    begin = unscored(window)
    scores: list[Score] = []
    signals: Tensors = {}
    for split, records in dataset.splits().items():
        simulations = [free_run(model, record.u, record.y[:window]) for record in records]
        for index, (record, simulation) in enumerate(zip(records, simulations, strict=True)):
            prefix = f"{split}/{index}"
            signals |= {
                f"{prefix}/u": record.u, f"{prefix}/y": record.y,
                f"{prefix}/y_sim": simulation.y, f"{prefix}/x": simulation.x,
            }  # fmt: skip
        scores += score_outputs(
            split, [record.y[begin:] for record in records], [s.y[begin:] for s in simulations], dataset.fitting.scaling
        )
    signals["Ts"] = np.array([dataset.fitting.Ts])
    return scores, signals
