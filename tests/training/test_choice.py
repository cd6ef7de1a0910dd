"""Which candidate is taken, with what it goes on and what is told: by scripted candidates, without any training."""

import math
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nnss_cli.datasets.record import Dataset, FittingData, Record

from nnss_cli.errors import InputError
from nnss_cli.training import attempt, fit
from nnss_cli.training import start as starts
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.recipe import Recipe, recipe_of
from nnss_cli.training.start import begin

BEST = recipe_of("best", {}, 2).replace(
    feedthrough="auto", integrator="auto", lead=0, judge="validation", scheduling="auto"
)


class Candidates:
    """In the place of attempts: what each comes to is scripted, what each is given is kept."""

    def __init__(
        self, errors: Sequence[float], weights: int = 1, epochs: int = 3, costs: float = 0.0, by_chance: float = 1.0,
        needless: tuple[int, ...] = (), nothing_hidden: tuple[int, ...] = (),
    ) -> None:  # fmt: skip
        self.errors, self.weights, self.epochs, self.costs = iter(errors), weights, epochs, costs
        self.by_chance = by_chance
        self.needless, self.nothing_hidden = needless, nothing_hidden  # numbers of candidates
        self.compared: list[tuple[list[Any], list[Any]]] = []
        self.made: list[Any] = []
        self.now = 0.0

    def attempt(
        self, data: Any, order: int, seed: int, recipe: Recipe, train: Any, val: Any, rival: Any, clock: Any,
        on_epoch: Any, linear: Any,
    ) -> Any:  # fmt: skip
        del linear
        integrator = recipe.integrator == "yes"
        one = SimpleNamespace(
            recipe=recipe, order=order, seed=seed, records=train, held=val, rival=rival, error=next(self.errors),
            samples=0, needless=len(self.made) in self.needless,
            hidden=len(self.made) not in self.nothing_hidden,
            model=SimpleNamespace(architecture=SimpleNamespace(integrator=integrator, weights=self.weights)),
            watch=SimpleNamespace(losses=[], diverged=""), trained=[], told=[], on_epoch=on_epoch,
        )  # fmt: skip

        def go(records: Any, epochs: int) -> None:
            one.trained.append((sum(map(len, records)), epochs))
            one.watch.losses += [1.0] * self.epochs
            one.samples = sum(map(len, records))
            self.now += self.costs
            if on_epoch:
                on_epoch(1, 0.5, 0.25)

        def end(remarks: tuple[str, ...], candidates: dict[str, float], judged_by: str) -> Any:
            return SimpleNamespace(taken=one, remarks=remarks, candidates=candidates, judged_by=judged_by)

        one.train, one.training, one.squares = go, end, lambda: np.array([one])
        one.epochs = lambda stage: recipe.epochs - stage
        self.made.append(one)
        return one

    def chance(self, squares: Any, rival: Any) -> float:
        self.compared.append((list(squares), list(rival)))
        return self.by_chance


