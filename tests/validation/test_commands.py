"""`nnss predict`, `nnss validate`, `--interval`: what they write and say, when they fail, what they refuse."""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from nnss_cli.datasets.record import Dataset, Record
from safetensors.numpy import load_file, save_file

from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.report.tables import number
from nnss_cli.trained import load
from nnss_cli.validation.residuals import dependence, whiteness
from nnss_cli.validation.trained import forecaster


def write(record: Record, path: Path) -> Path:
    pd.DataFrame({"y1": record.y[:, 0], "u1": record.u[:, 0]}).to_csv(path, index=False, float_format="%.17g")
    return path


@pytest.fixture
def new(tmp_path: Path, plant_data: Callable[..., Dataset]) -> Path:
    """A file of the test record."""
    return write(plant_data().tests["test"][0], tmp_path / "new.csv")


@pytest.mark.system
def test_predict_writes_what_the_predictor_predicts(
    new: Path, nnss: Callable, plant_run: Callable[..., Path], plant_data: Callable[..., Dataset]
) -> None:
    done = nnss("predict", plant_run(), new, "--horizon", "3", "--interval", "0.9", "--plot", "--out", "a/out.csv")
    assert done.code == 0, done.err
    record = plant_data().tests["test"][0]
    found = pd.read_csv("a/out.csv")
    assert list(found.columns) == ["time", "y1", "y1_low", "y1_high"]
    expected = forecaster(load(plant_run())).predict(record, 3)[:, 0]
    np.testing.assert_allclose(found["y1"], expected, rtol=1e-9)
    held = np.mean((found["y1_low"] <= record.y[:, 0])[1:] & (record.y[:, 0] <= found["y1_high"])[1:])
    assert f"it holds {100 * held:.1f} % here" in done.out
    assert 0.85 < held < 0.95
    assert Path("a/out.png").stat().st_size > 10_000
    assert "persistence" in done.out
    for horizon in ("1", "2", "3", "∞"):
        assert f" {horizon} " in done.out


@pytest.mark.system
def test_the_band_is_the_validation_records_alone(
    new: Path, nnss: Callable, plant_run: Callable[..., Path], plant_data: Callable[..., Dataset]
) -> None:
    """Another new record changes nothing of its width."""
    record = plant_data().tests["test"][0]
    write(Record(record.u, 50 * record.y, 0.5), Path("other.csv"))
    for command in (("simulate",), ("predict", "--horizon", "2")):
        widths = []
        for file in (new, "other.csv"):
            done = nnss(command[0], plant_run(), file, *command[1:], "--interval", "0.8", "--out", "p.csv", "--force")
            assert done.code == 0, done.err
            table = pd.read_csv("p.csv")
            widths.append((table["y1_high"] - table["y1_low"]).round(9).unique())
        np.testing.assert_array_equal(*widths)
        assert len(widths[0]) == 1


@pytest.mark.system
def test_predict_with_a_guard_and_an_adaptive_band(
    nnss: Callable, plant_run: Callable[..., Path], plant_data: Callable[..., Dataset]
) -> None:
    """On another plant's record; the table has guarded errors either way, a simulation has no such band."""
    record = plant_data().tests["test"][0]
    lost = Record(record.u, record.y + 200, record.Ts)
    write(lost, Path("lost.csv"))
    options = ("--horizon", "2", "--interval", "0.9", "--interval-by", "adaptive")
    plain = nnss("predict", plant_run(), "lost.csv", *options, "--out", "plain.csv")
    guarded = nnss("predict", plant_run(), "lost.csv", *options, "--guard", "--out", "guarded.csv", "--plot")
    assert (plain.code, guarded.code) == (0, 0), guarded.err
    for name, flag in (("plain", False), ("guarded", True)):
        found, expected = pd.read_csv(f"{name}.csv"), forecaster(load(plant_run()), guarded=flag)
        np.testing.assert_allclose(found["y1"], expected.predict(lost, 2)[:, 0], rtol=1e-9)
        limits = expected.limits(lost, 2, 0.9, "adaptive")
        np.testing.assert_allclose(found[["y1_low", "y1_high"]], np.hstack(limits.pair), rtol=1e-9)
        assert limits.held is not None
        done = guarded if flag else plain
        assert f"by the coverage seen (step {limits.adaptive.steps[0]:g})" in done.out  # type: ignore[union-attr]
        assert f"it holds {100 * limits.held[0]:.1f} % here" in done.out
        assert ("guard, y1: persistence had " in done.out) == flag
        assert "guarded" in done.out.split("persistence")[0]
        error = np.sqrt(np.mean((found["y1"] - lost.y[:, 0])[1:] ** 2))
        assert number(float(error)) in done.out.split()
    refused = nnss("simulate", plant_run(), "lost.csv", *options[2:], "--out", "none.csv")
    assert refused.code == 2
    assert "interval-by adaptive: expected predictions" in refused.err
    assert not Path("none.csv").exists()


