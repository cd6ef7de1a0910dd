"""Both sides of what decides about a file: thresholds, words, lengths, and where a message points."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from nnss_cli.datasets import preparation, textfile
from nnss_cli.datasets.formats import numbers, read_table
from nnss_cli.datasets.preparation import check_agreement, check_complete, interpolate_missing, resample, uniform_Ts
from nnss_cli.datasets.record import Channels, FittingData, Record, Scaling, first_outputs
from nnss_cli.datasets.windows import check_window, sliding_windows

from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection_files import assign_roles
from nnss_cli.testing import small_dataset

# text


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1.0), (" -2.5e3 ", -2500.0), ("+.5", 0.5), ("5.", 5.0), ("inf", math.inf), ("-Infinity", -math.inf),
        ("True", 1.0), ("FALSE", 0.0), ("1,5", "1,5"), ("1 2", "1 2"), ("0x1A", "0x1A"), ("1e", "1e"), (".", "."),
        ("١", "١"), ("nil", "nil"), ("2024-01-01", "2024-01-01"),
    ],
)  # fmt: skip
def test_a_cell_is_a_number_or_its_text(text: str, value: float | str) -> None:
    assert textfile.cell(text) == value


@pytest.mark.parametrize("text", ["", "  ", "nan", "NaN", "NAN", "NA"])
def test_what_holds_no_sample_is_missing(text: str) -> None:
    assert np.isnan(textfile.cell(text))


def test_a_decimal_comma_excludes_the_point() -> None:
    assert [textfile.cell(text, ",") for text in ("1,5", "-0,25e2", "3", "1.5", ",5")] == [1.5, -25.0, 3.0, "1.5", 0.5]


def test_values_are_shown_on_a_line_of_eighty() -> None:
    assert textfile.shown("x" * 78) == repr("x" * 78)
    assert (len(textfile.shown("x" * 79)), textfile.shown("x" * 79)[-2:]) == (78, "…'")
    assert textfile.shown_path("x" * 78) == repr("x" * 78)
    assert textfile.shown_path("a/" + "x" * 200 + "/file.csv").endswith("/file.csv'")
    assert len(textfile.shown_path("x" * 500)) == 78
    assert textfile.printable("a\n  b\x07c") == "a b?c"
    assert len(textfile.printable("x" * 900)) == 200


def test_a_header_is_words_alone_and_names_what_has_none() -> None:
    assert textfile.header(["u", "", "valve  7"], "f", 1) == ("u", "2", "valve 7")
    assert textfile.header(["1", "2"], "f", 1) is None
    assert textfile.header(["2024-01-01", "2"], "f", 1) is None
    with pytest.raises(InputError, match=r"f row 3: expected column names or samples, found both \('u' and 2\)"):
        textfile.header(["u", "2"], "f", 3)
    with pytest.raises(InputError, match="f: columns 1 and 3 are both named 'u'"):
        textfile.header(["u", "y", "u"], "f", 1)
    with pytest.raises(InputError, match="f: column 2 is named"):
        textfile.header(["u", "y\x07"], "f", 1)


@pytest.mark.parametrize(
    ("text", "columns", "last"),
    [
        ("u;y\n1,5;2,5\n", ["u", "y"], 2.5),
        ("u\ty\n1,5\t2,5\n", ["u", "y"], 2.5),
        ("1,5;2,5\n3;4\n", ["1", "2"], 4.0),
        ("u y\n1.5   2.5\n", ["u", "y"], 2.5),
        ("u, y\n1, 2\n", ["u", "y"], 2.0),
        ('"u, first",y\n1,2\n', ["u, first", "y"], 2.0),
        ("y\n1,5\n2,5\n", ["y"], 2.5),
        ("y\n1.5\n2.5", ["y"], 2.5),
        ("# made by hand\n\nu,y\n1,2\n\n# end\n", ["u", "y"], 2.0),
        ("u,y\n1,2\r\n3,4\r\n", ["u", "y"], 4.0),
        ("date,y\n2024-01-01 10:00:00,3\n", ["date", "y"], 3.0),
    ],
)
def test_a_layout_is_found(text: str, columns: list[str], last: float, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    table = read_table(tmp_path / "a.csv")
    assert list(table.columns) == columns
    assert numbers(table, columns[-1])[-1] == last


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("u,y\n1,2\n3\n", "'a.csv' row 3: expected 2 cells as in the rows before, found 1"),
        ("u,y\n1,2\n3,4,5\n", "'a.csv' row 3: expected 2 cells as in the rows before, found 3"),
        ("# c\nu,y\n1,2\n\n3,4,5\n", "'a.csv' row 5: expected 2 cells"),
        ("u,y\n", "holds column names but no samples"),
        ("# only\n\n", "'a.csv' is empty: expected rows of samples"),
        ('u,y\n1,2\n"3,4\n', "'a.csv' row 3: .*mend the quotes from there on"),
    ],
)
def test_a_broken_row_is_named_as_it_stands_in_the_file(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=said):
        read_table(tmp_path / "a.csv")


def test_infinite_samples_are_refused_where_they_stand(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("u,y\n1,2\n1,inf\n", encoding="utf-8")
    with pytest.raises(InputError, match="^'a.csv' row 3, column 'y': expected a finite number, found inf$"):
        numbers(read_table(tmp_path / "a.csv"), "y")


# preparation


@pytest.mark.parametrize(("step", "uniform"), [(1.0099, True), (1.0101, False), (0.9901, True), (0.9899, False)])
def test_a_time_axis_is_uniform_within_a_hundredth(step: float, uniform: bool) -> None:
    t = np.cumsum([0, *[1.0] * 50, step, *[1.0] * 50])
    if uniform:
        assert uniform_Ts(t) == pytest.approx((100 + step) / 101)
    else:
        with pytest.raises(
            InputError, match=f"^sample 52: .*the step is {step:.6g} s, expected 1 s within 1% .1 of 101"
        ):
            uniform_Ts(t)


@pytest.mark.parametrize(("found", "one"), [(1.00099, True), (1.00101, False), (0.99901, True), (0.99899, False)])
def test_sampling_times_are_one_within_a_thousandth(found: float, one: bool) -> None:
    if one:
        check_agreement(1.0, found, "x")
    else:
        with pytest.raises(InputError, match="x: sampling time"):
            check_agreement(1.0, found, "x")


def test_missing_samples_are_told_with_their_longest_gap() -> None:
    values = np.arange(20.0).reshape(10, 2)
    check_complete(values, ["u", "y"])
    values[[2, 3, 7], 1] = np.nan
    with pytest.raises(InputError, match="^sample 3, column 'y': 3 of 10 samples are missing, the longest gap is 2:"):
        check_complete(values, ["u", "y"])
    late = values.copy()
    late[[5, 6, 7, 9], 1] = late[[0, 5], 0] = np.nan
    with pytest.raises(InputError) as error:
        check_complete(late[:, [1, 0]], ["y", "u"])
    assert str(error.value) == (
        "sample 3, column 'y': 6 of 10 samples are missing, the longest gap is 3, from sample 6 on; "
        "column 'u': 2 of 10 samples are missing, the longest gap is 1, from sample 1 on"
        ': repair the file, or interpolate (--missing interpolate, or missing = "interpolate" in a description)'
    )
    assert interpolate_missing(np.arange(10.0), values, ["u", "y"])[:, 1] == pytest.approx(np.arange(1.0, 20, 2))
    for row, word in ((0, "starts"), (9, "ends")):
        ragged = values.copy()
        ragged[row, 0] = np.nan
        with pytest.raises(InputError, match=f"^sample {row + 1}, column 'u': the record {word} with a missing sample"):
            interpolate_missing(np.arange(10.0), ragged, ["u", "y"])


def test_a_finer_grid_is_straight_lines_up_to_the_last_sample() -> None:
    t, values = np.array([0.0, 1.0, 3.0]), np.array([[0.0], [2.0], [-2.0]])
    assert resample(t, values, 0.5)[:, 0] == pytest.approx([0, 1, 2, 1, 0, -1, -2])
    assert len(resample(t, values, 0.4)) == 8  # 0 … 2.8
    for Ts in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InputError, match="expected a positive sampling time"):
            resample(t, values, Ts)
    with pytest.raises(InputError, match="3.1 s makes fewer than two samples of a record of 3 s"):
        resample(t, values, 3.1)
    with pytest.raises(InputError, match="makes 30000000 samples of 3"):
        resample(t, values, 1e-7)


@pytest.mark.parametrize(
    ("text", "split"),
    [("60/20/20", (0.6, 0.2, 0.2)), ("0.5/0.25/0.25", (0.5, 0.25, 0.25)), ("100/0/0", (1, 0, 0)), ("1/0/0", (1, 0, 0)),
     (" 50 / 25.5 / 24.5 ", (0.5, 0.255, 0.245))],
)  # fmt: skip
def test_a_split_is_in_percent_or_fractions(text: str, split: tuple[float, ...]) -> None:
    assert preparation.parse_split(text) == pytest.approx(split)


@pytest.mark.parametrize(
    "text", ["60/20", "60/20/20/0", "60/20/19", "0.6/0.2/0.3", "0/50/50", "a/b/c", "-60/80/80", "1/2/3"]
)
def test_what_is_no_split_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="^split '"):
        preparation.parse_split(text)


def test_parts_of_a_split_are_rounded_and_cover_everything() -> None:
    parts = preparation.cut(7, (0.6, 0.2, 0.2))
    assert (parts["train"], parts["val"], parts["test"]) == (slice(0, 4), slice(4, 6), slice(6, 7))


# records and windows


def test_a_record_is_checked_once_and_read_only() -> None:
    record = Record([1.0, 2.0], [[1.0], [2.0]], 0.5)
    assert (record.u.shape, record.y.shape, len(record), record[1:].u.tolist()) == ((2, 1), (2, 1), 2, [[2.0]])
    with pytest.raises(ValueError, match="read-only"):
        record.u[0] = 0
    for u, y, Ts, said in (
        ([1.0], [1.0, 2.0], 1.0, "the same length: found 1 and 2 samples"), ([], [], 1.0,
         "u: expected samples × channels"),
        ([1.0, np.nan], [1.0, 2.0], 1.0, "u: sample 1 of channel 0 is nan"), ([1.0], [1.0], 0.0,
         "Ts: expected a positive"),
        ([1.0], [1.0], np.inf, "Ts: expected a positive"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            Record(u, y, Ts)


def test_a_channel_is_constant_when_it_differs_by_rounding_alone() -> None:
    def deviation(values: Any) -> float:
        return float(Scaling.of((Record(values, np.zeros(len(values)), 1.0),)).u_std[0])

    eps = np.finfo(float).eps
    assert deviation([1.0, 1.0 + 8 * eps]) == 1.0
    assert deviation([1.0, 1.0 + 9 * eps]) < 1e-14
    assert deviation([5.0]) == 1.0
    assert deviation([1.0, 3.0]) == pytest.approx(math.sqrt(2))  # ddof = 1
    assert deviation([1e-170, 3e-170]) == pytest.approx(math.sqrt(2) * 1e-170)
    scaling = Scaling.of((Record([0.1] * 3, [1.0, 2.0, 3.0], 1.0), Record([0.1], [6.0], 1.0)))
    assert (scaling.u_mean[0], scaling.y_mean[0]) == (0.1, 3.0)
    assert scaling.normalise_y(scaling.restore_y(np.array([[0.25]]))) == pytest.approx(0.25)
    normal = scaling.apply(Record([0.1], [5.0], 1.0))
    assert (normal.u[0, 0], normal.y[0, 0]) == (0.0, pytest.approx(2 / scaling.y_std[0]))


def test_first_outputs_are_as_many_as_the_inputs_at_most() -> None:
    u = np.zeros((3, 2))
    assert first_outputs([1.0, 2.0], u, 2).tolist() == [[1.0, 2.0]]
    assert len(first_outputs(np.zeros((3, 2)), u, 2)) == 3
    for wrong in (np.zeros((4, 2)), np.zeros((0, 2)), np.zeros((1, 3)), np.zeros((1, 1, 2))):
        with pytest.raises(InputError, match="y_init: expected 1 to 3 samples"):
            first_outputs(wrong, u, 2)


def test_records_of_one_model_are_of_one_kind() -> None:
    data = small_dataset().fitting
    names = Channels(("u",), ("y",), ("–",), ("–",))

    def made(Ts: float = 0.5, window: int = 1, K: int = 9, r: int = 1) -> FittingData:
        val = Record(np.zeros((K, r)), np.zeros(K), Ts)
        return FittingData("d", "p", data.train, (data.val[0], val), data.scaling, names, window)

    made()
    made(0.5 * (1 + 0.9e-9))
    made(window=8)
    for wrong, said in (
        ({"Ts": 0.5 * (1 + 2e-9)}, "validation record 2: expected 1 input, 1 output and Ts = 0.5 s"),
        ({"r": 2}, "found 2 inputs, 1 output and Ts = 0.5 s"), ({"window": 9}, "expected more than the 9 samples"),
        ({"window": 0}, "init window: expected at least 1, found 0"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            made(**wrong)


def test_a_window_fits_the_shortest_record_and_has_three_samples_at_least() -> None:
    records = tuple(Record(np.zeros(K), np.zeros(K), 1.0) for K in (8, 5, 9))
    check_window(records, 5)
    check_window(records, 0)
    with pytest.raises(
        InputError, match="expected at most the 5 samples of training record 2 of 3, found 6; use --window 5"
    ):
        check_window(records, 6)
    check_window((records[0][:3],), 0)
    with pytest.raises(InputError, match="training record 1 of 1: expected at least 3 samples, found 2"):
        check_window((records[0][:2],), 0)


def test_windows_start_every_stride_and_none_crosses_records() -> None:
    records = tuple(Record(np.arange(K) + 100.0 * K, np.arange(K), 1.0) for K in (7, 5))
    u, y = sliding_windows(records, 4, 2)
    assert [window[:, 0].tolist() for window in u] == [
        [700, 701, 702, 703], [702, 703, 704, 705], [500, 501, 502, 503],
    ]  # fmt: skip
    assert [window[0, 0] for window in y] == [0, 2, 0]
    assert [len(window) for window in sliding_windows(records, 0, 2)[0]] == [7, 5]


# what columns are taken for


def roles(columns: list[str], **given: Any) -> tuple[tuple[str, ...], tuple[str, ...], str | None]:
    table = pd.DataFrame({name: ["a", "b"] if name.startswith("word") else [1.0, 2.0] for name in columns})
    found = assign_roles(table, given)
    return found.inputs, found.outputs, found.time


def test_columns_are_taken_for_what_their_names_say_else_the_last_is_the_output() -> None:
    assert roles(["time", "u1", "U_2", "y"]) == (("u1", "U_2"), ("y",), "time")
    assert roles(["T", "in", "out1", "out2"]) == (("in",), ("out1", "out2"), "T")
    assert roles(["a", "b", "c"]) == (("a", "b"), ("c",), None)
    assert roles(["u", "level", "flow"]) == (("u",), ("level", "flow"), None)
    assert roles(["level", "flow", "y"]) == (("level", "flow"), ("y",), None)
    assert roles(["temperature", "using", "yard"]) == (("temperature", "using"), ("yard",), None)
    assert roles(["a", "word", "b"]) == (("a",), ("b",), None)
    assert roles(["y"]) == ((), ("y",), None)


def test_what_is_given_is_kept_and_the_rest_is_guessed() -> None:
    assert roles(["a", "b", "c"], outputs=["a"]) == (("b", "c"), ("a",), None)
    assert roles(["a", "b", "c"], inputs=[1]) == (("a",), ("b", "c"), None)
    assert roles(["a", "b", "c"], time="a") == (("b",), ("c",), "a")
    assert roles(["time", "b", "c"], Ts=0.1) == (("b",), ("c",), None)  # a ramp is no input
    assert roles(["time", "b", "c"], inputs=["time"], outputs=["c"]) == (("time",), ("c",), None)
    with pytest.raises(InputError, match="expected a column of numbers as output, found word"):
        roles(["word"])
    said = assign_roles(pd.DataFrame({"t": [1.0], "word": ["a"], "a": [1.0], "b": [2.0]}), {}).guesses
    assert said == (
        "Column 't' is taken for the time: --time or --ts says otherwise.",
        "Left out, since they hold no numbers: word.",
        "Taken for inputs: a; for outputs: b: --inputs and --outputs say otherwise.",
    )
