"""What a sweep plans, and what becomes of a run: decided on made-up results, without a fit."""

import json
import re
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.record import Dataset

from nnss_cli.errors import InputError
from nnss_cli.experiment import ablation, execute, executor, sweep
from nnss_cli.experiment.executor import Event, Limits, Lost, Serial, Task, keep_lost, work
from nnss_cli.experiment.provenance import here
from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import Plan, check_count, check_order, plan
from nnss_cli.methods import METHODS, Fit, select, version_of
from nnss_cli.testing import small_dataset
from nnss_cli.version import __version__

DATA = small_dataset(K=600)
METHOD = METHODS["n4sid"]
CHANNELS = {"inputs": ["u"], "outputs": ["y"], "input_units": ["V"], "output_units": ["m"]}


def spec(method: str = "n4sid", order: int = 1, seed: int = 0, **about: Any) -> RunSpec:
    """A run as `plan` would have it, with what else is told."""
    settings = METHODS[METHODS[method].members or method].settings(DATA.fitting, order, {})
    known = {"settings": settings, "data": DATA.fingerprint(), "version": version_of(METHODS[method])} | about
    return RunSpec(DATA.name, DATA.protocol, method, order, seed, **known)


def keep(store: Store, which: RunSpec, status: str = "ok", **provenance: str) -> RunResult:
    scores = (Score("test", "y1", 0.5, 0.5, 50.0),) if status == "ok" else ()
    y = np.zeros((4, 1))
    signals = {"Ts": np.array([0.5]), "test/0/u": y, "test/0/y": y, "test/0/y_sim": y + 0.5, "test/0/x": y}
    made = {"nnss": __version__} | provenance
    result = RunResult(which, status, "" if scores else "why", scores, 0, 1.0, made, {}, CHANNELS)  # type: ignore[arg-type]
    store.write(result, signals if scores else {})
    return result


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "out", DATA.name, DATA.protocol)


def planned(
    store: Store, *methods: str, orders: tuple[int, ...] = (1,), seeds: tuple[int, ...] = (0,), **more: Any
) -> Plan:
    return plan(
        store, DATA, select(methods), orders, seeds, more.pop("overrides", {}), more.pop("force", False), **more
    )


def labels(specs: list[RunSpec]) -> list[str]:
    return [one.label for one in specs]


# limits of a plan


def test_a_linear_model_of_an_order_must_have_as_many_coefficients_as_samples_at_most() -> None:
    # 200 samples of one output: n (1 + 1) coefficients and n states
    assert check_order(66, DATA.fitting) is None
    for order in (0, 67):
        with pytest.raises(
            InputError, match=rf"order: expected 1 to 66 on small \(200 output samples .*, found {order}"
        ):
            check_order(order, DATA.fitting)
    two = small_dataset(r=3, m=2).fitting
    check_order(16, two)  # 100 samples over 6
    with pytest.raises(InputError, match="expected 1 to 16"):
        check_order(17, two)


def test_runs_are_counted_before_they_are_planned(monkeypatch: pytest.MonkeyPatch, store: Store) -> None:
    monkeypatch.setattr(sweep, "MAX_RUNS", 5)
    check_count(5)
    with pytest.raises(InputError, match="expected at most 5 runs in one call, found 6"):
        check_count(6)
    assert len(planned(store, "n4sid", "simba", orders=(1, 1), seeds=(0, 1, 2, 3)).todo) == 5
    with pytest.raises(InputError, match="found 6"):
        planned(store, "n4sid", "simba", orders=(1, 1), seeds=(0, 1, 2, 3, 4))


# plans


def test_methods_without_seeds_run_once_and_orders_once(store: Store) -> None:
    found = planned(store, "n4sid", "simba", orders=(2, 1, 2), seeds=(3, 5))
    assert labels(found.todo) == [
        "n4sid-n2-s0",
        "simba-n2-s3",
        "simba-n2-s5",
        "n4sid-n1-s0",
        "simba-n1-s3",
        "simba-n1-s5",
    ]
    one = found.todo[0]
    assert (one.dataset, one.protocol, one.data, one.version) == (
        "small",
        DATA.protocol,
        DATA.fingerprint(),
        METHOD.version,
    )
    assert one.settings == METHOD.settings(DATA.fitting, 2, {})
    assert (found.done, found.faults) == ([], {})


