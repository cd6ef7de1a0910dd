"""Scores, the store, and sweeps that resume and do not depend on the number of processes."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from nnss_cli.datasets.catalog import load
from nnss_cli.datasets.record import Record, Scaling
from threadpoolctl import threadpool_info, threadpool_limits

from nnss_cli.errors import InputError
from nnss_cli.experiment import ablation
from nnss_cli.experiment import order as order_selection
from nnss_cli.experiment.agreement import OTHER_DATA, difference, unlike
from nnss_cli.experiment.comparison import _facts
from nnss_cli.experiment.execute import execute, simulate_splits
from nnss_cli.experiment.order import OrderRow, order_table, suggest_order
from nnss_cli.experiment.run import RunResult, RunSpec, score_outputs
from nnss_cli.experiment.schema import parse_result
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import Plan, check_order, plan, sweep
from nnss_cli.methods import METHODS, Fit, Method, select
from nnss_cli.report.tables import rmse_markdown, study_rows
from nnss_cli.version import __version__

QUICK = {
    "hidden": (6,), "encoder": (3,), "window": 40, "stride": 60, "batch": 8, "epochs": 2, "initial": "random",
}  # fmt: skip
NOTHING = lambda *_: None  # noqa: E731


def store_for(tmp_path: Path) -> Store:
    return Store(tmp_path, "twotank-sim", "strict")


def run_all(store: Store, seeds: int = 2, jobs: int = 1, overrides: dict | None = None, force: bool = False) -> int:
    dataset = load(store.dataset, store.protocol)
    todo = plan(store, dataset, select([]), [2], range(seeds), QUICK | (overrides or {}), force)
    sweep(todo.todo, dataset, store, jobs, NOTHING, NOTHING)
    return len(todo.todo)


@pytest.fixture(scope="module")
def two_seeds(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder of every method and two seeds, to be copied."""
    folder = tmp_path_factory.mktemp("two-seeds")
    run_all(store_for(folder), seeds=2)
    return folder


@pytest.fixture
def finished(two_seeds: Path, tmp_path: Path) -> Store:
    """A copy of it."""
    shutil.copytree(two_seeds, tmp_path / "finished")
    return store_for(tmp_path / "finished")


def test_scores_by_hand() -> None:
    y, simulated = np.array([[0.0], [2.0]]), np.array([[1.0], [2.0]])
    scaling = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.array([2.0]))
    (score,) = score_outputs("test", [y], [simulated], scaling)
    assert score.rmse == pytest.approx(np.sqrt(0.5))
    assert score.nrmse == pytest.approx(np.sqrt(0.5) / 2)
    assert score.fit_percent == pytest.approx(100 * (1 - 1 / np.sqrt(2)))


def test_a_result_survives_the_disk(finished: Store) -> None:
    store = finished
    assert len(store.results()) == 8
    for result in store.results():
        assert parse_result(json.dumps(result.to_json()).encode()) == result
        assert {s.split for s in result.scores} == {"train", "val", "test"}
        signals = store.signals(result.spec)
        error = signals["test/0/y_sim"] - signals["test/0/y"]
        (score,) = (s for s in result.scores if s.split == "test")
        assert score.rmse == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-14)


def scores_of(store: Store) -> dict:
    return {result.spec.label: (result.scores, result.history) for result in store.results()}


@pytest.mark.system
def test_only_what_is_missing_is_run_and_jobs_do_not_change_numbers(finished: Store, tmp_path: Path) -> None:
    one, two = finished, store_for(tmp_path / "two")
    assert len(one.results()) == 8  # two seeds of nnss and simba, the others once
    assert run_all(one, seeds=2) == 0
    assert run_all(one, seeds=3) == 3  # and the ensemble again
    assert run_all(two, seeds=3, jobs=2) == 10
    assert run_all(two, seeds=3, jobs=2) == 0
    assert scores_of(one) == scores_of(two)


def test_an_unfinished_run_counts_as_missing(finished: Store) -> None:
    store = finished
    before = scores_of(store)
    (store.folder / "runs" / "nnss-n2-s0" / "run.json").unlink()
    assert run_all(store, seeds=2) == 2  # it and the ensemble of which it is a member
    assert scores_of(store) == before


