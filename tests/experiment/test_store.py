"""Runs on disk: what is tidied, taken in and read back, and what a run must be to be believed."""

import json
import os
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from nnss_cli.baselines import simba, ssest
from nnss_cli.baselines.kernels import linear_adjoint

from nnss_cli import lock
from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection_dynamics import _regression
from nnss_cli.experiment.run import RunResult, RunSpec, Score, score_outputs
from nnss_cli.experiment.schema import check_place, check_signals, parse_result
from nnss_cli.experiment.store import Store, records_of, stores
from nnss_cli.experiment.tune import draw, settings_of
from nnss_cli.model import kernels
from nnss_cli.training import fast

CHANNELS = {"inputs": ["u"], "outputs": ["y", "z"], "input_units": ["V"], "output_units": ["m", "K"]}
OFF = np.array([0.5, 1.0])  # by which simulations are wrong
SPEC = RunSpec("tank", "own", "n4sid", 2, 0, {"horizon": "auto"}, "d", "1")


def result(which: RunSpec = SPEC, **changed: Any) -> RunResult:
    scores = tuple(Score("test", f"y{i + 1}", 0.5 * (i + 1), 0.25, 50.0) for i in range(2))
    return replace(RunResult(which, "ok", "", scores, 0, 1.0, {"nnss": "1"}, {}, CHANNELS), **changed)


def signals(**changed: Any) -> dict[str, Any]:
    """Of one record: simulations that are off by a half and one."""
    y = np.arange(8.0).reshape(4, 2)
    kept = {"Ts": np.array([0.5]), "test/0/u": y[:, :1], "test/0/y": y, "test/0/y_sim": y + OFF, "test/0/x": y}
    return {name: value for name, value in (kept | changed).items() if value is not None}


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "out", "tank", "own")


# tidying


def test_what_killed_commands_left_is_removed_and_nothing_else(store: Store) -> None:
    store.write(result(), signals())
    done, runs = store.run_folder(SPEC), store.folder / "runs"
    other = replace(SPEC, seed=1)
    for folder in (store.folder, runs, done, runs / other.label):
        folder.mkdir(exist_ok=True)
        old = folder / ".tmp-abcdef"
        old.touch()
        os.utime(old, (time.time() - 1e6,) * 2)
        (folder / ".tmp-recent").touch()
    (runs / other.label / "model.json").touch()
    (runs / ".locks").mkdir(exist_ok=True)
    (runs / ".locks" / "stale").touch()
    with store.lock(replace(SPEC, seed=2)) as held:
        assert held
        store.run_folder(replace(SPEC, seed=2)).mkdir()
        store.tidy()
        assert store.run_folder(replace(SPEC, seed=2)).exists()  # somebody is at it
        assert [path.name for path in (runs / ".locks").iterdir()] == ["n4sid-n2-s2"]
    assert not (runs / other.label).exists()  # it was not finished
    for folder in (store.folder, runs, done):
        assert [path.name for path in folder.glob(".tmp-*")] == [".tmp-recent"], folder
    assert {path.name for path in done.iterdir()} == {".tmp-recent", "run.json", "signals.safetensors"}
    store.tidy()
    assert not store.run_folder(replace(SPEC, seed=2)).exists()


