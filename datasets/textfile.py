"""Delimited text (CSV, TSV, blanks) as a table: layout found, columns checked, rows counted as in the file.

pandas reads the file in one go; only where that fails, or a row may be short, is the text gone through again
cell by cell, so that the error can name the place.
"""

from __future__ import annotations

import csv
import gzip
import re
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TextIO, cast

import numpy as np
import pandas as pd

from nnss_cli.errors import InputError

LARGEST = 4 * 2**30
"""Bytes that one file may take in memory; what announces more is refused before it is read."""
LONGEST_LINE = 2**22
"""Characters in a line of text; a longer one is no table."""
SAMPLE = 50
"""Rows from which the delimiter is told."""
MISSING = ("", "nan", "NaN", "NAN", "NA")
"""Cells that hold no sample: empty, not a number, and R's NA. Any other word is text."""

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)
_COMMA_NUMBER = re.compile(r"[+-]?(\d+,\d*|,\d+)([eE][+-]?\d+)?", re.ASCII)
_DATE = re.compile(r"\d{4}-\d\d-\d\d([T ]\d\d:\d\d\S*)?", re.ASCII)
_EXCELS_HINT = re.compile(r'"?sep=(.)"?')
_EXCELS_ERROR = re.compile(r"#(N/A|DIV/0!|VALUE!|REF!|NUM!|NAME\?|NULL!|SPILL!|CALC!|GETTING_DATA)")
_BETWEEN_BLANKS = re.compile(r'"((?:[^"]|"")*)"|(\S+)')
_BOOLEAN = {"true": 1.0, "false": 0.0}
# Before 3.1 pandas rounds to the nearest double only if asked; from 3.1 on it does, and warns when asked.
_PANDAS = tuple(int(part) for part in pd.__version__.split(".")[:2])
_EXACT: dict[str, Any] = {} if _PANDAS >= (3, 1) else {"float_precision": "round_trip"}


@dataclass(frozen=True)
class Layout:
    """How a text file is laid out."""

    delimiter: str
    """Tab, ";", "," or a blank, which stands for any run of blanks."""
    decimal: str
    """"." or, with ";" or tab, ","."""
    names: tuple[str, ...]
    """Column names: the header's, else "1", "2", …"""
    skipped: int
    """Lines before the first row of samples."""
    text: tuple[bool, ...]
    """Which columns start with a word or date, so are read as text."""
    ended: bool = False
    """Whether the first row ends in a delimiter that the header lacks: its empty cell makes a last column, nameless."""


def cell(text: str, decimal: str = ".") -> float | str:
    """A cell's number (NaN if missing, 0 or 1 for false or true), or its text when it is none."""
    text = text.strip()
    if text in MISSING:
        return np.nan
    number = text
    if decimal == ",":
        number = text.replace(",", ".") if "." not in text else ""
    if _NUMBER.fullmatch(number):
        return float(number)
    return _BOOLEAN.get(text.lower(), text)


def printable(text: str) -> str:
    """A foreign parser's message on one line, in printable characters, not too long."""
    text = " ".join(text.split())
    return "".join(mark if mark.isprintable() else "?" for mark in text)[:200]


def shown(value: object) -> str:
    """A value from a file for a message: quoted, on one line, not too long."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:76]}…'"


def shown_path(path: object) -> str:
    """A path for a message, likewise; of a long one the end, where the file's name stands."""
    text = repr(str(path))
    return text if len(text) <= 80 else f"'…{text[-76:]}"


