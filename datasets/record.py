"""Records of input and output signals, their scaling, and their splits.

Everything here is checked once, at the boundary, and read-only afterwards, so that no method
can change what the next one sees. Time runs along the first axis.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from nnss_cli.errors import InputError

FloatArray: TypeAlias = NDArray[np.floating[Any]]

Presets: TypeAlias = Mapping[str, Mapping[int, Mapping[str, Any]]]
"""Recipe → order → settings; an order that is not among them takes those of the nearest."""

NO_NUMBERS = {"c": "complex ones: give real and imaginary parts as channels", "M": "dates", "m": "durations"}
"""What NumPy would make floats of all the same, by kind: imaginary parts lost, ticks of a clock for measurements."""

FITTED_ON = ("train", "val")
"""The splits that are no test; every other name is a test set's."""


def as_floats(name: str, values: Any) -> FloatArray:
    """A float64 copy of numbers; what a mask hides is NaN, for it is no measurement.

    Raises:
        InputError: they are complex, dates, durations, whole numbers beyond all floats, or no numbers at all.
    """
    try:
        if isinstance(values, np.ma.MaskedArray):
            values = np.ma.filled(values.astype(np.float64), np.nan)
        array = np.asarray(values)
        if array.dtype.kind not in NO_NUMBERS:
            return array.astype(np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name}: expected numbers: {error}") from error
    raise InputError(f"{name}: expected real numbers, found {NO_NUMBERS[array.dtype.kind]}")


def _signal(name: str, values: ArrayLike) -> FloatArray:
    array = as_floats(name, values)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] == 0:
        raise InputError(f"{name}: expected samples × channels, found an array of shape {array.shape}")
    if not np.isfinite(array).all():
        row, column = np.argwhere(~np.isfinite(array))[0]
        raise InputError(
            f"{name}: sample {row} of channel {column} is {array[row, column]}; "
            "expected finite numbers, so cut or repair the record there"
        )
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Channels:
    """Names and units of the signals, for tables and figures."""

    inputs: tuple[str, ...]
    """Name of each input."""
    outputs: tuple[str, ...]
    """Name of each output."""
    input_units: tuple[str, ...]
    """Unit of each input, "–" where the source states none."""
    output_units: tuple[str, ...]
    """Unit of each output, "–" where the source states none."""


@dataclass(frozen=True)
class Record:
    """One experiment: u(k) and y(k), k = 0 … K−1, sampled every Ts seconds."""

    u: FloatArray
    """Inputs (K, r), physical units."""
    y: FloatArray
    """Outputs (K, m), physical units."""
    Ts: float
    """Sampling time [s]."""

    def __init__(self, u: ArrayLike, y: ArrayLike, Ts: float) -> None:
        object.__setattr__(self, "u", _signal("u", u))
        object.__setattr__(self, "y", _signal("y", y))
        object.__setattr__(self, "Ts", float(Ts))
        if len(self.u) != len(self.y):
            raise InputError(f"u and y must have the same length: found {len(self.u)} and {len(self.y)} samples")
        if not (np.isfinite(self.Ts) and self.Ts > 0):
            raise InputError(f"Ts: expected a positive sampling time in seconds, found {Ts}")

    def __len__(self) -> int:
        return len(self.y)

    @property
    def input_count(self) -> int:
        """Number of inputs r."""
        return self.u.shape[1]

    @property
    def output_count(self) -> int:
        """Number of outputs m."""
        return self.y.shape[1]

    def __getitem__(self, samples: slice) -> Record:
        return Record(self.u[samples], self.y[samples], self.Ts)


@dataclass(frozen=True)
class Simulation:
    """A free simulation: what a model makes of an input and the first output sample."""

    y: FloatArray
    """Simulated outputs (K, m), physical units."""
    x: FloatArray
    """States x(k) (K, n), in the model's own coordinates."""


def first_outputs(y_init: ArrayLike, u: FloatArray, outputs: int) -> FloatArray:
    """The first output samples (w, m) that tell x(0), from (w, m), or (m,) for one.

    Args:
        y_init: what a simulation was given.
        u: its inputs (K, r).
        outputs: number of outputs m.

    Raises:
        InputError: there are none, more than inputs, or not of m outputs each.
    """
    y = np.atleast_2d(np.asarray(y_init, dtype=np.float64))
    if y.ndim != 2 or y.shape[1] != outputs or not 1 <= len(y) <= len(u):
        raise InputError(
            f"y_init: expected 1 to {len(u)} samples (the record's length) of {outputs} output{'s' * (outputs != 1)} "
            f"each, found an array of shape {np.shape(y_init)}; give the record's first outputs, samples × outputs"
        )
    return y


