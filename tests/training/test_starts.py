"""What a training starts from where data are poor, what it says of it, and how the encoder is set for many outputs."""

import itertools
import re
from collections.abc import Callable

import numpy as np
import pytest
import torch
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.catalog import BENCHMARKS
from nnss_cli.datasets.record import Channels, FittingData, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS
from nnss_cli.model.nnss import NNSS
from nnss_cli.training import attempt
from nnss_cli.training import least_squares as optimiser
from nnss_cli.training import start as module
from nnss_cli.training.encoder import encoder_map, set_encoder
from nnss_cli.training.engine import ReferenceEngine
from nnss_cli.training.fast import FastEngine
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.recipe import Recipe, recipe_of
from nnss_cli.training.start import begin
from nnss_cli.training.warm import warm_start

BEST = Recipe(
    hidden=(5,), encoder=(4,), dtype="float64", window=0, optimiser="gauss-newton", initial="feedback", epochs=3
)


def dataset(u: np.ndarray, y: np.ndarray) -> FittingData:
    records = (Record(u, y, 1.0),)
    r, m = records[0].input_count, records[0].output_count
    channels = Channels(("u",) * r, ("y",) * m, ("",) * r, ("",) * m)
    return FittingData("poor", "strict", records, records, Scaling.of(records), channels)


k = np.arange(200.0)
POOR = {
    "constant output": (np.sin(k), 0 * k + 2, r"SSEST failed \(output y1 is constant over the training records: noth"),
    "all constant": (0 * k + 1, 0 * k + 1, r"nothing to identify; input u1 is constant\): started from random weights"),
    "short": (np.sin(k[:13]), np.cos(k[:13]), r"SSEST failed \(order 3 is too large .*: started from random weights"),
    "one constant output": (
        np.sin(k * k), np.stack([np.sin(1.1 * k * k), 0 * k], axis=1),
        r"linear start failed \(.*; output y2 is constant\): started from random weights",
    ),
}  # fmt: skip


@pytest.mark.system
@pytest.mark.parametrize("kind", POOR)
def test_where_ssest_fails_training_starts_at_random_and_says_so(kind: str) -> None:
    u, y, remark = POOR[kind]
    data = dataset(u, y)
    training = train_nnss(data, 3, 0, BEST)
    assert not training.diverged
    assert np.isfinite(training.model.simulate(data.val[0].u, data.val[0].y[0]).y).all()
    assert any(re.search(remark, text) for text in training.remarks), training.remarks
    fit = METHODS["nnss"].fit(
        data,
        3,
        0,
        METHODS["nnss"].settings(data, 3, {"epochs": 3, "hidden": (5,), "encoder": (4,), "stability": "schur"}),
        None,
    )
    assert fit.remarks[: len(training.remarks)] == training.remarks


@pytest.mark.system
@pytest.mark.parametrize("kind", POOR)
def test_a_layer_starts_where_it_can_on_poor_data(kind: str) -> None:
    """Units without effect need room beside the model, which rounding may leave negative."""
    u, y, _ = POOR[kind]
    training = train_nnss(dataset(u, y), 3, 0, BEST.replace(stability="incremental"))
    assert not training.diverged
    assert (kind == "one constant output") == any("found none near it" in text for text in training.remarks)