@pytest.mark.system
def test_other_options_are_not_mixed_unless_forced(finished: Store) -> None:
    store = finished
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
    assert len(plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).done) == 1

    monkeypatch.setattr(type(METHODS["n4sid"]), "fit", lambda *_: 3)
    with pytest.raises(TypeError, match="fit of n4sid: expected a Fit, found 3"):  # a fault of the method
        execute(spec, dataset, store)


def edit(path: Path, change: Callable[[dict], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def planned(store: Store, methods: list[str], seeds: int = 1) -> Plan:
    return plan(store, load(store.dataset, store.protocol), select(methods), [2], range(seeds), QUICK, False)


def one_run(tmp_path: Path, change: Callable[[dict], object]) -> Store:
    """A finished run whose run.json was changed."""
    store = store_for(tmp_path)
    dataset = load(store.dataset, store.protocol)
    execute(planned(store, ["n4sid"]).todo[0], dataset, store)
    edit(store.folder / "runs" / "n4sid-n2-s0" / "run.json", change)
    return store


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda run: run["spec"].update(data="0" * 16), "another version of the data"),
        (lambda run: run["provenance"].update(nnss="0.0.9"), f"nnss 0.0.9 instead of {__version__}"),
        (lambda run: run["provenance"].pop("nnss"), "nnss unknown instead of"),
        (lambda run: run["spec"].update(version="0"), "version 0 of the method instead of 1"),
        (lambda run: run["spec"].pop("version"), "version unknown of the method"),
    ],
)
def test_a_run_of_other_data_or_another_version_is_not_reused(
    tmp_path: Path, change: Callable[[dict], object], words: str
) -> None:
    store = one_run(tmp_path, change)
    with pytest.raises(InputError, match=rf"{words}.*--out.*--force"):
        planned(store, ["n4sid"])
    dataset = load(store.dataset, store.protocol)
    todo = plan(store, dataset, select(["n4sid"]), [2], [0], QUICK, True).todo
    assert [spec.label for spec in todo] == ["n4sid-n2-s0"]


def test_other_data_are_not_mixed_in(tmp_path: Path, small_data: Callable) -> None:
    """The same name and options, other samples."""
    store = Store(tmp_path, "small", "strict")
    first, second = small_data(seed=1), small_data(seed=2)
    execute(plan(store, first, select(["n4sid"]), [2], [0], {}, False).todo[0], first, store)
    assert not plan(store, first, select(["n4sid"]), [2], [0], {}, False).todo
    with pytest.raises(InputError, match="another version of the data"):
        plan(store, second, select(["n4sid"]), [2], [0], {}, False)


def test_runs_of_other_library_versions_are_reused_and_told(tmp_path: Path) -> None:
    store = one_run(tmp_path, lambda run: run["provenance"].update(numpy="1.26.0"))
    todo = planned(store, ["n4sid"])
    assert not todo.todo
    (line,) = todo.made_elsewhere()
    assert line.startswith("1 of the finished runs: numpy 1.26.0, here 2.")
    assert not planned(one_run(tmp_path / "same", lambda _: None), ["n4sid"]).made_elsewhere()


def test_an_ensemble_never_shrinks_below_the_seeds_on_disk(tmp_path: Path) -> None:
    store = store_for(tmp_path)
    dataset = load(store.dataset, store.protocol)
    sweep(planned(store, ["nnss-ensemble"], seeds=4).todo, dataset, store, 1, NOTHING, NOTHING)
    before = scores_of(store)
    again = planned(store, ["nnss-ensemble"], seeds=2)
    assert not again.todo
    assert again.done[-1].spec.settings["members"] == [0, 1, 2, 3]
    assert scores_of(store) == before
    (store.folder / "runs" / "nnss-n2-s1" / "run.json").unlink()
    (*_, ensemble) = planned(store, ["nnss-ensemble"], seeds=2).todo
    assert ensemble.settings["members"] == [0, 1, 2, 3]


