"""Runs on the workers of a Dask scheduler, which need share no file system with this machine.

A worker executes a run into a folder of its own and sends the folder's files back (remote.py); they are checked and
kept here, under the run's lock. The dataset is a task of its own, by its fingerprint: it goes to the scheduler once,
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
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError
from nnss_cli.experiment.agreement import difference
from nnss_cli.experiment.executor import Event, Loss, Outcome, Task, kept_meanwhile
from nnss_cli.experiment.provenance import THREADS
from nnss_cli.experiment.remote import executed, given
from nnss_cli.experiment.store import Store
from nnss_cli.plugins import in_use
from nnss_cli.version import __version__

if TYPE_CHECKING:
    from distributed import Future

CONNECT = 10.0  # seconds until there must be a connection to the scheduler
COUNT = 2.0  # seconds between looks at how many workers there are
CLOSE = 2.0  # seconds that taking leave may take
GONE = "the finished runs are kept; the same command goes on from here"


@dataclass(frozen=True)
class _Running:
    """A run that a worker has."""

    task: Task
    """Which one."""
    future: Future
    """Its files, when it has ended."""
    held: contextlib.ExitStack
    """Its lock."""
    since: float
    """When it was sent (time.monotonic)."""


class Dask:
    """A run for each worker of a scheduler; Dask gives those of a lost worker to another one."""

    def __init__(self, address: str, dataset: Dataset, store: Store, on_event: Callable[[Event], None]) -> None:
        try:
            from distributed import Client
        except ModuleNotFoundError as error:
            raise InputError(
                "--executor dask needs distributed, which is not installed: pip install 'nnss[dask]'"
            ) from error
        _silence()
        self._address, self._store, self._on_event = address, store, on_event
        self._running: dict[str, _Running] = {}
        self._ended: list[Outcome] = []
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
        return max(0, self._workers - len(self._running) - len(self._ended))

    def submit(self, task: Task) -> None:
        """Send a run to a worker, unless another command is at it or has done it."""
        held = contextlib.ExitStack()
        if not held.enter_context(self._store.lock(task.spec)):
            held.close()
            self._ended.append(Outcome(task))
            return
        if (kept := kept_meanwhile(task, self._store)) is not None:
            held.close()
            self._ended.append(Outcome(task, kept))
            return
        key = f"{task.spec.label}-{uuid.uuid4().hex}"
        with self._heard():
            future = self._client.submit(
                executed,
                replace(task, stamp=None),
                self._data,
                in_use(),
                __version__,
                self._topic,
                _threads(),
                key=key,
                pure=False,
            )
        self._running[key] = _Running(task, future, held, time.monotonic())
        future.add_done_callback(lambda done: self._inbox.put(("done", done.key)))

    def wait(self, seconds: float) -> list[Outcome]:
        """What has ended.

        Raises:
            InputError: results cannot be stored, the scheduler has gone, or a worker cannot execute runs.
        """
        ended, self._ended = self._ended, []
        deadline = time.monotonic() + (0.0 if ended else seconds)
        while True:
            try:
                what, content = self._inbox.get(timeout=min(COUNT, max(0.0, deadline - time.monotonic())) or 1e-3)
            except queue.Empty:
                self._require_scheduler()
                if time.monotonic() >= deadline or self.free:
                    return ended
                continue
            if what == "done" and content in self._running:
                ended.append(self._outcome(self._running.pop(content)))
                deadline = 0.0  # but take what has come with it
            elif what == "event" and (running := self._of(content["label"])) is not None:
                told = {name: content[name] for name in ("epoch", "val_rmse", "waits_for", "begun")}
                self._on_event(Event(running.task.spec, **told))

    def close(self) -> None:
        """Take leave. What workers are at ends by itself, and nobody hears of it."""
        for running in self._running.values():
            running.held.close()
        with contextlib.suppress(Exception):  # whatever state the connection is in, it is given up
            self._client.cancel([running.future for running in self._running.values()], force=True)
        self._running.clear()
        with contextlib.suppress(Exception):
            self._client.close(timeout=CLOSE)

    def _outcome(self, running: _Running) -> Outcome:
        task, future = running.task, running.future
        with running.held:
            self._require_scheduler()
            if future.status in ("cancelled", "lost"):
                raise InputError(f"the scheduler at '{self._address}' dropped {task.spec.label}: {GONE}")
            with self._heard():
                error = future.exception(timeout=CONNECT) if future.status == "error" else None
                answer: Any = None if error is not None else future.result(timeout=CONNECT)
            seconds = time.monotonic() - running.since
            if type(error).__name__ == "KilledWorker":
                reason = f"its worker was lost {error.allowed_failures + 1} times"  # type: ignore[union-attr]
                return Outcome(task, loss=Loss("crashed", reason, seconds, final=True))
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
                return Outcome(task, loss=Loss("crashed", f"it came back damaged: {fault}", seconds))
            if apart:
                self._store.clear(task.spec)
                raise InputError(f"a Dask worker made a run with {apart}")
            return Outcome(task, result)

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