@pytest.mark.parametrize(
    ("status", "again", "retried"),
    [("ok", False, False), ("diverged", False, False), ("failed", True, True), ("timeout", False, True),
     ("memory", False, True), ("crashed", False, True)],
)  # fmt: skip
def test_failed_runs_are_missing_and_others_only_when_they_are_to_be_tried_again(
    status: str, again: bool, retried: bool, store: Store
) -> None:
    kept = keep(store, spec(), status)
    for found, missing in ((planned(store, "n4sid"), again), (planned(store, "n4sid", retry=True), retried)):
        assert labels(found.todo) == ["n4sid-n1-s0"] * missing
        assert [r.spec for r in found.done] == [kept.spec] * (not missing)


def test_an_ensemble_brings_its_members_and_those_on_disk(store: Store) -> None:
    keep(store, spec("nnss", seed=7))
    found = planned(store, "nnss-ensemble", seeds=(0, 2))
    assert labels(found.todo) == ["nnss-n1-s0", "nnss-n1-s2", "nnss-ensemble-n1-s0"]
    assert found.todo[-1].settings["members"] == [0, 2, 7]
    assert found.done == []
    # finished, it is made again only when its members change
    for seed in (0, 2):
        keep(store, spec("nnss", seed=seed))
    keep(store, found.todo[-1])
    again = planned(store, "nnss-ensemble", "nnss", seeds=(0, 2))
    assert (again.todo, labels([r.spec for r in again.done])) == (
        [], ["nnss-ensemble-n1-s0", "nnss-n1-s0", "nnss-n1-s2"],
    )  # fmt: skip
    more = planned(store, "nnss-ensemble", seeds=(0, 3))
    assert labels(more.todo) == ["nnss-n1-s3", "nnss-ensemble-n1-s0"]
    assert more.todo[-1].settings["members"] == [0, 2, 3, 7]


def test_other_options_are_refused_or_replaced_by_force(store: Store) -> None:
    other = spec(settings=METHOD.settings(DATA.fitting, 1, {"horizon": "matlab"}))
    keep(store, other)
    with pytest.raises(
        InputError, match=r"holds runs of n4sid, order 1, with horizon matlab instead of .*take another"
    ):
        planned(store, "n4sid")
    dry = planned(store, "n4sid", force=True, dry=True)
    assert labels(dry.todo) == ["n4sid-n1-s0"]
    assert store.find(other) is not None
    assert labels(planned(store, "n4sid", force=True).todo) == ["n4sid-n1-s0"]
    assert store.find(other) is None


def test_force_runs_again_what_is_finished_and_keeps_it_until_then(store: Store) -> None:
    keep(store, spec())
    found = planned(store, "n4sid", force=True)
    assert (labels(found.todo), found.done) == (["n4sid-n1-s0"], [])
    assert store.find(spec()) is not None


def test_force_does_not_mix_with_data_that_it_does_not_replace(store: Store) -> None:
    keep(store, spec("ssest", data="other"))
    other = "another version of the data (samples, scaling, names or units)"
    with pytest.raises(InputError, match=re.escape(f"ssest, order 1, with {other}, which this command does not")):
        planned(store, "n4sid", force=True)
    assert labels(planned(store, "ssest", force=True).todo) == ["ssest-n1-s0"]


def test_a_stray_among_others_is_neither_used_nor_replaced(store: Store) -> None:
    for seed in (0, 1):
        keep(store, spec("simba", seed=seed))
    stray = spec("simba", seed=2, settings={"epochs": 1})
    keep(store, stray)
    strange = spec("ssest", data="other")
    keep(store, strange)
    found = planned(store, "simba", "ssest", seeds=(0, 2, 4))
    assert labels(found.todo) == ["simba-n1-s4"]
    assert [r.spec.seed for r in found.done] == [0]
    assert list(found.faults) == ["ssest-n1-s0", "simba-n1-s2"]
    assert found.faults["ssest-n1-s0"] == (
        f"'{store.folder / 'runs' / 'ssest-n1-s0'}' holds a run with another version of the data "
        "(samples, scaling, names or units), unlike others there; remove it, or run it with --force"
    )
    assert "epochs 1 instead of" in found.faults["simba-n1-s2"]
    store.clear(strange)
    assert planned(store, "simba", seeds=(2,), force=True).faults == {}


