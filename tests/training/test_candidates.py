"""Feedthrough and stages: what is found, who is taken, and that a short record trains as before."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.signal
import scipy.stats
from conftest import slow_but
from nnss_cli.baselines.ssest import ssest, ssest_by_validation
from nnss_cli.baselines.statespace import LinearStateSpace, simulation_rms
from nnss_cli.datasets.record import Dataset, FittingData, FloatArray, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS
from nnss_cli.training import attempt as module
from nnss_cli.training import candidates as candidates_module
from nnss_cli.training import fit
from nnss_cli.training import recipe as recipe_module
from nnss_cli.training.attempt import Attempt, Clock
from nnss_cli.training.candidates import STRETCHES, blocks, chance, pays, pooled, worth_trying
from nnss_cli.training.fit import stages, train_nnss
from nnss_cli.training.recipe import JUDGES, Recipe, recipe_of
from nnss_cli.training.warm import LinearStart, linear_start

RECIPE = Recipe(
    hidden=(4,), encoder=(4,), dtype="float64", window=0, optimiser="gauss-newton", initial="feedback", epochs=40,
    patience=40, consistency=0.0, feedthrough="auto",
)  # fmt: skip


UNITS = recipe_module.UNITS


@pytest.fixture(autouse=True)
def small_layers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small generators are tried against small layers here."""
    monkeypatch.setattr(recipe_module, "UNITS", 1)


def records(plant: Callable[[np.ndarray], np.ndarray], *lengths: int) -> tuple[Record, ...]:
    random = np.random.default_rng(5)
    inputs = [random.standard_normal((K, 1)) for K in lengths]
    return tuple(Record(u, plant(u), 1.0) for u in inputs)


def with_feedthrough(u: np.ndarray) -> np.ndarray:
    """A saturating system whose input shows at once: half of the output's variance is D u."""
    x, y = np.zeros(2), np.empty((len(u), 1))
    A, B = np.array([[0.9, 0.2], [-0.2, 0.9]]), np.array([0.0, 0.3])
    for k, (now,) in enumerate(u):
        y[k] = x[0] + 0.8 * now
        x = A @ x + B * now - np.array([0.0, 0.15]) * np.tanh(2 * x[0])
    return y


def without_feedthrough(u: np.ndarray) -> np.ndarray:
    return with_feedthrough(u) - 0.8 * u


def fitting(base: Dataset, plant: Callable[[np.ndarray], np.ndarray], K: int = 600) -> FittingData:
    train, val = records(plant, K, 300)
    return replace(base.fitting, train=(train,), val=(val,), scaling=Scaling.of((train,)))


@pytest.mark.system
def test_a_feedthrough_is_found_from_data_without_noise(small_data: Callable) -> None:
    data = replace(fitting(small_data(), with_feedthrough, K=1500), init_window=10)
    training = train_nnss(data, 2, 0, RECIPE.replace(hidden=(8,), epochs=100))
    assert training.model.architecture.feedthrough
    assert min(training.val_rmse) < 1e-3
    assert training.candidates["feedthrough"] < 1e-2 < 0.3 < training.candidates["as it is"]
    assert training.remarks == ("feedthrough taken: it lowers the validation error by more than 20%",)


