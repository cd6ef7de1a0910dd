"""`nnss simulate` and `nnss show`: what they write, what they say, and what they refuse in one line."""

import io
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from nnss_cli.datasets.record import Channels, Record, Simulation

from nnss_cli.errors import InputError
from nnss_cli.methods.compiled import free_run
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import FORMAT
from nnss_cli.report.simulation import missing_lines
from nnss_cli.report.tables import number
from nnss_cli.testing import small_dataset
from nnss_cli.trained import TrainedModel, load, records
from nnss_cli.trained.simulate import beyond_training, output_table, require_finite, simulate_file
from nnss_cli.validation.trained import simulation_limits


@pytest.fixture
def new(tmp_path: Path) -> Path:
    """A file of the test record."""
    record = small_dataset().tests["test"][0]
    path = tmp_path / "new.csv"
    pd.DataFrame({"y1": record.y[:, 0], "u1": record.u[:, 0]}).to_csv(path, index=False, float_format="%.17g")
    return path


def test_simulate_writes_what_the_model_simulates(
    new: Path, nnss: Callable, trained_folder: Callable[..., Path]
) -> None:
    done = nnss("simulate", trained_folder(), new, "--out", "a/out.csv", "--plot", "--states")
    assert done.code == 0, done.err
    model, record = load(trained_folder()), small_dataset().tests["test"][0]
    expected = model.simulate(record.u, record.y[0])
    found = pd.read_csv("a/out.csv")
    assert list(found.columns) == ["time", "y1", "x1", "x2"]
    np.testing.assert_allclose(found["time"], np.arange(len(record)) * 0.5)
    np.testing.assert_allclose(found["y1"], expected.y[:, 0], rtol=1e-10)
    np.testing.assert_allclose(found[["x1", "x2"]], expected.x, rtol=1e-10)
    assert Path("a/out.png").stat().st_size > 10_000
    run = json.loads((trained_folder() / "run.json").read_text())
    rmse = next(score["rmse"] for score in run["scores"] if score["split"] == "test")
    assert f"{rmse:.3g}"[:4] in done.out


def test_no_column_takes_the_place_of_another(tmp_path: Path) -> None:
    """Outputs may be named as limits and states are."""
    names = ("y", "y_low", "x1")
    model: Any = SimpleNamespace(channels=Channels(("u",), names, ("V",), ("m",) * 3), Ts=0.5)
    y = np.arange(6.0).reshape(2, 3)
    text = output_table(model, y, (y - 10, y + 10), np.array([[7.0, 8.0], [9.0, 6.0]]))
    table = pd.read_csv(io.StringIO(text))
    assert list(table.columns) == [
        "time", "y", "y_low", "x1", "y_low_", "y_low_low", "x1_low", "y_high", "y_low_high", "x1_high", "x1_", "x2",
    ]  # fmt: skip
    np.testing.assert_array_equal(table[list(names)], y)
    np.testing.assert_array_equal(table[["y_low_", "y_low_low", "x1_low"]], y - 10)
    np.testing.assert_array_equal(table[["y_high", "y_low_high", "x1_high"]], y + 10)
    np.testing.assert_array_equal(table[["x1_", "x2"]], [[7, 8], [9, 6]])


def test_instants_are_written_to_the_millisecond_of_unix_time() -> None:
    model: Any = SimpleNamespace(channels=Channels(("u",), ("y",), ("V",), ("m",)), Ts=0.001)
    t = (1709625600001 + np.arange(50)) / 1000
    table = pd.read_csv(io.StringIO(output_table(model, np.zeros((50, 1)), t=t)))
    np.testing.assert_array_equal(table["time"], t)


