"""Records and their scaling."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.datasets.record import Record, Scaling

from nnss_cli.errors import InputError


def test_a_record_is_read_only_and_owns_its_samples() -> None:
    u = np.zeros((4, 1))
    record = Record(u, np.ones(4), 0.1)
    u[0] = 7
    assert record.u[0, 0] == 0
    assert record.y.shape == (4, 1)
    with pytest.raises(ValueError, match="read-only"):
        record.y[0] = 2


@pytest.mark.parametrize(
    ("u", "y", "Ts", "message"),
    [
        (np.zeros(3), np.zeros(4), 1.0, "3 and 4 samples"),
        (np.array([0.0, np.nan]), np.zeros(2), 1.0, "u: sample 1 of channel 0 is nan"),
        (np.zeros(2), np.array([0.0, np.inf]), 1.0, "y: sample 1"),
        (np.zeros(2), np.zeros(2), 0.0, "positive sampling time"),
        (np.zeros((0, 1)), np.zeros((0, 1)), 1.0, "samples × channels"),
    ],
)
def test_bad_signals_are_refused_by_name(u: np.ndarray, y: np.ndarray, Ts: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Record(u, y, Ts)


def test_scaling_is_a_z_score_with_ddof_1_and_leaves_constant_channels_finite() -> None:
    random = np.random.default_rng(0)
    record = Record(
        np.column_stack([random.standard_normal(50), np.full(50, 3.0)]), random.standard_normal(50) * 9, 1.0
    )
    scaling = Scaling.of((record,))
    scaled = scaling.apply(record)
    np.testing.assert_allclose(scaled.y.std(axis=0, ddof=1), 1)
    np.testing.assert_allclose(scaled.u.mean(axis=0), 0, atol=1e-15)
    assert not scaled.u[:, 1].any()
    np.testing.assert_allclose(scaling.restore_y(scaled.y), record.y)


@pytest.mark.parametrize("K", [1, 2, 10, 37, 1000, 100_000])
@pytest.mark.parametrize("constant", [0.0, 0.1, 293.15, 1e5, -7e-9])
def test_a_constant_channel_is_centred_and_not_magnified(constant: float, K: int) -> None:
    still = np.full(K, constant)
    moving = np.sin(np.arange(K))
    # alone, beside others (numpy adds in another order) and over several records
    for records, channel in (
        ((Record(still, moving, 1.0),), 0),
        ((Record(np.column_stack([moving, still, moving]), moving, 1.0),), 1),
        ((Record(still[: K // 2 + 1], moving[: K // 2 + 1], 1.0), Record(still, moving, 1.0)), 0),
    ):
        scaling = Scaling.of(records)
        assert scaling.u_std[channel] == 1.0
        assert scaling.u_mean[channel] == constant
        assert not scaling.apply(records[0]).u[:, channel].any()
        changed = scaling.normalise_u(1.01 * records[0].u)[:, channel]
        assert np.abs(changed).max() <= 0.0101 * abs(constant)
        outputs = Scaling.of(tuple(Record(record.y, record.u, 1.0) for record in records))
        assert (outputs.y_mean[channel], outputs.y_std[channel]) == (constant, 1.0)


@given(st.floats(-1e9, 1e9), st.integers(2, 200), st.randoms(use_true_random=False))
def test_rounding_is_no_variation(constant: float, K: int, random: object) -> None:
    """One step of the floating-point grid either way."""
    near = [constant, np.nextafter(constant, np.inf), np.nextafter(constant, -np.inf)]
    u = np.array([random.choice(near) for _ in range(K)])  # type: ignore[attr-defined]
    scaling = Scaling.of((Record(u, u, 1.0),))
    assert scaling.u_std == 1.0
    assert scaling.u_mean == pytest.approx(constant, rel=1e-15)


@pytest.mark.parametrize("K", [10, 1000, 100_000])
@pytest.mark.parametrize(
    ("offset", "amplitude"), [(1e5, 1e-4), (293.15, 1e-9), (0.1, 1e-12), (0.0, 1e-200), (-7e-9, 1e-20)]
)
def test_a_small_signal_on_a_large_offset_keeps_its_deviation(offset: float, amplitude: float, K: int) -> None:
    sine = np.sin(np.arange(1.0, K + 1))
    u = offset + amplitude * sine
    (deviation,) = Scaling.of((Record(u, u, 1.0),)).u_std
    assert deviation == pytest.approx(
        amplitude * sine.std(ddof=1), rel=2e-3
    )  # the offset's grid takes up to 1e-3 of it


def test_two_levels_in_two_records_are_no_constant() -> None:
    scaling = Scaling.of(
        (Record(np.full(4, 1.0), np.arange(4), 1.0), Record(np.full(4, 1.0 + 1e-9), np.arange(4), 1.0))
    )
    assert scaling.u_std == pytest.approx(1e-9 * np.sqrt(2 / 7), rel=1e-6)
