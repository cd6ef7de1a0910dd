"""Any file as a table: text, Excel, Parquet, MAT, NPZ, HDF5. Files are data: nothing in them is executed."""

from __future__ import annotations

import importlib
import re
import zipfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from nnss_cli.datasets.arrayfile import as_table, hdf5_variables, is_hdf5, mat_variables, npz_variables
from nnss_cli.datasets.record import FloatArray
from nnss_cli.datasets.textfile import LARGEST, cell, check_names, header, printable, read_text, shown, shown_path
from nnss_cli.datasets.units import NO_UNIT, SECONDS, is_time_name, time_unit_in

from nnss_cli.errors import InputError, nearest

Columns = Sequence[str | int]

TEXT = (".csv", ".tsv", ".txt", ".dat")
"""Suffixes of delimited text, which may be packed (.csv.gz)."""
SUFFIXES = (*TEXT, ".xlsx", ".parquet", ".mat", ".npz", ".h5", ".hdf5")
"""All suffixes that are known."""
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:([.,' ])\d{3})(?:\1\d{3})*(?:[.,]\d+)?")
_FOREIGN_DATE = re.compile(r"(?:\d{1,2}([./-])\d{1,2}\1(?:\d{4}|\d\d)|\d{4}[./]\d{1,2}[./]\d{1,2})\b.*")
_MEANT_AS_NUMBER = re.compile(r"[\W_]*\d")  # "0x10" and "1_000", not "m3/h"
SAME = 0.01
"""Part of the usual step to within which a jump counts as an hour's, and its neighbours as no jumps."""
JITTERS = 4.0
"""As many median deviations of the steps from their median do so, too: 99 % of them where stamps scatter normally."""
SMALL, WELL_BELOW = 0.5, 300.0
"""Part of the usual step, and seconds of an hour, that these may be for steps to be regular."""
ABOUT = 600.0
"""Seconds to within which a time that runs back by night does so by an hour, however uneven its steps."""
LATEST = 1e10
"""Seconds, three hundred years: a larger time in no stated unit is Unix time in ms, µs or ns, or ticks."""


def read_table(
    path: Path, columns: Columns | None = None, sheet: str | int | None = None, known: Collection[str] = ()
) -> pd.DataFrame:
    """The file as a table, one row a sample; the index is the row as counted in the file.

    Columns of numbers are float64 (whole numbers beyond 2⁵³ and decimals are rounded to the nearest double, false
    and true are 0 and 1, missing cells NaN), dates are datetime64, elapsed times timedelta64, all else stays as it is,
    for `numbers` to refuse by row and column when it is used. `attrs["source"]` is the file's name,
    `attrs["left out"]` tells why parts of a file that are no columns are none.

    Args:
        path: A regular file; its suffix tells the format.
        columns: Which columns, by name or by number from 1; all if None.
        sheet: Sheet of an Excel file, by name or by number from 1; the first if None.
        known: Those of `columns` that were names before, as a model's channels, and cannot be numbers.

    Raises:
        InputError: no such file or column, an unknown suffix, or a file that cannot be read as what it says it is.
    """
    name = path.name.lower().removesuffix(".gz")
    suffix = Path(name).suffix
    if not path.exists():
        near = nearest(path.name, _neighbours(path))
        raise InputError(f"no such file: {shown_path(path)}" + (f"; did you mean '{near}'?" if near else ""))
    if not path.is_file():
        raise InputError(
            f"'{path}' is {'a folder' if path.is_dir() else 'not a regular file'}: expected a file of samples"
        )
    if suffix not in (TEXT if name != path.name.lower() else SUFFIXES):
        raise InputError(
            f"'{path.name}': no format is known by the suffix '{path.suffix}': expected one of "
            f"{', '.join(SUFFIXES)}, or text packed as .gz"
        )
    if path.stat().st_size == 0:
        raise InputError(f"'{path.name}' is empty: expected samples")
    if sheet is not None and suffix != ".xlsx":
        raise InputError(f"'{path.name}' has no sheets, found sheet {shown(sheet)}: leave it out")
    try:
        table = _read(path, suffix, columns, sheet)
    except InputError:
        raise
    except Exception as error:  # on a damaged file, a parser of a foreign format may raise anything
        told = printable(str(error)) or type(error).__name__
        raise InputError(
            f"'{path.name}' cannot be read as {suffix}: {told}; it may be cut off, damaged or of another format"
        ) from error
    table.attrs["source"] = path.name
    if table.empty:
        raise InputError(f"'{path.name}' holds no samples: expected a row for each")
    return table if columns is None else table[[find_column(table, column, known) for column in columns]]


def find_column(table: pd.DataFrame, column: str | int, known: Collection[str] = ()) -> str:
    """The name of a column given by name or by number from 1 (digits that name no column are a number).

    Args:
        table: has it.
        column: its name, or its number.
        known: names that cannot be numbers.

    Raises:
        InputError: there is none, and the message gives the nearest name, or why the file's array is no column; or
            the name of one is the number of another, as where columns are named 0, 1, 2.
    """
    names = [str(name) for name in table.columns]
    source = table.attrs.get("source", "table")
    number = _number_of_column(column)
    if number is not None and column not in known:
        _check_unambiguous(names, column, number, source)
    if isinstance(column, str) and column in names:
        return column
    left_out = table.attrs.get("left out", {})
    if column in left_out:
        raise InputError(f"'{source}': '{column}' cannot be a column: {left_out[column]}")
    if number is None:
        near = nearest(str(column), names, 0.5)
        hint = f"did you mean '{near}'?" if near else f"it has {', '.join(names[:20])}{', …' * (len(names) > 20)}"
        raise InputError(f"'{source}' has no column {shown(column)}: {hint}{other_sheets(table)}")
    if not 1 <= number <= len(names):
        raise InputError(f"'{source}' has no column {number}: it has {len(names)}, counted from 1{other_sheets(table)}")
    return names[number - 1]


def _check_unambiguous(names: Sequence[str], column: str | int, number: int, source: str) -> None:
    """Refuse digits that are the name of one column and the number of another: a user may mean either."""
    name = str(column)
    if name in names and 1 <= number <= len(names) and (named := names.index(name) + 1) != number:
        raise InputError(
            f"'{source}': expected a column, found that {shown(column)} may be column {number}, named "
            f"'{names[number - 1]}', or column {named}, named '{column}': rename the columns in words"
        )


def _number_of_column(column: str | int) -> int | None:
    if isinstance(column, int) or (column.isascii() and column.isdigit() and len(column) < 9):
        return int(column)
    return None


def numbers(table: pd.DataFrame, name: str) -> FloatArray:
    """A column as float64, NaN where a sample is missing.

    Raises:
        InputError: a cell holds no finite number; the message names row and column.
    """
    column = table[name]
    if column.dtype.kind == "O":
        values = np.array([_number(value) for value in column], dtype=object)
        words = np.array([not isinstance(value, float) for value in values])
        if words.any():
            k = int(words.argmax())
            raise InputError(
                f"{place(table, k)}, column '{name}': expected a number, found {shown(values[k])}{_hint(column, k)}"
            )
        array = values.astype(np.float64)
    elif column.dtype.kind in "mM":
        found = "date" if column.dtype.kind == "M" else "elapsed time"
        raise InputError(f"{place(table, 0)}, column '{name}': expected a number, found the {found} {column.iloc[0]}")
    else:
        array = column.to_numpy(np.float64)
    infinite = np.isinf(array)
    if infinite.any():
        k = int(infinite.argmax())
        raise InputError(f"{place(table, k)}, column '{name}': expected a finite number, found {array[k]}")
    return array


def times(table: pd.DataFrame, name: str) -> FloatArray:
    """A time column in seconds: numbers in the unit that its name states, elapsed times; dates since the first.

    Dates may be ISO 8601 text.

    Raises:
        InputError: a cell is neither, and the message names row and column; or the numbers are no seconds, and are
            told to be in no unit of time.
    """
    column = table[name]
    if holds_numbers(column):
        return _in_seconds(table, name)
    if column.dtype.kind == "m":
        return np.asarray(column.dt.total_seconds(), dtype=np.float64)
    if column.dtype.kind == "O":
        # Cell by cell, so that "2024-01-01" and 17 in one column are told apart.
        as_text = [value if isinstance(value, str) else getattr(value, "isoformat", lambda: None)() for value in column]
        stamps = pd.to_datetime(pd.Series(as_text, dtype=object), format="ISO8601", utc=True, errors="coerce")
        wrong = np.flatnonzero(stamps.isna().to_numpy() & ~column.isna().to_numpy())
        if len(wrong):
            k = int(wrong[0])
            raise InputError(
                f"{place(table, k)}, column '{name}': expected a time (seconds, or as 2024-01-31T12:00:00.5), "
                f"found {shown(column.iloc[k])}"
                + (_hint(column, k) or ": leave the column out and give the sampling time, or write it so")
            )
    else:
        stamps = column
    start = stamps[stamps.notna()].iloc[0] if stamps.notna().any() else None
    return np.asarray((stamps - start).dt.total_seconds(), dtype=np.float64)


def clock_change(table: pd.DataFrame, name: str, t: FloatArray) -> str:
    """Where a time column of local stamps jumps by an hour amid regular steps, as clocks do twice a year; else "".

    Resampled or sorted, such a record would be wrong by that hour, so it is told apart from a gap. Steps are regular
    within their usual jitter where that is small. A jump ahead may be a gap, and counts only at night, when clocks
    change; a time that runs back by about an hour there counts amid any steps.

    Args:
        table: has the column.
        name: of it.
        t: its `times`.
    """
    steps = np.diff(t)
    if tells_seconds(table[name]) or len(steps) < 3 or not (usual := float(np.nanmedian(steps))) > 0:
        return ""
    off = np.abs(steps - usual)
    jitter = JITTERS * float(np.nanmedian(off))
    near = max(SAME * usual, jitter if jitter <= min(SMALL * usual, WELL_BELOW) else 0.0)
    even = off <= near
    amid = np.concatenate([[True], even[:-1]]) & np.concatenate([even[1:], [True]])
    sharp = amid & (np.abs(off - 3600) <= near)
    for k in map(int, np.flatnonzero(sharp | ((steps < 0) & (np.abs(off - 3600) <= ABOUT)))):
        before, after = _stamps(table[name], k)
        if before.tzinfo or after.tzinfo:
            continue
        by_night = after.hour < 4 if steps[k] < 0 else _by_night(before, after)
        if by_night or (sharp[k] and steps[k] < usual):
            Ts = float(steps[even].mean()) if even.any() else usual
            return (
                f"{place(table, k + 1)}, column '{name}': the time goes from {before.isoformat()} to "
                f"{after.isoformat()} amid steps of {Ts:.6g} s, which looks like a clock set to summer or winter "
                "time: write UTC or offsets (as +01:00), or leave the column out and give the sampling time "
                f"(--ts {Ts:.9g})"
            )
    return ""


def _stamps(column: pd.Series, k: int) -> tuple[pd.Timestamp, pd.Timestamp]:
    """Dates k and k + 1 of a column, as they stand in the file."""
    return pd.Timestamp(column.iloc[k]), pd.Timestamp(column.iloc[k + 1])


def _by_night(earlier: pd.Timestamp, later: pd.Timestamp) -> bool:
    """Whether clocks may be set ahead between two stamps: from 0 to 3 o'clock, to 1 to 4."""
    return bool(earlier < (later - pd.Timedelta(hours=1)).normalize() + pd.Timedelta(hours=3))


def steady_times(table: pd.DataFrame, name: str) -> FloatArray:
    """A column's `times`, of one clock.

    Raises:
        InputError: as `times` and `check_clock`.
    """
    t = times(table, name)
    check_clock(table, name, t)
    return t


def check_clock(table: pd.DataFrame, name: str, t: FloatArray) -> None:
    """Refuse the `times` t of a column that are not of one clock.

    Raises:
        InputError: there is a `clock_change`; or dates do not grow, which are named as they stand.
    """
    if change := clock_change(table, name, t):
        raise InputError(change)
    back = np.flatnonzero(np.diff(t) <= 0)
    if len(back) and not tells_seconds(table[name]):
        before, after = _stamps(table[name], int(back[0]))
        raise InputError(
            f"{place(table, int(back[0]) + 1)}, column '{name}': time goes from {before.isoformat()} to "
            f"{after.isoformat()}: expected it to grow; sort or cut the rows"
        )


def time_note(table: pd.DataFrame, name: str) -> str:
    """What is to be told of a time column: that its numbers are in another unit than seconds; else ""."""
    unit = time_unit_in(name)
    if unit in ("s", NO_UNIT) or not holds_numbers(table[name]):
        return ""
    return f"the time column '{name}' is read in {unit}, as its name says"


def misread(column: pd.Series) -> str:
    """Why a column that was meant for dates or numbers holds words, by its first cell; "" where that is unknown."""
    first = str(column.dropna().iloc[0]).strip() if column.notna().any() else ""
    if _FOREIGN_DATE.fullmatch(first):
        return (
            f"looks like dates in a form that is not read ('{first}'): write them as 2024-01-31T12:00:00.5 (ISO 8601)"
        )
    return f"has separators of thousands ('{first}'): take them out" if _THOUSANDS.fullmatch(first) else ""


def other_sheets(table: pd.DataFrame) -> str:
    """What is to be told where a table lacks something that another sheet of its Excel file may have; else ""."""
    first, *others = table.attrs.get("sheets", [""])
    return f"; this is its sheet '{first}', give --sheet for another: {', '.join(others)}" if others else ""


def guess_time(names: Sequence[str], dates: Sequence[str]) -> str | None:
    """The column that is taken for the time where none is given: the first of dates or of a time's name.

    Args:
        names: of the columns that may be it.
        dates: those that hold dates, whatever their names.
    """
    return next((name for name in names if name in dates or is_time_name(name)), None)


def is_numeric(column: pd.Series) -> bool:
    """Whether a column holds numbers, or numbers with a few wrong cells, which are then named; not an empty one."""
    if column.dtype.kind in "fiub":
        return bool(column.notna().any())
    return column.dtype.kind == "O" and bool(pd.to_numeric(column, errors="coerce").notna().mean() > 0.5)


def holds_dates(table: pd.DataFrame, name: str) -> bool:
    """Whether a column holds dates or elapsed times, as a `time` column may."""
    column = table[name]
    if column.dtype.kind != "O" or is_numeric(column) or not column.notna().any():
        return column.dtype.kind in "mM"
    try:
        times(table, name)
    except InputError:
        return False
    return True


def holds_numbers(column: pd.Series) -> bool:
    """Whether each cell of a column is a number or empty."""
    if column.dtype.kind == "O":
        return all(isinstance(_number(value), float) for value in column)
    return column.dtype.kind not in "mM"


def tells_seconds(column: pd.Series) -> bool:
    """Whether a time column counts from a start of its own, by numbers or elapsed times; dates are of a calendar."""
    return column.dtype.kind == "m" or holds_numbers(column)


def place(table: pd.DataFrame, k: int) -> str:
    """Where sample k stands: the file, and the row as counted there."""
    return f"'{table.attrs.get('source', 'table')}' row {table.index[k]}"


def _hint(column: pd.Series, k: int) -> str:
    """What can be done about the word in cell k of a column of numbers, where that is a known case."""
    found = str(column.iloc[k]).strip()
    if _THOUSANDS.fullmatch(found):
        return ": take the separators of thousands out, as in 1001.34"
    if k == 0 and not _MEANT_AS_NUMBER.match(found) and len(column) > 1 and holds_numbers(column.iloc[1:]):
        return ": if this is a row of units, delete it and give --input-units and --output-units"
    return ""


def _in_seconds(table: pd.DataFrame, name: str) -> FloatArray:
    """A time column of numbers, from the unit that its name states."""
    values, unit = numbers(table, name), time_unit_in(name)
    if unit in SECONDS:
        return values * SECONDS[unit].numerator / SECONDS[unit].denominator
    at = f"'{table.attrs.get('source', 'table')}', column '{name}': "
    if unit != NO_UNIT:
        raise InputError(
            f"{at}expected a unit of time ({', '.join(SECONDS)}), found '{unit}': leave the column out and give the "
            "sampling time (--ts), or state its unit in its name, as in 't [ms]'"
        )
    late = np.abs(values) > LATEST
    if late.any():
        raise InputError(
            f"{at}expected seconds, found {values[int(late.argmax())]:.16g}, as of Unix time in ms, µs or ns: state "
            "the unit in the column's name, as in 't [ms]', or leave it out and give the sampling time (--ts)"
        )
    return values


def _number(value: object) -> object:
    """The float in a cell, or what it holds instead."""
    if isinstance(value, bool | np.bool_ | int | float | np.integer | np.floating):
        return float(value)
    return cell(value) if isinstance(value, str) else np.nan if pd.isna(value) else value


def _neighbours(path: Path) -> list[str]:
    try:
        return [neighbour.name for neighbour in path.parent.iterdir()]
    except OSError:
        return []


def _optional(package: str, extra: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(f"this format needs the package {package}: pip install 'nnss[{extra}]'") from error


def _read(path: Path, suffix: str, columns: Columns | None, sheet: str | int | None) -> pd.DataFrame:
    if suffix in TEXT:
        return read_text(path)
    if suffix == ".xlsx":
        return _read_excel(path, sheet)
    if suffix == ".parquet":
        return _read_parquet(path)
    if suffix == ".npz":
        return as_table(list(npz_variables(path)), path, columns)
    if suffix == ".mat" and not is_hdf5(path):
        return as_table(list(mat_variables(path)), path, columns)
    h5py = _optional("h5py", "hdf5")
    with h5py.File(path, "r") as file:
        return as_table(hdf5_variables(file, matlab=suffix == ".mat"), path, columns)


def _read_excel(path: Path, sheet: str | int | None) -> pd.DataFrame:
    openpyxl = _optional("openpyxl", "excel")
    with zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > LARGEST:
            raise InputError(f"'{path.name}' unpacks to more than {LARGEST >> 30} GiB: cut it into parts")
    book = openpyxl.load_workbook(path, read_only=True, data_only=True)
    sheets = list(book.sheetnames)
    try:
        rows = list(book[_sheet(path, book.sheetnames, sheet)].iter_rows(values_only=True))
    finally:
        book.close()
    filled = [i for i, row in enumerate(rows) if any(value is not None for value in row)]
    if not filled:
        raise InputError(f"'{path.name}' is empty: expected rows of samples")
    first, last = filled[0], filled[-1]
    width = max(j + 1 for row in rows for j, value in enumerate(row) if value is not None)
    cells = [[*row[:width], *[None] * (width - len(row))] for row in rows[first : last + 1]]
    names = header(cells[0], f"'{path.name}'", first + 1)
    if names is not None:
        cells, first = cells[1:], first + 1
    names = names or tuple(str(j + 1) for j in range(width))
    index = pd.RangeIndex(first + 1, first + 1 + len(cells))
    data = {name: _typed([row[j] for row in cells]) for j, name in enumerate(names)}
    table = pd.DataFrame(data, index=index)
    if sheet is None:
        table.attrs["sheets"] = sheets
    return table


def _sheet(path: Path, names: Sequence[str], sheet: str | int | None) -> str:
    if sheet is None:
        return names[0]
    if isinstance(sheet, int) and 1 <= sheet <= len(names):
        return names[sheet - 1]
    if sheet in names:
        return str(sheet)
    raise InputError(f"'{path.name}' has no sheet {shown(sheet)}: it has {', '.join(names)}")


def _typed(values: Sequence[object]) -> Any:
    """Cells as float64 where each is a number or empty, else as they are."""
    found = [_number(value) for value in values]
    if all(isinstance(value, float) for value in found):
        return np.array(found, dtype=np.float64)
    return np.array([*values, None], dtype=object)[:-1]  # the None keeps numpy from making another type of them


def _read_parquet(path: Path) -> pd.DataFrame:
    parquet, arrow = _optional("pyarrow.parquet", "parquet"), _optional("pyarrow", "parquet")
    with parquet.ParquetFile(path) as file:
        schema = file.schema_arrow
        check_names(schema.names, f"'{path.name}'")
        if file.metadata.num_rows * len(schema.names) * 8 > LARGEST:
            raise InputError(f"'{path.name}' holds more than {LARGEST >> 30} GiB: cut it into parts")
        kinds, data, left_out = arrow.types, {}, {}
        for field in schema:
            if kinds.is_nested(field.type) or kinds.is_binary(field.type):
                left_out[field.name] = f"type {field.type}, not numbers"
                continue
            column = file.read(columns=[field.name]).column(field.name)
            if kinds.is_dictionary(field.type):
                column = column.cast(field.type.value_type)
            if kinds.is_boolean(column.type):
                column = column.cast(arrow.uint8())
            if kinds.is_integer(column.type) or kinds.is_floating(column.type) or kinds.is_decimal(column.type):
                data[field.name] = column.cast(arrow.float64(), safe=False).to_numpy()
            elif kinds.is_timestamp(column.type):
                data[field.name] = column.cast(arrow.timestamp("ns")).to_numpy()
            elif kinds.is_duration(column.type):
                data[field.name] = column.cast(arrow.duration("ns")).to_numpy()
            else:
                data[field.name] = np.array([*column.to_pylist(), None], dtype=object)[:-1]
        table = pd.DataFrame(data, index=pd.RangeIndex(1, file.metadata.num_rows + 1))
    table.attrs["left out"] = left_out
    return table