@pytest.fixture
def choose(small_data: Callable[..., Dataset], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """`train_nnss` on scripted candidates; gives what came of it, and the candidates."""
    data = small_data(K=600).fitting

    def chosen(
        found: Candidates, names: tuple[str, ...], recipe: Recipe = BEST, on_epoch: Any = None, data: FittingData = data
    ) -> Any:
        monkeypatch.setattr(fit, "Attempt", found.attempt)
        monkeypatch.setattr(fit, "worth_trying", lambda *_: names)
        monkeypatch.setattr(fit, "chance", found.chance)
        monkeypatch.setattr(attempt.time, "monotonic", lambda: found.now)
        return train_nnss(data, 2, 7, recipe, on_epoch)

    return chosen


def test_without_alternatives_the_simplest_is_taken_and_nothing_told(choose: Callable) -> None:
    found = Candidates([1.0])
    came = choose(found, ())
    (one,) = found.made
    assert came.taken is one
    assert (one.recipe, one.order, one.seed, one.rival) == (BEST.simplest(), 2, 7, None)
    assert one.trained == [(200, BEST.epochs)]
    assert (came.remarks, came.candidates) == ((), {})


def test_an_alternative_is_a_change_of_the_best_so_far_and_its_rival_is_that_one(choose: Callable) -> None:
    found = Candidates([1.0, 0.7, 0.69, 0.5])
    told: list[int] = []
    came = choose(found, ("feedthrough", "integrator", "scheduling"), on_epoch=lambda epoch, *_: told.append(epoch))
    assert [one.rival for one in found.made] == [None, found.made[0], found.made[1], found.made[1]]
    fields = [(one.recipe.feedthrough, one.recipe.integrator, one.recipe.scheduling) for one in found.made]
    assert fields == [("no", "no", "x"), ("yes", "no", "x"), ("yes", "yes", "x"), ("yes", "no", "x+u")]
    assert came.taken is found.made[3]
    assert came.candidates == {
        "as it is": 1.0, "feedthrough": 0.7, "feedthrough with integrator": 0.69,
        "feedthrough with scheduling on u": 0.5,
    }  # fmt: skip
    assert came.remarks == (
        "feedthrough taken: it lowers the validation error by more than 20%",
        "feedthrough with scheduling on u taken: it lowers the validation error by more than 20%",
    )
    assert told == [1, 4, 7, 10]  # three epochs of each before


def test_what_won_twice_is_named_once(choose: Callable) -> None:
    came = choose(Candidates([1.0, 0.7, 0.5, 0.3]), ("feedthrough", "integrator", "scheduling"))
    assert list(came.candidates)[1:] == [
        "feedthrough", "feedthrough with integrator", "feedthrough with integrator with scheduling on u",
    ]  # fmt: skip


@pytest.mark.parametrize(("name", "label"), [("stability", "incremental layer"), ("lengthen", "windows that lengthen")])
def test_a_cold_start_takes_a_layers_place_in_the_name_too(name: str, label: str, choose: Callable) -> None:
    came = choose(Candidates([1.0, 0.7, 0.5, 0.3]), ("feedthrough", name, "initial"))
    assert list(came.candidates)[1:] == ["feedthrough", f"feedthrough with {label}", "feedthrough with cold start"]
    assert (came.taken.recipe.stability, came.taken.recipe.lengthen) == ("schur", "no")


def test_of_windows_that_no_record_needs_nothing_is_told(choose: Callable) -> None:
    """Nothing was trained on whole records, so there is no error to compare."""
    found = Candidates([1.0, 0.1, 0.7], needless=(1,))
    came = choose(found, ("lengthen", "scheduling"))
    assert came.candidates == {"as it is": 1.0, "scheduling on u": 0.7}
    assert [one.recipe.lengthen for one in found.made] == ["no", "yes", "no"]
    assert found.made[2].rival is found.made[0]


def test_windows_that_found_no_hidden_optimum_are_not_taken_however_they_validate(choose: Callable) -> None:
    came = choose(Candidates([1.0, 0.1], nothing_hidden=(1,)), ("lengthen",))
    assert came.candidates == {"as it is": 1.0, "windows that lengthen": 0.1}
    assert came.taken.recipe.lengthen == "no"
    assert came.remarks == ("windows that lengthen left: the training error falls by less than 50%",)
    assert choose(Candidates([1.0, 1.1], nothing_hidden=(1,)), ("lengthen",)).remarks == ()


def test_training_takes_one_thread_of_torch(choose: Callable) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        choose(Candidates([1.0]), ())
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(("error", "taken"), [(0.8, 0), (0.79, 1), (math.inf, 0)])
def test_one_must_pay(error: float, taken: int, choose: Callable) -> None:
    found = Candidates([1.0, error])
    assert choose(found, ("feedthrough",)).taken is found.made[taken]


@pytest.mark.parametrize(("error", "p", "compared", "taken"), [
    (0.95, 0.05, 1, 1), (0.95, 0.051, 1, 0), (1.0, 0.0, 0, 0), (0.79, 0.0, 0, 1), (math.inf, 0.0, 0, 0),
])  # fmt: skip
def test_a_small_gain_that_chance_hardly_explains_is_taken_and_told(
    error: float, p: float, compared: int, taken: int, choose: Callable
) -> None:
    """And chance is asked only where it decides."""
    found = Candidates([1.0, error], by_chance=p)
    came = choose(found, ("feedthrough",))
    assert came.taken is found.made[taken]
    assert found.compared == [([found.made[1]], [found.made[0]])] * compared
    margin = "by 5.0%, hardly by chance (p = 0.05)" if compared else "by more than 20%"
    assert came.remarks == (f"feedthrough taken: it lowers the validation error {margin}",) * taken


def test_by_blocks_chance_is_asked_of_all_that_is_held_out(choose: Callable) -> None:
    found = Candidates([1.0, 2.0, 0.9, 1.9], by_chance=0.0)
    came = choose(found, ("feedthrough",), BEST.replace(judge="blocks"))
    assert came.taken is found.made[2]
    assert found.compared == [(found.made[2:], found.made[:2])]


def test_a_later_candidate_is_compared_with_the_one_taken(choose: Callable) -> None:
    found = Candidates([1.0, 0.95, 0.92], by_chance=0.0)
    came = choose(found, ("feedthrough", "integrator"))
    assert came.taken is found.made[2]
    assert found.compared == [([found.made[1]], [found.made[0]]), ([found.made[2]], [found.made[1]])]


def test_only_the_one_taken_goes_through_the_other_stages(choose: Callable) -> None:
    found = Candidates([1.0, 0.1])
    choose(found, ("feedthrough",), BEST.replace(lead=20, epochs=9))
    first, second = found.made
    assert first.trained == [(20, 9)]
    assert second.trained == [(20, 9), (80, 8), (200, 7)]


def test_one_that_diverged_goes_through_no_other_stage(choose: Callable) -> None:
    found = Candidates([math.inf])
    attempt = found.attempt

    def diverging(*args: Any) -> Any:
        one = attempt(*args)
        one.watch.diverged = "ran away"
        return one

    found.attempt = diverging  # type: ignore[method-assign]
    came = choose(found, (), BEST.replace(lead=20))
    assert [each.trained for each in found.made] == [[(20, BEST.epochs)]]
    assert came.remarks == ()


def test_an_integrator_that_won_is_not_changed_into_what_cannot_train_one(choose: Callable) -> None:
    found = Candidates([1.0, 0.1])
    came = choose(found, ("integrator", "initial"))
    assert len(found.made) == 2
    assert list(came.candidates) == ["as it is", "integrator"]
    found = Candidates([1.0, 0.9, 0.1])
    came = choose(found, ("integrator", "initial"))
    assert came.taken.recipe.optimiser == "adam"
    assert came.remarks == ("cold start taken: it lowers the validation error by more than 20%",)


def test_judged_by_blocks_each_part_is_trained_on_the_others(choose: Callable) -> None:
    found = Candidates([1.0, 2.0, 0.1, 0.2])
    came = choose(found, ("feedthrough",), BEST.replace(judge="blocks"))
    parts = len(found.made) // 2
    assert parts == 2
    assert [one.rival for one in found.made] == [None, None, *found.made[:2]]
    assert came.taken is found.made[2]  # the one that validation judges
    lengths = [sum(map(len, one.held)) for one in found.made[:2]]
    expected = math.sqrt((lengths[0] * 1.0 + lengths[1] * 4.0) / sum(lengths))
    assert came.candidates["as it is"] == pytest.approx(expected)
    assert came.remarks == ("feedthrough taken: it lowers the error over 2 blocks by more than 20%",)


def test_a_budget_leaves_out_what_it_has_no_time_for(choose: Callable) -> None:
    found = Candidates([1.0, 0.1], costs=3.0)
    came = choose(found, ("feedthrough", "integrator"), BEST.replace(budget=5.0, lead=20))
    assert len(found.made) == 2
    assert came.taken is found.made[1]
    assert found.made[1].trained == [(20, BEST.epochs)]
    assert came.remarks == (
        "feedthrough taken: it lowers the validation error by more than 20%",
        "stopped by the budget of 5 s, without integrator, stage of 80 samples, stage of 200 samples",
    )
    exactly = choose(Candidates([1.0], costs=5.0), (), BEST.replace(budget=5.0))
    assert exactly.remarks == ()
    over = choose(Candidates([1.0], costs=5.5), (), BEST.replace(budget=5.0))
    assert over.remarks == ("stopped by the budget of 5 s",)


def test_what_a_budget_cut_short_on_some_block_is_not_judged(choose: Callable) -> None:
    found = Candidates([1.0, 1.0, 0.1, 0.1], costs=2.0)
    came = choose(found, ("feedthrough",), BEST.replace(judge="blocks", budget=5.0))
    assert came.taken is found.made[0]
    assert came.candidates == {}
    assert came.remarks == ("stopped by the budget of 5 s, without feedthrough",)
    assert [len(one.trained) for one in found.made] == [1, 1, 1, 0]


def test_a_budget_that_the_start_alone_takes_is_refused(choose: Callable) -> None:
    found = Candidates([1.0])
    attempt = found.attempt

    def slow(*args: Any) -> Any:
        found.now += 6.0
        return attempt(*args)

    found.attempt = slow  # type: ignore[method-assign]
    with pytest.raises(InputError, match=r"budget: 5 s are too few for one candidate, whose start alone took 6\.0 s"):
        choose(found, (), BEST.replace(budget=5.0))


@pytest.mark.parametrize(("weights", "optimiser", "told"), [
    (200, "gauss-newton", False), (201, "gauss-newton", True), (201, "lbfgs", False),
])  # fmt: skip
def test_more_weights_than_measured_outputs_are_told_of_gauss_newton(
    weights: int, optimiser: str, told: bool, choose: Callable
) -> None:
    came = choose(Candidates([1.0], weights=weights), (), BEST.replace(optimiser=optimiser, integrator="no"))
    said = f"{weights} weights for 200 measured outputs: take a lower order or --hidden, or more samples"
    assert came.remarks == (said,) * told


# starts


class Starts:
    """In the place of what makes starts: each fails as it is told, and is noted."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fails: Sequence[str] = (), refused: bool = False) -> None:
        self.seen: list[str] = []
        for name, where in (
            ("linear_start", "SSEST"), ("feedback_start", "feedback"), ("warm_start", "warm"),
            ("linear_layer", "layer"),
        ):  # fmt: skip
            monkeypatch.setattr(starts, name, self.step(where, where in fails, where != "feedback" or not refused))
        monkeypatch.setattr(starts, "waiting_for", lambda what: self.seen.append(f"waits for {what}"))

    def step(self, name: str, fails: bool, gives: bool) -> Callable[..., Any]:
        def run(*_: Any) -> Any:
            self.seen.append(name)
            if fails:
                raise ValueError(f"no\n {name}")
            return gives

        return run


class Model:
    """A model that counts how often its weights were drawn."""

    def __init__(self, stability: str = "schur") -> None:
        self.architecture = SimpleNamespace(
            integrator=False, order=2, gamma=1.0, feedthrough=False, stability=stability, encoder_window=1
        )
        self.drawn = 0

    def initialise(self, random: np.random.Generator) -> None:
        self.drawn += 1


RECORDS = (Record(np.arange(8.0)[:, None], np.arange(8.0)[:, None], 1.0),)


@pytest.mark.parametrize(
    ("initial", "fails", "refused", "start", "remarks", "drawn"),
    [
        ("random", (), False, "random", (), 1), ("linear", (), False, "linear", (), 1),
        ("feedback", (), False, "feedback", (), 1),
        ("feedback", ("SSEST",), False, "random", ("SSEST failed (no SSEST): started from random weights",), 1),
        ("linear", ("warm",), False, "random", ("linear start failed (no warm): started from random weights",), 2),
        ("feedback", (), True, "linear",
         ("feedback start refused: no iterate validated better than the linear model",), 1),
        ("feedback", ("feedback",), False, "linear",
         ("feedback start failed (no feedback): started from the linear model",), 2),
        ("feedback", ("feedback", "warm"), False, "random",
         ("feedback start failed (no feedback): started from the linear model",
          "linear start failed (no warm): started from random weights"), 3),
    ],
)  # fmt: skip
def test_a_start_that_fails_gives_way_to_the_next_and_that_is_told(
    initial: str, fails: tuple[str, ...], refused: bool, start: str, remarks: tuple[str, ...], drawn: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    Starts(monkeypatch, fails, refused)
    model = Model()
    assert begin(model, initial, RECORDS, RECORDS, 0) == (start, remarks)  # type: ignore[arg-type]
    assert model.drawn == drawn


@pytest.mark.parametrize(("stability", "made"), [("incremental", "layer"), ("schur", "warm"), ("quadratic", "warm")])
def test_a_linear_start_is_made_as_the_stability_asks(
    stability: str, made: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    starts = Starts(monkeypatch)
    assert begin(Model(stability), "linear", RECORDS, RECORDS, 0)[0] == "linear"  # type: ignore[arg-type]
    assert starts.seen == ["waits for SSEST, to start from", "SSEST", made]


def test_a_constant_channel_is_named_once_where_a_start_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    Starts(monkeypatch, ["SSEST"])
    still = (Record(np.ones((8, 1)), np.arange(8.0)[:, None], 1.0),)
    _, (remark,) = begin(Model(), "linear", still, still, 0)  # type: ignore[arg-type]
    (name,) = starts.constant_channels(still)
    assert remark == f"SSEST failed (no SSEST; {name} is constant): started from random weights"
