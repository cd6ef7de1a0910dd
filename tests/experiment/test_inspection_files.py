"""Files as an inspection takes them: roles by name, by exclusion or as given, and the description that follows."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from nnss_cli.datasets.description import read_description
from nnss_cli.datasets.experiments import load_experiments
from scipy.signal import lfilter

from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection_files import Roles, Seen, assign_roles, examine_files, suggested
from nnss_cli.experiment.inspection_split import Part, Split
from nnss_cli.experiment.source import ready


def table(*columns: str, **more: Any) -> pd.DataFrame:
    return pd.DataFrame({name: [1.0, 2.0] for name in columns} | more)


def roles(frame: pd.DataFrame, **fields: Any) -> tuple[Any, ...]:
    found = assign_roles(frame, {"Ts": 1.0} | fields)
    return found.inputs, found.outputs, found.time


@pytest.mark.parametrize(
    ("columns", "inputs", "outputs"),
    [
        (("u", "y"), ("u",), ("y",)), (("y", "u"), ("u",), ("y",)), (("U1", "in_2", "input 3", "Out", "y[m]"),
         ("U1", "in_2", "input 3"), ("Out", "y[m]")),
        (("valve", "level"), ("valve",), ("level",)), (("a", "b", "c"), ("a", "b"), ("c",)),
        (("u", "a", "b"), ("u",), ("a", "b")), (("y", "a", "b"), ("a", "b"), ("y",)),
        (("inlet", "youth"), ("inlet",), ("youth",)),  # no words of their own: the last is the output
        (("level",), (), ("level",)),
    ],
)  # fmt: skip
def test_roles_are_guessed_by_name_and_else_the_last_column_is_the_output(
    columns: tuple[str, ...], inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> None:
    assert roles(table(*columns)) == (inputs, outputs, None)
    (guess,) = assign_roles(table(*columns), {"Ts": 1.0}).guesses
    assert guess == (
        f"Taken for inputs: {', '.join(inputs) or 'none'}; for outputs: {', '.join(outputs)}: "
        "--inputs and --outputs say otherwise."
    )


def test_a_time_is_no_input_where_the_sampling_time_is_given() -> None:
    """As it is where stamps are only rounded: a ramp was taken for an input, and written into the description."""
    found = assign_roles(table("t", "valve", "level"), {"Ts": 1 / 60})
    assert (found.inputs, found.outputs, found.time) == (("valve",), ("level",), None)
    assert "Left out, since it reads as a time: t: --inputs or --outputs says otherwise." in found.guesses
    assert roles(table("t", "valve", "level"), inputs=("t",)) == (("t",), ("valve", "level"), None)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"outputs": "u"}, "column 'u': expected to be an input, an output or the time, found more than one"),
        ({"outputs": 1}, "column 'u': expected to be an input"),
        ({"time": "u"}, "column 'u': expected to be an input"),
        ({"inputs": ["u", "u"]}, "inputs: expected each value once"),
        ({"Ts": True}, "Ts: expected a positive number of seconds, found True"),
        ({"Ts": "0.1"}, "Ts: expected a positive number of seconds, found '0.1'"),
        ({"time": ["u"]}, "time: expected a name, or a number from 1"),
        ({"name": "../../evil"}, "name: expected letters, digits"),
    ],
)
def test_an_inspection_refuses_what_training_does(given: dict[str, Any], told: str, tmp_path: Path) -> None:
    file = tmp_path / "p.csv"
    table("u", "pump", "y").to_csv(file, index=False)
    with pytest.raises(InputError, match=re.escape(told)):
        examine_files([str(file)], {"inputs": "u", "outputs": "y", "Ts": 0.1} | given)


def test_a_list_of_one_stands_without_brackets(tmp_path: Path) -> None:
    """A word was taken letter by letter."""
    u = np.sin(np.arange(90.0) ** 1.5)
    pd.DataFrame({"pump": u, "y": np.roll(u, 1)}).to_csv(tmp_path / "p.csv", index=False)
    (tmp_path / "p.toml").write_text('files = ["p.csv"]\ninputs = ["pump"]\noutputs = ["y"]\nTs = 0.1\n')
    (tmp_path / "v.csv").write_text((tmp_path / "p.csv").read_text())
    names, given = [str(tmp_path / "p.csv")], {"inputs": "pump", "outputs": 2, "output_units": "mm", "Ts": 0.1}
    bare, listed = (
        examine_files(names, each)
        for each in (given, {"inputs": ["pump"], "outputs": ["y"], "output_units": ["mm"], "Ts": 0.1})
    )
    assert (bare.roles, bare.found) == (listed.roles, listed.found)
    held = [
        examine_files([str(tmp_path / "p.toml")], {"test": files}).found.split for files in _ways(tmp_path / "v.csv")
    ]
    assert held[0].test == (Part(1, 0, 90),)
    assert all(split == held[0] for split in held)


def _ways(file: Path) -> tuple[Any, ...]:
    return file, str(file), [file], (str(file),), {"test": [str(file)]}


def test_what_is_given_is_not_guessed() -> None:
    frame = table("u", "a", "y")
    found = assign_roles(frame, {"Ts": 1.0, "inputs": ("y",), "outputs": ("a",)})
    assert (found.inputs, found.outputs, found.guesses) == (("y",), ("a",), ())
    assert roles(frame, inputs=("a",)) == (("a",), ("u", "y"), None)
    assert roles(frame, outputs=("u",)) == (("a", "y"), ("u",), None)
    with pytest.raises(InputError, match="none"):
        roles(frame, inputs=("none",))


@pytest.mark.parametrize("name", ["t", "T", "time", "Time [s]", "timestamp", "date", "t_1"])
def test_a_column_of_that_name_is_the_time_unless_there_is_a_sampling_time(name: str) -> None:
    frame = table(name, "u", "y")
    found = assign_roles(frame, {})
    assert (found.inputs, found.outputs, found.time) == (("u",), ("y",), name)
    assert found.guesses[0] == f"Column '{name}' is taken for the time: --time or --ts says otherwise."
    assert assign_roles(frame, {"Ts": 1.0}).time is None
    assert assign_roles(frame, {"inputs": (name,)}).time is None
    assert assign_roles(table("tank", "u", "y"), {}).time is None


def test_a_temperature_is_no_time_and_a_unit_of_time_is_told() -> None:
    """ "T [°C]" is named as a time would be."""
    assert assign_roles(table("T [°C]", "u", "y"), {}).time is None
    assert assign_roles(table("t [samples]", "u", "y"), {}).time == "t [samples]"  # to be refused, not an input
    told = "The time column 'time_ms' is read in ms, as its name says."
    for fields in ({}, {"time": "time_ms"}):
        assert told in assign_roles(table("time_ms", "u", "y"), fields).guesses


def test_dates_and_numbers_that_are_not_read_are_told_why() -> None:
    zeit = assign_roles(table("u", "y", Zeit=["05.03.2024 08:00:00", "05.03.2024 08:00:01"], note=["a", "b"]), {})
    assert zeit.time is None
    assert zeit.guesses[:2] == (
        "Left out: column 'Zeit' looks like dates in a form that is not read ('05.03.2024 08:00:00'): write them as "
        "2024-01-31T12:00:00.5 (ISO 8601).",
        "Left out, since they hold no numbers: note.",
    )
    with pytest.raises(InputError, match=r"--outputs; 'y' has separators of thousands \('1.001,34'\): take them out$"):
        assign_roles(table("u", y=["1.001,34", "999,48"]), {"inputs": ("u",)})


def test_the_sheet_is_a_guess_too() -> None:
    frame = table("u", "y")
    frame.attrs["sheets"] = ["Cover", "Run"]
    assert assign_roles(frame, {}).guesses[0] == "Sheet 'Cover' is taken, of Cover, Run: --sheet says otherwise."
    frame.attrs["sheets"] = ["Run"]
    assert "Sheet" not in assign_roles(frame, {}).guesses[0]


def test_a_clock_set_to_summer_time_is_a_remark(tmp_path: Path) -> None:
    stamps = pd.date_range("2024-03-30T20:00", periods=150, freq="5min", tz="Europe/Berlin").tz_localize(None)
    frame = pd.DataFrame(np.random.default_rng(0).standard_normal((150, 2)), columns=["u", "y"])
    frame.assign(time=stamps).to_csv(tmp_path / "a.csv", index=False)
    seen = examine_files([str(tmp_path / "a.csv")], {})
    assert seen.found.remarks[0].startswith("'a.csv' row 74, column 'time': the time goes from 2024-03-31T01:55:00 to ")
    assert "looks like a clock set to summer or winter time" in seen.found.remarks[0]


def test_a_column_of_dates_is_the_time_whatever_its_name() -> None:
    frame = table("u", "y", when=pd.to_datetime(["2020-01-01", "2020-01-02"]))
    assert assign_roles(frame, {}).time == "when"
    named = assign_roles(table("t", "u", "y"), {"time": "u"})
    assert (named.time, named.inputs, named.outputs) == ("u", ("t",), ("y",))
    assert len(named.guesses) == 1


def test_elapsed_times_are_the_time_and_no_dates(tmp_path: Path) -> None:
    frame = pd.DataFrame(np.random.default_rng(0).standard_normal((150, 2)), columns=["u", "y"])
    frame.assign(run=pd.to_timedelta(0.1 * np.arange(150), unit="s")).to_parquet(tmp_path / "a.parquet")
    seen = examine_files([str(tmp_path / "a.parquet")], {})
    assert (seen.roles.time, seen.roles.inputs, seen.found.clock.Ts) == ("run", ("u",), pytest.approx(0.1))


def test_dates_in_text_may_be_the_time_and_are_said_to_be_dates() -> None:
    frame = table("u", "y", when=pd.Series(["2024-01-31T12:00:00.5", "2024-01-31 12:00:01"], dtype=object))
    frame["note"] = pd.Series(["2024-01-31", "late"], dtype=object)
    assert assign_roles(frame, {}).time == "when"
    told = assign_roles(frame, {"Ts": 1.0})
    assert (told.inputs, told.outputs, told.time) == (("u",), ("y",), None)
    assert told.guesses[:2] == (
        "Left out, since they hold dates or elapsed times: when: --time takes one for the time.",
        "Left out, since they hold no numbers: note.",
    )


@pytest.mark.parametrize("kind", [float, object])
def test_an_empty_column_is_no_output(kind: type) -> None:
    found = assign_roles(table("valve", "level", spare=np.array([np.nan, np.nan], dtype=kind)), {"Ts": 1.0})
    assert (found.inputs, found.outputs) == (("valve",), ("level",))
    assert found.guesses[0] == "Left out, since they hold no numbers: spare."


def test_it_is_known_which_roles_were_guessed() -> None:
    frame = table("t", "a", "b")
    for given, guessed in (
        ({}, ("inputs", "outputs", "time")), ({"outputs": ("b",)}, ("inputs", "time")), ({"time": "t"}, ("inputs",
         "outputs")), ({"inputs": ("a",), "outputs": ("b",), "Ts": 1.0}, ()),
    ):  # fmt: skip
        assert assign_roles(frame, given).guessed == guessed


@pytest.mark.parametrize(
    ("cells", "numbers"), [(["a", "1", "2"], True), (["a", "b", "2", "1"], False), (["a"] * 3, False)]
)
def test_a_column_is_one_of_numbers_when_more_than_half_of_its_cells_are(cells: list[str], numbers: bool) -> None:
    frame = pd.DataFrame({"u": np.arange(float(len(cells))), "y": np.arange(float(len(cells)))})
    frame["mixed"] = pd.Series(cells, dtype=object)
    found = assign_roles(frame, {"Ts": 1.0})
    words = [line for line in found.guesses if line.startswith("Left out")]
    assert words == ([] if numbers else ["Left out, since they hold no numbers: mixed."])
    whole = pd.DataFrame({"u": [1, 2], "flag": [True, False], "y": [0.5, 1.0]})
    assert assign_roles(whole, {"Ts": 1.0, "inputs": ("u", "flag")}).outputs == ("y",)


def test_without_a_column_for_an_output_it_is_said_what_there_is() -> None:
    frame = table("u", "v")
    frame.attrs["source"] = "a.csv"
    with pytest.raises(InputError, match=r"'a\.csv': expected a column of numbers as output, found u, v; name it"):
        assign_roles(frame, {"Ts": 1.0, "inputs": ("u", "v")})


# files


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    for seed, name in enumerate(("a b.csv", "c.csv")):
        u, y = np.random.default_rng(seed).standard_normal((2, 60))
        rows = "\n".join(f"{0.5 * k},{one},{two}" for k, (one, two) in enumerate(zip(u, y, strict=True)))
        Path(name).write_text(f"t,u [V],y\n{rows}\n", encoding="utf-8")
    return tmp_path


def test_files_are_experiments_with_units_from_their_names(here: Path) -> None:
    seen = examine_files(["a b.csv", "c.csv"], {})
    assert (seen.name, seen.found.samples, seen.found.clock.Ts) == ("a-b", (60, 60), 0.5)
    assert [(c.name, c.role, c.unit) for c in seen.found.channels] == [("u [V]", "input", "V"), ("y", "output", "–")]
    assert len(seen.guesses) == 2
    told = examine_files(["c.csv"], {"name": "mine", "Ts": 2.0, "inputs": ("u [V]",), "outputs": ("y",),
                                     "input_units": ("mV",), "output_units": ("m",)})  # fmt: skip
    assert (told.name, told.found.clock.Ts, told.found.samples) == ("mine", 2.0, (60,))
    assert [c.unit for c in told.found.channels] == ["mV", "m"]
    (here / "-Öl.csv").write_bytes((here / "c.csv").read_bytes())
    assert examine_files(["-Öl.csv"], {}).name == "Ol"
    with pytest.raises(InputError, match=r"input_units: expected one for each of u \[V\], found 2"):
        examine_files(["c.csv"], {"input_units": ("a", "b")})


def test_a_description_is_inspected_alone_and_what_is_given_goes_before_it(here: Path) -> None:
    (here / "x.toml").write_text(
        'name = "described"\nfiles = ["c.csv"]\ninputs = ["u [V]"]\noutputs = ["y"]\n'
        'time = "t"\noutput_units = ["m"]\n',
        encoding="utf-8",
    )
    seen = examine_files(["x.toml"], {})
    assert (seen.name, seen.found.clock.Ts, seen.guesses) == ("described", 0.5, ())
    assert [c.unit for c in seen.found.channels] == ["V", "m"]
    assert examine_files(["x.toml"], {"name": "own", "output_units": ("K",)}).found.channels[1].unit == "K"
    for names in (["x.toml", "c.csv"], ["c.csv", "x.toml"]):
        with pytest.raises(InputError, match="a description is inspected alone, found 2 files"):
            examine_files(names, {})


def test_rows_in_remarks_are_counted_as_in_the_file(here: Path) -> None:
    """As `train` counts them: the header is row 1, comments and blank lines count."""
    lines = Path("c.csv").read_text(encoding="utf-8").splitlines()
    Path("gap.csv").write_text("\n".join(["# a comment", *lines[:30], "", *lines[31:]]) + "\n", encoding="utf-8")
    told = "1 gap (over 1.5 times the median step), the first before 'gap.csv' row 33."
    assert any(told in remark for remark in examine_files(["gap.csv"], {}).found.remarks)
    assert any(told in remark for remark in examine_files(["c.csv", "gap.csv"], {}).found.remarks)
    with pytest.raises(InputError, match=r"'gap\.csv' row 33: time is not uniform"):
        ready(["gap.csv"], own={"inputs": ("u [V]",), "outputs": ("y",), "time": "t"})


def test_the_sampling_time_is_that_of_training_and_of_its_advice(here: Path) -> None:
    """Stamps with jitter, whose mean step is not the median one; with a gap there is the same step to resample to."""
    t = np.cumsum(np.tile([0.5, 0.5, 0.503], 20))
    table = pd.DataFrame({"t": t, "u": np.sin(t), "y": np.cos(t)})
    table.to_csv("jitter.csv", index=False)
    roles: dict[str, Any] = {"inputs": ("u",), "outputs": ("y",), "time": "t"}
    Ts = examine_files(["jitter.csv"], roles).found.clock.Ts
    assert Ts == ready(["jitter.csv"], own=roles).dataset.fitting.train[0].Ts != float(f"{np.median(np.diff(t)):.9g}")
    table.to_csv("one.csv", index=False)
    table.assign(t=t * 1.0005).to_csv("other.csv", index=False)  # of several files, the first one's
    assert examine_files(["one.csv", "other.csv"], roles).found.clock.Ts == Ts
    table.drop(index=30).to_csv("gap.csv", index=False)
    found = examine_files(["gap.csv"], roles).found.clock
    assert found.Ts == pytest.approx(Ts, rel=1e-4)
    with pytest.raises(InputError, match=re.escape(f"resample (--resample {found.Ts:.9g})")):
        ready(["gap.csv"], own=roles)


# what is given

GIVEN: dict[str, dict[str, Any]] = {
    "split": {"split": "70/20/10"}, "init_window": {"init_window": 5}, "orders": {"orders": (1, 4)},
    "constant": {"detrend": "constant"}, "linear": {"detrend": "linear", "split": "50/30/20"},
    "downsample": {"downsample": 3}, "resample": {"resample": 0.75}, "missing": {"missing": "interpolate"},
    "all": {"missing": "interpolate", "downsample": 2, "detrend": "linear", "split": "70/20/10", "init_window": 5},
    "test": {"test": ("test.csv",), "detrend": "linear"}, "val": {"val": ("val.csv",), "downsample": 2},
    "both": {"val": ("val.csv",), "test": ("test.csv",)},
}  # fmt: skip


@pytest.fixture
def drifting(here: Path) -> Path:
    """Files with a drift; the first misses a sample."""
    for seed, name in enumerate(("a.csv", "val.csv", "test.csv")):
        u = np.random.default_rng(seed).standard_normal(400 + 40 * seed)
        y = lfilter([0, 1.0], [1, -0.8], u) + 0.02 * np.arange(len(u)) + 7
        y += 0.1 * np.random.default_rng(9).standard_normal(len(u))
        pd.DataFrame({"t": 0.5 * np.arange(len(u)), "u": u, "y": y}).to_csv(name, index=False)
    return here


@pytest.mark.parametrize("case", GIVEN)
def test_what_is_shown_is_the_record_that_training_reads_in_the_description_written(case: str, drifting: Path) -> None:
    given = GIVEN[case]
    if "missing" in given:
        table = pd.read_csv("a.csv")
        table.loc[50, "y"] = np.nan
        table.to_csv("a.csv", index=False)
    own = {"inputs": (2,), "outputs": (3,), "time": "t"} | given
    shown = examine_files(["a.csv"], own)
    Path("x.toml").write_text(suggested(shown, ["a.csv"], own, Path("x.toml")), encoding="utf-8")
    description = read_description(Path("x.toml"))
    trained = load_experiments(description)
    parts = {"train": trained.train, "val": trained.val, "test": trained.tests.get("test", ())}
    for role, records in parts.items():
        assert [part.stop - part.start for part in getattr(shown.found.split, role)] == list(map(len, records))
    for i, channel in enumerate(shown.found.channels):
        values = np.concatenate([np.column_stack([r.u, r.y])[:, i] for records in parts.values() for r in records])
        assert (channel.samples, channel.missing) == (len(values), 0)
        assert channel.mean == pytest.approx(values.mean(), abs=1e-12)
        assert channel.sigma == pytest.approx(values.std(ddof=1))
    assert shown.found.clock.Ts == pytest.approx(trained.train[0].Ts)
    assert (shown.found.init_window, shown.found.orders) == (description.init_window, description.orders)
    for key, value in given.items():
        assert getattr(description, key) == ({"test": value} if key == "test" else value)
    # and again from the description, which gives all of it
    again = examine_files(["x.toml"], {}).found
    assert (again.split, again.channels, again.init_window, again.order) == (
        shown.found.split, shown.found.channels, shown.found.init_window, shown.found.order,
    )  # fmt: skip
    assert set(again.given) >= {"orders", "init_window"}
    assert set(shown.found.given) == {
        "split" if key in ("val", "test") else key for key in given if key in ("split", "val", "test", "init_window",
        "orders")
    }  # fmt: skip


def test_a_prepared_record_is_said_to_be_one(drifting: Path) -> None:
    own: dict[str, Any] = {"inputs": ("u",), "outputs": ("y",), "time": "t"}
    found = examine_files(["a.csv"], own | {"downsample": 2, "resample": 0.25}).found
    assert found.used[:2] == (
        "All of this is of the record as training takes it, after its preparation: resample 0.25, downsample 2.",
        "'a.csv': resampled from 400 samples (longest step 0.5 s) to 0.25 s",
    )
    assert (found.clock.Ts, found.clock.source) == (0.5, "preparation")
    assert examine_files(["a.csv"], own | {"downsample": 1, "detrend": "none"}).found.used == ()
    about = examine_files(["a.csv"], own | {"detrend": "constant"}).found
    assert about.used == ("models are about the means of the outputs (detrend constant)",)
    assert about.clock.source == "time column"
    pd.read_csv("val.csv").assign(t=lambda table: 2 * table["t"]).to_csv("slow.csv", index=False)
    with pytest.raises(InputError, match=r"'slow.csv': against 'a.csv': sampling time 2 s, expected 1 s"):
        examine_files(["a.csv", "slow.csv"], own | {"downsample": 2})


@pytest.mark.parametrize(
    ("given", "rule"),
    [
        ({"split": "0.72/0.2/0.08"}, "72/20/8 in time order"), ({"test": ("test.csv",)},
         "75/25/0 in time order, files of their own test"), ({"val": ("val.csv",)}, "files of their own validate"),
        ({"val": ("val.csv",), "test": ("test.csv",)}, "files of their own validate, files of their own test"),
    ],
)  # fmt: skip
def test_a_given_split_is_told_by_its_rule(given: dict[str, Any], rule: str, drifting: Path) -> None:
    assert examine_files(["a.csv"], {"outputs": ("y",), "time": "t"} | given).found.split.rule == rule


# what is recommended


def seen(split: Split, time: str | None = "t", inputs: tuple[str, ...] = ("u",), init_window: int = 3) -> Seen:
    found: Any = SimpleNamespace(split=split, init_window=init_window, orders=(1, 2), given=())
    return Seen("mine", found, Roles(inputs, ("y",), time, ()))


def described(folder: Path, of: Seen, names: list[str], **own: Any) -> Any:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()
    target = folder / "x.toml"
    target.write_text(suggested(of, [str(folder / name) for name in names], own, target), encoding="utf-8")
    return read_description(target)


def whole(*experiments: int) -> tuple[Part, ...]:
    return tuple(Part(e, 0, 10) for e in experiments)


def test_whole_experiments_are_described_by_their_files(tmp_path: Path) -> None:
    split = Split("whole experiments", whole(0, 1), whole(2), whole(3), ())
    found = described(tmp_path, seen(split), ["a.csv", "b.csv", "c.csv", "d.csv"], input_units=("V",))
    assert (found.files, found.val, found.test) == (("a.csv", "b.csv"), ("c.csv",), {"test": ("d.csv",)})
    assert (found.name, found.inputs, found.outputs, found.input_units) == ("mine", ("u",), ("y",), ("V",))
    assert (found.time, found.Ts, found.init_window, found.orders) == ("t", None, 3, (1, 2))


def test_shares_of_one_experiment_are_described_by_percents(tmp_path: Path) -> None:
    split = Split("50/30/20 in time order", (Part(0, 0, 5),), (Part(0, 5, 8),), (Part(0, 8, 10),), ())
    found = described(tmp_path, seen(split, time=None, init_window=1), ["deep/a.csv"], Ts=0.25)
    assert (found.files, found.split, found.val, found.test) == (("deep/a.csv",), "50/30/20", (), {})
    assert (found.Ts, found.time, found.init_window, found.allow_outside) == (0.25, None, 1, False)


def test_of_two_experiments_the_second_tests(tmp_path: Path) -> None:
    split = Split("the second experiment tests", (Part(0, 0, 7),), (Part(0, 7, 10),), whole(1), ())
    found = described(tmp_path, seen(split), ["a.csv", "b.csv"])
    assert (found.files, found.val, found.test) == (("a.csv",), (), {"test": ("b.csv",)})


def test_files_elsewhere_are_allowed_by_name(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "a.csv").touch()
    target = tmp_path / "in" / "x.toml"
    split = Split("none", (), (), (), ())
    text = suggested(seen(split), [str(tmp_path / "a.csv")], {}, target)
    assert str(tmp_path / "a.csv") in text
    assert "allow_outside = true" in text


@pytest.mark.parametrize(
    ("names", "of", "message"),
    [
        (["a.TOML"], {}, "'a.TOML' is a description already"),
        (["a.csv"], {"time": None}, "--ts: expected the sampling"),
        (["a.csv"], {"inputs": ()}, "--inputs: expected at least one input"),
    ],
)  # fmt: skip
def test_what_cannot_be_described_is_refused(
    names: list[str], of: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=message):
        suggested(seen(Split("none", (), (), (), ()), **of), names, {}, tmp_path / "x.toml")
