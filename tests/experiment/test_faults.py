"""Sweeps that are killed, interrupted, starved or shared: nothing is lost, and nothing waits for what is gone."""

import contextlib
import errno
import json
import os
import re
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import sweep_faults as faults
from conftest import slow_but
from nnss_cli.datasets.catalog import load

from nnss_cli import files
from nnss_cli.errors import InputError
from nnss_cli.experiment.executor import NO_LIMITS, Event, Executor, Serial, Task
from nnss_cli.experiment.interrupt import deferred, interruptible
from nnss_cli.experiment.outcomes import results
from nnss_cli.experiment.processes import Processes
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan, sweep
from nnss_cli.lock import lock
from nnss_cli.methods import select
from nnss_cli.plugins import read_source, use

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are watched through /proc")

NOTHING = lambda *_: None  # noqa: E731
SEEDS = 4


@pytest.fixture(autouse=True)
def nothing_stays_in_use() -> Iterator[None]:
    yield
    use(())


@pytest.fixture
def method(tmp_path: Path) -> Path:
    path = faults.write_method(tmp_path)
    use([read_source(path)])
    return path


def store_in(out: Path) -> Store:
    return Store(out, "twotank-sim", "paper")


def run_all(store: Store, seeds: int = SEEDS, jobs: int = 1, options: dict | None = None, **more: object) -> int:
    dataset = load(store.dataset, store.protocol)
    overrides = {f"trivial.{name}": value for name, value in (options or {}).items()}
    todo = plan(store, dataset, select(["trivial"]), [1], range(seeds), overrides, False).todo
    sweep(todo, dataset, store, jobs, NOTHING, NOTHING, **more)
    return len(todo)


def scores(store: Store) -> dict:
    return {result.spec.label: (result.status, result.scores) for result in store.results()}


