"""Models opened from their folders: the same numbers, what is known of them, and one line where it cannot be done."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from nnss_cli.datasets.record import Record, Simulation

import nnss_cli
from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import execute, simulate_splits
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import METHODS, compiled, load_model, select
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import FORMAT, read_model, read_tensors, write_tensors
from nnss_cli.testing import small_dataset
from nnss_cli.trained import TrainedModel, load
from nnss_cli.trained.signals import as_samples, as_values
from nnss_cli.training import fast
from nnss_cli.training.recipe import Recipe

QUICK = {"epochs": 1, "hidden": (3,), "encoder": (2,)}


def test_import_is_light() -> None:
    code = "import sys, nnss_cli; dir(nnss_cli); print(*sys.modules)"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    )
    assert not loaded & {"torch", "numpy", "scipy", "pandas", "matplotlib", "control", "typer"}


def test_every_public_name_is_there() -> None:
    for name in nnss_cli.__all__:
        assert getattr(nnss_cli, name) is not None
        assert name in dir(nnss_cli)
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        nnss_cli.lode  # noqa: B018


@pytest.mark.parametrize(("method", "settings"), [("n4sid", {}), ("nnss", QUICK)])
def test_a_loaded_model_simulates_as_its_run_did(
    method: str, settings: dict, trained_folder: Callable[..., Path]
) -> None:
    folder = trained_folder(method, **settings)
    model = nnss_cli.load(str(folder))
    assert (model.order, model.init_window, model.Ts) == (2, 1, 0.5)
    assert model.channels.inputs == ("u1",)
    assert model.fingerprint == small_dataset().fingerprint()
    assert model.origin is not None
    assert model.origin.method == method
    assert model.scaling is not None
    record = model.records()["test"][0]
    run = json.loads((folder / "run.json").read_text())
    error = model.simulate(record.u, record.y[:1]).y - record.y
    rmse = next(score["rmse"] for score in run["scores"] if score["split"] == "test")
    assert float(np.sqrt(np.mean(error**2))) == pytest.approx(rmse, rel=1e-12)
    assert load(folder.parents[3]).folder == folder  # the folder of `nnss train --out`


def test_signals_of_any_kind(trained_folder: Callable[..., Path]) -> None:
    model = load(trained_folder(r=2, m=2))
    random = np.random.default_rng(0)
    u, y = random.standard_normal((20, 2)), random.standard_normal((3, 2))
    expected = model.model.simulate(u, y).y
    frame = pd.DataFrame({"other": 1.0, "u2": u[:, 1], "u1": u[:, 0]})
    outputs = pd.DataFrame(y, columns=["y1", "y2"])
    for inputs, first in ((u, y), (u.tolist(), y.tolist()), (frame, outputs)):
        np.testing.assert_array_equal(model.simulate(inputs, first).y, expected)
    np.testing.assert_array_equal(model.simulate(u, y[0]).y, model.model.simulate(u, y[:1]).y)
    row = outputs[["y2", "y1"]].iloc[0]  # by its names, as a table is
    np.testing.assert_array_equal(model.simulate(u, row).y, model.model.simulate(u, y[:1]).y)
    there = model.equilibrium(frame[["u2", "other", "u1"]].iloc[4])
    np.testing.assert_array_equal(there.y, model.equilibrium(u[4]).y)
    np.testing.assert_array_equal(model.equilibrium(pd.Series(u[4])).y, there.y)
    one = load(trained_folder())
    expected = one.model.simulate(u[:, :1], y[:2, :1]).y
    for inputs, first in ((u[:, 0], y[:2, 0]), (pd.Series(u[:, 0]), list(y[:2, 0]))):
        np.testing.assert_array_equal(one.simulate(inputs, first).y, expected)
    np.testing.assert_array_equal(one.simulate(u[:, 0], 0.5).y, one.model.simulate(u[:, :1], np.array([[0.5]])).y)
    table = pd.DataFrame({"u1": u[:, 0], "y1": np.arange(20.0)})  # a row is one sample, and not one of each column
    row = one.simulate(table, table.iloc[3]).y
    np.testing.assert_array_equal(row, one.simulate(table, table[3:4]).y)
    np.testing.assert_array_equal(one.simulate(table.iloc[3], 0.5).y, one.simulate(table[3:4], 0.5).y)


def test_a_label_that_is_a_number_is_no_name() -> None:
    """Column 1 of `read_csv(header=None)` is the second; the channel '1' of a file without a header is the first."""
    table = pd.DataFrame({0: [1.0, 2.0], 1: [3.0, 4.0]})
    with pytest.raises(InputError, match="u: expected the columns 1, found 0, 1 .numbers, not names"):
        as_samples("u", table, ["1"])
    np.testing.assert_array_equal(as_samples("u", table[0], ["1"]), [[1], [2]])
    np.testing.assert_array_equal(as_samples("u", table.rename(columns=str), ["1"]), [[3], [4]])
    with pytest.raises(InputError, match="u: expected a finite number for each of 1, found"):
        as_values("u", table.iloc[0], ["1"])


@pytest.mark.parametrize(
    ("u", "y_init", "told"),
    [
        (np.zeros(5), np.zeros((1, 2)), r"u: expected samples × 2 for u1, u2, found an array of shape \(5,\)"),
        (np.zeros((2, 5)), np.zeros((1, 2)), "transposed"),
        (pd.DataFrame({"u1": [0.0], "v": [0.0]}), np.zeros(2), "expected the columns u1, u2, found u1, v"),
        ([[0.0, np.nan]], np.zeros(2), "sample 0 of 'u2' is nan"),
        ([["a", "b"]], np.zeros(2), "expected numbers"),
        (np.ma.masked_equal([["a", "b"]], "b"), np.zeros(2), "u: expected numbers"),
        ([[10**400, 1]], np.zeros(2), "u: expected numbers: int too large to convert to float"),
        (np.zeros((2, 2)), [1, -(10**400)], "y_init: expected numbers: int too large to convert to float"),
        (pd.DataFrame(np.zeros((3, 2))), np.zeros(2), "u: expected the columns u1, u2, found 0, 1 .numbers, not names"),
        (np.ma.masked_equal([[0.0, 9.0]], 9.0), np.zeros(2), "sample 0 of 'u2' is nan"),
        (np.zeros((2, 2)), np.ma.masked_equal([0.0, 9.0], 9.0), "y_init: expected a finite number for each of y1, y2"),
        (np.zeros((2, 2)) + 1j, np.zeros(2), "u: expected real numbers, found complex ones: give real and imaginary"),
        (np.zeros((2, 2)), np.zeros(2, complex), "y_init: expected real numbers, found complex ones"),
        (np.zeros((2, 2), "M8[s]"), np.zeros(2), "u: expected real numbers, found dates"),
        (np.zeros((2, 2)), np.zeros(2, "m8[ms]"), "y_init: expected real numbers, found durations"),
        (np.zeros((2, 2)), np.zeros((3, 2)), "y_init: expected 1 to 2 samples"),
        (np.zeros((0, 2)), np.zeros(2), r"shape \(0, 2\)"),
    ],
)
def test_wrong_signals_are_named(u: object, y_init: object, told: str, trained_folder: Callable[..., Path]) -> None:
    with pytest.raises(InputError, match=told) as error:
        load(trained_folder(r=2, m=2)).simulate(u, y_init)
    assert "\n" not in str(error.value)


def test_a_whole_number_beyond_all_floats_is_refused_wherever_values_are_given(
    untrained: Callable[..., TrainedModel],
) -> None:
    model, huge = untrained(n=2), 10**400
    masked = np.ma.masked_array(np.array([1, huge], dtype=object), [True, False])
    for name, call in (
        ("u", lambda: model.simulate([1, huge])), ("u", lambda: model.simulate(pd.Series([1, huge]))),
        ("u", lambda: model.simulate(masked)), ("y_init", lambda: model.simulate([1.0], huge)),
        ("x0", lambda: model.simulate([1.0], x0=[huge, 1])), ("u", lambda: model.linearise(huge)),
        ("u", lambda: model.equilibrium(huge)), ("x", lambda: model.matrices([1, huge])),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"^{name}: expected numbers: int too large to convert to float$"):
            call()
    with pytest.raises(InputError, match="^y: expected numbers: int too large"):
        Record([1, 2], [1, huge], 0.5)


@pytest.mark.parametrize("kind", [{}, {"scheduling": "x+u+y", "m": 2}, {"integrator": True, "scheduling": "x+u"}])
def test_from_a_state_it_is_the_same_in_compiled_code(
    kind: dict, untrained: Callable[..., TrainedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    model, random = untrained(n=3, **kind), np.random.default_rng(1)
    u, z0 = random.standard_normal((200, 1)), 0.3 * random.standard_normal(model.system.size)
    starts = [{"x0": z0}, *[{}] * ("integrator" not in kind)]  # which is at rest nowhere
    monkeypatch.setattr(compiled, "LONG", len(u) + 1)
    plain = [model.simulate(u, **start) for start in starts]
    monkeypatch.setattr(compiled, "LONG", 1)
    fast = [model.simulate(u, **start) for start in starts]
    assert any((one.x != other.x).any() for one, other in zip(fast, plain, strict=True)), "nothing was compiled"
    for one, other in zip(fast, plain, strict=True):
        np.testing.assert_allclose(one.y, other.y, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(one.x, other.x, rtol=1e-9, atol=1e-9)


def test_a_process_makes_compiled_simulations_ready_once(
    untrained: Callable[..., TrainedModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compiled, "LONG", 1)
    locked: list[object] = []
    own = fast.compiling
    monkeypatch.setattr(fast, "compiling", lambda kernel: locked.append(kernel) or own(kernel))
    fast._warm_up_runs.cache_clear()
    for seed in (0, 1):
        untrained(n=3, seed=seed).simulate(np.ones((20, 1)), np.ones(1))
    assert len(locked) == 1


def test_a_runs_scores_are_of_the_same_simulation(
    untrained: Callable[..., TrainedModel], small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Long records are scored, and members chosen, in compiled code: never by the model's own steps."""
    dataset = small_data(K=90)
    candidates = [untrained(n=3, seed=seed) for seed in range(3)]
    (record,) = dataset.tests["test"]
    own = candidates[0].model.simulate(record.u, record.y[:1]).y
    plain, longest = NNSS.simulate, []

    def watched(self: NNSS, u: np.ndarray, y_init: np.ndarray) -> Simulation:
        longest.append(len(u))
        return plain(self, u, y_init)

    monkeypatch.setattr(NNSS, "simulate", watched)
    monkeypatch.setattr(compiled, "LONG", 20)
    _, signals = simulate_splits(candidates[0].model, dataset)
    ensemble = METHODS["nnss-ensemble"].combine([each.model for each in candidates], dataset.fitting).model
    _, of_three = simulate_splits(Ensemble(tuple(each.model for each in candidates), "clipped"), dataset)
    simulate_splits(ensemble, dataset)
    assert set(longest) == {1}
    each = [one.simulate(record.u, record.y[:1]).y for one in candidates]
    expected = Ensemble(tuple(one.model for one in candidates), "clipped").together(np.stack(each))
    np.testing.assert_array_equal(of_three["test/0/y_sim"], expected)
    assert (expected != np.mean(each, axis=0)).any()
    np.testing.assert_array_equal(
        signals["test/0/y_sim"], candidates[0].simulate(record.u, record.y[:1]).y, strict=True
    )
    np.testing.assert_allclose(signals["test/0/y_sim"], own, rtol=1e-9, atol=1e-9)


