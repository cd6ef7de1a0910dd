"""Files opened for a trained model: columns by its channels' names, its sampling time, its init window."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.datasets.formats import (
    check_clock,
    guess_time,
    holds_dates,
    numbers,
    other_sheets,
    place,
    read_table,
    steady_times,
    tells_seconds,
    times,
)
from nnss_cli.datasets.preparation import check_agreement, check_complete, uniform_Ts
from nnss_cli.datasets.record import FloatArray, Record, unscored
from nnss_cli.datasets.units import NO_UNIT, unit_in, without_unit
from nnss_cli.errors import InputError
from nnss_cli.trained.model import TrainedModel

FILL = "fill them in in the file, or cut these rows"
"""What can be done about missing samples: nothing is interpolated for a model."""


@dataclass(frozen=True, eq=False)
class Start:
    """What a simulation needs of a file: all inputs, and outputs as far as they are there."""

    u: FloatArray
    """Inputs (K, r), physical units."""
    y_init: FloatArray | None
    """First output samples (w, m), physical units; None where they were not asked for."""
    y: FloatArray | None
    """Outputs (K, m) to be compared with, NaN where a sample is missing; None where all beyond the window are."""
    t: FloatArray | None = None
    """Instants (K,) [s], where a time column of numbers or elapsed times was read."""


def read_record(
    model: TrainedModel,
    path: str | Path,
    *,
    time: str | int | None = None,
    Ts: float | None = None,
    sheet: str | int | None = None,
) -> Record:
    """A file's inputs and outputs, complete, as a record for a model.

    Args:
        model: tells the columns by its channels' names; other columns are ignored.
        path: of any format that a record may have (docs/own-data.md).
        time: column of the time; it must be uniform, with the model's sampling time to 0.1 %.
        Ts: sampling time of the file [s], to be checked likewise. Where neither is given, a column that reads as a time
            is checked, and passed over where it is no regular time; without one, the file has the model's.
        sheet: of an Excel file.

    Raises:
        InputError: it cannot be read; a column is missing; another sampling time; missing samples; too short for the
            model's init window. One line each.
    """
    return read_timed(model, path, time=time, Ts=Ts, sheet=sheet)[0]


def read_timed(
    model: TrainedModel,
    path: str | Path,
    *,
    time: str | int | None = None,
    Ts: float | None = None,
    sheet: str | int | None = None,
) -> tuple[Record, FloatArray | None]:
    """As `read_record`, and the instants (K,) [s] where a time column of numbers or elapsed times was read.

    Args:
        model: as for `read_record`.
        path: as for `read_record`.
        time: as for `read_record`.
        Ts: as for `read_record`.
        sheet: as for `read_record`.

    Raises:
        InputError: as `read_record`.
    """
    path = Path(path)
    names = (*model.channels.inputs, *model.channels.outputs)
    values, table, t = _columns(model, path, names, time, Ts, sheet)
    check_complete(values, names, lambda k: place(table, k), FILL)
    _check_length(path, len(values), unscored(model.init_window) + 1, model.init_window)
    r = len(model.channels.inputs)
    return Record(values[:, :r], values[:, r:], model.Ts), t


def read_start(
    model: TrainedModel,
    path: str | Path,
    *,
    outputs: bool = True,
    time: str | int | None = None,
    Ts: float | None = None,
    sheet: str | int | None = None,
) -> Start:
    """A file's inputs for a simulation, and the first outputs, from which it starts.

    Outputs beyond the model's init window may be missing; from rest all may be, the others are compared with.

    Args:
        model: tells the columns by its channels' names; other columns are ignored.
        path: of any format that a record may have.
        outputs: whether the simulation starts from the first outputs; their columns are needed then.
        time: as for `read_record`.
        Ts: as for `read_record`.
        sheet: of an Excel file.

    Raises:
        InputError: as `read_record`.
    """
    path = Path(path)
    inputs, w = model.channels.inputs, model.init_window
    if outputs:
        rest = ", or give --start rest, which needs no outputs"
        values, table, t = _columns(model, path, (*inputs, *model.channels.outputs), time, Ts, sheet, rest)
    else:
        values, table, t = _columns(model, path, inputs, time, Ts, sheet, optional=model.channels.outputs)
    u, y = values[:, : len(inputs)], values[:, len(inputs) :]
    check_complete(u, inputs, lambda k: place(table, k), FILL)
    if not outputs:
        return Start(u, None, y if np.isfinite(y).any() else None, t)
    _check_length(path, len(values), w, w)
    first = "fill them in in the file, cut these rows, or give --start rest, which needs no outputs"
    check_complete(y[:w], model.channels.outputs, lambda k: place(table, k), first)
    return Start(u, y[:w], y if np.isfinite(y[w:]).any() else None, t)


def _columns(
    model: TrainedModel,
    path: Path,
    names: Sequence[str],
    time: str | int | None,
    Ts: float | None,
    sheet: str | int | None,
    without_outputs: str = "",
    optional: Sequence[str] = (),
) -> tuple[FloatArray, Any, FloatArray | None]:
    """Values (K, c) of these columns, NaN where a sample is missing; the table; its instants (K,), if no dates.

    `without_outputs` ends the message where outputs alone are missing. `optional` columns follow where all of them are
    there, as numbers.
    """
    try:
        table = _table(path, names, optional, time, sheet, time is None and Ts is None)
    except InputError as error:
        if "has no column" not in str(error):
            raise
        whole = read_table(path, None, sheet)
        held = [str(column) for column in whole.columns]
        missing = [name for name in names if name not in held]
        if not missing:
            raise
        raise InputError(
            f"'{path.name}': expected the columns {', '.join(names)}, the model's channels, found "
            f"{', '.join(held[:20])}{', …' * (len(held) > 20)}: {_remedy(missing, held)}"
            + without_outputs * (not set(missing) & set(model.channels.inputs))
            + other_sheets(whole)
        ) from error
    stamped = str(table.columns[-1])
    if time is not None and stamped in names:
        raise InputError(f"'{path.name}': expected another column than a channel's for the time, found '{stamped}'")
    values = np.column_stack([numbers(table, name) for name in names])
    if set(optional) <= set(table.columns):
        with suppress(InputError):
            values = np.column_stack([values, *[numbers(table, name) for name in optional]])
    clock: str | None = None
    t: FloatArray | None = None
    at_its_own = f"a model runs at its own sampling time alone: bring the file to {model.Ts:.9g} s"
    if time is not None:
        clock, t = stamped, steady_times(table, stamped)
        rounded = "repair the file, or leave --time out where the times are only rounded"
        found = uniform_Ts(t, lambda k: place(table, k), rounded)
        check_agreement(model.Ts, found, f"'{path.name}', column '{time}', against the model", at_its_own)
    elif Ts is None and (rising := _rising_time(table, (*names, *optional))) is not None:
        clock, t = rising
        try:
            check_clock(table, clock, t)
            found = uniform_Ts(t, lambda k: f"{place(table, k)}, column '{clock}'", at_its_own)
            check_agreement(model.Ts, found, f"'{path.name}', column '{clock}', against the model", at_its_own)
        except InputError as error:
            over = f"or pass over the column (--ts {model.Ts:.9g}) where it is no time of these samples"
            raise InputError(f"{error}, {over}") from error
    if Ts is not None:
        check_agreement(model.Ts, Ts, f"'{path.name}' against the model", at_its_own)
    return values, table, t if clock is not None and tells_seconds(table[clock]) else None


def _remedy(missing: Sequence[str], held: Sequence[str]) -> str:
    """What to do about missing columns; one of the same name may be there in another unit, which a new name hides."""
    of_another_unit = {without_unit(other): other for other in held if unit_in(other) != NO_UNIT}
    converted = [
        (other, name)
        for name in missing
        if (other := of_another_unit.get(without_unit(name))) and unit_in(name) not in (NO_UNIT, unit_in(other))
    ]
    told = [f"convert '{other}' to '{name}', in its values, too" for other, name in converted]
    others = [name for name in missing if name not in dict(converted).values()]
    return ", and ".join([*told, *[f"rename what stands for {', '.join(others)}"] * bool(others)])


def _table(
    path: Path,
    channels: Sequence[str],
    optional: Sequence[str],
    time: str | int | None,
    sheet: str | int | None,
    whole: bool,
) -> Any:
    """Columns of channels and time; the whole table where that is asked for and has them, as one of several may not.

    `optional` channels are left out where the file has them not all.
    """
    wanted = [*channels] if time is None else [*channels, time]
    if whole:
        with suppress(InputError):
            table = read_table(path, None, sheet)
            if set(wanted) <= set(table.columns):
                return table
    if optional:
        with suppress(InputError):
            return read_table(
                path, [*channels, *optional, *wanted[len(channels) :]], sheet, known=(*channels, *optional)
            )
    return read_table(path, wanted, sheet, known=channels)


def _rising_time(table: Any, channels: Sequence[str]) -> tuple[str, FloatArray] | None:
    """The column that reads as a time and its instants; None where there is none that rises at most of its steps."""
    others = [str(name) for name in table.columns if name not in channels]
    name = guess_time(others, [other for other in others if holds_dates(table, other)])
    if name is not None:
        with suppress(InputError):  # nothing was said of this column: it may be anything
            t = times(table, name)
            return (name, t) if len(t) > 1 and np.mean(np.diff(t) > 0) > 0.5 else None
    return None


def _check_length(path: Path, found: int, needed: int, window: int) -> None:
    if found < needed:
        raise InputError(
            f"'{path.name}': {found} samples are too few: the model needs {needed} or more, since it finds its initial "
            f"state from the first {window}"
        )
