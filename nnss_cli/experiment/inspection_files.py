"""Files as `nnss inspect` takes them: roles given, described or guessed, and the description that follows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from nnss_cli.datasets.description import Description, read_description, write_description
from nnss_cli.datasets.formats import find_column, numbers, place, read_table, times
from nnss_cli.datasets.units import unit_in
from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection import examine
from nnss_cli.experiment.inspection_result import Inspection
from nnss_cli.experiment.source import record_name

_TIME = re.compile(r"(t|time|timestamp|date|datetime)([^a-z].*)?", re.IGNORECASE)
_INPUT = re.compile(r"(u|in|input)([^a-z].*)?", re.IGNORECASE)
_OUTPUT = re.compile(r"(y|out|output)([^a-z].*)?", re.IGNORECASE)


@dataclass(frozen=True)
class Roles:
    """Which column is what."""

    inputs: tuple[str, ...]
    """Names of the inputs."""
    outputs: tuple[str, ...]
    """Names of the outputs."""
    time: str | None
    """Name of the time column; None where there is none."""
    guesses: tuple[str, ...]
    """What was guessed and why, in sentences."""
    guessed: tuple[str, ...] = ()
    """Which of "inputs", "outputs" and "time" were guessed."""


@dataclass(frozen=True)
class Seen:
    """Inspected files."""

    name: str
    """Name for results."""
    found: Inspection
    """What is in them."""
    roles: Roles
    """Which column is what."""

    @property
    def guesses(self) -> tuple[str, ...]:
        """What was guessed, in sentences."""
        return self.roles.guesses


def examine_files(names: Sequence[str], own: Mapping[str, Any]) -> Seen:
    """Inspect files: a description's training files, or one experiment a file.

    Args:
        names: a description (.toml) alone, or files of samples.
        own: fields of a description that the command line sets; inputs, outputs, time, Ts, sheet and units count.

    Raises:
        InputError: a file cannot be read, or has no such column.
    """
    paths = [Path(name) for name in names]
    fields = dict(own)
    if any(path.suffix.lower() == ".toml" for path in paths):
        if len(paths) > 1:
            raise InputError(f"'{names[0]}': a description is inspected alone, found {len(names)} files")
        described = read_description(paths[0])
        fields = {key: getattr(described, key) for key in ("inputs", "outputs", "time", "Ts", "sheet", "name")} | fields
        fields.setdefault("input_units", described.input_units)
        fields.setdefault("output_units", described.output_units)
        paths = [described.path(file) for file in described.files]
    tables = [read_table(path, None, fields.get("sheet")) for path in paths]
    roles = assign_roles(tables[0], fields)
    units = dict(zip((*roles.inputs, *roles.outputs), _units(roles, fields), strict=True))
    found = examine(
        [{name: numbers(table, find_column(table, name)) for name in roles.inputs} for table in tables],
        [{name: numbers(table, find_column(table, name)) for name in roles.outputs} for table in tables],
        fields.get("Ts"),
        [times(table, find_column(table, roles.time)) for table in tables] if roles.time else None,
        units,
        [partial(place, table) for table in tables],
    )
    return Seen(fields.get("name") or record_name(paths[0]), found, roles)


def assign_roles(table: pd.DataFrame, fields: Mapping[str, Any]) -> Roles:
    """Inputs, outputs and time: as given, else by their names, else the last column of numbers is the output.

    Raises:
        InputError: no such column, or no column of numbers is left for an output.
    """
    given = {
        role: tuple(find_column(table, column) for column in fields.get(role) or ()) for role in ("inputs", "outputs")
    }
    guesses, guessed = [], [role for role in ("inputs", "outputs") if not given[role]]
    columns = [str(name) for name in table.columns]
    dates = [name for name in columns if _are_dates(table, name)]
    taken = {*given["inputs"], *given["outputs"]}
    time = None if fields.get("time") is None else find_column(table, fields["time"])
    if time is None and fields.get("Ts") is None:
        time = next((name for name in columns if name not in taken and (name in dates or _TIME.fullmatch(name))), None)
        if time is not None:
            guesses.append(f"Column '{time}' is taken for the time: --time or --ts says otherwise.")
            guessed.append("time")
    others = [name for name in columns if name not in taken and name != time]
    if stamps := [name for name in others if name in dates]:
        guesses.append(f"Left out, since they hold dates: {', '.join(stamps)}: --time takes one for the time.")
    if words := [name for name in others if name not in dates and not _is_numeric(table[name])]:
        guesses.append(f"Left out, since they hold no numbers: {', '.join(words)}.")
    free = [name for name in others if name not in {*stamps, *words}]
    inputs, outputs = given["inputs"], given["outputs"]
    if not inputs or not outputs:
        if not inputs and not outputs:
            inputs = tuple(name for name in free if _INPUT.fullmatch(name))
            outputs = tuple(name for name in free if _OUTPUT.fullmatch(name))
        rest = [name for name in free if name not in {*inputs, *outputs}]
        if not outputs:
            outputs = tuple(rest if inputs else rest[-1:])
        if not inputs:
            inputs = tuple(name for name in rest if name not in outputs)
        guesses.append(
            f"Taken for inputs: {', '.join(inputs) or 'none'}; for outputs: {', '.join(outputs) or 'none'}: "
            "--inputs and --outputs say otherwise."
        )
    if not outputs:
        raise InputError(
            f"'{table.attrs.get('source', 'table')}': expected a column of numbers as output, found "
            f"{', '.join(columns)}; name it with --outputs"
        )
    return Roles(inputs, outputs, time, tuple(guesses), tuple(guessed))


def suggested(seen: Seen, names: Sequence[str], own: Mapping[str, Any], target: Path) -> str:
    """The description that the inspection recommends, as TOML for the file `target`.

    Raises:
        InputError: there is neither a time column nor a sampling time, or there are no inputs.
    """
    if any(name.lower().endswith(".toml") for name in names):
        raise InputError(f"'{names[0]}' is a description already: --write makes one of files of samples")
    if seen.roles.time is None and own.get("Ts") is None:
        raise InputError("--ts: expected the sampling time in seconds for a description, found no time column either")
    if not seen.roles.inputs:
        raise InputError("--inputs: expected at least one input for a description, found none")
    folder = target.resolve().parent
    files = [_relative(Path(name).resolve(), folder) for name in names]
    split, found = seen.found.split, seen.found
    parts = {
        role: {part.experiment for part in getattr(split, role)} for role in ("train", "val", "test")
    }  # experiments that a role has a part of
    val = tuple(files[i] for i in sorted(parts["val"] - parts["train"]))
    test = tuple(files[i] for i in sorted(parts["test"] - parts["train"] - parts["val"]))
    percent = re.match(r"\d+/\d+/\d+", split.rule)
    description = Description(
        name=seen.name,
        files=tuple(files[i] for i in sorted(parts["train"])) or tuple(files),
        val=val,
        test={"test": test} if test else {},
        inputs=seen.roles.inputs,
        outputs=seen.roles.outputs,
        input_units=tuple(own.get("input_units") or ()),
        output_units=tuple(own.get("output_units") or ()),
        time=seen.roles.time,
        Ts=own.get("Ts") if seen.roles.time is None else None,
        split=None if val or test or not percent else percent.group(),
        init_window=max(1, found.init_window),
        orders=found.orders,
        sheet=own.get("sheet"),
        allow_outside=any(file.startswith(("..", "/")) for file in files),
        folder=folder,
    )
    return write_description(description, dict.fromkeys(seen.roles.guessed, "Guessed by 'nnss inspect': check it."))


def _units(roles: Roles, fields: Mapping[str, Any]) -> list[str]:
    """A unit for each input and output.

    Raises:
        InputError: units are given for another number of them.
    """
    found = []
    for columns, key in ((roles.inputs, "input_units"), (roles.outputs, "output_units")):
        units = list(fields.get(key) or map(unit_in, columns))
        if len(units) != len(columns):
            raise InputError(f"{key}: expected one for each of {', '.join(columns)}, found {len(units)}")
        found += units
    return found


def _is_numeric(column: pd.Series) -> bool:
    """Whether a column holds numbers, or numbers with a few wrong cells, which are then named; not an empty one."""
    if column.dtype.kind in "fiub":
        return bool(column.notna().any())
    return column.dtype.kind == "O" and bool(pd.to_numeric(column, errors="coerce").notna().mean() > 0.5)


def _are_dates(table: pd.DataFrame, name: str) -> bool:
    """Whether a column holds dates, as a `time` column may."""
    column = table[name]
    if column.dtype.kind != "O" or _is_numeric(column) or not column.notna().any():
        return column.dtype.kind == "M"
    try:
        times(table, name)
    except InputError:
        return False
    return True


def _relative(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)