def test_a_long_record_of_a_linear_model_needs_no_torch() -> None:
    code = """import sys
from nnss_cli.experiment.execute import simulate_splits
from nnss_cli.methods import compiled, select
from nnss_cli.testing import small_dataset
dataset = small_dataset(K=90)
compiled.LONG = 1
model = select(["n4sid"])[0].fit(dataset.fitting, 2, 0, {"horizon": "matlab"}, None).model
simulate_splits(model, dataset)
assert "torch" not in sys.modules"""
    subprocess.run([sys.executable, "-c", code], check=True)


def changed(folder: Path, tmp_path: Path, **changes: object) -> Path:
    """A copy of a model whose model.json has other values; without those that are None."""
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    content = json.loads((copy / "model.json").read_text()) | changes
    (copy / "model.json").write_text(json.dumps({key: value for key, value in content.items() if value is not None}))
    return copy


@pytest.mark.parametrize("Ts", [-1, 0, float("nan"), float("inf"), 1e-400, "0.1", True])
def test_a_sampling_time_that_is_none_is_damage(Ts: object, trained_folder: Callable, tmp_path: Path) -> None:
    """A simulation would write it as its clock."""
    with pytest.raises(InputError, match=r"model.json': Ts: expected seconds above 0, found .*; train it again$"):
        load(changed(trained_folder(), tmp_path, Ts=Ts))


