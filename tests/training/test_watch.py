"""When a training ends, what it keeps and what it is given: by scripted errors, without training anything."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.record import Dataset, Record
from nnss_cli.datasets.windows import beginnings

from nnss_cli.iterative import EarlyStopping
from nnss_cli.training import attempt as module
from nnss_cli.training import candidates
from nnss_cli.training.attempt import Clock, Watch, _adam, _lbfgs
from nnss_cli.training.candidates import worth_trying
from nnss_cli.training.fit import _after, stages, train_nnss
from nnss_cli.training.recipe import Recipe, recipe_of

GAUSS = Recipe(
    hidden=(4,), encoder=(4,), dtype="float64", window=0, optimiser="gauss-newton", initial="linear", epochs=40,
    patience=100, consistency=0.0,
)  # fmt: skip


class Script:
    """An engine whose weights count its epochs, and whose validation errors are given."""

    def __init__(self, errors: Sequence[float], monkeypatch: pytest.MonkeyPatch) -> None:
        self.errors, self.placed, self.seen = iter(errors), [], itertools.count(1)
        self.at = 0
        monkeypatch.setattr(module, "free_run_rmse", self.error)

    def error(self, engine: Any, val: Any, init_window: int) -> float:
        self.at += 1
        return next(self.errors)

    def weights(self) -> dict[str, np.ndarray]:
        return {"w": np.array([float(self.at)])}

    def place(self, vector: np.ndarray) -> None:
        self.placed.append(vector.tolist())


def watch(engine: Script, rival: float = math.inf, on_epoch: Any = None, **changes: Any) -> Watch:
    made = Watch((), 1, GAUSS.replace(**changes), rival, Clock(0), on_epoch)
    made.take(engine, (), 1)  # type: ignore[arg-type]
    return made


def epochs_until_it_ends(made: Watch, most: int = 60) -> int:
    return next((epoch for epoch in range(1, most + 1) if not made.goes_on(1.0)), 0)


@pytest.mark.parametrize(
    ("changes", "ends"),
    [
        ({}, 10),
        ({"epochs": 39}, 0),
        ({"epochs": 44}, 10),
        ({"optimiser": "adam"}, 0),
        ({"integrator": "yes"}, 0),
        ({"stability": "incremental"}, 0),
    ],
)
def test_a_start_is_kept_when_ten_epochs_did_not_improve_it_if_a_quarter_is_as_many(
    changes: dict[str, Any], ends: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = watch(Script([1.0] + [2.0] * 60, monkeypatch), **changes)
    made.start()
    assert epochs_until_it_ends(made) == ends


@pytest.mark.parametrize(("error", "ends"), [(1.01, 10), (1.0, 0)])
def test_a_candidate_ends_when_a_quarter_of_the_epochs_left_it_behind_its_rival(
    error: float, ends: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert epochs_until_it_ends(watch(Script([error] * 60, monkeypatch), rival=1.0)) == ends
    assert epochs_until_it_ends(watch(Script([1.01] * 60, monkeypatch), rival=1.0, epochs=3)) == 1
    assert epochs_until_it_ends(watch(Script([1.01] * 60, monkeypatch), rival=1.0, optimiser="adam")) == 0


def test_a_later_stage_is_no_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its epochs count on: a first stage of nine that improved nothing had left the second one."""
    engine, begun = Script([1.0] + [2.0] * 60, monkeypatch), []
    made = watch(engine)

    def iterate(*given: Any) -> None:
        begun.append(next((i for i in range(given[-1]) if not made.goes_on(1.0)), given[-1]))

    attempt: Any = SimpleNamespace(
        recipe=GAUSS, watch=made, samples=0, start="linear", model=None, remarks=(), gauss_newton=iterate
    )
    monkeypatch.setattr(module, "build_engine", lambda *_: engine)
    record = Record(np.zeros((30, 1)), np.zeros((30, 1)), 1.0)
    for epochs in (9, 20):
        module.Attempt.train(attempt, (record,), epochs)
    assert begun == [9, 20]


def test_what_improves_once_before_a_quarter_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    made = watch(Script([1.0, *[2.0] * 8, 0.9, *[2.0] * 60], monkeypatch))
    made.start()
    assert epochs_until_it_ends(made, 50) == 0
    assert made.best_epoch == 9
    assert made.kept["w"] == [10.0]  # after the start's look and nine epochs
    made.begin_again()
    assert made.engine.placed == [[10.0]]  # type: ignore[attr-defined]
    assert (made.stopping.waited, made.stopping.reference, made.epoch_waits) == (0, 0.9, 1)