def diverging(bad: set[int]) -> Callable[..., Fit]:
    """A fit of NN-SS that diverges for some seeds."""
    sound = type(METHODS["nnss"]).fit

    def fit(self: Method, data: object, order: int, seed: int, *rest: object) -> Fit:
        return Fit(None, 3, "the loss became nan") if seed in bad else sound(self, data, order, seed, *rest)

    return fit


@pytest.mark.system
@pytest.mark.parametrize("bad", [{0, 1, 2}, {1, 2}])
def test_an_ensemble_of_diverged_members(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bad: set[int], nnss) -> None:
    monkeypatch.setattr(type(METHODS["nnss"]), "fit", diverging(bad))
    store = store_for(tmp_path)
    dataset = load(store.dataset, store.protocol)
    sweep(planned(store, ["nnss-ensemble", "n4sid"], seeds=3).todo, dataset, store, 1, NOTHING, NOTHING)
    (ensemble,) = (r for r in store.results() if r.spec.method == "nnss-ensemble")
    if len(bad) == 3:
        assert (ensemble.status, ensemble.scores) == ("diverged", ())
        assert ensemble.reason.startswith("none of its 3 members has a model: seed 0 diverged, seed 1 diverged")
    else:
        assert ensemble.status == "ok"
        assert ensemble.remarks == ("2 of 3 members left out: seed 1 diverged, seed 2 diverged",)
    assert nnss("report", "--out", tmp_path).code == 0  # it died on the missing signals
    text = (store.folder / "rmse.md").read_text()
    assert ("nnss-ensemble, order 2, seed 0: diverged: none of its 3 members" in text) == (len(bad) == 3)


@pytest.mark.parametrize(
    "error",
    [
        torch.linalg.LinAlgError("singular"),
        RuntimeError("out of range"),
        np.linalg.LinAlgError("singular"),
        ZeroDivisionError(),
    ],
)
def test_a_numerical_error_ends_the_run_not_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    def fails(*_: object) -> Fit:
        raise error

    store = store_for(tmp_path)
    dataset = load(store.dataset, store.protocol)
    monkeypatch.setattr(type(METHODS["ssregest"]), "fit", fails)
    sweep(planned(store, ["ssregest", "n4sid"]).todo, dataset, store, 1, NOTHING, NOTHING)
    by_method = {r.spec.method: r for r in store.results()}
    assert by_method["ssregest"].status == "failed"
    assert by_method["ssregest"].reason == (str(error) or type(error).__name__)
    assert by_method["n4sid"].status == "ok"


def test_a_model_that_cannot_be_simulated_is_a_failed_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from nnss_cli.baselines.linear_model import LinearModel

    def fails(*_: object) -> None:
        raise torch.linalg.LinAlgError("singular")

    store = store_for(tmp_path)
    monkeypatch.setattr(LinearModel, "simulate", fails)
    result = execute(planned(store, ["n4sid"]).todo[0], load(store.dataset, store.protocol), store)
    assert (result.status, result.reason, result.scores) == ("failed", "its simulation failed: singular", ())


def test_a_method_without_model_and_reason_has_failed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_for(tmp_path)
    monkeypatch.setattr(type(METHODS["n4sid"]), "fit", lambda *_: Fit(None))
    result = execute(planned(store, ["n4sid"]).todo[0], load(store.dataset, store.protocol), store)
    assert (result.status, result.reason) == ("failed", "the method gave no model and no reason")


def test_remarks_of_a_fit_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sound = type(METHODS["n4sid"]).fit
    monkeypatch.setattr(type(METHODS["n4sid"]), "fit", lambda *args: replace(sound(*args), remarks=("noted",)))
    store = store_for(tmp_path)
    execute(planned(store, ["n4sid"]).todo[0], load(store.dataset, store.protocol), store)
    assert store.results()[0].remarks == ("noted",)


def test_the_fit_of_an_output_that_stands_still_is_none() -> None:
    """Its deviation was the rounding of its mean, and the fit -1e17 %: a sensor that sticks, at other levels too."""
    scaling = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
    y = [np.full((120, 1), level) for level in (0.3, 0.1, 1e6 / 3)]
    assert any((part - part.mean(axis=0)).any() for part in y)  # what it is about
    (score,) = score_outputs("test", y, [part + 0.1 for part in y], scaling)
    assert (score.fit_percent, score.rmse) == (0.0, pytest.approx(0.1))


