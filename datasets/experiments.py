"""Described files as experiments: read, put on one time axis, cut, checked, ready to make a dataset of."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nnss_cli.datasets.description import Description
from nnss_cli.datasets.formats import numbers, place, read_table, steady_times, time_note
from nnss_cli.datasets.preparation import (
    PartName,
    Where,
    check_agreement,
    check_complete,
    check_increasing,
    cut,
    downsample,
    fit_drift,
    interpolate_missing,
    resample,
    uniform_Ts,
)
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling
from nnss_cli.datasets.units import has_unit, unit_in

from nnss_cli.errors import InputError

OWN = "own"
"""The protocol of a described record."""
LARGEST_VALUE = 1e100
"""A larger sample is no measurement, and its square would overflow."""


@dataclass(frozen=True)
class Experiments:
    """What a description's files hold, split: all that a dataset is made of, but for the scaling."""

    name: str
    """Name of the record."""
    train: tuple[Record, ...]
    """Training experiments, physical units, without the drift."""
    val: tuple[Record, ...]
    """Validation experiments, likewise."""
    tests: Mapping[str, tuple[Record, ...]]
    """Named test sets, likewise; empty where there is none."""
    channels: Channels
    """Names and units."""
    init_window: int
    """First output samples from which the initial state is found; more than one are not scored."""
    notes: tuple[str, ...] = ()
    """What a reader of the results must know: samples interpolated, a drift taken off, no test."""
    title: str = ""
    """One line for the heads of tables and figures."""
    about_means: bool = False
    """Whether models are to be in deviations from the means, wherever the plant rests under the mean input."""


@dataclass(frozen=True)
class Signals:
    """A file's signals on a uniform time axis."""

    file: str
    """As the description names it."""
    names: tuple[str, ...]
    """Inputs, then outputs."""
    values: FloatArray
    """(K, r + m), physical units."""
    Ts: float
    """Sampling time [s]."""
    notes: tuple[str, ...]
    """What was filled in or resampled."""


@dataclass(frozen=True)
class _Part:
    """A file's samples in one part."""

    signals: Signals
    samples: slice

    @property
    def values(self) -> FloatArray:
        return self.signals.values[self.samples]

    @property
    def t(self) -> FloatArray:
        return (self.samples.start + np.arange(len(self.values))) * self.signals.Ts


def load_experiments(description: Description) -> Experiments:
    """Read, prepare and split the described files.

    The order is: columns, time axis, missing samples, resampling, downsampling, split, drift (fitted on the training
    part only).

    Raises:
        InputError: whatever is wrong in a file or with its part, in one line that names it.
    """
    parts = _parts(description)
    r = len(description.inputs)
    first = parts["train"][0].signals
    for name, group in parts.items():
        for part in group:
            check_alike(first, part.signals)
            check_length(name, part.signals.file, len(part.values), description)
    _check_varying(parts["train"], r)
    drift = fit_drift([(part.t, part.values) for part in parts["train"]]) if description.detrend == "linear" else None

    def records(group: Sequence[_Part]) -> tuple[Record, ...]:
        found = []
        for part in group:
            values = part.values if drift is None else part.values - drift.at(part.t)
            found.append(Record(values[:, :r], values[:, r:], first.Ts))
        return tuple(found)

    tests = {name: group for name, group in parts.items() if name not in ("train", "val")}
    files = {part.signals.file: part.signals for group in parts.values() for part in group}
    notes = [note for signals in files.values() for note in signals.notes]
    units = (
        description.input_units or tuple(map(unit_in, first.names[:r])),
        description.output_units or tuple(map(unit_in, first.names[r:])),
    )
    if drift is not None:
        lines = [
            f"{name} {slope:.4g}{_after(unit)}/s"
            for name, slope, unit in zip(first.names, drift.slope, itertools.chain(*units), strict=True)
        ]
        notes.append(
            f"the training part's least-squares drift was taken off every record: {', '.join(lines)}; the models know "
            "signals without it"
        )
    if not tests:
        notes.append("there is no test part")
    channels = Channels(first.names[:r], first.names[r:], *units)
    return Experiments(
        name=description.name,
        train=records(parts["train"]),
        val=records(parts["val"]),
        tests={name: records(group) for name, group in tests.items()},
        channels=channels,
        init_window=description.init_window,
        notes=tuple(notes),
        title=description.title,
        about_means=description.detrend == "constant",
    )