@pytest.mark.parametrize(
    ("module", "worker", "given"),
    [(fast, "FastEngine", ("float64",)), (ssest, "refine", ()), (simba, "loss_and_gradient", ())],
)
def test_processes_compile_in_turn(module: Any, worker: str, given: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who finds another one compiling waits for its end, then reads what that has kept."""
    waits, done = threading.Event(), []
    sleep = time.sleep
    monkeypatch.setattr(lock.time, "sleep", lambda seconds: (waits.set(), sleep(seconds)))
    monkeypatch.setattr(module, worker, lambda *_, **__: done.append(True) or MagicMock())
    kernel = kernels.loss_and_gradient if module is fast else linear_adjoint
    with lock.compiling(kernel):
        other = threading.Thread(target=module.warm_up.__wrapped__, args=given)
        other.start()
        assert waits.wait(60)
        assert not done
    other.join(60)
    assert done


def test_where_no_lock_can_be_kept_nobody_waits(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with lock.in_turn(tmp_path / "file" / "compiling.lock"), lock.in_turn(tmp_path / "file" / "compiling.lock"):
        pass
    with pytest.raises(OSError, match="of its own"), lock.in_turn(tmp_path / "compiling.lock"):
        raise OSError("of its own")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_lock_is_held_by_one(store: Store) -> None:
    with store.lock(SPEC) as first, store.lock(SPEC) as second, store.lock(replace(SPEC, seed=1)) as other:
        assert (first, second, other) == (True, False, True)
    with store.lock(SPEC) as again:
        assert again


def test_an_error_of_the_disk_says_what_is_kept(store: Store) -> None:
    with (
        pytest.raises(InputError, match=r"cannot write to '.*own': No space .*the finished runs are kept"),
        store.writing(),
    ):
        raise OSError(28, "No space left on device")
    with pytest.raises(InputError, match="cannot write to .*: gone"), store.writing():
        raise OSError("gone")


def test_folders_of_runs_are_found_in_order(tmp_path: Path) -> None:
    for name in ("b/own", "a/strict", "a/own"):
        (tmp_path / name / "runs").mkdir(parents=True)
    (tmp_path / "c" / "own").mkdir(parents=True)
    (tmp_path / "c" / "own" / "runs").touch()
    assert [(one.dataset, one.protocol) for one in stores(tmp_path)] == [("a", "own"), ("a", "strict"), ("b", "own")]
    assert stores(tmp_path / "none") == []


def test_runs_are_read_back_by_method_order_and_seed(store: Store) -> None:
    order = [("n4sid", 2, 0), ("n4sid", 2, 10), ("n4sid", 10, 0), ("nnss", 1, 0)]
    for method, n, seed in reversed(order):
        store.write(result(replace(SPEC, method=method, order=n, seed=seed)), signals())
    for found in (store.results(), store.read().results):
        assert [(r.spec.method, r.spec.order, r.spec.seed) for r in found] == order
    assert store.find(replace(SPEC, seed=9)) is None
    assert store.stamp(replace(SPEC, seed=9)) is None
    before = store.stamp(SPEC)
    store.write(result(fit_seconds=2.0), signals())
    assert store.stamp(SPEC) != before
    store.clear(SPEC)
    assert store.find(SPEC) is None
    assert not store.run_folder(SPEC).exists()


def test_the_splits_of_a_run_have_an_order_of_their_own(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tensors come from their file in any order; what is written of the splits, an export, must be the same twice."""
    names = ("warm", "val", "cold", "train")
    kept = {f"{split}/0/{of}": np.zeros((3, 1)) for split in names for of in "uy"}
    monkeypatch.setattr("nnss_cli.experiment.store.read_tensors", lambda _: kept)
    assert list(records_of(store.folder, 0.5)) == ["train", "val", "cold", "warm"]


def test_the_records_of_a_run_come_back_by_split(store: Store) -> None:
    y = np.ones((3, 2))
    more = {
        "test/1/u": y[:, :1],
        "test/1/y": y,
        "test/1/y_sim": y + OFF,
        "test/1/x": y,
        "val/0/u": y,
        "val/0/y": y,
    }
    store.write(result(), signals(**more))
    found = records_of(store.run_folder(SPEC), 0.5)
    assert {split: [len(record) for record in records] for split, records in found.items()} == {
        "test": [4, 3],
        "val": [3],
    }
    assert found["test"][0].y.tolist() == signals()["test/0/y"].tolist()
    assert found["test"][0].Ts == 0.5


# taking in


def packed(store: Store, one: RunResult | None = None, **files: bytes) -> dict[str, bytes]:
    kept = one or result()
    made = Store(store.out.parent / "elsewhere", kept.spec.dataset, kept.spec.protocol)
    made.write(kept, signals() if kept.status == "ok" else {})
    return {path.name: path.read_bytes() for path in made.run_folder(kept.spec).iterdir()} | files


def test_a_run_of_elsewhere_is_taken_in_whole(store: Store) -> None:
    store.run_folder(SPEC).mkdir(parents=True)
    (store.run_folder(SPEC) / "left").touch()
    assert store.adopt(packed(store, **{"model.json": b"{}"})) == store.find(SPEC)
    assert {path.name for path in store.run_folder(SPEC).iterdir()} == {"run.json", "model.json", "signals.safetensors"}
    lost = result(replace(SPEC, seed=1), status="crashed", reason="why", scores=())
    assert store.adopt(packed(store, lost)).status == "crashed"


@pytest.mark.parametrize(
    ("one", "files", "message"),
    [
        (None, {"../x": b""}, "files: expected run.json"), (None, {".hidden": b""}, "files: expected run.json"),
        (None, {"run.json": b"{"}, "Invalid JSON"), (None, {"signals.safetensors": b""}, r"\w"),
        (result(replace(SPEC, dataset="other")), {}, "expected tank/own/n4sid-n2-s0 in this folder, found other/own"),
        (result(replace(SPEC, protocol="strict")), {}, "found tank/strict/n4sid-n2-s0"),
        (result(replace(SPEC, method="a/b")), {}, "spec: expected a plain name"),
    ],
)  # fmt: skip
def test_a_run_that_is_damaged_or_anothers_is_not_taken_in(
    one: RunResult | None, files: dict[str, bytes], message: str, store: Store
) -> None:
    if one is not None and "/" in one.spec.method:
        content = json.dumps(one.to_json()).encode()
        given = packed(store) | {"run.json": content}
    else:
        given = packed(store, one, **files)
    with pytest.raises(ValueError, match=message):
        store.adopt(given)
    assert store.results() == []


# what a run must be


def text(**changed: Any) -> bytes:
    return json.dumps(result(**changed).to_json()).encode()


GOOD = result().scores


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"spec": replace(SPEC, order=0)}, "order and seed: expected at least 1 and 0"),
        ({"spec": replace(SPEC, seed=-1)}, "order and seed"),
        ({"reason": "why"}, "reason: expected one where the status is not ok, and only there"),
        ({"status": "failed", "scores": ()}, "reason: expected one"),
        ({"scores": ()}, "scores: expected some where the status is ok"),
        ({"status": "failed", "reason": "why"}, "scores: expected some"),
        ({"channels": CHANNELS | {"output_units": ["m"]}}, "channels: a unit each"),
        ({"channels": CHANNELS | {"input_units": ["m", "V"]}}, "channels: a unit each"),
        ({"channels": {"outputs": ["y"]}}, "inputs: Field required"),
        ({"scores": GOOD[:1]}, "scores of 'test': expected one for each output"),
        ({"scores": (*GOOD, GOOD[0])}, "scores of 'test': expected one for each output"),
        ({"scores": (GOOD[0], replace(GOOD[1], output="y3"))}, "scores of 'test'"),
        ({"scores": (*GOOD, replace(GOOD[0], split="val"))}, "scores of 'val'"),
        ({"scores": (GOOD[0], replace(GOOD[1], rmse=-1e-9))}, "scores: expected finite errors, not negative"),
        ({"scores": (GOOD[0], replace(GOOD[1], nrmse=-1e-9))}, "scores: expected finite errors"),
    ],
)  # fmt: skip
def test_fields_that_contradict_each_other_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_result(text(**changed))


