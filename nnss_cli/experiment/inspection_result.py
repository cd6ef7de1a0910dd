"""What is known of a record, and the remarks on it: sentences that say what was found and guess at no cause."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

from nnss_cli.datasets.preparation import AGREEMENT, Where, sample
from nnss_cli.datasets.units import p_text
from nnss_cli.experiment.inspection_dynamics import LAGS, Feedback
from nnss_cli.experiment.inspection_order import LARGEST, OrderGuess
from nnss_cli.experiment.inspection_signals import FEW, Channel, Clock, Copy, Persistency
from nnss_cli.experiment.inspection_split import Split, percent

_Place: TypeAlias = Callable[[int | None, int | None], str]  # experiment and sample → where that is

UNEVEN = 0.01  # of a step
STOPPED = 0.01  # share of samples at an extreme value
HELD = 0.5  # share of samples held between the extremes: of a staircase, an extreme that is held tells nothing
DRIFTS = 0.25  # share of the variance on a straight line
COARSE = 0.02  # quantisation noise over σ
FAST = 0.1  # of the power near the Nyquist frequency
SLOW = 0.05  # of the Nyquist frequency: an output whose power lies below it
SURE, WORTH = 0.01, 0.01  # p-value below and share above which a nonlinearity is told of
MUCH = 0.05  # unexplained share that is worth a remark


@dataclass(frozen=True)
class Excitation:
    """What one input excites."""

    input: str
    """Name."""
    persistency: Persistency
    """Order of persistent excitation."""
    band: tuple[float, float] | None
    """Frequencies that hold 95 % of the power, mean apart [Hz, or 1/sample without Ts]; None for a short record."""
    near_nyquist: float | None
    """Share of the power above 0.8 of the Nyquist frequency."""
    feedback: Feedback | None = None
    """Whether past outputs foretell it; None where it changes too seldom, or nothing new could."""


@dataclass(frozen=True)
class Delay:
    """How an output follows an input, in the training and validation parts: `init_window` rests on it."""

    input: str
    """Name of the input."""
    output: str
    """Name of the output."""
    samples: int | None
    """Delay [samples]; None where nothing is above the bound, or `smooth`."""
    seconds: float | None
    """Delay [s]; None without Ts."""
    smooth: bool
    """Whether there is a response whose delay cannot be told, since the input's past foretells it."""
    bound: float
    """99 % bound of one lag's correlation where there is no response."""
    correlation: tuple[float, ...]
    """Partial correlation by lag, 0 … L, of prewhitened signals, given all other inputs and past outputs."""


@dataclass(frozen=True)
class Linearity:
    """How much of an output a linear model can explain."""

    output: str
    """Name."""
    unexplained: float | None
    """Share of the power that the inputs do not explain linearly, an estimate from above: by multiple coherence, for
    which memory longer than a segment is unexplained, or what a linear model leaves of these samples, where that is
    less. None for a short record."""
    coherence: tuple[float, ...]
    """Multiple coherence by frequency; empty for a short record or one without inputs."""
    gain: float | None
    """Share of a linear model's one-step residual that squares, cubes and products foretell; None if too short."""
    p_value: float | None
    """Of the F test that they foretell nothing; small only for a nonlinearity."""
    fitted: bool = False
    """Whether `unexplained` is what the best of the order guess's models leaves, which is less than by coherence."""

    @property
    def source(self) -> str:
        """What `unexplained` rests on, in a word or two."""
        return "a fitted model" if self.fitted else "coherence"


@dataclass(frozen=True)
class Spectrum:
    """Power by frequency, of all channels that have a spectrum."""

    frequency: tuple[float, ...]
    """Frequencies without zero [Hz, or 1/sample without Ts]."""
    channels: tuple[str, ...]
    """Names, inputs first."""
    density: tuple[tuple[float, ...], ...]
    """One-sided power density of each channel over its variance [1/Hz, or samples without Ts]."""
    segment: int
    """Samples of a Welch segment."""
    averages: float
    """Independent averages."""


