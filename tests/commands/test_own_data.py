"""Records of one's own from the command line: every format, roles, experiments, descriptions, and what is refused."""

import json
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from conftest import slow_but

import nnss_cli
from nnss_cli.report import figures

K = 240
QUICK = ("--methods", "n4sid", "ssregest", "--orders", "1", "2")


def plant(seed: int, samples: int = K) -> pd.DataFrame:
    """Two inputs, one output, a time column of 0.1 s."""
    random = np.random.default_rng(seed)
    u = random.uniform(-1, 1, (samples, 2))
    y = np.zeros(samples)
    for k in range(samples - 1):
        y[k + 1] = 0.8 * y[k] + 0.5 * u[k, 0] + 0.2 * u[k, 1]
    y += 3 + 0.01 * random.standard_normal(samples)
    return pd.DataFrame({"t": np.arange(samples) * 0.1, "valve": u[:, 0], "pump": u[:, 1], "level": y})


def write_csv(table: pd.DataFrame, path: Path) -> None:
    table.to_csv(path, index=False)


def write_mat(table: pd.DataFrame, path: Path) -> None:
    import scipy.io

    scipy.io.savemat(path, {name: table[name].to_numpy()[:, None] for name in table})


def write_npz(table: pd.DataFrame, path: Path) -> None:
    np.savez(path, **{name: table[name].to_numpy() for name in table})


def write_hdf5(table: pd.DataFrame, path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        for name in table:
            file[name] = table[name].to_numpy()


def write_excel(table: pd.DataFrame, path: Path) -> None:
    pytest.importorskip("openpyxl")
    table.to_excel(path, index=False)


def write_parquet(table: pd.DataFrame, path: Path) -> None:
    pytest.importorskip("pyarrow")
    table.to_parquet(path)


FORMATS = {
    "plant.csv": write_csv,
    "plant.tsv": lambda table, path: table.to_csv(path, index=False, sep="\t"),
    "plant.csv.gz": write_csv,
    "plant.mat": write_mat,
    "plant.npz": write_npz,
    "plant.h5": write_hdf5,
    "plant.xlsx": write_excel,
    "plant.parquet": write_parquet,
}
ROLES = ("--inputs", "valve", "pump", "--outputs", "level", "--ts", "0.1")


@pytest.fixture
def here(nnss: Callable) -> Path:
    """The empty folder that commands run in."""
    return Path.cwd()


def errors(folder: str = "results/plant/own") -> pd.DataFrame:
    table = pd.read_csv(Path(folder, "rmse.csv"))
    return table.drop(columns=["fit_seconds"])


@pytest.fixture(scope="module")
def expected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, pd.DataFrame]:
    return {}


@pytest.mark.system
@pytest.mark.parametrize("name", slow_but((0, 3), FORMATS))
def test_a_record_in_any_format_is_compared_and_gives_the_same_numbers(
    name: str, nnss: Callable, here: Path, expected: dict[str, pd.DataFrame]
) -> None:
    FORMATS[name](plant(0), here / name)
    outcome = nnss("compare", name, *ROLES, *QUICK, "--seeds", "1", "--jobs", "1")
    assert outcome.code == 0, outcome.err
    assert "plant, protocol own" in outcome.out
    table = errors()
    assert set(table["split"]) == {"train", "val", "test"}
    pd.testing.assert_frame_equal(table, expected.setdefault("plant", table), rtol=1e-6)
    assert "valve" in Path("results/plant/own/runs/n4sid-n1-s0/run.json").read_text()


