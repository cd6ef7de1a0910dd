"""The laws that every method obeys, for the tests of one's own: `pytest` with

    from nnss_cli.testing import MethodLaws
    from their_package import TheirMethod

    class TestTheirMethod(MethodLaws):
        method = TheirMethod()
        overrides = {"epochs": 3}  # options that make it fast

It needs pytest, which nnss itself does not.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.store import Store
from nnss_cli.methods import Fit, Method, Model, load_model, sound_method
from nnss_cli.modelfile import read_tensors


def linear_system(
    n: int, r: int, m: int, seed: int, radius: float = 0.9
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A random stable system A, B, C, D = 0 with spectral radius `radius`."""
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    return A, random.standard_normal((n, r)), random.standard_normal((m, n)), np.zeros((m, r))


def small_dataset(r: int = 1, m: int = 1, K: int = 150, seed: int = 0) -> Dataset:
    """A short record of a linear system of order 2 with noise: a third of it each for train, validation and test.

    Args:
        r: number of inputs.
        m: number of outputs.
        K: samples in all.
        seed: of the system, the input and the noise.
    """
    plant = LinearStateSpace(*linear_system(2, r, m, seed), 0.5)
    random = np.random.default_rng(seed)
    u = random.standard_normal((K, r))
    y = plant.simulate(u, np.ones(2))[0] + 0.01 * random.standard_normal((K, m)) + 3.0
    record = Record(u, y, 0.5)
    third = K // 3
    channels = Channels(
        tuple(f"u{i + 1}" for i in range(r)), tuple(f"y{i + 1}" for i in range(m)), ("V",) * r, ("m",) * m
    )
    train = (record[:third],)
    fitting = FittingData("small", "strict", train, (record[third : 2 * third],), Scaling.of(train), channels)
    return Dataset(fitting, {"test": (record[2 * third :],)})


def arrays_within(thing: object) -> list[FloatArray]:
    """Every array that can be reached from an object."""
    if isinstance(thing, np.ndarray):
        return [thing]
    if isinstance(thing, tuple | list):
        return [array for part in thing for array in arrays_within(part)]
    return (
        [array for part in vars(thing).values() for array in arrays_within(part)] if hasattr(thing, "__dict__") else []
    )


NASTY: dict[str, Callable[[FloatArray], tuple[FloatArray, FloatArray]]] = {
    "zero input": lambda k: (0 * k, np.sin(k)),
    "constant output": lambda k: (np.sin(k), 0 * k + 2),
    "everything constant": lambda k: (0 * k + 1, 0 * k + 1),
    "ramp": lambda k: (k, k),
    "unstable": lambda k: (np.sin(k), np.exp(k / 8)),
    "sinusoid": lambda k: (np.sin(k), np.cos(k)),
}
"""Signals u(k), y(k) that no model can be determined from, or hardly."""