@dataclass(frozen=True)
class Scaling:
    """z-score: ũ = (u − u_mean)/u_std and likewise for y; deviations with ddof = 1."""

    u_mean: FloatArray
    """Mean of each input (r,)."""
    u_std: FloatArray
    """Standard deviation of each input (r,)."""
    y_mean: FloatArray
    """Mean of each output (m,)."""
    y_std: FloatArray
    """Standard deviation of each output (m,)."""

    @classmethod
    def of(cls, records: tuple[Record, ...]) -> Scaling:
        """Statistics over all samples of `records`. A constant channel is only centred: its deviation counts as 1."""
        u = np.concatenate([record.u for record in records])
        y = np.concatenate([record.y for record in records])
        return cls(*_mean_and_deviation(u), *_mean_and_deviation(y))

    def apply(self, record: Record) -> Record:
        """The record in normalised units."""
        return Record(self.normalise_u(record.u), self.normalise_y(record.y), record.Ts)

    def normalise_u(self, u: FloatArray) -> FloatArray:
        """(u − u_mean)/u_std."""
        return (u - self.u_mean) / self.u_std

    def normalise_y(self, y: FloatArray) -> FloatArray:
        """(y − y_mean)/y_std."""
        return (y - self.y_mean) / self.y_std

    def restore_y(self, y: FloatArray) -> FloatArray:
        """y_std·ỹ + y_mean."""
        return y * self.y_std + self.y_mean


# A channel is constant when its samples differ by no more than rounding: a value c that has been through a few
# operations (a change of unit, an offset) is off by a few halves of eps·|c|, either way, so 8 eps covers it;
# what a 24-bit converter or float32 resolves is 6e-8 of |c|, far above. The range tells, not the deviation:
# the computed σ of the constant 0.1 is 1e-17, which is the error of its mean and grows with the record.
ROUNDING = 8 * np.finfo(np.float64).eps


def about_mean(values: FloatArray) -> FloatArray:
    """Signals (K, c) about their means; zero for a constant, whose computed mean is off by rounding."""
    mean, constant = _mean_and_constant(values)
    return np.where(constant, 0.0, values - mean)