@pytest.mark.system
def test_units_in_names_reach_every_table(nnss: Callable, here: Path) -> None:
    """Brackets are no markup and colons no pictures; columns of our own tables keep their units too."""
    names = {"valve": "valve [%]", "pump": "pump [bar]", "level": "level :up: [cm]"}
    write_csv(plant(0).rename(columns=names), here / "plant.csv")
    roles = ("--inputs", "valve [%]", "pump [bar]", "--outputs", "level :up: [cm]", "--time", "t")
    seen = nnss("inspect", "plant.csv", *roles)
    assert seen.code == 0, seen.err
    for name in names.values():
        assert seen.out.count(name) >= 2, name
    assert "[samples]" in seen.out
    assert "[s]" in seen.out
    trained = nnss("train", "plant.csv", *roles, "--output-units", "mm", "--method", "n4sid", "--order", "1")
    assert trained.code == 0, trained.err
    assert trained.out.count("level :up: [cm] [mm]") == 3


@pytest.mark.system
def test_inspect_writes_a_description_that_compares(nnss: Callable, here: Path) -> None:
    write_csv(plant(0), here / "plant.csv")
    outcome = nnss("inspect", "plant.csv", "--outputs", "level", "--output-units", "mm", "--write", "plant.toml")
    assert outcome.code == 0, outcome.err
    assert "Column 't' is taken for the time" in outcome.out
    assert "Taken for inputs: valve, pump" in outcome.out
    assert "the linear order (N4SID, 4 horizons; 'nnss order' tries all)\norder  Hankel σn/σ1  train [σ]" in outcome.out
    assert Path("results/plant/inspection.png").stat().st_size > 10_000
    assert max(map(len, outcome.out.splitlines()[:40])) <= 81
    text = Path("plant.toml").read_text()
    assert '\n# Guessed by \'nnss inspect\': check it.\ninputs = ["valve", "pump"]\n' in text
    assert "check it.\ntime = " in text
    assert "check it.\noutputs = " not in text
    assert '\noutput_units = ["mm"]\n' in text
    again = nnss("compare", "plant.toml", "--orders", "2", "--methods", "n4sid")
    assert again.code == 0, again.err
    run = json.loads(Path("results/plant/own/runs/n4sid-n2-s0/run.json").read_text())
    assert run["channels"]["output_units"] == ["mm"]
    refused = nnss("inspect", "plant.csv", "--write", "plant.toml")
    assert refused.code == 2
    assert "exists already" in refused.err
    assert Path("plant.toml").read_text() == text
    found = json.loads(nnss("inspect", "plant.toml", "--json").out)
    assert found["samples"] == [K]
    assert [c["unit"] for c in found["channels"]] == ["–", "–", "mm"]


