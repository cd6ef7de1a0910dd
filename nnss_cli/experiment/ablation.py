"""Studies of NN-SS itself: the same recipe with one switch changed at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError, unknown
from nnss_cli.experiment.agreement import agreeing
from nnss_cli.experiment.executor import Event
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store, records_of
from nnss_cli.experiment.sweep import plan, sweep
from nnss_cli.methods import METHODS, Method, Settings, load_model
from nnss_cli.methods.options import for_method

STRESS = 20_000  # steps of a run's stress test

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
        "no candidates": {"feedthrough": "no", "integrator": "no", "initial": "feedback"},
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

    A variant that does not go with the other options, as `incremental` with several hidden layers, has no runs.

    Raises:
        InputError: the study is unknown, or an order or option is out of range for all variants.
    """
    if study not in STUDIES:
        raise unknown("study", study, STUDIES)
    found = []
    method = METHODS["nnss"]
    given = {name: for_method(overrides, method.name) | change for name, change in STUDIES[study].items()}
    refused = _refused(method, dataset, orders, given)
    for name, changed in given.items():
        if name in refused:
            left_out = (f"{name}: {refused[name]}",)
            found.append(Variant(name, (), () if study == "stability" else None, left_out))
            continue
        own = variant_store(store, study, name)
        planned = plan(own, dataset, [method], orders, seeds, changed, force=False)
        todo = planned.todo
        on_plan(name, len(todo))
        sweep(todo, dataset, own, jobs, on_event, on_result)
        wanted = set(seeds)
        table = agreeing(own, own.read(planned.found), planned.faults)
        results = tuple(r for r in table.results if r.spec.order in orders and r.spec.seed in wanted)
        unbounded = tuple(r for r in results if _diverges(own, r)) if study == "stability" else None
        found.append(Variant(name, results, unbounded, tuple(table.left_out)))
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


def _diverges(store: Store, result: RunResult) -> bool:
    """Whether the state leaves the range of numbers under the stress inputs."""
    from nnss_cli.experiment.certificate import certify

    if result.status != "ok":  # there is no model to try
        return False
    folder = store.run_folder(result.spec)
    model = load_model(folder)
    found = certify(model, records_of(folder, model.Ts), steps=STRESS, search_lyapunov=False)
    return any(run.steps < STRESS for run in found.stress)
