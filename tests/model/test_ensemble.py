"""An ensemble: the mean of its members, chosen on validation, the same from disk."""

from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.catalog import load

from nnss_cli.methods import METHODS, load_model
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS

SMALL = {"hidden": (4,), "encoder": (3,), "epochs": 3}


@pytest.fixture(scope="module")
def members() -> list[NNSS]:
    data = load("twotank-sim").fitting
    method = METHODS["nnss"]
    return [method.fit(data, 2, seed, method.settings(data, 2, SMALL), None).model for seed in range(3)]  # type: ignore[misc]


def test_it_is_the_mean_of_its_members(members: list[NNSS]) -> None:
    record = load("twotank-sim").test[0]
    mean = np.mean([member.simulate(record.u, record.y[0]).y for member in members], axis=0)
    np.testing.assert_allclose(Ensemble(tuple(members)).simulate(record.u, record.y[0]).y, mean)


def test_its_members_are_the_half_that_validates_better(members: list[NNSS]) -> None:
    data = load("twotank-sim").fitting

    def error(member: NNSS) -> float:
        return float(np.mean([np.mean((member.simulate(r.u, r.y[0]).y - r.y) ** 2) for r in data.val]))

    chosen = Ensemble.chosen(members, data).members
    assert len(chosen) == 2
    assert list(chosen) == sorted(members, key=error)[:2]
    assert len(Ensemble.chosen(members[:1], data).members) == 1


def test_saved_and_loaded_it_is_the_same(members: list[NNSS], tmp_path: Path) -> None:
    record = load("twotank-sim").test[0]
    ensemble = Ensemble(tuple(members[:2]))
    ensemble.save(tmp_path)
    read = load_model(tmp_path)
    assert isinstance(read, Ensemble)
    np.testing.assert_array_equal(read.simulate(record.u, record.y[0]).y, ensemble.simulate(record.u, record.y[0]).y)
