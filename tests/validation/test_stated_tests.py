"""The stated tests and the verdict by their numbers: which tests fail, and what is told of which output."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.datasets.record import Channels

from nnss_cli.validation.linearisation import Linearisations, OperatingPoint
from nnss_cli.validation.predictor import StepTable
from nnss_cli.validation.residuals import Dependence, Profile, Whiteness, whiteness
from nnss_cli.validation.result import OutputCheck
from nnss_cli.validation.verdict import stated, verdict

NOTHING = Linearisations((), (), np.ones(1), 1.0)
POLES = np.full((1, 2), 0.5)


def channels(m: int, r: int) -> Channels:
    return Channels(tuple(f"u{j + 1}" for j in range(r)), tuple(f"y{i + 1}" for i in range(m)), ("–",) * r, ("–",) * m)


def output(name: str, white: float = 0.5, depends: tuple[float, ...] = (0.5,), **other: Any) -> OutputCheck:
    """An output whose tests of residuals have these p-values."""
    found = OutputCheck(
        name, "–", 0.1, 1.0, 90.0, None, None, 0.0, (1.0,) * len(depends), 0.1,
        Whiteness(np.array([0.3, 0.1]), 0.1, 1.0, 2, white),
        tuple(Dependence(np.array([0.3]), 0.1, 1.0, 3, p) for p in depends), (None,) * len(depends), (),
    )  # fmt: skip
    return replace(found, **other)


def steps(ratio: tuple[float, ...]) -> StepTable:
    """Errors one step ahead over persistence's; two steps ahead it is the other way round."""
    one = np.array([ratio, 1 / np.maximum(ratio, 1e-3)])
    return StepTable((1, 2), 2 * one, np.full(one.shape, 2.0), 2 * one[0])


@st.composite
def results(draw: st.DrawFn) -> tuple[list[float], list[list[float]], tuple[float, ...], list[tuple[float, str]]]:
    """p-values about the levels, errors about persistence's, rates about 1."""
    m, r = draw(st.integers(1, 3)), draw(st.integers(1, 3))
    white = st.sampled_from([0.009 / m, 0.011 / m, 0.009, 0.011])
    depends = st.sampled_from([0.009 / m / r, 0.011 / m / r, 0.009 / m, 0.009, 0.6])
    ratio = draw(st.tuples(*[st.sampled_from([0.3, 0.97, 1.0, 1.03])] * m))
    gains = draw(
        st.lists(
            st.tuples(st.sampled_from([0.4, 0.99, 1.0, 1.2]), st.sampled_from(["none", "Kalman"])),
            min_size=1,
            max_size=3,
        )
    )
    return [draw(white) for _ in range(m)], [[draw(depends) for _ in range(r)] for _ in range(m)], ratio, gains


@given(results())
def test_a_test_fails_by_its_worst_output_input_and_member(found: Any) -> None:
    """At 1 % shared by all outputs, or all pairs of outputs and inputs; the verdict speaks of those that fail."""
    white, depends, ratio, gains = found
    m, r = len(white), len(depends[0])
    named, outputs = channels(m, r), [output(f"y{i + 1}", white[i], tuple(depends[i])) for i in range(m)]
    table, (rates, origins) = steps(ratio), zip(*gains, strict=True)
    tests = stated(outputs, table, rates, origins, named)
    passed = {test.name.split(" (")[0]: test.passed for test in tests}
    expected = {
        "residuals are white": not [p for p in white if p < 0.01 / m],
        "residuals do not depend on the inputs": not [p for row in depends for p in row if p < 0.01 / m / r],
        "one step ahead, the model beats persistence": not [value for value in ratio if value >= 1],
    }
    corrected = [rate for rate, origin in gains if origin != "none"]
    assert passed == expected | ({"the observer is stable": not [x for x in corrected if x >= 1]} if corrected else {})
    assert f"'y{white.index(min(white)) + 1}'" in tests[0].found
    assert re.search(r"'(y\d)' on '(u\d)'", tests[1].found).groups() in {  # type: ignore[union-attr]
        (f"y{i + 1}", f"u{j + 1}") for i in range(m) for j in range(r) if depends[i][j] == min(map(min, depends))
    }
    assert f"{max(ratio):.2f} times" in tests[2].found
    assert not corrected or f"{max(corrected):.3g} a sample" in tests[3].found
    head, *lines = verdict(outputs, table, tests, 2, POLES, named, NOTHING, 0)
    failed = sum(not test.passed for test in tests)
    assert head == (f"{failed} of {len(tests)} tests fail." if failed else f"All {len(tests)} tests pass.")
    for i in range(m):
        own = " ".join(line for line in lines if line.startswith(f"'y{i + 1}'"))
        assert ("residuals are coloured" in own) == (white[i] < 0.01 / m)
        for j in range(r):
            assert (f"'u{j + 1}'" in own) == (depends[i][j] < 0.01 / m / r)
        assert ("persistence predicts" in own) == (ratio[i] >= 1)


