import numpy as np
import pytest
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
