"""Runs on the workers of a Dask scheduler, which need share no file system with this machine.

A worker executes a run into a folder of its own and sends the folder's files back (remote.py); they are checked and
kept here. The dataset is a task of its own, by its fingerprint: it goes to the scheduler once,
from there to the workers, and survives any of them. Dask sends code and pickles: whoever reaches its scheduler can
execute anything.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import time
import uuid
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError
from nnss_cli.experiment.agreement import difference
from nnss_cli.experiment.executor import Event, Limits, Lost, Task
from nnss_cli.experiment.provenance import THREADS
from nnss_cli.experiment.remote import executed, given
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.plugins import in_use
from nnss_cli.version import __version__

if TYPE_CHECKING:
    from distributed import Future as DaskFuture

CONNECT = 10.0  # seconds until there must be a connection to the scheduler
COUNT = 2.0  # seconds between looks at how many workers there are
NOT_YET = ("pending", "lost")  # of Dask's states: lost with a worker, it will be pending
CLOSE = 2.0  # seconds that taking leave may take
GONE = "the finished runs are kept; the same command goes on from here"


@dataclass(frozen=True)
class _Running:
    """A run that a worker has."""

    task: Task
    """Which one."""
    files: DaskFuture
    """Its files, when it has ended."""
    future: Future[RunResult]
    """Its result, when they are kept."""
    since: float
    """When it was sent (time.monotonic)."""


class Dask:
    """A run for each worker of a scheduler; Dask gives those of a lost worker to another one."""

    def __init__(
        self, address: str, dataset: Dataset, store: Store, limits: Limits, on_event: Callable[[Event], None]
    ) -> None:
        try:
            from distributed import Client
        except ModuleNotFoundError as error:
            raise InputError(
                "--executor dask needs distributed, which is not installed: pip install 'nnss[dask]'"
            ) from error
        _silence()
        self._address, self._store, self._limits, self._on_event = address, store, limits, on_event
        self._running: dict[str, _Running] = {}
        self._again: set[str] = set()  # of these, whose files were lost after they were made
        self._inbox: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._counted, self._workers = -COUNT, 0
        self._topic = f"nnss-{uuid.uuid4().hex}"
        try:
            self._client = Client(address, timeout=CONNECT, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"--scheduler: no Dask scheduler answers at '{address}' ({' '.join(str(error).split())[:200]}): "
                "expected an address such as tcp://10.0.0.1:8786"
            ) from error
        self._client.subscribe_topic(self._topic, lambda event: self._inbox.put(("event", event[1])))
        self._data = self._client.submit(given, dataset, key=f"nnss-data-{dataset.fingerprint()}")

    @property
    def free(self) -> int:
        """Workers without a run of ours."""
        if time.monotonic() - self._counted > COUNT:
            with self._heard():
                self._workers = len(self._client.scheduler_info(n_workers=-1)["workers"])
            self._counted = time.monotonic()
        return max(0, self._workers - len(self._running))

    def submit(self, task: Task) -> Future[RunResult]:
        """Send a run to a worker."""
        key = f"{task.spec.label}-{uuid.uuid4().hex}"
        with self._heard():
            files = self._client.submit(
                executed, task, self._data, self._limits, in_use(), __version__, self._topic, _threads(),
                key=key, pure=False,
            )  # fmt: skip
        running = self._running[key] = _Running(task, files, Future(), time.monotonic())
        files.add_done_callback(lambda done: self._inbox.put(("done", done.key)))
        return running.future

    def wait(self, seconds: float) -> None:
        """Until a run has come back, or a worker is free."""
        deadline = time.monotonic() + seconds
        while True:
            try:
                what, content = self._inbox.get(timeout=min(COUNT, max(0.0, deadline - time.monotonic())) or 1e-3)
            except queue.Empty:
                self._require_scheduler()
                self._ask_again()
                if time.monotonic() >= deadline or self.free:
                    return
                continue
            if what == "done" and content in self._running:
                if self._end(content):
                    deadline = 0.0  # but take what has come with it
            elif what == "event" and (at := self._of(content["label"])) is not None:
                told = {name: content[name] for name in ("epoch", "val_rmse", "waits_for", "begun")}
                self._on_event(Event(at.task.spec, **told))

    def close(self) -> None:
        """Take leave. What workers are at ends by itself, and nobody hears of it."""
        with contextlib.suppress(Exception):  # whatever state the connection is in, it is given up
            self._client.cancel([running.files for running in self._running.values()], force=True)
        self._running.clear()
        with contextlib.suppress(Exception):
            self._client.close(timeout=CLOSE)

    def _end(self, key: str) -> bool:
        """End a run's future; not where its files went with their worker before they came, and are made again."""
        running = self._running[key]
        try:
            result = self._result(running)
        except (Lost, InputError) as error:
            running.future.set_exception(error)
        else:
            if result is None:
                self._again.add(key)
                return False
            running.future.set_result(result)
        del self._running[key]
        return True

    def _ask_again(self) -> None:
        """Dask calls back once: whether it has made files again must be asked for."""
        for key in [key for key in self._again if self._running[key].files.status not in NOT_YET]:
            self._again.remove(key)
            self._inbox.put(("done", key))

    def _result(self, running: _Running) -> RunResult | None:
        """Keep the files that came back; None if they have gone again.

        Raises:
            Lost: its workers were.
            InputError: it cannot be kept, the scheduler has gone, or a worker cannot execute runs.
        """
        task, files = running.task, running.files
        self._require_scheduler()
        if files.status in NOT_YET:
            return None
        if files.status == "cancelled":
            raise InputError(f"the scheduler at '{self._address}' dropped {task.spec.label}: {GONE}")
        with self._heard():
            try:
                error = files.exception(timeout=CONNECT) if files.status == "error" else None
                answer: Any = None if error is not None else files.result(timeout=CONNECT)
            except TimeoutError:
                if files.status in NOT_YET:
                    return None
                raise
        seconds = time.monotonic() - running.since
        if type(error).__name__ == "KilledWorker":
            raise Lost("crashed", f"its worker was lost {error.allowed_failures + 1} times", seconds)  # type: ignore[union-attr]
        if error is not None:
            raise InputError(
                f"a Dask worker cannot execute runs: {type(error).__name__}: {' '.join(str(error).split())[:300]}"
            )
        if isinstance(answer, str):
            raise InputError(f"a Dask worker cannot execute runs: {answer}")
        try:
            result = self._store.adopt(answer)
            apart = difference(task.spec, result)
        except ValueError as fault:
            raise Lost("crashed", f"it came back damaged: {fault}", seconds, again=True) from fault
        if apart:
            self._store.clear(task.spec)
            raise InputError(f"a Dask worker made a run with {apart}")
        return result

    def _of(self, label: str) -> _Running | None:
        return next((running for running in self._running.values() if running.task.spec.label == label), None)

    def _require_scheduler(self) -> None:
        if self._client.status != "running":
            raise InputError(f"the scheduler at '{self._address}' has gone: {GONE}")

    @contextlib.contextmanager
    def _heard(self) -> Any:
        """Say of a lost connection what it means."""
        self._require_scheduler()
        try:
            yield
        except (OSError, TimeoutError) as error:
            raise InputError(f"the scheduler at '{self._address}' does not answer: {GONE}") from error


def _silence() -> None:
    """What a lost connection means is told once, by us: not in the tracebacks of Dask's own log."""
    for name in list(logging.root.manager.loggerDict):
        if name.split(".")[0] == "distributed":
            logging.getLogger(name).setLevel(logging.CRITICAL)


def _threads() -> dict[str, str]:
    return {name: os.environ.get(name, "") for name in THREADS}