def header(row: Sequence[object], source: str, number: int, decimal: str = ".") -> tuple[str, ...] | None:
    """The names in the first row of a table; None if it holds samples. A nameless column is named by its number.

    Args:
        row: its cells.
        source: the file, for messages.
        number: of the row.
        decimal: mark of the decimals, as in `cell`.

    Raises:
        InputError: names and numbers are mixed, or two columns have one name.
    """
    cells = [cell(value, decimal) if isinstance(value, str) else value for value in row]
    words = [value for value in cells if isinstance(value, str) and not _DATE.fullmatch(value)]
    if not words:
        return None
    figures = [value for value in cells if isinstance(value, int | float) and not pd.isna(value)]
    if figures:
        raise InputError(
            f"{source} row {number}: expected column names or samples, found both "
            f"({shown(words[0])} and {figures[0]:g}): name every column by a word, or take the word out"
        )
    names = tuple(" ".join(value.split()) if isinstance(value, str) else str(i) for i, value in enumerate(cells, 1))
    check_names(names, source)
    return names


def check_names(names: Sequence[Hashable], source: str) -> None:
    """Refuse a table in which two columns have one name, or one has a name that cannot be printed on a line.

    Raises:
        InputError: names the column and where it stands.
    """
    for i, name in enumerate(names):
        if not str(name).isprintable():
            raise InputError(f"{source}: column {i + 1} is named {shown(name)}: rename it in printable characters")
        if name in names[:i]:
            raise InputError(
                f"{source}: columns {names.index(name) + 1} and {i + 1} are both named '{name}': rename one of them"
            )


def read_text(path: Path) -> pd.DataFrame:
    """The file as a table: columns of numbers as float64, others as they are; the index is the file's row.

    A row is a line of the file, counted from 1 with the header and comments (lines that start with #). Missing
    cells are NaN.

    Raises:
        InputError: empty, not UTF-8 text, rows of unequal length, a broken quote, or a bad header.
    """
    layout = _layout(path)
    table = _read_fast(path, layout)
    if table is None or _has_short_row(path, layout, table):
        table = _read_carefully(path, layout)
    nameless = layout.names[-1] == str(len(layout.names))
    if nameless and len(layout.names) > 1:
        filled = table.iloc[:, -1].notna().to_numpy()
        if not filled.any():
            return table.iloc[:, :-1]  # every line ends in a delimiter
        if layout.ended:
            raise InputError(
                f"'{path.name}' row {table.index[filled.argmax()]}: expected {len(layout.names) - 1} cells as in the "
                f"header, found {len(layout.names)}: name the last column, or take it out"
            )
    return table


def _is_comment(line: str) -> bool:
    """Whether a line starts with #, as Excel's words for a cell in error do, too."""
    line = line.lstrip()
    return line.startswith("#") and not _EXCELS_ERROR.match(line)


def _open(path: Path) -> TextIO:
    opened: Any = gzip.open if path.suffix.lower() == ".gz" else open
    with opened(path, "rb") as stream:
        start = stream.read(2)
    encoding = "utf-16" if start in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig"
    return cast(TextIO, opened(path, "rt", encoding=encoding))


def _lines(path: Path, stream: TextIO, delimiter: str, skipped: int = 0) -> Iterator[tuple[int, str]]:
    """Lines that are neither blank nor comments, each with its number; between tabs a sample may be missing."""
    number, blanks = 0, None if delimiter != "\t" else " \r\n"
    try:
        while line := stream.readline(LONGEST_LINE):
            number += 1
            if len(line) == LONGEST_LINE:
                raise InputError(
                    f"'{path.name}' row {number}: more than {LONGEST_LINE} characters: expected a row of numbers; end "
                    "each row by a line break, or give the file its right suffix"
                )
            if number == 1 and _EXCELS_HINT.fullmatch(line.rstrip("\r\n")):
                continue
            if number > skipped and line.strip(blanks) and not _is_comment(line):
                yield number, line
    except UnicodeDecodeError as error:
        raise InputError(
            f"'{path.name}' from row {number + 1} on: not UTF-8 text (byte 0x{error.object[error.start]:02x}): "
            "save it as CSV UTF-8, or give the file its right suffix"
        ) from error