@pytest.mark.parametrize("path", [3, None, ["a"]])
def test_what_is_no_path_holds_no_model(path: Any) -> None:
    with pytest.raises(InputError, match="^model: expected the path of a folder, found "):
        load(path)


def test_a_model_alone_knows_where_it_comes_from(trained_folder: Callable[..., Path], tmp_path: Path) -> None:
    folder = trained_folder()
    for name in ("model.json", "model.safetensors"):
        shutil.copy(folder / name, tmp_path / name)
    model = load(tmp_path)
    assert model.fingerprint == small_dataset().fingerprint()
    assert model.records() == {}


def test_older_folders_load(trained_folder: Callable[..., Path], tmp_path: Path) -> None:
    folder = changed(trained_folder(), tmp_path, format=None, training=None)
    model = load(folder)
    assert model.origin is not None
    assert (model.origin.init_window, model.init_window, model.order) == (None, 1, 2)
    assert model.fingerprint == small_dataset().fingerprint()
    (folder / "run.json").unlink()
    bare = load(folder)
    assert (bare.origin, bare.fingerprint, bare.order, bare.init_window) == (None, None, 2, 1)
    u = np.random.default_rng(0).standard_normal(9)
    np.testing.assert_array_equal(bare.simulate(u, 1.0).y, load(trained_folder()).simulate(u, 1.0).y)


