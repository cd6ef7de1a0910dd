"""A file of inputs simulated with a trained model, and compared with what was measured where that is there."""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray, Record, Scaling, unscored
from nnss_cli.errors import InputError, unknown
from nnss_cli.experiment.run import Score, score_outputs
from nnss_cli.trained.model import TrainedModel
from nnss_cli.trained.records import read_start

STARTS = ("outputs", "rest")
LARGEST = 1e150
"""Of outputs that can be compared: of larger ones the squares, summed over a record, are no numbers."""
MARGIN = 0.01
"""Of the range of a training signal, by which another one may leave it and still count as within."""
ROUNDING = 1e-9
"""Of the size of a training signal, likewise: it may have been constant."""


@dataclass(frozen=True, eq=False)
class Simulated:
    """What became of a file."""

    u: FloatArray
    """Inputs (K, r), physical units."""
    y: FloatArray
    """Simulated outputs (K, m), physical units."""
    x: FloatArray
    """States (K, n), the model's own."""
    measured: FloatArray | None
    """Measured outputs (K, m), NaN where a sample is missing; None where all are, but for those of the start."""
    scores: tuple[Score, ...]
    """Errors of each output over what was measured of it after the init window, from rest over all; none of one
    without."""
    from_rest: bool = False
    """Whether it starts at the equilibrium under the first input, not from measured outputs."""
    t: FloatArray | None = None
    """Instants (K,) [s] as the file has them; None where no time column of numbers or elapsed times was read."""

    def seconds(self, Ts: float) -> FloatArray:
        """The instants (K,) [s], from 0."""
        return np.arange(len(self.y)) * Ts


@dataclass(frozen=True)
class Beyond:
    """A signal that leaves the range that it had in training, where no data speak for the model."""

    channel: str
    """Its name."""
    unit: str
    """Its unit."""
    samples: int
    """How many of them lie beyond."""
    of: int
    """Of so many."""
    found: tuple[float, float]
    """The least and the greatest."""
    trained: tuple[float, float]
    """Those of the training records."""


def beyond_training(train: Sequence[Record], channels: Channels, u: FloatArray, y: FloatArray) -> tuple[Beyond, ...]:
    """The inputs and outputs that leave the range of the training records.

    Errors there may be any (docs/recipes.md). That signals stay within promises nothing either: states may leave what
    training knew, and so may frequencies.

    Args:
        train: the training records; nothing is told without any.
        channels: names and units.
        u: inputs (K, r), physical units.
        y: outputs (K, m), simulated or measured.
    """
    if not train:
        return ()
    c, told = channels, []
    names, units = (*c.inputs, *c.outputs), (*c.input_units, *c.output_units)
    signals = np.concatenate([u, y], axis=1).T
    known = np.concatenate([np.concatenate([record.u, record.y], axis=1) for record in train]).T
    for name, unit, signal, before in zip(names, units, signals, known, strict=True):
        low, high = float(before.min()), float(before.max())
        margin = max(MARGIN * (high - low), ROUNDING * max(abs(low), abs(high)))
        lost = int(np.sum((signal < low - margin) | (signal > high + margin)))
        if lost:
            span = float(signal.min()), float(signal.max())
            told.append(Beyond(name, unit, lost, len(signal), span, (low, high)))
    return tuple(told)


def simulate_file(
    model: TrainedModel,
    path: str | Path,
    start: str = "outputs",
    *,
    time: str | int | None = None,
    Ts: float | None = None,
    sheet: str | int | None = None,
) -> Simulated:
    """Simulate the inputs of a file.

    Args:
        model: what simulates.
        path: file with a column for each input, by the model's names, and for each output, of which the first init
            window is needed.
        start: from these outputs, or at "rest": the equilibrium under the first input, for a file without outputs.
        time: column of the time, to be checked.
        Ts: sampling time of the file [s], to be checked.
        sheet: of an Excel file.

    Raises:
        InputError: whatever does not fit the model, or a simulation that leaves the finite range.
    """
    if start not in STARTS:
        raise unknown("start", start, STARTS)
    found = read_start(model, path, outputs=start == "outputs", time=time, Ts=Ts, sheet=sheet)
    with np.errstate(over="ignore", invalid="ignore"):
        simulation = model.simulate(found.u, found.y_init)
    require_finite(f"'{Path(path).name}': the simulation", simulation.y)
    rest = start == "rest"
    if found.y is None:
        return Simulated(found.u, simulation.y, simulation.x, None, (), rest, found.t)
    begin = 0 if rest else unscored(model.init_window)
    whole = np.isfinite(found.y).all(axis=1)
    scaling = model.scaling or Scaling.of((Record(found.u[whole], found.y[whole], model.Ts),))
    scores: list[Score] = []
    for i, there in enumerate(np.isfinite(found.y[begin:]).T):
        if there.any():
            scores.append(score_outputs("file", [found.y[begin:][there]], [simulation.y[begin:][there]], scaling)[i])
    return Simulated(found.u, simulation.y, simulation.x, found.y, tuple(scores), rest, found.t)


def require_finite(what: str, y: FloatArray) -> None:
    """Outputs that can be compared with measured ones: their squares are numbers.

    Args:
        what: they are, at the head of the message.
        y: the outputs (K, m).

    Raises:
        InputError: they reach `LARGEST`; the message says where.
    """
    lost = ~(np.abs(y) < LARGEST).all(axis=1)
    if lost.any():
        raise InputError(
            f"{what} leaves the finite range at sample {int(lost.argmax())}: expected a model that is stable for these "
            "inputs; 'nnss certify' tells what is promised of it"
        )


def simulated_table(
    model: TrainedModel, found: Simulated, states: bool = False, limits: tuple[FloatArray, FloatArray] | None = None
) -> str:
    """A simulation as CSV; see `output_table`.

    Args:
        model: names the outputs.
        found: the simulation.
        states: whether to add them, as x1 …
        limits: of a band (K, m) each, to be added.
    """
    return output_table(model, found.y, limits, found.x if states else None, found.t)


def output_table(
    model: TrainedModel,
    y: FloatArray,
    limits: tuple[FloatArray, FloatArray] | None = None,
    x: FloatArray | None = None,
    t: FloatArray | None = None,
) -> str:
    """Outputs as CSV: time, each output by its name, its limits as <name>_low and <name>_high, states x1 …

    Where an output has such a name itself, an underscore more tells the column from it.

    Args:
        model: names the outputs.
        y: outputs (K, m), physical units.
        limits: of a band (K, m) each.
        x: states (K, n).
        t: instants (K,) [s]; from 0 at the model's sampling time where there are none.
    """
    import pandas as pd

    names = model.channels.outputs
    clock = next(name for name in ("time", "t", "seconds", "time [s]", "time from start [s]") if name not in names)
    seconds = np.arange(len(y)) * model.Ts if t is None else t
    # three digits more than values have: Unix time in steps of a millisecond has thirteen
    columns = {clock: [f"{instant:.15g}" for instant in seconds]} | dict(zip(names, y.T, strict=True))
    for suffix, limit in zip(("low", "high"), limits or (), strict=False):
        for name, values in zip(names, limit.T, strict=True):
            columns[_unused(f"{name}_{suffix}", columns)] = values
    for i, state in enumerate(() if x is None else x.T):
        columns[_unused(f"x{i + 1}", columns)] = state
    return str(pd.DataFrame(columns).to_csv(index=False, float_format="%.12g", lineterminator="\n"))


def _unused(name: str, taken: Container[str]) -> str:
    while name in taken:
        name += "_"
    return name
