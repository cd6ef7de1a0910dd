"""Inspection: known answers, known null, remarks that are true, and records that nobody wants."""

import json
import math
import time
from typing import Any

import numpy as np
import pytest
from conftest import slow_but
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from nnss_cli.datasets.record import FloatArray
from scipy.signal import lfilter, max_len_seq

from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection import examine
from nnss_cli.experiment.inspection_dynamics import multiple_coherence, products, responses, welch
from nnss_cli.experiment.inspection_order import guess_order
from nnss_cli.experiment.inspection_result import Inspection
from nnss_cli.experiment.inspection_signals import (
    Channel,
    examine_channel,
    examine_clock,
    persistency,
    with_trend,
)

RESONANT = [1, -1.5, 0.7]


def channel(values: Any) -> Channel:
    return examine_channel("x", "output", "m", [np.asarray(values, dtype=float)])


def standard(*columns: FloatArray) -> FloatArray:
    z = np.stack(columns, axis=1)
    return (z - z.mean(0)) / z.std(0)


def plant(
    K: int = 1500, delay: int = 1, noise: float = 0.1, bend: float = 0.0, seed: int = 0, colour: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """A resonant second-order system after u + bend·u², white output noise of the given share of σ."""
    random = np.random.default_rng(seed)
    u = lfilter([1.0], [1.0, -colour], random.standard_normal(K + 300))
    y = lfilter([*np.zeros(delay), 1.0], RESONANT, u + bend * u**2)[300:]
    return u[300:], y + noise * y.std() * random.standard_normal(K)


def check_plain(found: Inspection) -> None:
    """JSON-able without NaN, and none in the text."""
    json.dumps(found.as_dict(), allow_nan=False)
    for sentence in (*found.remarks, *found.used):
        assert not {"nan", "inf", "None"} & set(sentence.replace(",", " ").split()), sentence


# persistency: L. Ljung, System Identification, section 13.2


@pytest.mark.parametrize("bits", [3, 4, 5])
def test_a_prbs_excites_the_order_of_its_period(bits: int) -> None:
    period = 2**bits - 1
    u = np.tile(2.0 * max_len_seq(bits)[0] - 1, 20)
    assert persistency([u[:, None]]).order == period


@pytest.mark.parametrize("constant", [0.0, 2.0, 300.0])
@pytest.mark.parametrize("k", [1, 3, 6])
def test_k_sines_excite_order_2k_and_a_constant_one_more(k: int, constant: float) -> None:
    t = np.arange(997)
    u = sum((np.sin((0.3 + 0.4 * i) * t + i) for i in range(k)), np.zeros(997)) + constant
    assert persistency([u[:, None]]).order == 2 * k + (constant != 0)


def test_noise_excites_all_orders_looked_at_and_a_constant_one() -> None:
    u = np.random.default_rng(0).standard_normal((500, 1))
    assert persistency([u]).order == persistency([u]).largest == 50
    assert persistency([np.full((500, 1), 7.0)]).order == 1
    assert persistency([np.zeros((500, 1))]).order == 0


def test_inputs_that_depend_on_each_other_excite_nothing_together() -> None:
    u = np.random.default_rng(0).standard_normal((500, 2))
    assert persistency([u]).order == persistency([u]).largest
    # v(k) = u(k−2): with three shifts a column appears twice
    assert persistency([np.stack([u[2:, 0], u[:-2, 0]], axis=1)]).order == 2


# columns


@given(st.integers(2, 200), st.floats(1e-3, 1e3), st.floats(-100, 100), st.integers(0, 99))
def test_quantised_signal_shows_its_step(levels: int, step: float, offset: float, seed: int) -> None:
    k = np.concatenate([np.arange(levels), np.random.default_rng(seed).integers(0, levels, 300)])
    found = channel(offset + step * k)
    assert found.step == pytest.approx(step, rel=1e-6)
    assert found.on_grid == 1.0
    assert found.bits == pytest.approx(math.log2(levels), abs=1e-6)
    assert found.levels == levels


def test_continuous_signal_has_no_grid() -> None:
    found = channel(np.random.default_rng(0).standard_normal(2000))
    assert found.bits is None
    assert found.on_grid is not None
    assert found.on_grid < 0.05


def test_saturated_share_counts_runs_of_three_at_the_extremes() -> None:
    x = np.sin(0.05 * np.arange(5000))
    clipped = channel(np.clip(x, -0.7, 2.0))
    assert clipped.at_minimum == pytest.approx(np.mean(x <= -0.7), abs=1e-12)
    assert clipped.at_maximum == 0.0
    pairs = channel(np.tile([0.0, 0.3, 1.0, 1.0, 0.5], 50))
    assert pairs.at_maximum == 0.0


@pytest.mark.parametrize("role", ["inputs", "outputs"])
def test_a_staircase_is_not_suspected_of_a_stop(role: str) -> None:
    """Steps to thirty levels, held for 20 samples each: the largest is held as all others are."""
    random = np.random.default_rng(0)
    stairs = np.repeat(random.uniform(0, 1, 30), 20)
    wave = 2.0 * np.sin(0.05 * np.arange(600))

    def suspected(x: FloatArray) -> bool:
        given: dict[str, Any] = {"inputs": {"u": random.standard_normal(600)}, "outputs": {"y": wave}}
        return any("look for a stop" in said for said in examine(**given | {role: {"x": x}}).remarks)

    assert channel(stairs).at_maximum > 0.01
    assert channel(stairs).held == pytest.approx(19 / 20, abs=0.01)
    assert not suspected(stairs)
    stopped = channel(np.clip(wave, -2.0, -0.3))
    assert (stopped.kind, stopped.held) == ("steps", 0.0)  # on the stop for most of the time
    assert suspected(np.clip(wave, -2.0, -0.3))


@given(st.lists(st.integers(2, 497), min_size=1, max_size=5, unique=True).filter(
    lambda rows: min(np.diff(sorted([*rows, 10**6]))) > 2
))  # fmt: skip
def test_spikes_are_counted_and_found(rows: list[int]) -> None:
    x = 0.1 * np.random.default_rng(0).standard_normal(500).cumsum()
    assert channel(x).spikes == 0
    x[rows] += 5.0
    assert (channel(x).spikes, channel(x).first_spike) == (len(rows), min(rows))
    second = examine_channel("x", "output", "m", [np.zeros(30), x])
    assert (second.spikes, second.first_spike, second.first_spike_experiment) == (len(rows), min(rows), 1)


def test_missing_samples_are_counted_with_their_longest_gap() -> None:
    x = np.arange(100.0)
    x[[3, 10, 11, 12]] = np.nan
    x[40] = np.inf
    found = channel(x)
    assert (found.missing, found.longest_gap, found.maximum) == (5, 3, 99.0)


def trend(x: FloatArray) -> tuple[float | None, float | None]:
    found = with_trend(channel(x), [(np.arange(float(len(x))), x)])
    return found.trend, found.trend_share


def test_trend_is_the_change_of_the_line_in_sigma() -> None:
    t = np.linspace(0, 1, 1001)
    for scale in (5.0, 1e-150, 1e250):
        change, share = trend(scale * t)
        assert change == pytest.approx(math.sqrt(12), rel=0.01)  # of a uniform distribution
        assert share == pytest.approx(1.0)
    assert trend(np.sin(2 * np.pi * 50 * t))[1] == pytest.approx(0, abs=0.01)
    assert trend(t[:2]) == trend(np.ones(9)) == (None, None)


@pytest.mark.parametrize("slope", [0.0, 0.02])
def test_the_line_is_in_the_time_since_each_experiments_start_and_of_training_alone(slope: float) -> None:
    """Experiments at levels of their own have no drift together, nor do validation and test tell of one."""
    random = np.random.default_rng(0)
    line = slope * np.arange(300)
    y = [level + line + random.standard_normal(300) for level in (0.0, 5.0, 10.0, 900.0)]
    u = [{"u": random.standard_normal(300)} for _ in y]
    found = examine(u, [{"y": each} for each in y])
    _, output = found.channels
    assert [part.experiment for part in found.split.train] == [0, 1]
    between = np.concatenate(y[:2])
    assert output.trend == pytest.approx(299 * slope / between.std(ddof=1), abs=0.2)
    assert any("A straight line" in said for said in found.remarks) is (slope > 0)
    without = examine(u, [{"y": each} for each in y], detrend="linear").channels[1]
    assert without.trend == pytest.approx(0, abs=1e-9)  # it is the line that detrend takes off
    late = np.r_[np.zeros(360), np.arange(240.0)] + 0.1 * random.standard_normal(600)  # rises after training alone
    (_, output) = examine({"u": random.standard_normal(600)}, {"y": late}).channels
    assert output.trend_share == pytest.approx(0, abs=0.02)


def test_no_difference_crosses_from_one_experiment_to_the_next() -> None:
    parts = [np.full(50, 1.0), np.full(50, 1e6)]
    assert examine_channel("x", "input", "", parts).switches == 0


def test_kinds_of_signals() -> None:
    random = np.random.default_rng(0)
    assert channel([]).kind == channel([np.nan] * 5).kind == "empty"
    assert channel([2.0] * 5).kind == "constant"
    assert channel(random.choice([0, 1], 50)).kind == "two levels"
    assert channel(random.choice([0, 1, 2], 50)).kind == "few levels"
    assert channel(np.repeat(random.standard_normal(50), 5)).kind == "steps"
    assert channel(random.standard_normal(50)).kind == "continuous"


def test_clock_names_jitter_duplicates_and_the_first_gap() -> None:
    t = np.arange(50) * 0.2
    assert examine_clock(None, [t]).jitter == pytest.approx(0, abs=1e-9)
    broken = np.delete(t, [20, 21])
    broken[5] = broken[4]
    found = examine_clock(None, [t, broken])
    assert found.Ts == pytest.approx(0.2)
    assert (found.duplicates, found.backwards) == (1, 0)
    # row 6 follows a doubled step, row 20 a tripled one
    assert (found.gaps, found.first_gap, found.first_gap_experiment) == (2, 6, 1)
    assert found.jitter == pytest.approx(2.0)
    assert examine_clock(None, [t[::-1]]).backwards == 49


def test_copies_are_found_and_relatives_are_not() -> None:
    u = np.random.default_rng(0).standard_normal((400, 2))
    found = examine({"a": u[:, 0], "b": 3 - 2 * u[:, 0], "c": u[:, 1]}, {"y": u[:, 0], "z": u[:, 0] + 1e-3 * u[:, 1]})
    assert {(c.first, c.second, c.equal) for c in found.copies} == {
        ("a", "b", False),
        ("a", "y", True),
        ("b", "y", False),
    }
    (affine,) = (c for c in found.copies if c.second == "b")
    assert (affine.gain, affine.offset) == (pytest.approx(-2), pytest.approx(3))
    assert "Columns 'a' and 'y' are equal." in found.remarks


# what ties outputs to inputs


@pytest.mark.parametrize("delay", range(11))
def test_delay_is_found_in_a_coloured_input(delay: int) -> None:
    u, y = plant(delay=delay, colour=0.9, noise=0.05, seed=delay)
    (found,) = responses([standard(u, y)], 1, 0)
    assert found.delay == delay


def test_a_smooth_input_tells_no_delay() -> None:
    """What older inputs foretell is no news at any lag: a lag found among noise would be no delay."""
    t = np.arange(1024)
    random = np.random.default_rng(0)
    u = sum((np.cos(2 * np.pi * i / 1024 * t + random.uniform(0, 7)) for i in range(1, 11)), np.zeros(1024))
    y = lfilter([0, 0, 0, 0.1], [1, -0.9], np.tile(u, 3))[1024:2048]
    found = examine({"u": u}, {"y": y + 0.02 * y.std() * random.standard_normal(1024)})
    assert found.delays[0].samples is None
    if found.delays[0].smooth:
        assert any("too smooth to tell the delay" in remark for remark in found.remarks)


def test_delays_of_several_correlated_inputs_are_told_apart() -> None:
    random = np.random.default_rng(3)
    u = random.standard_normal(3000)
    v = 0.7 * u + 0.7 * random.standard_normal(3000)
    y = lfilter([0, 0, 1.0], [1, -0.8], u) + lfilter([0] * 7 + [1.0], [1, -0.5], v) + 0.2 * random.standard_normal(3000)
    first, second = responses([standard(u, v, y)], 2, 0)
    assert (first.delay, second.delay) == (2, 7)


def test_no_delay_is_found_where_nothing_responds() -> None:
    """Coloured input, coloured output, no tie: 1 % of records may show one, and each lag's 99 % bound holds."""
    found, beyond = 0, []
    for seed in range(60):
        random = np.random.default_rng(seed)
        u, y = (lfilter([1.0], [1, -0.9], random.standard_normal(800)) for _ in range(2))
        (response,) = responses([standard(u, y)], 1, 0)
        found += response.delay is not None
        beyond.append(np.mean(np.abs(response.correlation) > response.bound))
    assert found <= 3
    assert 0.003 < np.mean(beyond) < 0.025


@pytest.mark.parametrize("noise", [0.1, 0.3, 1.0])
@pytest.mark.parametrize("colour", [0.0, 0.9])
def test_unexplained_share_of_a_linear_system_is_the_noise(noise: float, colour: float) -> None:
    shares = []
    for seed in range(5):
        spectra = welch([standard(*plant(4000, noise=noise, seed=seed, colour=colour))], 1)
        assert spectra is not None
        shares.append(multiple_coherence(spectra, 1, 0)[1])
    true = noise**2 / (1 + noise**2)
    assert np.mean(shares) == pytest.approx(true, rel=0.12, abs=0.005)


def test_a_long_memory_hardly_passes_for_noise() -> None:
    """Poles of modulus 0.975, 1500 samples, 1 % noise power: 14 % would be unexplained without whitening."""
    shares = []
    for seed in range(5):
        random = np.random.default_rng(seed)
        u = random.standard_normal(1800)
        y = lfilter([0, 1.0], [1, -1.9, 0.95], u)[300:]
        spectra = welch([standard(u[300:], y + 0.1 * y.std() * random.standard_normal(1500))], 1)
        assert spectra is not None
        shares.append(multiple_coherence(spectra, 1, 0)[1] or 0.0)
    assert np.mean(shares) < 0.03


def test_coherence_of_unrelated_signals_is_zero_on_average() -> None:
    """The correction for few averages: without it 4 inputs explain a quarter of noise."""
    left = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        spectra = welch([standard(*random.standard_normal((5, 1500)))], 4)
        assert spectra is not None
        left.append(multiple_coherence(spectra, 4, 0)[1])
    assert np.mean(left) > 0.93


def test_a_static_nonlinearity_raises_the_unexplained_share() -> None:
    def share(bend: float) -> float:
        found = examine(*({name: x} for name, x in zip("uy", plant(3000, bend=bend), strict=True)))
        return found.linearity[0].unexplained or 0.0

    assert share(0.4) > share(0.0) + 0.1


def slow(name: str) -> tuple[FloatArray, FloatArray]:
    """Linear plants without noise whose memory outlasts the segments: a lag, a step response, an integrator."""
    u = np.repeat(np.random.default_rng(3).uniform(-1, 1, 30), 20)
    if name == "step":
        u = np.r_[np.zeros(20), np.ones(280)]
    pole, gain = {"lag": (0.98, 0.02), "step": (0.97, 1.2), "integrator": (1.0, 0.1)}[name]
    return u, 20 + lfilter([0, gain], [1, -pole], u)


@pytest.mark.parametrize(("name", "coherent"), [("lag", 0.03), ("step", 0.1), ("integrator", 0.03)])
def test_no_more_is_unexplained_than_what_a_fitted_linear_model_leaves(name: str, coherent: float) -> None:
    u, y = slow(name)
    spectra = welch([standard(u, y)], 1)
    assert spectra is not None
    assert (multiple_coherence(spectra, 1, 0)[1] or 0.0) > coherent
    found = examine({"u": u}, {"y": y})
    assert found.linearity[0].fitted
    assert found.linearity[0].unexplained == pytest.approx(0, abs=0.002)
    assert not any("unexplained" in remark for remark in found.remarks)


def test_what_is_unexplained_is_told_by_output() -> None:
    """A linear model leaves nothing of the one output, and all of the other."""
    u, y = slow("lag")
    found = examine({"u": u}, {"y": y, "z": np.random.default_rng(0).standard_normal(600)})
    first, second = found.linearity
    assert (first.unexplained or 0.0) < 0.001
    assert (second.unexplained or 0.0) > 0.8
    bent = examine(*({name: x} for name, x in zip("uy", plant(3000, bend=0.4), strict=True))).linearity[0]
    assert not bent.fitted  # coherence explains as much


def test_spectrum_of_noise_integrates_to_its_variance() -> None:
    x = standard(lfilter([1.0], RESONANT, np.random.default_rng(0).standard_normal(20_000)))
    spectra = welch([x], 1)
    assert spectra is not None
    assert np.trapezoid(spectra.density[:, 0, 0].real, spectra.frequency) == pytest.approx(1, rel=0.05)


@pytest.mark.parametrize("kind", ["coloured", "steps", "two levels"])
def test_nonlinearity_test_has_its_size_on_linear_systems(kind: str) -> None:
    """Coloured, also heavy-tailed noise; 100 records each: nominal 5 % may give up to 11 (99 % of binomials)."""
    alarms = 0
    for seed in range(100):
        random = np.random.default_rng([seed, len(kind)])
        e = random.standard_normal(1300) if seed % 2 else random.laplace(size=1300)
        u = {
            "coloured": lfilter([1.0], [1, -0.9], random.standard_normal(1300)),
            "steps": np.repeat(random.uniform(-1, 1, 130), 10),
            "two levels": np.repeat(random.choice([-1.0, 1.0], 325), 4),
        }[kind]
        y = lfilter([0, 1.0], RESONANT, u)
        e = lfilter([1, 0.5], [1, -0.9], e)
        z = standard(u[300:], (y / y.std() + 0.3 * e / e.std())[300:])
        found = products([z], 1, 0, [1])
        assert found is not None
        alarms += found.p_value < 0.05
    assert alarms <= 11


@pytest.mark.parametrize("power", [2, 3])
def test_nonlinearity_test_sees_squares_and_cubes(power: int) -> None:
    random = np.random.default_rng(0)
    u = random.standard_normal(1500)
    y = lfilter([0, 1.0], [1, -0.8], u + 0.2 * u**power) + 0.1 * random.standard_normal(1500)
    found = products([standard(u, y)], 1, 0, [1])
    assert found is not None
    assert found.p_value < 1e-6
    assert found.gain > 0.1


@pytest.mark.system
@pytest.mark.parametrize("n", slow_but((1, 3), [1, 2, 3, 4]))
def test_order_guess_is_right_in_four_of_five_systems(n: int) -> None:
    """Modes that all matter: poles on a circle of radius 0.8, 1 % noise power."""
    right = 0
    for seed in range(10):
        random = np.random.default_rng([n, seed])
        angles = np.pi * (np.arange(n // 2) + random.uniform(0.4, 0.9, n // 2)) / max(1, n // 2)
        poles = np.concatenate([0.8 * np.exp(1j * angles), 0.8 * np.exp(-1j * angles), [0.7] * (n % 2)])
        u = random.standard_normal(1000)
        y = lfilter([0, 1.0], np.real(np.poly(poles)), u)
        z = standard(u, y + 0.1 * y.std() * random.standard_normal(1000))
        right += guess_order([z[:600]], [z[600:800]], 1).suggested == n
    assert right >= 8


def test_order_guess_does_not_look_at_the_last_fifth() -> None:
    u, y = plant(1000)
    first = examine({"u": u}, {"y": y})
    y[800:] = y[:800].mean() + 0.5 * np.random.default_rng(1).permutation(y[800:])
    u[800:] = np.random.default_rng(2).permutation(u[800:])
    second = examine({"u": u}, {"y": y})
    for one, two in zip(first.order.candidates, second.order.candidates, strict=True):
        assert two.val == pytest.approx(one.val, rel=1e-6)
    assert first.order.suggested == second.order.suggested == 2


# the split, and remarks


def test_split_avoids_an_input_at_rest_or_says_so() -> None:
    u, y = plant(1000)
    found = examine({"valve": u}, {"y": y})
    assert (found.split.rule, found.split.train[0].stop, found.split.val[0].stop) == (
        "60/20/20 in time order",
        600,
        800,
    )
    # at rest from 590 on: so is 60/20/20's validation part, not that of 50/30/20
    at_rest = examine({"valve": np.where(np.arange(1000) < 590, plant(1000)[0], 0.0)}, {"y": y})
    assert at_rest.split.rule == "50/30/20 in time order"
    assert any(remark.startswith("The split recommended is 50/30/20") for remark in at_rest.remarks)
    assert at_rest.split.warnings == ("input 'valve' is constant in the test part",)
    worse = examine({"valve": np.where(np.arange(1000) < 350, u, 0.0)}, {"y": y})
    assert any("input 'valve' is constant in the validation part" in remark for remark in worse.remarks)


def recommended(u: FloatArray, y: FloatArray) -> tuple[Any, ...]:
    found = examine({f"u{i}": column for i, column in enumerate(u.T)}, {"y": y})
    split = found.split
    return split.rule, split.train, split.val, split.test, found.init_window, found.orders


@pytest.mark.system
@pytest.mark.parametrize(("rest", "rule"), slow_but((0,), [(2000, "60/20/20"), (1190, "50/30/20"), (990, "40/40/20")]))
def test_what_the_test_part_holds_changes_no_recommendation(rest: int, rule: str) -> None:
    """A delay of its own, other levels, rest, missing and huge samples; for each split that may be recommended."""
    u = np.random.default_rng(1).standard_normal((2000, 2))
    y = lfilter([0, 1.0], RESONANT, u.sum(1)) + 0.1 * np.random.default_rng(2).standard_normal(2000)
    u[rest:] = 0.0
    expected = recommended(u, y)
    assert expected[0] == f"{rule} in time order"
    late = lfilter([0] * 30 + [50.0], [1, -0.5], np.random.default_rng(3).standard_normal(400))
    for name, inputs, output in (
        ("delay", np.random.default_rng(3).standard_normal((400, 2)), late), ("levels", 1e3, 500 + late),
        ("rest", 0.0, 3.0), ("missing", np.nan, np.nan), ("huge", 1.0, 1e300), ("one", u[:400], 1e12 * y[:400]),
    ):  # fmt: skip
        changed, other = u.copy(), y.copy()
        changed[1600:], other[1600:] = inputs, output
        assert recommended(changed, other) == expected, name


def test_ranges_beyond_the_training_part_are_told() -> None:
    u, y = plant(1000)
    y[900:] += 100
    found = examine({"u": u}, {"y": y})
    assert any(
        "samples of the test part lie outside the training range: 50 % of output 'y'" in remark
        for remark in found.remarks
    )


def test_several_experiments_are_split_whole() -> None:
    data = [plant(K, seed=K) for K in (400, 500, 600)]
    inputs, outputs = [{"u": u} for u, _ in data], [{"y": y} for _, y in data]
    found = examine(inputs, outputs, 0.1, [np.arange(len(u)) * 0.1 for u, _ in data])
    assert found.samples == (400, 500, 600)
    assert [part.experiment for part in (*found.split.train, *found.split.val, *found.split.test)] == [0, 1, 2]
    assert found.delays[0].samples == 1
    assert found.delays[0].seconds == pytest.approx(0.1)
    two = examine(inputs[:2], outputs[:2])
    assert (two.split.train[0].stop, two.split.val[0].start, two.split.test[0].experiment) == (300, 300, 1)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"u": np.ones(900)}, "The input 'u' is constant."),
        ({"u": np.where(np.arange(900) < 450, 0.0, 1.0)}, "The input 'u' changes only 1 time."),
        ({"u": np.sin(0.3 * np.arange(900))}, "The input 'u' is persistently exciting of order 2 only"),
        ({"y": np.full(900, np.nan)}, "The output 'y' holds no number."),
        ({"y": np.random.default_rng(5).standard_normal(900)}, "No response of 'y' to 'u' within"),
        ({"y": np.random.default_rng(5).standard_normal(900)}, "of the power of 'y' unexplained, an upper figure"),
        ({"y": np.linspace(0, 1, 900)}, "A straight line over the training part holds 100 % of the variance"),
        ({"y": np.clip(plant(900)[1], -1.0, None)}, "of the output 'y' is exactly its minimum -1"),
        ({"y": plant(900)[1] + np.where(np.arange(900) == 5, 40, 0)}, "1 single-sample spike, the first at sample 6."),
        ({"y": np.round(plant(900)[1], 0)}, "The output 'y' is quantised in steps of 1 "),
        ({"y": plant(900, bend=0.5)[1]}, "(p < 1e-16): it is nonlinear"),
        ({"y": np.where(np.arange(900) < 540, 1, -1) * plant(900)[1]}, "better than a constant would"),
        ({"y": lfilter([1.0], [1, -1.98, 0.9801], plant(900)[0])}, "sampled faster than it needs"),
    ],
)  # fmt: skip
def test_remarks_that_are_due(change: dict[str, FloatArray], sentence: str) -> None:
    u, y = plant(900)
    plain = examine({"u": u}, {"y": y}, 0.1)
    changed = {"u": u, "y": y} | change
    found = examine({"u": changed["u"]}, {"y": changed["y"]}, 0.1)
    assert any(sentence in remark for remark in found.remarks), found.remarks
    assert not any(sentence in remark for remark in plain.remarks), plain.remarks
    check_plain(found)