def test_finished_runs_made_elsewhere_are_told(store: Store) -> None:
    own = {name: value for name, value in here().items() if isinstance(value, str)}
    results = [
        keep(store, spec(seed=s), **(own | {"numpy": numpy})) for s, numpy in enumerate(("0.1", "0.1", own["numpy"]))
    ]
    assert Plan([], results, {}, None).made_elsewhere() == [  # type: ignore[arg-type]
        f"2 of the finished runs: numpy 0.1, here {own['numpy']}"
    ]


# what becomes of a run


class Constant:
    """A model whose outputs are its inputs, moved by a constant."""

    def __init__(self, offset: float = 0.0, fails: Exception | None = None) -> None:
        self.offset, self.fails = offset, fails

    def simulate(self, u: Any, y: Any) -> Any:
        if self.fails:
            raise self.fails
        return SimpleNamespace(y=u + self.offset, x=u[:, :1])

    def save(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "model.json").write_text("{}")


def executed(store: Store, fit: Callable[[], Any], **more: Any) -> RunResult:
    """What comes of a run whose fit does this."""

    class Made(type(METHOD)):  # type: ignore[misc]
        def prepare(self, settings: Any) -> None:
            more.setdefault("prepared", []).append(settings)

        def fit(self, data: Any, order: int, seed: int, settings: Any, on_epoch: Any = None) -> Any:
            return fit()

    result = execute.execute(spec(), DATA, store, method=Made(), command="nnss by hand")
    assert more["prepared"] == [spec().settings]
    on_disk(store, result)
    return result


def on_disk(store: Store, result: RunResult) -> None:
    kept = store.find(spec())
    assert kept is not None
    assert json.dumps(kept.to_json()) == json.dumps(result.to_json())


def raises(error: Exception) -> Callable[[], Any]:
    def fit() -> Any:
        raise error

    return fit


@pytest.mark.parametrize(
    ("fit", "status", "reason"),
    [
        (lambda: Fit(Constant()), "ok", ""),  # type: ignore[arg-type]
        (lambda: Fit(None, diverged="ran away"), "diverged", "ran away"),
        (lambda: Fit(Constant(), diverged="ran away"), "diverged", "ran away"),  # type: ignore[arg-type]
        (lambda: Fit(None), "failed", "the method gave no model and no reason"),
        (raises(ValueError("too\n  short")), "failed", "too short"), (raises(RuntimeError()), "failed", "RuntimeError"),
        (raises(ArithmeticError("x")), "failed", "x"), (raises(np.linalg.LinAlgError("s")), "failed", "s"),
        (raises(MemoryError("9 GB")), "memory", "9 GB"), (raises(MemoryError()), "memory", "MemoryError"),
        (lambda: Fit(Constant(np.inf)), "diverged",  # type: ignore[arg-type]
         "the simulation of train, val, test left the finite range"),
        (lambda: Fit(Constant(fails=ValueError("no"))), "failed", "its simulation failed: no"),  # type: ignore[arg-type]
    ],
)  # fmt: skip
def test_whatever_comes_of_a_fit_is_a_result_with_its_reason(
    fit: Callable[[], Any], status: str, reason: str, store: Store
) -> None:
    store.run_folder(spec()).mkdir(parents=True)
    (store.run_folder(spec()) / "left.txt").write_text("of an earlier run")
    result = executed(store, fit)
    assert (result.status, result.reason) == (status, reason)
    assert bool(result.scores) == (status == "ok")
    assert not (store.run_folder(spec()) / "left.txt").exists()
    assert result.provenance["command"] == "nnss by hand"
    assert list(result.channels["outputs"]) == ["y1"]


def test_a_result_keeps_what_the_fit_tells(store: Store) -> None:
    def fit() -> Fit:
        time.sleep(0.05)
        return Fit(Constant(), 7, "", {"val": [1.0, 2.0]}, ("a remark",))  # type: ignore[arg-type]

    result = executed(store, fit)
    assert (result.epochs, result.history, result.remarks) == (7, {"val": [1.0, 2.0]}, ("a remark",))
    assert 0.05 <= result.fit_seconds < 5
    assert result.fit_seconds == round(result.fit_seconds, 3)
    assert [score.split for score in result.scores] == ["train", "val", "test"]
    (record,) = DATA.tests["test"]
    error = float(np.sqrt(np.mean((record.u - record.y) ** 2)))
    assert result.scores[2].rmse == pytest.approx(error)
    assert result.scores[2].nrmse == pytest.approx(error / DATA.fitting.scaling.y_std[0])