def outcome(line: list[str], **more: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(line, capture_output=True, text=True, timeout=60, **more)


@pytest.mark.system
@pytest.mark.parametrize(
    ("number", "target", "phase"),
    slow_but((0, 4, 6), [
        (signal.SIGINT, "group", "fit"),
        (signal.SIGINT, "parent", "start"),
        (signal.SIGTERM, "parent", "write"),
        (signal.SIGHUP, "parent", "compile"),
        (signal.SIGKILL, "parent", "fit"),
        (signal.SIGKILL, "group", "write"),
        (signal.SIGKILL, "worker", "write"),
        (signal.SIGTERM, "worker", "start"),
    ]),
)  # fmt: skip
def test_a_signal_ends_it_or_costs_nothing_and_the_same_command_goes_on(
    number: signal.Signals, target: str, phase: str, method: Path, tmp_path: Path
) -> None:
    """What the whole of `make soak` asks of every signal, target and phase."""
    out, marks = tmp_path / "out", tmp_path / "marks"
    ended = faults.disturbed(method, out, marks, phase, target, number)
    assert ended.code is not None, "it waits for something"
    assert ended.seconds < 10
    assert not ended.left
    if target == "worker":
        assert ended.code == 0, ended.err
    elif number == signal.SIGKILL:
        assert ended.code == -signal.SIGKILL
    elif phase != "start":  # before Python has come to our code its own defaults hold
        assert ended.code == 130
        assert ended.err.startswith("nnss: interrupted")
        assert "Traceback" not in ended.err
    store = store_in(out)
    before = {path: path.read_bytes() for path in out.rglob("run.json")}
    use([read_source(method)])
    run_all(store, options={"hold": "" if phase == "start" else phase, "seconds": faults.HOLD, "marks": str(marks)})
    assert all(path.read_bytes() == content for path, content in before.items()), "a finished run was lost"
    undisturbed = store_in(tmp_path / "undisturbed")
    run_all(undisturbed)
    assert scores(store) == scores(undisturbed)
    assert not faults.leftovers(out)


@pytest.mark.system
def test_workers_end_with_a_killed_parent_in_the_midst_of_a_fit(method: Path, tmp_path: Path) -> None:
    """Not only when they next listen to it."""
    marks = tmp_path / "marks"
    marks.mkdir()
    process = faults.start(faults.command(method, tmp_path / "out", mode="sleep", marks=marks))
    assert faults.wait_until((marks / "fit-1").exists)
    faults.send(process, "parent", signal.SIGKILL)
    ended = faults.ending(process)
    assert (ended.code, ended.left) == (-signal.SIGKILL, [])


def test_a_killed_worker_is_replaced_and_its_run_tried_once_more(method: Path, tmp_path: Path) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    store = store_in(tmp_path / "out")
    run_all(store, jobs=2, options={"mode": "kill once", "marks": str(marks)})
    assert {result.status for result in store.results()} == {"ok"}
    assert (marks / "fit-1").read_text() == "xx"
    assert (marks / "fit-2").read_text() == "x"


@pytest.mark.system
@pytest.mark.parametrize(
    ("mode", "limits", "status", "words"),
    slow_but((0, 4), [
        ("kill", [], "crashed", "its process ended twice (SIGKILL: out of memory, or killed by hand)"),
        ("fault", [], "crashed", "TypeError: a fault of the method"),
        ("allocate", [], "memory", "Unable to allocate"),
        ("memory", ["--memory-limit", "0.7"], "memory", "more than the 0.7 of --memory-limit"),
        ("sleep", ["--time-limit", "0.5"], "timeout", "took longer than the 0.5 s of --time-limit"),
    ]),
)  # fmt: skip
def test_a_lost_run_is_a_row_with_its_reason_and_the_sweep_goes_on(
    mode: str, limits: list[str], status: str, words: str, method: Path, tmp_path: Path, nnss: Callable
) -> None:
    line = [*faults.command(method, tmp_path / "out", *limits, seeds=3, mode=mode)[3:]]
    ended = nnss(*line)
    assert ended.code == 1, ended.err
    found = {result.spec.seed: result for result in store_in(tmp_path / "out").results()}
    assert {seed: result.status for seed, result in found.items()} == {0: "ok", 1: status, 2: "ok"}
    assert words in found[1].reason
    assert ["1", "trivial", "2/3"] in [line.split()[:3] for line in ended.out.splitlines()]
    assert f"trivial, order 1, seed 1: {status}: " in ended.out
    rows = faults.table(tmp_path / "out")
    assert [row[rows[0].index("status")] for row in rows if row[4] == "1"] == [status]
    again = nnss(*line)
    assert "0 runs to do, 3 done already" in again.out
    assert f"1 of the finished runs: {status}; --retry-failed tries them again" in again.out
    assert again.code == 1
    assert "∞" in (tmp_path / "out" / faults.RECORD / "rmse.md").read_text()


@pytest.mark.system
def test_retry_failed_tries_again_what_another_limit_may_better(method: Path, tmp_path: Path, nnss: Callable) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    line = faults.command(method, tmp_path / "out", seeds=2, hold="fit", seconds=0.5, marks=marks)[3:]
    assert nnss(*line, "--time-limit", "0.1").code == 1
    again = nnss(*line, "--time-limit", "30", "--retry-failed")
    assert "2 runs to do, 0 done already" in again.out
    assert again.code == 0


def test_fail_fast_stops_at_the_first_run_without_a_result(method: Path, tmp_path: Path, nnss: Callable) -> None:
    ended = nnss(*faults.command(method, tmp_path / "out", "--fail-fast", seeds=6, jobs=1, mode="fault")[3:])
    assert ended.code == 1
    assert "Stopped at the first run without a result (--fail-fast): 4 are left" in ended.out
    assert set(scores(store_in(tmp_path / "out"))) == {"trivial-n1-s0", "trivial-n1-s1"}


def test_dry_run_tells_the_plan_and_the_time_and_touches_nothing(method: Path, tmp_path: Path, nnss: Callable) -> None:
    out = tmp_path / "out"
    line = faults.command(method, out, jobs=1)[3:]
    told = nnss(*line, "--dry-run")
    assert told.code == 0
    assert "4 runs to do, 0 done already" in told.out
    assert "and what trivial takes: no earlier run tells" in told.out
    assert not out.exists()
    run_all(store_in(out), seeds=1)
    path = next(out.rglob("run.json"))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fit_seconds": 600.0}))
    before = {path: path.read_bytes() for path in out.rglob("*") if path.is_file()}
    assert "Expected: about 30 min\n" in nnss(*line, "--dry-run").out
    assert "Expected: about 40 min\n" in nnss(*line, "--dry-run", "--force").out
    assert {path: path.read_bytes() for path in out.rglob("*") if path.is_file()} == before


@pytest.mark.system
def test_more_than_a_day_is_asked_for_and_more_than_a_folder_holds_refused(
    method: Path, tmp_path: Path, nnss: Callable
) -> None:
    out = tmp_path / "out"
    run_all(store_in(out), seeds=1)
    path = next(out.rglob("run.json"))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"fit_seconds": 50_000.0}))
    line = faults.command(method, out, jobs=1)[3:]
    refused = nnss(*line)
    assert (refused.code, len(refused.err.splitlines())) == (2, 1)
    assert "this will take about 41.7 h: --yes starts it all the same" in refused.err
    assert nnss(*line, "--yes").code == 0
    began = time.monotonic()
    refused = nnss(*faults.command(method, out, seeds=10**9)[3:])
    assert (refused.code, refused.err) == (
        2,
        "nnss: --seeds: expected at least 1 and at most 1,000,000, found 1,000,000,000\n",
    )
    refused = nnss(*faults.command(method, out, seeds=10**6)[3:], "--orders", "1", "2")
    assert refused.code == 2
    assert "expected at most 1,000,000 runs in one call, found 2,000,000" in refused.err
    assert nnss(*faults.command(method, out, jobs=10**6)[3:]).code == 2
    assert time.monotonic() - began < 5


