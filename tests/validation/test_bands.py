"""Conformal bands: coverage as claimed, blocks as long as the errors' memory, each output by itself."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.catalog import BENCHMARKS, load
from nnss_cli.datasets.download import fetch
from nnss_cli.datasets.record import Channels

from nnss_cli.errors import InputError
from nnss_cli.methods.linear import subspace_model
from nnss_cli.validation.bands import Band, calibrate, memory
from nnss_cli.validation.gain import estimate_gain
from nnss_cli.validation.limits import Limits
from nnss_cli.validation.predictor import Predictor, steppers_of


def noise(pole: float, samples: int, seed: int) -> np.ndarray:
    white = np.random.default_rng(seed).standard_normal((samples + 300, 1))
    return scipy.signal.lfilter([1], [1, -pole], white, axis=0)[300:]


def test_each_output_is_told_its_own_width_and_blocks() -> None:
    band = Band(0.9, np.array([1.5, 20.0]), (30, 12), (4, 10), (4, 16), None)
    held, y = np.array([0.875, np.nan]), np.zeros((3, 2))
    channels = Channels(("u",), ("level", "flow"), ("V",), ("cm", "–"))
    assert Limits(band, y - 1, y + 1, held).told(channels) == [
        "band of 90 %, level: ± 1.5 cm, from 30 blocks of 4 samples of the validation record; it holds 87.5 % here",
        "band of 90 %, flow: ± 20, from 12 blocks of 10 samples of the validation record, whose errors remember 16: it "
        "is too short to assure 90 %",
    ]
    following = replace(band, floor=np.array([0.1, 0.2]))
    assert "flow: ± 20 × the members' spread, from 12" in Limits(following, y, y, None).told(channels)[1]


@pytest.mark.parametrize("pole", [0.0, 0.6, 0.9])
def test_coverage_on_records_of_autoregressive_noise(pole: float) -> None:
    """200 records: calibrated on one half, the other half is covered to 88–92 % on average."""
    held = []
    for seed in range(200):
        e = noise(pole, 2000, seed)
        band = calibrate([e[:1000]], 0.9)
        held.append(np.mean(np.abs(e[1000:]) <= band.half_width))
    assert 0.88 <= np.mean(held) <= 0.92


@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("robotarm", 5),
        pytest.param("silverbox", 2, marks=pytest.mark.slow),
        pytest.param("wiener-hammerstein", 6, marks=pytest.mark.slow),
    ],
)
def test_coverage_where_test_and_validation_are_alike(name: str, order: int, mirror: Path) -> None:
    """With N4SID, simulated and predicted, as docs/validation.md says; of several tests, the one like validation."""
    benchmark = BENCHMARKS[name]
    fetch(benchmark, mirror=str(mirror), offline=True)
    dataset = load(name, "strict" if "strict" in benchmark.protocols else benchmark.protocols[0])
    fitting, w = dataset.fitting, dataset.fitting.init_window
    model = LinearModel.of(subspace_model(fitting, order, "auto"), fitting)
    predictor = Predictor(model, (estimate_gain(steppers_of(model)[0], fitting.train, fitting.val, w).K,))
    test = dataset.tests["multisine" if "multisine" in dataset.tests else "test"][0][:20_000]
    for horizon in (None, 1, 10):
        val, new = (
            [(r.y - predictor.predict(r.u, r.y, horizon, w))[w:] for r in records] for records in (fitting.val, [test])
        )
        held = np.mean(np.abs(new[0]) <= calibrate(val, 0.9).half_width, axis=0)
        assert ((held >= 0.85) & (held <= 0.95)).all()


@pytest.mark.parametrize("level", [0.5, 0.8, 0.95])
def test_few_blocks_make_a_wider_band_not_one_that_holds_less(level: float) -> None:
    held = []
    for seed in range(200):
        e = noise(0.9, 1200, seed)
        held.append(np.mean(np.abs(e[200:]) <= calibrate([e[:200]], level).half_width))
    assert np.mean(held) >= level


def test_a_record_too_short_for_its_memory_is_told(linear: LinearModel) -> None:
    """Nine blocks of 50 samples are shorter than what AR noise of pole 0.97 remembers: 90 % are not held."""
    held, told = [], []
    for seed in range(200):
        e = noise(0.97, 1250, seed)
        band = calibrate([e[:50]], 0.9)
        assert band.assured(0) or band.half_width == np.abs(e[:50]).max()
        held.append(np.mean(np.abs(e[250:]) <= band.half_width))
        told.append(not band.assured(0))
    assert np.mean(held) < 0.88
    assert np.mean(told) > 0.6
    doubted = calibrate([noise(0.97, 50, int(np.argmax(told)))], 0.9)
    (line,) = Limits.of(doubted, np.zeros((9, 1)), None, None, 1).told(linear.channels)
    assert f"whose errors remember {doubted.memory[0]}: it is too short to assure 90 %" in line
    long = calibrate([noise(0.97, 2000, 0)], 0.9)
    assert long.assured(0)
    assert long.length == long.memory


@pytest.mark.parametrize("lengths", [(49,), (29, 28), (57, 49)])
def test_the_largest_error_may_lie_beyond_whole_blocks(lengths: tuple[int, ...]) -> None:
    parts = [np.linspace(0, 10, length)[:, None] for length in lengths]
    band = calibrate(parts, 0.9)
    assert not band.assured(0)
    assert all(length % band.length[0] for length in lengths)
    assert band.half_width == 10


def test_the_level_orders_the_bands_and_the_units_scale_them() -> None:
    e = noise(0.5, 600, 1)
    widths = [float(calibrate([e], level).half_width[0]) for level in (0.5, 0.8, 0.9, 0.95)]
    assert widths == sorted(widths)
    np.testing.assert_allclose(calibrate([1e-3 * e], 0.9).half_width, 1e-3 * calibrate([e], 0.9).half_width)


def test_each_output_has_a_width_of_its_own() -> None:
    e = np.hstack([noise(0.9, 900, 1), 10 * noise(0.0, 900, 2)])
    both = calibrate([e[:500], e[500:]], 0.9)
    for i in range(2):
        alone = calibrate([e[:500, i : i + 1], e[500:, i : i + 1]], 0.9)
        assert both.half_width[i] == alone.half_width[0]
    assert both.length[0] > 4 * both.length[1]
    assert both.blocks[0] < both.blocks[1]


def test_blocks_are_as_long_as_the_memory() -> None:
    """1 + 2 Σ ρ^l = (1 + ρ)/(1 − ρ) of AR noise."""
    lengths = [memory([noise(0.8, 20_000, seed)[:, 0]]) for seed in range(5)]
    assert np.mean(lengths) == pytest.approx(9 + 0.5, rel=0.15)
    slow = [memory([noise(0.97, 50_000, seed)[:, 0]]) for seed in range(5)]
    assert np.mean(slow) == pytest.approx(1.97 / 0.03, rel=0.15)  # of which twenty lags have less than a half
    assert memory([np.zeros(20)]) == 1
    slow = [memory([noise(0.98, 50_000, seed)[:, 0]]) for seed in range(3)]
    assert np.mean(slow) == pytest.approx(99, rel=0.15)


def test_the_share_outside_is_what_the_blocks_allow() -> None:
    """n blocks: (α (n + 1) − 1)/n of the samples may lie outside, and as many do."""
    e = np.random.default_rng(0).permutation(np.arange(1.0, 501.0))[:, None]
    band = calibrate([e], 0.9)
    n, length = band.blocks[0], band.length[0]
    used = e[: n * length]
    outside = np.mean(used > band.half_width)
    assert outside <= (0.1 * (n + 1) - 1) / n < outside + 1 / len(used)


def test_a_band_that_follows_a_spread() -> None:
    random = np.random.default_rng(3)
    spread = np.exp(random.standard_normal((4000, 1)))
    e = spread * random.standard_normal((4000, 1))
    following = calibrate([e[:2000]], 0.9, [spread[:2000]])
    low, high = following.limits(np.zeros((2000, 1)), spread[2000:])
    inside = np.abs(e[2000:]) <= high
    np.testing.assert_allclose(low, -high)
    assert np.mean(inside) == pytest.approx(0.9, abs=0.02)
    wide = spread[2000:] > np.median(spread)
    assert np.mean(inside[wide]) == pytest.approx(0.9, abs=0.05)  # where the members disagree, too
    constant = np.abs(e[2000:]) <= calibrate([e[:2000]], 0.9).half_width
    assert np.mean(constant[wide]) < 0.84


@pytest.mark.parametrize(
    ("level", "samples", "told"),
    [
        (1.0, 50, "between 0 and 1"),
        (0.0, 50, "between 0 and 1"),
        (0.99, 50, "0.99 needs at least 99 validation samples"),
    ],
)
def test_what_cannot_be_had_is_refused(level: float, samples: int, told: str) -> None:
    with pytest.raises(InputError, match=told):
        calibrate([noise(0, samples, 0)], level)