def _rows(path: Path, delimiter: str, skipped: int = 0) -> Iterator[tuple[int, list[str]]]:
    """The rows as cells, each with its line's number; comments and blank lines are left out."""
    with _open(path) as stream:
        lines = _lines(path, stream, delimiter, skipped)
        if delimiter == " ":
            for number, line in lines:
                yield number, _between_blanks(line)
            return
        number = skipped

        def text() -> Iterator[str]:
            nonlocal number
            for at, line in lines:
                number = at
                yield line.rstrip("\n")

        reader = csv.reader(text(), delimiter=delimiter, skipinitialspace=True, strict=True)
        while True:
            first = number + 1
            try:
                row = next(reader)
            except StopIteration:
                return
            except csv.Error as error:
                raise InputError(f"'{path.name}' row {first}: {error}: mend the quotes from there on") from error
            yield number, row


def _between_blanks(line: str) -> list[str]:
    return [quoted.replace('""', '"') or bare for quoted, bare in _BETWEEN_BLANKS.findall(line)]


def _layout(path: Path) -> Layout:
    source = f"'{path.name}'"
    with _open(path) as stream:
        sample = [line for _, line in zip(range(SAMPLE), _lines(path, stream, " "), strict=False)]
    if not sample:
        raise InputError(f"{source} is empty: expected rows of samples")
    lines = [line.strip() for _, line in sample]
    # The one that stands in most lines; ";" before "," since a decimal comma stands with it. One that the first line
    # lacks is none: under a single name, the commas are decimal. Nor is a blank in the name of a single column.
    marks = [mark for mark in "\t;, " if _count(lines[0], mark) > 1]
    if len(lines) > 1 and not any(_count(line, " ") > 1 for line in lines[1:]):
        marks = [mark for mark in marks if mark != " "]
    usual = max(marks, key=lambda mark: sum(_count(line, mark) > 1 for line in lines), default=";")
    delimiter = _told_delimiter(path) or usual
    rows = _rows(path, delimiter)
    number, first = next(rows)
    commas = delimiter in "\t;" and any(_COMMA_NUMBER.fullmatch(value.strip()) for value in first)
    names = header(first, source, number, "," if commas else ".")
    skipped = number if names is not None else number - 1
    if names is not None:
        number, first = next(rows, (0, []))
        if not first:
            raise InputError(f"{source} holds column names but no samples: expected rows of numbers below them")
    ended = names is not None and len(first) == len(names) + 1 and not first[-1].strip()
    if names is None or ended:
        names = (*(names or ()), *(str(i + 1) for i in range(len(names or ()), len(first))))
    layout = Layout(delimiter, ".", names, skipped, (), ended)
    if delimiter in "\t;":
        layout = replace(layout, decimal=_decimal(path, layout))
    text = tuple(isinstance(cell(value, layout.decimal), str) for value in first)
    return replace(layout, text=text)


def _told_delimiter(path: Path) -> str:
    """What a first line "sep=;" says, which Excel reads; "" where there is none."""
    with _open(path) as stream:
        found = _EXCELS_HINT.fullmatch(stream.readline(LONGEST_LINE).rstrip("\r\n"))
    if found and found[1] not in "\t;, ":
        raise InputError(
            f"'{path.name}' row 1: expected a tab, ';', ',' or a blank as delimiter, found 'sep={found[1]}': save it so"
        )
    return found[1] if found else ""


def _count(line: str, mark: str) -> int:
    """Cells in a line; 0 where its quotes are broken."""
    if mark == " ":
        return len(_between_blanks(line))
    try:
        return len(next(csv.reader([line.rstrip("\n")], delimiter=mark, skipinitialspace=True)))
    except csv.Error:
        return 0


def _decimal(path: Path, layout: Layout) -> str:
    """The mark in the first number that has one."""
    for _, row in _rows(path, layout.delimiter, layout.skipped):
        for value in row:
            if _COMMA_NUMBER.fullmatch(value.strip()):
                return ","
            if "." in value and _NUMBER.fullmatch(value.strip()):
                return "."
    return "."