def test_a_fault_of_a_method_is_none_of_numerics(store: Store) -> None:
    with pytest.raises(KeyError):
        executed(store, raises(KeyError("x")))


def members(statuses: list[str]) -> list[RunResult]:
    return [
        RunResult(spec("nnss", seed=i), status, "", (), 0, 1.0, {}, {}, {})  # type: ignore[arg-type]
        for i, status in enumerate(statuses)
    ]


@pytest.mark.parametrize(
    ("statuses", "taken", "remarks", "diverged"),
    [
        (["ok", "ok"], [0, 1], ("own",), ""),
        (["ok", "failed", "diverged"], [0], ("own", "2 of 3 members left out: seed 1 failed, seed 2 diverged"), ""),
        (["failed", "timeout"], [], (), "none of its 2 members has a model: seed 0 failed, seed 1 timeout"),
        ([], [], (), "none of its 0 members has a model: none ran"),
    ],
)  # fmt: skip
def test_a_combination_is_of_the_members_that_have_a_model(
    statuses: list[str], taken: list[int], remarks: tuple[str, ...], diverged: str, store: Store,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(execute, "load_model", lambda folder: folder.name)
    seen: list[Any] = []

    def combine(models: list[Any], data: Any) -> Fit:
        seen.extend(models)
        return Fit(None, remarks=("own",))

    found = execute.combined(SimpleNamespace(combine=combine), members(statuses), DATA, store)  # type: ignore[arg-type]
    assert seen == [f"nnss-n1-s{seed}" for seed in taken]
    assert (found.remarks, found.diverged) == (remarks, diverged)


def test_a_damaged_member_costs_the_combination_alone(store: Store) -> None:
    with pytest.raises(ValueError, match=r"model\.json"):
        execute.combined(METHODS["nnss-ensemble"], members(["ok"]), DATA, store)


# one task after the other


@pytest.mark.parametrize("limits", [{"seconds": 0.0}, {"seconds": -1.0}, {"bytes": 0}, {"bytes": -5}])
def test_limits_are_positive(limits: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="expected a positive number"):
        Limits(**limits)
    Limits(0.001, 1).require_supported()


def test_a_limit_of_memory_needs_a_system_that_tells_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executor, "Path", lambda _: SimpleNamespace(exists=lambda: False))
    Limits(1.0).require_supported()
    with pytest.raises(InputError, match="--memory-limit: expected a system with /proc"):
        Limits(bytes=1).require_supported()