@dataclass(frozen=True)
class Envelope:
    """A channel over time, thinned to at most 500 points of smallest and largest value."""

    channel: str
    """Name."""
    time: tuple[float, ...]
    """Start of each point [s, or samples without Ts], experiments one after the other."""
    low: tuple[float | None, ...]
    """Smallest value; None where all are missing."""
    high: tuple[float | None, ...]
    """Largest value."""


@dataclass(frozen=True)
class Inspection:
    """All that is known of a record; plain numbers, texts and tuples, None where there is no answer."""

    samples: tuple[int, ...]
    """Rows of each experiment."""
    clock: Clock
    """Sampling instants."""
    channels: tuple[Channel, ...]
    """Inputs, then outputs."""
    copies: tuple[Copy, ...]
    """Columns that are equal or affine copies."""
    excitation: tuple[Excitation, ...]
    """One an input."""
    joint: Persistency | None
    """Persistency of all inputs together; None for fewer than two that vary."""
    spectrum: Spectrum | None
    """None for a short record."""
    delays: tuple[Delay, ...]
    """Each pair of an input and an output that vary."""
    linearity: tuple[Linearity, ...]
    """One an output that varies."""
    order: OrderGuess
    """A first guess of the linear order."""
    split: Split
    """The split, given or recommended."""
    orders: tuple[int, ...]
    """Orders given, or worth trying; empty where there is no guess."""
    init_window: int
    """Samples to find x(0) from, given or by a rule: 4 n and the longest delay, at most 50 and a tenth of any part."""
    used: tuple[str, ...]
    """Which part of the data each analysis took, where not all of it."""
    remarks: tuple[str, ...]
    """What a user should know, in sentences."""
    envelopes: tuple[Envelope, ...]
    """The channels over time, for the figure."""
    given: tuple[str, ...] = ()
    """Which of split, orders and init_window were given, not recommended."""

    def as_dict(self) -> dict[str, Any]:
        """Everything as JSON can hold it."""
        return dataclasses.asdict(self)


def remarks_on(found: Inspection, where: Sequence[Where] | None = None) -> tuple[str, ...]:
    """The remarks: the record as a whole, its columns, its inputs, what ties them, the split.

    Args:
        found: what is known.
        where: names a sample of each experiment; None to count samples from 1.
    """

    def at(experiment: int | None, k: int | None) -> str:
        experiment, k = experiment or 0, k or 0
        if where is not None:
            return where[experiment](k)
        return sample(k) + (f" of experiment {experiment + 1}" if len(found.samples) > 1 else "")

    channels = [text for channel in found.channels for text in _channel(channel, at)]
    return (*_record(found, at), *channels, *_inputs(found), *_ties(found), *_split(found))


def _number_of(count: int, what: str) -> str:
    return f"{count} {what}" + ("" if count == 1 else "s")


def _record(found: Inspection, at: _Place) -> Iterator[str]:
    clock, kinds = found.clock, {channel.role for channel in found.channels}
    for role in ("input", "output"):
        if role not in kinds:
            yield f"The record has no {role}s."
    if clock.source == "unknown":
        yield "The sampling time is not known: frequencies are in cycles a sample, delays in samples."
    if clock.unreadable:
        yield f"The time column has {_number_of(clock.unreadable, 'value')} that cannot be read as a time."
    if clock.duplicates:
        yield f"The time column has {_number_of(clock.duplicates, 'step')} of zero length."
    if clock.backwards:
        yield f"The time column goes back {_number_of(clock.backwards, 'time')}."
    if clock.gaps:
        yield (
            f"The time column has {_number_of(clock.gaps, 'gap')} (over 1.5 times the median step), "
            f"the first before {at(clock.first_gap_experiment, clock.first_gap)}."
        )
    if clock.jitter is not None and clock.jitter > UNEVEN:
        yield f"The time column is not uniform: a step is {percent(clock.jitter)} off the median step."
    step, Ts = clock.step, clock.Ts
    if clock.source == "given" and step is not None and Ts is not None and abs(step - Ts) > AGREEMENT * Ts:
        yield f"The given Ts of {Ts:.9g} s is not the time column's usual step of {step:.9g} s."
    for copy in found.copies:
        if copy.equal:
            yield f"Columns '{copy.first}' and '{copy.second}' are equal."
        elif copy.gain is not None and copy.offset is not None:
            yield (
                f"Column '{copy.second}' is {copy.gain:.4g} times '{copy.first}' plus {copy.offset:.4g}, "
                "to a millionth of its σ."
            )