def test_scores_are_of_all_records() -> None:
    scaling = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
    y = [np.zeros((3, 1)), np.zeros((1, 1))]
    (score,) = score_outputs("test", y, [np.zeros((3, 1)), np.full((1, 1), 2.0)], scaling)
    assert score.rmse == 1.0


def test_every_record_is_simulated_and_scored(small_data: Callable) -> None:
    """The second record's error counts as well as the first's."""
    dataset = small_data(K=90)
    (record,) = dataset.tests["test"]
    model = select(["n4sid"])[0].fit(dataset.fitting, 2, 0, {"horizon": "matlab"}, None).model
    off = Record(record.u, record.y + 5.0, record.Ts)
    scores, signals = simulate_splits(model, replace(dataset, tests={"test": (record, off)}))
    (test,) = (s for s in scores if s.split == "test")
    pooled = np.concatenate([signals[f"test/{i}/y_sim"] - signals[f"test/{i}/y"] for i in range(2)])
    assert test.rmse == pytest.approx(np.sqrt(np.mean(pooled**2)), rel=1e-12)
    (alone,) = (s for s in simulate_splits(model, dataset)[0] if s.split == "test")
    assert test.rmse > 2 * alone.rmse


@pytest.mark.parametrize(("second", "chosen"), [(1.04, 1), (1.06, 2)])
def test_an_order_is_good_enough_within_five_percent(second: float, chosen: int) -> None:
    rows = [OrderRow(n, 1.0, 1.0, val) for n, val in ((1, second), (2, 1.0), (3, 1.02), (4, None))]
    assert suggest_order(rows) == chosen


def test_damaged_runs_are_named(finished: Store) -> None:
    store = finished
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


@pytest.mark.parametrize(("method", "states"), [("ssregest", 2), ("n4sid", 3)])
def test_other_methods_and_orders_are_not_run_on_other_data(
    tmp_path: Path, small_data: Callable, method: str, states: int
) -> None:
    """A file that was edited in between gave one table of two records."""
    store = Store(tmp_path, "small", "strict")
    first, second = small_data(seed=1), small_data(seed=2)
    execute(plan(store, first, select(["n4sid"]), [2], [0], {}, False).todo[0], first, store)
    expected = rf"runs of n4sid, order 2, with {re.escape(OTHER_DATA)}"
    with pytest.raises(
        InputError, match=f"{expected}, here its samples of train, val, test: take another folder with --out"
    ):
        plan(store, second, select([method]), [states], [0], {}, False)
    with pytest.raises(InputError, match=f"{expected}, which this command does not replace"):
        plan(store, second, select([method]), [states], [0], {}, True)
    assert [r.spec.label for r in store.results()] == ["n4sid-n2-s0"]
    replaced = plan(store, second, select(sorted({method, "n4sid"})), sorted({2, states}), [0], {}, True)
    assert len(replaced.todo) == 2
    assert not store.results()


def test_a_table_of_runs_on_other_data_says_so(tmp_path: Path, small_data: Callable) -> None:
    store = Store(tmp_path, "small", "strict")
    for seed, method in ((1, "n4sid"), (2, "ssregest")):  # as an older version left them
        dataset = small_data(seed=seed)
        apart = Store(tmp_path / str(seed), "small", "strict")
        execute(plan(apart, dataset, select([method]), [2], [0], {}, False).todo[0], dataset, store)
    text = rmse_markdown(store.results())
    assert "different versions of the data, so not to be compared with the others: ssregest, order 2." in text
    assert "different versions of the data" not in rmse_markdown(store.results()[:1])


def test_the_order_table_says_why_there_is_no_model(small_data: Callable) -> None:
    """A constant output was "too short"."""
    data = small_data(K=300).fitting
    still = tuple(Record(record.u, np.full_like(record.y, 3.3), record.Ts) for record in data.train)
    with pytest.raises(InputError, match="no order up to 2 gives a model; of order 1: output y1 is constant"):
        order_table(replace(data, train=still, scaling=Scaling.of(still)), 2, "auto")


