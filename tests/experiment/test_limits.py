"""What a run may take, how its loss is told and how often it is tried, without a process being started."""

import contextlib
import itertools
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from nnss_cli.datasets.record import Channels

from nnss_cli.errors import InputError
from nnss_cli.experiment import outcomes, processes
from nnss_cli.experiment.estimate import DAY, OVERHEAD, amount, duration, estimate
from nnss_cli.experiment.executor import Limits, Lost, Task
from nnss_cli.experiment.processes import Processes
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.sweep import check_count
from nnss_cli.version import __version__

SPEC = RunSpec("tank", "strict", "nnss", 2, 0, {"epochs": 10}, "0", "1")


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"seconds": 0.0}, "--time-limit: expected a positive number of seconds, found 0"),
        ({"seconds": -1.5}, "--time-limit: expected a positive number of seconds, found -1.5"),
        ({"seconds": float("nan")}, "--time-limit: expected a positive number of seconds, found nan"),
        ({"seconds": float("inf")}, "--time-limit: expected a positive number of seconds, found inf"),
        ({"bytes": float("nan")}, "--memory-limit: expected a positive number of GB, found nan"),
        ({"bytes": float("inf")}, "--memory-limit: expected a positive number of GB, found inf"),
        ({"bytes": 0}, "--memory-limit: expected a positive number of GB, found 0"),
        ({"bytes": -2_500_000_000}, "--memory-limit: expected a positive number of GB, found -2.5"),
    ],
)
def test_a_limit_that_nothing_can_keep_to_is_refused(limits: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError) as error:
        Limits(**limits)
    assert str(error.value) == said
    assert Limits(1e-9, 1) == Limits(seconds=1e-9, bytes=1)


class Process:
    """What a worker's parent asks of its process."""

    pid = 1

    def __init__(self, exitcode: int | None = None) -> None:
        self.exitcode = exitcode

    def join(self, timeout: float) -> None:
        pass


def worker(seconds: float | None = None, exitcode: int | None = None, task: bool = True) -> Any:
    made = processes._Worker(Process(exitcode), None)  # type: ignore[arg-type]
    made.future = Future() if task else None
    made.since = None if seconds is None else 100.0 - seconds
    return made


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> Any:
    """An executor of these limits without workers, at the time 100 s, where a process holds 2.5 GB."""
    monkeypatch.setattr(processes.time, "monotonic", lambda: 100.0)
    monkeypatch.setattr(processes, "_resident", lambda _: 2_500_000_000)
    return lambda **limits: Processes(0, None, None, Limits(**limits), lambda _: None)  # type: ignore[arg-type]


def told(lost: Lost | None) -> tuple[str, str, float, bool] | None:
    """Its status, reason and time, and whether it is worth another try."""
    return None if lost is None else (lost.status, lost.reason, lost.seconds, lost.again)


def test_a_run_is_lost_when_it_goes_beyond_a_limit_and_not_before(limited: Any) -> None:
    ten = limited(seconds=10)
    assert ten._lost(worker(10.0), False) is None
    assert told(ten._lost(worker(10.5), False)) == ("timeout", "took longer than the 10 s of --time-limit", 10.5, False)
    assert ten._lost(worker(), False) is None, "it has not begun to fit"
    assert ten._lost(worker(99.0, task=False), False) is None, "it has nothing to do"
    held = limited(bytes=2_000_000_000)._lost(worker(3.0), False)
    assert told(held) == ("memory", "its process held 2.50 GB, more than the 2 of --memory-limit", 3.0, False)
    assert limited(bytes=2_500_000_000)._lost(worker(3.0), False) is None
    assert limited()._lost(worker(1e9), False) is None


