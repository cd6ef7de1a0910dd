from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.n4sid import n4sid, reflect_unstable
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.catalog import BENCHMARKS, load
from nnss_cli.datasets.download import fetch
from nnss_cli.datasets.record import Record

from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import simulate_splits


@pytest.mark.parametrize(("n", "r", "m"), [(1, 1, 1), (3, 1, 1), (2, 2, 1), (3, 1, 2), (4, 3, 2)])
@pytest.mark.parametrize("experiments", [1, 3])
def test_a_known_system_is_recovered_without_noise(system: Callable, n: int, r: int, m: int, experiments: int) -> None:
    plant = LinearStateSpace(*system(n, r, m, seed=10 * n + m, radius=0.8), 1.0)
    random = np.random.default_rng(0)
    records = []
    for _ in range(experiments):
        u = random.standard_normal((500, r))
        records.append(Record(u, plant.simulate(u, np.zeros(n))[0], 1.0))
    model = n4sid(tuple(records), n)
    np.testing.assert_allclose(model.markov(20), plant.markov(20), atol=1e-6)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 6))
def test_reflection_makes_stable_and_keeps_real(seed: int, n: int) -> None:
    A = np.random.default_rng(seed).standard_normal((n, n)) * 1.5
    mirrored = reflect_unstable(A)
    assert np.isrealobj(mirrored)
    assert np.abs(np.linalg.eigvals(mirrored)).max() < 1 + 1e-9


def test_stable_matrices_are_left_alone() -> None:
    A = np.diag([0.5, -0.9])
    assert reflect_unstable(A) is A


def test_too_short_a_record_is_named() -> None:
    record = Record(np.arange(20.0), np.arange(20.0), 1.0)
    with pytest.raises(InputError, match="order 4 is too large for n4sid"):
        n4sid((record,), 4)


# The paper's printed N4SID rows, by MATLAB's n4sid; ../shared/reference/paper_tables.csv
@pytest.mark.parametrize(("name", "order"), [("twotank", 3), ("robotarm", 5), ("daisy-powerplant", 4)])
def test_the_papers_printed_values(name: str, order: int, mirror: Path) -> None:
    fetch(BENCHMARKS[name], mirror=str(mirror), offline=True)
    dataset = load(name, "paper")
    records = tuple(dataset.fitting.scaling.apply(record) for record in dataset.fitting.train)
    scores, _ = simulate_splits(LinearModel.of(n4sid(records, order), dataset.fitting), dataset)
    printed = pd.read_csv(Path(__file__).parents[2] / "nnss_cli/report/paper_tables.csv")
    compared = 0
    for row in printed[(printed["dataset"] == name) & (printed["method"] == "n4sid")].itertuples():
        for score in scores:
            if (score.split, score.output) == (row.split, row.output):
                assert score.rmse == pytest.approx(row.rmse, abs=0.005001), row
                compared += 1
    assert compared >= 2
