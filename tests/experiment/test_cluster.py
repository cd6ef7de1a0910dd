"""Runs on a Dask cluster: a real scheduler and two worker processes, over TCP on the loopback."""

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import sweep_faults as faults
from nnss_cli.datasets.catalog import load

from nnss_cli.errors import InputError
from nnss_cli.experiment.cluster import Dask
from nnss_cli.experiment.executor import NO_LIMITS, Event, Task
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan, sweep
from nnss_cli.methods import METHODS, select
from nnss_cli.plugins import read_source, use

pytest.importorskip("distributed")
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="it reads /proc")


@dataclass
class Cluster:
    """A scheduler and its workers, each a process of its own."""

    folder: Path
    scheduler: subprocess.Popen[bytes] | None = None
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    @property
    def address(self) -> str:
        return (self.folder / "address").read_text()

    def start(self) -> None:
        code = (
            "import asyncio, sys, pathlib\n"
            "from distributed import Scheduler\n"
            "async def main():\n"
            "    async with Scheduler(host='127.0.0.1', port=0, dashboard=False) as scheduler:\n"
            "        pathlib.Path(sys.argv[1] + '~').write_text(scheduler.address)\n"
            "        pathlib.Path(sys.argv[1] + '~').rename(sys.argv[1])\n"
            "        await scheduler.finished()\n"
            "asyncio.run(main())\n"
        )
        self.scheduler = self._process(code, str(self.folder / "address"))
        assert faults.wait_until((self.folder / "address").exists)
        for _ in range(2):
            self.add_worker()

    def add_worker(self, kind: str = "Worker", **environment: str) -> None:
        code = (
            "import asyncio, sys\n"
            f"from distributed import {kind}\n"
            "async def main():\n"
            f"    async with {kind}(sys.argv[1], nthreads=1, dashboard=False) as worker:\n"
            "        await worker.finished()\n"
            "if __name__ == '__main__':\n"
            "    asyncio.run(main())\n"
        )
        self.workers.append(self._process(code, self.address, **environment))

    def _process(self, code: str, *arguments: str, **environment: str) -> subprocess.Popen[bytes]:
        own = self.folder / f"cwd-{time.monotonic_ns()}"  # nothing is shared but the address
        own.mkdir()
        with (self.folder / "log").open("ab") as log:
            return subprocess.Popen(
                [sys.executable, "-c", code, *arguments], cwd=own, stdout=log, stderr=log,
                env=os.environ | {"TMPDIR": str(own)} | environment,
            )  # fmt: skip

    def stop(self) -> None:
        for process in (*self.workers, self.scheduler):
            if process is not None:
                process.kill()
                process.wait()


@pytest.fixture
def cluster(tmp_path: Path) -> Iterator[Cluster]:
    folder = tmp_path / "cluster"
    folder.mkdir()
    made = Cluster(folder)
    try:
        made.start()
        yield made
    finally:
        made.stop()


@pytest.fixture
def method(tmp_path: Path) -> Iterator[Path]:
    path = faults.write_method(tmp_path)
    use([read_source(path)])
    METHODS.of_files()
    yield path
    use([])


class Swept:
    """What was heard of a sweep."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self.results: list[RunResult] = []


def run(
    out: Path, scheduler: str = "", methods: tuple[str, ...] = ("trivial",), seeds: int = 6, **options: object
) -> Swept:
    store = Store(out, "twotank-sim", "paper")
    dataset = load(store.dataset, store.protocol)
    heard = Swept()
    overrides = {f"trivial.{name}": value for name, value in options.items()}
    todo = plan(store, dataset, select(list(methods)), [1], range(seeds), overrides, False).todo
    sweep(todo, dataset, store, 1, heard.events.append, heard.results.append, scheduler=scheduler)
    return heard


def numbers(out: Path) -> dict[str, bytes]:
    """Models and signals of every run, to the last bit; without the machine and the times of a model's training."""

    def content(path: Path) -> bytes:
        if path.name != "model.json":
            return path.read_bytes()
        description = json.loads(path.read_text(encoding="utf-8"))
        assert description["training"].pop("provenance")
        return json.dumps(description).encode()

    return {
        f"{path.parent.name}/{path.name}": content(path) for path in out.glob("*/*/runs/*/*") if path.name != "run.json"
    }


def scores(out: Path) -> list[tuple]:
    return [(r.spec, r.status, r.scores, r.history) for r in Store(out, "twotank-sim", "paper").results()]


