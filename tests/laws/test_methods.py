"""What every method must obey, whatever it is: adding one to the registry adds it here."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.record import Dataset, FittingData

from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.run import RunSpec
from nnss_cli.experiment.store import Store
from nnss_cli.methods import METHODS, Fit, load_model
from nnss_cli.modelfile import read_tensors

SMALL = {
    "hidden": (6,), "encoder": (3,), "window": 12, "stride": 4, "batch": 4, "epochs": 3, "dtype": "float64",
}  # fmt: skip

pytestmark = pytest.mark.parametrize("name", METHODS)


def fit(name: str, dataset: Dataset, order: int = 2, seed: int = 0) -> Fit:
    method = METHODS[name]
    return method.fit(dataset.fitting, order, seed, method.settings(dataset.fitting, order, SMALL), None)


@pytest.mark.parametrize(("r", "m"), [(1, 1), (2, 1), (1, 2), (2, 3)])
def test_shapes_units_and_finiteness(name: str, r: int, m: int, small_data: Callable) -> None:
    dataset = small_data(r, m, K=450)
    model = fit(name, dataset).model
    assert model is not None
    record = dataset.tests["test"][0]
    simulation = model.simulate(record.u, record.y[0])
    assert simulation.y.shape == record.y.shape
    assert simulation.x.shape == (len(record), 2)
    assert np.isfinite(simulation.y).all()
    assert model.Ts == record.Ts
    assert len(model.channels.outputs) == m


def test_fitting_is_deterministic_and_changes_nothing(name: str, small_data: Callable) -> None:
    dataset = small_data(K=300)
    before = dataset.fingerprint()
    record = dataset.tests["test"][0]
    first, second = (fit(name, dataset, seed=5).model.simulate(record.u, record.y[0]).y for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert dataset.fingerprint() == before


def test_the_result_does_not_depend_on_earlier_seeds(name: str, small_data: Callable) -> None:
    dataset = small_data(K=300)
    record = dataset.tests["test"][0]
    alone = fit(name, dataset, seed=2).model.simulate(record.u, record.y[0]).y
    fit(name, dataset, seed=1)
    np.testing.assert_array_equal(fit(name, dataset, seed=2).model.simulate(record.u, record.y[0]).y, alone)


def test_simulation_is_causal(name: str, small_data: Callable) -> None:
    dataset = small_data(K=300)
    model = fit(name, dataset).model
    record = dataset.tests["test"][0]
    u = record.u.copy()
    plain = model.simulate(u, record.y[0])
    u[30:] += 10.0
    changed = model.simulate(u, record.y[0])
    np.testing.assert_array_equal(changed.y[:30], plain.y[:30])
    np.testing.assert_array_equal(changed.x[:31], plain.x[:31])
    assert not np.allclose(changed.y[30:], plain.y[30:])


def test_saved_and_loaded_it_simulates_bit_identically(name: str, small_data: Callable, tmp_path: Path) -> None:
    dataset = small_data(2, 2, K=450)
    model = fit(name, dataset).model
    model.save(tmp_path)
    again = load_model(tmp_path)
    record = dataset.tests["test"][0]
    np.testing.assert_array_equal(again.simulate(record.u, record.y[0]).y, model.simulate(record.u, record.y[0]).y)


def test_the_scale_of_the_record_does_not_matter(name: str, small_data: Callable) -> None:
    """Volts or millivolts: the simulated output is the same signal."""
    from dataclasses import replace

    from nnss_cli.datasets.record import Record, Scaling

    dataset = small_data(K=300)
    train, val, test = (
        tuple(Record(1000 * r.u + 5, 0.01 * r.y - 3, r.Ts) for r in records) for records in dataset.splits().values()
    )
    other = Dataset(replace(dataset.fitting, train=train, val=val, scaling=Scaling.of(train)), {"test": test})
    record, scaled = dataset.tests["test"][0], test[0]
    y = fit(name, dataset).model.simulate(record.u, record.y[0]).y
    y_other = fit(name, other).model.simulate(scaled.u, scaled.y[0]).y
    np.testing.assert_allclose((y_other + 3) / 0.01, y, rtol=1e-6, atol=1e-6)


def arrays_within(thing: object) -> list[np.ndarray]:
    """Every array that can be reached from an object."""
    if isinstance(thing, np.ndarray):
        return [thing]
    if isinstance(thing, tuple | list):
        return [array for part in thing for array in arrays_within(part)]
    return (
        [array for part in vars(thing).values() for array in arrays_within(part)] if hasattr(thing, "__dict__") else []
    )


def test_no_test_sample_can_be_reached_from_what_a_method_is_given(name: str, small_data: Callable) -> None:
    del name
    dataset = small_data(K=300)
    test = np.concatenate([record.y.ravel() for record in dataset.tests["test"]])
    seen = np.concatenate([array.ravel() for array in arrays_within(dataset.fitting)])
    assert len(seen) > len(test)
    assert not np.isin(test, seen).any()


def test_another_test_record_gives_the_same_model(name: str, small_data: Callable, tmp_path: Path) -> None:
    """Through all that runs a method: its choice of epoch, start and horizon included."""
    dataset = small_data(K=300)
    (record,) = dataset.tests["test"]
    other = Dataset(dataset.fitting, {"test": (type(record)(-record.u, 100 - 7 * record.y, record.Ts),)})
    signals = []
    for index, one in enumerate((dataset, other)):
        store = Store(tmp_path / str(index), one.name, "strict")
        settings = METHODS[name].settings(one.fitting, 2, SMALL)
        assert execute(RunSpec(one.name, "strict", name, 2, 0, settings, "0", "1"), one, store).status == "ok"
        signals.append(read_tensors(next(store.folder.rglob("signals.safetensors"))))
    for split in ("train", "val"):
        np.testing.assert_array_equal(signals[0][f"{split}/0/y_sim"], signals[1][f"{split}/0/y_sim"])


NASTY = {
    "zero input": lambda k: (0 * k, np.sin(k)),
    "constant output": lambda k: (np.sin(k), 0 * k + 2),
    "everything constant": lambda k: (0 * k + 1, 0 * k + 1),
    "ramp": lambda k: (k, k),
    "unstable": lambda k: (np.sin(k), np.exp(k / 8)),
    "sinusoid": lambda k: (np.sin(k), np.cos(k)),
}


@pytest.mark.parametrize("kind", NASTY)
@pytest.mark.parametrize("K", [13, 200])
def test_singular_and_short_problems_end_as_a_row_with_a_reason(name: str, kind: str, K: int, tmp_path: Path) -> None:
    from nnss_cli.datasets.record import Channels, Record, Scaling

    u, y = NASTY[kind](np.arange(float(K)))
    records = (Record(u, y, 1.0),)
    channels = Channels(("u",), ("y",), ("V",), ("m",))
    dataset = Dataset(
        FittingData("nasty", "strict", records, records, Scaling.of(records), channels), {"test": records}
    )
    spec = RunSpec("nasty", "strict", name, 3, 0, METHODS[name].settings(dataset.fitting, 3, SMALL), "0")
    result = execute(spec, dataset, Store(tmp_path, "nasty", "strict"))
    if result.status == "ok":
        assert {score.split for score in result.scores} == {"train", "val", "test"}
        assert all(np.isfinite(score.rmse) for score in result.scores)
    else:
        assert result.reason
        assert not result.scores