def test_simulate_with_an_interval(new: Path, nnss: Callable, plant_run: Callable[..., Path]) -> None:
    done = nnss("simulate", plant_run(), new, "--interval", "0.9", "--plot")
    assert done.code == 0, done.err
    assert "band of 90 %, y1: ± " in done.out
    plain = nnss("simulate", plant_run(), new, "--out", "plain.csv")
    assert plain.code == 0
    np.testing.assert_array_equal(pd.read_csv("predicted.csv")["y1"], pd.read_csv("plain.csv")["y1"])
    assert "band" not in plain.out


@pytest.mark.system
def test_a_sound_model_passes(
    nnss: Callable, plant_run: Callable[..., Path], plant_data: Callable[..., Dataset]
) -> None:
    """Of the right order, trained on so many samples that its own errors do not show on a few new ones."""
    new = write(plant_data(K=5400).tests["test"][0][:400], Path("short.csv"))
    done = nnss("validate", plant_run(K=5400), new, "--out", "v.png")
    assert (done.code, done.err) == (0, "")
    assert "All 3 tests pass." in done.out
    assert "RMSE/σ" in done.out
    assert "σ (training)" in done.out
    assert "Ahead, after the samples that tell x(0)" in done.out
    assert Path("v.png").stat().st_size > 50_000


@pytest.mark.system
def test_a_model_of_too_low_an_order_fails_with_a_verdict(nnss: Callable, plant_run: Callable[..., Path]) -> None:
    done = nnss("validate", plant_run(order=1))
    assert done.code == 1
    assert "FAILS" in done.out
    assert "dependent on 'u1': dynamics are missing; try order 2." in done.out
    assert "% that a linear model reaches which is fitted to this very record: there is" in done.out
    assert "Traceback" not in done.err


@pytest.mark.system
def test_validate_as_json(
    new: Path, nnss: Callable, plant_run: Callable[..., Path], plant_data: Callable[..., Dataset]
) -> None:
    done = nnss("validate", plant_run(), new, "--json")
    found = json.loads(done.out)
    assert not list(Path().glob("*.png"))
    assert found["passed"] is all(test["passed"] for test in found["tests"])
    assert done.code == (0 if found["passed"] else 1), done.err
    assert (found["record"], found["samples"]) == ("new.csv", 600)
    (output,) = found["outputs"]
    record, model = plant_data().tests["test"][0], load(plant_run())
    rmse = np.sqrt(np.mean((model.simulate(record.u, record.y[0]).y - record.y) ** 2))
    assert output["rmse"] == pytest.approx(rmse)
    assert output["sigma"] == pytest.approx(plant_data().fitting.scaling.y_std[0])
    assert output["fit_percent"] == pytest.approx(100 * (1 - rmse / record.y.std()))
    assert found["steps"]["simulated"][0] == pytest.approx(
        np.sqrt(np.mean((model.simulate(record.u, record.y[0]).y - record.y)[1:] ** 2))
    )
    poles = np.array(found["poles"])
    assert np.hypot(poles[..., 0], poles[..., 1]).max() == pytest.approx(found["largest_pole"])
    assert found["largest_pole"] == pytest.approx(model.model.system.spectral_radius())  # type: ignore[attr-defined]
    assert len(found["operating_points"]) == 1  # of a linear model, one stands for all
    assert found["operating_points"][0]["dc_gain"][0][0] == pytest.approx(15 / 2, rel=0.05)
    same = json.loads(nnss("validate", plant_run(), "--json").out)
    assert same["record"] == "test"
    assert same["outputs"] == found["outputs"]


