"""Options that say what is in a file of one's own, each declared once: the fields of a description."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from typing import Any

from nnss_cli.commands.parameters import flag_of, option, with_parameters

_PANEL = "A record of one's own (a description.toml has the same keys: docs/own-data.md)"


def _option(kind: Any, flag: str, metavar: str, help_text: str) -> Any:
    return option(kind | None, _PANEL, flag, metavar, help_text)


# Field of a description → the option that sets it.
RECORD_OPTIONS: dict[str, Any] = {
    "inputs": _option(list[str], "--inputs", "COLUMN …", "Columns of the inputs, by name or number from 1."),
    "outputs": _option(list[str], "--outputs", "COLUMN …", "Columns of the outputs."),
    "input_units": _option(list[str], "--input-units", "UNIT …", "Unit of each input."),
    "output_units": _option(list[str], "--output-units", "UNIT …", "Unit of each output."),
    "time": _option(str, "--time", "COLUMN", "Column of the time: seconds or dates; checked to be uniform."),
    "Ts": _option(float, "--ts", "SECONDS", "Sampling time, where there is no time column."),
    "resample": _option(float, "--resample", "SECONDS", "Bring a non-uniform time axis to this sampling time."),
    "downsample": _option(int, "--downsample", "N", "Keep every N-th sample, behind an anti-alias filter."),
    "missing": _option(str, "--missing", "refuse|interpolate", "Missing samples: refuse (default) or interpolate."),
    "split": _option(str, "--split", "60/20/20", "Train/validation/test of each file, percent, in time order."),
    "val": _option(list[str], "--val", "FILE …", "Files that validate, instead of a part of each."),
    "test": _option(list[str], "--test", "FILE …", "Files that test."),
    "detrend": _option(
        str,
        "--detrend",
        "none|constant|linear",
        "constant: models about the mean; linear: take off a drift (of train).",
    ),
    "init_window": _option(
        int, "--init-window", "W", "Find x(0) from the first W outputs; more than one are not scored."
    ),
    "sheet": _option(str, "--sheet", "NAME", "Sheet of an Excel file."),
    "name": _option(str, "--name", "NAME", "Name that results are kept under (default: the file's)."),
}


def with_record_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command every option of RECORD_OPTIONS; its parameter `own` gets those that the user set."""

    def wrapper(**given: Any) -> None:
        own = {name: given.pop(name) for name in RECORD_OPTIONS}
        command(**given, own={name: value for name, value in own.items() if value is not None and value != []})

    return with_parameters(command, wrapper, RECORD_OPTIONS, without="own")


def as_arguments(names: Sequence[str], own: dict[str, Any]) -> str:
    """The dataset argument and the options that give these fields, as a command line has them."""
    parts = list(names)
    for field, value in own.items():
        parts += [option_of(field), *map(str, value if isinstance(value, list) else (value,))]
    return shlex.join(parts)


def option_of(field: str) -> str:
    """The option that sets a field of a description."""
    return flag_of(RECORD_OPTIONS[field])
