"""An ensemble: the mean of its members, chosen on validation, the same from disk."""

from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.catalog import load
from nnss_cli.datasets.record import Channels, FittingData, Record, Scaling, Simulation

from nnss_cli.methods import METHODS, load_model
from nnss_cli.methods.ensemble import better_half
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS

SMALL = {"hidden": (4,), "encoder": (3,), "epochs": 3}


@pytest.fixture(scope="module")
def members() -> list[NNSS]:
    data = load("twotank-sim").fitting
    method = METHODS["nnss"]
    return [method.fit(data, 2, seed, method.settings(data, 2, SMALL), None).model for seed in range(3)]  # type: ignore[misc]


def test_it_is_the_mean_of_its_members(members: list[NNSS]) -> None:
    record = load("twotank-sim").tests["test"][0]
    mean = np.mean([member.simulate(record.u, record.y[0]).y for member in members], axis=0)
    np.testing.assert_allclose(Ensemble(tuple(members)).simulate(record.u, record.y[0]).y, mean)


def test_its_members_are_the_half_that_validates_better(members: list[NNSS]) -> None:
    data = load("twotank-sim").fitting

    def error(member: NNSS) -> float:
        return float(np.mean([np.mean((member.simulate(r.u, r.y[0]).y - r.y) ** 2) for r in data.val]))

    chosen = better_half(members, data)
    assert len(chosen) == 2
    assert list(chosen) == sorted(members, key=error)[:2]
    assert len(better_half(members[:1], data)) == 1


def test_saved_and_loaded_it_is_the_same(members: list[NNSS], tmp_path: Path) -> None:
    record = load("twotank-sim").tests["test"][0]
    ensemble = Ensemble(tuple(members[:2]))
    ensemble.save(tmp_path)
    read = load_model(tmp_path)
    assert isinstance(read, Ensemble)
    np.testing.assert_array_equal(read.simulate(record.u, record.y[0]).y, ensemble.simulate(record.u, record.y[0]).y)


class Offset:
    """A stand-in for a member: off by one constant on training samples and by another on validation samples."""

    def __init__(self, name: str, train: float, val: float, train_length: int) -> None:
        self.name, self.offsets, self.train_length = name, (train, val), train_length

    def simulate(self, u: np.ndarray, y0: np.ndarray) -> Simulation:
        offset = self.offsets[len(u) != self.train_length]
        return Simulation(np.full((len(u), len(y0)), offset), np.zeros((len(u), 1)))


def silent(K: int, m: int = 1) -> Record:
    return Record(np.zeros((K, 1)), np.zeros((K, m)), 1.0)


def data_of(m: int, sigma: np.ndarray) -> FittingData:
    channels = Channels(("u",), tuple(f"y{i}" for i in range(m)), ("",), ("",) * m)
    scaling = Scaling(np.zeros(1), np.ones(1), np.zeros(m), sigma)
    return FittingData("made up", "strict", (silent(7, m),), (silent(5, m), silent(4, m)), scaling, channels)


def test_members_are_chosen_on_validation_not_on_training() -> None:
    candidates = [Offset("fits", 0.1, 3.0, 7), Offset("generalises", 2.0, 0.2, 7), Offset("neither", 5.0, 4.0, 7)]
    chosen = better_half(candidates, data_of(1, np.ones(1)))
    assert [member.name for member in chosen] == ["generalises", "fits"]


def test_members_are_chosen_in_units_of_the_outputs_deviations() -> None:
    class Two(Offset):
        def simulate(self, u: np.ndarray, y0: np.ndarray) -> Simulation:
            return Simulation(np.tile(self.offsets, (len(u), 1)), np.zeros((len(u), 1)))

    # 48 of σ = 480 and 0.009 of σ = 0.01, against 120 and 0.0025: the first is lower in physical units alone
    candidates = [Two("physical", 48.0, 0.009, 7), Two("normalised", 120.0, 0.0025, 7)]
    chosen = better_half(candidates, data_of(2, np.array([480.0, 0.01])))
    assert [member.name for member in chosen] == ["normalised"]