@pytest.mark.system
def test_a_disturbed_plant_needs_the_noise_model(nnss: Callable, plant_run: Callable[..., Path]) -> None:
    """Its simulation's errors are coloured, its one-step errors are white: the model passes."""
    done = nnss("validate", plant_run(coloured=True), "--json")
    found = json.loads(done.out)
    assert found["outputs"][0]["simulation_r1"] > 0.4
    assert found["tests"][0]["passed"], found["tests"]
    assert found["gains"] != ["none"]
    assert any("the predictor makes up for what the simulation lacks" in line for line in found["verdict"])
    model = load(plant_run(coloured=True))
    (record,) = model.records()["test"]
    e, u = (signal[found["left_out"] :, 0] for signal in (record.y - forecaster(model).predict(record, 1), record.u))
    (output,) = found["outputs"]
    assert output["white"]["statistic"] == pytest.approx(whiteness([e]).statistic)
    assert output["depends"][0]["statistic"] == pytest.approx(dependence([e], [u]).statistic)
    assert output["residual_rmse"] == pytest.approx(np.sqrt(np.mean(e**2)))


@pytest.fixture
def ensemble(
    tmp_path: Path, neural: Callable[..., NNSS], plant_run: Callable[..., Path], plant_data: Callable[..., Dataset]
) -> Path:
    """Three members that disagree, beside the records of a run."""
    members = []
    for seed in range(3):
        member = neural(seed=seed)
        with torch.no_grad():
            for name, value in asdict(plant_data().fitting.scaling).items():
                getattr(member, name).copy_(torch.tensor(value))
        member.Ts = 0.5
        members.append(member)
    folder = tmp_path / "ensemble"
    folder.mkdir()
    Ensemble(tuple(members), "clipped").save(folder)
    shutil.copy(plant_run() / "signals.safetensors", folder)
    return folder


@pytest.mark.system
def test_a_band_may_follow_an_ensemble(new: Path, nnss: Callable, ensemble: Path) -> None:
    for command in ("simulate", "predict"):
        done = nnss(command, ensemble, new, "--interval", "0.9", "--interval-by", "ensemble", "--force")
        assert done.code == 0, done.err
        assert "× the members' spread, from" in done.out
        table = pd.read_csv("predicted.csv")
        width = table["y1_high"] - table["y1_low"]
        assert width.max() > 1.5 * width.min()
        np.testing.assert_allclose((table["y1_high"] + table["y1_low"]) / 2, table["y1"], atol=1e-9)
        if command == "simulate":
            record = pd.read_csv(new)
            y = load(ensemble).simulate(record[["u1"]], record["y1"].iloc[:1]).y
            np.testing.assert_allclose(table["y1"], y[:, 0], atol=1e-12)  # not the mean, around which they spread


@pytest.mark.system
def test_each_member_of_an_ensemble_has_its_own_gain(new: Path, nnss: Callable, ensemble: Path) -> None:
    done = nnss("validate", ensemble, new, "--json")
    assert done.code == 1  # of random weights
    found = json.loads(done.out)
    assert len(found["gains"]) == len(found["observer_rates"]) == 3
    assert found["steps"]["predicted"][0][0] < found["steps"]["simulated"][0]


@pytest.mark.system
def test_validate_takes_a_split_of_the_run(nnss: Callable, plant_run: Callable[..., Path]) -> None:
    found = json.loads(nnss("validate", plant_run(), "--split", "val", "--json").out)
    assert found["record"] == "val"
    refused = nnss("validate", plant_run(), "--split", "night", "--json")
    assert refused.code == 2
    assert "unknown split 'night': choose from" in refused.err


