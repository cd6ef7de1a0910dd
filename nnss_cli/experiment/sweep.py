"""Many runs: which are missing, and executing them in one process or several."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from multiprocessing.queues import SimpleQueue
from typing import Any

from nnss_cli.datasets.record import Dataset, FittingData
from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import LIBRARIES, execute, provenance
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.store import Store
from nnss_cli.methods import METHODS, Method, Settings, version_of
from nnss_cli.methods.options import for_method
from nnss_cli.plugins import Source, in_use, use


@dataclass(frozen=True)
class Plan:
    """What a sweep has to do."""

    todo: list[RunSpec]
    """Runs to execute."""
    done: list[RunResult]
    """Runs that were asked for and are finished already."""

    def made_elsewhere(self) -> list[str]:
        """A line for each library whose version was another one when a finished run was made, and for the machine."""
        here = provenance()
        lines = []
        for name in (*LIBRARIES, "python", "machine"):
            others = Counter(made for r in self.done if (made := r.provenance.get(name, "unknown")) != here[name])
            lines += [
                f"{count} of the finished runs: {name} {made}, here {here[name]}" for made, count in others.items()
            ]
        return lines


@dataclass(frozen=True)
class Event:
    """A sign of life of a running fit."""

    spec: RunSpec
    """Which run."""
    epoch: int = 0
    """Epoch just finished; 0 when the run starts."""
    val_rmse: float | None = None
    """Validation error of that epoch, normalised units."""


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


def plan(
    store: Store,
    dataset: Dataset,
    methods: Sequence[Method],
    orders: Sequence[int],
    seeds: Sequence[int],
    overrides: Settings,
    force: bool,
) -> Plan:
    """List the runs that are missing. Failed ones count as missing, diverged ones as results.

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

    Raises:
        InputError: an order or option is out of range, or there are runs with other options, data or versions
            that must not be mixed with these.
    """
    existing = store.results()
    finished = {r.spec.label: r for r in existing if r.status != "failed"}
    data = dataset.fingerprint()
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
                kept = {r.spec.seed for r in own if not store.conflict(member, [r])}
                spec = replace(spec, settings=spec.settings | {"members": sorted(kept | set(seeds))})
                retrained = any((s.method, s.order) == (member.method, order) for s in todo)
                outdated = force or retrained or bool(store.conflict(spec, existing))
                chosen = [spec]
            else:
                outdated = force
                chosen = [replace(spec, seed=seed) for seed in (seeds if method.seeded else [0])]
                difference = "" if force else store.conflict(spec, existing)
                if difference:
                    raise InputError(
                        f"'{store.folder}' holds runs of {difference}: "
                        "take another folder with --out, or --force to replace them"
                    )
            for one in chosen:
                if outdated or one.label not in finished:
                    todo.append(one)
                else:
                    done.append(finished[one.label])
    if force:
        replaced = {(spec.method, spec.order) for spec in todo}
        difference = store.conflict(todo[0], [r for r in existing if (r.spec.method, r.spec.order) not in replaced])
        if difference:
            raise InputError(
                f"'{store.folder}' holds runs of {difference}, which this command does not replace: "
                "take another folder with --out, or remove it"
            )
        _discard_replaced(store, todo, existing)
    return Plan(todo, done)


def _discard_replaced(store: Store, todo: list[RunSpec], existing: list[RunResult]) -> None:
    """Forget old runs that differ from the new ones of their method and order: they must not mix."""
    for result in existing:
        same = [s for s in todo if (s.method, s.order) == (result.spec.method, result.spec.order)]
        if same and store.conflict(same[0], [result]):
            store.clear(result.spec)


def sweep(
    specs: Sequence[RunSpec],
    dataset: Dataset,
    store: Store,
    jobs: int,
    on_event: Callable[[Event], None],
    on_result: Callable[[RunResult], None],
) -> None:
    """Execute runs; each is on disk when `on_result` hears of it.

    Every run has its own seed and one thread, so the numbers do not depend on `jobs`.

    Raises:
        KeyboardInterrupt: finished runs stay, the others are missing.
        InputError: a worker process was killed from outside.
    """
    combinations = [spec for spec in specs if METHODS[spec.method].members]
    trained = [spec for spec in specs if spec not in combinations]
    if jobs == 1 or len(trained) <= 1:
        for spec in trained:
            on_result(_reported(spec, dataset, store, on_event))
    else:
        _side_by_side(trained, dataset, store, jobs, on_event, on_result)
    for spec in combinations:
        on_result(_reported(spec, dataset, store, on_event))


def _side_by_side(
    specs: Sequence[RunSpec],
    dataset: Dataset,
    store: Store,
    jobs: int,
    on_event: Callable[[Event], None],
    on_result: Callable[[RunResult], None],
) -> None:
    for spec in specs:  # compile here: the workers then find it on disk
        METHODS[spec.method].prepare(spec.settings)
    context = multiprocessing.get_context("spawn")
    events: SimpleQueue[Event | None] = context.SimpleQueue()
    listener = threading.Thread(target=_listen, args=(events, on_event), daemon=True)
    listener.start()
    pool = ProcessPoolExecutor(min(jobs, len(specs)), context, initializer=_start_worker, initargs=(events, in_use()))
    try:
        pending = {pool.submit(_work, spec, dataset, store) for spec in specs}
        while pending:
            finished, pending = wait(pending, return_when=FIRST_COMPLETED)
            for future in finished:
                on_result(future.result())
    except BrokenProcessPool as error:
        raise InputError(
            "a worker process was killed (out of memory?): the finished runs are kept; "
            "call the same command again with a smaller --jobs"
        ) from error
    finally:
        # Also on Ctrl-C: no fit goes on in the background. A run cut short has no run.json.
        pool.shutdown(wait=False, cancel_futures=True)
        for child in multiprocessing.active_children():
            child.terminate()
        events.put(None)
        listener.join(timeout=5)


def _reported(spec: RunSpec, dataset: Dataset, store: Store, report: Callable[[Event], None]) -> RunResult:
    report(Event(spec))
    return execute(spec, dataset, store, lambda epoch, _, val: report(Event(spec, epoch, val)))


def _listen(events: SimpleQueue[Any], on_event: Callable[[Event], None]) -> None:
    while (event := events.get()) is not None:
        on_event(event)


_events: SimpleQueue[Any]  # of a worker process


def _start_worker(events: SimpleQueue[Any], plugins: tuple[Source, ...]) -> None:
    global _events
    _events = events
    use(plugins)
    # Ctrl-C reaches the whole group: a worker just ends, the parent tells the user.
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _work(spec: RunSpec, dataset: Dataset, store: Store) -> RunResult:
    return _reported(spec, dataset, store, _events.put)
