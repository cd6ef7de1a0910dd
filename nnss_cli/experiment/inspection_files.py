"""Files as `nnss inspect` takes them: roles given, described or guessed, and the description that follows."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from nnss_cli.datasets.description import Description, check_fields, check_roles, record_name, write_description
from nnss_cli.datasets.experiments import check_alike, check_length, files_by_role, read_signals
from nnss_cli.datasets.formats import (
    clock_change,
    find_column,
    guess_time,
    holds_dates,
    is_numeric,
    misread,
    numbers,
    other_sheets,
    place,
    read_table,
    time_note,
    times,
)
from nnss_cli.datasets.preparation import PartName, Where, cut
from nnss_cli.datasets.record import FloatArray
from nnss_cli.datasets.units import unit_in
from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection import examine
from nnss_cli.experiment.inspection_result import Inspection
from nnss_cli.experiment.inspection_split import Part, Split
from nnss_cli.experiment.source import describe, described_with

_INPUT = re.compile(r"(u|in|input)([^a-z].*)?", re.IGNORECASE)
_OUTPUT = re.compile(r"(y|out|output)([^a-z].*)?", re.IGNORECASE)

PREPARATION = ("missing", "resample", "downsample", "detrend")  # fields of a description; their defaults ask for none


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


@dataclass(frozen=True)
class _Experiments:
    """Files as `examine` takes them."""

    data: list[FloatArray]
    """Inputs and outputs of each (K, r + m)."""
    Ts: float | None
    """Sampling time [s]; None to take it from `times`."""
    times: list[FloatArray] | None = None
    """Instants of each [s] (K,)."""
    where: list[Where] | None = None
    """Names a sample of each."""
    used: tuple[str, ...] = ()
    """What was done to them, in sentences."""
    remarks: tuple[str, ...] = ()
    """What is to be said of their clocks, in sentences."""


def examine_files(names: Sequence[str], own: Mapping[str, Any]) -> Seen:
    """Inspect files: a description's, or one experiment a file.

    They are taken as they are, gaps and all, unless a preparation is asked for: then as training takes them.

    Args:
        names: a description (.toml) alone, or files of samples.
        own: fields of a description that the command line sets; they go before those of the file.

    Raises:
        InputError: a file cannot be read, has no such column or cannot be prepared as asked; a field is wrong.
    """
    own = check_fields(own)
    plan: Description | None = None
    if any(name.lower().endswith(".toml") for name in names):
        if len(names) > 1:
            raise InputError(f"'{names[0]}': a description is inspected alone, found {len(names)} files")
        plan = described_with(Path(names[0]), own)
    fields = own if plan is None else vars(plan)
    first = Path(names[0]) if plan is None else plan.path(plan.files[0])
    table = read_table(first, None, fields.get("sheet"))
    roles = assign_roles(table, fields)
    units = dict(zip((*roles.inputs, *roles.outputs), _units(roles, fields), strict=True))
    if plan is None and any(key in own for key in (*PREPARATION, "split", "val", "test", "init_window", "orders")):
        plan = describe(names, {**own, "inputs": roles.inputs, "outputs": roles.outputs, "time": roles.time})
    files = list(names) if plan is None else [file for group in files_by_role(plan).values() for file in group]
    if plan is not None and (steps := _preparation(plan)):
        read = _as_trained(plan, files, steps)
    else:
        paths = [Path(file) if plan is None else plan.path(file) for file in files[1:]]
        read = _as_they_are([table, *(read_table(path, None, fields.get("sheet")) for path in paths)], roles, fields)
    r = len(roles.inputs)
    found = examine(
        [dict(zip(roles.inputs, data.T[:r], strict=True)) for data in read.data],
        [dict(zip(roles.outputs, data.T[r:], strict=True)) for data in read.data],
        read.Ts, read.times, units, read.where, **({} if plan is None else _planned(plan, own, read.data)),
    )  # fmt: skip
    if plan is not None:
        for role in ("train", "val", "test"):
            for part in getattr(found.split, role):
                check_length(role, files[part.experiment], part.stop - part.start, plan)
    if read.used:
        found = replace(found, clock=replace(found.clock, source="preparation"))
    found = replace(found, remarks=(*read.remarks, *found.remarks))
    means = ("models are about the means of the outputs (detrend constant)",) * (
        plan is not None and plan.detrend == "constant"
    )
    return Seen(fields.get("name") or record_name(first), replace(found, used=(*read.used, *found.used, *means)), roles)


def _as_they_are(tables: Sequence[pd.DataFrame], roles: Roles, fields: Mapping[str, Any]) -> _Experiments:
    columns = [[find_column(table, name) for name in (*roles.inputs, *roles.outputs)] for table in tables]
    clocks = [] if roles.time is None else [find_column(table, roles.time) for table in tables]
    instants = [times(table, name) for table, name in zip(tables, clocks, strict=False)]
    changes = map(clock_change, tables, clocks, instants)
    return _Experiments(
        [
            np.column_stack([numbers(table, name) for name in names])
            for table, names in zip(tables, columns, strict=True)
        ],
        fields.get("Ts"),
        instants or None,
        [partial(place, table) for table in tables],
        remarks=tuple(f"{change}." for change in changes if change),
    )


def _preparation(plan: Description) -> list[str]:
    """What is asked for of the samples, in words; detrend constant is of the models alone."""
    asked = [(key, getattr(plan, key)) for key in PREPARATION]
    return [f"{key} {value}" for key, value in asked if value not in (getattr(Description, key), "constant")]


def _as_trained(plan: Description, files: Sequence[str], steps: Sequence[str]) -> _Experiments:
    """The files' signals up to the split, with training's refusals; a drift is taken off after the split."""
    signals = [read_signals(plan, file) for file in files]
    for other in signals[1:]:
        check_alike(signals[0], other)
    used = (
        f"All of this is of the record as training takes it, after its preparation: {', '.join(steps)}.",
        *(note for each in signals for note in each.notes),
    )
    return _Experiments([each.values for each in signals], signals[0].Ts, used=used)


def _planned(plan: Description, own: Mapping[str, Any], data: Sequence[FloatArray]) -> dict[str, Any]:
    """What of the split, window, orders and drift is given, as `examine` takes it."""
    split = None
    if plan.split or plan.val or plan.test:
        parts: dict[PartName, list[Part]] = {"train": [], "val": [], "test": []}
        roles = [role for role, files in files_by_role(plan).items() for _ in files]
        for e, (role, values) in enumerate(zip(roles, data, strict=True)):
            whole: Mapping[PartName, slice] = {role: slice(0, len(values))}
            for name, at in (cut(len(values), plan.parts) if role == "train" else whole).items():
                parts[name] += [Part(e, at.start, at.stop)] if at.stop > at.start else []
        shares = "/".join(f"{100 * part:g}" for part in plan.parts)
        rules = (
            ("files of their own validate", plan.val), (f"{shares} in time order", not plan.val),
            ("files of their own test", plan.test),
        )  # fmt: skip
        rule = ", ".join(text for text, holds in rules if holds)
        split = Split(rule, tuple(parts["train"]), tuple(parts["val"]), tuple(parts["test"]), ())
    window = plan.init_window if plan.init_window > 1 or "init_window" in own else None
    return {"split": split, "init_window": window, "orders": plan.orders, "detrend": plan.detrend}


def assign_roles(table: pd.DataFrame, fields: Mapping[str, Any]) -> Roles:
    """Inputs, outputs and time: as given, else by their names, else the last column of numbers is the output.

    Raises:
        InputError: no such column, or no column of numbers is left for an output.
    """
    given = {
        role: tuple(find_column(table, column) for column in fields.get(role) or ()) for role in ("inputs", "outputs")
    }
    guesses, guessed = [], [role for role in ("inputs", "outputs") if not given[role]]
    if len(sheets := table.attrs.get("sheets", [])) > 1:
        guesses.append(f"Sheet '{sheets[0]}' is taken, of {', '.join(sheets)}: --sheet says otherwise.")
    columns = [str(name) for name in table.columns]
    dates = [name for name in columns if holds_dates(table, name)]
    taken = {*given["inputs"], *given["outputs"]}
    time = None if fields.get("time") is None else find_column(table, fields["time"])
    check_roles(given["inputs"], given["outputs"], time)
    clock = guess_time([name for name in columns if name not in taken], dates) if time is None else None
    if clock is not None and fields.get("Ts") is None:
        time = clock
        guesses.append(f"Column '{time}' is taken for the time: --time or --ts says otherwise.")
        guessed.append("time")
    if time is not None and (unit := time_note(table, time)):
        guesses.append(f"{unit[0].upper()}{unit[1:]}.")
    others = [name for name in columns if name not in taken and name != time]
    if clock in others and clock not in dates:  # no signal, though the sampling time is given
        others.remove(clock)
        guesses.append(f"Left out, since it reads as a time: {clock}: --inputs or --outputs says otherwise.")
    if stamps := [name for name in others if name in dates]:
        guesses.append(
            f"Left out, since they hold dates or elapsed times: {', '.join(stamps)}: --time takes one for the time."
        )
    words = [name for name in others if name not in dates and not is_numeric(table[name])]
    reasons = {name: why for name in words if (why := misread(table[name]))}
    guesses += [f"Left out: column '{name}' {why}." for name, why in reasons.items()]
    if rest := [name for name in words if name not in reasons]:
        guesses.append(f"Left out, since they hold no numbers: {', '.join(rest)}.")
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
            + "".join(f"; '{name}' {why}" for name, why in reasons.items())
            + other_sheets(table)
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
    files, val, test = (
        tuple(_relative(Path(name).resolve(), folder) for name in group)
        for group in (names, own.get("val") or (), own.get("test") or ())
    )
    found = seen.found
    proposed: dict[str, Any] = {"init_window": found.init_window, "orders": found.orders}
    if "split" not in found.given:
        train, validating, testing = (
            {part.experiment for part in parts} for parts in (found.split.train, found.split.val, found.split.test)
        )  # experiments that a role has a part of
        val = tuple(files[i] for i in sorted(validating - train))
        test = tuple(files[i] for i in sorted(testing - train - validating))
        percent = re.match(r"\d+/\d+/\d+", found.split.rule)
        proposed["split"] = None if val or test or not percent else percent.group()
        files = tuple(files[i] for i in sorted(train)) or files
    description = Description(
        **{
            **proposed, **own, "name": seen.name, "files": files, "val": val, "test": test, "time": seen.roles.time,
            "inputs": seen.roles.inputs, "outputs": seen.roles.outputs,
        },
        allow_outside=any(file.startswith(("..", "/")) for file in (*files, *val, *test)),
        folder=folder,
    )  # fmt: skip
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


def _relative(path: Path, folder: Path) -> str:
    return str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)