@pytest.mark.system
def test_a_model_alone_needs_a_record_to_fit_on(
    new: Path, nnss: Callable, plant_run: Callable[..., Path], tmp_path: Path
) -> None:
    folder = tmp_path / "alone"
    folder.mkdir()
    for name in ("model.json", "model.safetensors"):
        shutil.copy(plant_run() / name, folder)
    refused = nnss("predict", folder, new)
    assert refused.code == 2
    assert "keeps no training and validation records: give a record" in refused.err
    assert refused.err.count("\n") == 1
    assert not Path("predicted.csv").exists()
    assert nnss("predict", folder, new, "--data", new, "--interval", "0.9").code == 0
    assert nnss("validate", folder, new, "--data", new, "--json").code in (0, 1)
    assert nnss("validate", folder).code == 2
    assert nnss("simulate", folder, new, "--interval", "0.9", "--data", new, "--force").code == 0


@pytest.mark.system
def test_a_record_to_fit_the_predictor_on_is_not_taken_for_what_the_model_was_trained_on(
    nnss: Callable, plant_run: Callable[..., Path], plant_data: Callable[..., Dataset], tmp_path: Path
) -> None:
    """The range is that of the model's own training records, of which nothing is known of a model without its run."""
    data = plant_data()
    (train,), (test,) = data.fitting.train, data.tests["test"]
    write(train, Path("train.csv"))
    write(Record(0.05 * test.u, 0.05 * test.y, 0.5), Path("quiet.csv"))
    write(Record(3 * test.u, 3 * test.y, 0.5), Path("loud.csv"))
    alone = tmp_path / "alone"
    alone.mkdir()
    for name in ("model.json", "model.safetensors"):
        shutil.copy(plant_run() / name, alone)
    told = {}
    for file in ("train.csv", "loud.csv"):
        for folder in (plant_run(), alone):
            done = nnss("validate", folder, file, "--data", "quiet.csv", "--json")
            told[file, folder] = "\n".join(json.loads(done.out)["verdict"])
    assert "the model or its predictor was fitted to 600 of these 600 samples" in told["train.csv", plant_run()]
    assert "leaves the range" not in told["train.csv", plant_run()]
    assert f"fitted to, {train.u.min():.4g} to {train.u.max():.4g}, at " in told["loud.csv", plant_run()]
    assert "No independent evidence" not in told["loud.csv", plant_run()]
    for file in ("train.csv", "loud.csv"):
        assert "leaves the range" not in told[file, alone]
        assert "No independent evidence" not in told[file, alone]
    beyond = "beyond the training records no data speak for the model"
    for folder, file, known in (
        (plant_run(), "train.csv", False),
        (plant_run(), "loud.csv", True),
        (alone, "loud.csv", False),
    ):
        assert (beyond in nnss("predict", folder, file, "--data", "quiet.csv", "--force").out) == known


@pytest.mark.parametrize(
    ("command", "options", "told"),
    [
        ("predict", ("--horizon", "0"), "--horizon: expected 1 to 599 steps ahead"),
        ("predict", ("--horizon", "600"), "--horizon: expected 1 to 599 steps ahead"),
        ("predict", ("--interval", "90"), "interval: expected a share between 0 and 1, such as 0.9, found 90"),
        ("predict", ("--interval", "0.9999"), "0.9999 needs at least 9999 validation samples, found 599"),
        ("predict", ("--interval", "0.9", "--interval-by", "hope"), "unknown interval-by 'hope'"),
        ("predict", ("--interval", "0.9", "--interval-by", "ensemble"), "needs an ensemble of two members at least"),
        ("predict", ("--ts", "0.1"), "sampling time 0.1 s, expected 0.5 s"),
        ("simulate", ("--interval", "1"), "interval: expected a share between 0 and 1"),
        ("validate", ("--ts", "0.1"), "sampling time 0.1 s, expected 0.5 s"),
        ("validate", ("--split", "test"), "expected a FILE or --split, found both"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(
    command: str, options: tuple[str, ...], told: str, new: Path, nnss: Callable, plant_run: Callable[..., Path]
) -> None:
    done = nnss(command, plant_run(), new, *options)
    assert done.code == 2
    assert told in done.err
    assert done.err.count("\n") == 1
    assert not list(Path().glob("*.csv"))
    assert not list(Path().glob("*.png"))


@pytest.mark.system
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda table: table.rename(columns={"y1": "level"}),
            "expected the columns u1, y1, the model's channels, found",
        ),
        (lambda table: table.assign(y1=table["y1"].where(table.index != 7)), "y1"),
        (lambda table: table[:1], "samples are too few"),
    ],
)
def test_files_that_do_not_fit_are_refused_in_one_line(
    change: Callable, told: str, new: Path, nnss: Callable, plant_run: Callable[..., Path]
) -> None:
    change(pd.read_csv(new)).to_csv("bad.csv", index=False)
    for command in ("predict", "validate"):
        done = nnss(command, plant_run(), "bad.csv")
        assert done.code == 2, done.out
        assert told in done.err
        assert done.err.count("\n") == 1