def _mean_and_constant(values: FloatArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    lowest, highest = values.min(axis=0), values.max(axis=0)
    grid = np.maximum(ROUNDING * np.maximum(np.abs(lowest), np.abs(highest)), np.finfo(np.float64).tiny)
    constant = highest - lowest <= grid
    # A constant's mean is the constant itself: what rounding leaves of a sum would be a signal to a regression.
    return np.where(constant, values[0], values.mean(axis=0)), constant


def _mean_and_deviation(values: FloatArray) -> tuple[FloatArray, FloatArray]:
    mean, constant = _mean_and_constant(values)
    freedom = 1 if len(values) > 1 else 0
    deviation = values.std(axis=0, ddof=freedom)
    lost = ~constant & (deviation == 0)  # squares of samples below 1e-162 underflow: their unit is the range
    if lost.any():
        lowest = values.min(axis=0)
        span = np.where(lost, values.max(axis=0) - lowest, 1.0)
        deviation = np.where(lost, span * ((values - lowest) / span).std(axis=0, ddof=freedom), deviation)
    return mean, np.where(constant | (deviation == 0), 1.0, deviation)


def _kind(record: Record) -> str:
    r, m = record.input_count, record.output_count
    return f"{r} input{'s' * (r != 1)}, {m} output{'s' * (m != 1)} and Ts = {record.Ts:.12g} s"


def unscored(init_window: int) -> int:
    """First samples of a record that are not scored: those that tell x(0) where they are several, else none."""
    return init_window if init_window > 1 else 0


@dataclass(frozen=True)
class FittingData:
    """All that a method may see: it holds no test record, so nothing can be chosen on one."""

    dataset: str
    """Name of the dataset."""
    protocol: str
    """Which split and statistics."""
    train: tuple[Record, ...]
    """Training experiments, physical units."""
    val: tuple[Record, ...]
    """Validation experiments, for early stopping and every choice."""
    scaling: Scaling
    """z-score statistics (the paper's power plant takes them over all 200 rows, others over train)."""
    channels: Channels
    """Names and units."""
    init_window: int = 1
    """Output samples at the beginning of a record from which x(0) may be found, w; where w > 1 they are not scored."""
    presets: Presets = field(default_factory=dict, compare=False)
    """What a benchmark with a history lays down for recipes; empty for a record of one's own."""

    def __post_init__(self) -> None:
        for split, records in (("train", self.train), ("validation", self.val)):
            if not records:
                raise InputError(f"dataset {self.dataset}: expected a {split} record, found none")
            self.check_like_first(split, records)
        if self.init_window < 1:
            raise InputError(f"dataset {self.dataset}: init window: expected at least 1, found {self.init_window}")
        r, m = self.input_count, self.output_count
        for owner, names, count in (
            (self.channels, ("inputs", "input_units"), r), (self.channels, ("outputs", "output_units"), m),
            (self.scaling, ("u_mean", "u_std"), r), (self.scaling, ("y_mean", "y_std"), m),
        ):  # fmt: skip
            for name in names:
                found = np.shape(getattr(owner, name))
                if found != (count,):
                    raise InputError(
                        f"dataset {self.dataset}: {type(owner).__name__}.{name}: expected shape ({count},), one value "
                        f"for each channel of the records, found {found}"
                    )

    def check_like_first(self, split: str, records: tuple[Record, ...]) -> None:
        """Check that `records` have the channels and the sampling time of the first training record.

        Raises:
            InputError: one differs; the message names it by its split and its number, counted from 1.
        """
        first = self.train[0]
        for number, record in enumerate(records, start=1):
            if self.init_window > 1 and len(record) <= self.init_window:
                raise InputError(
                    f"dataset {self.dataset}: {split} record {number}: expected more than the {self.init_window} "
                    f"samples of the init window, found {len(record)}; give a shorter --init-window or a longer record"
                )
            same_channels = (record.input_count, record.output_count) == (first.input_count, first.output_count)
            # A Ts taken from a time axis is off by rounding; 1e-9 of it is 1e-4 of a sample after 100 000 samples.
            if not (same_channels and math.isclose(record.Ts, first.Ts, rel_tol=1e-9)):
                raise InputError(
                    f"dataset {self.dataset}: {split} record {number}: expected {_kind(first)} as in the first "
                    f"training record, found {_kind(record)}; one model needs records of one kind"
                )

    def fingerprint(self) -> str:
        """A hash of every sample and statistic that a method may see, and of the channels' names and units."""
        return _hash(self, {"train": self.train, "val": self.val})

    def normalised(self) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
        """Train and validation records in normalised units."""
        scale = self.scaling.apply
        return tuple(scale(record) for record in self.train), tuple(scale(record) for record in self.val)

    @property
    def Ts(self) -> float:
        """Sampling time [s]."""
        return self.train[0].Ts

    @property
    def input_count(self) -> int:
        """Number of inputs r."""
        return self.train[0].input_count

    @property
    def output_count(self) -> int:
        """Number of outputs m."""
        return self.train[0].output_count


@dataclass(frozen=True)
class Dataset:
    """A benchmark under one protocol: what may be fitted on, and the test kept apart from it."""

    fitting: FittingData
    """Train, validation and scaling."""
    tests: Mapping[str, tuple[Record, ...]]
    """Test experiments by the name of the test set, "test" where there is one; empty where the file has none."""
    notes: tuple[str, ...] = field(default=())
    """What a reader of the results must know, such as why there is no test."""
    title: str = ""
    """One line for the heads of tables and figures; "" where the name is all there is."""

    def __post_init__(self) -> None:
        for name, records in self.tests.items():
            if name in FITTED_ON or not records:
                raise InputError(
                    f"dataset {self.name}: test set '{name}': expected at least one record, under a name that is not "
                    f"{' or '.join(FITTED_ON)}, found {len(records)}"
                )
            self.fitting.check_like_first(name, records)

    @property
    def name(self) -> str:
        """Name of the dataset."""
        return self.fitting.dataset

    @property
    def heading(self) -> str:
        """What it is called in heads."""
        return heading(self.title, self.name)

    @property
    def protocol(self) -> str:
        """Which split and statistics."""
        return self.fitting.protocol

    def splits(self) -> dict[str, tuple[Record, ...]]:
        """The records to score, by split."""
        return {"train": self.fitting.train, "val": self.fitting.val, **self.tests}

    def fingerprint(self) -> str:
        """A hash of every sample, statistic, name and unit: runs with equal fingerprints are comparable."""
        return _hash(self.fitting, self.splits())


def heading(title: str, name: str) -> str:
    """What a dataset is called in heads of tables and figures: its title, where it has one, with its name."""
    return f"{title} ({name})" if title else name


def _hash(fitting: FittingData, splits: Mapping[str, tuple[Record, ...]]) -> str:
    digest = hashlib.sha256(repr(fitting.channels).encode())
    if fitting.init_window > 1:
        digest.update(f"window {fitting.init_window}".encode())
    for split, records in splits.items():
        for record in records:
            digest.update(f"{split}{record.u.shape}{record.y.shape}{record.Ts}".encode())
            digest.update(record.u.tobytes())
            digest.update(record.y.tobytes())
    scaling = fitting.scaling
    for statistic in (scaling.u_mean, scaling.u_std, scaling.y_mean, scaling.y_std):
        digest.update(statistic.tobytes())
    return digest.hexdigest()[:16]