@pytest.mark.system
@pytest.mark.parametrize(
    "names", [("trivial", "n4sid"), pytest.param(("trivial", "nnss", "nnss-ensemble"), marks=pytest.mark.slow)]
)
def test_a_cluster_gives_the_numbers_of_this_machine(
    names: tuple[str, ...], cluster: Cluster, method: Path, tmp_path: Path
) -> None:
    """One method is of a plug-in file; a worker is killed while it is at a run."""
    marks = tmp_path / "marks"
    marks.mkdir()
    options = {"hold": "fit", "seconds": 0.2, "marks": str(marks)}
    small = {"epochs": 2, "hidden": (4,), "optimiser": "adam", "initial": "random"} if "nnss" in names else {}

    def swept(out: Path, scheduler: str) -> Swept:
        store = Store(out, "twotank-sim", "paper")
        dataset = load(store.dataset, store.protocol)
        heard = Swept()
        overrides = small | {f"trivial.{name}": value for name, value in options.items()}
        todo = plan(store, dataset, select(list(names)), [1], range(3), overrides, False).todo

        def on_event(event: Event) -> None:
            heard.events.append(event)
            if scheduler and sum(e.epoch == 0 for e in heard.events) == 2:
                cluster.workers[0].send_signal(signal.SIGKILL)

        sweep(todo, dataset, store, 1, on_event, heard.results.append, scheduler=scheduler)
        return heard

    away = swept(tmp_path / "away", cluster.address)
    here = swept(tmp_path / "here", "")
    assert cluster.workers[0].wait(10) == -signal.SIGKILL
    assert len(away.results) == len(here.results) == (4 if "n4sid" in names else 7)
    assert {result.status for result in away.results} == {"ok"}
    assert numbers(tmp_path / "away") == numbers(tmp_path / "here")
    assert scores(tmp_path / "away") == scores(tmp_path / "here")
    assert {event.spec.label for event in away.events} == {event.spec.label for event in here.events}
    assert not faults.leftovers(tmp_path / "away")


@pytest.mark.system
def test_it_is_an_executor_as_the_others_are(cluster: Cluster, method: Path, tmp_path: Path) -> None:
    cluster.workers.pop().kill()
    store = Store(tmp_path / "out", "twotank-sim", "paper")
    dataset = load(store.dataset, store.protocol)
    (spec,) = plan(store, dataset, select(["trivial"]), [1], range(1), {}, False).todo
    events: list[Event] = []
    with contextlib.closing(Dask(cluster.address, dataset, store, NO_LIMITS, events.append)) as executor:
        assert faults.wait_until(lambda: len(executor._client.scheduler_info()["workers"]) == 1)
        faults.obey(executor, Task(spec), events, store)


@pytest.mark.slow
def test_files_that_go_with_their_worker_before_they_came_are_made_again(
    cluster: Cluster, method: Path, tmp_path: Path
) -> None:
    cluster.workers.pop().kill()
    store = Store(tmp_path / "out", "twotank-sim", "paper")
    dataset = load(store.dataset, store.protocol)
    (spec,) = plan(store, dataset, select(["trivial"]), [1], range(1), {}, False).todo
    events: list[Event] = []
    with contextlib.closing(Dask(cluster.address, dataset, store, NO_LIMITS, events.append)) as executor:
        assert faults.wait_until(lambda: executor.free == 1 or executor.wait(0.1))
        future = executor.submit(Task(spec))
        (running,) = executor._running.values()
        assert faults.wait_until(lambda: running.files.status == "finished")
        cluster.workers[0].kill()
        assert faults.wait_until(lambda: running.files.status != "finished")
        executor.wait(0.5)
        assert not future.done()
        cluster.add_worker()
        assert faults.wait_until(lambda: future.done() or executor.wait(1))
        assert future.result().status == "ok"
    assert sum(event.waits_for == "compiling" for event in events) == 2  # done twice


@pytest.mark.slow
def test_limits_hold_there_as_here_and_the_worker_stays(
    cluster: Cluster, method: Path, tmp_path: Path, nnss: Callable
) -> None:
    """Its nanny makes a worker a daemon of multiprocessing, which may not start processes; that of a run is started."""
    for worker in cluster.workers:
        worker.kill()
        worker.wait()
    cluster.add_worker("Nanny")

    def ended(out: str, *more: str, seeds: int = 2, **options: object) -> object:
        line = faults.command(method, tmp_path / out, *more, seeds=seeds, **options)[3:]
        return nnss(*line, "--executor", "dask", "--scheduler", cluster.address)

    def statuses(out: str) -> dict[int, tuple[str, str]]:
        runs = Store(tmp_path / out, "twotank-sim", "paper").results()
        return {result.spec.seed: (result.status, result.reason) for result in runs}

    stuck = ended("out", "--time-limit", "0.5", mode="sleep")
    assert stuck.code == 1, stuck.err
    assert statuses("out") == {0: ("ok", ""), 1: ("timeout", "took longer than the 0.5 s of --time-limit")}
    again = ended("out", "--time-limit", "0.5", mode="sleep")
    assert "0 runs to do, 2 done already" in again.out
    again = ended("out", "--retry-failed", "--memory-limit", "0.001", mode="sleep")
    assert "1 runs to do, 1 done already" in again.out
    assert statuses("out")[1][0] == "memory"
    assert "more than the 0.001 of --memory-limit" in statuses("out")[1][1]
    lost = ended("killed", "--fail-fast", "--time-limit", "60", seeds=4, mode="kill")
    assert "Stopped at the first run without a result (--fail-fast): 2 are left" in lost.out
    assert statuses("killed")[1] == (
        "crashed",
        "its process ended twice (SIGKILL: out of memory, or killed by hand)",
    )
    assert cluster.workers[-1].poll() is None


