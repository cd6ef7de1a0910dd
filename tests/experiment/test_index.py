"""What is read of a folder of runs: the index is never believed over the files, what is wrong is named and left out."""

import json
import os
import random
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from conftest import slow_but

from nnss_cli.errors import InputError
from nnss_cli.experiment import index
from nnss_cli.experiment import store as stores
from nnss_cli.experiment.agreement import agreeing
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import load_model, select
from nnss_cli.modelfile import read_tensors, write_tensors

ORDERS = (1, 2, 3)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three runs of n4sid on the embedded plant."""
    from nnss_cli.datasets.catalog import load

    store = Store(tmp_path_factory.mktemp("made"), "twotank-sim", "strict")
    dataset = load(store.dataset, store.protocol)
    for spec in plan(store, dataset, select(["n4sid"]), ORDERS, [0], {}, False).todo:
        assert execute(spec, dataset, store).status == "ok"
    return store.out


@pytest.fixture
def store(made: Path, tmp_path: Path) -> Store:
    shutil.copytree(made, tmp_path / "work" / "results")
    return Store(tmp_path / "work" / "results", "twotank-sim", "strict")


@pytest.fixture
def parsed(monkeypatch: pytest.MonkeyPatch) -> list[bytes]:
    """The run.json that were read; files count as settled at once."""
    seen: list[bytes] = []
    whole = stores.parse_result
    monkeypatch.setattr(stores, "parse_result", lambda text: (seen.append(text), whole(text))[1])
    monkeypatch.setattr(index, "SETTLED_NS", 0)
    return seen


def run_file(store: Store, order: int) -> Path:
    return store.folder / "runs" / f"n4sid-n{order}-s0" / "run.json"


def tamper(path: Path, change: Callable[[dict], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def labels(store: Store) -> list[int]:
    return [result.spec.order for result in store.read().results]


def test_the_index_spares_reading_and_gives_the_same(store: Store, parsed: list[bytes]) -> None:
    first = store.read()
    assert len(parsed) == 3
    again = store.read()
    assert len(parsed) == 3
    assert again.results == first.results == store.results()
    assert not again.faults
    assert not list(store.out.rglob("rmse*"))


def test_files_that_have_just_changed_are_read_again(store: Store) -> None:
    """Two changes within one tick of the clock leave one time of change."""
    store.read()
    assert index.read_index(store.folder / "runs") == {}


def test_a_change_that_hides_is_seen(store: Store, parsed: list[bytes]) -> None:
    store.read()
    path = run_file(store, 2)
    before, text = path.stat(), path.read_text()
    changed = text.replace('"epochs": 0', '"epochs": 7')
    assert len(changed) == len(text) != 0
    with path.open("r+") as stream:  # in place, of the same size, with the same time
        stream.write(changed)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert [result.epochs for result in store.read().results] == [0, 7, 0]
    assert len(parsed) == 4


def test_a_damaged_index_is_rebuilt(store: Store, parsed: list[bytes]) -> None:
    expected = store.read().results
    path = store.folder / "runs" / index.NAME
    whole, draw = path.read_bytes(), random.Random(0)
    for _ in range(30):
        at = draw.randrange(len(whole))
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << draw.randrange(8)]) + whole[at + 1 :])
        assert store.read().results == expected
    for text in (b"", b"\n", whole[: len(whole) // 2], b"[" * 100_000, whole.replace(b'"index": 1', b'"index": 0')):
        path.write_bytes(text)
        assert store.read().results == expected
    count = len(parsed)
    assert store.read().results == expected
    assert len(parsed) == count


def test_a_folder_that_was_moved_with_its_index_is_not_believed(store: Store, parsed: list[bytes]) -> None:
    store.read()
    other = Store(store.out, "twotank-sim", "paper")
    store.folder.rename(other.folder)
    found = other.read()
    assert not found.results
    assert len(found.faults) == 3
    assert "in this folder, found twotank-sim/strict" in found.faults["n4sid-n1-s0"]


def test_a_folder_that_cannot_be_written_is_read(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(index, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError(30, "read-only")))
    assert labels(store) == [1, 2, 3]


def no_scores(run: dict) -> None:
    run["scores"][0]["rmse"] *= 1.0001


FAULTS: list[tuple[Callable[[dict], object], str]] = [
    (lambda run: run.pop("status"), "run.json' is not a finished run of this version (status: Field required"),
    (lambda run: run["spec"].update(seed=4), "found twotank-sim/strict/n4sid-n2-s4"),
    (no_scores, "signals.safetensors' disagrees with the run.json beside it (train y1: another score)"),
    (lambda run: run["spec"].update(data="0"), "another version of the data"),
]


@pytest.mark.parametrize(("change", "words"), FAULTS)
@pytest.mark.parametrize("command", slow_but((1,), ["compare", "report"]))
def test_what_is_wrong_is_named_left_out_and_never_overwritten(
    command: str, change: Callable[[dict], object], words: str, store: Store, nnss: Callable
) -> None:
    tamper(run_file(store, 2), change)
    before = run_file(store, 2).read_bytes()
    asked = ["compare", "twotank-sim", "--protocol", "strict", "--methods", "n4sid", "--orders", "1", "2", "3"]
    told = nnss(*(asked if command == "compare" else ["report"]))
    assert told.code == 1, told.err
    assert len([line for line in told.err.splitlines() if "left out" in line and words in line]) == 1, told.err
    table = (store.folder / "rmse.csv").read_text()
    assert "n4sid,1,0" in table
    assert "n4sid,3,0" in table
    assert "n4sid,2,0" not in table
    assert words in (store.folder / "rmse.md").read_text()
    assert run_file(store, 2).read_bytes() == before
    if command == "compare":
        assert nnss(*asked, "--force").code == 0  # asked for: replaced
        assert "n4sid,2,0" in (store.folder / "rmse.csv").read_text()


def test_a_run_without_its_signals_is_named(store: Store) -> None:
    (run_file(store, 3).parent / "signals.safetensors").unlink()
    found = store.read()
    assert [result.spec.order for result in found.results] == [1, 2]
    assert "signals.safetensors' cannot be read" in found.faults["n4sid-n3-s0"]


def test_a_run_that_is_replaced_while_it_is_read_is_no_fault(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its signals have gone when its run.json was read already: another command does it again."""
    whole = stores.read_tensors
    once = iter([True])

    def racing(path: Path) -> dict:
        if next(once, False):
            content = {name: (path.parent / name).read_bytes() for name in (path.name, "run.json")}
            for name in content:
                (path.parent / name).unlink()
            try:
                return whole(path)
            finally:
                for name, text in content.items():
                    (path.parent / name).write_bytes(text)
        return whole(path)

    monkeypatch.setattr(stores, "read_tensors", racing)
    found = store.read()
    assert not found.faults
    assert len(found.results) == 3