@pytest.mark.system
def test_two_commands_on_one_folder_share_the_work_and_both_finish(method: Path, tmp_path: Path) -> None:
    marks, out = tmp_path / "marks", tmp_path / "out"
    marks.mkdir()
    line = faults.command(method, out, seeds=6, hold="fit", seconds=0.2, marks=marks)
    both = [faults.start(line) for _ in range(2)]
    endings = [faults.ending(process, 60) for process in both]
    assert [ended.code for ended in endings] == [0, 0], endings
    assert {mark.name: mark.read_text() for mark in marks.glob("fit-*")} == {f"fit-{seed}": "x" for seed in range(6)}
    assert len(faults.table(out)) == 1 + 6 * 3
    assert not faults.leftovers(out)


@pytest.mark.system
def test_a_run_that_another_command_holds_is_waited_for_and_taken_over_when_it_dies(
    method: Path, tmp_path: Path
) -> None:
    store = store_in(tmp_path / "out")
    dataset = load(store.dataset, store.protocol)
    todo = plan(store, dataset, select(["trivial"]), [1], range(2), {}, False).todo
    finished: list[RunResult] = []
    holder = subprocess.Popen(
        [sys.executable, "-c", "import sys, time\nfrom pathlib import Path\nfrom nnss_cli.lock import lock\n"
         "with lock(Path(sys.argv[1])) as held:\n    print(held, flush=True)\n    time.sleep(60)",
         str(store.folder / "runs" / ".locks" / todo[0].label)],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert holder.stdout is not None
    assert holder.stdout.readline() == "True\n"

    def heard(result: RunResult) -> None:
        finished.append(result)
        threading.Timer(1.3, holder.kill).start()  # after the first result, which is of the other run, and two looks

    events: list[Event] = []
    sweep(todo, dataset, store, 1, events.append, heard)
    holder.wait()
    holder.stdout.close()
    assert [result.spec.seed for result in finished] == [1, 0]
    waited = Event(todo[0], waits_for="waits for another process that is at it", begun=False)
    assert [event for event in events if event.spec == todo[0]] == [
        waited, Event(todo[0], waits_for="compiling", begun=False), Event(todo[0]),
    ]  # fmt: skip


@pytest.mark.parametrize("kind", ["serial", "processes"])
def test_executors_do_the_same_behind_one_interface(kind: str, method: Path, tmp_path: Path) -> None:
    """Dask's is asked the same in test_cluster.py."""
    store = store_in(tmp_path / "out")
    dataset = load(store.dataset, store.protocol)
    (spec,) = plan(store, dataset, select(["trivial"]), [1], range(1), {}, False).todo
    events: list[Event] = []
    executor: Executor = (
        Serial(dataset, store, events.append)
        if kind == "serial"
        else Processes(1, dataset, store, NO_LIMITS, events.append)
    )
    with contextlib.closing(executor):
        faults.obey(executor, Task(spec), events, store)


def test_what_another_command_has_kept_meanwhile_is_not_done_again(method: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path / "out")
    dataset = load(store.dataset, store.protocol)
    todo = plan(store, dataset, select(["trivial"]), [1], range(2), {}, False).todo
    events: list[Event] = []
    coming = results([Task(spec) for spec in todo], Serial(dataset, store, events.append), dataset, store, {})
    assert next(coming).spec == todo[0]
    sweep(todo[1:], dataset, store, 1, NOTHING, NOTHING)
    assert list(coming) == [store.find(todo[1])]
    assert events == [Event(todo[0], waits_for="compiling", begun=False), Event(todo[0])]


def test_a_lock_is_held_by_one_and_leaves_nothing(tmp_path: Path) -> None:
    path = tmp_path / "locks" / "one"
    with lock(path) as held:
        assert held
        with lock(path) as twice:
            assert not twice
        assert path.exists()
    assert not path.exists()
    with lock(path) as held:
        assert held


@pytest.mark.system
@pytest.mark.parametrize("jobs", [2, 4])
def test_the_numbers_do_not_depend_on_the_number_of_processes(jobs: int, tmp_path: Path) -> None:
    found = []
    for count in (1, jobs):
        store = store_in(tmp_path / str(count))
        dataset = load(store.dataset, store.protocol)
        todo = plan(store, dataset, select(["n4sid", "ssregest"]), [2, 3], range(1), {}, False).todo
        sweep(todo, dataset, store, count, NOTHING, NOTHING)
        found.append((scores(store), {spec.label: store.signals(spec)["test/0/y_sim"].tobytes() for spec in todo}))
    assert found[0] == found[1]
    assert len(found[0][0]) == 4


def test_files_of_a_run_are_all_flushed_before_any_is_in_place_and_run_json_is_last(
    method: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[tuple[str, str]] = []
    flush, place = files._flush, files._into_place
    monkeypatch.setattr(files, "_flush", lambda path: (done.append(("flushed", path.suffix)), flush(path)))
    monkeypatch.setattr(files, "_into_place", lambda path, to: (done.append(("in place", to.name)), place(path, to)))
    run_all(store_in(tmp_path / "out"), seeds=1)
    assert [what for what, _ in done] == ["flushed"] * 4 + ["in place"] * 4
    assert done[-1][1] == "run.json"
    assert {name for _, name in done[4:]} == {"model.json", "model.safetensors", "signals.safetensors", "run.json"}


def writes(out: Path) -> list[str]:
    """Every write of a sweep of two runs, in order."""
    seen: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        whole = files._write
        patch.setattr(files, "_write", lambda path, content: (seen.append(path.suffix), whole(path, content)))
        run_all(store_in(out), seeds=2)
    return seen


@pytest.mark.system
def test_a_full_disk_at_each_write_loses_nothing_and_is_one_line(
    method: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    count = len(writes(tmp_path / "undisturbed"))
    assert count == 8  # of each run: two of the model, the signals, run.json
    undisturbed = scores(store_in(tmp_path / "undisturbed"))
    whole = files._write
    for last in range(count // 2 + 1):
        left = [last]

        def full(path: Path, content: bytes, left: list[int] = left) -> None:
            left[0] -= 1
            if left[0] < 0:
                path.write_bytes(content[: len(content) // 2])
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            whole(path, content)

        store = store_in(tmp_path / str(last))
        with monkeypatch.context() as patch:
            patch.setattr(files, "_write", full)
            with pytest.raises(
                InputError, match=r"cannot write to '.*': No space left .*bytes free.*same command"
            ) as told:
                run_all(store, seeds=2)
            assert str(store.folder) in str(told.value)
        assert len(store.results()) == last // 4
        assert not list(store.out.rglob(".tmp-*"))
        assert run_all(store, seeds=2) == 2 - last // 4
        assert scores(store) == undisturbed
        assert not faults.leftovers(store.out)


def mounts() -> bool:
    """Whether this system lets us mount a file system of our own."""
    try:
        line = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"]
        return subprocess.run(line, capture_output=True).returncode == 0
    except OSError:
        return False


@pytest.mark.parametrize("kilobytes", [*(pytest.param(size, marks=pytest.mark.slow) for size in (40, 350, 900))])
def test_a_full_file_system_loses_nothing_and_is_one_line(kilobytes: int, method: Path, tmp_path: Path) -> None:
    """A real one, too small for a run, for six, or for the figures of six; then one with room."""
    if not mounts():
        pytest.skip("no user namespaces here: see the writer that fails, above")
    small, out = tmp_path / "small", tmp_path / "out"
    small.mkdir()
    line = faults.command(method, small, seeds=6)
    mounted = (
        f'mount -t tmpfs -o size={kilobytes}k none "{small}" && "$@"; code=$?; cp -a "{small}" "{out}"; exit $code'
    )
    ended = subprocess.run(["unshare", "-rm", "sh", "-c", mounted, "sh", *line], capture_output=True, text=True)
    assert ended.returncode == 2, ended.stderr
    (said,) = ended.stderr.splitlines()
    assert re.search(rf"cannot write to '{small}[^']*': No space left on device", said)
    store = store_in(out)
    if "name another folder" not in said:  # told before the first run
        assert re.search(r"\([\d,]+ bytes free\)", said)
        assert len(store.results()) == len(list(out.rglob("run.json")))
    assert (len(store.results()) < 6) == (kilobytes < 900)
    assert not store.read().faults
    kept = {path: path.read_bytes() for path in out.rglob("run.json")}
    again = outcome(faults.command(method, out, seeds=6))
    assert again.returncode == 0, again.stderr
    assert len(store.results()) == 6
    assert {path: path.read_bytes() for path in kept} == kept
    assert not faults.leftovers(out)


@pytest.mark.system
def test_workers_that_cannot_write_end_the_sweep_with_one_line(method: Path, tmp_path: Path) -> None:
    """A limit of the system on the size of files stands for the full disk."""

    def bounded() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    ended = outcome(faults.command(method, tmp_path / "out"), preexec_fn=bounded)
    assert ended.returncode == 2
    assert len(ended.stderr.splitlines()) == 1, ended.stderr
    assert f"cannot write to '{tmp_path / 'out' / faults.RECORD}': File too large" in ended.stderr
    assert not list((tmp_path / "out").rglob("run.json"))


def test_what_dead_writers_left_is_removed_and_what_live_ones_write_is_not(method: Path, tmp_path: Path) -> None:
    store = store_in(tmp_path / "out")
    run_all(store, seeds=1)
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    folder = store.folder / "runs" / "trivial-n1-s0"
    unfinished = store.folder / "runs" / "trivial-n1-s7"
    unfinished.mkdir()
    (unfinished / "model.json").write_text("{")
    host = files._host()
    dead = [one / f".tmp-{host}-{gone.pid}-abc.json" for one in (store.folder, folder, unfinished)]
    alive = [
        folder / f".tmp-{host}-{os.getpid()}-abc.json",
        store.folder / ".tmp-another-1-abc",
        folder / ".tmp-earlier",
    ]
    for path in (*dead, *alive):
        path.write_text("half")
    old = store.folder / ".tmp-another-2-abc.csv"
    old.write_text("half")
    os.utime(old, (0, 0))
    run_all(store, seeds=2)
    assert not any(path.exists() for path in (*dead, old, unfinished))
    assert all(path.exists() for path in alive)
    dead[0].write_text("half")
    assert run_all(store, seeds=2) == 0
    assert not dead[0].exists(), "also where nothing is to do"


def test_an_interruption_waits_for_what_must_not_be_cut() -> None:
    done = []
    with interruptible():
        with contextlib.suppress(KeyboardInterrupt), deferred():
            os.kill(os.getpid(), signal.SIGTERM)
            done.append("whole")
            raise KeyError  # the interruption goes before an error
        done.append("cleaning up")
        os.kill(os.getpid(), signal.SIGHUP)  # a second one does not disturb it
        done.append("cleaned up")
    assert done == ["whole", "cleaning up", "cleaned up"]
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


@pytest.mark.slow
def test_a_method_that_swallows_the_interruption_ends_as_well(method: Path, tmp_path: Path) -> None:
    marks = tmp_path / "marks"
    marks.mkdir()
    process = faults.start(faults.command(method, tmp_path / "out", jobs=1, mode="deaf", marks=marks))
    assert faults.wait_until((marks / "fit-1").exists)
    faults.send(process, "parent", signal.SIGTERM)
    ended = faults.ending(process)
    assert ended.code == 130
    assert ended.seconds < 10
    assert [path.parent.name for path in (tmp_path / "out").rglob("run.json")] == ["trivial-n1-s0"]