@pytest.mark.system
def test_inspect_shows_and_writes_what_it_is_given(nnss: Callable, here: Path) -> None:
    write_csv(plant(0).assign(level=lambda table: table["level"] + 0.1 * table["t"]), here / "plant.csv")
    outcome = nnss(
        "inspect", "plant.csv", "--inputs", "2", "3", "--outputs", "4", "--time", "t", "--split", "70/20/10",
        "--init-window", "5", "--detrend", "linear", "--downsample", "2", "--write", "p70.toml",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    shown = {line.split("  ")[0]: line for line in outcome.out.splitlines() if "  " in line}
    assert shown["samples"].endswith(" 120")
    assert shown["Ts"].endswith(" 0.2 s (preparation)")
    assert shown["split"].endswith("70/20/10 in time order (given)")
    assert shown["init window"].endswith("5 samples (given)")
    assert "after its preparation: downsample 2, detrend linear." in outcome.out
    text = Path("p70.toml").read_text()
    for line in ('split = "70/20/10"', "init_window = 5", 'detrend = "linear"', "downsample = 2"):
        assert f"\n{line}\n" in text


@pytest.mark.system
def test_every_option_of_a_record_is_in_the_description_that_inspect_writes(nnss: Callable, here: Path) -> None:
    from nnss_cli.datasets.description import read_description

    from nnss_cli.commands.record_options import RECORD_OPTIONS, as_arguments

    for number, name in enumerate(("plant.csv", "val.csv", "test.csv")):
        write_csv(plant(number), here / name)
    values = {
        "inputs": ("valve",), "outputs": ("level",), "input_units": ("%",), "output_units": ("mm",), "time": "t",
        "Ts": 0.1, "resample": 0.2, "downsample": 2, "missing": "interpolate", "split": "50/25/25", "val": ("val.csv",),
        "test": ("test.csv",), "detrend": "constant", "init_window": 3, "name": "mine",
    }  # fmt: skip
    assert values.keys() == RECORD_OPTIONS.keys() - {"sheet"}  # of Excel files
    for field, value in values.items():
        own = {"inputs": ("valve",), "outputs": ("level",), "time": "t"} | {field: value}
        line = as_arguments(["plant.csv"], {key: list(v) if isinstance(v, tuple) else v for key, v in own.items()})
        outcome = nnss("inspect", *shlex.split(line), "--write", "x.toml", "--force", "--json")
        assert outcome.code == 0, outcome.err
        found = getattr(read_description(Path("x.toml")), field)
        assert found == ({"test": value} if field == "test" else value), field


@pytest.mark.system
def test_a_quiet_inspection_says_in_the_description_what_it_guessed(nnss: Callable, here: Path) -> None:
    write_csv(plant(0).assign(spare=np.nan, shift="late"), here / "plant.csv")
    outcome = nnss("inspect", "plant.csv", "--time", "t", "--write", "plant.toml", "--quiet")
    assert (outcome.code, outcome.out) == (0, "")
    text = Path("plant.toml").read_text()
    for line in ('inputs = ["valve", "pump"]', 'outputs = ["level"]'):
        assert f"# Guessed by 'nnss inspect': check it.\n{line}\n" in text
    assert text.count("Guessed") == 2


def test_files_are_experiments_with_files_to_validate_and_to_test(nnss: Callable, here: Path) -> None:
    for number, samples in enumerate((120, 90, 100, 110), start=1):
        write_csv(plant(number, samples).rename(columns={"valve": "u", "level": "y"}), here / f"run{number}.csv")
    line = "train run1.csv run2.csv --val run3.csv --test run4.csv --inputs u pump --outputs y --time t --order 2"
    outcome = nnss(*shlex.split(line), "--method", "n4sid")
    assert outcome.code == 0, outcome.err
    from nnss_cli.modelfile import read_tensors

    signals = read_tensors(Path("results/run1/own/runs/n4sid-n2-s0/signals.safetensors"))
    lengths = {name: len(array) for name, array in signals.items() if name.endswith("/y")}
    assert lengths == {"train/0/y": 120, "train/1/y": 90, "val/0/y": 100, "test/0/y": 110}
    np.testing.assert_allclose(signals["val/0/y"][:, 0], plant(3, 100)["level"])


def test_options_go_before_the_description(nnss: Callable, here: Path) -> None:
    write_csv(plant(0), here / "plant.csv")
    Path("plant.toml").write_text('files = ["plant.csv"]\ninputs = ["valve"]\noutputs = ["level"]\ntime = "t"\n')
    outcome = nnss(
        "train", "plant.toml", "--order", "1", "--method", "n4sid", "--split", "40/30/30", "--init-window", "9"
    )
    assert outcome.code == 0, outcome.err
    from nnss_cli.modelfile import read_tensors

    signals = read_tensors(Path("results/plant/own/runs/n4sid-n1-s0/signals.safetensors"))
    assert [len(signals[f"{split}/0/y"]) for split in ("train", "val", "test")] == [96, 72, 72]


@pytest.mark.system
def test_other_samples_are_not_mixed_in_under_the_same_name(nnss: Callable, here: Path) -> None:
    write_csv(plant(0), here / "plant.csv")
    assert nnss("compare", "plant.csv", *ROLES, "--methods", "n4sid", "--orders", "1").code == 0
    write_csv(plant(1), here / "plant.csv")
    refused = nnss("compare", "plant.csv", *ROLES, "--methods", "n4sid", "--orders", "1")
    assert refused.code == 2
    assert "another version of the data" in refused.err


@pytest.mark.system
def test_own_data_take_searched_horizons_and_order_and_compare_agree(nnss: Callable, here: Path) -> None:
    write_csv(plant(0), here / "plant.csv")
    assert nnss("compare", "plant.csv", *ROLES, "--methods", "n4sid", "--orders", "2").code == 0
    run = json.loads(Path("results/plant/own/runs/n4sid-n2-s0/run.json").read_text())
    assert run["spec"]["settings"] == {"horizon": "auto"}
    assert nnss("order", "plant.csv", *ROLES, "--max-order", "3").code == 0
    by_order = pd.read_csv("results/plant/own/order.csv").set_index("order")
    (score,) = (s for s in run["scores"] if s["split"] == "val")
    assert by_order.loc[2, "val"] == pytest.approx(score["nrmse"], rel=1e-9)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("compare plnt.csv --inputs valve --outputs level --ts 1", ["no such file: 'plnt.csv'", "benchmark"]),
        ("compare plant.csv", ["--inputs", "nnss inspect plant.csv"]),
        ("compare plant.csv --inputs valve", ["--outputs"]),
        ("compare plant.csv --inputs valve --outputs level", ["Ts", "time column"]),
        ("compare plant.csv --inputs valv --outputs level --ts 1 --orders 1", ["'valv'", "did you mean 'valve'"]),
        ("compare plant.csv --inputs valve --outputs level --ts 0.1", ["plant has no usual orders", "--orders 2 3 4"]),
        ("compare plant.csv --inputs valve --outputs level --ts 0 --orders 1", ["Ts", "positive number of seconds"]),
        ("compare plant.csv --inputs valve --outputs level --time t --ts 1 --orders 1", ["0.1", "1"]),
        ("compare plant.csv --inputs valve --outputs level --ts 1 --split 60/20 --orders 1", ["split", "60/20"]),
        ("compare plant.csv --inputs valve --outputs level --ts 1 --name ../x --orders 1", ["name"]),
        ("compare plant.csv --inputs valve --outputs level --ts 1 --name twotank --orders 1", ["benchmark", "--name"]),
        ("compare plant.csv --inputs valve --outputs level --ts 1 --protocol paper --orders 1", ["--protocol", "own"]),
        ("compare plant.csv --inputs valve --outputs level --ts 1 --orders 90", ["order", "found 90"]),
        ("compare plant.csv --inputs valve --outputs level --ts 1 --orders 1 --init-window 48", ["init", "48"]),
        ("compare plant.csv --inputs 1 --outputs 9 --ts 1 --orders 1", ["no column 9"]),
        ("compare twotank-sim --inputs valve", ["--inputs", "twotank-sim", "benchmark"]),
        ("compare twotank-sim robotarm", ["one benchmark"]),
        ("compare text.csv --inputs u --outputs y --ts 1 --orders 1", ["row 3", "'u'", "n/a"]),
        ("compare gap.csv --inputs u --outputs y --ts 1 --orders 1", ["'u'", "missing"]),
        ("compare jump.csv --inputs u --outputs y --time t --orders 1", ["row", "resample"]),
        ("compare flat.csv --inputs u --outputs y --ts 1 --orders 1", ["'u'", "constant"]),
        ("compare empty.csv --inputs u --outputs y --ts 1 --orders 1", ["empty.csv", "empty"]),
        ("compare wrong.toml", ["'inpts'", "did you mean 'inputs'", "valid keys are"]),
        ("compare outside.toml", ["outside", "allow_outside"]),
        ("compare plant.csv wrong.toml", ["wrong.toml", "alone"]),
        ("inspect empty.csv", ["empty.csv", "empty"]),
        ("inspect missing.csv", ["missing.csv"]),
        ("inspect words.csv", ["words.csv", "column of numbers"]),
        ("inspect nots.csv --write nots.toml", ["--ts"]),
        ("inspect plant.csv --outputs level --time t --split 70/20 --write x.toml", ["split '70/20'", "60/20/20"]),
        ("inspect plant.csv --outputs level --time t --missing drop --write x.toml", ["missing", "'drop'"]),
        ("inspect plant.csv --outputs level --time t --init-window 60 --write x.toml", ["too few", "init_window"]),
        ("inspect plant.csv --outputs level --time t --test plant.csv --write x.toml", ["stands under two"]),
        ("inspect plant.csv --outputs level --time t --val none.csv --write x.toml", ["none.csv"]),
        ("inspect jump.csv --outputs y --time t --downsample 2 --write x.toml", ["jump.csv' row", "resample"]),
        ("inspect nots.csv --outputs y --downsample 2", ["Ts", "sampling time"]),
        ("train plant.csv --inputs valve --outputs level --ts 1 --order 0", ["order", "found 0"]),
        ("certify nowhere --data plant.csv", ["nowhere"]),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(line: str, words: list[str], nnss: Callable, here: Path) -> None:
    write_csv(plant(0), here / "plant.csv")
    k = np.arange(60)
    good = pd.DataFrame({"t": k * 1.0, "u": np.sin(k), "y": np.cos(k)})
    good.drop(columns="t").to_csv("nots.csv", index=False)
    good.assign(t=np.where(k > 30, k + 0.5, k)).to_csv("jump.csv", index=False)
    good.assign(u=1.0).to_csv("flat.csv", index=False)
    good.astype({"u": object}).assign(u=lambda t: [("n/a" if i == 1 else v) for i, v in enumerate(t["u"])]).to_csv(
        "text.csv", index=False
    )
    good.assign(u=np.where(k == 4, np.nan, good["u"])).to_csv("gap.csv", index=False)
    Path("empty.csv").write_text("")
    Path("words.csv").write_text("a,b\nx,y\nz,w\n")
    Path("wrong.toml").write_text('files = ["plant.csv"]\ninpts = ["valve"]\noutputs = ["level"]\n')
    Path("outside.toml").write_text('files = ["../plant.csv"]\ninputs = ["valve"]\noutputs = ["level"]\nTs = 1.0\n')
    before = sorted(Path().rglob("*"))
    outcome = nnss(*shlex.split(line))
    assert outcome.code == 2, outcome.out
    assert len(outcome.err.strip().splitlines()) == 1, outcome.err
    assert "Traceback" not in outcome.err
    for word in words:
        assert word in outcome.err
    assert sorted(Path().rglob("*")) == before


def step_test(seed: int = 0, samples: int = 600) -> pd.DataFrame:
    """A second-order plant of gain 1 that is at rest until its input steps, and ends elsewhere."""
    u = np.repeat([0.0, 5, 5, 8, 3, 6], samples // 6)
    x = np.zeros((samples, 2))
    for k in range(samples - 1):
        x[k + 1] = [0.97 * x[k, 0] + 0.03 * u[k], 0.95 * x[k, 1] + 0.05 * x[k, 0]]
    return pd.DataFrame({"u": u, "y": x[:, 1] + 0.02 * np.random.default_rng(seed).standard_normal(samples)})


def test_a_step_test_from_rest_needs_no_offset_of_a_models_own(here: Path) -> None:
    """About the mean no linear model fits it, of whatever order; the data are the same to a reader either way."""
    table = step_test()
    table.to_csv("steps.csv", index=False)
    how = {"inputs": ["u"], "outputs": ["y"], "Ts": 1.0, "init_window": 10}
    found = nnss_cli.fit("steps.csv", method="ssest", order=2, out="free", **how)
    kept = nnss_cli.fit("steps.csv", method="ssest", order=2, out="kept", detrend="constant", **how)
    errors = {}
    for name, model in (("free", found), ("kept", kept)):
        (test,) = model.records()["test"]
        np.testing.assert_array_equal(test.y[:, 0], table.y[480:])
        errors[name] = np.sqrt(np.mean((model.simulate(test.u, test.y[:10]).y - test.y)[10:] ** 2))
        simulated = model.simulate(table.u, table.y[:10]).y[10:, 0]  # new records as they are
        errors[name + " all"] = np.sqrt(np.mean((simulated - table.y[10:]) ** 2))
    assert errors["free"] < 0.04
    assert errors["free all"] < 0.06
    assert errors["kept"] > 4 * errors["free"]
    (note,) = [each for each in found.origin.notes if "rests under the mean input" in each]
    assert note.startswith("y: models are about ")
    rest = table.u[:360].mean()  # of gain 1
    assert float(note.split()[4].rstrip(",")) == pytest.approx(rest, abs=0.15)
    assert f"{table.y[:360].mean():.5g}" in note
    assert not any("mean input" in each for each in kept.origin.notes)
    assert kept.scaling.y_mean == pytest.approx(table.y[:360].mean())


def test_a_model_of_signals_without_a_drift_takes_records_without_it(here: Path) -> None:
    table = plant(0)
    drift = 0.05 * (table.t - table.t[:144].mean())
    table.assign(level=table.level + drift).to_csv("plant.csv", index=False)
    model = nnss_cli.fit(
        "plant.csv", method="n4sid", order=1, inputs=["valve", "pump"], outputs=["level"], Ts=0.1, detrend="linear"
    )
    fresh = plant(3)
    y = model.simulate(fresh[["valve", "pump"]], fresh.level[0]).y[:, 0]
    assert np.sqrt(np.mean((y - fresh.level) ** 2)) < 0.1
    (note,) = [each for each in model.origin.notes if "drift" in each]
    slopes = {
        part.split()[0]: float(part.split()[1].split("/")[0]) for part in note.split(": ")[1].split("; ")[0].split(", ")
    }
    assert slopes["level"] == pytest.approx(np.polyfit(table.t[:144], (table.level + drift)[:144], 1)[0], rel=1e-3)
    assert set(slopes) == {"valve", "pump", "level"}


def test_letters_that_a_figure_cannot_show_are_told_in_one_line(nnss: Callable, here: Path) -> None:
    figures._tell_of_the_font.cache_clear()
    write_csv(plant(0).rename(columns={"level": "水位", "valve": "$valve$"}), here / "plant.csv")
    roles = ("--inputs", "$valve$", "pump", "--outputs", "水位", "--ts", "0.1")
    seen = nnss("inspect", "plant.csv", *roles)
    assert seen.code == 0, seen.err
    (line,) = (line for line in seen.err.splitlines() if "font" in line)
    assert line.startswith("nnss: figures: the font has no letters for some names")
    assert ".py" not in seen.err


@pytest.mark.system
def test_the_title_of_a_description_heads_what_is_made_of_it(nnss: Callable, here: Path) -> None:
    write_csv(plant(0), here / "plant.csv")
    text = 'files = ["plant.csv"]\ninputs = ["valve", "pump"]\noutputs = ["level"]\ntime = "t"\n'
    Path("plant.toml").write_text(text + 'title = "Tank in the yard"\n')
    trained = nnss("train", "plant.toml", "--method", "n4sid", "--order", "1")
    assert trained.code == 0, trained.err
    assert "Tank in the yard (plant), protocol own, n4sid, order 1" in trained.out
    assert json.loads(Path("results/plant/own/runs/n4sid-n1-s0/run.json").read_text())["title"] == "Tank in the yard"
    ordered = nnss("order", "plant.toml", "--max-order", "2")
    assert "Tank in the yard (plant), protocol own: N4SID by order" in ordered.out
    assert nnss("report").code == 0
    assert "## Tank in the yard (plant), protocol `own`" in Path("results/report.md").read_text().splitlines()
