"""Scores, the store, and sweeps that resume and do not depend on the number of processes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.catalog import load
from nnss_cli.datasets.record import Scaling

from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.run import RunResult, score_outputs
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import check_order, plan, sweep
from nnss_cli.methods import METHODS, Fit, select

QUICK = {"hidden": (6,), "encoder": (3,), "window": 40, "stride": 60, "batch": 8, "epochs": 2}
NOTHING = lambda *_: None  # noqa: E731


def store_for(tmp_path: Path) -> Store:
    return Store(tmp_path, "twotank-sim", "strict")


def run_all(store: Store, seeds: int = 2, jobs: int = 1, overrides: dict | None = None, force: bool = False) -> int:
    dataset = load(store.dataset, store.protocol)
    todo = plan(store, dataset, select([]), [2], range(seeds), QUICK | (overrides or {}), force)
    sweep(todo.todo, dataset, store, jobs, NOTHING, NOTHING)
    return len(todo.todo)


def test_scores_by_hand() -> None:
    y, simulated = np.array([[0.0], [2.0]]), np.array([[1.0], [2.0]])
    scaling = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.array([2.0]))
    (score,) = score_outputs("test", [y], [simulated], scaling)
    assert score.rmse == pytest.approx(np.sqrt(0.5))
    assert score.nrmse == pytest.approx(np.sqrt(0.5) / 2)
    assert score.fit_percent == pytest.approx(100 * (1 - 1 / np.sqrt(2)))


def test_a_result_survives_the_disk(tmp_path: Path) -> None:
    store = store_for(tmp_path)
    run_all(store, seeds=1)
    for result in store.results():
        assert RunResult.from_json(result.to_json()) == result
        assert {s.split for s in result.scores} == {"train", "val", "test"}
        signals = store.signals(result.spec)
        error = signals["test/0/y_sim"] - signals["test/0/y"]
        (score,) = (s for s in result.scores if s.split == "test")
        assert score.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-14)


def scores_of(store: Store) -> dict:
    return {result.spec.label: (result.scores, result.history) for result in store.results()}


def test_only_what_is_missing_is_run_and_jobs_do_not_change_numbers(tmp_path: Path) -> None:
    one, two = store_for(tmp_path / "one"), store_for(tmp_path / "two")
    assert run_all(one, seeds=2) == 8  # two seeds of nnss and simba, the others once
    assert run_all(one, seeds=2) == 0
    assert run_all(one, seeds=3) == 3  # and the ensemble again
    assert run_all(two, seeds=3, jobs=2) == 10
    assert run_all(two, seeds=3, jobs=2) == 0
    assert scores_of(one) == scores_of(two)


def test_an_unfinished_run_counts_as_missing(tmp_path: Path) -> None:
    store = store_for(tmp_path)
    run_all(store, seeds=1)
    before = scores_of(store)
    (store.folder / "runs" / "nnss-n2-s0" / "run.json").unlink()
    assert run_all(store, seeds=1) == 2  # it and the ensemble of which it is a member
    assert scores_of(store) == before


def test_other_options_are_not_mixed_unless_forced(tmp_path: Path) -> None:
    store = store_for(tmp_path)
    run_all(store, seeds=2)
    with pytest.raises(InputError, match=r"epochs 2 instead of 3.*--out.*--force"):
        run_all(store, seeds=1, overrides={"epochs": 3})
    run_all(store, seeds=1, overrides={"epochs": 3}, force=True)
    epochs = {r.spec.label: r.spec.settings["epochs"] for r in store.results() if "epochs" in r.spec.settings}
    trained = dict.fromkeys(("nnss-n2-s0", "nnss-ensemble-n2-s0", "simba-n2-s0"), 3)
    assert epochs == trained  # the old seed 1 has gone with its options


def test_failure_and_divergence_are_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, small_data: Callable
) -> None:
    store = store_for(tmp_path)
    dataset = load(store.dataset, store.protocol)
    (spec,) = plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).todo

    def too_large(*_: object) -> Fit:
        raise InputError("order 2 is too large")

    monkeypatch.setattr(type(METHODS["n4sid"]), "fit", too_large)
    result = execute(spec, dataset, store)
    assert (result.status, result.reason, result.scores) == ("failed", "order 2 is too large", ())
    assert plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).todo == [spec]  # tried again

    monkeypatch.setattr(type(METHODS["n4sid"]), "fit", lambda *_: Fit(None, 4, "the loss became nan in epoch 4"))
    result = execute(spec, dataset, store)
    assert (result.status, result.epochs) == ("diverged", 4)
    assert plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).done == 1


def test_damaged_runs_are_named(tmp_path: Path) -> None:
    store = store_for(tmp_path)
    run_all(store, seeds=1)
    path = store.folder / "runs" / "nnss-n2-s0" / "run.json"
    path.write_text("{}")
    with pytest.raises(InputError, match="nnss-n2-s0"):
        store.results()


def test_orders_beyond_the_data_are_refused(small_data: Callable) -> None:
    data = small_data(K=90).fitting  # 30 training samples, r = m = 1
    check_order(10, data)
    for order in (0, -1, 11):
        with pytest.raises(InputError, match=f"expected 1 to 10 .* found {order}"):
            check_order(order, data)