def test_a_sound_run_is_read_as_it_was() -> None:
    zero = (replace(GOOD[0], rmse=0.0, nrmse=0.0, fit_percent=-50.0), GOOD[1])
    for one in (result(), result(scores=zero), result(status="memory", reason="why", scores=()),
                result(replace(SPEC, order=1))):  # fmt: skip
        assert parse_result(json.dumps(one.to_json()).encode()) == one
    check_place(result(), "tank", "own", "n4sid-n2-s0")
    for place in (("x", "own", "n4sid-n2-s0"), ("tank", "x", "n4sid-n2-s0"), ("tank", "own", "n4sid-n2-s1")):
        with pytest.raises(ValueError, match=f"spec: expected {'/'.join(place)} in this folder, found tank/own"):
            check_place(result(), *place)


Y = signals()["test/0/y"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"Ts": None}, "Ts: expected one number"), ({"Ts": OFF}, "Ts"), ({"Ts": np.array([0.0])}, "Ts"),
        ({"Ts": np.array([1])}, "Ts"), ({"test/0/u": None}, "test/0: expected u, y, y_sim and x"),
        ({"test/0/x": np.zeros(4)}, "test/0: expected u, y"), ({"test/0/x": np.zeros((4, 1), int)}, "test/0: expected"),
        ({"test/0/u": Y[:3, :1]}, "test/0: of different lengths"),
        ({"test/0/x": Y[:3]}, "test/0: of different lengths"),
        ({"test/0/u": np.zeros((5, 1))}, "test/0: of different lengths"),
        ({"test/0/x": np.zeros((5, 1))}, "test/0: of different lengths"),
        ({"test/0/y_sim": Y[:, :1]}, "test/0: of different lengths"), ({"test/0/y": None}, "test: no signals"),
        ({"test/0/y_sim": Y + OFF * [1, 1.001]}, "test y2: another score"),
        ({"test/0/y_sim": Y + OFF * [1.001, 1]}, "test y1: another score"),
        ({f"test/0/{name}": Y[:0] for name in ("u", "y", "y_sim", "x")}, "test: no signals"),
        ({f"test/0/{name}": Y[:, :1] for name in ("y", "y_sim")} | {"test/0/y_sim": Y[:, :1] + 0.5},
         "test: no output y2"),
    ],
)  # fmt: skip
def test_signals_that_are_not_those_that_were_scored_are_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_signals(result(), signals(**changed))