def test_remarks_on_the_clock() -> None:
    u, y = plant(300)
    t = np.arange(300) * 0.1
    t[200:] += 5.0
    found = examine({"u": u}, {"y": y}, 0.2, t)
    text = " ".join(found.remarks)
    assert "1 gap (over 1.5 times the median step), the first before sample 201." in text
    assert "The given Ts of 0.2 s is not the time column's usual step of 0.1 s." in text
    assert "The sampling time is not known" in " ".join(examine({"u": u}, {"y": y}).remarks)


def test_missing_samples_leave_complete_stretches() -> None:
    u, y = plant(1500, delay=4)
    y[[200, 700, 701]] = np.nan
    found = examine({"u": u}, {"y": y})
    assert found.delays[0].samples == 4
    assert found.used[0] == "dynamics: 1497 of 1500 samples, in stretches of at least 20 without a missing sample"
    assert "The output 'y' misses 3 of 1500 samples, at most 2 in a row." in found.remarks


# records that nobody wants

SIGNAL = st.one_of(
    hnp.arrays(np.float64, st.integers(0, 60), elements=st.floats(allow_nan=False, allow_infinity=False)),
    hnp.arrays(np.float64, st.integers(0, 60), elements=st.sampled_from([0.0, 1.0, -1e308, 1.7e308, 5e-324, np.nan])),
    st.integers(0, 250).map(lambda K: np.random.default_rng(K).standard_normal(K)),
)