@pytest.mark.system
def test_what_is_written_has_the_times_of_the_file(
    new: Path, nnss: Callable, trained_folder: Callable[..., Path]
) -> None:
    """To the millisecond of Unix time; dates, a falling column and one that --ts passes over give the time since 0."""
    plain = pd.read_csv(new)
    since = np.arange(len(plain)) * 0.5
    dates = pd.Timestamp("2024-05-01") + pd.to_timedelta(since, unit="s")
    for clock, column, options, expected in (
        ("t", since + 12.5, (), since + 12.5), ("t [ms]", 1000 * since + 1709625600001, (), since + 1709625600.001),
        ("clock", since - 3, ("--time", "clock"), since - 3), ("t", dates, (), since), ("t", since[::-1], (), since),
        ("t", since + 12.5, ("--ts", "0.5"), since),
    ):  # fmt: skip
        plain.assign(**{clock: column}).to_csv(new, index=False)
        for command in ("simulate", "predict"):
            done = nnss(command, trained_folder(), new, *options, "--out", "out.csv", "--force")
            assert done.code == 0, done.err
            np.testing.assert_allclose(pd.read_csv("out.csv")["time"], expected, rtol=0, atol=1e-5)
    since[7:] += 0.05  # a sample came late: at the model's sampling time all after it would be off
    plain.assign(t=since).to_csv(new, index=False)
    for command in ("simulate", "predict", "validate"):
        refused = nnss(command, trained_folder(), new)
        assert refused.code == 2
        assert "row 9, column 't': time is not uniform: the step is 0.55 s, expected 0.5" in refused.err
        assert "pass over the column (--ts 0.5)" in refused.err