@pytest.mark.parametrize(
    ("code", "said"),
    [
        (-signal.SIGKILL, "SIGKILL: out of memory, or killed by hand"), (-signal.SIGSEGV, "SIGSEGV"),
        (0, "exit code 0"), (3, "exit code 3"), (None, "exit code None"),
    ],
)  # fmt: skip
def test_a_process_that_is_gone_tells_how_it_ended(code: int | None, said: str, limited: Any) -> None:
    expected = ("crashed", f"its process ended twice ({said})", 2.0, True)
    assert told(limited()._lost(worker(2.0, code), True)) == expected
    ended = worker(2.0, code)
    ended.ended = True
    assert told(limited()._lost(ended, False)) == expected


def test_the_parent_looks_again_when_a_limit_may_be_reached(limited: Any) -> None:
    def patience(*workers: Any, **limits: Any) -> float:
        executor = limited(**limits)
        executor._workers = list(workers)
        found = executor._patience(5.0)
        executor._workers = []
        return float(found)

    assert patience(worker(3.0)) == 5.0
    assert patience(worker(3.0), bytes=1) == processes.MEMORY_POLL < 0.1
    assert patience(worker(3.0, task=False), bytes=1) == 5.0
    assert patience(worker(3.0), worker(6.0), seconds=8) == pytest.approx(2, abs=0.01)
    assert patience(worker(3.0), seconds=8) == pytest.approx(5, abs=0.01)
    assert 0 < patience(worker(9.0), seconds=8) < 0.01
    assert patience(worker(), seconds=8) == 5.0


class Scripted:
    """An executor of one place whose outcomes are given: 'ok', or the status of a loss, with '…' for another try."""

    def __init__(self, outcomes: Sequence[str]) -> None:
        self.outcomes, self.running, self.submitted = iter(outcomes), [], 0
        self.folder: Folder | None = None

    @property
    def free(self) -> int:
        return 1 - len(self.running)

    def submit(self, task: Task) -> Future[RunResult]:
        assert self.free
        assert self.folder is not None
        assert self.folder.locked == 1, "the run is not this command's"
        self.submitted += 1
        self.running.append((task, Future()))
        return self.running[-1][1]

    def wait(self, seconds: float) -> None:
        if self.running:
            (task, future), what = self.running.pop(), next(self.outcomes)
            if what == "ok":
                future.set_result(result(task.spec, "ok"))
            else:
                future.set_exception(Lost(what.rstrip("…"), "why", 1.0, what.endswith("…")))  # type: ignore[arg-type]

    def close(self) -> None:
        pass


class Folder:
    """A store whose runs' locks other commands hold at first, so many times; it keeps what it is told to."""

    def __init__(self, held: int = 0, meanwhile: RunResult | None = None) -> None:
        self.held, self.meanwhile, self.locked, self.written = held, meanwhile, 0, []

    @contextlib.contextmanager
    def lock(self, spec: RunSpec) -> Iterator[bool]:
        self.held -= 1
        if self.held >= 0:
            yield False
            return
        self.locked += 1
        yield True
        self.locked -= 1

    def stamp(self, spec: RunSpec) -> Any:
        return "another" if self.meanwhile is not None else None

    def find(self, spec: RunSpec) -> RunResult | None:
        return self.meanwhile

    def clear(self, spec: RunSpec) -> None:
        pass

    def write(self, result: RunResult, signals: Any) -> None:
        self.written.append(result)


def result(spec: RunSpec, status: Any) -> RunResult:
    return RunResult(spec, status, "" if status == "ok" else "why", (), 0, 1.0, {}, {}, {})


def found(specs: Sequence[RunSpec], executor: Scripted, folder: Folder) -> list[RunResult]:
    executor.folder = folder
    dataset = SimpleNamespace(
        fitting=SimpleNamespace(channels=Channels(("u",), ("y",), ("V",), ("m",))), notes=(), title=""
    )
    ended = outcomes.results([Task(spec, "nnss") for spec in specs], executor, dataset, folder, {})  # type: ignore[arg-type]
    listed = list(ended)
    assert folder.locked == 0, "a lock is left"
    return listed


