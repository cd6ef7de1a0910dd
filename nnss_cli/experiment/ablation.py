"""Studies of NN-SS itself: the same recipe with one switch changed at a time."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError, unknown
from nnss_cli.experiment.agreement import agreeing
from nnss_cli.experiment.executor import Event
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store, records_of
from nnss_cli.experiment.sweep import plan, sweep
from nnss_cli.files import write_text
from nnss_cli.methods import METHODS, Method, Settings, load_model
from nnss_cli.methods.options import for_method

STRESS = 20_000  # steps of a run's stress test
STRESSED = "stress.json"  # what came of it, in the run's folder

# variant → what it changes
STUDIES: dict[str, dict[str, Settings]] = {
    "recipe": {
        "the recipe as it is": {},
        "λ = 0": {"consistency": 0.0},
        "λ = 0.1": {"consistency": 0.1},
        "cold start": {"initial": "random"},
        "linear start": {"initial": "linear"},
        "feedback start": {"initial": "feedback"},
        "windows of 40 samples": {"window": 40, "stride": 10},
        "encoder fixed": {"fixed_encoder": True},
        "scheduling x+u": {"scheduling": "x+u"},
        "scheduling x+y": {"scheduling": "x+y"},
    },
    "class": {
        "the recipe as it is": {},
        "without feedthrough": {"feedthrough": "no"},
        "with feedthrough": {"feedthrough": "yes"},
        "without integrator": {"integrator": "no"},
        "with integrator": {"integrator": "yes"},
        "scheduling x+u": {"scheduling": "x+u"},
        "scheduling x+u, with feedthrough": {"scheduling": "x+u", "feedthrough": "yes"},
        "without incremental layer": {"stability": "schur"},
        "incremental layer": {"stability": "incremental", "hidden": (16,)},
        "without windows that lengthen": {"lengthen": "no"},
        "encoder of 10 samples": {"encoder_window": 10},
        "no candidates": {
            "feedthrough": "no",
            "integrator": "no",
            "lengthen": "no",
            "stability": "schur",
            "initial": "feedback",
        },
    },
    "stability": {
        "schur": {"stability": "schur"},
        "quadratic": {"stability": "quadratic"},
        "incremental": {"stability": "incremental"},
        "none": {"stability": "none"},
    },
}


@dataclass(frozen=True)
class Variant:
    """One switch of a study, with its runs."""

    name: str
    """What was changed."""
    results: tuple[RunResult, ...]
    """A run per seed."""
    unbounded: tuple[RunResult, ...] | None
    """Those with a model whose state left the range of numbers under stress; None where that was not tried."""
    left_out: tuple[str, ...] = ()
    """A line for each run that is damaged, or disagrees with the others."""
    refused: str = ""
    """Why there can be no runs of it here, or ""."""


def variant_store(store: Store, study: str, name: str) -> Store:
    """Where a variant's runs are kept: apart from those of the comparison, with which they must not mix."""
    word = "".join(letter if letter.isalnum() else "-" for letter in name)
    return replace(store, out=store.out / "ablation" / study / word)


def ablate(
    store: Store,
    dataset: Dataset,
    study: str,
    orders: Sequence[int],
    seeds: Sequence[int],
    overrides: Settings,
    jobs: int,
    on_plan: Callable[[str, int], None],
    on_event: Callable[[Event], None],
    on_result: Callable[[RunResult], None],
) -> list[Variant]:
    """Run what is missing of a study, and return all of it.

    A variant that does not go with the other options, as `incremental` with several hidden layers, or with the record,
    as an encoder window with one that leaves no sample unscored, has no runs.

    Raises:
        InputError: the study is unknown, or an order or option is out of range for all variants.
    """
    if study not in STUDIES:
        raise unknown("study", study, STUDIES)
    found = []
    method = METHODS["nnss"]
    for option in set.intersection(*map(set, STUDIES[study].values())) & for_method(overrides, method.name).keys():
        raise InputError(f"{option}: each variant of the study '{study}' has one of its own: leave it out")
    given = {name: for_method(overrides, method.name) | change for name, change in STUDIES[study].items()}
    refused = _refused(method, dataset, orders, given)
    for name, changed in given.items():
        own = variant_store(store, study, name)
        if name in refused:
            found.append(Variant(name, (), _unbounded(own, (), study), refused=refused[name]))
            continue
        planned = plan(own, dataset, [method], orders, seeds, changed, force=False)
        todo = planned.todo
        on_plan(name, len(todo))
        sweep(todo, dataset, own, jobs, on_event, on_result)
        wanted = set(seeds)
        table = agreeing(own, own.read(planned.found), planned.faults)
        results = tuple(r for r in table.results if r.spec.order in orders and r.spec.seed in wanted)
        if study == "stability":
            for result in results:
                _stress(own, result)
        found.append(Variant(name, results, _unbounded(own, results, study), tuple(table.left_out)))
    return found


def studies(store: Store) -> dict[str, list[Variant]]:
    """The studies of which runs are on disk, each with all of them: nothing is trained or put under stress."""
    found: dict[str, list[Variant]] = {}
    for study, changes in STUDIES.items():
        variants = []
        for name in changes:
            own = variant_store(store, study, name)
            table = agreeing(own, own.read())
            results = tuple(table.results)
            variants.append(Variant(name, results, _unbounded(own, results, study), tuple(table.left_out)))
        if any(variant.results for variant in variants):
            found[study] = variants
    return found


def _refused(method: Method, dataset: Dataset, orders: Sequence[int], given: dict[str, Settings]) -> dict[str, str]:
    """Why there are no runs of a variant, by its name.

    Raises:
        InputError: there are of none.
    """
    refused = {}
    for name, changed in given.items():
        try:
            for order in orders:
                method.settings(dataset.fitting, order, changed)
        except InputError as error:
            refused[name] = error
    if len(refused) == len(given):
        raise next(iter(refused.values()))
    return {name: str(error) for name, error in refused.items()}


def _unbounded(store: Store, results: Sequence[RunResult], study: str) -> tuple[RunResult, ...] | None:
    """The runs that left the range of numbers; None where a model was not put under stress."""
    stressed = {id(result): _stressed(store, result) for result in results if result.status == "ok"}
    if study != "stability" or None in stressed.values():
        return None
    return tuple(result for result in results if stressed.get(id(result)))


def _stressed(store: Store, result: RunResult) -> bool | None:
    """Whether a run's model left the range of numbers under stress, as its folder says; None where it does not."""
    try:
        kept: Any = json.loads((store.run_folder(result.spec) / STRESSED).read_text(encoding="utf-8"))
        return bool(kept["unbounded"]) if kept["steps"] == STRESS else None
    except (OSError, ValueError, TypeError, KeyError):
        return None


def _stress(store: Store, result: RunResult) -> None:
    """Try whether a model's state leaves the range of numbers under the stress inputs, and keep what came of it.

    Raises:
        InputError: it cannot be written.
    """
    from nnss_cli.experiment.certificate import certify

    if result.status != "ok" or _stressed(store, result) is not None:  # no model to try, or one that was tried
        return
    folder = store.run_folder(result.spec)
    model = load_model(folder)
    found = certify(model, records_of(folder, model.Ts), steps=STRESS, search_lyapunov=False)
    unbounded = any(run.steps < STRESS for run in found.stress)
    with store.writing():
        write_text(folder / STRESSED, json.dumps({"steps": STRESS, "unbounded": unbounded}) + "\n")