@pytest.mark.system
def test_a_system_without_one_keeps_the_papers_structure(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    data = fitting(small_data(), without_feedthrough)
    noisy = tuple(
        replace(r, y=r.y + 0.05 * np.random.default_rng(1).standard_normal(r.y.shape)) for r in (*data.train, *data.val)
    )
    data = replace(data, train=noisy[:1], val=noisy[1:])
    auto, plain = (train_nnss(data, 2, 0, RECIPE.replace(feedthrough=each)) for each in ("auto", "no"))
    assert not auto.model.architecture.feedthrough
    assert auto.val_rmse == plain.val_rmse
    assert auto.candidates == plain.candidates == {}  # none was tried
    monkeypatch.setattr(candidates_module, "feedthrough_p_value", lambda _: 0.0)
    tried = train_nnss(data, 2, 0, RECIPE)
    assert not tried.model.architecture.feedthrough
    assert tried.val_rmse == plain.val_rmse  # to the last bit: the other candidate left no trace
    assert set(tried.candidates) == {"as it is", "feedthrough"}


def test_a_candidate_must_pay() -> None:
    assert not pays(0.81, 1.0)
    assert pays(0.79, 1.0)
    assert pays(2.0, np.inf)
    assert not pays(np.inf, np.inf)
    assert not pays(np.inf, 1.0)
    assert pays(0.99, 1.0, simpler=True)
    assert not pays(1.0, 1.0, simpler=True)
    assert not pays(np.inf, np.inf, simpler=True)
    assert pays(0.99, 1.0, by_chance=0.05)
    assert not pays(0.99, 1.0, by_chance=0.051)
    assert not pays(1.0, 1.0, by_chance=0.0)


def correlated(random: np.random.Generator, K: int, a: float = 0.9) -> FloatArray:
    """K samples of an autoregressive process of unit variance whose correlation falls by `a` a sample."""
    noise = random.standard_normal((2, K + 200)) * np.sqrt(1 - a * a)
    return np.asarray(scipy.signal.lfilter([1.0], [1.0, -a], noise)[:, 200:])


@pytest.mark.system
def test_equally_good_candidates_are_told_apart_as_often_as_the_level_says() -> None:
    """Of 2000 pairs of correlated errors, none better on the average, 1 % at 1 %; sample by sample it would be 23 %."""
    random = np.random.default_rng(0)
    p, naive = [], []
    for _ in range(2000):
        one, other = np.square(correlated(random, 800))
        p.append(chance(one, other))
        naive.append(scipy.stats.ttest_1samp(other - one, 0, alternative="greater").pvalue)
    assert 0.004 <= np.mean(np.array(p) <= 0.01) <= 0.016
    assert 0.03 <= np.mean(np.array(p) <= 0.05) <= 0.07
    assert np.mean(np.array(naive) <= 0.01) > 0.1


def test_a_candidate_that_is_better_all_along_is_found_so_and_one_of_a_lucky_moment_is_not() -> None:
    random = np.random.default_rng(1)
    noise, _ = correlated(random, 2000)
    shared = np.square(noise)
    assert chance(0.95 * shared, shared) < 1e-3
    assert chance(shared, 0.95 * shared) > 1 - 1e-3
    lucky = shared.copy()
    lucky[:100] *= 0.1  # as much better on the whole, by its beginning alone
    assert lucky.mean() < 0.96 * shared.mean()
    assert chance(lucky, shared) > 0.05


def test_chance_is_students_test_of_eight_stretches() -> None:
    random = np.random.default_rng(2)
    one, other = np.square(random.standard_normal((2, 403)))
    means = [part.mean() for part in np.array_split(other - one, 8)]
    assert chance(one, other) == pytest.approx(scipy.stats.ttest_1samp(means, 0, alternative="greater").pvalue)
    assert chance(one, other) + chance(other, one) == pytest.approx(1)
    assert chance(one, one) == 1
    assert chance(one, one + 1) == 0
    assert chance(one[:399], one[:399] + random.random(399)) == 1  # too few to say
    assert chance(one[:400], one[:400] + random.random(400)) < 1
    assert STRETCHES == 8


def test_squares_are_of_the_best_weights_on_what_was_held_out(small_data: Callable) -> None:
    """Their mean is the validation error by which the attempt is judged."""
    data = fitting(small_data(), with_feedthrough)
    train, val = data.normalised()
    recipe = RECIPE.replace(feedthrough="no", epochs=8)
    attempt = Attempt(data, 2, 0, recipe, train, val, None, Clock(0), None, linear_start)
    attempt.train(train, 8)
    assert len(attempt.squares()) == sum(map(len, val))
    assert np.sqrt(attempt.squares().mean()) == pytest.approx(attempt.error, rel=1e-12)
    assert attempt.error == min([*attempt.watch.errors, attempt.error]) < attempt.watch.errors[0]


def few(base: Dataset) -> FittingData:
    """So few and noisy samples that a generator of many weights fits the noise."""
    random = np.random.default_rng(3)
    noisy = [
        replace(r, y=r.y + 0.3 * random.standard_normal(r.y.shape)) for r in records(without_feedthrough, 120, 400)
    ]
    return replace(base.fitting, train=(noisy[0],), val=(noisy[1],), scaling=Scaling.of((noisy[0],)))


@pytest.mark.system
def test_an_incremental_layer_needs_no_margin(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of twice as many units, it has fewer weights and promises more than the generator that it is tried after."""
    data = few(small_data())
    recipe = RECIPE.replace(hidden=(6,), stability="auto", feedthrough="no")
    auto, schur, layer = (
        train_nnss(data, 2, 0, recipe.replace(**changes))
        for changes in ({}, {"stability": "schur"}, {"stability": "incremental", "hidden": (12,)})
    )
    weights = schur.model.architecture.weights, layer.model.architecture.weights
    assert weights[1] < weights[0]
    assert auto.candidates["as it is"] == min([*schur.val_rmse, auto.candidates["as it is"]])
    assert 0.8 < auto.candidates["incremental layer"] / auto.candidates["as it is"] < 1
    assert auto.model.architecture == layer.model.architecture
    assert auto.val_rmse == layer.val_rmse
    said = f"incremental layer taken: it lowers the validation error with {weights[1]} weights for {weights[0]}"
    assert said in auto.remarks
    monkeypatch.setattr(fit, "pays", lambda error, rival, **_: pays(error, rival))
    assert train_nnss(data, 2, 0, recipe).model.architecture == schur.model.architecture


def test_candidates_share_ssests_model(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is made once for all that have no D, and once for those that have."""
    made: list[bool] = []

    def noting(train: Any, val: Any, order: int, gamma: float, init_window: int, feedthrough: bool) -> LinearStart:
        made.append(feedthrough)
        return linear_start(train, val, order, gamma, init_window, feedthrough)

    monkeypatch.setattr(fit, "linear_start", noting)
    monkeypatch.setattr(candidates_module, "feedthrough_p_value", lambda _: 0.0)
    training = train_nnss(few(small_data()), 2, 0, RECIPE.replace(stability="auto", epochs=2))
    assert set(training.candidates) >= {"as it is", "feedthrough"}
    assert len(training.candidates) == 3
    assert sorted(made) == [False, True]


def test_a_layer_is_tried_where_one_stage_is_all(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is ahead on short beginnings of long records, and may be behind on all of them."""
    data = few(small_data())
    auto = RECIPE.replace(stability="auto", feedthrough="no")
    assert worth_trying(data, 2, auto, data.train) == ("stability",)
    assert worth_trying(data, 2, auto.replace(lead=50), stages(data.train, auto.replace(lead=50))[0]) == ()
    assert worth_trying(data, 2, auto.replace(stability="schur"), data.train) == ()
    weights = auto.replace(stability="incremental", hidden=(8,)).architecture(2, 1, 1).weights
    for samples, tried in ((weights, ("stability",)), (weights - 1, ())):
        short = replace(data, train=(data.train[0][:samples],))
        assert worth_trying(short, 2, auto, short.train) == tried
    assert "stability" not in auto.replace(hidden=(4, 4)).alternatives(100)  # its layer is one
    assert "stability" not in auto.replace(scheduling="x+y").alternatives(100)
    assert "stability" not in auto.replace(optimiser="adam").alternatives(100)
    monkeypatch.setattr(recipe_module, "UNITS", UNITS)
    units = [auto.replace(hidden=(width,)).alternatives(100)["stability"]["hidden"] for width in (1, 8, 9)]
    assert units == [(16,), (16,), (18,)]
    assert recipe_of("best", {}, 2).stability == "auto"
    assert recipe_of("paper", {}, 2).stability == "schur"


@pytest.mark.parametrize(
    ("order", "inputs", "outputs", "width"),
    [(2, 1, 1, 8), (6, 2, 2, 8), (7, 1, 1, 6), (10, 1, 1, 2), (10, 5, 5, 2), (20, 5, 5, 1)],
)
def test_a_generator_of_high_order_is_narrower(order: int, inputs: int, outputs: int, width: int) -> None:
    """An iteration costs the square of its weights: 5488 of them took eight seconds at order 10 with five channels."""
    recipe = recipe_of("best", {}, order, outputs, inputs)
    assert recipe.hidden == (width,)
    wider = recipe.replace(hidden=(width + 1,)).simplest().architecture(order, inputs, outputs)
    assert width == 8 or wider.weights > recipe_module.MOST
    assert recipe_of("paper", {}, order, outputs, inputs).hidden == (100,)


def test_a_width_that_is_asked_for_stays(small_data: Callable) -> None:
    settings, data = METHODS["nnss"].settings, small_data().fitting
    assert [settings(data, 10, asked)["hidden"] for asked in ({}, {"hidden": (8,)})] == [(2,), (8,)]


def test_a_cold_candidate_after_a_layer_is_the_papers_structure() -> None:
    recipe = recipe_of("best", {}, 2)
    layer, cold = (recipe.alternatives(100)[name] for name in ("stability", "initial"))
    after = recipe.simplest().replace(**layer).replace(**cold)
    assert (after.stability, after.hidden) == ("schur", (120,) * 6)
    assert after.architecture(2, 1, 1).weights > 10_000
    quadratic = recipe.replace(stability="quadratic")
    assert quadratic.simplest().replace(**quadratic.alternatives(100)["initial"]).stability == "quadratic"


def test_stages_are_beginnings_four_times_as_long_each_and_end_with_everything() -> None:
    recipe = RECIPE.replace(lead=100)
    (train,) = records(without_feedthrough, 3500)
    assert [len(part[0]) for part in stages((train,), recipe)] == [100, 400, 1600, 3500]
    assert all((part[0].y == train.y[: len(part[0])]).all() for part in stages((train,), recipe))
    several = records(without_feedthrough, 300, 100)
    assert [[len(r) for r in part] for part in stages(several, recipe)] == [[75, 25], [300, 100]]
    assert stages(several, RECIPE.replace(lead=201)) == [several]  # half of it would be no less work
    for plain in (RECIPE, recipe.replace(window=50), recipe.replace(optimiser="adam", initial="random")):
        assert stages((train,), plain) == [(train,)]


def test_only_the_candidate_taken_goes_on(small_data: Callable) -> None:
    data = fitting(small_data(), with_feedthrough)
    epochs: list[int] = []
    training = train_nnss(data, 2, 0, RECIPE.replace(lead=150, epochs=4), lambda epoch, *_: epochs.append(epoch))
    assert training.epochs == 4 + 2  # of the first stage, and half as many of the second
    assert epochs == list(range(1, len(epochs) + 1))
    assert 2 * 4 >= len(epochs) - 2 > 4
    errors = training.candidates
    assert errors["feedthrough"] <= min(training.val_rmse[:4])  # the start counts too
    assert min(training.val_rmse) <= errors["feedthrough"]


def test_a_later_stage_begins_at_the_best_weights(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    data = fitting(small_data(), without_feedthrough)
    recipe = RECIPE.replace(lead=150, epochs=6, feedthrough="no")
    errors = iter([5.0, 3.0, 1.0, 2.0, 4.0, 6.0, 7.0] + [9.0] * 3)  # the start, six epochs, three of the next
    begun = []
    plain = module.gauss_newton

    def noting(engine, y, *args) -> None:
        begun.append((len(y[0]), engine.weights()))
        plain(engine, y, *args)

    monkeypatch.setattr(module, "gauss_newton", noting)
    monkeypatch.setattr(module, "free_run_rmse", lambda *_: next(errors))
    training = train_nnss(data, 2, 0, recipe)
    assert [length for length, _ in begun] == [150, 600]
    assert training.best_epoch == 2
    for name, weight in begun[1][1].items():
        np.testing.assert_array_equal(weight, training.model.state_dict()[name].numpy())
        if name == "generator.0.weight":
            assert (weight != begun[0][1][name]).any()


@pytest.mark.system
def test_a_stage_that_diverges_leaves_the_model_of_the_one_before(
    small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = fitting(small_data(), without_feedthrough)
    plain = module.gauss_newton

    def breaking(engine, u, y, iterations, goes_on, *options) -> None:
        if len(y[0]) == 600:
            goes_on(np.nan)
        else:
            plain(engine, u, y, iterations, goes_on, *options)

    monkeypatch.setattr(module, "gauss_newton", breaking)
    training = train_nnss(data, 2, 0, RECIPE.replace(lead=150, epochs=4, feedthrough="no"))
    assert not training.diverged
    assert "trained on the first 150 samples: on 600, the loss became nan in epoch 5" in training.remarks
    fit = METHODS["nnss"].fit(data, 2, 0, {**vars(RECIPE), "lead": 600, "epochs": 2, "feedthrough": "no"}, None)
    assert fit.model is None  # a first stage has nothing to fall back on


def test_feedthrough_wants_one_of_three_words_and_lead_no_negative_number() -> None:
    with pytest.raises(InputError, match="feedthrough 'maybe'.*auto, yes, no"):
        RECIPE.replace(feedthrough="maybe")
    with pytest.raises(InputError, match="lead: expected at least 0, found -1"):
        RECIPE.replace(lead=-1)


def test_the_papers_recipe_has_neither() -> None:
    paper, best = recipe_of("paper", {}, 2), recipe_of("best", {}, 2)
    assert (paper.feedthrough, paper.lead) == ("no", 0)
    assert (best.feedthrough, best.lead) == ("auto", 5000)


def test_ssest_takes_a_feedthrough_that_validates_better(small_data: Callable) -> None:
    random = np.random.default_rng(0)
    for D in (0.0, 0.5):
        plant = LinearStateSpace(np.array([[0.8]]), np.array([[0.5]]), np.array([[1.0]]), np.array([[D]]), 1.0)
        train, val = (
            Record(u, plant.simulate(u, np.zeros(1))[0] + 0.05 * random.standard_normal((300, 1)), 1.0)
            for u in random.standard_normal((2, 300, 1))
        )
        found = ssest_by_validation((train,), (val,), 1)
        errors = [simulation_rms(ssest((train,), (val,), 1, feedthrough), (val,)) for feedthrough in (False, True)]
        assert simulation_rms(found, (val,)) == min(errors)
        if D:
            assert abs(found.D.item() - D) < 0.02
    data = small_data().fitting
    for protocol, expected in (("paper", "no"), ("strict", "auto"), ("official", "auto")):
        assert METHODS["ssest"].settings(replace(data, protocol=protocol), 2, {}) == {"feedthrough": expected}


@pytest.mark.system
def test_a_start_that_a_quarter_of_the_epochs_did_not_improve_is_kept(
    small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = fitting(small_data(), without_feedthrough)
    for epochs, second, ran, best in ((40, 1.1, 10, 0), (40, 0.9, 12, 2), (20, 1.1, 12, 0)):
        errors = iter([1.0, 1.2, second, *[1.3] * 9, np.nan])  # of the start, and of each epoch
        monkeypatch.setattr(module, "free_run_rmse", lambda *_, errors=errors: next(errors))
        training = train_nnss(data, 2, 0, RECIPE.replace(epochs=epochs, feedthrough="no"))
        assert len(training.val_rmse) == ran
        assert training.best_epoch == best


def test_a_candidate_that_is_still_behind_after_a_quarter_is_given_up(
    small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = fitting(small_data(), with_feedthrough)
    recipe = RECIPE.replace(initial="random", epochs=8, feedthrough="auto")
    for behind, ran in ((1.1, 2), (1.0, 8)):
        # the first candidate comes down to 1; the second is behind it in its second epoch, or level
        errors = iter([3.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 3.0, behind, *[0.5] * 6])
        epochs: list[int] = []
        monkeypatch.setattr(module, "free_run_rmse", lambda *_, errors=errors: next(errors))
        training = train_nnss(data, 2, 0, recipe, lambda epoch, *_, epochs=epochs: epochs.append(epoch))
        assert len(epochs) == 8 + ran
        assert training.model.architecture.feedthrough == (ran == 8)


def test_a_cold_model_is_tried_where_weights_outnumber_outputs(small_data: Callable) -> None:
    data, best = small_data(K=150).fitting, recipe_of("best", {}, 2)  # 50 samples to train
    weights = best.simplest().architecture(2, 1, 1).weights
    assert sum(record.y.size for record in data.train) < weights
    assert "initial" in worth_trying(data, 2, best, data.train)
    enough = fitting(small_data(), without_feedthrough, K=weights)
    assert "initial" not in worth_trying(enough, 2, best, enough.train)
    for samples, tried in ((2.5 * weights - 20, False), (2.5 * weights + 20, True)):  # K ≥ 2 (weights + 2 K/20)
        some = fitting(small_data(), without_feedthrough, K=int(samples))
        assert ("lengthen" in worth_trying(some, 2, best, some.train)) == tried  # else it says nothing that one fits
    assert best.alternatives(50)["initial"]["window"] == 30
    assert best.alternatives(1000)["initial"]["window"] == 60
    settings = METHODS["nnss"].settings
    assert settings(data, 2, {})["initial"] == "auto"
    assert settings(data, 2, {"hidden": (4,)})["initial"] == "feedback"  # what is asked for holds for every candidate
    assert settings(data, 2, {"hidden": (4,), "initial": "auto"})["initial"] == "auto"


@pytest.mark.parametrize(("order", "advice"), [(1, "a lower --hidden"), (2, "a lower order or --hidden")])
def test_more_weights_than_measured_outputs_are_told(order: int, advice: str, small_data: Callable) -> None:
    few = small_data(K=120).fitting
    recipe = RECIPE.replace(feedthrough="no", epochs=2, hidden=(8,))
    weights, outputs = recipe.architecture(order, 1, 1).weights, sum(record.y.size for record in few.train)
    assert f"{weights} weights for {outputs} measured outputs: take {advice}, or more samples" in (
        train_nnss(few, order, 0, recipe).remarks
    )
    enough = fitting(small_data(), without_feedthrough, K=weights)
    assert not any("weights" in remark for remark in train_nnss(enough, order, 0, recipe).remarks)


@pytest.mark.system
def test_the_cold_model_is_taken_where_it_pays(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    data = small_data(K=150).fitting
    recipe = RECIPE.replace(initial="auto", feedthrough="no", epochs=2, hidden=(12,))
    for cold, taken in ((0.79, True), (0.81, False)):
        monkeypatch.setattr(
            module, "free_run_rmse", lambda engine, *_, cold=cold: cold if len(engine.weights()) > 10 else 1.0
        )
        monkeypatch.setattr(recipe_module, "_COLD", recipe_module._COLD | {"hidden": (4,) * 4, "epochs": 2})
        training = train_nnss(data, 2, 0, recipe)
        assert training.model.architecture.hidden == ((4,) * 4 if taken else (12,))
        assert training.candidates == {"as it is": 1.0, "cold start": cold}
        assert ("cold start taken: it lowers the validation error by more than 20%" in training.remarks) == taken
        kept = [METHODS["nnss"].fit(data, 2, 0, {**vars(recipe), "judge": judge}, None).history for judge in JUDGES]
        assert [{*each} - {"train_loss", "val_rmse"} for each in kept] == [
            {f"{error}, as it is", f"{error}, cold start"} for error in ("val_rmse", "block_rmse")
        ]
        longer = replace(data, val=(*data.val, *data.val, *data.val))  # training has no block of that length
        assert train_nnss(longer, 2, 0, recipe.replace(judge="blocks")).judged_by == "val_rmse"
        by_blocks = train_nnss(data, 2, 0, recipe.replace(judge="blocks"))
        assert by_blocks.candidates == pytest.approx({"as it is": 1.0, "cold start": cold})
        assert ("cold start taken: it lowers the error over 2 blocks by more than 20%" in by_blocks.remarks) == taken


def test_blocks_hold_out_each_training_sample_once_and_mix_none_into_what_is_trained_on() -> None:
    def record(first: int, K: int) -> Record:
        return Record(np.arange(first, first + K), np.arange(first, first + K), 1.0)

    train, val = (record(0, 70), record(1000, 30)), (record(5000, 24),)
    found = blocks(train, val)
    assert len(found) == 4
    all_held = []
    for trained, held in found:
        own, others = (np.concatenate([r.y[:, 0] for r in records]) for records in (held, trained))
        assert not np.intersect1d(own, others).size
        assert np.array_equal(np.sort([*own, *others]), np.concatenate([r.y[:, 0] for r in (*train, *val)]))
        assert all((np.diff(r.y[:, 0]) == 1).all() for r in (*trained, *held))  # no jump within an experiment
        assert len(own) == 25
        all_held.append(own)
    assert np.array_equal(np.concatenate(all_held), np.concatenate([r.y[:, 0] for r in train]))
    assert len(blocks(train, (record(5000, 40),))) == 2  # about as long as validation
    assert len(blocks(train, (record(5000, 5),))) == 4  # five with validation itself, at most
    assert blocks(train, (record(5000, 101),)) == []
    # experiment of 3 is too short for 4 samples to begin with: it is held out by no one, and trained on by the others
    short = blocks((record(0, 3), record(10, 3), record(20, 54)), (record(5000, 30),), init_window=4)
    assert [[len(r) for r in held] for _, held in short] == [[24], [30]]
    assert [[len(r) for r in trained] for trained, _ in short] == [[30, 30], [3, 3, 24, 30]]


def test_the_error_over_blocks_is_that_of_all_held_out_samples() -> None:
    random = np.random.default_rng(0)
    parts = [random.standard_normal(K) for K in (3, 50, 7)]
    errors = [float(np.sqrt(np.mean(part**2))) for part in parts]
    assert pooled(errors, [3, 50, 7]) == pytest.approx(np.sqrt(np.mean(np.concatenate(parts) ** 2)))
    assert pooled([0.1], [7]) == 0.1
    assert pooled([0.1, np.inf], [7, 1]) == np.inf


@pytest.mark.system
def test_judged_by_blocks_validation_is_one_of_them(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """The feedthrough does much better on a validation record of 40 samples alone, and worse on the rest."""
    data = fitting(small_data(), with_feedthrough, K=160)
    data = replace(data, val=(data.val[0][:40],))
    recipe = RECIPE.replace(epochs=2)
    outputs = sum(recipe.simplest().architecture(2, 1, 1).parameter_sizes)
    seen: list[int] = []

    def error(engine: object, records: tuple[Record, ...], *_: object) -> float:
        """By whether u(k) has a say in y(k): the generator then has an output more."""
        feedthrough = len(engine.weights()["generator.2.bias"]) > outputs  # type: ignore[attr-defined]
        own = np.array_equal(records[0].y, data.normalised()[1][0].y)
        seen.append(len(records[0]))
        return (0.1 if own else 3.0) if feedthrough else 1.0

    monkeypatch.setattr(module, "free_run_rmse", error)
    alone = train_nnss(data, 2, 0, recipe)
    assert set(seen) == {40}
    assert len(seen) == 6  # two candidates, each a start and two epochs
    assert alone.model.architecture.feedthrough
    assert alone.candidates == {"as it is": 1.0, "feedthrough": 0.1}
    training = train_nnss(data, 2, 0, recipe.replace(judge="blocks"))
    assert len(seen) == 6 + 5 * 6 - 4  # where it is behind it is given up after an epoch
    assert not training.model.architecture.feedthrough
    assert training.candidates["as it is"] == pytest.approx(1.0)
    assert training.candidates["feedthrough"] == pytest.approx(np.sqrt((0.1**2 + 4 * 9) / 5))
    with pytest.raises(InputError, match="judge"):
        recipe.replace(judge="test")


@pytest.mark.system
def test_an_integrator_that_won_is_not_started_cold(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """Adam cannot train one in the compiled engine: what cannot be combined is not tried."""
    data = small_data(K=150).fitting
    monkeypatch.setattr(candidates_module, "longest_time_constant", lambda _: np.inf)
    recipe = RECIPE.replace(initial="auto", integrator="auto", feedthrough="no", epochs=2, hidden=(40,))
    assert worth_trying(data, 2, recipe, data.train) == ("integrator", "initial")
    errors = {True: 0.5, False: 1.0}
    monkeypatch.setattr(module, "free_run_rmse", lambda engine, *_: errors["generator_drift.bias" in engine.weights()])
    training = train_nnss(data, 2, 0, recipe)
    assert training.model.architecture.integrator
    assert training.candidates == {"as it is": 1.0, "integrator": 0.5}


def test_what_the_encoder_sees_makes_no_record_a_short_one(small_data: Callable) -> None:
    """With its weights for a window of 10 samples the model's would outnumber the 100 measured outputs."""
    data = small_data(K=300).fitting
    plain = RECIPE.replace(initial="auto", stability="auto", feedthrough="no", hidden=(2,))
    window = plain.replace(encoder_window=10)
    weights = [recipe.simplest().architecture(2, 1, 1).weights for recipe in (plain, window)]
    assert weights[0] < len(data.train[0]) < weights[1]
    assert worth_trying(data, 2, window, data.train) == worth_trying(data, 2, plain, data.train) == ("stability",)


@pytest.mark.system
@pytest.mark.parametrize(
    ("errors", "told", "taken"),
    slow_but((0, 2), [
        ((1.0, 1.0, 1.0, 0.5), ["feedthrough", "integrator", "integrator and feedthrough"], True),
        ((1.0, 1.0, 0.5, 0.3), ["feedthrough", "integrator", "integrator and feedthrough"], True),
        ((1.0, 1.0, 0.5, 0.45), ["feedthrough", "integrator", "integrator and feedthrough"], False),
        ((1.0, 0.5, 1.0, 0.3), ["feedthrough", "feedthrough with integrator"], True),
    ]),
)  # fmt: skip
def test_an_integrator_is_tried_with_a_feedthrough_that_alone_is_no_help(
    small_data: Callable, monkeypatch: pytest.MonkeyPatch, errors: tuple[float, ...], told: list[str], taken: bool
) -> None:
    """Errors are of neither, a feedthrough, an integrator, both: in what is summed up u may show at once."""
    data = small_data(K=150).fitting
    monkeypatch.setattr(candidates_module, "longest_time_constant", lambda _: np.inf)
    monkeypatch.setattr(candidates_module, "feedthrough_p_value", lambda _: 0.0)
    recipe = RECIPE.replace(integrator="auto", epochs=1, patience=1)
    assert worth_trying(data, 2, recipe, data.train) == ("feedthrough", "integrator", "both")

    def error(engine: Any, *_: Any) -> float:
        weights = engine.weights()
        integrator = "generator_drift.bias" in weights
        return errors[(weights["generator.2.bias"].size == (8 if integrator else 25)) + 2 * integrator]

    monkeypatch.setattr(module, "free_run_rmse", error)
    training = train_nnss(data, 2, 0, recipe)
    assert list(training.candidates) == ["as it is", *told]
    a = training.model.architecture
    assert (a.integrator and a.feedthrough) == taken
    monkeypatch.setattr(candidates_module, "feedthrough_p_value", lambda _: 1.0)
    assert worth_trying(data, 2, recipe, data.train) == ("integrator",)
    for asked in ({"feedthrough": "yes"}, {"integrator": "yes"}, {"gain": 5.0, "stability": "incremental"}):
        assert "both" not in recipe.replace(**asked).alternatives(100)


@pytest.mark.system
def test_a_budget_ends_a_fit_and_says_what_it_left_out(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    data = fitting(small_data(), with_feedthrough)
    seconds = iter(range(10_000))
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: float(next(seconds))))  # no one else's clock
    recipe = RECIPE.replace(epochs=50, lead=150)
    short = train_nnss(data, 2, 0, recipe.replace(budget=33.0))
    assert 6 <= short.epochs <= 9  # the start looks at the clock before each of its iterations, too
    assert "stopped by the budget of 33 s, without feedthrough, stage of 600 samples" in short.remarks
    assert not any("budget" in remark for remark in train_nnss(data, 2, 0, recipe.replace(budget=1000.0)).remarks)
    with pytest.raises(
        InputError, match=r"budget: 0.5 s are too few for one candidate, whose start alone took .* s: give more"
    ):
        train_nnss(data, 2, 0, recipe.replace(budget=0.5))  # a second passes between two looks at the clock
    with pytest.raises(InputError, match="budget: expected seconds, or 0 for no bound, found -1"):
        recipe.replace(budget=-1.0)


@pytest.mark.parametrize(("p_value", "tried"), [(0.0099, True), (0.011, False), (0.09, False)])
def test_a_feedthrough_is_tried_where_the_input_shows_at_one_percent(
    p_value: float, tried: bool, small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(candidates_module, "feedthrough_p_value", lambda _: p_value)
    data = small_data(K=150).fitting
    assert ("feedthrough" in worth_trying(data, 2, RECIPE, data.train)) == tried
