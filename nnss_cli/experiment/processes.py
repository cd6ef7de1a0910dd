"""Runs in worker processes of this machine.

No state waits for something that is gone: the parent waits for messages and for the ends of processes at
once; a worker ends when its parent does, also by kill -9; whatever is killed has written its files atomically.
"""

from __future__ import annotations

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeAlias

from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError
from nnss_cli.experiment.executor import Event, Limits, Lost, Task, seldom, work
from nnss_cli.experiment.interrupt import SIGNALS, deferred
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.plugins import Source, in_use, use

MEMORY_POLL = 0.02  # seconds between looks at what a worker holds
CHATTER = 0.2  # seconds between epochs that a worker tells
FALSE_STARTS = 3  # workers in a row that end before they begin
PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Ready:
    """A worker has started."""


@dataclass(frozen=True)
class Done:
    """A worker's task has ended."""

    result: RunResult


@dataclass(frozen=True)
class Refused:
    """A worker's task cannot be kept or prepared, and the next one will not be either."""

    message: str


Message: TypeAlias = Ready | Event | Done | Refused


class _Worker:
    """A worker process as its parent sees it."""

    def __init__(self, process: BaseProcess, connection: Connection[Any, Any]) -> None:
        self.process, self.connection = process, connection
        self.ready = False  # it has started
        self.future: Future[RunResult] | None = None  # of its task
        self.since: float | None = None  # when its task began to fit (time.monotonic)
        self.messages: list[Message] = []  # not heard yet
        self.ended = False  # it will send no more

    def read(self) -> None:
        """Take in what it has sent."""
        try:
            while self.connection.poll():
                self.messages.append(self.connection.recv())
        except (EOFError, OSError):
            self.ended = True

    def kill(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()

    def seconds(self) -> float:
        return 0.0 if self.since is None else time.monotonic() - self.since


class Processes:
    """A worker process for each task that runs; one that is lost is replaced."""

    def __init__(
        self, jobs: int, dataset: Dataset, store: Store, limits: Limits, on_event: Callable[[Event], None]
    ) -> None:
        self._dataset, self._store, self._limits, self._on_event = dataset, store, limits, on_event
        self._workers: list[_Worker] = []
        self._false_starts = 0
        limits.require_supported()
        try:
            for _ in range(jobs):
                self._start()
        except BaseException:
            self.close()
            raise

    @property
    def free(self) -> int:
        """Workers without a task."""
        return sum(worker.ready and worker.future is None for worker in self._workers)

    def submit(self, task: Task) -> Future[RunResult]:
        """Send a task to a free worker."""
        worker = next(worker for worker in self._workers if worker.ready and worker.future is None)
        worker.future, worker.since = Future(), None
        _send(worker, task)
        return worker.future

    def wait(self, seconds: float) -> None:
        """Until a worker tells or ends; processes that have gone are replaced."""
        waited_for = [thing for worker in self._workers for thing in (worker.connection, worker.process.sentinel)]
        wait(waited_for, self._patience(seconds))
        for worker in list(self._workers):
            gone = not worker.process.is_alive()  # before reading: what it sent before its end is there then
            worker.read()
            self._hear(worker)
            lost = self._lost(worker, gone)
            if lost is not None:
                self._replace(worker)
                if worker.future is not None:
                    worker.future.set_exception(lost)

    def close(self) -> None:
        """Kill the workers."""
        with deferred():
            while self._workers:
                self._workers.pop().kill()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_main, args=(theirs, os.getpid()), daemon=True)
        # no signal between the start and its record; none kills the worker before it minds its parent
        with deferred(), _blocked(), _no_daemon():
            process.start()
            self._workers.append(_Worker(process, ours))
            theirs.close()  # the worker's end is the worker's alone: it closes with it

    def _replace(self, worker: _Worker) -> None:
        """Another worker in place of one that has gone, or has to."""
        with deferred():
            self._workers.remove(worker)
            worker.kill()
        if not worker.ready:
            self._false_starts += 1
            if self._false_starts >= FALSE_STARTS:
                raise InputError(
                    f"worker processes end before they begin ({_end_of(worker.process)}): the finished runs are kept; "
                    "call the same command again with a smaller --jobs"
                )
        self._start()

    def _hear(self, worker: _Worker) -> None:
        messages, worker.messages = worker.messages, []
        for message in messages:
            match message:
                case Ready():
                    worker.ready, self._false_starts = True, 0
                    _send(worker, (in_use(), self._dataset, self._store))
                case Event():
                    if message.begun:
                        worker.since = worker.since or time.monotonic()
                    self._on_event(message)
                case Done() if worker.future is not None:
                    worker.future.set_result(message.result)
                    worker.future = None
                case Refused() if worker.future is not None:
                    worker.future.set_exception(InputError(message.message))
                    worker.future = None

    def _lost(self, worker: _Worker, gone: bool) -> Lost | None:
        """Why a worker is no more, or may not go on."""
        if gone or worker.ended:
            worker.process.join(1.0)
            return Lost("crashed", f"its process ended twice ({_end_of(worker.process)})", worker.seconds(), again=True)
        if worker.future is None or worker.since is None:
            return None
        limit = self._limits.seconds
        if limit is not None and worker.seconds() > limit:
            return Lost("timeout", f"took longer than the {limit:g} s of --time-limit", worker.seconds())
        held = self._limits.bytes and _resident(worker.process.pid)
        if held and self._limits.bytes and held > self._limits.bytes:
            allowed = f"{self._limits.bytes / 1e9:g} of --memory-limit"
            return Lost("memory", f"its process held {held / 1e9:.2f} GB, more than the {allowed}", worker.seconds())
        return None

    def _patience(self, seconds: float) -> float:
        running = [worker for worker in self._workers if worker.future is not None]
        if running and self._limits.bytes is not None:
            seconds = min(seconds, MEMORY_POLL)
        if self._limits.seconds is not None:
            left = [self._limits.seconds - worker.seconds() for worker in running if worker.since is not None]
            seconds = min([seconds, *(max(0.0, one) + 0.001 for one in left)])
        return seconds


