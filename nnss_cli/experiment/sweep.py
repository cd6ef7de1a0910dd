"""Many runs: which are missing, and executing them in one process or several."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

from nnss_cli.datasets.record import Dataset, FittingData
from nnss_cli.errors import InputError
from nnss_cli.experiment.agreement import OTHER_DATA, conflict, difference
from nnss_cli.experiment.changed import changed_data
from nnss_cli.experiment.executor import NO_LIMITS, Event, Executor, Limits, Serial, Task
from nnss_cli.experiment.outcomes import results
from nnss_cli.experiment.processes import Processes
from nnss_cli.experiment.provenance import LIBRARIES, MADE_ON, here
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.store import Found, Store
from nnss_cli.machine import few_threads
from nnss_cli.methods import METHODS, Method, Settings, version_of
from nnss_cli.methods.options import for_method

MAX_RUNS = 1_000_000
"""Runs of one call: each is a folder, of which more than that are beyond a file system's patience."""

AGAIN = ("timeout", "memory", "crashed")
"""Results that another machine, or limit, may better: they are tried again when it is asked for."""


@dataclass(frozen=True)
class Plan:
    """What a sweep has to do."""

    todo: list[RunSpec]
    """Runs to execute."""
    done: list[RunResult]
    """Runs that were asked for and are finished already."""
    faults: dict[str, str]
    """Runs of the folder that are damaged or disagree with the others, by label: they are neither used nor replaced."""
    found: Found
    """What there was in the folder."""

    @property
    def labels(self) -> set[str]:
        """Of all that was asked for."""
        return {spec.label for spec in self.todo} | {result.spec.label for result in self.done}

    def made_elsewhere(self) -> list[str]:
        """A line for each version of the code or a library, and for each machine, that made finished runs elsewhere."""
        lines = []
        for name in (*LIBRARIES, "python", "commit", *MADE_ON):
            own = here().get(name, "unknown")
            others = Counter(made for r in self.done if (made := r.provenance.get(name, "unknown")) != own)
            lines += [f"{count} of the finished runs: {name} {made}, here {own}" for made, count in others.items()]
        return lines


def check_order(order: int, data: FittingData) -> None:
    """Refuse an order that the training record cannot determine.

    A linear model of order n has n (r + m) coefficients and n initial states: there must be at
    least as many output samples.

    Raises:
        InputError: the order is below 1 or above that bound.
    """
    samples = sum(len(record) for record in data.train) * data.output_count
    largest = samples // (data.input_count + data.output_count + 1)
    if not 1 <= order <= largest:
        raise InputError(
            f"order: expected 1 to {largest} on {data.dataset} ({samples} output samples for training), found {order}"
        )


def check_count(runs: int) -> None:
    """Refuse a plan that no folder could hold, before it is made.

    Raises:
        InputError: there are more than `MAX_RUNS`.
    """
    if runs > MAX_RUNS:
        raise InputError(f"expected at most {MAX_RUNS:,} runs in one call, found {runs:,}: take fewer seeds or orders")


def plan(
    store: Store,
    dataset: Dataset,
    methods: Sequence[Method],
    orders: Sequence[int],
    seeds: Sequence[int],
    overrides: Settings,
    force: bool,
    retry: bool = False,
    dry: bool = False,
) -> Plan:
    """List the runs that are missing. Failed ones count as missing, diverged ones as results.

    So do those that timed out, took too much memory or crashed, unless they are to be tried again.

    A combination brings its members along: the seeds asked for, and those on disk with the same options, so
    that it never stands beside rows of more seeds than it was made of. It is made again when they change.

    Args:
        store: where they are kept.
        dataset: what is fitted.
        methods: which methods.
        orders: numbers of states n.
        seeds: of methods that have one.
        overrides: options by name, for every method that has them, or by 'METHOD.OPTION' for one.
        force: run again what is finished.
        retry: run again what has a status of `AGAIN`.
        dry: leave what is replaced where it is.

    Raises:
        InputError: an order or option is out of range, there are more than `MAX_RUNS`, or there are runs with
            other options, data or versions that must not be mixed with these.
    """
    check_count(len(set(orders)) * sum(len(seeds) if method.seeded else 1 for method in methods))
    found = store.read(touch=not dry)
    existing, faults = found.results, dict(found.faults)
    missing = ("failed", *AGAIN) if retry else ("failed",)
    finished = {r.spec.label: r for r in existing if r.status not in missing}
    data = dataset.fingerprint()
    if not force:
        existing = _without_strays(existing, lambda _: True, partial(_other_data, data), store, faults)
    todo: list[RunSpec] = []
    done: list[RunResult] = []

    def first(method: Method, order: int) -> RunSpec:
        # a combination is of runs with its members' options
        given = for_method(overrides, method.members, method.name)
        settings = method.settings(dataset.fitting, order, given)
        return RunSpec(store.dataset, store.protocol, method.name, order, 0, settings, data, version_of(method))

    members = [METHODS[method.members] for method in methods if method.members]
    methods = [*(method for method in members if method not in methods), *methods]
    for order in dict.fromkeys(orders):
        check_order(order, dataset.fitting)
        for method in methods:
            spec = first(method, order)
            if method.members:
                member = first(METHODS[method.members], order)
                own = [r for r in existing if (r.spec.method, r.spec.order) == (member.method, order)]
                kept = {r.spec.seed for r in own if not difference(member, r)}
                sound = [one for one in kept | set(seeds) if force or replace(member, seed=one).label not in faults]
                spec = replace(spec, settings=spec.settings | {"members": sorted(sound)})
                retrained = any((s.method, s.order) == (member.method, order) for s in todo)
                outdated = force or retrained or bool(conflict(spec, existing))
                chosen = [spec]
            else:
                outdated = force
                chosen = [replace(spec, seed=seed) for seed in (seeds if method.seeded else [0])]
                if not force:
                    existing = _without_strays(
                        existing, partial(_is_of, spec), partial(difference, spec), store, faults
                    )
                other = "" if force else conflict(spec, existing)
                if other:
                    apart = [r for r in existing if r.spec.data != data] if OTHER_DATA in other else []
                    changed = changed_data(store, apart[0], dataset) if apart else ""
                    raise InputError(
                        f"'{store.folder}' holds runs of {other}{f', here its {changed}' * bool(changed)}: "
                        "take another folder with --out, or --force to replace them"
                    )
            for one in chosen:
                if one.label in faults and not force:
                    continue
                if outdated or one.label not in finished:
                    todo.append(one)
                else:
                    done.append(finished[one.label])
    if force:
        replaced = {(spec.method, spec.order) for spec in todo}
        other = conflict(todo[0], [r for r in existing if (r.spec.method, r.spec.order) not in replaced])
        if other:
            raise InputError(
                f"'{store.folder}' holds runs of {other}, which this command does not replace: "
                "take another folder with --out, or remove it"
            )
    if force and not dry:
        _discard_replaced(store, todo, existing)
    replaced_labels = {spec.label for spec in todo}
    return Plan(todo, done, {label: line for label, line in faults.items() if label not in replaced_labels}, found)