def _parts(description: Description) -> dict[str, list[_Part]]:
    """The parts by name, "train" and "val" first, each with its files' samples."""
    read = {file: read_signals(description, file) for files in files_by_role(description).values() for file in files}
    parts: dict[str, list[_Part]] = {"train": [], "val": []}
    for file in description.files:
        K = len(read[file].values)
        for (name, samples), fraction in zip(cut(K, description.parts).items(), description.parts, strict=True):
            if fraction > 0:
                parts.setdefault(name, []).append(_Part(read[file], samples))
    for group, files in {"val": description.val, **description.test}.items():
        parts[group] = parts.get(group, []) + [_Part(read[file], slice(0, len(read[file].values))) for file in files]
    return parts


def files_by_role(description: Description) -> dict[PartName, tuple[str, ...]]:
    """The files that train, validate and test.

    Raises:
        InputError: a file stands under two of them, or twice in one set.
    """
    roles: dict[PartName, tuple[str, ...]] = {
        "train": description.files, "val": description.val, "test": sum(description.test.values(), ()),
    }  # fmt: skip
    role_of: dict[Path, str] = {}
    for role, files in roles.items():
        for file in files:
            other = role_of.setdefault(description.path(file), role)
            if other != role:
                raise InputError(
                    f"file '{file}' stands under two of train, val and test, found {other} and {role}: leave it in one"
                )
    for files in (description.files, description.val, *description.test.values()):
        named: dict[Path, str] = {}
        for file in files:
            first = named.setdefault(description.path(file), file)
            if first != file:
                raise InputError(f"file '{file}' stands twice, found it as '{first}', too: name it once")
    return roles


def read_signals(description: Description, file: str) -> Signals:
    """The signals of a described file, up to the split: columns, time axis, missing samples, resampled, downsampled.

    Raises:
        InputError: whatever is wrong in the file, in one line that names it.
    """
    path = description.path(file)
    columns = [*description.inputs, *description.outputs]
    wanted = columns if description.time is None else [*columns, description.time]
    sheet = description.sheet if path.suffix.lower() == ".xlsx" else None
    table = read_table(path, wanted, sheet)
    names = [str(name) for name in table.columns]
    for i, name in enumerate(names):
        if name in names[:i]:
            raise InputError(f"'{path.name}': column '{name}' is asked for twice, by name and by number: name it once")
    signals = tuple(names[: len(columns)])

    def where(k: int) -> str:
        return place(table, k)

    values = np.column_stack([numbers(table, name) for name in signals])
    too_large = np.abs(values) > LARGEST_VALUE
    if too_large.any():
        k, i = (int(at) for at in np.argwhere(too_large)[0])
        raise InputError(
            f"{where(k)}, column '{signals[i]}': {values[k, i]:g}: expected numbers below {LARGEST_VALUE:g}"
        )
    with _naming(path):
        stamps = None if description.time is None else steady_times(table, names[-1])
        t, Ts = _time_axis(description, stamps, len(values), where)
    told = "" if description.time is None else time_note(table, names[-1])
    notes = [f"'{path.name}': {told}"] if told else []
    count = int(np.isnan(values).sum())
    if description.missing == "refuse":
        check_complete(values, signals, where)
    elif count:
        values = interpolate_missing(t, values, signals, where)
        notes.append(f"'{path.name}': {count} missing samples were interpolated")
    if description.resample is not None:
        with _naming(path):
            values = resample(t, values, description.resample)
        notes.append(
            f"'{path.name}': resampled from {len(t)} samples (longest step {np.diff(t).max():.6g} s) to {Ts:.6g} s"
        )
    if description.downsample > 1:
        with _naming(path):
            values, Ts = downsample(values, description.downsample), Ts * description.downsample
    return Signals(file, signals, values, Ts, tuple(notes))


