"""Every format is written here and read back; what is no table is refused in one line that names the place."""

import gzip
import io
import os
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import openpyxl
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from nnss_cli.datasets import arrayfile, textfile
from nnss_cli.datasets.formats import SUFFIXES, clock_change, numbers, read_table, steady_times, time_note, times
from scipy.io import savemat

from nnss_cli.errors import InputError

Frame = pd.DataFrame


def text_of(frame: Frame, delimiter: str, decimal: str = ".", names: bool = True) -> str:
    rows = [[repr(float(value)).replace(".", decimal) for value in row] for row in frame.to_numpy()]
    quoted = ['"' + str(name).replace('"', '""') + '"' for name in frame.columns]
    return "".join(delimiter.join(row) + "\n" for row in ([quoted] if names else []) + rows)


def write_excel(path: Path, frame: Frame) -> None:
    book = openpyxl.Workbook()
    for row in [list(frame.columns), *frame.to_numpy().tolist()]:
        book.active.append(row)
    book.save(path)


def write_hdf5(path: Path, frame: Frame) -> None:
    with h5py.File(path, "w", track_order=True) as file:
        for name in frame:
            file[name] = frame[name].to_numpy()


def write_mat73(path: Path, frame: Frame) -> None:
    """As MATLAB writes -v7.3: a header of 512 bytes, arrays by columns, their class as an attribute."""
    with h5py.File(path, "w", userblock_size=512, track_order=True) as file:
        for name in frame:
            file.create_dataset(name, data=frame[[name]].to_numpy().T).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM")


WRITERS: dict[str, Callable[[Path, Frame], object]] = {
    "comma.csv": lambda path, frame: path.write_text(text_of(frame, ","), encoding="utf-8"),
    "bom.csv": lambda path, frame: path.write_text(text_of(frame, ","), encoding="utf-8-sig"),
    "utf16.txt": lambda path, frame: path.write_text(text_of(frame, "\t"), encoding="utf-16"),
    "semicolon.csv": lambda path, frame: path.write_text(text_of(frame, ";"), encoding="utf-8"),
    "german.csv": lambda path, frame: path.write_text(text_of(frame, ";", ","), encoding="utf-8"),
    "german-tab.txt": lambda path, frame: path.write_text(text_of(frame, "\t", ","), encoding="utf-8"),
    "tab.tsv": lambda path, frame: path.write_text(text_of(frame, "\t"), encoding="utf-8"),
    "blanks.dat": lambda path, frame: path.write_text(text_of(frame, "  "), encoding="utf-8"),
    "packed.csv.gz": lambda path, frame: path.write_bytes(gzip.compress(text_of(frame, ",").encode())),
    "UPPER.CSV": lambda path, frame: path.write_text(text_of(frame, ","), encoding="utf-8"),
    "excel.xlsx": write_excel,
    "table.parquet": lambda path, frame: frame.to_parquet(path),
    "v5.mat": lambda path, frame: savemat(path, {name: frame[name].to_numpy() for name in frame}),
    "v73.mat": write_mat73,
    "arrays.npz": lambda path, frame: np.savez(path, **{name: frame[name].to_numpy() for name in frame}),
    "plain.h5": write_hdf5,
    "plain.hdf5": write_hdf5,
}

finite = st.floats(allow_nan=False, allow_infinity=False)
words = st.text(st.characters(categories=["L", "N", "P", "S"]), min_size=1, max_size=8)
"""Names of a text file: what reads as a number, a date, a missing cell or a comment is none."""
names_of_text = words.filter(
    lambda name: (
        all(isinstance(textfile.cell(name, mark), str) for mark in ".,")
        and not textfile._DATE.fullmatch(name)
        and name[0] not in "#\"'"
    )
)
names_of_arrays = st.from_regex(r"[A-Za-z][A-Za-z0-9]{0,8}_", fullmatch=True)


def tables(names: st.SearchStrategy[str]) -> st.SearchStrategy[Frame]:
    def of(values: np.ndarray) -> st.SearchStrategy[Frame]:
        count = values.shape[1]
        return st.lists(names, min_size=count, max_size=count, unique=True).map(
            lambda found: Frame(values, columns=pd.Index(found, dtype=object))
        )

    shapes = st.tuples(st.integers(2, 12), st.integers(1, 4))
    return shapes.flatmap(lambda shape: hnp.arrays(np.float64, shape, elements=finite)).flatmap(of)


def check_round_trip(file: str, folder: Path, frame: Frame) -> None:
    path = folder / file
    WRITERS[file](path, frame)
    found = read_table(path)
    if file in ("v73.mat", "plain.h5", "plain.hdf5"):  # HDF5 keeps its names sorted, and has no other order
        frame = frame[sorted(frame.columns)]
    assert list(found.columns) == list(frame.columns)
    expected = frame.to_numpy()
    if file == "excel.xlsx":  # openpyxl writes sixteen digits
        expected = expected.clip(-1e308, 1e308)  # which round the largest number to infinity
        np.testing.assert_allclose(found.to_numpy().clip(-1e308, 1e308), expected, rtol=1e-15)
    else:
        np.testing.assert_array_equal(found.to_numpy(), expected)