@settings(max_examples=60)
@given(st.lists(SIGNAL, max_size=4), st.integers(0, 4), st.sampled_from([None, 1e-9, 3.0]), st.booleans())
def test_any_record_is_inspected(columns: list[FloatArray], r: int, Ts: float | None, timed: bool) -> None:
    K = min((len(column) for column in columns), default=0)
    named = {f"c{i}": column[:K] for i, column in enumerate(columns)}
    inputs = dict(list(named.items())[:r])
    outputs = {name: x for name, x in named.items() if name not in inputs}
    found = examine(inputs, outputs, Ts, next(iter(named.values())) if timed and named else None)
    check_plain(found)
    assert found.init_window >= 1
    parts = [(p.start, p.stop) for p in (*found.split.train, *found.split.val, *found.split.test)]
    assert sum(stop - start for start, stop in parts) == K


def test_inputs_are_not_changed() -> None:
    u, y = plant(200)
    before = u.copy(), y.copy()
    examine({"u": u}, {"y": y})
    np.testing.assert_array_equal(u, before[0])
    np.testing.assert_array_equal(y, before[1])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (({"u": np.ones(3)}, {"y": np.ones(4)}), "columns of one length"),
        (({"u": np.ones((3, 2))}, {"y": np.ones(3)}), "column 'u': expected one column"),
        (({"u": ["a", "b"]}, {"y": np.ones(2)}), "column 'u': expected numbers"),
        (({"u": np.ones(3)}, {"y": np.ones(3)}, -1.0), "Ts: expected a positive"),
        (({"u": np.ones(3)}, {"y": np.ones(3)}, None, np.ones(2)), "columns of one length"),
        (([{"u": np.ones(3)}, {"v": np.ones(3)}], [{"y": np.ones(3)}] * 2), "experiment 2: expected the channels u, y"),
        (([{"u": np.ones(3)}], [{"y": np.ones(3)}] * 2), "equally many"),
    ],
)
def test_what_is_no_record_is_one_line(arguments: tuple[Any, ...], said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        examine(*arguments)
    assert "\n" not in str(error.value)


@pytest.mark.system
def test_a_million_rows_take_seconds_and_say_what_was_used() -> None:
    random = np.random.default_rng(0)
    u = random.standard_normal((1_000_000, 2))
    u[:200_000] *= 1e-6  # at rest first
    y = lfilter([0, 1.0], [1, -0.9], u, axis=0) + 0.1 * random.standard_normal((1_000_000, 2))
    start = time.process_time()
    found = examine({"a": u[:, 0], "b": u[:, 1]}, {"y": y[:, 0], "z": y[:, 1]}, 0.1)
    assert time.process_time() - start < 6  # 1.8 s on an idle core; this is for one shared by others
    assert found.used[:2] == (
        "spectra and coherence: 131072 of 1000000 samples, where the inputs vary most",
        "delays: 131072 of 800000 samples, where the inputs vary most",
    )
    assert found.used[2].startswith("order: 4000 samples")
    assert [d.samples for d in found.delays if (d.input, d.output) in (("a", "y"), ("b", "z"))] == [1, 1]
