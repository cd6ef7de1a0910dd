"""Sweeps that are disturbed from outside: a method that can be caught in each phase, and who sends what to whom.

Used by tests/experiment/test_faults.py and by `make soak`; it reads /proc, so it needs Linux.
"""

import csv
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from nnss_cli.experiment.executor import Event, Executor, Task
from nnss_cli.experiment.store import Store

# Trivial, but for what `mode` makes it do; `hold` is the phase in which it lingers, and says so by a file in `marks`.
METHOD = '''
import os, time
from dataclasses import dataclass
from pathlib import Path
import numpy as np
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.methods import Fit, Method

@dataclass(frozen=True)
class Options:
    mode: str = ""
    """What befalls seed 1."""
    hold: str = ""
    """Phase in which it lingers."""
    seconds: float = 0.0
    """How long."""
    marks: str = ""
    """Folder of marks."""

def reach(phase, settings):
    if settings["marks"]:
        with open(Path(settings["marks"]) / phase, "a") as stream:
            stream.write("x")
    if settings["hold"] == phase.split("-")[0]:
        time.sleep(settings["seconds"])

class Slow(LinearModel):
    def save(self, folder):
        reach("write", self.settings)
        super().save(folder)

class Trivial(Method):
    name = "trivial"
    seeded = True
    options = Options
    def prepare(self, settings):
        reach("compile", settings)
    def fit(self, data, order, seed, settings, on_epoch):
        reach(f"fit-{seed}", settings)
        mode = settings["mode"] if seed == 1 else ""
        if mode == "kill" or mode == "kill once" and Path(settings["marks"], "fit-1").read_text() == "x":
            os.kill(os.getpid(), 9)
        if mode == "abort":
            os.abort()
        if mode == "fault":
            raise TypeError("a fault of the method")
        if mode == "memory":
            held = []
            while True:
                held.append(np.ones(2_000_000))
                time.sleep(0.002)
        if mode == "allocate":
            np.ones(10**15)
        while mode == "deaf":
            try:
                time.sleep(60)
            except KeyboardInterrupt:
                pass
        if mode == "sleep":
            time.sleep(600)
        n = order
        system = LinearStateSpace(
            0.5 * np.eye(n), np.full((n, data.input_count), (1 + seed) / 10), np.ones((data.output_count, n)),
            np.zeros((data.output_count, data.input_count)), data.Ts,
        )
        model = Slow.of(system, data)
        object.__setattr__(model, "settings", settings)
        return Fit(model)

METHOD = Trivial()
'''
HOLD = 0.15  # seconds in the phase that a signal is to hit
RECORD = Path("twotank-sim", "paper")


def write_method(folder: Path) -> Path:
    """The method as a plug-in file."""
    path = folder / "trivial.py"
    path.write_text(METHOD, encoding="utf-8")
    return path


def command(method: Path, out: Path, *more: str, seeds: int = 4, jobs: int = 2, **options: object) -> list[str]:
    """The command line of a sweep of the trivial method."""
    assigned = [f"trivial.{name}={value}" for name, value in options.items()]
    return [
        sys.executable, "-m", "nnss_cli", "compare", "twotank-sim", "--plugin", str(method), "--methods", "trivial",
        "--orders", "1", "--seeds", str(seeds), "--jobs", str(jobs), "--out", str(out), *more,
        *(["--set", *assigned] if assigned else []),
    ]  # fmt: skip


def start(line: list[str]) -> subprocess.Popen[str]:
    """Start it in a session of its own, as from a terminal: no signal is ignored."""

    def heed() -> None:
        for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)

    return subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True, preexec_fn=heed
    )


