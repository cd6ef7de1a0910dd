"""A described record: the file of the description, what it makes of the data, and 2,000 wrong ones."""

import os
import re
import struct
import tracemalloc
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from nnss_cli.datasets.description import Description, field_texts, read_description, write_description
from nnss_cli.datasets.experiments import Experiments, load_experiments
from scipy.io import savemat

from nnss_cli.errors import InputError

KEYS = [option.name for option in fields(Description) if option.name != "folder"]
OWN_DATA = Path(__file__).parents[2] / "docs" / "own-data.md"

names = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9._-]{0,12}", fullmatch=True)
texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=10)
paths = texts.filter(lambda text: "\0" not in text)
lines = texts.map(lambda text: " ".join(text.split()))
seconds = st.floats(1e-9, 1e9)
whole = st.integers(1, 2**31 - 1)


def unique(elements: st.SearchStrategy, least: int = 0) -> st.SearchStrategy[tuple]:
    return st.lists(elements, min_size=least, max_size=3, unique=True).map(tuple)


@st.composite
def descriptions(draw: st.DrawFn) -> Description:
    columns = draw(unique(st.one_of(texts.filter(bool), whole), 3))
    inputs, outputs, time = columns[:1], columns[1:-1], columns[-1]
    val, test = draw(unique(paths)), draw(st.dictionaries(names, unique(paths, 1), max_size=2))
    test = {name: files for name, files in test.items() if name not in ("train", "val")}
    timed, ts = draw(st.sampled_from([(True, False), (True, True), (False, True)]))
    splits = [None] if val else [None, "80/20/0"] if test else [None, "60/20/20", "0.5/0.5/0"]
    return Description(
        name=draw(names), title=draw(lines), files=draw(unique(paths, 1)), val=val, test=test, inputs=inputs,
        outputs=outputs, input_units=draw(st.sampled_from([(), ("V",)])), output_units=draw(lines.map(lambda u: (u,))),
        time=time if timed else None, Ts=draw(seconds) if ts else None,
        resample=draw(seconds) if timed != ts and draw(st.booleans()) else None, downsample=draw(whole),
        missing=draw(st.sampled_from(["refuse", "interpolate"])), split=draw(st.sampled_from(splits)),
        detrend=draw(st.sampled_from(["none", "constant", "linear"])), init_window=draw(whole),
        orders=draw(unique(whole)), horizon=draw(st.sampled_from(["auto", "matlab"])),
        sheet=draw(st.one_of(st.none(), texts.filter(bool), whole)), citation=draw(lines), allow_outside=True,
    )  # fmt: skip


ODD = Description(
    name="a",
    title="\x7f",
    files='"\x1f\\\n.csv',
    test={"a.b": "\t"},
    inputs="\x85",
    outputs="ü💧'",
    Ts=1e-05,
    allow_outside=True,
)