def test_patience_ends_it_and_every_epoch_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[tuple[int, float, float]] = []
    made = watch(Script([3.0, 2.0, 2.5, 2.5, 2.5], monkeypatch), patience=3, on_epoch=lambda *each: told.append(each))
    assert epochs_until_it_ends(made) == 5
    assert told == [(1, 1.0, 3.0), (2, 1.0, 2.0), (3, 1.0, 2.5), (4, 1.0, 2.5), (5, 1.0, 2.5)]
    assert (made.best_epoch, made.losses, made.errors) == (2, [1.0] * 5, [3.0, 2.0, 2.5, 2.5, 2.5])
    assert made.diverged == ""


def test_numbers_that_are_not_finite_end_it_with_their_epoch(monkeypatch: pytest.MonkeyPatch) -> None:
    made = watch(Script([1.0, math.inf], monkeypatch))
    assert made.goes_on(0.5)
    assert not made.goes_on(0.4)
    assert made.diverged == "the validation error became inf in epoch 2"
    assert (made.best_epoch, made.losses) == (1, [0.5, 0.4])
    lost = watch(Script([1.0], monkeypatch))
    assert lost.goes_on(0.5)
    assert not lost.goes_on(math.nan)
    assert (lost.diverged, lost.losses) == ("the loss became nan in epoch 2", [0.5])


def test_patience_is_reset_by_a_marked_gain_alone() -> None:
    stopping = EarlyStopping(patience=2, improvement=0.1)
    assert stopping.is_best(1.0)
    assert stopping.is_best(0.95)  # the best, but no marked gain
    assert (stopping.waited, stopping.reference, stopping.stop) == (1, 1.0, False)
    assert stopping.is_best(0.9)  # a tenth below the last reset, exactly
    assert (stopping.waited, stopping.reference) == (0, 0.9)
    assert not stopping.is_best(0.9)
    assert not stopping.is_best(5.0)
    assert stopping.stop
    steps = EarlyStopping(patience=30, improvement=0.0)
    steps.is_best(1.0, 10)
    steps.is_best(2.0, 29)
    assert not steps.stop
    steps.is_best(2.0, 1)
    assert steps.stop