def test_white_residuals_of_three_outputs_are_rejected_as_often_as_said() -> None:
    """1,000 records of 200 samples at the level of 1 % for all three: 5 to 17 of them."""
    rejected = 0
    for seed in range(1000):
        e = np.random.default_rng(seed).standard_normal((3, 200))
        outputs = [replace(output(f"y{i + 1}"), white=whiteness([e[i]])) for i in range(3)]
        rejected += not stated(outputs, steps((0.5,) * 3), (0.5,), ("none",), channels(3, 1))[0].passed
    assert 5 <= rejected <= 17


def told(*outputs: OutputCheck, linear: Linearisations = NOTHING) -> list[str]:
    m, r = len(outputs), len(outputs[0].depends)
    tests = stated(outputs, steps((0.5,) * m), (0.5,), ("none",), channels(m, r))
    return list(verdict(outputs, steps((0.5,) * m), tests, 2, POLES, channels(m, r), linear, 0)[1:])


def test_a_fit_is_about_the_linear_limit_within_two_percent() -> None:
    """One sentence above, one below, one between; of an output without a limit none."""

    def sentence(fit: float) -> str:
        (line,) = told(output("y1", fit_percent=fit, limit=80.0))
        assert f"{fit:.1f} %" in line
        return re.sub(r"[\d.]+ %", "", line)

    above, near, *others, below = map(sentence, (82.1, 81.9, 80.0, 78.1, 77.9))
    assert {near} == set(others)
    assert len({above, near, below}) == 3
    assert told(output("y1", fit_percent=50.0)) == []


def test_a_profile_is_told_where_it_is_no_chance_and_matters() -> None:
    def profile(share: float, p: float) -> Profile:
        return Profile(np.zeros(2), np.zeros(2), np.ones(2), share, p)

    pair = (0.5, 0.5)
    chance, small = profile(0.9, 0.0026), profile(0.049, 1e-9)  # of four profiles: 1 %/4 is the level of one
    assert told(output("y1", depends=pair, by_input=(chance, None), by_state=(small, chance))) == []
    (line,) = told(
        output("y1", depends=pair, by_input=(chance, profile(0.06, 0.0024)), by_state=(profile(0.051, 0.0), small))
    )
    assert "bends with input 'u2' (6 % of its variance, beyond a straight line)" in line


def test_a_gain_that_changes_its_sign_is_told_with_where() -> None:
    def point(u: tuple[float, float], gain: list[list[float]]) -> OperatingPoint:
        return OperatingPoint(
            np.array(u), np.zeros(2), np.zeros(1), np.array(gain), np.zeros((1, 2, 2)), np.zeros((1, 2, 2))
        )

    points = (
        point((1, 10), [[1.0, -0.5], [-2.0, np.inf]]),
        point((2, 20), [[3.0, -0.25], [np.nan, -1.0]]),
        point((3, 30), [[2.0, 0.75], [-1.0, -2.0]]),
    )
    pair = [output(name, depends=(0.5, 0.5)) for name in ("y1", "y2")]
    (line,) = told(*pair, linear=replace(NOTHING, points=points))
    assert "from 'u2' to 'y1' changes its sign: -0.5 at 10, 0.75 at 30" in line
    assert told(*pair, linear=replace(NOTHING, points=points[:2])) == []


def test_persistence_without_errors_is_not_beaten() -> None:
    still = StepTable((1,), np.array([[0.0, 0.1]]), np.array([[0.0, 1.0]]), np.zeros(2))
    tests = stated([output("y1"), output("y2")], still, (0.5,), ("none",), channels(2, 1))
    assert not tests[2].passed
    assert tests[2].found == "RMSE inf times that of persistence ('y1')"