@given(description=descriptions())
@example(description=ODD)
def test_a_description_comes_back_from_its_file(
    description: Description, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.getbasetemp() / "any.toml"
    description = replace(description, folder=path.parent)
    path.write_text(write_description(description), encoding="utf-8", newline="")
    found = read_description(path)
    assert found == description


def test_every_field_is_explained_and_documented(tmp_path: Path) -> None:
    assert [key for key in field_texts() if key != "folder"] == KEYS
    documented = re.findall(r"^\| `(\w+)` \|", OWN_DATA.read_text(encoding="utf-8"), re.MULTILINE)
    assert documented == KEYS
    described = Description(name="a", files="a.csv", inputs="u", outputs=2, Ts=1)
    text = write_description(described)
    for key in KEYS:
        assert re.search(rf"^(# )?{key} =", text, re.MULTILINE), key
        comment = " ".join(re.split(rf"\n(?:# )?{key} =", text)[0].split("\n\n")[-1].replace("\n# ", " ").split())
        assert comment == "# " + field_texts()[key]


MINIMAL = {"files": "a.csv", "inputs": ["u"], "outputs": ["y"], "Ts": 0.5}


def toml(**keys: object) -> str:
    def value(item: object) -> str:
        if isinstance(item, Mapping):
            return "{" + ", ".join(f"{name} = {value(one)}" for name, one in item.items()) + "}"
        if isinstance(item, list):
            return f"[{', '.join(map(value, item))}]"
        if isinstance(item, bool):
            return str(item).lower()
        return f"'{item}'" if isinstance(item, str) else repr(item)

    return "\n".join(f"{key} = {value(item)}" for key, item in keys.items() if item is not None)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"ouputs": ["y"]}, "unknown key 'ouputs': did you mean 'outputs'. valid keys are name, title, .*"),
        ({"outputs": None}, "'d.toml': the key 'outputs' is missing: Columns of the outputs"),
        ({"outputs": []}, "outputs: expected a list of at least one value, found ()"),
        ({"Ts": "0.1"}, "'d.toml': Ts: expected a positive number of seconds, found '0.1'"),
        ({"Ts": True}, "Ts: expected a positive number"),
        ({"Ts": 10**400}, "Ts: expected a positive number of seconds, found 1000"),
        ({"Ts": None, "ts": 0.1}, "unknown key 'ts': did you mean 'Ts'"),
        ({"Ts": float("inf")}, "Ts: expected a positive number"),
        ({"Ts": None}, "Ts: expected the sampling time in seconds, or a time column"),
        ({"inputs": [0]}, "inputs: expected a name, or a number from 1, found .0."),
        ({"inputs": ["u", "u"]}, "inputs: expected each value once"),
        ({"inputs": ["y"]}, "column 'y': expected to be an input, an output or the time, found more than one"),
        ({"time": "u"}, "column 'u': expected"),
        ({"input_units": ["V", "A"]}, "input_units: expected one for each of 1 inputs, found 2"),
        ({"name": "../x"}, "name: expected letters, digits"),
        ({"title": 3}, "title: expected text, found 3"),
        ({"split": "60/20/30"}, "'d.toml': split '60/20/30': the parts sum to 110"),
        ({"split": "80/0/20"}, "the validation part is empty"),
        ({"split": "60/20/20", "val": "b.csv"}, "split: expected none beside val files"),
        ({"split": "60/30/10", "test": "b.csv"}, "expected 0 for test beside test files, as 75/25/0, found 0.1"),
        ({"test": {"warm": "c.csv", "train": "b.csv"}}, "test: expected named test sets .*, found 'train'$"),
        ({"split": [60, 20, 20]}, 'split: expected train/validation/test in percent as text, "60/20/20", found'),
        ({"test": {"warm": ["b.csv"], "orders": [2, 3]}},
         r"'d.toml': 'orders' stands inside the table .test., .*, found .2, 3.: move 'orders' above the line .test."),
        ({"outputs": None, "test": {"outputs": ["y"]}}, "'outputs' stands inside the table .test."),
        ({"test": {"missing": "interpolate"}}, "'missing' stands inside the table .test."),
        ({"test": {"a": []}}, "test: expected named test sets with at least one file each, .*'a' without files$"),
        ({"test": {"warm": ["b.csv"], "-all": ["c.csv"]}},
         "test: test set's name: expected letters, .*, found '-all'$"),
        ({"test": {"warm": ["b.csv"], "cold": ["c.csv", "c.csv"]}},
         "test: test set 'cold': expected each value once .'c.csv' stands twice., found .'c.csv', 'c.csv'.$"),
        ({"test": {"warm": ["b.csv"], "cold": 3}}, "test: test set 'cold': expected text, found 3$"),
        ({"detrend": "cubic"}, 'detrend: expected "none" or "constant" or "linear", found .cubic.'),
        ({"missing": "zero"}, 'missing: expected "refuse" or "interpolate"'),
        ({"downsample": 0}, "downsample: expected a whole number from 1 on, found 0"),
        ({"orders": [2, 2.5]}, "orders: expected a whole number from 1 on, found"),
        ({"allow_outside": 1}, "allow_outside: expected true or false, found 1"),
        ({"time": "t", "resample": 0.1}, "Ts: expected none where a time column is resampled"),
        ({"files": "../a.csv"}, "file '../a.csv' lies outside the description's folder: .*allow_outside"),
        ({"test": {"far": "/etc/passwd"}}, "file '/etc/passwd' lies outside"),
        ({"files": "link.csv"}, "file 'link.csv' lies outside"),
    ],
)  # fmt: skip
def test_a_wrong_description_is_one_line(keys: dict[str, object], message: str, tmp_path: Path) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    (tmp_path / "a.csv").write_text("u,y\n1,2\n")
    (folder / "link.csv").symlink_to(tmp_path / "a.csv")
    (folder / "d.toml").write_text(toml(**MINIMAL | keys))
    with pytest.raises(InputError, match=message) as found:
        read_description(folder / "d.toml")
    assert "\n" not in str(found.value)
    if "lies outside" in message:
        (folder / "d.toml").write_text(toml(**MINIMAL | keys | {"allow_outside": True}))
        read_description(folder / "d.toml")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"files = [", "'d.toml' is no TOML: "), (b"\xff", "'d.toml' is no TOML"), (b"a = 1\na = 2", "is no TOML"),
        (b"", "the key 'files' is missing"), (b"x = " + b"[" * 100_000, "is no TOML"),
        (b"#" * 1_000_001, "longer than"),
    ],
)  # fmt: skip
def test_what_is_no_toml_is_refused(content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / "d.toml").write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_description(tmp_path / "d.toml")
    with pytest.raises(InputError, match="cannot read the description .* No such file"):
        read_description(tmp_path / "none.toml")
    with pytest.raises(InputError, match="cannot read the description .* Is a directory"):
        read_description(tmp_path)


