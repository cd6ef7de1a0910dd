"""A record of one's own, described: which files, columns, units, time axis, preparation and split.

The command line's options and the keys of a TOML file are the fields of one dataclass. docs/own-data.md shows them.
"""

from __future__ import annotations

import ast
import inspect
import json
import math
import os
import re
import textwrap
import tomllib
import unicodedata
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from typing import Any, cast

from nnss_cli.datasets.preparation import TREND_KINDS, parse_split
from nnss_cli.datasets.textfile import printable, shown

from nnss_cli.errors import InputError, nearest

Column = str | int

LARGEST_FILE = 1_000_000
"""Bytes of a description; a longer one is none."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
# letters that Unicode does not take apart into a base and a mark
_WHOLE = str.maketrans(
    {"ß": "ss", "Æ": "AE", "æ": "ae", "Ø": "O", "ø": "o", "Œ": "OE", "œ": "oe", "Ł": "L", "ł": "l", "Đ": "D", "đ": "d"}
)


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError("text")
    value.encode()  # a lone surrogate cannot be written to a file
    return str(value)  # NumPy's own kind is written otherwise


def _line(value: object) -> str:
    if _text(value) != " ".join(_text(value).split()):
        raise TypeError("text on one line, without blanks around it")
    return _text(value)


def _is_name(value: object) -> bool:
    return isinstance(value, str) and _NAME.fullmatch(value) is not None


def _name(value: object) -> str:
    if not _is_name(_text(value)):
        raise TypeError("letters, digits, '.', '_' and '-' (it names a folder of results)")
    return _text(value)


def _file(value: object) -> str:
    return _text(os.fspath(value) if isinstance(value, os.PathLike) else value)


def _integer(value: object) -> int | None:
    """NumPy's too; None for what is none, as true and false are."""
    return int(value) if isinstance(value, Integral) and not isinstance(value, bool) else None


def _whole(value: object) -> int:
    if (number := _integer(value)) is None or not 1 <= number < 2**31:
        raise TypeError("a whole number from 1 on")
    return number


def _seconds(value: object) -> float:
    try:
        seconds = float(value) if isinstance(value, Real) and not isinstance(value, bool) else math.nan
    except OverflowError:  # a whole number beyond all doubles
        seconds = math.inf
    if not 0 < seconds < math.inf:
        raise TypeError("a positive number of seconds")
    return seconds


def _column(value: object) -> Column:
    if isinstance(value, str) and value:
        return _text(value)
    if (number := _integer(value)) is not None and number >= 1:
        return number
    raise TypeError("a name, or a number from 1")


def _yes(value: object) -> bool:
    if not isinstance(value, bool):
        raise TypeError("true or false")
    return value