def session(leader: int) -> list[int]:
    """The processes of a session that are alive."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                state, _, _, own = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
            except OSError:
                continue
            if int(own) == leader and state not in "ZX":
                found.append(int(entry.name))
    return found


def workers(leader: int) -> list[int]:
    """The worker processes of a session."""
    found = []
    for process in session(leader):
        try:
            if b"spawn_main" in Path(f"/proc/{process}/cmdline").read_bytes():
                found.append(process)
        except OSError:
            continue
    return sorted(found)


def wait_until(condition: Callable[[], object], seconds: float = 60.0) -> bool:
    """Whether it became true in time."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.005)
    return False


def send(process: subprocess.Popen[str], target: str, number: int) -> None:
    """Send a signal to the parent, a worker, both, or the group."""
    if target == "group":
        os.killpg(process.pid, number)
        return
    found = workers(process.pid) if target in ("worker", "both") else []
    if target in ("parent", "both"):
        os.kill(process.pid, number)
    for one in found[:1]:
        try:
            os.kill(one, number)
        except ProcessLookupError:
            continue


@dataclass(frozen=True)
class Ending:
    """How a disturbed command ended."""

    code: int | None
    """Exit code; None if it did not end in time."""
    seconds: float
    """From the signal to its end and that of its processes."""
    left: list[int]
    """Processes that were left over (and were killed then)."""
    err: str
    """What it said on stderr."""


def ending(process: subprocess.Popen[str], seconds: float = 10.0) -> Ending:
    """Wait for a command's end; end it, and what it left, when that does not come."""
    began = time.monotonic()
    try:
        _, err = process.communicate(timeout=seconds)
        code: int | None = process.returncode
    except subprocess.TimeoutExpired:
        code, err = None, ""
    # what it started may take a moment to see that it has gone
    wait_until(
        lambda: not session(process.pid), max(0.0, seconds - (time.monotonic() - began)) if code is not None else 0
    )
    took = time.monotonic() - began
    left = session(process.pid)
    for one in left:
        try:
            os.kill(one, signal.SIGKILL)
        except ProcessLookupError:
            continue
    if code is None:
        process.communicate()
    return Ending(code, took, left, err)


def disturbed(method: Path, out: Path, marks: Path, phase: str, target: str, number: int) -> Ending:
    """Start a sweep, send a signal in a phase, and see it end.

    In phase `start` the signal comes as soon as the target is there, however far it has come.
    """
    marks.mkdir()
    process = start(command(method, out, hold="" if phase == "start" else phase, seconds=HOLD, marks=marks))

    def reached() -> bool:
        if target in ("worker", "both") and not workers(process.pid):
            return False
        return phase == "start" or any(marks.glob(f"{phase}*"))

    wait_until(lambda: reached() or process.poll() is not None)
    send(process, target, number)
    return ending(process)


def table(out: Path) -> list[list[str]]:
    """rmse.csv without the times."""
    with (out / RECORD / "rmse.csv").open(newline="") as stream:
        rows = list(csv.reader(stream))
    times = rows[0].index("fit_seconds")
    return [row[:times] + row[times + 1 :] for row in rows]


def leftovers(out: Path) -> list[Path]:
    """Temporary files, locks, and folders of unfinished runs."""
    runs = out / RECORD / "runs"
    found = [*out.rglob(".tmp-*"), *(runs / ".locks").glob("*")]
    return found + [one for one in runs.glob("[!.]*") if not (one / "run.json").exists()]


def obey(executor: Executor, task: Task, events: list[Event], store: Store) -> None:
    """Ask of an executor of one place what each promises: a future that ends within `wait`, with what is on disk."""

    def until(condition: Callable[[], object]) -> None:
        deadline = time.monotonic() + 30
        while not condition():
            executor.wait(1)
            assert time.monotonic() < deadline, "it does not come"

    until(lambda: executor.free)
    future = executor.submit(task)
    assert not executor.free
    assert not future.done()
    assert events == []
    until(future.done)
    kept = store.find(task.spec)
    assert kept is not None
    assert (future.result().spec, future.result().scores) == (kept.spec, kept.scores)
    assert events == [Event(task.spec, waits_for="compiling", begun=False), Event(task.spec)]
    until(lambda: executor.free == 1)