def test_the_order_table_bears_what_linear_algebra_raises(
    small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    sound = order_selection.subspace_model

    def fails(data: object, n: int, horizon: str) -> object:
        if n == 2:
            raise np.linalg.LinAlgError("singular")
        return sound(data, n, horizon)

    monkeypatch.setattr(order_selection, "subspace_model", fails)
    rows = order_table(small_data(K=300).fitting, 3, "matlab")
    assert [row.val is None for row in rows] == [False, True, False]


@pytest.mark.system
@pytest.mark.usefixtures("weak_adversary")
def test_only_runs_with_a_model_are_unbounded_under_stress(
    tmp_path: Path, small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run that diverged in training counted as one whose state grew under stress."""
    monkeypatch.setattr(type(METHODS["nnss"]), "fit", diverging({1}))
    monkeypatch.setattr(ablation, "STRESS", 200)
    store = Store(tmp_path, "small", "strict")
    variants = ablation.ablate(
        store, small_data(K=200), "stability", [2], [0, 1], {"epochs": 1}, 1, NOTHING, NOTHING, NOTHING
    )
    rows = study_rows(variants)
    assert [row["runs"] for row in rows] == ["1/2"] * 4
    assert [row["unbounded under stress"] for row in rows] == ["0 of 1"] * 4
    assert [row["variant"] for row in rows] == ["schur", "quadratic", "incremental", "none"]
    grown = [replace(v, unbounded=v.results[:1]) for v in variants]
    assert [row["unbounded under stress"] for row in study_rows(grown)] == ["1 of 1"] * 4


def test_a_variant_that_does_not_go_with_the_options_is_left_out(
    tmp_path: Path, small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(METHODS["nnss"]), "fit", diverging({0}))

    def of(**options: object) -> list[ablation.Variant]:
        store = Store(tmp_path, "small", "strict")
        return ablation.ablate(
            store, small_data(K=200), "stability", [2], [0], {"epochs": 1} | options, 1, NOTHING, NOTHING, NOTHING
        )

    variants = {variant.name: variant for variant in of(hidden=(3, 3))}
    assert [len(variant.results) for variant in variants.values()] == [1, 1, 0, 1]
    assert "expected one hidden layer, found 2" in variants["incremental"].refused
    assert [row["runs"] for row in study_rows(list(variants.values()))] == ["0/1", "0/1", "–", "0/1"]
    with pytest.raises(InputError, match="gamma"):
        of(gamma=2.0)


def test_threads_are_no_other_options(tmp_path: Path) -> None:
    """They change no number, so a study goes on with what was made by others."""
    made = replace(RunSpec("tank", "strict", "nnss", 2, 0, {"threads": 1, "epochs": 5}, "0", "1"))
    result = RunResult(made, "ok", "", (), 1, 1.0, {"nnss": __version__}, {}, {})
    with_two = replace(made, settings=made.settings | {"threads": 2})
    assert (difference(with_two, result), unlike(with_two, [result])) == ("", "")
    assert all(a == b for _, a, b in _facts(result, replace(result, spec=with_two)))
    other = replace(with_two, settings=with_two.settings | {"epochs": 6})
    assert difference(other, result) == "epochs 5 instead of 6"
    assert "epochs 5 instead of 6" in unlike(other, [result])


def test_a_fit_has_one_blas_thread_whatever_was_loaded_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a notebook NumPy is there before nnss, with as many threads as cores: eight times slower beside other work."""
    seen: list[int] = []

    def counted(*_: object) -> Fit:
        seen.extend(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas")
        return Fit(None, diverged="counted")

    monkeypatch.setattr(METHODS["n4sid"], "fit", counted)
    store, dataset = store_for(tmp_path), load("twotank-sim", "strict")
    todo = plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).todo
    with threadpool_limits(2, "blas"):
        sweep(todo, dataset, store, 1, NOTHING, NOTHING)
        outside = {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}
    assert seen
    assert set(seen) == {1}
    assert 2 in outside
