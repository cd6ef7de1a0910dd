from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.ssregest import KERNELS, _arx_to_state_space, kernel_matrix, ssregest
from nnss_cli.baselines.statespace import LinearStateSpace, simulation_rms
from nnss_cli.datasets.catalog import BENCHMARKS, load
from nnss_cli.datasets.download import fetch
from nnss_cli.datasets.record import Record

from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import simulate_splits


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("decay", [0.1, 0.5, 0.95])
def test_kernels_are_covariances_that_decay(kernel: str, decay: float) -> None:
    K = kernel_matrix(kernel, 20, 2.0, decay, 0.5)
    np.testing.assert_array_equal(K, K.T)
    assert np.linalg.eigvalsh(K)[0] > -1e-12
    assert (np.diff(np.diag(K)) < 0).all()


def test_dc_with_full_correlation_is_tc() -> None:
    """ρ = √λ gives the TC kernel: Chen, Ohlsson and Ljung 2012, section 4."""
    np.testing.assert_allclose(
        kernel_matrix("dc", 15, 1.0, 0.8, np.sqrt(0.8)), kernel_matrix("tc", 15, 1.0, 0.8), rtol=1e-12
    )


def test_the_observer_form_is_the_arx_model() -> None:
    random = np.random.default_rng(0)
    m, r, p = 2, 1, 3
    theta = 0.2 * random.standard_normal((m, (m + r) * p))
    model = _arx_to_state_space(theta, m, r, p, 1.0)
    u = random.standard_normal((30, r))
    y, _ = model.simulate(u, np.zeros(p * m))
    coefficients = theta.reshape(m, m + r, p)
    for k in range(p, 30):
        past = sum(
            coefficients[:, :m, lag] @ y[k - lag - 1] + coefficients[:, m:, lag] @ u[k - lag - 1] for lag in range(p)
        )
        np.testing.assert_allclose(y[k], past, atol=1e-12)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("n", "r", "m"), [(2, 1, 1), (3, 2, 2)])
def test_a_known_system_is_found_in_noise(system: Callable, kernel: str, n: int, r: int, m: int) -> None:
    plant = LinearStateSpace(*system(n, r, m, seed=n + 5, radius=0.8), 1.0)
    random = np.random.default_rng(0)
    u = random.standard_normal((1000, r))
    y, _ = plant.simulate(u, random.standard_normal(n))
    noisy = Record(u, y + 0.05 * y.std(axis=0) * random.standard_normal(y.shape), 1.0)
    model = ssregest((noisy,), n, kernel)
    scale = np.abs(plant.markov(20)).max()
    assert np.abs(model.markov(20) - plant.markov(20)).max() < 0.05 * scale
    assert model.order == n
    assert model.spectral_radius() < 1


def test_fewer_samples_than_coefficients_are_no_obstacle(system: Callable) -> None:
    plant = LinearStateSpace(*system(2, 4, 2, seed=1, radius=0.7), 1.0)
    random = np.random.default_rng(0)
    u = random.standard_normal((70, 4))
    y, _ = plant.simulate(u, np.zeros(2))
    record = Record(u, y, 1.0)
    assert simulation_rms(ssregest((record,), 2), (record,)) < 0.1 * y.std()


def test_too_short_a_record_is_named() -> None:
    record = Record(np.arange(5.0), np.arange(5.0), 1.0)
    with pytest.raises(InputError, match="too large for ssregest"):
        ssregest((record,), 6)


@pytest.mark.system
@pytest.mark.parametrize(("name", "order"), [("twotank", 3), ("robotarm", 5), ("daisy-powerplant", 4)])
def test_train_errors_are_not_above_the_printed_ones(name: str, order: int, mirror: Path) -> None:
    fetch(BENCHMARKS[name], mirror=str(mirror), offline=True)
    dataset = load(name, "paper")
    train, _ = dataset.fitting.normalised()
    scores, _ = simulate_splits(LinearModel.of(ssregest(train, order), dataset.fitting), dataset)
    printed = pd.read_csv(Path(__file__).parents[2] / "nnss_cli/report/paper_tables.csv")
    printed = printed[(printed["dataset"] == name) & (printed["method"] == "ssregest") & (printed["split"] == "train")]
    for row in printed.itertuples():
        (score,) = (s for s in scores if (s.split, s.output) == ("train", row.output))
        assert score.rmse <= row.rmse


def test_many_short_experiments_take_as_many_lags_as_the_shortest_allows(system: Callable) -> None:
    """The lags went by the sum of the samples: 20 records of 25 samples were too short for 30 lags of any order."""
    model = LinearStateSpace(*system(2, 1, 1, 0), 1.0)
    random = np.random.default_rng(0)
    records = []
    for _ in range(20):
        u = random.standard_normal((25, 1))
        y, _ = model.simulate(u, np.zeros(2))
        records.append(Record(u, y + 1e-3 * random.standard_normal(y.shape), 1.0))
    found = ssregest(tuple(records), 2)
    assert simulation_rms(found, tuple(records)) < 0.1 * np.std(np.concatenate([r.y for r in records]))
    with pytest.raises(InputError, match="found one of 3"):
        ssregest((records[0], records[1][:3]), 5)
