"""Where a window tells x(0), validation chooses by the rule that scores: x(0) from the window, which is not scored."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import slow_but
from nnss_cli.baselines import ssest as ssest_module
from nnss_cli.baselines.n4sid import n4sid_auto, n4sid_candidates
from nnss_cli.baselines.statespace import LinearStateSpace, simulation_rms
from nnss_cli.datasets.record import Dataset, Record, Scaling, Simulation

from nnss_cli.experiment.execute import simulate_splits
from nnss_cli.experiment.order import order_table
from nnss_cli.methods import METHODS
from nnss_cli.methods.ensemble import better_half
from nnss_cli.training.attempt import build_engine
from nnss_cli.training.engine import free_run_rmse
from nnss_cli.training.feedback import Feedback
from nnss_cli.training.recipe import ENGINES, Recipe

QUICK = {"hidden": (6,), "encoder": (3,), "window": 12, "stride": 12, "batch": 4, "epochs": 3, "dtype": "float64"}
W = 20


@pytest.fixture
def windowed(small_data: Callable, system: Callable) -> Dataset:
    """Its plant is slow, and its records begin elsewhere than one sample tells."""
    dataset, random = small_data(K=240), np.random.default_rng(1)
    plant = LinearStateSpace(*system(2, 1, 1, 5, radius=0.97), 0.5)

    def record() -> Record:
        u = random.standard_normal((80, 1))
        y = plant.simulate(u, 8 * random.standard_normal(2))[0]
        return Record(u, y + 0.01 * random.standard_normal((80, 1)), 0.5)

    train, val, test = ((record(),) for _ in range(3))
    fitting = replace(dataset.fitting, train=train, val=val, scaling=Scaling.of(train), init_window=W)
    return Dataset(fitting, {"test": test})


def scored(model: object, dataset: Dataset, split: str) -> float:
    """The score of a split, in normalised units."""
    scores, _ = simulate_splits(model, dataset)
    return next(s.rmse for s in scores if s.split == split) / dataset.fitting.scaling.y_std[0]


@pytest.mark.parametrize(
    "settings", slow_but((0, 1), [{}, {"initial": "linear", "optimiser": "adam"}, {"engine": "reference"}])
)
@pytest.mark.parametrize("name", ["nnss", "nnss-paper", "simba"])
def test_the_validation_error_of_an_epoch_is_the_score(name: str, settings: dict, windowed: Dataset) -> None:
    method, data = METHODS[name], windowed.fitting
    fit = method.fit(data, 2, 0, method.settings(data, 2, {**QUICK, "start": "random", **settings}), None)
    if fit.best_epoch:
        assert fit.history["val_rmse"][fit.best_epoch - 1] == pytest.approx(
            scored(fit.model, windowed, "val"), rel=1e-6
        )
    else:
        assert min(fit.history["val_rmse"]) >= scored(fit.model, windowed, "val") * (1 - 1e-6)


@pytest.mark.parametrize("engine", ENGINES)
def test_an_engine_runs_from_the_models_window(engine: str, windowed: Dataset) -> None:
    data = windowed.fitting
    model = METHODS["nnss"].fit(data, 2, 0, METHODS["nnss"].settings(data, 2, QUICK), None).model
    (record,) = data.normalised()[1]
    built = build_engine(model, [record.u], [record.y], Recipe(engine=engine, dtype="float64"))
    ours = model.simulate(data.val[0].u, data.val[0].y[:W]).y
    np.testing.assert_allclose(built.free_run(record.u, record.y[:W]), data.scaling.normalise_y(ours), atol=1e-6)
    assert np.abs(built.free_run(record.u, record.y[0]) - data.scaling.normalise_y(ours)).max() > 1e-3
    assert free_run_rmse(built, (record,), W) == pytest.approx(scored(model, windowed, "val"), rel=1e-6)


def test_linear_errors_are_the_score(windowed: Dataset) -> None:
    model = METHODS["n4sid"].fit(windowed.fitting, 2, 0, {"horizon": "matlab"}, None).model
    train, val = windowed.fitting.normalised()
    for split, records in (("train", train), ("val", val)):
        assert simulation_rms(model.system, records, W) == pytest.approx(scored(model, windowed, split), rel=1e-9)


def test_n4sid_chooses_its_horizon_by_the_score(windowed: Dataset) -> None:
    train, val = windowed.fitting.normalised()
    chosen = METHODS["n4sid"].fit(windowed.fitting, 2, 0, {"horizon": "auto"}, None).model.system
    errors = {w: [simulation_rms(model, val, w) for _, model in n4sid_candidates(train, 2)] for w in (1, W)}
    assert np.argmin(errors[1]) != np.argmin(errors[W])
    assert simulation_rms(chosen, val, W) == min(errors[W])
    assert simulation_rms(n4sid_auto(train, val, 2)[0], val) == min(errors[1])


def test_ssest_and_the_order_table_choose_by_the_score(windowed: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[int, int]] = []
    (val,) = windowed.fitting.normalised()[1]
    plain = simulation_rms

    def noting(model: object, records: tuple, init_window: int = 1) -> float:
        seen.append((np.array_equal(records[0].y, val.y), init_window))
        return plain(model, records, init_window)

    monkeypatch.setattr(ssest_module, "simulation_rms", noting)
    METHODS["ssest"].fit(windowed.fitting, 2, 0, {"feedthrough": "no"}, None)
    METHODS["nnss"].fit(windowed.fitting, 2, 0, METHODS["nnss"].settings(windowed.fitting, 2, QUICK), None)
    assert {w for of_val, w in seen if of_val} == {W}
    row = order_table(windowed.fitting, 2, "auto")[1]
    train, _ = windowed.fitting.normalised()
    model, _ = n4sid_auto(train, (val,), 2, W)
    assert (row.train, row.val) == (simulation_rms(model, train, W), simulation_rms(model, (val,), W))


def test_a_feedback_start_is_judged_from_windows(windowed: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    lengths: set[int] = set()
    spreads: list[np.ndarray] = []
    plain = Feedback.state_from

    def noting(self: Feedback, u: np.ndarray, y: np.ndarray, guess: np.ndarray, spread: np.ndarray) -> np.ndarray:
        lengths.add(len(y))
        spreads.append(spread)
        return plain(self, u, y, guess, spread)

    monkeypatch.setattr(Feedback, "state_from", noting)
    fit = METHODS["nnss"].fit(windowed.fitting, 2, 0, METHODS["nnss"].settings(windowed.fitting, 2, QUICK), None)
    assert lengths == {W}
    assert all(np.abs(spread - np.eye(2)).max() > 1e-3 for spread in spreads)  # of the states of each iterate
    assert np.abs(spreads[0] - spreads[-1]).max() > 1e-6
    assert not any("failed" in remark for remark in fit.remarks)


class Off:
    """Simulates the validation record with an error before or after sample W."""

    def __init__(self, dataset: Dataset, before: float, after: float) -> None:
        self.y = {len(r): r.y for r in dataset.fitting.val}
        self.error = before, after

    def simulate(self, u: np.ndarray, y_init: np.ndarray) -> Simulation:
        assert len(y_init) == W
        error = np.where(np.arange(len(u)) < W, *self.error)[:, None]
        return Simulation(self.y[len(u)] + error, np.zeros((len(u), 1)))


def test_an_ensemble_does_not_judge_its_members_by_the_window(windowed: Dataset) -> None:
    good, poor = Off(windowed, 100.0, 0.1), Off(windowed, 0.0, 0.2)
    assert better_half([poor, good], windowed.fitting) == (good,)
