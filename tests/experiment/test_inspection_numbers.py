"""What an inspection computes, on signals whose answers are known by hand, and the lengths at which it gives up."""

import math
from dataclasses import replace

import numpy as np
import pytest
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import FloatArray, Record
from scipy.signal import butter, csd, lfilter

from nnss_cli.experiment.inspection import examine
from nnss_cli.experiment.inspection_dynamics import (
    LEVEL,
    Spectra,
    _f_test,
    _first,
    _size,
    band,
    excerpt,
    feedback,
    multiple_coherence,
    products,
    responses,
    welch,
)
from nnss_cli.experiment.inspection_order import HOW_GUESSED, _hankel, _horizons, _left, guess_order
from nnss_cli.experiment.inspection_signals import (
    Channel,
    examine_channel,
    examine_clock,
    find_copies,
    persistency,
    with_trend,
)
from nnss_cli.experiment.inspection_split import Part, recommend_split


def noise(*shape: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(shape)


# spectra and coherence


def test_the_spectrum_of_white_noise_is_2_and_1_at_both_ends() -> None:
    """One-sided: 2 σ² a cycle a sample, but zero and the Nyquist frequency have no negative twin."""
    ends, between = [], []
    for seed in range(5):
        found = welch([noise(20_000, 1, seed=seed)], 1)
        assert found is not None
        power = found.density[:, 0, 0].real
        ends.append(power[[0, -1]])
        between.append(power[5:-5].mean())
    assert np.mean(ends) == pytest.approx(1, abs=0.2)
    assert np.mean(between) == pytest.approx(2, abs=0.04)


@pytest.mark.parametrize(
    ("K", "inputs", "segment", "segments"),
    # ten samples start the whitening filters (fewer of a short record); eight segments at least, more for more inputs
    [(4000, 1, 512, 14), (4000, 3, 256, 30), (300, 1, 64, 8), (100_000, 1, 2048, 96), (40, 1, 8, 8), (16, 1, 8, 3)],
)
def test_segments_are_as_long_as_eight_of_them_allow(K: int, inputs: int, segment: int, segments: int) -> None:
    found = welch([noise(K, 2)], inputs)
    assert found is not None
    assert (found.segment, found.frequency[-1], len(found.frequency)) == (segment, 0.5, segment // 2 + 1)
    assert found.averages == pytest.approx(segments / (1 + 2 / 36 * (1 - 1 / segments)))
    assert found.density.shape == (segment // 2 + 1, 2, 2)


@pytest.mark.parametrize("K", [40, 300, 333, 5000])
def test_without_whitening_the_spectrum_is_scipys(K: int) -> None:
    x, order = noise(K, 2), min(10, K // 20)  # so many samples start the filters
    found = welch([x], 1, flatten=False)
    assert found is not None
    known = {"nperseg": found.segment, "noverlap": found.segment // 2, "detrend": False}
    for i, j in ((0, 0), (1, 1), (0, 1)):
        f, expected = csd(x[order:, j], x[order:, i], **known)
        np.testing.assert_allclose(found.density[:, i, j], expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(found.frequency, f)


def test_fifteen_samples_have_no_spectrum() -> None:
    assert welch([noise(15, 2)], 1) is None
    assert welch([], 1) is None


def test_a_delay_turns_the_phase_of_the_cross_spectrum() -> None:
    u = noise(20_002)
    found = welch([np.stack([u[2:], u[:-2]], axis=1)], 1)  # y(k) = u(k−2)
    assert found is not None
    turned = np.angle(found.density[:, 1, 0] * np.exp(2j * np.pi * found.frequency * 2))
    assert np.abs(turned[2:-2]).max() < 0.2


def test_the_band_leaves_the_same_power_below_and_above() -> None:
    f, flat = np.arange(100) / 200, np.ones(100)
    assert band(f, flat) == (0.01, 0.485)  # 2.5 of 100 lines on either side
    assert band(f, flat, 0.5) == (0.12, 0.37)
    assert band(f, np.eye(100)[40]) == (0.2, 0.2)


def spectra(S: FloatArray, averages: float, lines: int = 5) -> Spectra:
    return Spectra(np.arange(lines) / 8, np.tile(S.astype(complex), (lines, 1, 1)), 8, averages)


def test_multiple_coherence_is_the_textbooks_with_the_bias_of_few_averages_removed() -> None:
    S = np.array([[1.0, 0.6], [0.6, 1.0]])  # γ² = 0.36
    curve, left = multiple_coherence(spectra(S, 10), 1, 0)
    assert left == pytest.approx(0.64 * 10 / 9)
    assert curve == pytest.approx([1 - 0.64 * 10 / 9] * 5)
    joint = np.array([[1.0, 0.5, 0.6], [0.5, 1.0, 0.6], [0.6, 0.6, 1.0]])  # Suy' Suu⁻¹ Suy = 0.48
    assert multiple_coherence(spectra(joint, 12), 2, 0)[1] == pytest.approx(0.52 * 12 / 10)
    assert multiple_coherence(spectra(np.eye(2), 10), 1, 0)[1] == 1.0  # no more than everything
    twice = np.array([[1.0, 1.0, 0.6], [1.0, 1.0, 0.6], [0.6, 0.6, 1.0]])  # an input and its copy
    assert multiple_coherence(spectra(twice, 12), 2, 0)[1] == pytest.approx(0.64 * 12 / 10)


def test_multiple_coherence_takes_the_output_that_is_asked_for_and_leaves_out_the_mean() -> None:
    S = np.array([[1.0, 0.6, 0.8], [0.6, 1.0, 0.3], [0.8, 0.3, 1.0]])
    found = spectra(S, 1e9)
    assert [multiple_coherence(found, 1, i)[1] for i in (0, 1)] == pytest.approx([0.64, 0.36])
    found.density[0, 1, 1] = 1e6  # power at f = 0 is the mean's
    found.density[1, 0, 1] = found.density[1, 1, 0] = 1.0  # one line of four is explained
    assert multiple_coherence(found, 1, 0)[1] == pytest.approx(0.75 * 0.64)


@pytest.mark.parametrize(("averages", "known"), [(4.0, False), (4.01, True)])
def test_coherence_needs_more_averages_than_twice_the_inputs_and_two(averages: float, known: bool) -> None:
    curve, left = multiple_coherence(spectra(np.eye(2), averages), 1, 0)
    assert (left is not None) is known
    assert known or not curve.any()


def test_without_inputs_or_without_power_there_is_no_coherence() -> None:
    assert multiple_coherence(spectra(np.eye(2), 100), 0, 0)[1] is None
    assert multiple_coherence(spectra(np.diag([1.0, 0.0]), 100), 1, 0)[1] is None


# responses and products


@pytest.mark.parametrize(
    ("K", "lags", "rows", "columns"),
    # past outputs, lags and the output: a quarter of the samples at most
    [(1500, 50, 1450, 72), (200, 32, 168, 16 + 33 + 1), (40, 5, 35, 10), (16, 1, 15, 4)],
)
def test_the_bound_of_one_lag_is_that_of_the_degrees_of_freedom(K: int, lags: int, rows: int, columns: int) -> None:
    (found,) = responses([noise(K, 2)], 1, 0)
    assert (len(found.correlation), found.samples) == (lags + 1, rows)
    assert found.bound == pytest.approx(LEVEL / math.sqrt(rows - columns))


def test_fifteen_samples_show_no_response() -> None:
    assert responses([noise(15, 2)], 1, 0) == []


@pytest.mark.parametrize("gain", [0.5, -0.5])
def test_the_correlation_is_that_of_input_and_output_with_its_sign(gain: float) -> None:
    u, e = noise(2, 20_000)
    (found,) = responses([np.stack([u, lfilter([0, 0, gain], [1.0], u) + e], axis=1)], 1, 0)
    assert found.correlation[2] == pytest.approx(gain / math.hypot(gain, 1), abs=0.02)
    assert np.abs(np.delete(found.correlation, 2)).max() < 0.04
    assert (found.delay, found.smooth) == (2, False)


def test_a_response_belongs_to_the_output_asked_for_and_every_stretch_is_used() -> None:
    u, e = noise(2, 900)
    data = np.stack([u, e, lfilter([0, 0, 0, 1.0], [1.0], u) + 0.1 * e], axis=1)
    apart = [data[:300], data[300:600], data[600:]]
    assert [responses(apart, 1, output)[0].delay for output in (0, 1)] == [None, 3]
    assert responses(apart, 1, 1)[0].samples == 900 - 3 * 50


@pytest.mark.parametrize(("K", "samples"), [(407, None), (408, 400), (700, 686), (1000, 980), (90, None)])
def test_products_are_tested_on_sixteen_rows_a_column(K: int, samples: int | None) -> None:
    found = products([noise(K, 2)], 1, 0, [1])
    assert (found and found.samples) == samples


def test_products_explain_nothing_of_noise_and_all_of_a_square() -> None:
    u, e = noise(2, 2000)
    null = products([np.stack([u, e], axis=1)], 1, 0, [1])
    assert null is not None
    assert null.gain < 0.01
    assert null.p_value > 0.01
    y = lfilter([0, 1.0], [1.0], u**2 - 1)
    assert (bent := products([np.stack([u, y + y.std() * e], axis=1)], 1, 0, [1])) is not None
    assert bent.gain == pytest.approx(0.5, abs=0.06)  # half of the power is noise
    wrong = products([np.stack([u, lfilter([0] * 6 + [1.0], [1.0], u**2 - 1) + e], axis=1)], 1, 0, [1])
    assert wrong is not None
    assert wrong.gain < 0.05  # the square of another lag


def test_a_share_explained_is_beyond_what_random_columns_would() -> None:
    """Residual variances with and without the columns are compared, not squares, which fall with any column."""
    shares = []
    for seed in range(300):
        X, y = noise(60, 12, seed=seed), noise(60, seed=1000 + seed)
        found = _f_test(np.linalg.qr(np.column_stack([X, y]), mode="r"), 3, 60)
        assert found is not None
        before, after = (float(np.linalg.lstsq(X[:, :k], y)[1][0]) / (60 - k) for k in (3, 12))
        assert found[0] == pytest.approx(max(0.0, 1 - after / before), rel=1e-9, abs=1e-12)
        shares.append(1 - after / before)
    assert np.mean(shares) == pytest.approx(0, abs=0.02)  # where nine of 57 squares are 0.16


def test_a_product_of_output_and_input_is_seen() -> None:
    u, e = noise(2, 3000)
    y = np.zeros(3000)
    for k in range(1, 3000):
        y[k] = 0.4 * y[k - 1] * u[k - 1] + e[k]
    found = products([np.stack([u, y], axis=1)], 1, 0, [1])
    assert found is not None
    assert found.p_value < 1e-10


@pytest.mark.parametrize("kind", ["white", "filtered", "held"])
def test_no_input_follows_outputs_in_open_loop_at_the_level(kind: str) -> None:
    """Four of 60 would be below 1 % by a chance of 0.3 %: feedthrough, delays, slow plants, white and other noise."""
    plants = (([0, 0.02], [1, -0.98]), ([0, 1.0], [1, -1.5, 0.7]), ([1, 0.3], [1, -0.9]), ([0] * 6 + [1.0], [1, -0.8]))
    alarms = 0
    for seed in range(60):
        e, v = noise(2, 1000, seed=seed)
        u = {"white": v, "filtered": lfilter(*butter(4, 0.2), v), "held": np.repeat(v[:250], 4)}[kind]
        y = lfilter(*plants[seed % 4], u)
        e = lfilter([1.0], [1, -0.9 * (seed % 2)], e)
        found = feedback([np.stack([u / u.std(), y / y.std() + 0.2 * e / e.std()], axis=1)[200:]], 1, 0)
        assert found is not None
        alarms += found.p_value < 0.01
    assert alarms <= 3


def loop(late: int, seed: int = 0, K: int = 800) -> FloatArray:
    """u(k) = −0.8 y(k − late) and some excitation; the plant needs two samples."""
    e, d, w = 0.02 * noise(3, K, seed=seed)
    x, u, y = np.zeros(2), np.zeros(K), np.zeros(K)
    for k in range(K):
        y[k] = x[0] + e[k]
        u[k] = d[k] - 0.8 * y[max(0, k - late)]
        x = np.array([0.9 * x[0] + 0.2 * x[1] + w[k], -0.1 * x[0] + 0.7 * x[1] + 0.3 * u[k]])
    return np.stack([u / u.std(), y / y.std()], axis=1)


@pytest.mark.parametrize("late", [0, 1, 5])
def test_an_input_that_follows_outputs_is_seen(late: int) -> None:
    for seed in range(5):
        found = feedback([loop(late, seed)], 1, 0)
        assert found is not None
        assert found.p_value < 1e-3
        assert found.gain > 0.02
    other = np.column_stack([noise(800, seed=9), loop(late)])  # of two inputs it is the second
    first, second = (feedback([other[:400], other[400:]], 2, which) for which in (0, 1))
    assert first is not None
    assert second is not None
    assert first.p_value > 0.01 > 1e-3 > second.p_value


def test_an_input_that_changes_seldom_or_is_foretold_shows_no_feedback() -> None:
    e = noise(800)
    assert feedback([np.stack([np.repeat(e[:40], 20), e], axis=1)], 1, 0) is None
    assert feedback([np.stack([np.sin(0.3 * np.arange(800)), e], axis=1)], 1, 0) is None
    assert feedback([], 1, 0) is None
    assert feedback([e[:, None]], 1, 0) is None  # no output
    found = feedback([np.stack([np.repeat(e[:200], 4), e], axis=1)], 1, 0)
    assert found is not None
    assert found.samples == 198  # of 199 changes: one lies within the six lags


def test_an_excerpt_is_where_the_inputs_vary_most_in_time_order() -> None:
    k = np.arange(100.0)
    quiet, loud = np.stack([np.zeros(100), k], axis=1), np.stack([(-1) ** k, k], axis=1)
    parts = [quiet, loud, quiet, 0.5 * loud]
    assert [len(part) for part in excerpt(parts, 400, 1)] == [100] * 4
    assert excerpt([*parts, loud[:19]], 400, 1)[3] is parts[3]
    kept = excerpt(parts, 200, 1)
    assert len(kept) == 2
    assert np.array_equal(kept[0], loud)
    assert np.array_equal(kept[1], 0.5 * loud)
    assert [len(part) for part in excerpt(parts, 150, 1)] == [100, 50]
    assert [len(part) for part in excerpt(parts, 119, 1)] == [100]  # what is left is no stretch
    first = [np.stack([(-1) ** k, 0 * k], axis=1), np.stack([0 * k, 3 * (-1) ** k], axis=1)]
    assert excerpt(first, 100, 1)[0] is not first[1]
    assert np.array_equal(excerpt(first, 100, 1)[0], first[0])
    assert np.array_equal(excerpt(first, 100, 0)[0], first[1])  # without inputs the outputs count


# columns


def test_a_column_of_twelve_samples_counted_by_hand() -> None:
    x = np.array([0, 0, 0, 1, 2, 3, 3, 3, 3, np.nan, 1, 2])
    found = with_trend(examine_channel("level", "output", "m", [x]), [(np.arange(12.0), x)])
    assert found == Channel(
        "level", "output", "m", 12, 1, 1, 0.0, 3.0, 18 / 11, found.sigma, 4, "few levels", 4,
        1.0, 1.0, 2.0, 3 / 11, 4 / 11, 0.0, None, None, None, found.trend, found.trend_share,
    )  # fmt: skip
    assert found.sigma == pytest.approx(np.nanstd(x, ddof=1))
    known = np.flatnonzero(np.isfinite(x))
    slope = np.polyfit(known, x[known], 1)[0]
    assert found.trend == pytest.approx(11 * slope / found.sigma)
    assert found.trend_share == pytest.approx(np.corrcoef(known, x[known])[0, 1] ** 2)


def test_columns_without_much_in_them() -> None:
    one = examine_channel("x", "input", "V", [np.array([5.0, np.nan])])
    assert (one.kind, one.mean, one.sigma, one.levels, one.samples, one.missing) == ("constant", 5.0, None, 1, 2, 1)
    same = examine_channel("x", "input", "V", [np.full(4, -2.0)])
    assert (same.sigma, same.minimum, same.at_minimum, same.switches, same.step) == (0.0, -2.0, 1.0, 0, None)
    none = examine_channel("x", "input", "V", [])
    assert (none.kind, none.samples, none.longest_gap, none.minimum, none.at_minimum) == ("empty", 0, 0, None, 0.0)
    two = examine_channel("x", "input", "V", [np.array([0.0, 1.0])])
    assert (two.trend, two.trend_share, two.kind, two.bits) == (None, None, "two levels", 1.0)


@pytest.mark.parametrize(("levels", "kind"), [(16, "few levels"), (17, "continuous"), (2, "two levels")])
def test_sixteen_levels_are_few_and_have_no_spikes(levels: int, kind: str) -> None:
    x = np.random.default_rng(0).permutation(np.repeat(np.arange(float(levels)), 9))
    found = examine_channel("x", "input", "V", [x])
    assert (found.kind, found.levels, found.step) == (kind, levels, 1.0)
    assert found.spikes == (None if levels <= 16 else 0)


@pytest.mark.parametrize(("changes", "kind"), [(20, "continuous"), (19, "steps")])
def test_a_signal_of_steps_stays_more_often_than_it_changes(changes: int, kind: str) -> None:
    x = np.cumsum([0.0, *[1.0] * changes, *[0.0] * (40 - changes)])
    found = examine_channel("x", "input", "V", [x])
    assert (found.kind, found.switches) == (kind, changes)


@pytest.mark.parametrize(("height", "spikes"), [(21.6, 0), (21.8, 1), (-25.6, 0), (-25.8, 1)])
def test_a_spike_exceeds_eight_robust_deviations_on_both_flanks(height: float, spikes: int) -> None:
    # differences of −2, 2 and 0 about 0.01: their MAD is 2, so eight deviations are 23.72
    x = np.cumsum(np.tile([-2.0, 2.0, -2.0, 2.0, 0.0], 40) + 0.01)
    x[101] += height  # between differences of 2 and −2
    found = examine_channel("x", "output", "m", [x])
    assert (found.spikes, found.first_spike) == (spikes, 101 if spikes else None)


def test_a_step_is_no_spike() -> None:
    x = np.cumsum(np.tile([-3.0, -1.0, 1.0, 3.0], 50) + 0.01)
    x[101:] += 500.0
    assert examine_channel("x", "output", "m", [x]).spikes == 0
    x[102:] += 500.0  # two steps one after the other, in the same direction
    assert examine_channel("x", "output", "m", [x]).spikes == 0


def test_huge_and_tiny_columns_keep_their_numbers() -> None:
    for scale in (1e-150, 1e150):
        x = scale * np.arange(20.0)
        found = examine_channel("x", "output", "m", [x])
        assert (found.minimum, found.maximum) == (0.0, pytest.approx(19 * scale))
        assert (found.mean, found.step) == (pytest.approx(9.5 * scale), pytest.approx(scale))
        assert found.sigma == pytest.approx(scale * np.arange(20).std(ddof=1))
        assert found.levels == 20


def test_the_clock_of_a_good_time_column_is_its_step() -> None:
    found = examine_clock(None, [np.array([0, 0.1, 0.2, 0.3]), np.array([5.0, 5.1, 5.2])])
    assert found.source == "time column"
    assert found.Ts == pytest.approx(0.1)
    assert (found.gaps, found.first_gap, found.first_gap_experiment, found.unreadable) == (0, None, None, 0)
    assert examine_clock(0.5, [np.array([0.0, 1.0])]).source == "given"
    nothing = examine_clock(None, [])
    assert (nothing.Ts, nothing.source, nothing.jitter, nothing.duplicates) == (None, "unknown", None, 0)


@pytest.mark.parametrize(("step", "gaps"), [(1.5, 0), (1.51, 1)])
def test_a_gap_is_longer_than_one_and_a_half_steps(step: float, gaps: int) -> None:
    t = np.cumsum([0, 1, 1, 1, step, 1, 1])
    found = examine_clock(None, [t])
    assert found.gaps == gaps
    assert found.first_gap == (4 if gaps else None)
    assert found.first_gap_experiment == (0 if gaps else None)
    assert found.jitter == pytest.approx(step - 1)


def test_instants_that_are_none_are_counted_and_left_out() -> None:
    found = examine_clock(None, [np.array([0, 1, np.nan, 3, 1e100, 5, 6, -np.inf])])
    assert (found.unreadable, found.Ts, found.gaps) == (3, 1.0, 0)


def test_copies_need_three_rows_and_a_millionth_of_sigma() -> None:
    u = noise(500)
    assert find_copies(["a", "b"], np.stack([u, u], axis=1)[:2]) == ()
    assert len(find_copies(["a", "b"], np.stack([u, u], axis=1)[:3])) == 1
    for distance, count in ((0.5e-6, 1), (3e-6, 0)):
        other = u + distance * u.std() * noise(500, seed=1)
        assert len(find_copies(["a", "b"], np.stack([u, other], axis=1))) == count
    (affine,) = find_copies(["a", "b"], np.stack([1e200 * u, 7 - 1e-3 * u], axis=1))
    assert (affine.equal, affine.gain, affine.offset) == (False, pytest.approx(-1e-203), pytest.approx(7))


# how an input excites


@pytest.mark.parametrize(
    ("K", "r", "largest"), [(500, 1, 50), (99, 1, 50), (97, 1, 49), (1, 1, 1), (500, 5, 40), (500, 2, 50), (30, 2, 10)]
)
def test_the_largest_order_looked_at_is_what_the_windows_allow(K: int, r: int, largest: int) -> None:
    found = persistency([noise(K, r)])
    assert (found.largest, found.samples, found.order) == (largest, K, largest)


def test_of_no_samples_nothing_is_excited_and_stretches_add_up() -> None:
    assert (persistency([]).order, persistency([]).largest) == (0, 0)
    assert (persistency([noise(0, 1)]).order, persistency([noise(0, 1)]).samples) == (0, 0)
    found = persistency([noise(40, 1), noise(20, 1), noise(3, 1)])
    assert (found.largest, found.samples) == (20, 63)


def test_power_near_the_nyquist_frequency_is_a_share() -> None:
    k = np.arange(4096)
    u = 3 * np.sin(2 * np.pi * 0.1 * k) + np.sin(2 * np.pi * 0.45 * k)
    found = examine({"u": u}, {"y": noise(4096)}, 0.5)
    (each,) = found.excitation
    assert each.near_nyquist == pytest.approx(0.1, abs=0.01)
    assert each.band == pytest.approx((0.2, 0.9), abs=0.02)  # Hz
    assert examine({"u": u}, {"y": noise(4096)}).excitation[0].band == pytest.approx((0.1, 0.45), abs=0.01)


# the record as a whole


def test_the_spectrum_is_a_density_in_hertz() -> None:
    for Ts in (None, 0.01):
        found = examine({"u": noise(3000)}, {"y": noise(3000, seed=1)}, Ts)
        assert found.spectrum is not None
        f = np.array(found.spectrum.frequency)
        assert f[-1] == pytest.approx(0.5 / (Ts or 1))
        assert f[0] > 0
        for density in found.spectrum.density:
            assert np.trapezoid(density, f) == pytest.approx(1, rel=0.1)
        assert found.spectrum.channels == ("u", "y")


def test_a_curve_over_time_has_at_most_500_points_of_smallest_and_largest() -> None:
    x = np.arange(1001.0)
    x[4] = np.nan
    found = examine({}, {"y": x}, 0.5).envelopes[0]
    assert (found.channel, len(found.time), found.time[1]) == ("y", 334, 1.5)
    assert (found.low[:2], found.high[:2], found.low[-1]) == ((0.0, 3.0), (2.0, 5.0), 999.0)
    whole = examine({}, {"y": x[:500]}).envelopes[0]
    assert (len(whole.time), whole.time[1], whole.low[4]) == (500, 1.0, None)


def test_orders_and_initialisation_window_follow_order_delay_and_length() -> None:
    u = noise(3000)
    for K in (3000, 400):
        y = lfilter([0, 0, 0, 1.0], [1, -1.5, 0.7], u)[:K]
        found = examine({"u": u[:K]}, {"y": y + 0.05 * y.std() * noise(K, seed=2)}, 0.2)
        assert found.orders == tuple(range(found.order.suggested - 1, found.order.suggested + 2))
        delay = found.delays[0].samples or 0
        assert delay == 3
        assert found.delays[0].seconds == pytest.approx(0.6)
        assert found.init_window == min(50, 4 * found.order.suggested + delay, K // 50)


def test_a_column_counts_while_no_more_than_half_of_it_is_missing() -> None:
    u, y = noise(2, 400)
    for missing, outputs in ((160, 1), (161, 0)):  # of the training and validation parts
        z = y.copy()
        z[:missing] = np.nan
        assert len(examine({"u": u}, {"z": z}).linearity) == outputs


def test_inputs_are_judged_together_where_there_are_two_that_vary() -> None:
    u, v, y = noise(3, 400)
    assert examine({"u": u}, {"y": y}).joint is None
    assert examine({"u": u, "v": np.ones(400)}, {"y": y}).joint is None
    joint = examine({"u": u, "v": v}, {"y": y}).joint
    assert joint is not None
    assert joint.order == joint.largest == 50


def test_of_a_plant_that_climbs_from_rest_the_order_is_found() -> None:
    """About the mean of the part it is fitted on, around which it does not move, no order fits."""
    u = np.repeat([0.0, 5, 5, 8, 3, 6, 1, 4], 100)
    x = np.zeros((800, 2))
    for k in range(799):
        x[k + 1] = [0.97 * x[k, 0] + 0.03 * u[k], 0.95 * x[k, 1] + 0.05 * x[k, 0]]
    z = np.column_stack([u, x[:, 1] + 0.002 * np.random.default_rng(0).standard_normal(800)])
    found = guess_order([z[:500]], [z[500:]], 1)
    assert found.suggested == 2
    assert found.candidates[1].val < 0.05
    assert guess_order([z[:500]], [z[500:]], 1, about_means=True).candidates[1].val > 0.1
    columns = {"u": z[:, 0]}, {"y": z[:, 1]}
    about = [examine(*columns, detrend=detrend).order.candidates[1].val for detrend in ("none", "constant")]
    assert about[1] > 1.4 * about[0]
    deviation = z[:500, 1].std(ddof=1)
    assert found.constant == pytest.approx(np.sqrt(np.mean((z[500:, 1] - z[:500, 1].mean()) ** 2)) / deviation)


def test_guess_order_says_what_it_fitted_on_and_what_a_constant_would_do() -> None:
    u = noise(900)
    y = lfilter([0, 1.0], [1, -0.8], u) + 0.05 * noise(900, seed=1)
    data = np.stack([u, y], axis=1)
    found = guess_order([data[:600]], [data[600:800]], 1)
    assert (found.train_samples, found.val_samples, found.suggested) == (600, 200, 1)
    scaled = (data[600:800, 1] - data[:600, 1].mean()) / data[:600, 1].std(ddof=1)
    assert found.constant == pytest.approx(math.sqrt(np.mean(scaled**2)))
    assert [c.order for c in found.candidates] == [1, 2, 3, 4, 5, 6]
    hankel = [c.hankel for c in found.candidates]
    assert hankel[0] == 1.0
    assert hankel == sorted(hankel, reverse=True)
    assert hankel[1] < 0.2
    noisy = 0.05 / data[:600, 1].std()
    assert found.candidates[0].val == pytest.approx(noisy, rel=0.3)
    assert found.candidates[0].train == pytest.approx(noisy, rel=0.3)
    assert f"N4SID, {len(_horizons(2, 1, 1))} horizons" in HOW_GUESSED
    nothing = guess_order([data[:19]], [data[600:800]], 1)
    assert (nothing.suggested, nothing.candidates, nothing.constant) == (None, (), None)
    assert (nothing.train_samples, nothing.val_samples) == (0, 200)


@pytest.mark.system
def test_what_models_leave_is_of_the_samples_asked_for_and_counts_the_starts() -> None:
    u, e = noise(2, 3000)
    y = lfilter([0, 1.0], [1, -0.8], u)
    data = np.stack([u, y + 0.5 * y.std() * e, e], axis=1)
    parts = [data[:1500]], [data[1500:2000]], 1, False
    first, second = guess_order(*parts, [data[2000:]]).left
    assert first == pytest.approx(0.2, abs=0.03)  # 0.5²/(1 + 0.5²)
    assert second == pytest.approx(1, abs=0.05)
    short = [data[at : at + 20] for at in range(2000, 3000, 20)]
    assert guess_order(*parts, short).left == pytest.approx((first, second), abs=0.06)
    assert guess_order(*parts).left == ()
    assert guess_order(*parts, [data[2000:2001]]).left == (None, None)  # its start alone explains one sample


def test_what_a_model_leaves_of_short_stretches_counts_the_starts() -> None:
    """Two states, fitted to each twenty samples of noise, explain a tenth of it by chance."""
    turning = np.array([[0.95, 0.3], [-0.3, 0.95]])
    model = LinearStateSpace(turning, np.zeros((2, 1)), np.array([[1.0, 0.0]]), np.zeros((1, 1)), 1.0)
    signals = noise(100, 2, 20, 1)
    assert _left([model], [Record(u, y, 1.0) for u, y in signals]) == (pytest.approx(1, abs=0.04),)
    assert _left([model], [Record(u[:2], y[:2], 1.0) for u, y in signals]) == (None,)  # all of it


# the split


def split_of(x: FloatArray, role: str = "output") -> tuple[str, tuple[str, ...], int]:
    channel = replace(examine_channel("y", "output", "m", [x]), role=role)
    found = recommend_split([x[:, None]], [channel])
    return found.rule, found.warnings, found.test[0].start


@pytest.mark.parametrize(
    ("beyond", "rule", "warned"),
    [
        (4, "60/20/20", "2 %"), (5, "60/20/20", "2.5 %"), (20, "60/20/20", "10 %"), (21, "50/30/20", "7 %"),
        (30, "50/30/20", "10 %"), (31, "40/40/20", "7.8 %"), (40, "40/40/20", "10 %"), (41, "60/20/20", "20 %"),
    ],
)  # fmt: skip
def test_another_split_is_recommended_when_a_tenth_of_validation_is_out_of_range(
    beyond: int, rule: str, warned: str | None
) -> None:
    x = np.random.default_rng(0).uniform(0, 1, 1000)
    x[:400:20], x[1:400:20] = 0, 1
    x[800 - beyond : 800] = np.where(np.arange(beyond) % 2, 2, -2)
    x[800:] = 7.0  # neither the range nor the rest of the test part has a say
    found, warnings, start = split_of(x)
    assert found == f"{rule} in time order"
    assert start == 800
    validation = [said for said in warnings if "validation part" in said]
    if beyond == 4:  # no more than 2 %
        assert validation == []
    else:
        assert validation == [f"samples of the validation part lie outside the training range: {warned} of output 'y'"]
    assert warnings[0] == "output 'y' is constant in the test part"


def test_a_test_part_out_of_range_takes_no_split_away() -> None:
    """It is beyond what 50 % of the record show, not beyond 60 %; a tenth of the last fifth but one is beyond both."""
    x = np.random.default_rng(0).uniform(0, 1, 1000)
    x[550:552] = 5, -5
    x[779:800] = np.where(np.arange(21) % 2, 6, -6)
    x[800:] = np.where(np.arange(200) % 2, 4, -4)
    assert split_of(x)[0] == "50/30/20 in time order"


def test_a_split_covers_every_sample_once() -> None:
    for K, at in ((999, (599, 799)), (7, (4, 6)), (0, ())):
        found = recommend_split([noise(K, 1)], [examine_channel("y", "output", "m", [noise(K)])])
        parts = [*found.train, *found.val, *found.test]
        assert parts == ([Part(0, 0, at[0]), Part(0, at[0], at[1]), Part(0, at[1], K)] if K else [])


def test_of_two_experiments_the_second_tests_and_of_more_the_last() -> None:
    def rule(*lengths: int) -> tuple[str, list[Part]]:
        parts = [noise(K, 1, seed=K) for K in lengths]
        found = recommend_split(parts, [examine_channel("y", "output", "m", [part[:, 0] for part in parts])])
        return found.rule, [*found.train, *found.val, *found.test]

    said = "the second experiment tests, the last quarter of the first validates"
    assert rule(101, 50) == (said, [Part(0, 0, 76), Part(0, 76, 101), Part(1, 0, 50)])
    assert rule(30, 40, 50) == ("whole experiments", [Part(0, 0, 30), Part(1, 0, 40), Part(2, 0, 50)])


def test_a_part_at_rest_is_named_with_its_channel() -> None:
    x = noise(1000)
    x[600:] = 0.0
    rule, warnings, _ = split_of(x, "input")
    assert rule == "50/30/20 in time order"  # only its test part is at rest
    assert warnings == ("input 'y' is constant in the test part",)
    assert split_of(np.where(np.arange(1000) < 790, noise(1000), 0.0), "input")[0] == "60/20/20 in time order"


@pytest.mark.parametrize(
    ("z", "first"),
    [
        ([0.1, 3.0, 9.0, 1.0], 1),  # beyond the bound of one lag, and beside what is beyond that of all
        ([2.7, 3.0, 9.0, 1.0], 0),
        ([3.0, 0.1, 9.0, 1.0], 2),
        ([0.1, 0.2, 0.3, 3.0], None),
    ],
)
def test_a_response_begins_with_what_leads_up_to_it(z: list[float], first: int | None) -> None:
    assert _first(np.array(z), np.full(4, 10.0)) == (first, False)


def test_where_a_regularised_model_fails_or_would_take_long_there_are_no_hankel_singular_values() -> None:
    short = (Record(np.zeros((3, 1)), np.zeros((3, 1)), 1.0),)
    for records, channels, outputs in ((short, 2, 1), (short, 31, 1), (short, 10, 1)):
        found = _hankel(records, channels, outputs)
        assert found.shape == (0,)


def test_of_many_short_stretches_no_lag_is_longer_than_a_quarter_of_one() -> None:
    stretches = [np.zeros((40, 2))] * 100
    assert _size(stretches, 1) == (10, 10)
    assert _size([np.zeros((4000, 2))], 1) == (20, 50)