def test_a_long_record_is_simulated_in_compiled_code(
    new: Path,
    nnss: Callable,
    untrained: Callable[..., TrainedModel],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Equal to the model's own simulation up to rounding; the command never takes the slow way."""
    model, random = untrained(n=3).model, np.random.default_rng(0)
    u, y = random.standard_normal((100, 1)), random.standard_normal((100, 1))
    pd.DataFrame({"u1": u[:, 0], "y1": y[:, 0]}).to_csv(new, index=False, float_format="%.17g")
    expected = model.simulate(u, y[:1])
    model.save(tmp_path / "model")
    plain, longest = NNSS.simulate, []

    def watched(self: NNSS, u: np.ndarray, y_init: np.ndarray) -> Simulation:
        longest.append(len(u))
        return plain(self, u, y_init)

    monkeypatch.setattr(NNSS, "simulate", watched)
    done = nnss("simulate", tmp_path / "model", new, "--states")
    assert done.code == 0, done.err
    found = pd.read_csv("predicted.csv")
    np.testing.assert_allclose(found["y1"], expected.y[:, 0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found[["x1", "x2", "x3"]], expected.x, rtol=1e-9, atol=1e-9)
    assert max(longest) < 10
    free_run(model, u[1:], y[:1])  # a sample less is run by the model itself
    assert max(longest) == 99


def test_simulate_at_rest_needs_no_outputs(new: Path, nnss: Callable, trained_folder: Callable[..., Path]) -> None:
    pd.DataFrame({"u1": np.full(20, 0.7)}).to_csv(new, index=False)
    refused = nnss("simulate", trained_folder(), new)
    assert refused.code == 2
    assert "expected the columns u1, y1, the model's channels, found u1: rename what stands for y1" in refused.err
    assert not Path("predicted.csv").exists()
    done = nnss("simulate", trained_folder(), new, "--start", "rest")
    assert done.code == 0, done.err
    y = pd.read_csv("predicted.csv")["y1"]
    np.testing.assert_allclose(y, load(trained_folder()).equilibrium(0.7).y[0], rtol=1e-9)
    assert "RMSE" not in done.out
    assert "compare" not in done.out


def test_from_rest_all_outputs_that_are_there_are_compared_with(
    new: Path, nnss: Callable, trained_folder: Callable[..., Path]
) -> None:
    """The first ones too, which tell nothing of the start then. A band is that of other starts, which is said."""
    record, model = small_dataset().tests["test"][0], windowed(load(trained_folder()), 5)
    expected = model.simulate(record.u).y
    found = simulate_file(model, new, "rest")
    assert found.from_rest
    assert found.scores[0].rmse == pytest.approx(np.sqrt(np.mean((expected - record.y) ** 2)), rel=1e-12)
    np.testing.assert_array_equal(found.measured, record.y)
    held = simulation_limits(model, found, 0.9)
    within = (held.low <= record.y) & (record.y <= held.high)
    assert held.held == pytest.approx([within.mean()])
    done = nnss("simulate", trained_folder(), new, "--start", "rest", "--interval", "0.9")
    assert done.code == 0, done.err
    assert str(number(found.scores[0].rmse)) in done.out
    told = "The band is that of simulations from measured outputs; it holds where the plant was at rest."
    assert done.out.count(told) == 1
    assert told not in nnss("simulate", trained_folder(), new, "--interval", "0.9").out
    pd.DataFrame({"u1": record.u[:, 0], "y1": "lost"}).to_csv(new, index=False)  # outputs that are no numbers
    assert simulate_file(model, new, "rest").measured is None


def test_a_column_in_another_unit_is_to_be_converted_not_renamed(
    nnss: Callable, trained_folder: Callable[..., Path], tmp_path: Path
) -> None:
    """Who renames it alone gets numbers that are wrong by the factor between the units."""
    model = replace(load(trained_folder()).model, channels=Channels(("p [Pa]",), ("y",), ("Pa",), ("",)))
    told = []
    for name in ("p [bar]", "p (Pa)", "p", "q [bar]"):
        pd.DataFrame({name: np.ones(9), "y": 0.0}).to_csv(tmp_path / "new.csv", index=False)
        with pytest.raises(InputError) as error:
            simulate_file(TrainedModel(model), tmp_path / "new.csv")
        told.append(str(error.value).partition(f"found {name}, y: ")[2])
    converted = "convert 'p [bar]' to 'p [Pa]', in its values, too"
    assert told == [converted, *["rename what stands for p [Pa]"] * 3]
    pd.DataFrame({"p [bar]": np.ones(9)}).to_csv(tmp_path / "new.csv", index=False)
    with pytest.raises(InputError, match=r"too, and rename what stands for y$"):
        simulate_file(TrainedModel(model), tmp_path / "new.csv")


def test_missing_outputs_are_told_and_left_out(new: Path, nnss: Callable, trained_folder: Callable[..., Path]) -> None:
    model, record = load(trained_folder()), small_dataset().tests["test"][0]
    whole = nnss("simulate", trained_folder(), new, "--interval", "0.9")
    assert "missing" not in whole.out
    table = pd.read_csv(new)
    lost = np.arange(5, 11)
    table.loc[lost, "y1"] = np.nan
    table.to_csv(new, index=False, float_format="%.17g")
    done = nnss("simulate", trained_folder(), new, "--plot", "--interval", "0.9")
    assert done.code == 0, done.err
    assert f"'y1': 6 of {len(table)} samples are missing: errors are over the others." in done.out
    kept = np.setdiff1d(np.arange(len(table)), lost)
    found = simulate_file(model, new)
    error = np.sqrt(np.mean((found.y - record.y)[kept] ** 2))
    assert found.scores[0].rmse == pytest.approx(error, rel=1e-12)
    assert str(number(error)) in done.out
    low, high = (pd.read_csv("predicted-2.csv")[f"y1_{side}"].to_numpy()[kept] for side in ("low", "high"))
    held = np.mean(((low <= record.y[kept, 0]) & (record.y[kept, 0] <= high))[1:])
    assert f"it holds {100 * held:.1f} % here" in done.out
    table.loc[1:, "y1"] = np.nan
    table.to_csv(new, index=False)
    done = nnss("simulate", trained_folder(), new)
    assert "Nothing to compare with: the file has no outputs beyond those of the start." in done.out
    assert "RMSE" not in done.out
    (rest,) = simulate_file(model, new, "rest").scores
    assert rest.rmse == abs(table["y1"][0] - simulate_file(model, new, "rest").y[0, 0])  # the one that is left


def test_each_output_is_scored_over_its_own_samples(
    nnss: Callable, trained_folder: Callable[..., Path], tmp_path: Path
) -> None:
    record = small_dataset(1, 3).tests["test"][0]
    table = pd.DataFrame(np.column_stack([record.u, record.y]), columns=["u1", "y1", "y2", "y3"])
    table.loc[9:, "y2"] = np.nan
    table.loc[1:, "y3"] = np.nan
    table.to_csv(tmp_path / "new.csv", index=False, float_format="%.17g")
    folder = trained_folder(m=3)
    found = simulate_file(windowed(load(folder), 2), tmp_path / "new.csv", "rest")
    assert [score.output for score in found.scores] == ["y1", "y2", "y3"]  # of y3 one sample is there
    table.loc[1, "y3"] = 0.0
    table.to_csv(tmp_path / "new.csv", index=False, float_format="%.17g")
    model = windowed(load(folder), 2)
    found = simulate_file(model, tmp_path / "new.csv")
    error = (found.y - record.y)[2:]
    assert [(score.output, score.rmse) for score in found.scores] == [
        ("y1", pytest.approx(np.sqrt(np.mean(error[:, 0] ** 2)))),
        ("y2", pytest.approx(np.sqrt(np.mean(error[:7, 1] ** 2)))),
    ]
    K = len(table)
    assert missing_lines(found.measured, model.channels, 2) == [
        f"'y2': {K - 9} of {K - 2} samples are missing: errors are over the others.",
        f"'y3': {K - 2} of {K - 2} samples are missing: there is nothing to compare with.",
    ]


def windowed(model: TrainedModel, window: int) -> TrainedModel:
    assert model.origin is not None
    return replace(model, origin=replace(model.origin, init_window=window))


def test_what_leaves_the_range_of_training_is_told(
    new: Path, nnss: Callable, trained_folder: Callable[..., Path], tmp_path: Path
) -> None:
    model = load(trained_folder())
    (known,) = model.records()["train"]
    bounds = [(float(signal.min()), float(signal.max())) for signal in (known.u, known.y)]
    margins = [0.01 * (high - low) for low, high in bounds]

    def told(u: np.ndarray, y: np.ndarray) -> tuple:
        return beyond_training(model.records()["train"], model.channels, u[:, None], y[:, None])

    (u_low, u_high), (y_low, y_high) = bounds
    within = np.array([u_low - 0.99 * margins[0], u_high + 0.99 * margins[0]])
    assert told(within, np.array([y_low, y_high])) == ()
    (one,) = told(np.array([u_low - 1.01 * margins[0], u_high]), np.array([y_low, y_high]))
    assert (one.channel, one.samples, one.of, one.trained) == ("u1", 1, 2, bounds[0])
    assert one.found == (u_low - 1.01 * margins[0], u_high)
    (one,) = told(np.array([u_low, u_low, u_high]), y_high + np.array([2, 2, 0]) * margins[1])
    assert (one.channel, one.samples, one.of, one.trained) == ("y1", 2, 3, bounds[1])

    for size, expected in ((5.0, True), (0.2, False)):
        table = pd.read_csv(new)
        u = table["u1"] = size * table["u1"]
        table.to_csv(file := tmp_path / f"{size}.csv", index=False)
        done = nnss("simulate", trained_folder(), file, "--force", "--json")
        assert done.code == 0, done.err
        tables = [event for event in map(json.loads, done.out.splitlines()) if event["event"] == "table"]
        found = [row for table in tables for row in table["rows"] if "trained from" in row]
        assert bool(found) == expected
        if expected:
            assert found[0]["signal"].startswith("u1")
            assert found[0]["of"] == len(table)
            beyond = (u < u_low - margins[0]) | (u > u_high + margins[0])
            assert found[0]["samples"] == int(beyond.sum())
    shutil.copytree(trained_folder(), tmp_path / "damaged")
    (tmp_path / "damaged" / "signals.safetensors").write_bytes(b"no signals")
    done = nnss("simulate", tmp_path / "damaged", tmp_path / "5.0.csv", "--force")
    assert done.code == 0  # a simulation needs no records
    assert "whether signals leave the range of the training records is not known: " in done.out
    model.model.save(tmp_path / "bare")  # without the records of a run nothing can be said
    assert nnss("simulate", tmp_path / "bare", tmp_path / "5.0.csv", "--force").out.count("beyond") == 0


def test_all_training_records_and_every_signal_count_for_the_range() -> None:
    records = tuple(
        Record(np.column_stack([u, np.full(3, 0.1 + 0.2)]), np.array(y)[:, None], 1.0)
        for u, y in (([0.0, 1.0, 2.0], [0.0, 1.0, 2.0]), ([5.0, 6.0, 7.0], [-3.0, 0.0, 1.0]))
    )
    channels = Channels(("a", "b"), ("y",), ("V", ""), ("m",))

    def told(u: list[list[float]], y: list[float]) -> list[tuple[str, str, int]]:
        found = beyond_training(records, channels, np.array(u), np.array(y)[:, None])
        return [(one.channel, one.unit, one.samples) for one in found]

    assert told([[7.0, 0.3], [0.0, 0.3]], [-3.0, 2.0]) == []  # 0.1 + 0.2 is 0.3 but for rounding
    assert told([[8.0, 0.3], [0.0, 0.3]], [-4.0, 2.0]) == [("a", "V", 1), ("y", "m", 1)]
    assert told([[7.0, 0.31], [0.0, 0.29]], [0.0, 0.0]) == [("b", "", 2)]


def test_nothing_is_overwritten_unasked(new: Path, nnss: Callable, trained_folder: Callable[..., Path]) -> None:
    Path("predicted.csv").write_text("mine")
    refused = nnss("simulate", trained_folder(), new, "--out", "predicted.csv")
    assert (refused.code, Path("predicted.csv").read_text()) == (2, "mine")
    assert "exists already" in refused.err
    for name in ("predicted-2.csv", "predicted-3.csv"):
        assert nnss("simulate", trained_folder(), new).out.endswith(f"{name}\n")
    assert Path("predicted.csv").read_text() == "mine"
    assert nnss("simulate", trained_folder(), new, "--force").code == 0
    assert Path("predicted.csv").read_bytes() == Path("predicted-2.csv").read_bytes()


def test_a_record_of_the_usual_name_is_passed_over(new: Path, nnss: Callable, trained_folder: Callable) -> None:
    """As any file of that name is: what is read need not be called otherwise."""
    shutil.copy(new, "predicted.csv")
    done = nnss("simulate", trained_folder(), "predicted.csv")
    assert done.code == 0, done.err
    assert Path("predicted.csv").read_bytes() == new.read_bytes()
    assert done.out.endswith("predicted-2.csv\n")


@pytest.mark.parametrize("options", [(), ("--ts", "0.5"), ("--time", "t")])
@pytest.mark.parametrize("outputs", [True, False])
def test_from_rest_a_file_is_read_once_or_twice(
    outputs: bool, options: tuple[str, ...], nnss: Callable, trained_folder: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With its outputs once; without them once more at most, where columns were asked for by name."""
    reads: list[str] = []
    plain = records.read_table
    monkeypatch.setattr(
        records, "read_table", lambda path, *rest, **more: reads.append(path) or plain(path, *rest, **more)
    )
    table = pd.DataFrame({"t": 0.5 * np.arange(20), "u1": np.full(20, 0.7), "y1": 0.0})
    (table if outputs else table.drop(columns="y1")).to_csv("new.csv", index=False)
    done = nnss("simulate", trained_folder(), "new.csv", "--start", "rest", *options)
    assert done.code == 0, done.err
    assert ("RMSE" in done.out) == outputs
    assert len(reads) == (1 if outputs or not options else 2)


def test_what_is_read_is_not_replaced_even_when_forced(
    new: Path, nnss: Callable, trained_folder: Callable[..., Path]
) -> None:
    """Under whatever name: a measurement would be gone."""
    before, beside = new.read_bytes(), new.with_name("fitted.csv")
    beside.write_bytes(before)
    Path("other.csv").symlink_to(new)
    calls: list[tuple[object, ...]] = [
        ("simulate", trained_folder(), new, "--out", new),
        ("simulate", trained_folder(), new, "--out", "other.csv"),
        ("predict", trained_folder(), new, "--out", new),
        ("predict", trained_folder(), new, "--data", beside, "--out", beside),
        ("inspect", new, "--inputs", "u1", "--outputs", "y1", "--ts", "0.5", "--write", new),
    ]
    for call in calls:
        refused = nnss(*call, "--force")
        assert (refused.code, refused.err.count("\n")) == (2, 1)
        assert f"'{call[-1]}' is what is read: expected another file" in refused.err
        assert new.read_bytes() == beside.read_bytes() == before


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--ts", "0.1"), "sampling time 0.1 s, expected 0.5 s"),
        (("--start", "middle"), "unknown start 'middle': choose from outputs, rest"),
        (("--time", "clock"), "no column 'clock'"),
        (("--time", "u1"), "expected another column than a channel's for the time, found 'u1'"),
        (("--out", "x.png", "--plot"), "expected a name for the table, 'x.png' is the figure's beside it"),
        (("--out", "x.XLSX"), "--out: expected a name for CSV text, found 'x.XLSX': end it in .csv"),
        (
            ("--start", "rest", "--interval", "0.9", "--interval-by", "ensemble"),
            "interval-by ensemble: expected a simulation from measured outputs, found one from rest",
        ),
        (("--ts", "nan"), "against the model: sampling time nan s, expected 0.5 s"),
    ],
)
def test_simulate_refuses_in_one_line(
    options: tuple[str, ...], told: str, new: Path, nnss: Callable, trained_folder: Callable[..., Path]
) -> None:
    done = nnss("simulate", trained_folder(), new, *options)
    assert done.code == 2
    assert told in done.err
    assert done.err.count("\n") == 1
    assert not Path("predicted.csv").exists()


def test_a_simulation_that_runs_away_is_told(new: Path, nnss: Callable, trained_folder: Callable[..., Path]) -> None:
    import shutil

    from safetensors.numpy import load_file, save_file

    folder = Path(shutil.copytree(trained_folder(), "copy"))
    tensors = load_file(folder / "model.safetensors")
    save_file(tensors | {"A": 1e9 * np.eye(2)}, folder / "model.safetensors")
    done = nnss("simulate", folder, new)
    assert done.code == 2
    assert "the simulation leaves the finite range at sample 1" in done.err  # beyond 1e150, which is still a number
    assert not Path("predicted.csv").exists()


@pytest.mark.parametrize("far", [np.nan, np.inf, -1e150])
def test_outputs_whose_squares_are_no_numbers_are_out_of_range(far: float) -> None:
    y = np.full((6, 2), 0.99e150)
    require_finite("the simulation", y)
    y[3, 1] = far
    with pytest.raises(InputError, match="the simulation leaves the finite range at sample 3: expected a model"):
        require_finite("the simulation", y)


@pytest.mark.system
@pytest.mark.parametrize("method", ["n4sid", "nnss"])
def test_show_tells_what_a_folder_holds(method: str, nnss: Callable, trained_folder: Callable[..., Path]) -> None:
    folder = trained_folder(method, **({"epochs": 1, "hidden": (3,), "encoder": (2,)} if method == "nnss" else {}))
    done = nnss("show", folder)
    assert done.code == 0, done.err
    dataset = small_dataset()
    for told in (dataset.fingerprint(), "0.5 s", "small (strict)", "u1", "y_std", method):
        assert told in done.out
    found = json.loads(nnss("show", folder, "--json").out)
    assert found["fingerprint"] == dataset.fingerprint()
    assert found["scaling"]["y_std"] == pytest.approx(dataset.fitting.scaling.y_std.tolist())
    assert found["training"]["method"] == method
    assert all(found["arrays"][name]["shape"] == [1] for name in ("u_mean", "y_std"))
    assert (found["format"], found["order"], found["init_window"]) == (FORMAT, 2, 1)