@pytest.mark.parametrize(("file", "name"), [("Öl Tank", "Ol-Tank"), ("run-.2", "run-.2"), ("水", "record")])
def test_a_description_without_a_name_is_named_after_its_file(file: str, name: str, tmp_path: Path) -> None:
    """As a file of samples is; behind the mark that Windows' editors put first, too."""
    (tmp_path / f"{file}.toml").write_text(toml(**MINIMAL), encoding="utf-8-sig")
    assert read_description(tmp_path / f"{file}.toml").name == name


def signals(K: int = 100, seed: int = 0, Ts: float = 0.5) -> pd.DataFrame:
    random = np.random.default_rng(seed)
    return pd.DataFrame({
        "t": np.arange(K) * Ts, "u": random.standard_normal(K), "v": random.standard_normal(K) + 3,
        "y": random.standard_normal(K).cumsum(),
    })  # fmt: skip


def described(folder: Path, **keys: object) -> Description:
    given: dict[str, object] = {"name": "plant", "files": "a.csv", "inputs": ["u", "v"], "outputs": "y", "Ts": 0.5}
    return Description(**given | keys, folder=folder)  # type: ignore[arg-type]


def test_values_of_numpy_pandas_and_pathlib_are_those_of_python() -> None:
    plain = {"name": "p", "inputs": ["u", "v"], "outputs": [3], "files": ["p.csv"], "Ts": 0.5, "init_window": 5}
    given = {
        "name": np.str_("p"), "inputs": pd.Index(["u", "v"]), "outputs": np.array([3]), "files": Path("p.csv"),
        "Ts": np.float32(0.5), "init_window": np.int64(5),
    }  # fmt: skip
    found = Description(**given)
    assert found == Description(**plain)
    assert all(type(value) is str for value in (found.name, *found.inputs, *found.files))
    assert [type(value) for value in (found.outputs[0], found.Ts, found.init_window)] == [int, float, int]
    assert Description(**given | {"orders": np.arange(1, 3), "Ts": np.int64(2)}).orders == (1, 2)
    for wrong in (np.bool_(True), np.float64("nan"), np.datetime64("now")):
        with pytest.raises(InputError, match="Ts: expected a positive number of seconds"):
            Description(**given | {"Ts": wrong})