def _discard_replaced(store: Store, todo: list[RunSpec], existing: list[RunResult]) -> None:
    """Forget old runs that differ from the new ones of their method and order: they must not mix."""
    new = {(spec.method, spec.order): spec for spec in todo}
    for result in existing:
        spec = new.get((result.spec.method, result.spec.order))
        if spec is not None and difference(spec, result):
            store.clear(result.spec)


def _is_of(spec: RunSpec, result: RunResult) -> bool:
    return (result.spec.method, result.spec.order) == (spec.method, spec.order)


def _other_data(data: str, result: RunResult) -> str:
    return "" if result.spec.data == data else OTHER_DATA


def _without_strays(
    existing: list[RunResult],
    kind: Callable[[RunResult], bool],
    differs: Callable[[RunResult], str],
    store: Store,
    faults: dict[str, str],
) -> list[RunResult]:
    """The runs without those of a kind that differ from what is asked for, where others of the kind do not.

    Those are added to `faults`. Where all of a kind differ, something else is asked for than there is.
    """
    own = [result for result in existing if kind(result)]
    reasons = {result.spec.label: reason for result in own if (reason := differs(result))}
    if len(reasons) == len(own):
        return existing
    for label, reason in reasons.items():
        folder = store.folder_of(label)
        faults[label] = f"'{folder}' holds a run with {reason}, unlike others there; remove it, or run it with --force"
    return [result for result in existing if result.spec.label not in reasons]


@few_threads()
def sweep(
    specs: Sequence[RunSpec],
    dataset: Dataset,
    store: Store,
    jobs: int,
    on_event: Callable[[Event], None],
    on_result: Callable[[RunResult], None],
    limits: Limits = NO_LIMITS,
    fail_fast: bool = False,
    scheduler: str = "",
) -> None:
    """Execute runs; each is on disk when `on_result` hears of it.

    Every run has its own seed and one thread, so the numbers do not depend on `jobs`. Another command on
    the same folder takes other runs; what it finishes counts here as well.

    Args:
        specs: which runs.
        dataset: what is fitted.
        store: where they are kept; what killed commands left there is removed.
        jobs: processes.
        on_event: hears of each run that starts, and of its epochs.
        on_result: hears of each result.
        limits: of a run.
        fail_fast: end with the first result that is not ok.
        scheduler: address of a Dask scheduler whose workers execute the runs, instead of processes here.

    Raises:
        KeyboardInterrupt: finished runs stay, the others are missing.
        InputError: results cannot be kept, or no process can be started.
    """
    store.tidy()
    if not specs:
        return
    tasks = [Task(spec) for spec in specs]
    before = {spec.label: store.stamp(spec) for spec in specs}
    combinations = [task for task in tasks if METHODS[task.spec.method].members]
    trained = [task for task in tasks if not METHODS[task.spec.method].members]
    executor: Executor
    if scheduler:
        from nnss_cli.experiment.cluster import Dask

        executor = Dask(scheduler, dataset, store, limits, on_event)
    elif limits == NO_LIMITS and (jobs == 1 or len(trained) <= 1):
        executor = Serial(dataset, store, on_event)
    else:
        executor = Processes(min(jobs, len(specs)), dataset, store, limits, on_event)
    try:
        # combinations are made of the others, which a cluster's workers do not have at hand
        last = Serial(dataset, store, on_event) if scheduler else executor
        for part, own in ((trained, executor), (combinations, last)):
            for result in results(part, own, dataset, store, before, on_event):
                on_result(result)
                if fail_fast and result.status != "ok":
                    return
    finally:
        executor.close()