def test_what_may_be_taken_is_compiled_before(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    monkeypatch.setattr("nnss_cli.training.fast.warm_up", lambda _, stability, __: made.append(stability))
    data = dataset(np.sin(k), np.cos(k))
    for option, compiled in (({}, ["schur", "incremental"]), ({"stability": "quadratic"}, ["quadratic"])):
        made.clear()
        METHODS["nnss"].prepare(METHODS["nnss"].settings(data, 2, option))
        assert made == compiled


@pytest.mark.parametrize("name", ["n4sid", "ssest", "simba"])
def test_the_reason_of_a_failure_is_a_sentence_about_the_data(name: str) -> None:
    method = METHODS[name]
    for outputs, text in (
        (0 * k + 2, "output y1 is constant over the training records: nothing to identify"),
        (np.stack([0 * k, 0 * k + 1], axis=1), "output y1 and output y2 are constant over the training records"),
        (np.where(k < 1, 1.0, 0.0), "no output varies after the first 12 samples of the training records"),
    ):
        data = dataset(np.sin(k * k), outputs)
        data = FittingData("poor", "paper", data.train, data.val, data.scaling, data.channels)
        if name == "ssest" and text.startswith("no output"):
            continue  # shorter horizons remain
        with pytest.raises(InputError, match=text):
            method.fit(data, 3, 0, method.settings(data, 3, {}), None)


def test_a_start_that_is_kept_and_one_that_is_refused_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    data = dataset(np.sin(k * k), np.cos(k * k))
    errors = iter([1.0, 2.0, 2.0, 2.0])
    monkeypatch.setattr(attempt, "free_run_rmse", lambda *_: next(errors))
    monkeypatch.setattr(module, "feedback_start", lambda *_: False)
    training = train_nnss(data, 2, 0, BEST)
    assert training.best_epoch == 0
    assert training.remarks == (
        "feedback start refused: no iterate validated better than the linear model",
        "validation refused every epoch after the linear start",
    )
    errors = iter([1.0, 2.0, 0.5, 2.0])
    fit = METHODS["nnss"].fit(data, 2, 0, {**BEST.__dict__, "recipe": "best", "initial": "linear"}, None)
    assert (fit.best_epoch, fit.remarks) == (2, ())


def test_a_start_that_no_step_improved_was_not_refused_by_validation(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the optimiser took no step, validation had none to refuse."""
    monkeypatch.setattr(attempt, "gauss_newton", lambda *_: None)
    training = train_nnss(dataset(np.sin(k * k), np.cos(k * k)), 2, 0, BEST.replace(initial="linear"))
    assert (training.epochs, training.remarks) == (0, ("no step lowered the training error of the linear start",))


def test_a_feedback_start_that_fails_leaves_the_linear_one(monkeypatch: pytest.MonkeyPatch) -> None:
    data = dataset(np.sin(k * k), np.cos(k * k))
    train, val = data.normalised()

    def failing(model: NNSS, *_: object) -> bool:
        with torch.no_grad():
            next(iter(model.parameters())).fill_(7.0)
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr(module, "feedback_start", failing)
    models = [NNSS(BEST.architecture(2, 1, 1), data.scaling, data.channels, 1.0) for _ in range(2)]
    assert begin(models[0], "linear", train, val, 0) == ("linear", ())
    taken, remarks = begin(models[1], "feedback", train, val, 0)
    assert (taken, remarks) == (
        "linear", ("feedback start failed (Singular matrix): started from the linear model",)
    )  # fmt: skip
    for first, second in zip(*(model.parameters() for model in models), strict=True):
        assert torch.equal(first, second)


@pytest.mark.system
@pytest.mark.parametrize(
    ("method", "name"), [("train_batch", "adam"), ("loss_and_gradient", "lbfgs"), ("sensitivities", "gauss-newton")]
)
def test_a_singular_step_ends_the_run_and_not_the_sweep(
    method: str, name: str, small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = BEST.replace(engine="reference", optimiser=name, initial="random", window=20, stride=20, epochs=5)
    plain, seen = getattr(ReferenceEngine, method), []

    def breaking(self: ReferenceEngine, *args: object) -> object:
        seen.append(1)
        if len(seen) == 3:
            torch.linalg.solve(torch.zeros(2, 2), torch.ones(2))
        return plain(self, *args)

    monkeypatch.setattr(ReferenceEngine, method, breaking)
    training = train_nnss(small_data().fitting, 2, 0, recipe)
    assert training.diverged == f"the step's matrix became singular in epoch {training.epochs + 1}"
    assert training.epochs < 5


def test_a_singular_gram_matrix_is_damped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fifty columns that are one: without damping, Cholesky fails by rounding."""
    monkeypatch.setattr(optimiser, "FIRST_DAMPING", 0.0)
    column = np.random.default_rng(0).standard_normal((80, 1))
    target = 3 * column[:, 0]
    losses: list[float] = []

    def evaluate(point: np.ndarray) -> tuple:
        errors, J = column[:, 0] * point.sum() - target, np.repeat(column, 50, axis=1)
        return optimiser.NormalEquations.of(errors, J), np.zeros((0, 1))

    def accepted(_: np.ndarray, loss: float, __: np.ndarray) -> bool:
        losses.append(loss)
        return loss > 1e-20

    optimiser.levenberg_marquardt(evaluate, np.zeros(50), 5, accepted)
    assert losses[-1] < 1e-12


def encoder(widths: tuple[int, ...], m: int, n: int, seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    random = np.random.default_rng(seed)
    sizes = (m, *widths, n)
    return [
        (random.standard_normal((after, before)), random.standard_normal(after))
        for before, after in itertools.pairwise(sizes)
    ]


@pytest.mark.parametrize(
    ("m", "n", "widths"), [(10, 2, (8,)), (10, 4, (8,)), (12, 12, (12,)), (10, 4, (4, 9, 5)), (3, 2, ()), (9, 1, (1,))]
)
def test_an_encoder_as_wide_as_the_rank_is_set_exactly(m: int, n: int, widths: tuple) -> None:
    random = np.random.default_rng(1)
    E, e = random.standard_normal((n, m)), random.standard_normal(n)
    layers = encoder(widths, m, n)
    set_encoder(layers, E, e)
    for ours, expected in zip(encoder_map(layers, m)[-1], (E, e), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-10)


def test_a_narrower_encoder_gets_the_nearest_map_of_its_rank() -> None:
    random = np.random.default_rng(2)
    E, e = random.standard_normal((6, 7)), random.standard_normal(6)
    layers = encoder((5, 3), 7, 6)
    set_encoder(layers, E, e)
    found, shift = encoder_map(layers, 7)[-1]
    np.testing.assert_allclose(np.linalg.norm(found - E, 2), np.linalg.svd(E)[1][3], rtol=1e-10)  # Eckart–Young
    np.testing.assert_allclose(shift, e, atol=1e-12)


def test_the_encoder_of_best_is_as_wide_as_the_outputs(small_data: Callable) -> None:
    for m, expected in ((1, (8,)), (8, (8,)), (12, (12,))):
        data = small_data(m=m).fitting
        assert METHODS["nnss"].settings(data, 2, {})["encoder"] == expected
        assert METHODS["nnss"].settings(data, 2, {"encoder": (3,)})["encoder"] == (3,)
        assert METHODS["nnss"].settings(data, 2, {"recipe": "paper", "window": 20})["encoder"] == (16, 16)
    assert all("best" not in benchmark.presets for benchmark in BENCHMARKS.values())  # one rule for every record


@pytest.mark.parametrize(("m", "n"), [(10, 2), (10, 4), (12, 12)])
@pytest.mark.parametrize("narrow", [False, True])
def test_a_linear_start_of_many_outputs_begins_where_the_linear_model_does(m: int, n: int, narrow: bool) -> None:
    random = np.random.default_rng(0)
    recipe = recipe_of("best", {}, n, m)
    if narrow:
        recipe = recipe.replace(encoder=(n,))
    unit = Scaling(np.zeros(1), np.ones(1), np.zeros(m), np.ones(m))
    model = NNSS(recipe.architecture(n, 1, m), unit, Channels(("u",), ("y",) * m, ("",), ("",) * m), 1.0)
    model.initialise(random)
    A = 0.8 * np.linalg.qr(random.standard_normal((n, n)))[0]
    linear = LinearStateSpace(A, np.ones((n, 1)), random.standard_normal((m, n)), np.zeros((m, 1)), 1.0)
    E = np.linalg.pinv(linear.C)
    warm_start(model, (linear, E))
    engine = FastEngine(model, np.zeros((1, 3, 1)), np.zeros((1, 3, m)), recipe)
    u, y0 = random.standard_normal((40, 1)), random.standard_normal(m)
    np.testing.assert_allclose(engine.model_weights.encode(y0[:, None])[:, 0], E @ y0, atol=1e-10)
    np.testing.assert_allclose(engine.free_run(u, y0), linear.simulate(u, E @ y0)[0], atol=1e-7)