@pytest.mark.parametrize(
    ("script", "status"),
    [
        (["ok"], "ok"), (["crashed…", "ok"], "ok"), (["crashed…", "crashed…"], "crashed"), (["crashed"], "crashed"),
        (["timeout"], "timeout"), (["memory"], "memory"), (["crashed…", "timeout"], "timeout"),
    ],
)  # fmt: skip
def test_a_run_whose_process_ended_is_tried_twice_and_one_beyond_a_limit_once(script: list[str], status: str) -> None:
    executor, folder = Scripted(script), Folder()
    (one,) = found([SPEC], executor, folder)
    assert (one.status, one.reason) == (status, "" if status == "ok" else "why")
    assert executor.submitted == len(script)
    assert folder.written == ([] if status == "ok" else [one]), "a loss is kept, a result has been"


def test_a_run_that_another_command_is_at_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = itertools.count(0.0, 1.0)
    monkeypatch.setattr(outcomes.time, "monotonic", lambda: next(clock))
    executor = Scripted(["ok"])
    assert [one.status for one in found([SPEC], executor, Folder(held=2))] == ["ok"]
    assert executor.submitted == 1
    executor, kept = Scripted([]), replace(result(SPEC, "ok"), provenance={"nnss": __version__})
    assert found([SPEC], executor, Folder(held=2, meanwhile=kept)) == [kept]
    assert executor.submitted == 0, "the other command has kept it"


def test_a_crash_of_one_run_leaves_the_tries_of_the_others() -> None:
    executor = Scripted(["crashed…", "ok", "crashed…", "ok"])
    ended = found([replace(SPEC, seed=seed) for seed in (0, 1)], executor, Folder())
    assert [(one.spec.seed, one.status) for one in ended] == [(0, "ok"), (1, "ok")]


def test_a_million_runs_are_a_call_and_one_more_is_not() -> None:
    check_count(1_000_000)
    with pytest.raises(InputError, match="expected at most 1,000,000 runs in one call, found 1,000,001"):
        check_count(1_000_001)


def test_a_plan_is_estimated_from_runs_at_the_nearest_order() -> None:
    def kept(order: int, seconds: float, method: str = "nnss") -> RunResult:
        return RunResult(replace(SPEC, method=method, order=order), "ok", "", (), 1, seconds, {}, {}, {})

    earlier = [kept(2, 1.0), kept(2, 3.0), kept(5, 10.0)]
    todo = [replace(SPEC, order=3, seed=seed) for seed in range(4)] + [
        replace(SPEC, order=4),
        replace(SPEC, method="simba"),
    ]
    found = estimate(todo, earlier, 2)
    assert [(g.method, g.order, g.runs, g.seconds) for g in found.groups] == [
        ("nnss", 3, 4, 2.0), ("nnss", 4, 1, 10.0), ("simba", 2, 1, None),
    ]  # fmt: skip
    assert found.seconds == pytest.approx((4 * 2 + 10 + 6 * OVERHEAD) / 2)
    assert found.unknown == ("simba",)
    assert estimate(todo[:1], earlier, 8).seconds == pytest.approx(2 + OVERHEAD), "no more processes than runs"
    assert estimate([], earlier, 2).seconds == 0
    tie = estimate([replace(SPEC, order=3)], [kept(4, 9.0), kept(2, 1.0)], 1)
    assert tie.groups[0].seconds == 1.0, "of two as near the lower"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.2, "1 s"), (1.4, "1 s"), (119.4, "119 s"), (120, "2 min"), (7199, "120 min"), (7200, "2 h"), (9000, "2.5 h"),
        (2 * DAY - 1, "48 h"), (2 * DAY, "2 days"), (100 * DAY, "100 days"),
    ],
)  # fmt: skip
def test_a_duration_is_in_the_unit_of_which_there_are_two(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_many_orders_are_told_by_the_first_and_last() -> None:
    five = [replace(SPEC, order=n, settings={}) for n in (1, 2, 3, 5, 7)]
    assert amount(five) == "nnss 5 runs of order 1, 2, 3, 5, 7"
    assert amount([*five, replace(SPEC, order=9, settings={})]) == "nnss 6 runs of order 1 to 9"