def _time_axis(description: Description, t: FloatArray | None, K: int, where: Where) -> tuple[FloatArray, float]:
    """The time of each sample, and the sampling time (of no use yet where the record is to be resampled)."""
    if t is None:
        assert description.Ts is not None
        return np.arange(K) * description.Ts, description.Ts
    if description.resample is not None:
        check_increasing(t, where)
        return t, description.resample
    Ts = uniform_Ts(t, where)
    if description.Ts is not None:
        check_agreement(description.Ts, Ts, f"column '{description.time}' against Ts")
        Ts = description.Ts
    return t, Ts


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Put the file's name before an error that does not know it."""
    try:
        yield
    except InputError as error:
        told = str(error)
        raise error if told.startswith(f"'{path.name}'") else InputError(f"'{path.name}': {told}") from error


def check_alike(first: Signals, other: Signals) -> None:
    """Refuse a file of other channels or of another sampling time than the first."""
    if other.names != first.names:
        raise InputError(
            f"'{other.file}' has the channels {', '.join(other.names)}, expected {', '.join(first.names)} as in "
            f"'{first.file}': name the columns alike, or describe the files apart"
        )
    with _naming(Path(other.file)):
        check_agreement(first.Ts, other.Ts, f"against '{first.file}'")


def check_length(name: str, file: str, K: int, description: Description) -> None:
    """Refuse a part of K samples that is too short for the description's window and orders."""
    least = max(description.init_window, *description.orders, 1) + 1
    if least > K:
        raise InputError(
            f"'{file}': {K} samples are too few for {name}: expected {least} or more, one "
            "beyond the init_window and the largest order: take a longer record or another split"
        )


def _check_varying(train: Sequence[_Part], r: int) -> None:
    least = np.min([part.values.min(axis=0) for part in train], axis=0)
    most = np.max([part.values.max(axis=0) for part in train], axis=0)
    for i, name in enumerate(train[0].signals.names):
        if least[i] == most[i]:
            raise InputError(
                f"{'input' if i < r else 'output'} '{name}' is constant over the training part ({least[i]:g}): nothing "
                "can be learnt from it; leave it out, or train where it moves"
            )


def _after(unit: str) -> str:
    """The unit behind a number."""
    return f" {unit}" if has_unit(unit) else ""


def dataset_of(experiments: Experiments, scaling_at_rest: Callable[[tuple[Record, ...]], Scaling]) -> Dataset:
    """The experiments as a dataset, scaled over the training part, under the protocol `own`.

    Models are in deviations from the mean inputs and the outputs at rest under them, so that linear ones need no
    offset. Where the training part moves around its means, that is the mean outputs.

    Args:
        experiments: whose `about_means` asks for the mean outputs instead.
        scaling_at_rest: that of training records about the outputs at rest under the mean inputs.
    """
    notes, channels, means = experiments.notes, experiments.channels, Scaling.of(experiments.train)
    scaling = means if experiments.about_means else scaling_at_rest(experiments.train)
    for name, unit, rest, mean in zip(
        channels.outputs, channels.output_units, scaling.y_mean, means.y_mean, strict=True
    ):
        if rest != mean:
            notes += (
                f"{name}: models are about {rest:.5g}{_after(unit)}, where it rests under the mean input; the "
                f'training part does not move around its mean, {mean:.5g}, which detrend = "constant" would take',
            )
    fitting = FittingData(
        experiments.name, OWN, experiments.train, experiments.val, scaling, channels, experiments.init_window,
    )  # fmt: skip
    return Dataset(fitting, dict(experiments.tests), notes, experiments.title)
