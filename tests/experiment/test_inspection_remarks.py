"""Remarks on a record: each is made on one side of its threshold, and not on the other."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from nnss_cli.experiment.inspection import examine
from nnss_cli.experiment.inspection_dynamics import LAGS, Feedback
from nnss_cli.experiment.inspection_order import LARGEST, OrderCandidate, OrderGuess
from nnss_cli.experiment.inspection_result import Inspection, Linearity, Spectrum, remarks_on
from nnss_cli.experiment.inspection_signals import Copy, Persistency
from nnss_cli.experiment.inspection_split import percent


@pytest.fixture(scope="module")
def plain() -> Inspection:
    """A record of which there is nothing to say."""
    u = np.random.default_rng(0).standard_normal((900, 2))
    y = lfilter([0, 1.0], [1, -1.5, 0.7], u.sum(1)) + 0.1 * np.random.default_rng(1).standard_normal(900)
    found = examine({"u": u[:, 0], "v": u[:, 1]}, {"y": y}, 0.1)
    return replace(
        found, order=OrderGuess(2, (OrderCandidate(2, 0.1, 0.2, 0.2),), 500, 200, 1.0), orders=(1, 2, 3),
        split=replace(found.split, warnings=()), linearity=(Linearity("y", 0.01, (), 0.0, 0.9),),
        excitation=tuple(replace(e, near_nyquist=0.05) for e in found.excitation),
    )  # fmt: skip


def changed(found: Inspection, path: str, **values: Any) -> Inspection:
    """`found` with fields of one of its parts changed: 'clock', or 'channels 2' for an element."""
    name, _, number = path.partition(" ")
    part = getattr(found, name)
    if not number:
        return replace(found, **{name: replace(part, **values)})
    parts = list(part)
    parts[int(number)] = replace(parts[int(number)], **values)
    return replace(found, **{name: tuple(parts)})


def test_of_a_plain_record_nothing_is_said(plain: Inspection) -> None:
    assert remarks_on(plain) == ()


Y, U = "channels 2", "channels 0"
NYQUIST = "of the power of the input 'u' lies above 0.8 of the Nyquist frequency: downsampling would lose it."
SIDES = [
    ("clock", {"source": "unknown"}, {"source": "given"}, "The sampling time is not known"),
    ("clock", {"unreadable": 1}, {"unreadable": 0}, "The time column has 1 value that cannot be read as a time."),
    ("clock", {"duplicates": 1}, {"duplicates": 0}, "The time column has 1 step of zero length."),
    ("clock", {"backwards": 1}, {"backwards": 0}, "The time column goes back 1 time."),
    ("clock", {"gaps": 1, "first_gap": 7}, {"gaps": 0},
     "has 1 gap (over 1.5 times the median step), the first before sample 8."),
    ("clock", {"jitter": 0.0101}, {"jitter": 0.01},
     "The time column is not uniform: a step is 1 % off the median step."),
    ("clock", {"step": 0.1002}, {"step": 0.1001},
     "The given Ts of 0.1 s is not the time column's usual step of 0.1002 s."),
    (Y, {"kind": "empty"}, {}, "The output 'y' holds no number."),
    (Y, {"missing": 1, "longest_gap": 1}, {"missing": 0},
     "The output 'y' misses 1 of 900 samples, at most 1 in a row."),
    (Y, {"kind": "constant"}, {}, "The output 'y' is constant."),
    (Y, {"at_minimum": 0.0101, "levels": 17}, {"at_minimum": 0.01}, "1 % of the output 'y' is exactly its minimum"),
    (Y, {"at_maximum": 0.12, "maximum": 4.25, "levels": 17}, {"at_maximum": 0.12, "levels": 16},
     "12 % of the output 'y' is exactly its maximum 4.25, in runs of at least three samples: look for a stop"),
    (Y, {"at_maximum": 0.12, "levels": 17, "held": 0.49}, {"at_maximum": 0.12, "levels": 17, "held": 0.5},
     "look for a stop or saturation"),
    (Y, {"bits": 5.04, "step": 0.0694, "sigma": 1.0}, {"bits": 5.0, "step": 0.0692, "sigma": 1.0},
     "The output 'y' is quantised in steps of 0.0694 (5.0 bits): rounding noise of 2 % of its σ."),
    (Y, {"spikes": 9, "first_spike": 4}, {"spikes": 10, "first_spike": 4},
     "9 single-sample spikes, the first at sample 5."),
    (Y, {"spikes": 1, "samples": 90, "first_spike": 4}, {"spikes": 2, "samples": 90, "first_spike": 4},
     "1 single-sample spike, the first"),
    (Y, {"trend": -1.26, "trend_share": 0.2501}, {"trend": -1.26, "trend_share": 0.25},
     "holds 25 % of the variance of the output 'y' there (-1.3 σ from start to end): drift, or a slow response."),
    (Y, {"trend": 3.0, "trend_share": 0.9}, {"trend": 3.0, "trend_share": 0.9, "role": "input"},
     "A straight line over the"),
    (U, {"switches": 9}, {"switches": 10}, "The input 'u' changes only 9 times."),
    ("excitation 0", {"near_nyquist": 0.104}, {"near_nyquist": 0.1}, f"10 % {NYQUIST}"),
    ("excitation 0", {"persistency": Persistency(5, 50, 1e-9, 900)}, {"persistency": Persistency(6, 50, 1e-9, 900)},
     "The input 'u' is persistently exciting of order 5 only: a model of order 3 needs 6."),
    ("excitation 0", {"persistency": Persistency(3, 4, 1e-9, 900)}, {"persistency": Persistency(4, 4, 1e-9, 900)},
     "The input 'u' is persistently exciting of order 3 only"),
    ("joint", {"order": 49, "largest": 50}, {"order": 50},
     "Together the inputs are persistently exciting of order 49 only"),
    ("joint", {"order": 19, "largest": 20}, {"order": 20, "largest": 20},
     "Together the inputs are persistently exciting"),
    ("delays 0", {"smooth": True}, {"smooth": False}, "the input is too smooth to tell the delay"),
    ("delays 0", {"samples": None, "correlation": (0.0,) * 8}, {"samples": 0},
     "No response of 'y' to 'u' within 7 samples"),
    ("delays 0", {"samples": LAGS}, {"samples": LAGS - 1}, f"A delay of {LAGS} samples is the longest looked for"),
    ("linearity 0", {"unexplained": 0.0501}, {"unexplained": 0.05},
     "leave about 5 % of the power of 'y' unexplained, an upper figure by coherence over segments of 128"),
    ("linearity 0", {"unexplained": 0.12, "fitted": True}, {"unexplained": 0.05, "fitted": True},
     "leave about 12 % of the power of 'y' unexplained, an upper figure by the best linear model"),
    ("linearity 0", {"p_value": 0.009, "gain": 0.02}, {"p_value": 0.01, "gain": 0.02},
     "foretell 2 % of what a linear model leaves of 'y' from one sample to the next (p = 0.009): it is nonlinear."),
    ("linearity 0", {"p_value": 0.0, "gain": 0.0101}, {"p_value": 0.0, "gain": 0.01}, "(p < 1e-16): it is nonlinear."),
    ("excitation 1", {"feedback": Feedback(0.02, 0.0049, 900)}, {"feedback": Feedback(0.02, 0.0051, 900)},
     "Past outputs foretell 2 % of what is new of the input 'v' (p = 0.0049): it follows them, which is feedback, or"),
    ("excitation 1", {"feedback": Feedback(0.011, 0.0, 900)}, {"feedback": Feedback(0.01, 0.0, 900)},
     "(p < 1e-16): it follows them"),
    ("delays 0", {"samples": 0}, {"samples": 1},
     "'y' goes with 'u' in the same sample: a feedthrough, or feedback, which this record does not tell apart. Under"),
    ("order", {"constant": 0.2}, {"constant": 0.201},
     "better than a constant would: the guess of the order says little."),
    ("order", {"suggested": LARGEST}, {"suggested": LARGEST - 1},
     f"The linear order is at least {LARGEST}, the largest tried"),
    ("split", {"rule": "50/25/25 in time order"}, {"rule": "whole experiments"},
     "The split recommended is 50/25/25 in time order"),
    ("split", {"warnings": ("it rains",)}, {"warnings": ()},
     "With the recommended split (60/20/20 in time order), it rains."),
]  # fmt: skip


@pytest.mark.parametrize(("path", "due", "not_due", "sentence"), SIDES)
def test_each_remark_has_a_threshold(
    plain: Inspection, path: str, due: dict[str, Any], not_due: dict[str, Any], sentence: str
) -> None:
    assert any(sentence in said for said in remarks_on(changed(plain, path, **due))), remarks_on(
        changed(plain, path, **due)
    )
    assert not any(sentence in said for said in remarks_on(changed(plain, path, **not_due)))


def test_of_feedback_there_is_one_remark_on_the_input_that_follows_most(plain: Inspection) -> None:
    found = changed(plain, "excitation 0", feedback=Feedback(0.5, 1e-5, 900))
    found = changed(changed(found, "excitation 1", feedback=Feedback(0.1, 1e-9, 900)), "delays 0", samples=0)
    (said,) = remarks_on(found)
    assert "foretell 10 % of what is new of the input 'v' (p = 1e-09)" in said
    assert "delays and coherence are not to be trusted" in said


def test_remarks_on_the_record_as_a_whole(plain: Inspection) -> None:
    assert "The record has 99 samples: too few for more than a first look." in remarks_on(
        replace(plain, samples=(50, 49))
    )
    assert remarks_on(replace(plain, samples=(50, 50))) == ()
    (said,) = remarks_on(
        changed(replace(plain, samples=(450, 450)), "clock", gaps=2, first_gap=3, first_gap_experiment=1)
    )
    assert said == (
        "The time column has 2 gaps (over 1.5 times the median step), the first before sample 4 of experiment 2."
    )
    without = replace(plain, channels=plain.channels[2:], excitation=(), joint=None, spectrum=None)
    assert remarks_on(without) == ("The record has no inputs.",)
    pair = (Copy("u", "y", True, 1.0, 0.0), Copy("v", "y", False, -2.0, 3.14159), Copy("u", "v", False, None, None))
    assert remarks_on(replace(plain, copies=pair)) == (
        "Columns 'u' and 'y' are equal.",
        "Column 'y' is -2 times 'v' plus 3.142, to a millionth of its σ.",
    )


def test_of_a_split_that_was_given_nothing_is_recommended(plain: Inspection) -> None:
    found = changed(plain, "split", rule="50/25/25 in time order", warnings=("it rains",))
    assert remarks_on(replace(found, given=("split",))) == ("With the given split (50/25/25 in time order), it rains.",)


def test_a_constant_input_is_not_blamed_for_exciting_little(plain: Inspection) -> None:
    dead = changed(
        changed(plain, U, kind="constant", switches=0), "excitation 0", persistency=Persistency(1, 50, 1e-9, 9)
    )
    assert remarks_on(dead) == ("The input 'u' is constant.",)


@pytest.mark.parametrize(("inside", "said"), [(0.9901, True), (0.99, False)])
def test_an_output_is_slow_when_99_percent_of_its_power_lies_below_a_twentieth_of_nyquist(
    plain: Inspection, inside: float, said: bool
) -> None:
    def remark(channel: str) -> bool:
        spectrum = Spectrum((0.5, 1.0, 20.0), (channel,), ((inside / 2, inside / 2, 1 - inside),), 8, 2.0)
        slow = f"99 % of the power of '{channel}' lies below 5 % of the Nyquist frequency"
        return any(slow in text for text in remarks_on(replace(plain, spectrum=spectrum)))

    assert remark("y") is said
    assert not remark("u")  # an input may be as slow as it likes


@pytest.mark.parametrize(
    ("share", "text"), [(0.1, "10 %"), (0.994, "99 %"), (0.0996, "10 %"), (0.0123, "1.2 %"), (0.001, "0.1 %")]
)
def test_small_shares_have_two_digits_and_large_ones_none(share: float, text: str) -> None:
    assert percent(share) == text