def test_any_number_of_first_samples_may_not_be_scored_and_records_are_scored_together() -> None:
    check_signals(result(), signals())
    lost = signals()["test/0/y_sim"].copy()
    lost[:2] += 9.0  # two samples told x(0)
    check_signals(result(), signals(**{"test/0/y_sim": lost}))
    lost[3] += 9.0
    with pytest.raises(ValueError, match="another score"):
        check_signals(result(), signals(**{"test/0/y_sim": lost}))
    second = {"test/1/u": Y[:2, :1], "test/1/y": Y[:2], "test/1/x": Y[:2]}
    check_signals(result(), signals(**second | {"test/1/y_sim": Y[:2] + OFF * [-1, 1]}))
    with pytest.raises(ValueError, match="another score"):
        check_signals(result(), signals(**second | {"test/1/y_sim": Y[:2]}))


def test_scores_are_pooled_over_records_and_a_flat_output_has_no_fit() -> None:
    class Scaling:
        y_std = np.array([2.0, 4.0])

    y = [np.array([[0.0, 5.0], [2.0, 5.0]]), np.array([[10.0, 5.0]])]
    found = score_outputs("test", y, [y[0] + [1.0, 2.0], y[1] + [1.0, 2.0]], Scaling())  # type: ignore[arg-type]
    assert [(s.split, s.output, s.rmse, s.nrmse) for s in found] == [("test", "y1", 1.0, 0.5), ("test", "y2", 2.0, 0.5)]
    # deviations from each record's own mean: −1, 1 and 0
    assert found[0].fit_percent == pytest.approx(100 * (1 - 1 / np.sqrt(2 / 3)))
    assert found[1].fit_percent == 0.0


# what a search draws


class Bounds:
    """A trial that draws the upper bounds, and keeps all of them."""

    def __init__(self) -> None:
        self.asked: dict[str, tuple[Any, ...]] = {}

    def keep(self, name: str, low: float, high: float, log: bool = False) -> float:
        self.asked[name] = (low, high, log)
        return high

    suggest_int = suggest_float = keep

    def suggest_categorical(self, name: str, values: list[int]) -> int:
        self.asked[name] = tuple(values)
        return values[-1]


def test_a_search_varies_what_the_papers_did_within_its_bounds() -> None:
    trial: Any = Bounds()
    values = draw(trial, 1000, {})
    assert trial.asked == {
        "depth": (1, 6, False), "width": (8, 200, True), "encoder_depth": (1, 4, False),
        "encoder_width": (4, 128, True),
        "window": (20, 400, True), "consistency": (1e-4, 1.0, True), "learning_rate": (1e-4, 1e-2, True),
        "batch": (1, 8, 32, 64),
    }  # fmt: skip
    assert settings_of(values, {}) == {
        "optimiser": "adam", "initial": "random", "feedthrough": "no", "hidden": (200,) * 6, "encoder": (128,) * 4,
        "window": 400, "stride": 20, "consistency": 1.0, "learning_rate": 1e-2, "batch": 64,
    }  # fmt: skip
    short: Any = Bounds()
    draw(short, 15, {})
    assert short.asked["window"] == (15, 15, True)
    some: Any = Bounds()
    given = {"hidden": (3,), "window": 9, "optimiser": "gauss-newton", "stride": 2}
    assert settings_of(draw(some, 1000, given), given)["stride"] == 2
    assert set(some.asked) == {"encoder_depth", "encoder_width", "consistency"}
    assert settings_of({"window": 19}, {})["stride"] == 1
    assert settings_of({"window": 40}, {})["stride"] == 2


# the rows of an inspection's regression


@pytest.fixture
def data() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((9000, 3))


def test_rows_of_a_regression_are_each_sample_once(data: np.ndarray) -> None:
    u, v, y = data.T
    blocks = list(_regression([data, data[:7], data[:2]], 2, 0, 2, 3))
    assert [len(block) for block in blocks] == [4096, 4096, 9000 - 3 - 8192, 4]
    rows = np.concatenate(blocks[:3])
    k = np.arange(3, 9000)
    expected = [y[k - 1], y[k - 2], u[k - 3], u[k - 2], u[k - 1], u[k], v[k - 3], v[k - 2], v[k - 1], v[k], y[k]]
    np.testing.assert_array_equal(rows, np.stack(expected, axis=1))


def test_products_stand_between_a_constant_and_the_output(data: np.ndarray) -> None:
    u, y = data[:50, 0], data[:50, 2]
    (rows,) = _regression([data[:50, [0, 2]]], 1, 0, 1, 2, [1])
    k = np.arange(3, 50)
    bases = [y[k - 1], y[k - 2], u[k - 1], u[k - 2]]
    powers = [base**power for base in bases for power in (2, 3)]
    expected = [np.ones(47), y[k - 1], u[k - 2], u[k - 1], u[k], *powers, y[k - 1] * u[k - 1], y[k]]
    np.testing.assert_allclose(rows, np.stack(expected, axis=1), rtol=1e-15)