def test_without_a_time_column_samples_are_evenly_apart(tmp_path: Path) -> None:
    """A gap in a straight line is filled on the line, and nothing is left of it without its trend."""
    frame = signals()
    frame["y"] = 3.0 + 2.0 * frame.t
    frame.loc[[1, 40, 41], "y"] = np.nan
    frame.to_csv(tmp_path / "a.csv", index=False)
    found = load_experiments(described(tmp_path, missing="interpolate"))
    np.testing.assert_allclose(found.train[0].y[:, 0], 3.0 + np.arange(60), rtol=1e-12)


def test_a_time_in_another_unit_gives_seconds_and_a_note(tmp_path: Path) -> None:
    frame = signals().rename(columns={"t": "t [ms]"})
    frame["t [ms]"] *= 1000
    frame.to_csv(tmp_path / "a.csv", index=False)
    found = load_experiments(described(tmp_path, time="t [ms]", Ts=None))
    assert found.train[0].Ts == 0.5
    assert found.notes == ("'a.csv': the time column 't [ms]' is read in ms, as its name says",)


def test_a_clock_set_to_winter_time_is_neither_resampled_nor_interpolated(tmp_path: Path) -> None:
    stamps = pd.date_range("2024-10-26T22:00", periods=len(signals()), freq="5min", tz="Europe/Berlin")
    signals().assign(t=stamps.tz_localize(None)).to_csv(tmp_path / "a.csv", index=False)
    for preparation in ({}, {"resample": 300.0}):
        with pytest.raises(
            InputError, match=r"'a.csv' row 62, column 't': .* looks like a clock set to summer or winter"
        ):
            load_experiments(described(tmp_path, time="t", Ts=None, **preparation))


@pytest.mark.parametrize(("keys", "reach"), [
    ({"missing": "interpolate"}, 2), ({"resample": 0.3}, 1), ({"resample": 1.0}, 19),
])  # fmt: skip
def test_what_is_prepared_before_the_split_reaches_over_a_cut_as_far_as_is_documented(
    keys: dict[str, object], reach: int, tmp_path: Path
) -> None:
    """A gap of two samples ends at the cut."""
    frame = signals()
    frame.loc[[58, 59], "y"] = np.nan if "missing" in keys else 0.0
    changed = frame.copy()
    changed.loc[60:, "y"] += 100.0
    trained = []
    for each in (frame, changed):
        each.to_csv(tmp_path / "a.csv", index=False)
        trained.append(load_experiments(described(tmp_path, time="t", Ts=None, **keys)).train[0].y[:, 0])
    differ = np.flatnonzero(np.abs(trained[1] - trained[0]) > 1e-9)
    assert len(differ) > 0
    assert differ[0] >= len(trained[0]) - reach


def test_one_file_is_cut_in_time_order(tmp_path: Path) -> None:
    frame = signals()
    frame.to_csv(tmp_path / "a.csv", index=False)
    found = load_experiments(described(tmp_path, output_units="m", init_window=4))
    assert isinstance(found, Experiments)
    assert [len(part[0]) for part in (found.train, found.val, found.tests["test"])] == [60, 20, 20]
    together = [found.train[0], found.val[0], found.tests["test"][0]]
    np.testing.assert_array_equal(np.concatenate([record.u for record in together]), frame[["u", "v"]])
    np.testing.assert_array_equal(np.concatenate([record.y for record in together]), frame[["y"]])
    assert {record.Ts for record in together} == {0.5}
    assert (found.channels.inputs, found.channels.outputs) == (("u", "v"), ("y",))
    assert (found.channels.input_units, found.channels.output_units) == (("–", "–"), ("m",))
    assert (found.name, found.init_window, found.notes) == ("plant", 4, ())