class _Samples:
    """A stream of the lines with samples, as pandas reads it: without comments, counted, and not without end."""

    def __init__(self, path: Path, stream: TextIO, skipped: int) -> None:
        self.path, self.stream = path, stream
        self.lines = self.length = 0
        for _ in range(skipped):
            stream.readline()

    def read(self, size: int) -> str:
        while True:
            chunk = self.stream.read(size)
            if not chunk:
                return ""
            if not chunk.endswith("\n"):
                chunk += self.stream.readline(LONGEST_LINE)
            self.length += len(chunk)
            if self.length > LARGEST:
                raise InputError(f"'{self.path.name}' holds more than {LARGEST >> 30} GiB of text: cut it into parts")
            self.lines += chunk.count("\n") + (not chunk.endswith("\n"))
            if "#" in chunk:
                lines = chunk.splitlines(keepends=True)
                chunk = "".join(line for line in lines if not _is_comment(line))
            if chunk:
                return chunk

    def __iter__(self) -> Iterator[str]:
        return iter(self.stream)  # pandas asks for it before it takes an object as a file


def _read_fast(path: Path, layout: Layout) -> pd.DataFrame | None:
    """The table as pandas reads it, or None when a cell or a row is not as expected."""
    columns = range(len(layout.names))
    if len(layout.text) != len(columns):
        return None  # a first row that is too long would lose its end
    kinds = {i: "object" if text else "float64" for i, text in zip(columns, layout.text, strict=True)}
    with _open(path) as stream:
        samples = _Samples(path, stream, layout.skipped)
        try:
            table = pd.read_csv(
                samples, header=None, names=columns, index_col=False, keep_default_na=False, na_values=list(MISSING),
                sep=r"\s+" if layout.delimiter == " " else layout.delimiter, decimal=layout.decimal,
                dtype=kinds,
                skipinitialspace=True, **_EXACT,
            )  # fmt: skip
        except InputError:
            raise
        except ValueError:  # a parser's error and a wrong byte are values' errors too
            return None
    if samples.lines == len(table):
        table.index = pd.RangeIndex(layout.skipped + 1, layout.skipped + 1 + len(table))
    else:  # comments or blank lines in between
        numbers = [number for number, _ in _rows(path, layout.delimiter, layout.skipped)]
        if len(numbers) != len(table):
            return None
        table.index = pd.Index(numbers)
    table.columns = pd.Index(layout.names)
    return table


def _has_short_row(path: Path, layout: Layout, table: pd.DataFrame) -> bool:
    """Whether a row has too few cells: pandas fills it with NaN without a word, the last cell always among them."""
    suspects = set(table.index[table.iloc[:, -1].isna()])
    if not suspects:
        return False
    with _open(path) as stream:
        for number, line in _lines(path, stream, layout.delimiter, layout.skipped):
            if number in suspects and _count(line, layout.delimiter) != len(layout.names):
                return True
    return False


def _read_carefully(path: Path, layout: Layout) -> pd.DataFrame:
    """The table cell by cell: slow, but it knows where it is."""
    numbers: list[int] = []
    columns: list[list[float | str]] = [[] for _ in layout.names]
    for number, row in _rows(path, layout.delimiter, layout.skipped):
        if len(row) != len(columns):
            ended = len(row) == len(columns) + 1 and not row[-1].strip()
            raise InputError(
                f"'{path.name}' row {number}: expected {len(columns)} cells as in the rows before, found {len(row)}"
                + ": it ends in a delimiter, which is to be taken off, or to end every row" * ended
            )
        numbers.append(number)
        for column, value in zip(columns, row, strict=True):
            column.append(cell(value, layout.decimal))
    data = {
        name: np.array(column, dtype=object if any(isinstance(value, str) for value in column) else np.float64)
        for name, column in zip(layout.names, columns, strict=True)
    }
    return pd.DataFrame(data, index=pd.Index(numbers))