@pytest.mark.slow
def test_a_run_that_kills_its_workers_is_a_row(cluster: Cluster, method: Path, tmp_path: Path) -> None:
    for _ in range(3):
        cluster.add_worker()  # the scheduler gives a run up after four
    heard = run(tmp_path / "out", cluster.address, seeds=2, mode="kill")
    found = {result.spec.seed: (result.status, result.reason) for result in heard.results}
    assert found == {0: ("ok", ""), 1: ("crashed", "its worker was lost 4 times")}


@pytest.mark.system
def test_a_scheduler_that_is_killed_is_a_clear_end(cluster: Cluster, method: Path, tmp_path: Path) -> None:
    line = faults.command(
        method, tmp_path / "out", "--executor", "dask", "--scheduler", cluster.address, seeds=6, hold="fit",
        seconds=0.4, marks=tmp_path,
    )  # fmt: skip
    process = faults.start(line)
    assert faults.wait_until(lambda: any((tmp_path / "out").rglob("run.json")))
    assert cluster.scheduler is not None
    cluster.scheduler.kill()
    ended = faults.ending(process, 20)
    assert ended.code == 2
    assert "the scheduler at 'tcp://127.0.0.1:" in ended.err
    assert "the finished runs are kept; the same command goes on from here" in ended.err
    assert "Traceback" not in ended.err
    kept = numbers(tmp_path / "out")
    heard = run(tmp_path / "out", hold="fit", seconds=0.4, marks=str(tmp_path))
    assert 0 < len(heard.results) < 6
    assert kept.items() <= numbers(tmp_path / "out").items()


class SlowLine:
    """Between us and a scheduler: every packet takes its time, until the line is cut."""

    def __init__(self, address: str, seconds: float) -> None:
        self._to, self._seconds = address.removeprefix("tcp://").split(":"), seconds
        self._server = socket.create_server(("127.0.0.1", 0))
        self._ends: list[socket.socket] = []
        self.address = "tcp://{}:{}".format(*self._server.getsockname())
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection((self._to[0], int(self._to[1])))
                self._ends += [near, far]
                for one, other in ((near, far), (far, near)):
                    threading.Thread(target=self._pass, args=(one, other), daemon=True).start()

    def _pass(self, one: socket.socket, other: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while content := one.recv(1 << 20):
                time.sleep(self._seconds)
                other.sendall(content)

    def cut(self) -> None:
        self._server.close()
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


@pytest.mark.slow
def test_a_slow_network_changes_nothing_and_one_that_is_cut_is_a_clear_end(
    cluster: Cluster, method: Path, tmp_path: Path
) -> None:
    run(tmp_path / "here", seeds=4)
    slow = SlowLine(cluster.address, 0.1)
    heard = run(tmp_path / "away", slow.address, seeds=4)
    assert len(heard.results) == 4
    assert numbers(tmp_path / "away") == numbers(tmp_path / "here")
    assert scores(tmp_path / "away") == scores(tmp_path / "here")
    threading.Timer(4.0, slow.cut).start()
    began = time.monotonic()
    with pytest.raises(InputError, match="the finished runs are kept; the same command goes on from here"):
        run(tmp_path / "cut", slow.address, seeds=40, hold="fit", seconds=1.0, marks=str(tmp_path))
    assert time.monotonic() - began < 20
    assert not faults.leftovers(tmp_path / "cut")


@pytest.mark.system
def test_nobody_there_and_workers_that_would_count_otherwise(
    cluster: Cluster, method: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("nnss_cli.experiment.cluster.CONNECT", 0.5)
        with pytest.raises(InputError, match="no Dask scheduler answers at 'tcp://127.0.0.1:1'"):
            run(tmp_path / "out", "tcp://127.0.0.1:1")
    for worker in cluster.workers:
        worker.kill()
        worker.wait()
    cluster.add_worker(OMP_NUM_THREADS="2")
    with pytest.raises(InputError, match="other threads, which changes last digits: start it with OMP_NUM_THREADS=1"):
        run(tmp_path / "out", cluster.address)
    assert not list((tmp_path / "out").rglob("run.json"))
    assert not faults.leftovers(tmp_path / "out")
