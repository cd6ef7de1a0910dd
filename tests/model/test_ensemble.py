"""An ensemble: the mean of its members, clipped or not, chosen on validation, the same from disk."""

import json
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.catalog import load
from nnss_cli.datasets.record import Channels, FittingData, Record, Scaling, Simulation

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS, load_model
from nnss_cli.methods.ensemble import better_half
from nnss_cli.methods.registry import DEFAULT
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS

SMALL = {"hidden": (4,), "encoder": (3,), "epochs": 3}


@pytest.fixture(scope="module")
def members() -> list[NNSS]:
    data = load("twotank-sim").fitting
    method = METHODS["nnss"]
    return [method.fit(data, 2, seed, method.settings(data, 2, SMALL), None).model for seed in range(3)]  # type: ignore[misc]


def test_of_two_and_where_all_agree_it_is_the_mean(members: list[NNSS]) -> None:
    record = load("twotank-sim").tests["test"][0][:200]
    each = np.stack([member.simulate(record.u, record.y[0]).y for member in members])
    for rule, count in (("clipped", 2), ("mean", 3), ("mean", 2), ("clipped", 1)):
        found = Ensemble(tuple(members[:count]), rule).simulate(record.u, record.y[0])
        np.testing.assert_allclose(found.y, each[:count].mean(axis=0), rtol=1e-12)
        np.testing.assert_array_equal(found.x, members[0].simulate(record.u, record.y[0]).x)  # those of the first
    clipped = Ensemble(tuple(members), "clipped")
    found = clipped.simulate(record.u, record.y[0]).y
    np.testing.assert_array_equal(found, clipped.together(each))
    far = np.abs(each - np.median(each, axis=0)).max(axis=0) > 5 * np.median(
        np.abs(each - np.median(each, axis=0)), axis=0
    )
    assert far.any()
    assert not far.all()
    np.testing.assert_allclose(found[~far], each.mean(axis=0)[~far], rtol=1e-12)
    assert (found[far] != each.mean(axis=0)[far]).all()


@pytest.mark.parametrize(
    ("each", "expected"),
    [
        ([0.0, 1.0, 2.0, 3.0, 4.0], 2.0),
        ([0.0, 1.0, 2.0, 3.0, 6.0], 2.4),  # within five deviations of the median, here of 1
        ([0.0, 1.0, 2.0, 3.0, 1e9], (0 + 1 + 2 + 3 + 7) / 5),
        ([-1e9, 1.0, 2.0, 3.0, 4.0], (-3 + 1 + 2 + 3 + 4) / 5),
        ([0.0, 0.1, 10.0], (0 + 0.1 + 0.6) / 3),
        ([1.0, 1.0, 1.0, 9.0], 1.0),
        ([0.0, 1.0, 2.0, 100.0], (0 + 1 + 2 + 1.5 + 5 * 1.0) / 4),
    ],
)
def test_what_is_far_from_the_others_is_moved_to_five_median_deviations(
    each: list[float], expected: float, members: list[NNSS]
) -> None:
    ensemble, values = Ensemble(tuple(members[:1] * len(each)), "clipped"), np.array(each)
    assert ensemble.together(values) == pytest.approx(expected, rel=1e-12)
    assert ensemble.together(values[::-1]) == pytest.approx(expected, rel=1e-12)
    columns = np.stack([values, -2 * values + 3], axis=1)  # each output by itself, in any unit
    np.testing.assert_allclose(ensemble.together(columns), [expected, -2 * expected + 3], rtol=1e-12)


@pytest.mark.parametrize("count", [3, 5, 8])
def test_fewer_than_half_cannot_take_it_far_and_it_lies_between_its_members(count: int, members: list[NNSS]) -> None:
    """So its energy is no more than that of all members together: √k γ bounds a gain that γ bounds for each of k."""
    ensemble, random = Ensemble(tuple(members[:1] * count), "clipped"), np.random.default_rng(count)
    for _ in range(200):
        each = random.standard_normal((count, 4))
        found = ensemble.together(each)
        assert (each.min(axis=0) <= found + 1e-12).all()
        assert (found - 1e-12 <= each.max(axis=0)).all()
        astray = (count - 1) // 2
        others = each[astray:]
        each[:astray] = 10.0 ** random.uniform(2, 12)
        reach = np.ptp(others, axis=0)
        assert (ensemble.together(each) <= others.max(axis=0) + 5 * reach).all()


def test_a_member_that_leaves_the_finite_range_takes_the_ensemble_along(members: list[NNSS]) -> None:
    """As in its exports, where a share of 0 of what is infinite is no number, and as a predictor demands."""
    for rule in ("clipped", "mean"):
        for lost in (np.nan, np.inf, -np.inf):
            each = np.arange(10.0).reshape(5, 2)
            each[3, 1] = lost
            found = Ensemble(tuple(members[:1] * 5), rule).together(each)
            assert np.isfinite(found[0])
            assert not np.isfinite(found[1])


def test_its_members_are_the_half_that_validates_better(members: list[NNSS]) -> None:
    data = load("twotank-sim").fitting

    def error(member: NNSS) -> float:
        return float(np.mean([np.mean((member.simulate(r.u, r.y[0]).y - r.y) ** 2) for r in data.val]))

    chosen = better_half(members, data)
    assert len(chosen) == 2
    assert list(chosen) == sorted(members, key=error)[:2]
    assert len(better_half(members[:1], data)) == 1


def test_the_clipped_one_is_asked_for_by_name(members: list[NNSS]) -> None:
    data = load("twotank-sim").fitting
    rules = {name: METHODS[name].combine(members, data).model.rule for name in ("nnss-ensemble", "nnss-clipped")}  # type: ignore[union-attr]
    assert rules == {"nnss-ensemble": "mean", "nnss-clipped": "clipped"}
    assert "nnss-ensemble" in DEFAULT
    assert "nnss-clipped" not in DEFAULT


def test_saved_and_loaded_it_is_the_same(members: list[NNSS], tmp_path: Path) -> None:
    record = load("twotank-sim").tests["test"][0][:200]
    for rule in ("clipped", "mean"):
        ensemble = Ensemble(tuple(members), rule)
        ensemble.save(tmp_path / rule)
        read = load_model(tmp_path / rule)
        assert isinstance(read, Ensemble)
        assert read.rule == rule
        expected = ensemble.simulate(record.u, record.y[0]).y
        np.testing.assert_array_equal(read.simulate(record.u, record.y[0]).y, expected)


def test_a_file_without_a_rule_is_of_an_older_nnss_that_took_the_mean(members: list[NNSS], tmp_path: Path) -> None:
    Ensemble(tuple(members)).save(tmp_path)
    file = tmp_path / "model.json"
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"rule": "best"}))
    with pytest.raises(InputError, match="unknown rule of an ensemble 'best'"):
        load_model(tmp_path)
    del content["rule"]
    file.write_text(json.dumps(content))
    assert load_model(tmp_path).rule == "mean"  # type: ignore[attr-defined]


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