def test_a_model_that_runs_away_is_told_in_one_line(new: Path, nnss: Callable, plant_run: Callable[..., Path]) -> None:
    folder = Path(shutil.copytree(plant_run(), "copy"))
    tensors = load_file(folder / "model.safetensors")
    save_file(tensors | {"A": 1e9 * np.eye(2), "C": np.array([[1.0, 1e-9]])}, folder / "model.safetensors")
    for command in (("predict", folder, new, "--horizon", "300"), ("validate", folder, new)):
        done = nnss(*command)
        assert done.code == 2, done.out
        assert "leaves the finite range at sample" in done.err
        assert done.err.count("\n") == 1
    assert not list(Path().glob("*.[cp][sn][vg]"))


@pytest.mark.system
def test_nothing_is_overwritten_unasked(new: Path, nnss: Callable, plant_run: Callable[..., Path]) -> None:
    Path("predicted.png").write_bytes(b"mine")
    assert nnss("predict", plant_run(), new, "--plot").out.endswith("predicted-2.csv\npredicted-2.png\n")
    assert Path("predicted.png").read_bytes() == b"mine"
    assert nnss("predict", plant_run(), new).out.endswith("predicted.csv\n")
    assert nnss("predict", plant_run(), new, "--force").out.endswith("predicted.csv\n")
    refused = nnss("predict", plant_run(), new, "--plot", "--out", "predicted.csv")
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    assert "'predicted.csv' exists already: name another file with --out, or --force" in refused.err


@pytest.mark.system
def test_each_validation_has_a_figure_of_its_own(new: Path, nnss: Callable, plant_run: Callable[..., Path]) -> None:
    run = plant_run().name
    first, second = f"validation-{run}.png", f"validation-{run}-2.png"
    assert nnss("validate", plant_run(), new).out.endswith(f"\n{first}\n")
    Path(first).write_bytes(b"mine")
    assert nnss("validate", plant_run(), new, "--csv").code in (0, 1)
    assert Path(second).stat().st_size > 50_000
    refused = nnss("validate", plant_run(), new, "--out", first)
    assert refused.code == 2
    assert "exists already" in refused.err
    assert Path(first).read_bytes() == b"mine"
    assert nnss("validate", plant_run(), new, "--force").out.endswith(f"\n{first}\n")


@pytest.mark.parametrize("command", ["simulate", "predict", "validate"])
def test_that_a_file_exists_is_told_after_what_is_wrong_with_the_data(
    command: str, nnss: Callable, plant_run: Callable[..., Path]
) -> None:
    Path("there.png").write_bytes(b"mine")
    refused = nnss(command, plant_run(), "no.csv", "--out", "there.png")
    assert refused.code == 2
    assert "no.csv" in refused.err
    assert "exists" not in refused.err


@pytest.mark.parametrize("name", ["page", "page.txt"])
def test_a_page_is_a_figure_by_its_name(name: str, new: Path, nnss: Callable, plant_run: Callable[..., Path]) -> None:
    """Without a suffix an empty file was left, and the figure under a temporary name."""
    given = nnss("validate", plant_run(), new, "--out", name)
    assert (given.code, given.out) == (2, "")
    assert f"expected a figure, such as page.png, .svg, .pdf, found '{name}'" in given.err
    assert not list(Path().glob("*page*"))
