"""What every method must obey at every init window: one input, several, experiments of different length."""

from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from conftest import linear_system, marks_of, slow_but
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Dataset, FittingData, Record, Scaling

from nnss_cli.experiment.execute import simulate_splits
from nnss_cli.methods import METHODS, Fit, Model, load_model

SMALL = {
    "hidden": (6,), "encoder": (3,), "window": 12, "stride": 12, "batch": 4, "epochs": 2, "dtype": "float64",
    "initial": "linear",
}  # fmt: skip
KINDS = {"siso": (1, 1, (80,)), "mimo": (2, 2, (120,)), "two experiments": (1, 1, (70, 80))}
WINDOWS = (1, 4, 50)

pytestmark = [
    pytest.mark.parametrize("name", [pytest.param(name, marks=marks_of(name)) for name in METHODS]),
    pytest.mark.parametrize(("kind", "window"), slow_but((0, 2, 4, 8), product(KINDS, WINDOWS))),
]


@cache
def data(kind: str, window: int) -> Dataset:
    """A linear plant with a slow mode, so that y(0) does not tell the state, and little noise."""
    r, m, lengths = KINDS[kind]
    plant = LinearStateSpace(*linear_system(2, r, m, 5, radius=0.97), 0.5)
    random = np.random.default_rng(1)

    def record(K: int) -> Record:
        u = random.standard_normal((K, r))
        y = plant.simulate(u, 8 * random.standard_normal(2))[0]
        return Record(u, y + 0.01 * random.standard_normal((K, m)), 0.5)

    train, val, test = (tuple(record(K) for K in lengths) for _ in range(3))
    channels = Channels(("u",) * r, ("y",) * m, ("V",) * r, ("m",) * m)
    return Dataset(
        FittingData("windows", "own", train, val, Scaling.of(train), channels, init_window=window), {"test": test}
    )


def fitted(name: str, kind: str, window: int) -> Fit:
    fitting = data(kind, window).fitting
    method = METHODS[name]
    if method.members:
        return method.combine([model(method.members, kind, window)], fitting)
    return method.fit(fitting, 2, 0, method.settings(fitting, 2, SMALL), None)


@cache
def model(name: str, kind: str, window: int) -> Model:
    found = fitted(name, kind, window).model
    assert found is not None
    return found


def test_shapes_and_scores(name: str, kind: str, window: int) -> None:
    dataset = data(kind, window)
    scores, _ = simulate_splits(model(name, kind, window), dataset)
    assert {score.split for score in scores} == set(dataset.splits())
    assert all(np.isfinite(score.rmse) for score in scores)
    for record in dataset.tests["test"]:
        simulation = model(name, kind, window).simulate(record.u, record.y[:window])
        assert simulation.y.shape == record.y.shape
        assert simulation.x.shape == (len(record), 2)


def test_it_is_deterministic_and_changes_nothing(name: str, kind: str, window: int) -> None:
    dataset = data(kind, window)
    before, record = dataset.fingerprint(), dataset.tests["test"][0]
    first = model(name, kind, window)
    again = first if window != 4 else fitted(name, kind, window).model  # one window fits twice: fits take time
    np.testing.assert_array_equal(
        first.simulate(record.u, record.y[:window]).y, again.simulate(record.u, record.y[:window]).y
    )
    assert dataset.fingerprint() == before


def test_what_comes_after_the_window_does_not_change_what_was_before(name: str, kind: str, window: int) -> None:
    record = data(kind, window).tests["test"][0]
    plain = model(name, kind, window).simulate(record.u, record.y[:window])
    u = record.u.copy()
    u[window + 5 :] += 10.0
    changed = model(name, kind, window).simulate(u, record.y[:window])
    np.testing.assert_array_equal(changed.y[: window + 5], plain.y[: window + 5])
    np.testing.assert_array_equal(changed.x[: window + 6], plain.x[: window + 6])
    assert not np.allclose(changed.y[window + 5 :], plain.y[window + 5 :])


def test_saved_and_loaded_it_finds_the_same_state(name: str, kind: str, window: int, tmp_path: Path) -> None:
    record = data(kind, window).tests["test"][0]
    model(name, kind, window).save(tmp_path)
    again = load_model(tmp_path).simulate(record.u, record.y[:window])
    expected = model(name, kind, window).simulate(record.u, record.y[:window])
    np.testing.assert_array_equal(again.y, expected.y)
    np.testing.assert_array_equal(again.x, expected.x)


def test_a_window_of_its_own_simulation_tells_the_state_that_one_sample_does_not(
    name: str, kind: str, window: int
) -> None:
    """A run from the middle of a simulation on: there the state is another than one sample tells."""
    one = model(name, kind, window)
    record = data(kind, window).tests["test"][0]
    whole = one.simulate(record.u, record.y[0]).y
    u, y = record.u[10:], whole[10:]

    def error(w: int) -> float:
        return float(np.abs(one.simulate(u, y[:w]).y - y)[max(WINDOWS) :].max()) / y.std()

    if window == 1:
        np.testing.assert_array_equal(one.simulate(u, y[:1]).y, one.simulate(u, y[0]).y)
    else:
        assert error(window) <= max(error(1), 1e-9)
    if window == max(WINDOWS):
        assert error(window) < 1e-3
