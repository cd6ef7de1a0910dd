"""Execute one run: fit, simulate every split, score, keep."""

from __future__ import annotations

import platform
import time
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib import metadata

import numpy as np

from nnss_cli.datasets.record import Dataset
from nnss_cli.experiment.origin import write_origin
from nnss_cli.experiment.run import RunResult, RunSpec, Score, Status, score_outputs
from nnss_cli.experiment.store import Store
from nnss_cli.iterative import EpochCallback
from nnss_cli.methods import METHODS, Fit, Method, Model, load_model
from nnss_cli.methods.registry import sound_fit
from nnss_cli.modelfile import Tensors
from nnss_cli.version import __version__

LIBRARIES = ("numpy", "scipy", "torch", "numba")
"""Those whose version may change a number's last digits."""

# Singular, too short, out of range. torch's errors of linear algebra are RuntimeErrors.
NUMERICAL = (ValueError, ArithmeticError, np.linalg.LinAlgError, RuntimeError)


def execute(
    spec: RunSpec,
    dataset: Dataset,
    store: Store,
    on_epoch: EpochCallback | None = None,
    method: Method | None = None,
) -> RunResult:
    """Fit, simulate, score and write one run. Numerical failure is a result, not an exception.

    Whoever else may execute the same run at once holds its lock (`Store.lock`).

    Args:
        spec: which run.
        dataset: what is fitted and scored.
        store: where it is kept.
        on_epoch: hears of each epoch.
        method: what fits; the registered one of the run's method unless given.

    Raises:
        InputError: it cannot be kept: no space, no permission.
    """
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
    made = provenance()
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
        with store.writing():
            fit.model.save(store.run_folder(spec))
            write_origin(store.run_folder(spec), spec, dataset.fitting.init_window, made, dataset.notes, fit.remarks)
    result = RunResult(
        spec, status, reason, tuple(scores), fit.epochs, round(fit_seconds, 3), made, fit.history,
        asdict(dataset.fitting.channels), dataset.notes, fit.remarks,
    )  # fmt: skip
    store.write(result, signals)
    return result


def _members(method: Method, spec: RunSpec, store: Store) -> list[RunResult]:
    """The finished runs that a combination was planned with, by seed."""
    wanted = {(method.members, spec.order, seed) for seed in spec.settings["members"]}
    return [r for r in store.results() if (r.spec.method, r.spec.order, r.spec.seed) in wanted]


def combined(method: Method, members: list[RunResult], dataset: Dataset, store: Store) -> Fit:
    """What a method makes of other runs. Those without a model are left out, and that is said."""
    sound = [member for member in members if member.status == "ok"]
    lost = [f"seed {member.spec.seed} {member.status}" for member in members if member.status != "ok"]
    if not sound:
        return Fit(None, diverged=f"none of its {len(members)} members has a model: {', '.join(lost) or 'none ran'}")
    fit = method.combine([load_model(store.run_folder(member.spec)) for member in sound], dataset.fitting)
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
    begin = window if window > 1 else 0
    scores: list[Score] = []
    signals: Tensors = {}
    for split, records in dataset.splits().items():
        simulations = [model.simulate(record.u, record.y[:window]) for record in records]
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


def provenance() -> dict[str, str]:
    """Where a number came from: versions, machine, time."""
    versions = {name: metadata.version(name) for name in LIBRARIES}
    return {
        "nnss": __version__,
        "python": platform.python_version(),
        **versions,
        "machine": f"{platform.system()} {platform.machine()}",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
    }