def _split(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError('train/validation/test in percent as text, "60/20/20"')
    parse_split(value)
    return _text(value)


def _one_of(*choices: str) -> Callable[[object], str]:
    def check(value: object) -> str:
        if value not in choices:
            raise TypeError(" or ".join(f'"{choice}"' for choice in choices))
        return _text(value)

    return check


def _all(check: Callable[[object], Any], least: int = 0) -> Callable[[object], tuple[Any, ...]]:
    """A list of `least` or more different values; a single one stands for a list of one."""

    def checked(value: object) -> tuple[Any, ...]:
        several = isinstance(value, Iterable) and not isinstance(value, str | bytes | Mapping)
        values = tuple(cast(Iterable[object], value)) if several else (value,)
        if len(values) < least:
            raise TypeError("a list of at least one value")
        return tuple(check(one) for one in values)

    return checked


def _different(check: Callable[[object], tuple[Any, ...]]) -> Callable[[object], tuple[Any, ...]]:
    def checked(value: object) -> tuple[Any, ...]:
        values = check(value)
        for i, one in enumerate(values):
            if one in values[:i]:
                raise TypeError(f"each value once ({one!r} stands twice)")
        return values

    return checked


_files = _different(_all(_file))


def _test_sets(value: object) -> dict[str, tuple[str, ...]]:
    """A table of named test sets, or a list of files that make the set "test"."""
    if not isinstance(value, Mapping):
        files = _files(value)
        return {"test": files} if files else {}
    sets = {}
    for name, files in value.items():
        try:
            sets[_name(name)] = _files(files)
        except TypeError as error:
            of, found = (f" '{name}'", files) if _is_name(name) else ("'s name", name)
            raise InputError(f"test: test set{of}: expected {error}, found {shown(found)}") from error
        if name in ("train", "val") or not sets[name]:
            raise InputError(
                "test: expected named test sets with at least one file each, none of them named train or val, found "
                f"{shown(name)}{'' if sets[name] else ' without files'}"
            )
    return sets


def _option(check: Callable[[object], Any], default: Any = MISSING, optional: bool = False) -> Any:
    """A field whose values pass `check`, which returns them or raises TypeError with what it expects."""
    metadata = {"check": check, "optional": optional}
    if callable(default):
        return field(default_factory=default, metadata=metadata)
    return field(default=default, metadata=metadata)


@dataclass(frozen=True, kw_only=True)
class Description:
    """What is in the files and what to make of it. Every field is checked; lists are kept as tuples."""

    name: str = _option(_name)
    """Name of the record, under which results are kept. Default: the description's file name."""
    title: str = _option(_line, "")
    """One line for the heads of tables and figures."""
    files: tuple[str, ...] = _option(_different(_all(_file, 1)))
    """Files with the training experiments, one experiment each; paths start at the description's folder."""
    val: tuple[str, ...] = _option(_files, ())
    """Files with the validation experiments. Without them, a part of each training file validates (split)."""
    test: Mapping[str, tuple[str, ...]] = _option(_test_sets, dict)
    """Files with the test experiments: a list, or a table of named test sets. Without them, a part of each
    training file tests (split), or nothing does if val is given."""
    inputs: tuple[Column, ...] = _option(_different(_all(_column, 1)))
    """Columns of the inputs, by name or by number from 1."""
    outputs: tuple[Column, ...] = _option(_different(_all(_column, 1)))
    """Columns of the outputs, by name or by number from 1."""
    input_units: tuple[str, ...] = _option(_all(_line), ())
    """Unit of each input. Default: what its column's name ends in, as "u [V]" or "level (cm)"."""
    output_units: tuple[str, ...] = _option(_all(_line), ())
    """Unit of each output, in which errors are reported. Default: likewise."""
    time: str | int | None = _option(_column, None, optional=True)
    """Column of the time: seconds, another unit that its name states, as "t [ms]" or "time_ms", or dates as
    2024-01-31T12:00:00.5. Checked to be uniform unless resample is given."""
    Ts: float | None = _option(_seconds, None, optional=True)
    """Sampling time in seconds; with a time column the two must agree to 0.1 %."""
    resample: float | None = _option(_seconds, None, optional=True)
    """New sampling time in seconds, by straight lines between the samples, behind an anti-alias filter where it is
    longer than the old one."""
    downsample: int = _option(_whole, 1)
    """Keep every N-th sample, behind a zero-phase anti-alias filter."""
    missing: str = _option(_one_of("refuse", "interpolate"), "refuse")
    """What to do about missing samples: "refuse" or "interpolate" (straight lines; never at the ends of a file)."""
    split: str | None = _option(_split, None, optional=True)
    """Parts of each training file in time order, train/validation/test in percent. Default: 60/20/20, or 75/25/0
    if test files are given; not with val files."""
    detrend: str = _option(_one_of(*TREND_KINDS), "none")
    """"none"; "constant" for models about the training part's mean, even where it does not move around that; or
    "linear", to take a drift off every signal (a line in the time since each file's start, fitted on the training
    part)."""
    init_window: int = _option(_whole, 1)
    """First output samples from which the initial state is found; more than one are not scored."""
    orders: tuple[int, ...] = _option(_different(_all(_whole)), ())
    """Model orders to compare."""
    horizon: str = _option(_one_of("auto", "matlab"), "auto")
    """Horizons of N4SID: searched on validation ("auto"), or MATLAB's ("matlab")."""
    sheet: str | int | None = _option(_column, None, optional=True)
    """Sheet of Excel files, by name or by number from 1. Default: the first."""
    citation: str = _option(_line, "")
    """What to cite when the record is used."""
    allow_outside: bool = _option(_yes, False)
    """Whether files may lie outside the description's folder."""
    folder: Path = Path()
    """Where paths start: the description's folder; no key of the file."""

    def __post_init__(self) -> None:
        for name, value in check_fields(vars(self)).items():
            object.__setattr__(self, name, value)
        self._check_together()

    def _check_together(self) -> None:
        for kind in ("input", "output"):
            columns, units = getattr(self, f"{kind}s"), getattr(self, f"{kind}_units")
            if units and len(units) != len(columns):
                raise InputError(f"{kind}_units: expected one for each of {len(columns)} {kind}s, found {len(units)}")
        check_roles(self.inputs, self.outputs, self.time)
        if self.time is None and self.Ts is None:
            raise InputError("Ts: expected the sampling time in seconds, or a time column (time), found neither")
        if self.time is not None and self.Ts is not None and self.resample is not None:
            raise InputError(
                f"Ts: expected none where a time column is resampled, found {self.Ts:g} beside resample "
                f"{self.resample:g}, which is the new sampling time: leave Ts out"
            )
        if self.val and self.split is not None:
            raise InputError(
                f"split: expected none beside val files, which validate instead, found '{self.split}': leave one out"
            )
        parts = self.parts
        if not self.val and parts[1] == 0:
            raise InputError(
                f"split '{self.split}': the validation part is empty: every choice needs one, or val files"
            )
        if self.test and parts[2] > 0:
            raise InputError(
                f"split '{self.split}': expected 0 for test beside test files, as 75/25/0, found {parts[2]:.3g}"
            )

    @property
    def parts(self) -> tuple[float, float, float]:
        """Fractions of each training file that train, validate and test."""
        if self.val:
            return 1.0, 0.0, 0.0
        return parse_split(self.split or ("75/25/0" if self.test else "60/20/20"))

    def path(self, file: str) -> Path:
        """A file's path.

        Raises:
            InputError: it leaves the description's folder (by a link, too) and `allow_outside` is not set.
        """
        try:
            path = (self.folder / file).resolve()
            inside = path.is_relative_to(self.folder.resolve())
        except (OSError, ValueError, RuntimeError) as error:  # a NUL, a loop of links
            raise InputError(f"file {shown(file)}: not a path: {printable(str(error))}") from error
        if not inside and not self.allow_outside:
            raise InputError(
                f"file {shown(file)} lies outside the description's folder: move it there, or set allow_outside = true"
            )
        return path


def check_fields(given: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a description, each checked by itself; others are passed on as they are.

    Raises:
        InputError: one is of another type or out of range.
    """
    found = dict(given)
    for option in fields(Description):
        value = given.get(option.name)
        if option.name in given and "check" in option.metadata and not (value is None and option.metadata["optional"]):
            try:
                found[option.name] = option.metadata["check"](value)
            except (TypeError, UnicodeEncodeError) as error:
                expected = "text in Unicode" if isinstance(error, UnicodeEncodeError) else str(error)
                raise InputError(f"{option.name}: expected {expected}, found {shown(value)}") from error
    return found


def check_roles(inputs: Sequence[Column], outputs: Sequence[Column], time: Column | None) -> None:
    """Refuse a column that stands for more than one thing.

    Raises:
        InputError: it does.
    """
    signals = (*inputs, *outputs)
    for column in signals:
        if signals.count(column) > 1 or column == time:
            raise InputError(f"column {column!r}: expected to be an input, an output or the time, found more than one")


def record_name(file: str | Path) -> str:
    """The file's name without suffixes and accents, "-" for what a name of results may not have."""
    stem = Path(Path(file).name.removesuffix(".gz")).stem
    plain = "".join(c for c in unicodedata.normalize("NFKD", stem.translate(_WHOLE)) if not unicodedata.combining(c))
    return re.sub(r"[^A-Za-z0-9._-]+", "-", plain).strip(".-_") or "record"


@cache
def field_texts() -> dict[str, str]:
    """The docstring of each field of `Description`, in order: help of the options, comments of the file."""
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(Description))).body
    assert isinstance(tree, ast.ClassDef)
    texts = {}
    for option, text in zip(tree.body, tree.body[1:], strict=False):
        if isinstance(option, ast.AnnAssign) and isinstance(option.target, ast.Name) and isinstance(text, ast.Expr):
            texts[option.target.id] = " ".join(str(ast.literal_eval(text.value)).split())
    return texts