def test_one_table_has_one_set_of_options(store: Store) -> None:
    """Two of three seeds agree: the third is told, and does not decide."""
    results = store.read().results
    runs = [
        replace(results[0], spec=replace(results[0].spec, seed=seed, settings={"horizon": horizon}))
        for seed, horizon in ((0, "auto"), (1, "matlab"), (2, "auto"))
    ]
    table = agreeing(store, replace(store.read(), results=[*runs, *results[1:]]))
    assert [(r.spec.order, r.spec.seed) for r in table.results] == [(1, 0), (1, 2), (2, 0), (3, 0)]
    (line,) = table.left_out
    assert "n4sid, order 1, seed 1: another version or other options than most runs of it there" in line


def test_a_stray_does_not_stop_a_sweep_but_other_options_do(store: Store) -> None:
    from nnss_cli.datasets.catalog import load

    dataset = load(store.dataset, store.protocol)
    tamper(run_file(store, 2), lambda run: run["spec"].update(data="0"))
    planned = plan(store, dataset, select(["n4sid"]), ORDERS, [0], {}, False)
    assert (planned.todo, [r.spec.order for r in planned.done]) == ([], [1, 3])
    assert list(planned.faults) == ["n4sid-n2-s0"]
    settings = {"horizon": "matlab" if planned.done[0].spec.settings["horizon"] == "auto" else "auto"}
    with pytest.raises(InputError, match="horizon matlab|horizon auto"):
        plan(store, dataset, select(["n4sid"]), [1], [0], settings, False)


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("A", lambda a: a[:, :1], r"A: expected float64 \(1, 1\), found float64 \(2, 1\)"),
        ("B", lambda a: a.astype("float32"), r"B: expected float64 \(2, 1\), found float32"),
        ("C", lambda a: a.T.copy(), r"C: expected float64 \(1, 2\), found float64 \(2, 1\)"),
        ("D", lambda a: a * float("nan"), "D: expected finite numbers"),
        ("y_std", lambda a: a[:0], r"y_std: expected float64 \(1,\)"),
        ("u_mean", None, "missing u_mean, unknown none"),
    ],
)
def test_arrays_of_a_linear_model_have_its_shapes_and_types(
    name: str, change: Callable | None, words: str, store: Store
) -> None:
    folder = run_file(store, 2).parent
    arrays = read_tensors(folder / "model.safetensors")
    load_model(folder)
    changed = arrays | {name: change(arrays[name])} if change else {k: v for k, v in arrays.items() if k != name}
    write_tensors(folder / "model.safetensors", changed)
    with pytest.raises(InputError, match=words):
        load_model(folder)
