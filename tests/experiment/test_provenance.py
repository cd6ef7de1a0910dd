"""Where numbers come from is kept with each run, and told where runs of one table differ in it."""

import json
import re
import shutil
import subprocess
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.record import Dataset

from nnss_cli.experiment import provenance
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.provenance import Watch
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import select
from nnss_cli.report.tables import rmse_markdown


@pytest.fixture
def made(tmp_path: Path, small_data: Callable) -> tuple[Store, Dataset]:
    store, dataset = Store(tmp_path, "small", "strict"), small_data()
    for spec in plan(store, dataset, select(["n4sid"]), [1, 2], [0], {}, False).todo:
        execute(spec, dataset, store, command="nnss compare small --orders 1 2")
    return store, dataset


def changed(store: Store, **entries: str | None) -> list[RunResult]:
    """The runs, the first with other entries of its provenance."""
    path = store.folder / "runs" / "n4sid-n1-s0" / "run.json"
    content = json.loads(path.read_text())
    for name, value in entries.items():
        content["provenance"].pop(name, None) if value is None else content["provenance"].update({name: value})
    path.write_text(json.dumps(content))
    return store.read().results


def test_a_run_tells_where_it_comes_from(made: tuple[Store, Dataset]) -> None:
    store, dataset = made
    result = store.results()[0]
    found = result.provenance
    assert found["command"] == "nnss compare small --orders 1 2"
    assert found["cpu"]
    assert found["instructions"]
    assert found["threads"] == "OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 MKL_NUM_THREADS=1"
    assert {"numpy", "scipy", "torch", "pandas", "safetensors", "control"} <= found.keys()
    began, ended = (datetime.fromisoformat(found[name]) for name in ("started", "finished"))
    assert (ended - began).total_seconds() == pytest.approx(float(found["seconds"]), abs=0.1)
    assert 10 < int(found["peak memory [MB]"]) < 10_000
    assert result.spec.data == dataset.fingerprint()


def test_peak_memory_is_that_of_the_run() -> None:
    first = Watch()
    held = np.ones(30_000_000)
    large = int(first.provenance()["peak memory [MB]"])
    del held
    small = int(Watch().provenance()["peak memory [MB]"])
    assert large - small > 150


def test_the_commit_and_whether_files_were_changed(tmp_path: Path) -> None:
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    assert provenance._commit(tmp_path) == "", "no checkout"

    def git(*arguments: str) -> None:
        subprocess.run(
            ["git", "-c", "user.name=x", "-c", "user.email=x@x", *arguments],
            cwd=tmp_path,
            check=True,
            capture_output=True,
        )

    git("init")
    (tmp_path / "file").write_text("one")
    git("add", "file")
    git("commit", "-m", "first")
    assert re.fullmatch("[0-9a-f]{12}", provenance._commit(tmp_path))
    (tmp_path / "file").write_text("two")
    assert re.fullmatch("[0-9a-f]{12}-dirty", provenance._commit(tmp_path))


def test_no_process_is_started_for_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    provenance.here()
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("a process"))
    Watch().provenance()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("commit", "with different versions of commit"), ("scipy", "with different versions of scipy"),
        ("cpu", "on different machines, by cpu"), ("instructions", "on different machines, by instructions"),
    ],
)  # fmt: skip
def test_a_table_of_several_versions_or_machines_says_so(name: str, words: str, made: tuple[Store, Dataset]) -> None:
    store, dataset = made
    assert "different" not in rmse_markdown(store.read().results)
    results = changed(store, **{name: "another"})
    assert re.search(rf"Made {words}: (.* \(1 runs\), )?another \(1 runs\)", rmse_markdown(results))
    told = plan(store, dataset, select(["n4sid"]), [1, 2], [0], {}, False).made_elsewhere()
    assert any(line.startswith(f"1 of the finished runs: {name} another, here ") for line in told)


def test_runs_of_earlier_versions_are_read(made: tuple[Store, Dataset]) -> None:
    """Theirs had the versions of four libraries, the machine and the time."""
    new = ("commit", "cpu", "instructions", "threads", "command", "started", "seconds", "peak memory [MB]", "pandas")
    results = changed(made[0], **dict.fromkeys(new))
    assert [result.spec.order for result in results] == [1, 2]
    assert not plan(*made, select(["n4sid"]), [1, 2], [0], {}, False).todo
