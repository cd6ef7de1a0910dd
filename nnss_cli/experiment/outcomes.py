"""What becomes of tasks, whoever executes them: locks, second tries, and the results of those that were lost."""

from __future__ import annotations

import contextlib
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future

from nnss_cli.datasets.record import Dataset
from nnss_cli.experiment.agreement import difference
from nnss_cli.experiment.executor import Event, Executor, Lost, Task, keep_lost
from nnss_cli.experiment.index import Stamp
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.store import Store

POLL = 0.5  # seconds between looks at what another command is at
IDLE = 10.0  # seconds after which a wait is taken up again where nothing was heard
TRIES = 2  # of a run whose process is lost


def results(
    tasks: Sequence[Task], executor: Executor, dataset: Dataset, store: Store, before: Mapping[str, Stamp],
    on_event: Callable[[Event], None] = lambda _: None,
) -> Iterator[RunResult]:  # fmt: skip
    """The results of tasks as they come, whoever executes them; a run whose process is lost is tried once more.

    Args:
        tasks: which runs.
        executor: who executes them.
        dataset: what is fitted.
        store: where they are kept.
        before: stamps when the sweep began, by label, of finished runs that are to be replaced.
        on_event: hears of each run that another command is at, once.

    Raises:
        InputError: results cannot be kept, or the executor cannot go on.
    """
    ready, elsewhere = deque(tasks), deque[Task]()  # the latter: another command is at them
    running: dict[Future[RunResult], tuple[Task, contextlib.ExitStack]] = {}  # with their locks
    tries: Counter[str] = Counter()
    awaited: set[str] = set()
    looked = time.monotonic()
    try:
        while ready or elsewhere or running:
            if elsewhere and executor.free > len(ready) and time.monotonic() - looked > POLL:
                ready.extend(elsewhere)
                elsewhere.clear()
                looked = time.monotonic()
            while ready and executor.free:
                task, held = ready.popleft(), contextlib.ExitStack()
                if not held.enter_context(store.lock(task.spec)):
                    elsewhere.append(task)
                    if task.spec.label not in awaited:
                        awaited.add(task.spec.label)
                        on_event(Event(task.spec, waits_for="waits for another process that is at it", begun=False))
                    continue
                kept = _kept_meanwhile(task.spec, before.get(task.spec.label), store)
                if kept is None:
                    running[executor.submit(task)] = task, held
                else:
                    held.close()
                    yield kept
            if ready or elsewhere or running:
                executor.wait(POLL if elsewhere else IDLE)
            for future in [future for future in running if future.done()]:
                task, held = running.pop(future)
                with held:
                    try:
                        result = future.result()
                    except Lost as lost:
                        tries[task.spec.label] += 1
                        if lost.again and tries[task.spec.label] < TRIES:
                            ready.appendleft(task)
                            continue
                        # it may have been lost between its end and its telling
                        kept = _kept_meanwhile(task.spec, before.get(task.spec.label), store)
                        result = kept or keep_lost(task, lost, dataset, store)
                yield result
    except BaseException:
        executor.close()  # before anyone else may take what it was at
        raise
    finally:
        for _, held in running.values():
            held.close()


def _kept_meanwhile(spec: RunSpec, before: Stamp, store: Store) -> RunResult | None:
    """The result that was kept since the sweep began; None if there is none, or of other options."""
    if store.stamp(spec) == before:
        return None
    kept = store.find(spec)
    return kept if kept is not None and not difference(spec, kept) else None