def test_the_same_record_comes_from_every_format(tmp_path: Path) -> None:
    frame = signals()
    arrays = {name: frame[name].to_numpy() for name in frame}
    frame.to_csv(tmp_path / "a.csv", index=False)
    frame.to_csv(tmp_path / "a.tsv", sep="\t", index=False)
    frame.to_parquet(tmp_path / "a.parquet")
    frame.to_excel(tmp_path / "a.xlsx", index=False)
    savemat(tmp_path / "a.mat", arrays)
    np.savez(tmp_path / "a.npz", **arrays)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, values in arrays.items():
            file[name] = values
    expected = load_experiments(described(tmp_path))
    for suffix in ("tsv", "parquet", "xlsx", "mat", "npz", "h5"):
        found = load_experiments(described(tmp_path, files=f"a.{suffix}", time="t", Ts=None))
        np.testing.assert_allclose(found.train[0].y, expected.train[0].y, rtol=1e-15, err_msg=suffix)
        np.testing.assert_allclose(found.tests["test"][0].u, expected.tests["test"][0].u, rtol=1e-15, err_msg=suffix)
        assert found.train[0].Ts == 0.5


def test_of_a_time_axis_and_a_sampling_time_that_agree_the_latter_counts(tmp_path: Path) -> None:
    signals(Ts=0.50002).to_csv(tmp_path / "a.csv", index=False)
    found = load_experiments(described(tmp_path, time="t", Ts=0.5))
    assert {record.Ts for record in (*found.train, *found.val)} == {0.5}


def test_files_with_channels_in_another_order_are_not_taken_by_number(tmp_path: Path) -> None:
    """Their inputs would change places."""
    signals().to_csv(tmp_path / "a.csv", index=False)
    signals(seed=1)[["t", "v", "u", "y"]].to_csv(tmp_path / "b.csv", index=False)
    with pytest.raises(InputError, match="b.csv"):
        load_experiments(described(tmp_path, files=["a.csv", "b.csv"], inputs=[2, 3], outputs=[4]))
    by_name = load_experiments(described(tmp_path, files=["a.csv", "b.csv"]))
    assert [len(record) for record in by_name.train] == [60, 60]


def test_files_are_experiments_and_parts(tmp_path: Path) -> None:
    for i, K in enumerate((50, 60, 40, 30, 20)):
        signals(K, seed=i).to_csv(tmp_path / f"{i}.csv", index=False)
    files = {"files": ["0.csv", "1.csv"], "val": ["2.csv"], "test": {"soft": ["3.csv"], "hard": ["4.csv", "3.csv"]}}
    found = load_experiments(described(tmp_path, **files))
    assert [len(record) for record in found.train] == [50, 60]
    assert [len(record) for record in found.val] == [40]
    assert {name: [len(record) for record in records] for name, records in found.tests.items()} == {
        "soft": [30], "hard": [20, 30],
    }  # fmt: skip
    no_val = load_experiments(described(tmp_path, files=["0.csv", "1.csv"], test="4.csv"))
    assert [len(record) for record in (*no_val.train, *no_val.val)] == [38, 45, 12, 15]
    assert [len(record) for record in no_val.tests["test"]] == [20]
    no_test = load_experiments(described(tmp_path, files="0.csv", val="2.csv"))
    assert not no_test.tests
    assert no_test.notes == ("there is no test part",)


@pytest.mark.parametrize("kind", ["none", "constant", "linear"])
def test_a_drift_is_learnt_from_the_training_part_only_and_signals_keep_their_level(kind: str, tmp_path: Path) -> None:
    frame = signals()
    frame.to_csv(tmp_path / "a.csv", index=False)
    frame.assign(y=np.where(np.arange(100) < 60, frame.y, 1e6 * np.arange(100))).to_csv(tmp_path / "b.csv", index=False)
    plain, found = load_experiments(described(tmp_path)), load_experiments(described(tmp_path, detrend=kind))
    other = load_experiments(described(tmp_path, files="b.csv", detrend=kind))
    np.testing.assert_array_equal(found.train[0].y, other.train[0].y)
    assert found.about_means == (kind == "constant")
    if kind != "linear":
        assert found.notes == plain.notes == ()
        for one, two in zip(
            (found.train, found.val, found.tests["test"]), (plain.train, plain.val, plain.tests["test"]), strict=True
        ):
            np.testing.assert_array_equal(one[0].y, two[0].y)
        return
    slope, _ = np.polyfit(frame.t[:60], frame.y[:60], 1)  # one line, which goes on behind the training part
    np.testing.assert_allclose(found.val[0].y[:, 0], frame.y[60:80] - slope * (frame.t[60:80] - frame.t[:60].mean()))
    np.testing.assert_allclose(found.train[0].y.mean(), frame.y[:60].mean())
    (note,) = found.notes
    assert f"y {slope:.4g}" in note
    assert "/s" in note