def _keys() -> list[str]:
    return [option.name for option in fields(Description) if "check" in option.metadata]


def read_description(path: Path) -> Description:
    """The description in a TOML file; its name is the file's where it gives none.

    Raises:
        InputError: no such file, no TOML, unknown keys (all valid ones are listed), wrong values, or files
            outside its folder.
    """
    try:
        with path.open("rb") as stream:
            content = stream.read(LARGEST_FILE + 1) if path.is_file() else b""
        if len(content) > LARGEST_FILE:
            raise InputError(
                f"'{path.name}' is no description: longer than {LARGEST_FILE} bytes: expected a short TOML file"
            )
        table = tomllib.loads(content.decode("utf-8-sig"))  # Windows' editors put a mark first
    except OSError as error:
        raise InputError(f"cannot read the description '{path}': {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"'{path.name}' is no TOML: {printable(str(error))}") from error
    valid = _keys()
    for key in table:
        if key not in valid:
            near = nearest(key, valid)
            hint = f"did you mean '{near}'? " if near else ""
            raise InputError(f"'{path.name}': unknown key {shown(key)}: {hint}valid keys are {', '.join(valid)}")
    _check_below_test(table, valid, path)
    table.setdefault("name", path.stem if _NAME.fullmatch(path.stem) else record_name(path))
    for key in ("files", "inputs", "outputs"):
        if key not in table:
            raise InputError(f"'{path.name}': the key '{key}' is missing: {field_texts()[key]}")
    try:
        description = Description(**table, folder=path.parent)
        for files in (description.files, description.val, *description.test.values()):
            for file in files:
                description.path(file)
    except InputError as error:
        raise InputError(f"'{path.name}': {error}") from error
    return description


def _check_below_test(table: Mapping[str, Any], valid: Sequence[str], path: Path) -> None:
    """Refuse a key of the description below "[test]", where TOML takes it for a test set; files make it one."""
    sets = table.get("test")
    for key, value in sets.items() if isinstance(sets, Mapping) else ():
        files = isinstance(value, list) and all(isinstance(one, str) for one in value)
        if key in valid and not (files and (key in table or key not in ("files", "inputs", "outputs"))):
            raise InputError(
                f"'{path.name}': '{key}' stands inside the table [test], expected names of test sets with their files "
                f"there, found {shown(value)}: move '{key}' above the line [test]"
            )


def write_description(description: Description, remarks: Mapping[str, str] | None = None) -> str:
    """The description as TOML, each key under its comment; `read_description` gives an equal one again.

    Keys that stand at their default are written as comments, so that the file shows what there is.

    Args:
        description: what is written.
        remarks: key → a line more in its comment.
    """
    blocks, tables = [], []
    for option in fields(Description):
        if "check" not in option.metadata:
            continue
        comment = textwrap.fill(
            field_texts()[option.name], 110, initial_indent="# ", subsequent_indent="# ", break_long_words=False
        )
        if remarks and option.name in remarks:
            comment += f"\n# {remarks[option.name]}"
        value = getattr(description, option.name)
        default = option.default_factory() if option.default_factory is not MISSING else option.default
        if isinstance(value, Mapping) and value:
            tables.append(
                "\n".join([comment, "[test]", *(f"{_toml(name)} = {_toml(files)}" for name, files in value.items())])
            )
        elif value != default:
            blocks.append(f"{comment}\n{option.name} = {_toml(value)}")
        else:
            told = "" if value is None else _toml([] if isinstance(value, Mapping) else value)
            blocks.append(f"{comment}\n# {option.name} = {told}".rstrip())
    return "\n\n".join(["# A description of a record for nnss: see docs/own-data.md.", *blocks, *tables]) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple | list):
        return f"[{', '.join(_toml(one) for one in value)}]"
    if isinstance(value, str):
        # JSON's escapes are TOML's, but for DEL, which JSON leaves as it is.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return repr(value)
