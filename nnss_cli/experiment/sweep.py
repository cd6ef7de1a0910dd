"""Many runs: which are missing, and executing them in one process or several."""

from __future__ import annotations

import multiprocessing
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.queues import SimpleQueue
from typing import Any

from nnss_cli.datasets.record import Dataset, FittingData
from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.store import Store
from nnss_cli.methods import METHODS, Ensemble, Method, Settings


@dataclass(frozen=True)
class Plan:
    """What a sweep has to do."""

    todo: list[RunSpec]
    """Runs to execute."""
    done: int
    """Runs that were asked for and are finished already."""


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

    An ensemble brings its members along, and is made again when they change.

    Raises:
        InputError: an order or option is out of range, or there are runs with other options that
            must not be mixed with these.
    """
    existing = store.results()
    finished = {r.spec.label: r for r in existing if r.status != "failed"}
    data = dataset.fingerprint()
    todo: list[RunSpec] = []
    done = 0
    members = [METHODS[method.of] for method in methods if isinstance(method, Ensemble)]
    methods = [*(method for method in members if method not in methods), *methods]
    for order in dict.fromkeys(orders):
        check_order(order, dataset.fitting)
        for method in methods:
            settings = method.settings(dataset.fitting, order, overrides)
            if isinstance(method, Ensemble):
                ensemble = settings | {"members": list(seeds)}
                spec = RunSpec(store.dataset, store.protocol, method.name, order, 0, ensemble, data)
                retrained = any((s.method, s.order) == (method.of, order) for s in todo)
                if force or retrained or spec.label not in finished or store.conflict(spec, existing):
                    todo.append(spec)
                else:
                    done += 1
                continue
            for seed in seeds if method.seeded else [0]:
                spec = RunSpec(store.dataset, store.protocol, method.name, order, seed, settings, data)
                if force:
                    todo.append(spec)
                    continue
                difference = store.conflict(spec, existing)
                if difference:
                    raise InputError(
                        f"'{store.folder}' holds runs of {method.name}, order {order}, with {difference}: "
                        "take another folder with --out, or --force to replace them"
                    )
                if spec.label in finished:
                    done += 1
                else:
                    todo.append(spec)
    if force:
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
    ensembles = [spec for spec in specs if isinstance(METHODS[spec.method], Ensemble)]
    trained = [spec for spec in specs if spec not in ensembles]
    if jobs == 1 or len(trained) <= 1:
        for spec in trained:
            on_result(_reported(spec, dataset, store, on_event))
    else:
        _side_by_side(trained, dataset, store, jobs, on_event, on_result)
    for spec in ensembles:
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
    pool = ProcessPoolExecutor(min(jobs, len(specs)), context, initializer=_start_worker, initargs=(events,))
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


def _start_worker(events: SimpleQueue[Any]) -> None:
    global _events
    _events = events
    # Ctrl-C reaches the whole group: a worker just ends, the parent tells the user.
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def _work(spec: RunSpec, dataset: Dataset, store: Store) -> RunResult:
    return _reported(spec, dataset, store, _events.put)