ARRAYS = ("table.parquet", "v5.mat", "v73.mat", "arrays.npz", "plain.h5", "plain.hdf5", "excel.xlsx")


@pytest.mark.parametrize("file", [file for file in WRITERS if file not in ARRAYS])
@given(frame=tables(names_of_text))
@example(frame=Frame({"flow, in [m³/h]": [1.0, -0.0], 'level "L"; x': [5e-324, 1.7976931348623157e308]}))
@example(frame=Frame({"u": [1.0, 2.0], "y": [3.0, 4.0]}))
def test_any_table_comes_back_from_text(file: str, frame: Frame, tmp_path_factory: pytest.TempPathFactory) -> None:
    check_round_trip(file, tmp_path_factory.getbasetemp(), frame)


@pytest.mark.parametrize("file", ARRAYS)
@given(frame=tables(names_of_arrays))
def test_any_table_comes_back_from_arrays(file: str, frame: Frame, tmp_path_factory: pytest.TempPathFactory) -> None:
    check_round_trip(file, tmp_path_factory.getbasetemp(), frame)


def test_no_suffix_is_untried() -> None:
    assert {Path(file.lower().removesuffix(".gz")).suffix for file in WRITERS} == set(SUFFIXES)


def write(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("delimiter", [",", ";", "\t", " "])
@given(values=hnp.arrays(np.float64, st.tuples(st.integers(1, 5), st.integers(2, 4)), elements=finite))
def test_columns_without_names_are_numbered(
    delimiter: str, values: np.ndarray, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = write(tmp_path_factory.getbasetemp() / "plain.csv", text_of(Frame(values), delimiter, names=False))
    found = read_table(path)
    assert list(found.columns) == [str(i + 1) for i in range(values.shape[1])]
    np.testing.assert_array_equal(found.to_numpy(), values)


def test_rows_are_counted_as_in_the_file(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "# pump test\n\nu,y\n1,2\n# valve opened\n3,4\n\n5,x\n")
    found = read_table(path)
    assert list(found.index) == [4, 6, 8]
    np.testing.assert_array_equal(numbers(found, "u"), [1, 3, 5])
    with pytest.raises(InputError, match="^'a.csv' row 8, column 'y': expected a number, found 'x'$"):
        numbers(found, "y")
    numeric = write(tmp_path / "c.csv", "u,y\n1,2\n# valve opened\n3,4\n\n5,6\n")
    assert list(read_table(numeric).index) == [2, 4, 6]
    no_comment = write(tmp_path / "b.csv", "u,y\n" + "1,2\n" * 14 + "1,n/a\n1,2\n")
    with pytest.raises(InputError, match="^'b.csv' row 16, column 'y': expected a number, found 'n/a'$"):
        numbers(read_table(no_comment), "y")


@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize("between", ["", "\n", "# a comment\n", "  \n"])
def test_a_row_of_missing_samples_is_a_row_whatever_stands_between(mark: str, between: str, tmp_path: Path) -> None:
    rows = [f"u{mark}y\n", f"1{mark}2\n", f"{mark}\n", f"3{mark}4\n"]
    (tmp_path / "a.tsv").write_text(between.join(rows) + between)
    table = read_table(tmp_path / "a.tsv")
    np.testing.assert_array_equal(table.to_numpy(), [[1, 2], [np.nan, np.nan], [3, 4]])
    step = 1 + bool(between)
    assert list(table.index) == [1 + step, 1 + 2 * step, 1 + 3 * step]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_text_in_gzip_is_of_the_same_encodings(encoding: str, tmp_path: Path) -> None:
    content = "u,y\n1,2\n3,4\n".encode(encoding)
    (tmp_path / "a.csv").write_bytes(content)
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(content))
    for name in ("a.csv", "a.csv.gz"):
        np.testing.assert_array_equal(read_table(tmp_path / name).to_numpy(), [[1, 2], [3, 4]])


def test_a_row_of_excel_is_the_sheet_s(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    book.active.title = "first"
    sheet = book.create_sheet("run 2")
    for row in ([], ["u", "y"], [1, 2.5], [3, None], ["4", True], [5, "#DIV/0!"], []):
        sheet.append(row)
    book.active.append([7])
    book.save(tmp_path / "a.xlsx")
    found = read_table(tmp_path / "a.xlsx", sheet=2)
    np.testing.assert_array_equal(numbers(found, "u"), [1, 3, 4, 5])
    with pytest.raises(InputError, match="'a.xlsx' row 6, column 'y': expected a number, found '#DIV/0!'"):
        numbers(read_table(tmp_path / "a.xlsx", sheet="run 2"), "y")
    np.testing.assert_array_equal(read_table(tmp_path / "a.xlsx"), [[7]])
    with pytest.raises(InputError, match="no sheet 'run': it has first, run 2"):
        read_table(tmp_path / "a.xlsx", sheet="run")


def test_missing_booleans_and_whole_numbers(tmp_path: Path) -> None:
    text = write(tmp_path / "a.csv", "a,b,c,d\n1,,True,9007199254740993\nNaN,2, false,3\nNA,nan,TRUE, 4\n")
    found = read_table(text)
    expected = np.array([[1, np.nan, 1, 2.0**53], [np.nan, 2, 0, 3], [np.nan, np.nan, 1, 4]])
    np.testing.assert_array_equal(np.column_stack([numbers(found, name) for name in found]), expected)
    table = pa.table({
        "a": pa.array([1, None, None]), "b": pa.array([None, 2.0, None]), "c": [True, False, True],
        "d": pa.array([2**53 + 1, 3, 4], pa.uint64()),
    })  # fmt: skip
    pa.parquet.write_table(table, tmp_path / "a.parquet")
    np.testing.assert_array_equal(read_table(tmp_path / "a.parquet").to_numpy(), expected)
    np.savez(tmp_path / "a.npz", c=np.array([True, False]), d=np.array([2**53 + 1, 3]))
    np.testing.assert_array_equal(read_table(tmp_path / "a.npz").to_numpy(), expected[:2, 2:])


def test_silverbox_s_trailing_delimiter_makes_no_column(tmp_path: Path) -> None:
    found = read_table(write(tmp_path / "a.csv", '"V1","V2",\n1,2,\n3,4,\n'))
    assert list(found.columns) == ["V1", "V2"]
    np.testing.assert_array_equal(found.to_numpy(), [[1, 2], [3, 4]])


@pytest.mark.parametrize("text", ["u;y\n1,5;2;\n3;4; \n", "u,y\n1.5,2,\n# pump\n3,4,\n", "u\ty\n1.5\t2\t\n3\t4\t\n"])
def test_rows_may_end_in_a_delimiter_that_the_header_lacks(text: str, tmp_path: Path) -> None:
    """All of them: what stands behind it in one row is no column without a name, nor does it move the others."""
    found = read_table(write(tmp_path / "a.txt", text))
    assert list(found.columns) == ["u", "y"]
    np.testing.assert_array_equal(found.to_numpy(), [[1.5, 2], [3, 4]])
    mark = text[1]
    at = text.count("\n") + 1
    with pytest.raises(InputError, match=f"row {at}: expected 2 cells as in the header, found 3: name the last column"):
        read_table(write(tmp_path / "a.txt", f"{text}5{mark}6{mark}7\n8{mark}9{mark}\n"))
    with pytest.raises(InputError, match=f"row {at}: expected 3 cells as in the rows before, found 2$"):
        read_table(write(tmp_path / "a.txt", f"{text}5{mark}6\n"))
    with pytest.raises(InputError, match="row 3: expected 2 cells .* found 3: it ends in a delimiter, which is to be"):
        read_table(write(tmp_path / "a.txt", f"u{mark}y\n1{mark}2\n3{mark}4{mark}\n"))


def test_a_decimal_comma_may_come_late(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "u;y\n" + "1;2\n" * 200 + "1;2,5\n")
    assert numbers(read_table(path), "y")[-1] == 2.5


def test_times_are_seconds_whichever_way_they_are_written(tmp_path: Path) -> None:
    stamps = pd.date_range("2024-02-29 23:59:59.5", periods=5, freq="500ms")
    expected = 0.5 * np.arange(5)
    frame = Frame({"t": stamps, "s": expected, "y": np.arange(5.0)})
    frame.to_parquet(tmp_path / "a.parquet")
    frame.to_excel(tmp_path / "a.xlsx", index=False)
    frame.to_csv(tmp_path / "a.csv", index=False)
    frame.assign(t=frame.t.map(lambda stamp: stamp.isoformat() + "+01:00")).to_csv(tmp_path / "b.csv", index=False)
    np.savez(tmp_path / "a.npz", t=stamps.to_numpy(), s=expected)
    for file in ("a.parquet", "a.xlsx", "a.csv", "b.csv", "a.npz"):
        table = read_table(tmp_path / file)
        np.testing.assert_allclose(times(table, "t"), expected, atol=1e-9, err_msg=file)
        np.testing.assert_array_equal(times(table, "s"), expected)
        with pytest.raises(InputError, match="column 't': expected a number, found"):
            numbers(table, "t")
    wrong = write(tmp_path / "c.csv", "t,y\n2024-01-01,1\n01.02.2024,2\n")
    with pytest.raises(InputError, match=r"'c.csv' row 3, column 't': expected a time .* found '01.02.2024'"):
        times(read_table(wrong), "t")


def test_elapsed_times_are_seconds_as_a_time_and_no_signal(tmp_path: Path) -> None:
    seconds = 90_000 + 0.5 * np.arange(5)
    for unit in ("s", "ms", "us", "ns"):
        run = pd.Series(pd.to_timedelta(seconds, unit="s")).astype(f"timedelta64[{unit}]")
        run[2] = pd.NaT
        expected = np.where(np.arange(5) == 2, np.nan, np.floor(seconds) if unit == "s" else seconds)
        frame = Frame({"run [ms]": run, "y": np.arange(5.0)})
        frame.to_parquet(tmp_path / "a.parquet")
        np.savez(tmp_path / "a.npz", **{"run [ms]": run.to_numpy(), "y": frame.y})
        book = openpyxl.Workbook()
        for row in [list(frame.columns), *[[None if pd.isna(t) else t.to_pytimedelta(), 1] for t in run]]:
            book.active.append(row)  # openpyxl gives them the format [h]:mm:ss
        book.save(tmp_path / "a.xlsx")
        for file in ("a.parquet", "a.npz", "a.xlsx"):
            table = read_table(tmp_path / file)
            np.testing.assert_allclose(times(table, "run [ms]"), expected, atol=1e-9, err_msg=f"{file} {unit}")
            assert clock_change(table, "run [ms]", times(table, "run [ms]")) == time_note(table, "run [ms]") == ""
            with pytest.raises(InputError, match="column 'run .ms.': expected a number, found the elapsed time 1 days"):
                numbers(table, "run [ms]")


def test_elapsed_times_in_no_fixed_unit_are_no_column(tmp_path: Path) -> None:
    arrays = {unit: np.arange(3).astype(f"m8[{unit}]") for unit in ("Y", "M", "ps", "generic", "m")}
    np.savez(tmp_path / "a.npz", y=np.arange(3.0), **arrays)
    assert list(read_table(tmp_path / "a.npz").columns) == ["y", "m"]
    with pytest.raises(InputError, match="'M' cannot be a column: type timedelta64.M., not real numbers"):
        read_table(tmp_path / "a.npz", ["M"])


def test_a_time_is_read_in_the_unit_that_its_name_states(tmp_path: Path) -> None:
    for name, seconds in {"t": 1, "t [s]": 1, "time_ms": 1e-3, "t (µs)": 1e-6, "Time [min]": 60, "t [h]": 3600}.items():
        table = read_table(write(tmp_path / "a.csv", f"{name},y\n0,1\n20,2\n40,\n"))
        np.testing.assert_allclose(times(table, name), 20.0 * np.arange(3) * seconds, rtol=1e-15)
        unit = {1e-3: "ms", 1e-6: "us", 60: "min", 3600: "h"}.get(seconds)
        assert time_note(table, name) == (
            f"the time column '{name}' is read in {unit}, as its name says" if unit else ""
        )
    dates = read_table(write(tmp_path / "a.csv", "Time [min],y\n2024-01-01 00:00,1\n2024-01-01 00:01,2\n"))
    assert times(dates, "Time [min]")[1] == 60
    assert time_note(dates, "Time [min]") == ""


def test_numbers_that_are_no_seconds_are_refused(tmp_path: Path) -> None:
    table = read_table(
        write(tmp_path / "a.csv", "t [samples],t,t [ms]\n0,,1709625600000\n1,1709625600020,1709625600020\n")
    )
    with pytest.raises(InputError, match=r"'a.csv', column 't \[samples\]': expected a unit of time .*found 'samples'"):
        times(table, "t [samples]")
    with pytest.raises(InputError, match="expected seconds, found 1709625600020, as of Unix time in ms"):
        times(table, "t")
    np.testing.assert_allclose(np.diff(times(table, "t [ms]")), 0.02, rtol=1e-4)


@pytest.mark.parametrize("minutes", [5, 60])
@pytest.mark.parametrize(("start", "to"), [("2024-03-30", "03:00"), ("2024-10-26", "02:00")])
def test_a_clock_set_to_summer_or_winter_time_is_told(minutes: int, start: str, to: str, tmp_path: Path) -> None:
    """Not where there are offsets, not of a gap by day, and not of numbers."""
    stamps = pd.Series(
        pd.date_range(f"{start}T00:00", periods=3000 // minutes, freq=f"{minutes}min", tz="Europe/Berlin")
    )

    def told(values: pd.Series) -> str:
        values.rename("when").to_csv(tmp_path / "a.csv")
        table = read_table(tmp_path / "a.csv")
        return clock_change(table, "when", times(table, "when"))

    local = stamps.dt.tz_localize(None)
    message = told(local)
    at = int(np.flatnonzero(local.diff() != pd.Timedelta(minutes=minutes))[1]) + 2
    assert message.startswith(f"'a.csv' row {at}, column 'when': the time goes from {start[:8]}")
    assert f"T{to}:00 amid steps of {60 * minutes} s, which looks like a clock set to summer or winter time" in message
    assert message.endswith(f"or leave the column out and give the sampling time (--ts {60 * minutes})")
    with pytest.raises(InputError, match="looks like a clock"):
        steady_times(read_table(tmp_path / "a.csv"), "when")
    assert told(stamps) == told(stamps.dt.tz_convert("UTC").dt.tz_localize(None)) == ""
    mixed = local.dt.strftime("%Y-%m-%dT%H:%M").where(local.index < at - 2, stamps.astype(str))
    assert told(mixed) == ""
    by_day = pd.Series(pd.date_range("2024-03-30T08:00", periods=100, freq="1min"))
    assert told(by_day.where(by_day.index < 50, by_day + pd.Timedelta(hours=1))) == ""
    assert told(pd.Series(np.where(np.arange(100) < 50, 0, 3600) + 300 * np.arange(100))) == ""


@pytest.mark.parametrize(("minutes", "scatter"), [(5, 10), (5, 50), (20, 60), (360, 60), (360, 0)])
@pytest.mark.parametrize("start", ["2024-03-28", "2024-10-24"])
@pytest.mark.parametrize("seed", range(3))
def test_a_clock_change_is_told_amid_steps_that_scatter(minutes: int, scatter: int, start: str, seed: int) -> None:
    """And steps of hours; not in UTC, nor where the gap is by day."""
    random = np.random.default_rng(seed)
    grid = pd.Series(pd.date_range(f"{start}T05:00", periods=6 * 1440 // minutes, freq=f"{minutes}min", tz="UTC"))
    stamps = grid + pd.to_timedelta(random.uniform(-scatter, scatter, len(grid)).round(3), unit="s")

    def told(values: pd.Series) -> str:
        table = Frame({"when": values})
        return clock_change(table, "when", times(table, "when"))

    message = told(stamps.dt.tz_convert("Europe/Berlin").dt.tz_localize(None))
    assert "looks like a clock set to summer or winter time" in message
    assert float(message.split("--ts ")[1].rstrip(")")) == pytest.approx(60 * minutes, rel=1e-3)
    naive = stamps.dt.tz_localize(None)
    assert told(naive) == ""
    noon = naive.searchsorted(pd.Timestamp(f"{start}T12:00") + pd.Timedelta(days=4))
    if minutes < 60:
        assert told(naive.where(naive.index < noon, naive + pd.Timedelta(hours=1))) == ""


def test_dates_that_run_back_are_named_as_they_stand() -> None:
    """By about an hour at night they are a clock's, however uneven the steps; then to sort them would be wrong."""
    uneven = pd.Series(np.cumsum(np.random.default_rng(0).uniform(60, 600, 100)))

    def refused(start: str, back: float) -> str:
        seconds = uneven.where(uneven.index < 50, uneven - back)
        with pytest.raises(InputError) as error:
            steady_times(Frame({"when": pd.Timestamp(start) + pd.to_timedelta(seconds.round(), unit="s")}), "when")
        return str(error.value)

    night = "2024-10-26T22:30"
    assert "looks like a clock set to summer or winter time" in refused(night, 3600)
    for message in (refused(night, 9000), refused("2024-10-26T12:00", 3600)):
        stamp = r"2024-10-\d\dT[\d:]{8}"
        goes = f"time goes from {stamp} to {stamp}: expected it to grow; sort or cut the rows"
        assert re.fullmatch(f"'table' row 50, column 'when': {goes}", message)


def test_what_spreadsheets_add_is_told_by_name(tmp_path: Path) -> None:
    units = read_table(write(tmp_path / "a.csv", "t,u\ns,V\n0,1\n1,2\n"))
    hint = "row 2, column '{}': expected a .*, found '{}': if this is a row of units, delete it and give --input-units"
    with pytest.raises(InputError, match=hint.format("u", "V")):
        numbers(units, "u")
    with pytest.raises(InputError, match=hint.format("t", "s")):
        times(units, "t")
    flow = read_table(write(tmp_path / "a.csv", "t,u\ns,m3/h\n0,1\n"))
    with pytest.raises(InputError, match=hint.format("u", "m3/h")):
        numbers(flow, "u")
    for wrong in ("0x10", "1_000", "−1", "(3)"):
        mistyped = read_table(write(tmp_path / "a.csv", f"t,u\n0,{wrong}\n1,2\n"))
        with pytest.raises(InputError, match=f"found '{re.escape(wrong)}'$"):
            numbers(mistyped, "u")
    words = read_table(write(tmp_path / "a.csv", "u\nV\n0\nA\n"))
    with pytest.raises(InputError, match="found 'V'$"):
        numbers(words, "u")
    thousands = read_table(write(tmp_path / "a.csv", "u;y\n1,5;1.001,34\n2,5;999,48\n"))
    with pytest.raises(InputError, match="found '1.001,34': take the separators of thousands out, as in 1001.34"):
        numbers(thousands, "y")


def test_a_hint_for_excel_tells_the_delimiter(tmp_path: Path) -> None:
    """And is no header, row or comment: rows count it, and a comma may stand in more lines than the delimiter."""
    for text in ("sep=;\na,b;c\n1,5;2\n2,5;3\n", '"sep=;"\r\na,b;c\r\n1,5;2\r\n2,5;3\r\n'):
        table = read_table(write(tmp_path / "a.csv", text))
        assert list(table.columns) == ["a,b", "c"]
        np.testing.assert_array_equal(table.to_numpy(), [[1.5, 2], [2.5, 3]])
        assert list(table.index) == [3, 4]
    assert read_table(write(tmp_path / "a.csv", "sep=;\n1;2\n3;4\n")).to_numpy().tolist() == [[1, 2], [3, 4]]
    with pytest.raises(InputError, match="row 1: expected a tab, ';', ',' or a blank as delimiter, found 'sep=|'"):
        read_table(write(tmp_path / "a.csv", "sep=|\n1|2\n"))


def test_the_other_sheets_are_told_where_the_first_lacks_a_column(tmp_path: Path) -> None:
    with pd.ExcelWriter(tmp_path / "a.xlsx") as book:
        pd.DataFrame({"note": ["x"]}).to_excel(book, sheet_name="Cover", index=False)
        pd.DataFrame({"u": [1.0]}).to_excel(book, sheet_name="Run", index=False)
    told = "; this is its sheet 'Cover', give --sheet for another: Run"
    for column in ("u", 2):
        with pytest.raises(InputError) as error:
            read_table(tmp_path / "a.xlsx", [column])
        assert str(error.value).endswith(told)
    assert read_table(tmp_path / "a.xlsx", ["u"], "Run")["u"].tolist() == [1]
    with pytest.raises(InputError, match="it has u$"):
        read_table(tmp_path / "a.xlsx", ["y"], "Run")


def test_columns_by_name_and_number(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", "time,valve,7\n0,1,2\n1,3,4\n".replace("7", "level"))
    np.testing.assert_array_equal(read_table(path, [3, "valve", "1"]).to_numpy(), [[2, 1, 0], [4, 3, 1]])
    for column, message in {
        "levle": "no column 'levle': did you mean 'level'",
        "zzz": "it has time, valve, level",
        4: "no column 4: it has 3",
        0: "no column 0",
        "9" * 30: "no column",
    }.items():
        with pytest.raises(InputError, match=message):
            read_table(path, [column])


def test_digits_that_name_one_column_and_number_another_are_refused(tmp_path: Path) -> None:
    """As pandas names columns from 0: the command line took 1 for the name, Python for the number."""
    path = tmp_path / "a.parquet"
    Frame(np.arange(6.0).reshape(2, 3)).to_parquet(path)
    for column in (1, "1"):
        with pytest.raises(InputError) as error:
            read_table(path, [column])
        assert str(error.value) == (
            f"'a.parquet': expected a column, found that {column!r} may be column 1, named '0', or column 2, named "
            "'1': rename the columns in words"
        )
    assert read_table(path, ["0", 3]).to_numpy().tolist() == [[0, 2], [3, 5]]
    assert read_table(path, ["1", "2"], known=["1", "2"]).to_numpy().tolist() == [[1, 2], [4, 5]]
    Frame(np.arange(2.0)[:, None], columns=["7"]).to_parquet(path)
    assert read_table(path, ["7"])["7"].tolist() == read_table(path, [1])["7"].tolist() == [0, 1]


@pytest.mark.parametrize("suffix", ["mat", "npz", "h5"])
def test_arrays_are_columns_by_their_shape(suffix: str, tmp_path: Path) -> None:
    arrays = {
        "u": np.arange(6.0)[:, None], "row": np.arange(6)[None], "Y": np.arange(12, dtype=np.int16).reshape(6, 2),
        "Ts": np.array([[0.5]]), "short": np.arange(4.0), "wide": np.zeros((2, 6)), "cube": np.zeros((6, 2, 2)),
        "z": np.arange(6) * 1j,
    }  # fmt: skip
    path = tmp_path / f"a.{suffix}"
    if suffix == "mat":
        savemat(path, arrays | {"s": {"a": 1}, "c": np.array([1, "x"], dtype=object), "word": "text"})
    elif suffix == "npz":
        np.savez(path, **arrays, word=np.array("text"))
    else:
        with h5py.File(path, "w", track_order=True) as file:
            for name, values in arrays.items():
                file[name] = values
            file["word"] = "text"
            file["group/inner"] = np.arange(6.0)
    found = read_table(path)
    expected = ["u", "row", "Y1", "Y2"] + ["group/inner"] * (suffix == "h5")
    assert sorted(found.columns) == sorted(expected)
    np.testing.assert_array_equal(
        found[["u", "row", "Y1", "Y2"]].to_numpy()[:, 1:], [[k, 2 * k, 2 * k + 1] for k in range(6)]
    )
    left = {"Ts": "1 samples|single", "short": "4 samples", "wide": "2×6.*transpose", "cube": "3 dim", "z": "complex"}
    if suffix == "mat":
        left |= {"s": "class struct", "c": "class cell"}
    for name, reason in (left | {"word": "text|type|class"}).items():
        if name in ("short", "Ts"):
            reason = f"{reason}|differ in length"
        with pytest.raises(InputError, match=reason):
            read_table(path, ["u", name])
    np.testing.assert_array_equal(read_table(path, ["short"])["short"], range(4))


def test_empty_arrays_are_no_columns(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", u=np.zeros(5), none=np.zeros(0), empty=np.zeros((0, 3)), nothing=np.zeros((5, 0)))
    assert list(read_table(tmp_path / "a.npz").columns) == ["u"]
    for name in ("none", "empty", "nothing"):
        with pytest.raises(InputError, match=f"'{name}' cannot be a column: empty"):
            read_table(tmp_path / "a.npz", [name])


def test_the_length_is_the_longest_that_two_columns_share(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", u=np.zeros(5), y=np.zeros(5), a=np.zeros(3), b=np.zeros(3), scratch=np.zeros(9))
    assert list(read_table(tmp_path / "a.npz").columns) == ["u", "y"]
    with pytest.raises(InputError, match="columns differ in length: 'u' has 5 samples, 'scratch' has 9"):
        read_table(tmp_path / "a.npz", ["u", "scratch"])


def test_scalars_are_no_samples_beside_a_signal(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"y": np.arange(5.0), "Ts": 0.1, "gain": 2.0})
    assert read_table(tmp_path / "a.mat")["y"].tolist() == [0, 1, 2, 3, 4]
    assert read_table(tmp_path / "a.mat", ["Ts"])["Ts"].tolist() == [0.1]
    savemat(tmp_path / "a.mat", {"Ts": 0.1, "gain": 2.0})
    assert read_table(tmp_path / "a.mat").to_numpy().tolist() == [[0.1, 2]]


def test_matlab_s_own_hdf5_is_read_by_columns_and_without_its_insides(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file.create_dataset("y", data=np.arange(10.0).reshape(2, 5)).attrs["MATLAB_class"] = np.bytes_("double")
        file.create_dataset("name", data=np.arange(5, dtype=np.uint16)).attrs["MATLAB_class"] = np.bytes_("char")
        file.create_group("data").attrs["MATLAB_class"] = np.bytes_("struct")
        file["data/u"] = np.arange(5.0)
        file["#refs#/a"] = np.arange(5.0)
    found = read_table(path)
    assert list(found.columns) == ["y1", "y2"]
    np.testing.assert_array_equal(found["y2"], [5, 6, 7, 8, 9])
    with pytest.raises(InputError, match="'name' cannot be a column: MATLAB class char"):
        read_table(path, ["name"])
    with pytest.raises(InputError, match="'data' cannot be a column: MATLAB class struct"):
        read_table(path, ["data"])


def test_hdf5_does_not_lead_to_other_files(tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_bytes(np.arange(5.0).tobytes())
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = np.arange(5.0)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["y"] = np.arange(5.0)
        file["link"] = h5py.ExternalLink("other.h5", "x")
        file.create_dataset("raw", (5,), "f8", external=[(str(secret), 0, h5py.h5f.UNLIMITED)])
        layout = h5py.VirtualLayout((5,), "f8")
        layout[:] = h5py.VirtualSource("other.h5", "x", (5,))
        file.create_virtual_dataset("virtual", layout)
    assert list(read_table(tmp_path / "a.h5").columns) == ["y"]


class Trap:
    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, ("pwned",)


def test_nothing_is_unpickled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "a.npz", y=np.arange(3.0), trap=np.array([Trap()], dtype=object))
    assert list(read_table(tmp_path / "a.npz").columns) == ["y"]
    with pytest.raises(InputError, match="'trap' cannot be a column: Python objects, which are never loaded"):
        read_table(tmp_path / "a.npz", ["trap"])
    assert not (tmp_path / "pwned").exists()


def npz_with(shape: tuple[int, ...]) -> bytes:
    content, member = io.BytesIO(), io.BytesIO()
    np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": shape})
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("u.npy", member.getvalue() + bytes(80))
    return content.getvalue()


def test_sizes_are_refused_before_memory_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.npz").write_bytes(npz_with((10**14,)))
    with pytest.raises(InputError, match="holds 80 bytes: the file is damaged"):
        read_table(tmp_path / "a.npz")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("u", (10**13,), "f8", chunks=(1000,))
    with pytest.raises(InputError, match="more than 4 GiB"):
        read_table(tmp_path / "a.h5")
    monkeypatch.setattr(arrayfile, "LARGEST", 100)
    monkeypatch.setattr(textfile, "LARGEST", 100)
    monkeypatch.setattr(textfile, "LONGEST_LINE", 60)
    savemat(tmp_path / "a.mat", {"u": np.zeros(20)}, do_compression=True)
    with pytest.raises(InputError, match="more than"):
        read_table(tmp_path / "a.mat")
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"1,2\n" * 100))
    with pytest.raises(InputError, match="more than"):
        read_table(tmp_path / "a.csv.gz")
    with pytest.raises(InputError, match="row 1: more than 60 characters"):
        read_table(write(tmp_path / "a.csv", "1," * 100))


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("a.csv", b"", "'a.csv' is empty"),
        ("a.csv", b"\n  \n# nothing\n", "'a.csv' is empty"),
        ("a.csv", b"u,y\n", "column names but no samples"),
        ("a.csv", b"u,y\n1,2\n3\n4,5\n", "'a.csv' row 3: expected 2 cells as in the rows before, found 1"),
        ("a.csv", b"u,y\n1,2\n3,\n# x\n4\n", "'a.csv' row 5: expected 2 cells as in the rows before, found 1"),
        ("a.dat", b"u y\n1 2\n 3 \n4 5\n", "'a.dat' row 3: expected 2 cells as in the rows before, found 1"),
        ("a.csv", b"u,y\n1,2\n3,4,5\n", "'a.csv' row 3: expected 2 cells as in the rows before, found 3"),
        ("a.csv", b"u,y\n1,2,3\n3,4,5\n", "'a.csv' row 2: expected 2 cells as in the rows before, found 3"),
        ("a.csv", b"u,y\n1,2,3\n3,4\n", "'a.csv' row 2: expected 2 cells as in the rows before, found 3"),
        ("a.csv", b"u,y,u\n1,2,3\n", "columns 1 and 3 are both named 'u'"),
        ("a.csv", b"u,1,y\n1,2,3\n", "row 1: expected column names or samples, found both"),
        ("a.csv", b'u,y\n1,"2\n3,4\n', "'a.csv' row 2: unexpected end of data: mend the quotes"),
        ("a.csv", b"u,y\n1,\xb0\n", "not UTF-8 text .byte 0xb0."),
        ("a.csv", b"\x89HDF\r\n\x1a\n\x00\x00", "not UTF-8 text"),
        ("a.csv.gz", b"u,y\n1,2\n", "cannot be read as .csv: Not a gzipped file"),
        ("a.csv.gz", gzip.compress(b"u,y\n1,2\n" * 999, mtime=0)[:-20], "cannot be read as .csv"),
        ("a.xlsx", b"PK\x03\x04", "cannot be read as .xlsx"),
        ("a.parquet", b"PAR1", "cannot be read as .parquet"),
        ("a.mat", b"MATLAB 5.0", "cannot be read as .mat"),
        ("a.npz", b"PK", "cannot be read as .npz"),
        ("a.h5", b"\x89HDF\r\n\x1a\n", "cannot be read as .h5"),
        ("a.pkl", b"x", "no format is known by the suffix '.pkl': expected one of .csv, .tsv, .*or text packed as .gz"),
        ("a", b"x", "no format is known by the suffix ''"),
        ("a.mat.gz", b"x", "no format is known"),
    ],
)  # fmt: skip
def test_what_is_no_table_is_refused_in_one_line(file: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match=message) as found:
        read_table(tmp_path / file)
    assert "\n" not in str(found.value)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    write(tmp_path / "plant.csv", "1,2\n")
    (tmp_path / "folder.csv").mkdir()
    os.mkfifo(tmp_path / "pipe.csv")
    for file, message in {
        "plnt.csv": "no such file: .* did you mean 'plant.csv'",
        "folder.csv": "is a folder: expected a file",
        "pipe.csv": "is not a regular file",
    }.items():
        with pytest.raises(InputError, match=message):
            read_table(tmp_path / file)
    with pytest.raises(InputError, match="has no sheets"):
        read_table(tmp_path / "plant.csv", sheet=1)


def test_infinite_samples_are_named(tmp_path: Path) -> None:
    for text in ("inf", "1e999"):
        path = write(tmp_path / "a.csv", f"u,y\n1,2\n3,-{text}\n")
        with pytest.raises(InputError, match="'a.csv' row 3, column 'y': expected a finite number, found -inf"):
            numbers(read_table(path), "y")


@pytest.mark.parametrize(
    ("file", "package", "extra"),
    [
        ("excel.xlsx", "openpyxl", "excel"),
        ("table.parquet", "pyarrow.parquet", "parquet"),
        ("plain.h5", "h5py", "hdf5"),
    ],
)
def test_a_missing_package_is_named_with_its_extra(
    file: str, package: str, extra: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    WRITERS[file](tmp_path / file, Frame({"u": [1.0, 2.0]}))
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=rf"needs the package {package}: pip install 'nnss\[{extra}\]'"):
        read_table(tmp_path / file)


def test_the_module_loads_no_optional_package() -> None:
    code = "import sys, nnss_cli.datasets.formats; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert not {"torch", "openpyxl", "h5py", "scipy.io", "scipy.signal"} & set(loaded)


@pytest.mark.parametrize(
    "text", ["pump voltage\n1\n2\n", "pump  voltage [V]\n1,5\n2,5\n", "# made by us\npump voltage\n1\n"]
)
def test_a_blank_in_the_name_of_a_single_column_is_no_delimiter(text: str, tmp_path: Path) -> None:
    path = tmp_path / "one.csv"
    path.write_text(text)
    table = read_table(path)
    assert [*table.columns] == [" ".join(text.split("\n")[-3 if text.startswith("#") else 0].split())]
    assert table.dtypes.iloc[0] == np.float64


def test_a_number_beyond_the_range_of_doubles_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "one.csv"
    path.write_text("u,y\n1,2\n" + "9" * 400 + ",3\n")
    with pytest.raises(InputError, match="row 3, column 'u': expected a finite number, found inf"):
        numbers(read_table(path), "u")


@pytest.mark.parametrize("word", ["#N/A", "#DIV/0!", "#VALUE!", "#REF!", "#NUM!", "#NAME?", "#NULL!"])
@pytest.mark.parametrize("rows", [20, 20_000])
def test_excels_words_for_a_cell_in_error_are_no_comments(word: str, rows: int, tmp_path: Path) -> None:
    """In the first column of a row, which was left out with all that stands behind it."""
    lines = [f"{k},{k % 7}" for k in range(rows)]
    lines[13] = f"{word},3"
    path = write(tmp_path / "a.csv", "\n".join(["u,y", "# a comment, of ours", *lines, ""]))
    table = read_table(path)
    assert len(table) == rows
    with pytest.raises(InputError, match=rf"'a.csv' row 16.*{re.escape(word)}"):
        numbers(table, "u")


@given(size=st.integers(1, 30))
def test_comments_are_left_out_wherever_a_read_ends(size: int) -> None:
    text = "head\n1,2\n# a remark, 9\n3,4\n  # another\n5,6 # not at the start\n7,8"
    samples = textfile._Samples(Path("a.csv"), io.StringIO(text), skipped=1)
    parts = list(iter(lambda: samples.read(size), ""))
    assert "".join(parts) == "1,2\n3,4\n5,6 # not at the start\n7,8"
    assert all(part.endswith("\n") for part in parts[:-1])
    assert samples.lines == 6
