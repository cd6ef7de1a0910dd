"""Uniform samples from raw ones: what is kept, what is taken off, and where it is refused."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from nnss_cli.datasets import preparation
from nnss_cli.datasets.preparation import (
    check_agreement,
    check_complete,
    check_increasing,
    cut,
    downsample,
    fit_drift,
    interpolate_missing,
    parse_split,
    resample,
    uniform_Ts,
    usual_step,
)
from scipy.signal import decimate

from nnss_cli.errors import InputError


@given(Ts=st.floats(1e-6, 1e6), K=st.integers(2, 400), start=st.floats(-1e3, 1e3), seed=st.integers(0, 99))
def test_Ts_is_found_under_jitter_within_the_tolerance(Ts: float, K: int, start: float, seed: int) -> None:
    jitter = np.random.default_rng(seed).uniform(-0.002, 0.002, K)
    t = start * Ts + (np.arange(K) + jitter) * Ts
    assert uniform_Ts(t) == pytest.approx(Ts, rel=0.004 / (K - 1) + 1e-8)
    assert uniform_Ts(np.arange(K) * 0.1) == 0.1


def test_the_usual_step_is_the_mean_of_those_near_the_median() -> None:
    assert usual_step(np.array([1.0, 1.003, 1.0, 1.003, 1.0, 7.0, 0.2])) == pytest.approx(5.006 / 5)
    assert usual_step(np.array([1.0, 3.0])) == 2.0  # none is near


def test_the_first_place_off_the_grid_is_named_with_both_steps() -> None:
    t = np.arange(100) * 0.5
    t[40:] += 0.5
    t[70:] += 0.1
    with pytest.raises(InputError, match="^line 41: .* is 1 s, expected 0.5 s within 1% .2 of 99 .*--resample 0.5"):
        uniform_Ts(t, lambda k: f"line {k + 1}")


@pytest.mark.parametrize(
    ("t", "message"),
    [
        ([0.0, 1, 1, 2], "sample 3: time goes from 1 to 1: expected it to grow"),
        ([0.0, 1, 2, 1.5], "sample 4: time goes from 2 to 1.5"),
        ([0.0, np.nan, 2], "sample 2: the time is missing"),
        ([0.0], "sample 1: a time axis needs at least two samples"),
    ],
)
def test_time_must_increase(t: list[float], message: str) -> None:
    for check in (check_increasing, uniform_Ts):
        with pytest.raises(InputError, match=message):
            check(np.array(t))


def test_two_sampling_times_agree_to_a_thousandth() -> None:
    check_agreement(0.1, 0.10005, "x")
    with pytest.raises(InputError, match=r"x: sampling time 0.1002 s, expected 0.1 s"):
        check_agreement(0.1, 0.1002, "x")


def test_gaps_are_named_and_filled_by_lines_in_time() -> None:
    t = np.array([0.0, 1, 2, 4, 5, 6, 7])
    values = np.column_stack([3 * t + 1, -t])
    holed = values.copy()
    holed[[2, 3, 5], 1] = np.nan
    with pytest.raises(InputError, match="sample 3, column 'y': 3 of 7 samples are missing, the longest gap is 2:"):
        check_complete(holed, ("u", "y"))
    check_complete(values, ("u", "y"))
    np.testing.assert_allclose(interpolate_missing(t, holed, ("u", "y")), values)
    assert np.isnan(holed[2, 1]), "the caller's array is his"
    for k, word in ((0, "starts"), (6, "ends")):
        at_end = values.copy()
        at_end[k, 0] = np.nan
        with pytest.raises(InputError, match=f"sample {k + 1}, column 'u': the record {word} with a missing sample"):
            interpolate_missing(t, at_end, ("u", "y"))


@given(N=st.integers(2, 12), part=st.floats(1.0, 1.0 / 0.11), phase=st.floats(0, 6.28))
def test_a_sine_above_the_new_nyquist_frequency_is_gone(N: int, part: float, phase: float) -> None:
    frequency = part * np.pi / N  # rad per old sample
    assume(frequency <= np.pi)
    K = 100 * N
    sine = np.sin(frequency * np.arange(K) + phase)[:, None]
    inner = downsample(sine, N)[20:-20]
    assert np.abs(inner).max() < 1e-2  # 40 dB; without the filter it would stand at its alias


@given(N=st.integers(1, 12), part=st.floats(0, 0.8), phase=st.floats(0, 6.28))
def test_a_sine_below_it_is_kept_without_delay(N: int, part: float, phase: float) -> None:
    K = 100 * N + 3
    sine = np.sin(part * np.pi / N * np.arange(K) + phase)[:, None]
    inner = slice(20, -20)
    np.testing.assert_allclose(downsample(sine, N)[inner], sine[::N][inner], atol=0.01)


@given(N=st.integers(1, 9), K=st.integers(200, 260), offset=st.floats(-5, 5), slope=st.floats(-5, 5))
def test_lines_are_kept_to_the_ends(N: int, K: int, offset: float, slope: float) -> None:
    line = np.column_stack([offset + slope * np.arange(K), np.full(K, offset)])
    found = downsample(line, N)
    assert found.shape == (-(-K // N), 2)
    np.testing.assert_allclose(found, line[::N], rtol=1e-9, atol=1e-9 * (1 + 300 * abs(slope) + abs(offset)))


def test_decimation_is_scipy_s_in_the_passband() -> None:
    random = np.random.default_rng(0)
    t = np.arange(2000)
    slow = sum(random.standard_normal() * np.sin(w * t + 6 * random.random()) for w in np.linspace(0.01, 0.4, 9))
    ours, theirs = downsample(slow[:, None], 4)[:, 0], decimate(slow, 4, ftype="fir", n=400)
    np.testing.assert_allclose(ours[60:-60], theirs[60:-60], atol=0.02 * np.abs(slow).max())


@pytest.mark.parametrize("N", [2, 3, 10, 50])
def test_the_filter_is_flat_and_down_where_it_is_said_to_be(N: int) -> None:
    """Its impulse response, put together from what it makes of impulses at each of N samples."""
    K, taps = 100 * N, np.zeros(100 * N)
    for shift in range(N):
        impulse = np.zeros((K, 1))
        impulse[50 * N + shift] = 1
        taps[-shift % N :: N] = np.roll(downsample(impulse, N)[:, 0], -(shift > 0))
    size = np.abs(np.fft.rfft(taps, 64 * K))
    frequency = np.linspace(0, N, len(size))  # over the new Nyquist frequency
    assert np.abs(size[frequency <= 0.8] - 1).max() < 1e-3
    assert size[frequency >= 1].max() < 1e-3
    assert size[frequency >= 1].max() > 0.8e-3


@pytest.mark.parametrize("Ts", [0.2, 0.37, 2.0])
def test_a_coarser_grid_goes_by_one_eight_times_finer_than_the_samples(
    Ts: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[int, int]] = []
    monkeypatch.setattr(preparation, "downsample", lambda values, N: seen.append((len(values), N)) or values)
    resample(np.arange(101) * 0.1, np.zeros((101, 1)), Ts)
    ((length, q),) = seen
    assert 8 <= q * 0.1 / Ts <= 8 + 0.1 / Ts + 1e-9  # up to the next whole number
    assert length == pytest.approx(10 / (Ts / q) + 1, abs=1)


def test_records_too_short_for_the_filter_are_refused() -> None:
    assert len(downsample(np.zeros((39, 1)), 2)) == 20
    with pytest.raises(InputError, match="downsample 2: the filter needs more than 38 samples, found 38"):
        downsample(np.zeros((38, 1)), 2)
    with pytest.raises(InputError, match="downsample: expected a whole number from 1 on, found 0"):
        downsample(np.zeros((38, 1)), 0)


@given(seed=st.integers(0, 99), Ts=st.floats(0.05, 0.9))
def test_resampling_to_a_finer_grid_is_interpolation(seed: int, Ts: float) -> None:
    t = np.cumsum(np.random.default_rng(seed).uniform(0.95, 1.05, 50))
    line = np.column_stack([2 * t + 1, -t])
    found = resample(t, line, Ts)
    grid = t[0] + np.arange(len(found)) * Ts
    assert t[-1] - Ts < grid[-1] <= t[-1] + 1e-5
    np.testing.assert_allclose(found, np.column_stack([2 * grid + 1, -grid]), atol=1e-4)


@pytest.mark.parametrize("Ts", [1.4, 2.0, 3.3, 10.0])
def test_resampling_to_a_coarser_grid_filters(Ts: float) -> None:
    random = np.random.default_rng(0)
    t = np.arange(3000) + random.uniform(-0.002, 0.002, 3000)
    slow, fast = 0.05 * np.pi / Ts, 1.2 * np.pi / Ts
    found = resample(t, np.column_stack([np.sin(slow * t), np.sin(min(fast, 3.0) * t), t]), Ts)
    grid = t[0] + np.arange(len(found)) * Ts
    inner = slice(20, -20)
    np.testing.assert_allclose(found[inner, 0], np.sin(slow * grid)[inner], atol=0.01)
    np.testing.assert_allclose(found[:, 2], grid, atol=0.05)
    assert np.abs(found[inner, 1]).max() < 0.015  # 40 dB, and what the jitter makes of it


def test_resampling_is_bounded() -> None:
    t = np.arange(10.0)
    for Ts, message in ((0.0, "positive"), (np.inf, "positive"), (10.0, "fewer than two"), (1e-9, "makes 90+ samples")):
        with pytest.raises(InputError, match=message):
            resample(t, t[:, None], Ts)
    with pytest.raises(InputError, match="at its gaps"):
        resample(np.array([0, 1e-9, 2e-9, 3e-9, 1e3]), np.zeros((5, 1)), 10.0)


@given(seed=st.integers(0, 99))
def test_a_drift_is_the_least_squares_line_without_its_mean(seed: int) -> None:
    random = np.random.default_rng(seed)
    t = np.arange(50) * 0.1
    parts = [(t, random.standard_normal((50, 2)) + 5), (t[:20], random.standard_normal((20, 2)))]
    drift = fit_drift(parts)
    times, every = (np.concatenate(each) for each in zip(*parts, strict=True))
    left = every - drift.at(times)
    np.testing.assert_allclose(left.mean(axis=0), every.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose((times - times.mean()) @ left, 0, atol=1e-9)
    np.testing.assert_allclose(drift.slope, np.polyfit(times, every, 1)[0])


@given(K=st.integers(0, 10_000), train=st.integers(1, 99), val=st.integers(0, 99))
def test_a_split_takes_every_sample_once_in_time_order(K: int, train: int, val: int) -> None:
    assume(train + val <= 100)
    split = parse_split(f"{train}/{val}/{100 - train - val}")
    parts = cut(K, split)
    assert list(parts) == ["train", "val", "test"]
    assert [k for part in parts.values() for k in range(part.start, part.stop)] == list(range(K))
    for part, fraction in zip(parts.values(), split, strict=True):
        assert abs(part.stop - part.start - fraction * K) <= 1
    assert parse_split(f"{train / 100}/{val / 100}/{(100 - train - val) / 100}") == pytest.approx(split)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("60/20", "expected train/validation/test"), ("60/20/30", "sum to 110"), ("a/b/c", "as 60/20/20"),
        ("0/50/50", "train part is empty"), ("-10/60/50", "as 60/20/20"), ("nan/0/0", "as 60/20/20"),
        ("1e2/0/0", "as 60/20/20"), ("0/0/0", "sum to 0"), ("", "as 60/20/20"), ("600/200/200", "sum to 1000"),

    ],
)  # fmt: skip
def test_bad_splits_are_refused(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_split(text)