class MethodLaws:
    """What every method must obey, whatever it is."""

    method: ClassVar[Method]
    """The method under test."""
    overrides: ClassVar[dict[str, Any]] = {}
    """Options that make it fast."""

    @pytest.fixture
    def subject(self) -> Method:
        """The method under test; to be parametrised where one class is for several."""
        return self.method

    def fitted(self, subject: Method, dataset: Dataset, order: int = 2, seed: int = 0) -> Fit:
        """A fit with the options of `overrides`."""
        data = dataset.fitting
        return subject.fit(data, order, seed, subject.settings(data, order, self.overrides), None)

    def model(self, subject: Method, dataset: Dataset, order: int = 2, seed: int = 0) -> Model:
        """The model of a fit that must have one."""
        fit = self.fitted(subject, dataset, order, seed)
        assert fit.model is not None, f"no model: {fit.diverged or 'no reason given'}"
        return fit.model

    def run(self, subject: Method, dataset: Dataset, store: Store, order: int = 2) -> RunResult:
        """A run through all that the bench does with a method."""
        settings = subject.settings(dataset.fitting, order, self.overrides)
        spec = RunSpec(dataset.name, store.protocol, subject.name, order, 0, settings, "0", subject.version)
        return execute(spec, dataset, store, method=subject)

    def test_it_keeps_the_protocol(self, subject: Method) -> None:
        """Name, options, kinds of model: what a plug-in is refused for."""
        assert sound_method(subject) is subject

    def test_settings_are_plain_data_and_repeat(self, subject: Method) -> None:
        """They are kept as JSON and compared with those of the next call."""
        data = small_dataset(K=300).fitting
        settings = subject.settings(data, 2, self.overrides)
        plain = {name: list(value) if isinstance(value, tuple) else value for name, value in settings.items()}
        assert json.loads(json.dumps(settings)) == plain
        assert subject.settings(data, 2, self.overrides) == settings
        ignored = subject.settings(data, 2, self.overrides | {"of another method": 1})
        assert ignored == settings

    @pytest.mark.parametrize(("r", "m"), [(1, 1), (2, 1), (1, 2), (2, 3)])
    def test_shapes_units_and_finiteness(self, subject: Method, r: int, m: int) -> None:
        """y (K, m) and x (K, n), finite, from one output sample or a window of four."""
        dataset = small_dataset(r, m, K=450)
        model = self.model(subject, dataset)
        record = dataset.tests["test"][0]
        for y_init in (record.y[0], record.y[:1], record.y[:4]):
            simulation = model.simulate(record.u, y_init)
            assert simulation.y.shape == record.y.shape
            assert simulation.x.shape == (len(record), 2)
            assert np.isfinite(simulation.y).all()
        assert model.Ts == record.Ts
        assert len(model.channels.outputs) == m

    def test_it_fits_two_experiments_of_different_length(self, subject: Method) -> None:
        """Train and validation may be several records."""
        dataset = small_dataset(2, 2, K=600)
        (train,), (val,) = dataset.fitting.train, dataset.fitting.val
        parts = replace(dataset.fitting, train=(train[:80], train[80:]), val=(val[:120], val[120:]))
        model = self.model(subject, Dataset(parts, dataset.tests))
        assert np.isfinite(model.simulate(val.u, val.y[0]).y).all()

    def test_fitting_is_deterministic_and_changes_nothing(self, subject: Method) -> None:
        """The same data, options and seed give the same model; the data stay as they are."""
        dataset = small_dataset(K=300)
        before = dataset.fingerprint()
        record = dataset.tests["test"][0]
        first, second = (self.model(subject, dataset, seed=5).simulate(record.u, record.y[0]).y for _ in range(2))
        np.testing.assert_array_equal(first, second)
        assert dataset.fingerprint() == before

    def test_the_result_does_not_depend_on_earlier_seeds(self, subject: Method) -> None:
        """A seed is all that randomness comes from."""
        dataset = small_dataset(K=300)
        record = dataset.tests["test"][0]
        alone = self.model(subject, dataset, seed=2).simulate(record.u, record.y[0]).y
        self.fitted(subject, dataset, seed=1)
        np.testing.assert_array_equal(self.model(subject, dataset, seed=2).simulate(record.u, record.y[0]).y, alone)

    def test_simulation_is_causal(self, subject: Method) -> None:
        """A later input changes no earlier output, and it does change later ones."""
        dataset = small_dataset(K=300)
        model = self.model(subject, dataset)
        record = dataset.tests["test"][0]
        u = record.u.copy()
        plain = model.simulate(u, record.y[0])
        u[30:] += 10.0
        changed = model.simulate(u, record.y[0])
        np.testing.assert_array_equal(changed.y[:30], plain.y[:30])
        np.testing.assert_array_equal(changed.x[:31], plain.x[:31])
        assert not np.allclose(changed.y[30:], plain.y[30:])

    def test_saved_and_loaded_it_simulates_bit_identically(self, subject: Method, tmp_path: Path) -> None:
        """Through the files of `save`, by the readers that the method names."""
        dataset = small_dataset(2, 2, K=450)
        model = self.model(subject, dataset)
        model.save(tmp_path)
        again = load_model(tmp_path, subject.models)
        record = dataset.tests["test"][0]
        np.testing.assert_array_equal(again.simulate(record.u, record.y[0]).y, model.simulate(record.u, record.y[0]).y)

    def test_the_scale_of_the_record_does_not_matter(self, subject: Method) -> None:
        """Volts or millivolts: the simulated output is the same signal."""
        dataset = small_dataset(K=300)
        train, val, test = (
            tuple(Record(1000 * r.u + 5, 0.01 * r.y - 3, r.Ts) for r in records)
            for records in dataset.splits().values()
        )
        other = Dataset(replace(dataset.fitting, train=train, val=val, scaling=Scaling.of(train)), {"test": test})
        record, scaled = dataset.tests["test"][0], test[0]
        y = self.model(subject, dataset).simulate(record.u, record.y[0]).y
        y_other = self.model(subject, other).simulate(scaled.u, scaled.y[0]).y
        np.testing.assert_allclose((y_other + 3) / 0.01, y, rtol=1e-6, atol=1e-6)

    def test_no_test_sample_can_be_reached_from_what_it_is_given(self, subject: Method) -> None:
        """By type: the test records are not in it."""
        del subject
        dataset = small_dataset(K=300)
        test = np.concatenate([record.y.ravel() for record in dataset.tests["test"]])
        seen = np.concatenate([array.ravel() for array in arrays_within(dataset.fitting)])
        assert len(seen) > len(test)
        assert not np.isin(test, seen).any()

    def test_another_test_record_gives_the_same_model(self, subject: Method, tmp_path: Path) -> None:
        """Through all that runs a method: its choice of epoch, start and horizon included."""
        dataset = small_dataset(K=300)
        (record,) = dataset.tests["test"]
        other = Dataset(dataset.fitting, {"test": (Record(-record.u, 100 - 7 * record.y, record.Ts),)})
        signals = []
        for index, one in enumerate((dataset, other)):
            store = Store(tmp_path / str(index), one.name, "strict")
            result = self.run(subject, one, store)
            assert result.status == "ok", result.reason
            signals.append(read_tensors(next(store.folder.rglob("signals.safetensors"))))
        for split in ("train", "val"):
            np.testing.assert_array_equal(signals[0][f"{split}/0/y_sim"], signals[1][f"{split}/0/y_sim"])

    @pytest.mark.parametrize("kind", NASTY)
    @pytest.mark.parametrize("K", [13, 200])
    def test_singular_and_short_problems_end_as_a_row_with_a_reason(
        self, subject: Method, kind: str, K: int, tmp_path: Path
    ) -> None:
        """No traceback and no NaN in a table."""
        u, y = NASTY[kind](np.arange(float(K)))
        records = (Record(u, y, 1.0),)
        channels = Channels(("u",), ("y",), ("V",), ("m",))
        dataset = Dataset(
            FittingData("nasty", "strict", records, records, Scaling.of(records), channels), {"test": records}
        )
        result = self.run(subject, dataset, Store(tmp_path, "nasty", "strict"), order=3)
        if result.status == "ok":
            assert {score.split for score in result.scores} == {"train", "val", "test"}
            assert all(np.isfinite(score.rmse) for score in result.scores)
        else:
            assert result.reason
            assert not result.scores
