"""Who executes runs: this process (`Serial`), or others (`processes`, `cluster`); what all of them do with one."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import execute, sentence
from nnss_cli.experiment.provenance import Watch, command_line
from nnss_cli.experiment.run import RunResult, RunSpec, Status
from nnss_cli.experiment.store import Store
from nnss_cli.iterative import waits_told
from nnss_cli.methods import METHODS


@dataclass(frozen=True)
class Event:
    """A sign of life of a running fit."""

    spec: RunSpec
    """Which run."""
    epoch: int = 0
    """Epoch just finished; 0 when the run starts."""
    val_rmse: float | None = None
    """Validation error of that epoch, normalised units."""
    waits_for: str = ""
    """What it is at while there is no epoch to show, in words."""
    begun: bool = True
    """Whether its fit has begun, and so its time is counted."""


@dataclass(frozen=True)
class Task:
    """A run to be done."""

    spec: RunSpec
    """Which one."""
    command: str = field(default_factory=command_line)
    """The command line that asks for it."""


class Lost(Exception):
    """A run that could not tell itself how it ended."""

    def __init__(self, status: Status, reason: str, seconds: float, again: bool = False) -> None:
        """Its status, the reason in words, for how long it had run, whether it is worth another try."""
        super().__init__(reason)
        self.status, self.reason, self.seconds, self.again = status, reason, seconds, again


@dataclass(frozen=True)
class Limits:
    """What a run may take; None for as much as there is."""

    seconds: float | None = None
    """Wall time from the start of its fit."""
    bytes: float | None = None
    """Memory of its process, libraries included."""

    def __post_init__(self) -> None:
        """Refuse what nothing can keep to.

        Raises:
            InputError: a limit is not a positive number.
        """
        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise InputError(f"--time-limit: expected a positive number of seconds, found {self.seconds:g}")
        if self.bytes is not None and not 0 < self.bytes < math.inf:
            raise InputError(f"--memory-limit: expected a positive number of GB, found {self.bytes / 1e9:g}")

    def require_supported(self) -> None:
        """Refuse a limit of memory where nothing tells what a process holds.

        Raises:
            InputError: this machine, which is to execute the runs, has no /proc.
        """
        if self.bytes is not None and not Path("/proc/self/statm").exists():
            raise InputError("--memory-limit: expected a system with /proc (Linux), found none: leave it out")


NO_LIMITS = Limits()


class Executor(Protocol):
    """Executes tasks side by side. Futures end, and events are heard, within `wait`: so in the caller's thread."""

    @property
    def free(self) -> int:
        """How many tasks it takes at present."""
        ...

    def submit(self, task: Task) -> Future[RunResult]:
        """Begin a task whose lock the caller holds; only where one is `free`.

        Returns:
            What ends with the result, which is on disk then; with `Lost`; or with InputError, where results
            cannot be kept or a method not be prepared, so that the next one will not do better.
        """
        ...

    def wait(self, seconds: float) -> None:
        """Until a future has ended, or for about so many seconds at most.

        Raises:
            InputError: no process can be started, or the scheduler has gone.
        """
        ...

    def close(self) -> None:
        """End at once whatever still runs; its futures end no more."""
        ...


def seldom(tell: Callable[[Event], None], apart: float) -> Callable[[Event], None]:
    """`tell` without the epochs that come sooner than `apart` seconds after what was told last.

    To send, hear and show one takes a millisecond or two, of a core that another run could have.
    """
    told = -math.inf

    def passed(event: Event) -> None:
        nonlocal told
        if event.epoch == 0 or time.monotonic() - told > apart:
            told = time.monotonic()
            tell(event)

    return passed


class Serial:
    """One task after the other, in this process."""

    def __init__(self, dataset: Dataset, store: Store, on_event: Callable[[Event], None]) -> None:
        self._dataset, self._store, self._on_event = dataset, store, on_event
        self._next: tuple[Task, Future[RunResult]] | None = None

    @property
    def free(self) -> int:
        """One, unless it waits to be executed."""
        return int(self._next is None)

    def submit(self, task: Task) -> Future[RunResult]:
        """Keep a task for `wait`."""
        future: Future[RunResult] = Future()
        self._next = task, future
        return future

    def wait(self, seconds: float) -> None:
        """Execute the task, however long that takes."""
        if self._next is None:
            time.sleep(seconds)
            return
        (task, future), self._next = self._next, None
        try:
            future.set_result(work(task, self._dataset, self._store, self._on_event))
        except Exception as error:
            future.set_exception(error)

    def close(self) -> None:
        """There is nothing to end."""


def work(task: Task, dataset: Dataset, store: Store, report: Callable[[Event], None]) -> RunResult:
    """Execute and keep a run.

    A method that raises what is no numerical failure has a fault, which costs this run and no other.

    Raises:
        InputError: it cannot be kept, or a method cannot be prepared.
    """
    spec = task.spec
    report(Event(spec, waits_for="compiling", begun=False))
    METHODS[spec.method].prepare(spec.settings)
    report(Event(spec))
    started = time.perf_counter()
    try:
        with waits_told(lambda what: report(Event(spec, waits_for=what))):
            return execute(
                spec, dataset, store, lambda epoch, _, val: report(Event(spec, epoch, val)), command=task.command
            )
    except InputError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {sentence(error)}"
        return keep_lost(task, Lost("crashed", reason, time.perf_counter() - started), dataset, store)


def keep_lost(task: Task, lost: Lost, dataset: Dataset, store: Store) -> RunResult:
    """Keep as a result that a run was lost."""
    result = RunResult(
        task.spec, lost.status, lost.reason, (), 0, round(lost.seconds, 3), Watch().provenance(task.command), {},
        asdict(dataset.fitting.channels), dataset.notes, title=dataset.title,
    )  # fmt: skip
    store.clear(task.spec)
    store.write(result, {})
    return result