def test_one_task_is_executed_when_it_is_waited_for(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    slept: list[float] = []
    monkeypatch.setattr(executor.time, "sleep", slept.append)
    outcomes = iter([members(["ok"])[0], InputError("full")])

    def scripted(*_: Any) -> RunResult:
        outcome = next(outcomes)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(executor, "work", scripted)
    serial = Serial(DATA, store, lambda _: None)
    for good in (True, False):
        assert serial.free == 1
        future = serial.submit(Task(spec(), "x"))
        assert (serial.free, future.done()) == (0, False)
        serial.wait(9.0)
        assert (serial.free, future.done(), slept) == (1, True, [])
        assert (future.exception() is None) is good
    serial.wait(0.25)
    assert slept == [0.25]


def test_a_run_tells_when_it_begins_and_each_epoch(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    prepared: list[Any] = []
    monkeypatch.setattr(type(METHOD), "prepare", lambda _, settings: prepared.append(settings))

    def fits(which: RunSpec, dataset: Dataset, where: Store, on_epoch: Callable, command: str) -> RunResult:
        on_epoch(3, 0.5, 0.25)
        return members([command])[0]

    monkeypatch.setattr(executor, "execute", fits)
    heard: list[Event] = []
    result = work(Task(spec(), "by hand"), DATA, store, heard.append)
    assert result.status == "by hand"
    assert heard == [Event(spec(), waits_for="compiling", begun=False), Event(spec()), Event(spec(), 3, 0.25)]
    assert (heard[1].begun, heard[1].epoch, heard[1].waits_for) == (True, 0, "")
    assert prepared == [spec().settings]


def test_epochs_are_told_seldom_and_all_else_always(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 0.1, 0.25, 0.3, 0.5, 0.5, 0.6, 0.75])
    now = [next(clock)]
    monkeypatch.setattr(executor, "time", SimpleNamespace(monotonic=lambda: now[0]))
    heard: list[Event] = []
    tell = executor.seldom(heard.append, 0.2)
    events = [
        Event(spec(), waits_for="compiling", begun=False), Event(spec(), 1, 0.5), Event(spec(), 2, 0.4),
        Event(spec()), Event(spec(), waits_for="SSEST"), Event(spec(), 3, 0.3), Event(spec(), 4, 0.2),
        Event(spec(), 5, 0.1),
    ]  # fmt: skip
    for event in events:
        tell(event)
        now[0] = next(clock, 9.0)
    assert heard == [events[0], events[2], events[3], events[4], events[7]]


def test_a_method_with_a_fault_costs_its_run_and_a_full_disk_the_command(
    store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: Any, **__: Any) -> RunResult:
        raise error

    monkeypatch.setattr(executor, "execute", fails)
    error: Exception = KeyError("lost")
    result = work(Task(spec(), "by hand"), DATA, store, lambda _: None)
    assert (result.status, result.reason, result.scores) == ("crashed", "KeyError: 'lost'", ())
    on_disk(store, result)
    error = InputError("the disk is full")
    with pytest.raises(InputError, match="the disk is full"):
        work(Task(spec(), "by hand"), DATA, store, lambda _: None)


def test_a_lost_run_is_kept_with_its_reason_in_place_of_what_was_there(store: Store) -> None:
    keep(store, spec())
    lost = Lost("timeout", "took 9 s", 9.12345)
    assert not lost.again
    assert str(lost) == "took 9 s"
    result = keep_lost(Task(spec(), "by hand"), lost, DATA, store)
    assert (result.status, result.reason, result.fit_seconds, result.epochs) == ("timeout", "took 9 s", 9.123, 0)
    assert (result.provenance["command"], result.notes) == ("by hand", DATA.notes)
    assert not (store.run_folder(spec()) / "signals.safetensors").exists()
    assert store.find(spec()) is not None


# studies


def test_variants_have_folders_of_their_own(store: Store) -> None:
    found = ablation.variant_store(store, "class", "scheduling x+u, with feedthrough")
    assert found.out == store.out / "ablation" / "class" / "scheduling-x-u--with-feedthrough"
    assert (found.dataset, found.protocol) == (store.dataset, store.protocol)


def test_a_study_runs_its_switches_and_shows_what_was_asked_for(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ablation, "STUDIES", {"mine": {"plain": {}, "short": {"epochs": 3}}})
    done: list[Any] = []

    def runs(todo: list[RunSpec], dataset: Dataset, own: Store, jobs: int, on_event: Any, on_result: Any) -> None:
        for which in todo:
            on_result(keep(own, which))

    monkeypatch.setattr(ablation, "sweep", runs)
    planned_: list[tuple[str, int]] = []

    def study(orders: tuple[int, ...], seeds: tuple[int, ...]) -> list[ablation.Variant]:
        return ablation.ablate(
            store, DATA, "mine", orders, seeds, {"epochs": 9, "nnss.hidden": (4,)}, 1,
            lambda name, count: planned_.append((name, count)), lambda _: None, done.append,
        )  # fmt: skip

    plain, short = study((1, 2), (0, 1))
    assert planned_ == [("plain", 4), ("short", 4)]
    assert len(done) == 8
    assert (plain.name, short.name, plain.unbounded, plain.left_out) == ("plain", "short", None, ())
    assert {r.spec.settings["epochs"] for r in plain.results} == {9}
    assert {r.spec.settings["epochs"] for r in short.results} == {3}
    assert all(list(r.spec.settings["hidden"]) == [4] for r in plain.results)
    fewer, _ = study((2,), (1, 2))
    assert [(r.spec.order, r.spec.seed) for r in fewer.results] == [(2, 1), (2, 2)]
    assert planned_[2:] == [("plain", 1), ("short", 1)]
    monkeypatch.setattr(ablation, "STUDIES", {"mine": {"plain": {"epochs": 2}, "short": {"epochs": 3}}})
    with pytest.raises(InputError, match="epochs: each variant of the study 'mine' has one of its own: leave it out"):
        study((2,), (0,))
    with pytest.raises(InputError, match="study"):
        ablation.ablate(store, DATA, "none", (1,), (0,), {}, 1, lambda *_: None, lambda _: None, lambda _: None)
