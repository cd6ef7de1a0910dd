"""Who executes runs: this process (`Serial`), or others (`processes`); what all of them do with one."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Protocol

from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError
from nnss_cli.experiment.agreement import difference
from nnss_cli.experiment.execute import execute, sentence
from nnss_cli.experiment.index import Stamp
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
    stamp: Stamp
    """Its run.json when the sweep began: another one since then is another command's result."""
    command: str = field(default_factory=command_line)
    """The command line that asks for it."""


@dataclass(frozen=True)
class Loss:
    """How a run ended that could not tell it itself."""

    status: Status
    """crashed, timeout or memory."""
    reason: str
    """In words."""
    seconds: float
    """For how long it had run."""
    final: bool = False
    """Whether it was tried again already."""


@dataclass(frozen=True)
class Outcome:
    """What came of a task: a result; or a loss; or neither, where another command is at it."""

    task: Task
    """Which one."""
    result: RunResult | None = None
    """What is on disk now."""
    loss: Loss | None = None
    """How its process ended."""


class Executor(Protocol):
    """Executes tasks side by side. Results are on disk when `wait` gives them."""

    @property
    def free(self) -> int:
        """How many tasks it takes at present."""
        ...

    def submit(self, task: Task) -> None:
        """Begin a task; only where one is `free`."""
        ...

    def wait(self, seconds: float) -> list[Outcome]:
        """What has ended, after at most about so many seconds.

        Raises:
            InputError: results cannot be stored, or no process can be started.
        """
        ...

    def close(self) -> None:
        """End at once whatever still runs."""
        ...


class Serial:
    """One task after the other, in this process."""

    def __init__(self, dataset: Dataset, store: Store, on_event: Callable[[Event], None]) -> None:
        self._dataset, self._store, self._on_event = dataset, store, on_event
        self._ended: list[Outcome] = []

    @property
    def free(self) -> int:
        """One, until its outcome was taken."""
        return 0 if self._ended else 1

    def submit(self, task: Task) -> None:
        """Execute a task to its end."""
        self._ended.append(Outcome(task, work(task, self._dataset, self._store, self._on_event)))

    def wait(self, seconds: float) -> list[Outcome]:
        """The outcome of the last task."""
        if not self._ended:
            time.sleep(seconds)
        ended, self._ended = self._ended, []
        return ended

    def close(self) -> None:
        """There is nothing to end."""


def work(task: Task, dataset: Dataset, store: Store, report: Callable[[Event], None]) -> RunResult | None:
    """Execute and keep a run, unless another command does so; None where that is still at it.

    A method that raises what is no numerical failure has a fault, which costs this run and no other.

    Raises:
        InputError: it cannot be kept, or a method cannot be prepared.
    """
    spec = task.spec
    with store.lock(spec) as held:
        if not held:
            return None
        if (kept := kept_meanwhile(task, store)) is not None:
            return kept
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
            return _write_loss(task, Loss("crashed", reason, time.perf_counter() - started), dataset, store)


def settle(task: Task, loss: Loss, dataset: Dataset, store: Store) -> RunResult | None:
    """Keep as a result that a run was lost; if its result is there all the same, that one. None as in `work`."""
    with store.lock(task.spec) as held:
        if not held:
            return None
        return kept_meanwhile(task, store) or _write_loss(task, loss, dataset, store)


def kept_meanwhile(task: Task, store: Store) -> RunResult | None:
    """The result that another command has kept since the sweep began; None if there is none, or of other options."""
    if store.stamp(task.spec) == task.stamp:
        return None
    kept = store.find(task.spec)
    return kept if kept is not None and not difference(task.spec, kept) else None


def _write_loss(task: Task, loss: Loss, dataset: Dataset, store: Store) -> RunResult:
    result = RunResult(
        task.spec, loss.status, loss.reason, (), 0, round(loss.seconds, 3), Watch().provenance(task.command), {},
        asdict(dataset.fitting.channels), dataset.notes,
    )  # fmt: skip
    store.clear(task.spec)
    store.write(result, {})
    return result