@pytest.mark.system
def test_how_far_off_guesses_are_is_kept_and_older_folders_have_states_of_size_one(
    trained_folder: Callable[..., Path], tmp_path: Path
) -> None:
    folder, dataset = trained_folder("nnss", **QUICK), small_dataset()
    tensors = read_tensors(folder / "model.safetensors")
    kept = tensors["initial_spread"]
    model = NNSS.from_file(*read_model(folder))
    engine = fast.FastEngine(model, [np.ones((3, 1))], [np.ones((3, 1))], Recipe(dtype=model.architecture.dtype))
    np.testing.assert_allclose(engine.see(dataset.fitting.normalised()[0]), kept, rtol=1e-6)
    assert np.abs(kept - np.eye(2)).max() > 0.01
    (older := tmp_path / "older").mkdir()
    shutil.copy(folder / "model.json", older)
    write_tensors(older / "model.safetensors", {name: tensors[name] for name in tensors.keys() - {"initial_spread"}})
    bare = load(changed(older, tmp_path, format=2))
    model.initial_spread.copy_(torch.eye(2))
    u, y = np.random.default_rng(0).standard_normal((2, 30, 1))
    np.testing.assert_array_equal(bare.simulate(u, y).y, model.simulate(u, y).y)
    assert np.abs(load(folder).simulate(u, y).y - model.simulate(u, y).y).max() > 1e-6


@pytest.mark.system
def test_equal_trainings_give_equal_folders(trained_folder: Callable[..., Path], tmp_path: Path) -> None:
    """To the byte, whenever and by whichever command; an earlier version's model, which kept its times, loads."""
    dataset, folder = small_dataset(), trained_folder("nnss", **QUICK)
    store = Store(tmp_path / "again", dataset.name, dataset.protocol)
    (spec,) = plan(store, dataset, select(["nnss"]), [2], [0], QUICK, False).todo
    execute(spec, dataset, store, command="another")
    for name in ("model.json", "model.safetensors"):
        assert (store.run_folder(spec) / name).read_bytes() == (folder / name).read_bytes()
    training = json.loads((folder / "model.json").read_text())["training"]
    times = {"seconds": "4.428", "started": "2026-11-26T09:35:06.487+00:00", "command": "nnss compare"}
    training["provenance"] |= times
    older = load(changed(folder, tmp_path, training=training)).origin
    assert older is not None
    assert times.items() <= older.provenance.items()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"format": FORMAT + 1}, f"is of format {FORMAT + 1}, this nnss reads up to {FORMAT}: install"),
        ({"format": "two"}, "format: expected a whole number"),
        ({"format": True}, "format: expected a whole number"),
        ({"training": {"dataset": "small"}}, "training: protocol: Field required"),
        ({"training": 3}, "training: "),
    ],
)
def test_folders_of_later_versions_and_damaged_ones(
    changes: dict, told: str, trained_folder: Callable[..., Path], tmp_path: Path
) -> None:
    folder = changed(trained_folder(), tmp_path, **changes)
    with pytest.raises(InputError, match=told) as error:
        load(folder)
    assert "\n" not in str(error.value)


def test_where_there_is_no_model_or_more_than_one(trained_folder: Callable[..., Path], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder: '.*nowhere'"):
        load(tmp_path / "nowhere")
    with pytest.raises(InputError, match="holds no trained model"):
        load(tmp_path)
    for name in ("a", "b"):
        shutil.copytree(trained_folder(), tmp_path / name)
    with pytest.raises(InputError, match="holds 2 trained models: name one of '.*a', '.*b'"):
        load(tmp_path)


def test_readers_see_their_own_facts_only(trained_folder: Callable[..., Path]) -> None:
    folder = trained_folder()
    seen: dict = {}
    content = json.loads((folder / "model.json").read_text())
    assert {"format", "training"} < set(content)
    (copy := folder.parent / "copy").mkdir()
    shutil.copy(folder / "model.safetensors", copy)
    (copy / "model.json").write_text(json.dumps(content | {"kind": "mine"}))
    load_model(copy, {"mine": lambda description, _: seen.update(description)})
    assert set(seen) == {"kind", "Ts", "channels"}
    shutil.rmtree(copy)