def test_time_gaps_resampling_and_decimation(tmp_path: Path) -> None:
    frame = signals(400)
    frame.loc[7:9, "v"] = np.nan
    frame.to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(
        InputError, match="'a.csv' row 9, column 'v': 3 of 400 samples are missing, the longest gap is 3"
    ):
        load_experiments(described(tmp_path))
    found = load_experiments(described(tmp_path, missing="interpolate", time="t", downsample=4))
    assert found.train[0].Ts == 2.0
    assert len(found.train[0]) == 60
    assert found.notes == ("'a.csv': 3 missing samples were interpolated",)
    frame.drop(index=range(7, 10)).to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match="'a.csv' row 9: time is not uniform: the step is 2 s, expected 0.5 s"):
        load_experiments(described(tmp_path, time="t"))
    found = load_experiments(described(tmp_path, time="t", Ts=None, resample=0.5))
    np.testing.assert_allclose(found.train[0].y[10:240, 0], frame.y[10:240], atol=1e-12)
    assert found.notes == ("'a.csv': resampled from 397 samples (longest step 2 s) to 0.5 s",)
    signals().to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match="'a.csv': column 't' against Ts: sampling time 0.5 s, expected 0.4 s"):
        load_experiments(described(tmp_path, time="t", Ts=0.4))


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"outputs": "z"}, "'a.csv' has no column 'z': "),
        ({"outputs": "yy"}, "'a.csv' has no column 'yy': did you mean 'y'"),
        ({"inputs": ["u", 2]}, "'a.csv': column 'u' is asked for twice"),
        ({"files": ["a.csv", "c.csv"], "inputs": 2}, r"'c.csv' has the channels w, y, expected u, y as in 'a.csv'"),
        ({"files": ["a.csv", "slow.csv"], "time": "t", "Ts": None}, "'slow.csv': against 'a.csv': sampling time 0.6 s"),
        ({"orders": [30]}, "'a.csv': 20 samples are too few for val: expected 31 or more"),
        ({"init_window": 20}, "'a.csv': 20 samples are too few for val: expected 21 or more"),
        ({"inputs": ["u", "still"]}, r"input 'still' is constant over the training part \(1\)"),
        ({"outputs": "still"}, "output 'still' is constant"),
        ({"inputs": "u", "outputs": ["y", "v", "still"]}, "output 'still' is constant"),
        ({"val": "a.csv"}, "file 'a.csv' stands under two of train, val and test"),
        ({"val": "./a.csv"}, "file './a.csv' stands under two"),
        ({"files": ["a.csv", "./a.csv"]}, "file './a.csv' stands twice, found it as 'a.csv', too"),
        ({"files": ["a.csv", "below/../a.csv"]}, "file 'below/../a.csv' stands twice"),
        ({"test": {"hard": ["b.csv", "./b.csv"]}}, "file './b.csv' stands twice, found it as 'b.csv', too"),
        ({"downsample": 10}, "'a.csv': downsample 10: the filter needs more than 190 samples, found 100"),
        ({"inputs": "v", "time": "u", "Ts": None}, "'a.csv' row 3: time goes from"),
        ({"outputs": "huge"}, r"'a.csv' row 7, column 'huge': 1e\+200: expected numbers below"),
        ({"outputs": "word"}, "'a.csv' row 7, column 'word': expected a number, found 'valve'"),
        ({"files": "b.csv"}, "no such file: .*b.csv"),
    ],
)  # fmt: skip
def test_wrong_data_are_one_line_that_names_them(keys: dict[str, object], message: str, tmp_path: Path) -> None:
    frame = signals()
    frame["still"], frame["huge"], frame["word"] = np.arange(100) // 60 + 1, frame.y, frame.y.astype(object)
    frame.loc[5, "huge"], frame.loc[5, "word"] = 1e200, "valve"
    frame.to_csv(tmp_path / "a.csv", index=False)
    frame.rename(columns={"u": "w"}).to_csv(tmp_path / "c.csv", index=False)
    frame.assign(t=frame.t * 1.2).to_csv(tmp_path / "slow.csv", index=False)
    with pytest.raises(InputError, match=message) as found:
        load_experiments(described(tmp_path, **keys))
    assert "\n" not in str(found.value)


