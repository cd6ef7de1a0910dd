"""What is in a record, before anything is trained on it: the analysis behind `nnss inspect`."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np

from nnss_cli.datasets.preparation import Where, fit_drift
from nnss_cli.datasets.record import FloatArray
from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection_dynamics import (
    LEAST,
    band,
    excerpt,
    feedback,
    multiple_coherence,
    products,
    responses,
    welch,
)
from nnss_cli.experiment.inspection_order import OrderGuess, guess_order
from nnss_cli.experiment.inspection_result import (
    Delay,
    Envelope,
    Excitation,
    Inspection,
    Linearity,
    Spectrum,
    remarks_on,
)
from nnss_cli.experiment.inspection_signals import (
    Channel,
    Persistency,
    examine_channel,
    examine_clock,
    find_copies,
    finite,
    persistency,
    runs,
    with_trend,
)
from nnss_cli.experiment.inspection_split import Part, Split, checked, recommend_split

Columns: TypeAlias = Mapping[str, FloatArray]

DYNAMICS_SAMPLES = 131_072  # samples, at most, from which spectra, coherence and delays are taken
BINS = 500  # points of a curve over time
WINDOW = 50  # largest recommended initialisation window


def examine(
    inputs: Columns | Sequence[Columns],
    outputs: Columns | Sequence[Columns],
    Ts: float | None = None,
    time: FloatArray | Sequence[FloatArray] | None = None,
    units: Mapping[str, str] | None = None,
    where: Sequence[Where] | None = None,
    split: Split | None = None,
    init_window: int | None = None,
    orders: Sequence[int] = (),
    detrend: str = "none",
) -> Inspection:
    """Examine a record, or several experiments given as sequences.

    Args:
        inputs: name → samples (K,); NaN or infinity is a missing sample. May be empty.
        outputs: likewise.
        Ts: sampling time [s]; None to take the time column's.
        time: instants [s] (K,) of each experiment, if there is a time column.
        units: name → unit.
        where: names a sample of each experiment in the remarks, as its file counts it.
        split: what trains, validates and tests; None to recommend it.
        init_window: samples to find x(0) from; None to recommend it.
        orders: to be compared; none to recommend them.
        detrend: "linear" takes the drift of the training part off, of complete records; "none" and "constant" nothing.
            With "constant" models are about the means of the outputs, else about the outputs at rest.

    Raises:
        InputError: columns that are no numbers, of different lengths, or that differ between experiments; Ts ≤ 0.
    """
    if Ts is not None and not (np.isfinite(Ts) and Ts > 0):
        raise InputError(f"Ts: expected a positive sampling time in seconds, found {Ts}")
    experiments, names, r, times = _read(inputs, outputs, time)
    clock = examine_clock(Ts, times)
    asked = {"split": split, "orders": orders, "init_window": init_window}

    def columns() -> tuple[Channel, ...]:
        return tuple(
            examine_channel(
                name, "input" if i < r else "output", (units or {}).get(name, "–"), [data[:, i] for data in experiments]
            )
            for i, name in enumerate(names)
        )

    channels = columns()
    split = split or recommend_split(experiments, channels)
    if detrend == "linear":
        experiments = _without_drift(experiments, split.train)
        channels = columns()
    split = checked(split, experiments, channels)
    timed = _over_time(experiments, split.train)
    channels = tuple(with_trend(c, [(t, data[:, i]) for t, data in timed]) for i, c in enumerate(channels))
    chosen = _chosen_on(split)
    alive = [i for i in range(len(names)) if _varies([values[:, i] for values in _within(experiments, chosen)])]
    live_inputs, live_outputs = [i for i in alive if i < r], [i for i in alive if i >= r]
    scaled = _scaled(experiments, alive, chosen)
    complete = _stretches(scaled)
    used = _missing_note(complete, experiments)
    whole = _stretches([data[:, alive] for data in experiments])
    copies = find_copies([names[i] for i in alive], np.concatenate(whole)) if whole else ()
    del whole
    q = len(live_inputs)
    seen = _noted(excerpt(complete, DYNAMICS_SAMPLES, q), complete, "spectra and coherence", used)
    parts = _standardised(seen)
    untested = _stretches(_within(scaled, chosen))  # the window that is recommended rests on the delays
    untested = _standardised(_noted(excerpt(untested, DYNAMICS_SAMPLES, q), untested, "delays", used))
    spectra, power = welch(parts, q), welch(parts, q, flatten=False)
    # the scaled columns are centred; persistency counts a constant, so it takes the raw ones
    raw = [_stretches([data[:, [i]] for data in experiments]) for i in range(r)]
    excitation = []
    for i in range(r):
        found = None if power is None or i not in live_inputs else live_inputs.index(i)
        follows = None if found is None else feedback(parts, q, found)
        told = _excitation(names[i], persistency(raw[i]), power, found, clock.Ts)
        excitation.append(dataclasses.replace(told, feedback=follows))
    joint = persistency([part[:, :q] for part in complete]) if q > 1 and complete else None
    order = _order(scaled, split, q, len(live_outputs), detrend == "constant", used, seen)
    delays, linearity = [], []
    for output, i in enumerate(live_outputs):
        pairs = responses(untested, q, output) if untested else []
        for response, j in zip(pairs, live_inputs, strict=False):
            seconds = None if response.delay is None or clock.Ts is None else response.delay * clock.Ts
            curve = tuple(map(float, response.correlation))
            delays.append(Delay(names[j], names[i], response.delay, seconds, response.smooth, response.bound, curve))
        lags = [1 if response.delay is None else response.delay for response in pairs]
        gain = products(parts, q, output, lags) if pairs or not q else None
        coherence, unexplained = multiple_coherence(spectra, q, output) if spectra else (np.empty(0), None)
        left = order.left[output] if order.left else None
        fitted = unexplained is not None and left is not None and left < unexplained
        linearity.append(
            Linearity(
                names[i], left if fitted else unexplained,
                () if unexplained is None else tuple(map(float, coherence[1:])),
                None if gain is None else gain.gain, None if gain is None else gain.p_value, fitted,
            )
        )  # fmt: skip
    shortest = min((part.stop - part.start for part in (*split.train, *split.val, *split.test)), default=1)
    longest_delay = max((delay.samples or 0 for delay in delays), default=0)
    n = order.suggested
    known = Inspection(
        tuple(len(data) for data in experiments), clock, channels, copies, tuple(excitation), joint,
        _spectrum(power, [names[i] for i in alive], clock.Ts), tuple(delays), tuple(linearity), order, split,
        tuple(orders) or (() if n is None else tuple(range(max(1, n - 1), n + 2))),
        init_window or max(1, min(WINDOW, 4 * (n or 1) + longest_delay, shortest // 10)), tuple(used), (),
        tuple(_envelope(name, [data[:, i] for data in experiments], clock.Ts) for i, name in enumerate(names)),
        tuple(name for name, value in asked.items() if value),
    )  # fmt: skip
    return dataclasses.replace(known, remarks=remarks_on(known, where))


def _read(
    inputs: Columns | Sequence[Columns], outputs: Columns | Sequence[Columns], time: Any
) -> tuple[list[FloatArray], list[str], int, list[FloatArray]]:
    """One array (K, c) an experiment with NaN where samples are missing, names, r, and time columns."""
    ins = [inputs] if isinstance(inputs, Mapping) else list(inputs)
    outs = [outputs] if isinstance(outputs, Mapping) else list(outputs)
    if time is None:
        times = []
    else:
        times = [time] if isinstance(inputs, Mapping) else list(time)
    if len(ins) != len(outs) or (times and len(times) != len(ins)):
        raise InputError(
            f"experiments: expected inputs, outputs and times of equally many, found {len(ins)}, {len(outs)}"
            + (f" and {len(times)}" if times else "")
        )
    first = (list(ins[0]), list(outs[0])) if ins else ([], [])
    names = [*first[0], *first[1]]
    experiments: list[FloatArray] = []
    clocks: list[FloatArray] = []
    for index, (u, y) in enumerate(zip(ins, outs, strict=True)):
        if (list(u), list(y)) != first:
            raise InputError(
                f"experiment {index + 1}: expected the channels {', '.join(names) or '(none)'} of the first, "
                f"found {', '.join([*u, *y]) or '(none)'}"
            )
        columns = [_column(name, values) for name, values in (*u.items(), *y.items())]
        if times:
            clocks.append(_column("time", times[index]))
        lengths = {len(column) for column in columns + clocks[index:]}
        if len(lengths) > 1:
            raise InputError(f"experiment {index + 1}: expected columns of one length, found {sorted(lengths)}")
        data = np.empty((lengths.pop() if lengths else 0, len(columns)), order="F")
        for i, column in enumerate(columns):
            data[:, i] = np.where(np.isfinite(column), column, np.nan)
        experiments.append(data)
    return experiments, names, len(first[0]), clocks


def _column(name: str, values: Any) -> FloatArray:
    try:
        column = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"column '{name}': expected numbers, found something else ({error})") from None
    if column.ndim == 2 and column.shape[1] == 1:
        column = column[:, 0]
    if column.ndim != 1:
        raise InputError(f"column '{name}': expected one column of samples, found an array of shape {column.shape}")
    return column


def _over_time(experiments: Sequence[FloatArray], parts: Sequence[Part]) -> list[tuple[FloatArray, FloatArray]]:
    """Samples since the start of the experiment, and the columns, of each part."""
    return [(np.arange(p.start, p.stop, dtype=np.float64), experiments[p.experiment][p.start : p.stop]) for p in parts]


def _without_drift(experiments: Sequence[FloatArray], train: Sequence[Part]) -> list[FloatArray]:
    """The records (K, c) without the drift of their training parts, a line in the samples of each experiment."""
    parts = _over_time(experiments, train)
    if sum(len(instants) for instants, _ in parts) < 2:
        return list(experiments)
    drift = fit_drift(parts)
    return [data - drift.at(np.arange(len(data), dtype=np.float64)) for data in experiments]


def _chosen_on(split: Split) -> list[Part]:
    """The training and validation parts, those that touch as one: all that a recommendation may rest on."""
    joined: list[Part] = []
    for part in sorted((*split.train, *split.val), key=lambda part: (part.experiment, part.start)):
        if joined and (joined[-1].experiment, joined[-1].stop) == (part.experiment, part.start):
            joined[-1] = dataclasses.replace(joined[-1], stop=part.stop)
        else:
            joined.append(part)
    return joined


def _within(experiments: Sequence[FloatArray], parts: Sequence[Part]) -> list[FloatArray]:
    return [experiments[part.experiment][part.start : part.stop] for part in parts]


def _varies(parts: Sequence[FloatArray]) -> bool:
    """Whether a column varies and is there at half of the samples at least."""
    x = np.concatenate(parts) if parts else np.empty(0)
    known = x[np.isfinite(x)]
    return 2 * len(known) >= len(x) > 0 and bool(known.max() > known.min())


def _scaled(experiments: Sequence[FloatArray], alive: Sequence[int], parts: Sequence[Part]) -> list[FloatArray]:
    """The columns that vary, centred and over their σ, both those of `parts`."""
    scaled: list[FloatArray] = [np.empty((len(data), len(alive)), order="F") for data in experiments]
    for target, i in enumerate(alive):
        joined = np.concatenate([values[:, i] for values in _within(experiments, parts)])
        # by the largest first: squares of huge numbers leave the range of numbers
        largest = float(np.nanmax(np.abs(joined)))
        joined = joined / largest
        mean = np.nanmean(joined)
        sigma = np.sqrt(np.nanmean((joined - mean) ** 2))
        with np.errstate(over="ignore"):  # of a test part beyond the range of numbers
            for block, data in zip(scaled, experiments, strict=True):
                values = data[:, i] / largest
                block[:, target] = (values - mean) / sigma if sigma > 0 else values - mean
    return scaled


def _stretches(experiments: Sequence[FloatArray]) -> list[FloatArray]:
    """The stretches of each experiment in which no sample of any column is missing."""
    return [stretch for data in experiments if data.shape[1] for stretch in _complete(data)]


def _complete(data: FloatArray) -> list[FloatArray]:
    return [data[a:b] for a, b in zip(*runs(np.asarray(np.isfinite(data).all(axis=1))), strict=True)]


def _standardised(parts: Sequence[FloatArray]) -> list[FloatArray]:
    if not parts:
        return []
    everything = np.concatenate(parts)
    with np.errstate(over="ignore"):  # a test part may be far beyond what the columns are scaled by
        sigma = everything.std(0)
    mean = everything.mean(0)
    return [(part - mean) / np.where(sigma > 1e-12, sigma, np.inf) for part in parts]


def _missing_note(complete: Sequence[FloatArray], experiments: Sequence[FloatArray]) -> list[str]:
    rows, kept = sum(map(len, experiments)), sum(len(part) for part in complete if len(part) >= LEAST)
    gaps = len(complete) > len(experiments) or sum(map(len, complete)) < rows
    if not gaps or not complete:
        return []
    return [f"dynamics: {kept} of {rows} samples, in stretches of at least {LEAST} without a missing sample"]


def _noted(parts: list[FloatArray], complete: Sequence[FloatArray], what: str, used: list[str]) -> list[FloatArray]:
    """`parts`, with a note where they are not all there was to use."""
    total = sum(len(part) for part in complete if len(part) >= LEAST)
    count = sum(map(len, parts))
    if count < total:
        used.append(f"{what}: {count} of {total} samples, where the inputs vary most")
    return parts


def _excitation(name: str, order: Persistency, spectra: Any, channel: int | None, Ts: float | None) -> Excitation:
    if channel is None:
        return Excitation(name, order, None, None)
    f, power = spectra.frequency[1:], spectra.density[1:, channel, channel].real
    if not power.sum() > 0:
        return Excitation(name, order, None, None)
    low, high = band(f, power)
    return Excitation(name, order, (low / (Ts or 1), high / (Ts or 1)), float(power[f > 0.4].sum() / power.sum()))


def _order(
    scaled: Sequence[FloatArray], split: Split, r: int, m: int, about_means: bool, used: list[str],
    whole: Sequence[FloatArray],
) -> OrderGuess:  # fmt: skip
    """The order guess on the split's training and validation parts, and what its models leave of `whole`.

    Test is not looked at for the guess.
    """
    if r == 0 or m == 0:
        return OrderGuess(None, (), 0, 0, None)
    train, val = (
        [stretch for part in parts for stretch in _complete(scaled[part.experiment][part.start : part.stop])]
        for parts in (split.train, split.val)
    )
    guess = guess_order(train, val, r, about_means, whole)
    rows = sum(part.stop - part.start for part in (*split.train, *split.val))
    if guess.suggested is not None and guess.train_samples + guess.val_samples < rows:
        used.append(
            f"order: {guess.train_samples} samples of the training and {guess.val_samples} of the validation part"
        )
    return guess


def _spectrum(spectra: Any, names: Sequence[str], Ts: float | None) -> Spectrum | None:
    if spectra is None:
        return None
    power = np.maximum(np.einsum("fii->if", spectra.density[1:]).real, 0.0)
    return Spectrum(
        tuple(map(float, spectra.frequency[1:] / (Ts or 1))), tuple(names),
        tuple(tuple(map(float, row * (Ts or 1))) for row in power), spectra.segment, spectra.averages,
    )  # fmt: skip


def _envelope(name: str, parts: Sequence[FloatArray], Ts: float | None) -> Envelope:
    x = np.concatenate(parts) if parts else np.empty(0)
    if len(x) == 0:
        return Envelope(name, (), (), ())
    starts = np.arange(0, len(x), math.ceil(len(x) / BINS))
    low, high = np.fmin.reduceat(x, starts), np.fmax.reduceat(x, starts)
    return Envelope(name, tuple(map(float, starts * (Ts or 1.0))), tuple(map(finite, low)), tuple(map(finite, high)))