def test_a_budget_is_up_after_its_seconds_and_none_never_is(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    two, none = Clock(2.0), Clock(0.0)
    now[0] = 102.0
    assert not two.up
    now[0] = 102.1
    assert two.up
    assert two.elapsed == pytest.approx(2.1)
    now[0] = 1e12
    assert not none.up


def test_epochs_of_a_candidate_count_on_after_those_before_it() -> None:
    told: list[tuple[int, float, float]] = []

    def tell(*each: Any) -> None:
        told.append(each)

    assert _after(0, tell) is tell
    assert _after(7, None) is None
    later = _after(7, tell)
    assert later is not None
    later(1, 0.5, 0.25)
    assert told == [(8, 0.5, 0.25)]


# the optimisers' loops


class Batches:
    """An engine that notes the windows of each step, and a watch that ends after some epochs."""

    def __init__(self, losses: Sequence[float] = (), last: int = 99) -> None:
        self.taken: list[tuple[int, list[int]]] = []
        self.losses, self.told, self.last = list(losses), [], last

    def train_batch(self, windows: np.ndarray, epoch: int) -> float:
        self.taken.append((epoch, windows.tolist()))
        return self.losses.pop(0) if self.losses else 1.0

    def goes_on(self, loss: float) -> bool:
        self.told.append(loss)
        return math.isfinite(loss) and len(self.told) < self.last


def adam(found: Batches, epochs: int = 2) -> Batches:
    recipe = GAUSS.replace(optimiser="adam", batch=3, epochs=epochs, window=10)
    _adam(found, 8, 2, recipe, np.random.default_rng(0), found)  # type: ignore[arg-type]
    return found


def test_an_epoch_of_adam_is_disjoint_batches_and_its_mean_loss() -> None:
    found = adam(Batches([1.0, 2.0, 4.0, 6.0]))
    assert [epoch for epoch, _ in found.taken] == [1, 1, 2, 2]
    for _, pair in itertools.groupby(found.taken, key=lambda each: each[0]):
        first, second = (windows for _, windows in pair)
        assert len(first) == len(second) == 3  # eight windows: two are left over
        assert len({*first, *second}) == 6
    assert found.told == [1.5, 5.0]


def test_adam_ends_when_told_or_when_a_loss_is_not_finite() -> None:
    assert len(adam(Batches(last=1), epochs=5).taken) == 2
    found = adam(Batches([1.0, 1.0, math.nan]), epochs=5)
    assert len(found.taken) == 3  # the batch after it is not trained
    assert math.isnan(found.told[-1])


class Bowl:
    """A quadratic loss about 1, 2, … with curvatures far apart."""

    def __init__(self, last: int = 999) -> None:
        self.placed: list[np.ndarray] = []
        self.told: list[float] = []
        self.last = last

    def weights(self) -> dict[str, np.ndarray]:
        return {"a": np.zeros((2, 2), dtype=np.float32), "b": np.zeros(3)}

    def place(self, vector: np.ndarray) -> None:
        self.placed.append(vector.copy())

    def loss_and_gradient(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        curvature, off = 10.0 ** np.arange(7), vector - np.arange(1, 8)
        return float(0.5 * curvature @ off**2), curvature * off

    def goes_on(self, loss: float) -> bool:
        self.told.append(loss)
        return len(self.told) < self.last


def test_lbfgs_places_each_iterate_and_ends_after_its_iterations_or_when_told() -> None:
    long, short, told = Bowl(), Bowl(), Bowl(last=2)
    _lbfgs(long, 200, long)  # type: ignore[arg-type]
    assert long.placed[-1] == pytest.approx(np.arange(1, 8), abs=1e-4)
    assert long.told == sorted(long.told, reverse=True)
    assert [long.loss_and_gradient(each)[0] for each in long.placed] == pytest.approx(long.told)
    _lbfgs(short, 4, short)  # type: ignore[arg-type]
    assert len(short.told) == len(short.placed) == 4
    _lbfgs(told, 200, told)  # type: ignore[arg-type]
    assert len(told.told) == 2


# what is tried, and on what


def test_a_later_stage_has_half_the_epochs_of_the_one_before_and_one_at_least(
    small_data: Callable[..., Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[tuple[int, int]] = []

    def none(engine: Any, u: Any, y: Sequence[np.ndarray], iterations: int, *_: Any) -> None:
        given.append((sum(map(len, y)), iterations))

    monkeypatch.setattr(module, "gauss_newton", none)
    data = small_data(K=400).fitting
    total = sum(map(len, data.train))
    for epochs, expected in ((9, [9, 4, 2]), (2, [2, 1, 1])):
        given.clear()
        train_nnss(data, 2, 0, GAUSS.replace(epochs=epochs, lead=total // 16))
        assert [iterations for _, iterations in given] == expected
        assert [length for length, _ in given] == [8, 32, total]


def test_stages_are_of_gauss_newton_on_whole_records_alone() -> None:
    (train,) = (tuple(Record(np.zeros((K, 1)), np.zeros((K, 1)), 1.0) for K in (600, 200)),)

    def lengths(**changes: Any) -> list[int]:
        return [sum(map(len, part)) for part in stages(train, GAUSS.replace(**changes))]

    assert lengths(lead=100) == [100, 400, 800]
    assert lengths(lead=101) == [102, 800]  # 4 times it would be over half; beginnings are rounded up
    assert lengths(lead=400) == [400, 800]
    assert lengths(lead=401) == lengths(lead=0) == [800]
    assert lengths(lead=100, window=50) == lengths(lead=100, optimiser="lbfgs") == [800]


def test_beginnings_share_the_samples_by_length_and_leave_none_too_short() -> None:
    records = tuple(Record(np.arange(float(K))[:, None], np.zeros((K, 1)), 1.0) for K in (700, 200, 100))
    assert [len(part) for part in beginnings(records, 100, 3)] == [70, 20, 10]
    assert [len(part) for part in beginnings(records, 101, 3)] == [71, 21, 11]
    assert [len(part) for part in beginnings(records, 10, 3)] == [7, 3, 3]
    assert beginnings(records, 100, 3)[1].u[0] == 0


def test_an_alternative_is_tried_where_training_data_speak_for_it(
    small_data: Callable[..., Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    data = small_data(K=400).fitting
    outputs, longest = data.output_count, max(map(len, data.train))
    recipe = recipe_of("best", {}, 2).replace(feedthrough="auto", integrator="auto")

    def tried(p: float = 1.0, constant: float = 0.0, order: int = outputs + 1) -> tuple[str, ...]:
        monkeypatch.setattr(candidates, "feedthrough_p_value", lambda _: p)
        monkeypatch.setattr(candidates, "longest_time_constant", lambda _: constant)
        return worth_trying(data, order, recipe, data.train)

    assert "feedthrough" in tried(p=0.01)
    assert "feedthrough" not in tried(p=0.0101)
    assert "integrator" in tried(constant=longest)
    assert "integrator" not in tried(constant=longest - 1)
    assert "integrator" not in tried(constant=math.inf, order=outputs)


@pytest.mark.parametrize(("short", "told"), [(0, False), (1, True)])
def test_more_weights_than_measured_outputs_are_told(
    short: int, told: bool, small_data: Callable[..., Dataset], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "gauss_newton", lambda *_: None)
    data, recipe = small_data(K=800).fitting, GAUSS.replace(initial="random")
    K = recipe.architecture(2, data.input_count, data.output_count).weights - short
    assert data.output_count == 1
    training = train_nnss(replace(data, train=(data.train[0][:K],)), 2, 0, recipe)
    assert any("measured outputs" in remark for remark in training.remarks) is told