class Mutator:
    """Seeded wrong inputs: a good record and description, each broken somewhere."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.folder, self.random = folder, np.random.default_rng(seed)

    def pick(self, *choices: object) -> object:
        return choices[int(self.random.integers(len(choices)))]

    def data(self) -> str:
        """Write a data file of any format, often damaged; its name."""
        suffix = str(self.pick("csv", "csv", "csv", "tsv", "csv.gz", "xlsx", "parquet", "mat", "npz", "h5", "pkl"))
        path = self.folder / f"a.{suffix}"
        frame = signals(int(self.pick(0, 2, 60, 60, 200)), seed=1)
        for _ in range(int(self.random.integers(3))):
            frame = self.spoilt(frame)
        arrays = {str(name): frame[name].to_numpy() for name in dict.fromkeys(frame.columns) if frame[name].ndim == 1}
        match suffix:
            case "xlsx":
                frame.map(lambda value: value.replace("\0", "") if isinstance(value, str) else value).to_excel(
                    path, index=False
                )
            case "parquet":
                pd.DataFrame({name: pd.Series(values).astype(str) if values.dtype == object else values
                              for name, values in arrays.items()}).to_parquet(path)  # fmt: skip
            case "mat":
                savemat(path, {name.strip() or "x": values for name, values in arrays.items()})
            case "npz":
                np.savez(path, **arrays)
            case "h5":
                with h5py.File(path, "w") as file:
                    for name, values in arrays.items():
                        file[name or "x"] = (
                            np.array([str(value).encode() for value in values]) if values.dtype == object else values
                        )
            case _:
                frame.to_csv(path, index=False, sep=str(self.pick(",", ";", "\t", " ")))
        if self.random.random() < 0.5:
            path.write_bytes(self.damaged(path.read_bytes()))
        return path.name

    def spoilt(self, frame: pd.DataFrame) -> pd.DataFrame:
        frame, name = frame.copy(), str(self.pick("t", "u", "v", "y"))
        k = int(self.random.integers(len(frame) or 1))
        if name not in frame.columns or len(frame) == 0 or frame[name].ndim > 1:
            return frame
        match self.pick("word", "nan", "inf", "constant", "rename", "drop", "jump", "back", "date", "huge"):
            case "word":
                frame[name] = frame[name].astype(object)
                frame.loc[k, name] = str(
                    self.pick("n/a", "#", '"', "1,5", "\n", "1;2", "١", "0x1f", "1 000", "\x00", "💧")
                )
            case "nan":
                frame.loc[k : k + int(self.random.integers(20)), name] = np.nan
            case "inf":
                frame.loc[k, name] = -np.inf
            case "constant":
                frame[name] = 1.0
            case "rename":
                frame = frame.rename(columns={name: str(self.pick("u", "t", "", "1", "a b", "# x", '"'))})
            case "drop":
                frame = frame.drop(columns=name)
            case "jump":
                frame["t"] = np.arange(len(frame)) + np.where(np.arange(len(frame)) >= k, 1e6, 0)
            case "back":
                frame = frame.iloc[::-1]
            case "date":
                frame[name] = pd.date_range("2024-01-01", periods=len(frame), freq="s").astype(str).astype(object)
            case "huge":
                frame.loc[k, name] = 1e308
        return frame

    def damaged(self, content: bytes) -> bytes:
        at = int(self.random.integers(max(1, len(content))))
        match self.pick("cut", "flip", "insert", "zeros", "empty", "join", "size"):
            case "cut":
                return content[:at]
            case "flip":
                return content[:at] + self.random.bytes(3) + content[at + 3 :]
            case "insert":
                extra = self.pick(b",", b'"', b"\n", b"\n#", b"\xff", b"\x00", b";", b"1e999", b"\r")
                return content[:at] + bytes(extra) + content[at:]  # type: ignore[arg-type]
            case "zeros":
                return content[:at] + bytes(64) + content[at + 64 :]
            case "empty":
                return b""
            case "join":
                return content + content[at:]
        at -= at % 8
        return content[:at] + struct.pack("<q", int(self.pick(2**62, -1, 2**33))) + content[at + 8 :]

    def description(self, file: str) -> str:
        keys: dict[str, object] = {"files": file, "inputs": ["u", "v"], "outputs": ["y"], "Ts": 0.5}
        options: dict[str, tuple[object, ...]] = {
            "time": ("t", 1, "x", 99), "Ts": (None, -1, 0, "a", 1e-300, 1e300, 7), "title": ("a", 1),
            "resample": (0.1, 5, 1e-9, 1e300, -1), "horizon": ("matlab", "long"),
            "split": ("60/20/20", "98/1/1", "1/1/98", "100/0/0", "a", "50/50/0"),
            "detrend": ("linear", "constant", "x"),
            "downsample": (2, 3, 0, 10**6, 2**40), "missing": ("interpolate", "x"), "orders": ([3], [50], [0], "x"),
            "init_window": (5, 10**6, 0), "val": (file, "no.csv", ".."),
            "test": ("no.csv", {"a": "no.csv"}, {"val": "b"}),
            "inputs": ([1], [2, 3], ["u"], [], ["y"], [99], [-1], [True], 3), "outputs": (["t"], [4], "y", [""], [2.5]),
            "sheet": (1, 2, "Sheet1", 0), "name": ("", "a/b", "x" * 200),
            "files": ([file, file], [], "../a.csv", "/dev/zero", ".", "a\x7f", 5),
            "unknown": (1,), "allow_outside": (True, "yes"), "citation": (1, "a"),
            "input_units": (["V"], ["V", "A"], [1]),
        }  # fmt: skip
        for _ in range(int(self.random.integers(4))):
            key = str(self.pick(*options))
            keys[key] = self.pick(*options[key])
        text = toml(**keys)
        return self.damaged(text.encode()).decode("utf-8", "replace") if self.random.random() < 0.15 else text


def try_wrong_inputs(folder: Path, cases: range) -> tuple[int, int]:
    """How many of the cases were accepted and refused; anything but an InputError of one line fails."""
    folder = folder / "study"
    folder.mkdir()
    accepted = refused = 0
    for case in cases:
        mutator = Mutator(folder, case)
        (folder / "d.toml").write_text(mutator.description(mutator.data()), encoding="utf-8")
        before = sorted(os.listdir(folder))
        told = ""
        try:
            load_experiments(read_description(folder / "d.toml"))
            accepted += 1
        except InputError as error:
            told = str(error)
            refused += 1
        except BaseException as error:
            raise AssertionError(f"case {case}: {type(error).__name__}: {error}") from error
        assert told.isprintable(), f"case {case}: {told!r}"
        assert sorted(os.listdir(folder)) == before, f"case {case} wrote something"
        for file in folder.iterdir():
            file.unlink()
    return accepted, refused


@pytest.mark.filterwarnings("ignore")
def test_200_wrong_inputs_are_refused_in_one_line(tmp_path: Path) -> None:
    accepted, refused = try_wrong_inputs(tmp_path, range(200))
    assert accepted > 5, "some are still right, so that the reader is not refusing everything"
    assert refused > 100


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_2000_wrong_inputs_are_refused_in_one_line(tmp_path: Path) -> None:
    tracemalloc.start()
    accepted, refused = try_wrong_inputs(tmp_path, range(10_000, 12_000))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert accepted > 50
    assert refused > 1000
    assert peak < 2e9, "a size in a damaged header took memory"