def _send(worker: _Worker, message: Any) -> None:
    with contextlib.suppress(OSError):  # it has gone: `wait` sees that
        worker.connection.send(message)


@contextlib.contextmanager
def _blocked() -> Any:
    """A process that is started within has `SIGNALS` blocked."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # the first start of a process starts it, and that lifts the block
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _no_daemon() -> Any:
    """Let a daemon of multiprocessing, as a Dask worker under its nanny is, start a process.

    It may not, since it is ended without a chance to end its own; ours see to that themselves (`_end_with`).
    """
    config = getattr(multiprocessing.current_process(), "_config", {})
    daemon = config.pop("daemon", None)
    try:
        yield
    finally:
        if daemon is not None:
            config["daemon"] = daemon


def _end_of(process: BaseProcess) -> str:
    """How a process ended, in words."""
    code = process.exitcode
    if code is None or code >= 0:
        return f"exit code {code}"
    name = signal.Signals(-code).name
    return f"{name}: out of memory, or killed by hand" if name == "SIGKILL" else name


def _resident(pid: int | None) -> int:
    """Bytes of memory that a process holds; 0 for one that has gone."""
    try:
        return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


def _main(connection: Connection[Any, Any], parent: int) -> None:
    """A worker: one task after the other, until it is killed or its parent has gone."""
    _end_with(parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent ends its workers
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    with contextlib.suppress(EOFError, OSError):
        connection.send(Ready())
        plugins, dataset, store = connection.recv()
        while True:
            connection.send(_answer(connection.recv(), plugins, dataset, store, lambda event: _tell(connection, event)))


def _tell(connection: Connection[Any, Any], event: Event) -> None:
    try:
        connection.send(event)
    except OSError:
        os._exit(1)  # nobody hears it: this is no fault of the run, which must not be kept as one


def _answer(
    task: Task, plugins: tuple[Source, ...], dataset: Dataset, store: Store, send: Callable[[Event], None]
) -> Done | Refused:
    try:
        if in_use() != plugins:
            use(plugins)
        return Done(work(task, dataset, store, seldom(send, CHATTER)))
    except InputError as error:
        return Refused(str(error))


def _end_with(parent: int) -> None:
    """End this process when its parent ends, whatever either is doing."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(1)
    threading.Thread(target=_watch_parent, daemon=True).start()


def _watch_parent() -> None:
    process = multiprocessing.parent_process()
    if process is not None:
        process.join()
        os._exit(1)