def _channel(c: Channel, at: _Place) -> Iterator[str]:
    name = f"{c.role} '{c.name}'"
    if c.kind == "empty":
        yield f"The {name} holds no number."
        return
    if c.missing:
        yield f"The {name} misses {c.missing} of {c.samples} samples, at most {c.longest_gap} in a row."
    if c.kind == "constant":
        yield f"The {name} is constant."
    if c.levels > FEW:
        for share, extreme, value in ((c.at_minimum, "minimum", c.minimum), (c.at_maximum, "maximum", c.maximum)):
            if share > STOPPED and c.held < HELD:
                yield (
                    f"{percent(share)} of the {name} is exactly its {extreme} {value:.6g}, in runs of at least "
                    "three samples: look for a stop or saturation."
                )
        if c.bits is not None and c.step is not None and c.sigma and c.step / 12**0.5 > COARSE * c.sigma:
            yield (
                f"The {name} is quantised in steps of {c.step:.4g} ({c.bits:.1f} bits): "
                f"rounding noise of {percent(c.step / 12**0.5 / c.sigma)} of its σ."
            )
    if c.spikes and c.spikes <= max(1, c.samples // 100):
        first = at(c.first_spike_experiment, c.first_spike)
        yield f"The {name} has {_number_of(c.spikes, 'single-sample spike')}, the first at {first}."
    if c.trend is not None and c.trend_share is not None and c.trend_share > DRIFTS and c.role == "output":
        yield (
            f"A straight line over the training part holds {100 * c.trend_share:.0f} % of the variance of the {name} "
            f"there ({c.trend:+.1f} σ from start to end): drift, or a slow response."
        )


def _inputs(found: Inspection) -> Iterator[str]:
    kinds = {channel.name: channel for channel in found.channels if channel.role == "input"}
    needed = 2 * max(found.orders, default=1)
    for e in found.excitation:
        channel = kinds[e.input]
        if channel.kind in ("empty", "constant"):
            continue
        if e.persistency.order < min(needed, e.persistency.largest):
            yield (
                f"The input '{e.input}' is persistently exciting of order {e.persistency.order} only: "
                f"a model of order {max(found.orders, default=1)} needs {needed}."
            )
        if channel.switches < 10:
            yield f"The input '{e.input}' changes only {_number_of(channel.switches, 'time')}."
        if e.near_nyquist is not None and e.near_nyquist > FAST:
            yield (
                f"{100 * e.near_nyquist:.0f} % of the power of the input '{e.input}' lies above 0.8 of the Nyquist "
                "frequency: downsampling would lose it."
            )
    if found.joint is not None:
        least = min((e.persistency.order for e in found.excitation if e.persistency.order > 1), default=0)
        if found.joint.order < min(least, found.joint.largest):
            yield (
                f"Together the inputs are persistently exciting of order {found.joint.order} only: "
                "they depend on each other, so their effects cannot be told apart."
            )


def _ties(found: Inspection) -> Iterator[str]:
    for delay in found.delays:
        if delay.smooth:
            yield (
                f"'{delay.output}' responds to '{delay.input}', but the input is too smooth to tell the delay: "
                "its past foretells it."
            )
        elif delay.samples is None:
            yield (
                f"No response of '{delay.output}' to '{delay.input}' within {len(delay.correlation) - 1} samples "
                "is above the noise."
            )
    longest = max((delay.samples or 0 for delay in found.delays), default=0)
    if longest == LAGS:
        yield f"A delay of {LAGS} samples is the longest looked for: the real one may be longer."
    for each in found.linearity:
        if each.unexplained is not None and each.unexplained > MUCH:
            segment = "" if found.spectrum is None else f" over segments of {found.spectrum.segment} samples"
            how = "the best linear model fitted here" if each.fitted else f"coherence{segment}"
            yield (
                f"Linear relations to the inputs leave about {percent(each.unexplained)} of the power of "
                f"'{each.output}' unexplained, an upper figure by {how}: noise, nonlinearity, unmeasured inputs or a "
                "long memory; it cannot tell which."
            )
        if each.p_value is not None and each.gain is not None and each.p_value < SURE and each.gain > WORTH:
            yield (
                f"Squares, cubes and products foretell {100 * each.gain:.0f} % of what a linear model leaves of "
                f"'{each.output}' from one sample to the next ({p_text(each.p_value)}): it is nonlinear."
            )
    yield from _feedback(found)
    if found.spectrum is not None:
        yield from _slow(found)
    lowest = min((c.val for c in found.order.candidates), default=0.0)
    if found.order.constant is not None and lowest >= found.order.constant:
        yield (
            "No linear model tried simulates the validation part better than a constant would: "
            "the guess of the order says little."
        )
    if found.order.suggested == LARGEST:
        yield f"The linear order is at least {LARGEST}, the largest tried: `nnss order` looks further."


def _feedback(found: Inspection) -> Iterator[str]:
    """One remark: for the input that follows outputs most, else for the first pair that goes together at once."""
    untrusted = "Under feedback delays and coherence are not to be trusted, and models fitted here may be biased."
    tests = [(e.feedback.p_value, e.input, e.feedback) for e in found.excitation if e.feedback is not None]
    follows = [test for test in tests if test[0] < SURE / len(tests) and test[2].gain > WORTH]
    at_once = [delay for delay in found.delays if delay.samples == 0]
    if follows:
        p, name, most = min(follows, key=lambda test: test[:2])
        yield (
            f"Past outputs foretell {percent(most.gain)} of what is new of the input '{name}' ({p_text(p)}): it "
            f"follows them, which is feedback, or both follow something else. {untrusted}"
        )
    elif at_once:
        yield (
            f"'{at_once[0].output}' goes with '{at_once[0].input}' in the same sample: a feedthrough, or feedback, "
            f"which this record does not tell apart. {untrusted}"
        )


def _slow(found: Inspection) -> Iterator[str]:
    assert found.spectrum is not None
    nyquist = found.spectrum.frequency[-1]
    for name, density in zip(found.spectrum.channels, found.spectrum.density, strict=True):
        role = next(channel.role for channel in found.channels if channel.name == name)
        inside = sum(d for f, d in zip(found.spectrum.frequency, density, strict=True) if f <= SLOW * nyquist)
        if role == "output" and sum(density) > 0 and inside > 0.99 * sum(density):
            yield (
                f"99 % of the power of '{name}' lies below {100 * SLOW:.0f} % of the Nyquist frequency: "
                "the record may be sampled faster than it needs."
            )


def _split(found: Inspection) -> Iterator[str]:
    split = found.split
    if sum(found.samples) < 100:
        yield f"The record has {sum(found.samples)} samples: too few for more than a first look."
    given = "split" in found.given
    if not given and split.rule != "60/20/20 in time order" and split.rule.endswith("time order"):
        yield (
            f"The split recommended is {split.rule}: with 60/20/20 more columns would be at rest or out of range "
            "in the training or validation part."
        )
    for warning in split.warnings:
        yield f"With the {'given' if given else 'recommended'} split ({split.rule}), {warning}."
