"""Several experiments of different length: engines agree, nothing is cut, equal lengths give the old numbers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from nnss_cli.datasets.record import FittingData, Record, Scaling
from nnss_cli.datasets.windows import sliding_windows

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS
from nnss_cli.model.architecture import SCHEDULING, Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.encoder import regress_encoder
from nnss_cli.training.engine import ReferenceEngine, training_loss
from nnss_cli.training.fast import FastEngine
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.gauss_newton import gauss_newton
from nnss_cli.training.least_squares import Block
from nnss_cli.training.recipe import Recipe

LENGTHS = (7, 12, 7, 4)


def make(a: Architecture, seed: int = 0) -> NNSS:
    from nnss_cli.datasets.record import Channels

    r, m = a.inputs, a.outputs
    scaling = Scaling(np.zeros(r), np.ones(r), np.zeros(m), np.ones(m))
    model = NNSS(a, scaling, Channels(("u",) * r, ("y",) * m, ("",) * r, ("",) * m), 1.0)
    model.initialise(np.random.default_rng(seed))
    return model


def signals(a: Architecture, lengths: tuple[int, ...] = LENGTHS) -> tuple[list[np.ndarray], list[np.ndarray]]:
    random = np.random.default_rng(1)
    return tuple([random.standard_normal((L, width)) for L in lengths] for width in (a.inputs, a.outputs))


def architecture(scheduling: str) -> Architecture:
    return Architecture(3, 2, 2, (6, 5), (4,), scheduling, dtype="float64")


@pytest.mark.parametrize("scheduling", SCHEDULING)
@pytest.mark.parametrize("consistency", [0.0, 0.3])
def test_the_loss_weighs_each_window_by_its_samples(scheduling: str, consistency: float) -> None:
    """Against torch, one window after the other; the engines against each other with gradients and over Adam steps."""
    a = architecture(scheduling)
    u, y = signals(a)
    model = make(a)
    used = [L - ("y" in scheduling) for L in LENGTHS]
    losses = [
        training_loss(model, torch.tensor(v)[None], torch.tensor(w)[None], consistency)
        for v, w in zip(u, y, strict=True)
    ]
    expected = sum(K * loss for K, loss in zip(used, losses, strict=True)) / sum(used)
    expected.backward()
    gradient = torch.cat([p.grad.ravel() for p in model.parameters()]).numpy()
    recipe = Recipe(dtype="float64", consistency=consistency)
    fast, plain = (engine(make(a), u, y, recipe) for engine in (FastEngine, ReferenceEngine))
    vector = np.concatenate([p.detach().numpy().ravel() for p in model.parameters()])
    for engine in (fast, plain):
        found, slope = engine.loss_and_gradient(vector)
        assert found == pytest.approx(expected.item(), rel=1e-12)
        np.testing.assert_allclose(slope, gradient, rtol=0, atol=1e-12 * np.abs(gradient).max())
    for chosen in ([0, 1, 3], [2, 0], [1, 3]):
        assert fast.train_batch(np.array(chosen), 1) == pytest.approx(plain.train_batch(np.array(chosen), 1), rel=1e-10)
    for name, weight in plain.weights().items():
        np.testing.assert_allclose(fast.weights()[name], weight, rtol=0, atol=1e-10)


@pytest.mark.parametrize("scheduling", SCHEDULING)
def test_derivatives_agree_window_after_window(scheduling: str, whole: Callable) -> None:
    a = architecture(scheduling)
    u, y = signals(a)
    x0 = np.random.default_rng(2).standard_normal((len(LENGTHS), a.order))
    model = make(a)
    fast, plain = (
        whole(engine(model, u, y, Recipe()).sensitivities(x0), x0) for engine in (FastEngine, ReferenceEngine)
    )
    for ours, theirs in zip(fast, plain, strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-11 * max(1.0, np.abs(theirs).max()))
    row = state = 0
    p = fast[1].shape[1] - x0.size
    for i, L in enumerate(LENGTHS):  # each window is what it is alone
        e, J, x = whole(FastEngine(model, [u[i]], [y[i]], Recipe()).sensitivities(x0[i : i + 1]), x0[i : i + 1])
        rows = slice(row, row + len(e))
        np.testing.assert_array_equal(fast[0][rows], e)
        np.testing.assert_array_equal(fast[2][state : state + len(x)], x)
        np.testing.assert_array_equal(fast[1][rows, :p], J[:, :p])
        np.testing.assert_array_equal(fast[1][rows, p + 3 * i : p + 3 * i + 3], J[:, p:])
        others = np.delete(fast[1][rows, p:], range(3 * i, 3 * i + 3), axis=1)
        assert not others.any()
        row, state = row + len(e), state + L - ("y" in scheduling)


def experiments(data: FittingData, *lengths: int) -> FittingData:
    """The same plant, in training records of these lengths."""
    whole = data.train[0]
    ends = np.cumsum(lengths)
    train = tuple(whole[end - K : end] for K, end in zip(lengths, ends, strict=True))
    return replace(data, train=train, scaling=Scaling.of(train))


def test_the_jacobian_of_whole_records_has_a_row_for_each_sample(small_data: Callable, whole: Callable) -> None:
    """100 and 600 samples: 700 rows, where 502 windows of 100 made 50200."""
    data = experiments(small_data(K=2100).fitting, 100, 600)
    recipe = Recipe(hidden=(8,), encoder=(8,), dtype="float64", window=0, stride=1)
    model = make(recipe.architecture(2, 1, 1))
    u, y = sliding_windows(data.normalised()[0], recipe.window, recipe.stride)
    engine = FastEngine(model, u, y, recipe)
    _, J, _ = whole(engine.sensitivities(np.zeros((2, 2))), np.zeros((2, 2)))
    assert J.shape == (700, engine.model_weights.generator_size + 2 * 2)


@pytest.mark.parametrize("scheduling", ["x", "x+y"])
def test_the_encoder_is_regressed_on_every_state(scheduling: str) -> None:
    a = architecture(scheduling)
    u, y = signals(a, (20, 33))
    engine = FastEngine(make(a), u, y, Recipe(dtype="float64"))
    seen: list[np.ndarray] = []
    plain = engine.sensitivities

    def noting(x0: np.ndarray) -> list[Block]:
        found = list(plain(x0))
        seen.append(np.concatenate([block.x for block in found]))
        return found

    engine.sensitivities = noting  # type: ignore[method-assign]
    gauss_newton(engine, u, y, 1, lambda _: False)
    known = np.concatenate([window["y" in scheduling :] for window in y])
    E, e = regress_encoder(known, seen[-1])
    for y0 in np.eye(2):
        np.testing.assert_allclose(engine.model_weights.encode(y0[:, None])[:, 0], E @ y0 + e, atol=1e-10)


@pytest.mark.parametrize("optimiser", ["gauss-newton", "lbfgs", "adam"])
@pytest.mark.parametrize("initial", ["random", "feedback"])
def test_two_experiments_train_end_to_end(optimiser: str, initial: str, small_data: Callable) -> None:
    data = experiments(small_data(K=1200).fitting, 60, 300)
    recipe = Recipe(
        hidden=(6,), encoder=(4,), dtype="float64", window=0, batch=1, optimiser=optimiser, initial=initial, epochs=8,
        consistency=0.0,
    )  # fmt: skip
    training = train_nnss(data, 2, 0, recipe)
    assert not training.diverged
    if initial == "random":
        assert training.train_loss[-1] < training.train_loss[0]
    else:
        assert min(training.val_rmse) < 0.1  # the plant is linear; what is left is x(0) from one output


@pytest.mark.parametrize("name", ["nnss", "simba"])
def test_a_window_that_a_record_cannot_fill_is_refused_before_anything_runs(name: str, small_data: Callable) -> None:
    data = experiments(small_data(K=1500).fitting, 79, 100, 79)
    with pytest.raises(InputError, match="79 samples of training record 1 of 3, found 100"):
        METHODS[name].settings(data, 2, {"window": 100})
    assert METHODS[name].settings(data, 2, {"window": 0})["window"] == 0


def test_simba_takes_whole_records_of_any_length(small_data: Callable) -> None:
    data = experiments(small_data(K=1200).fitting, 60, 300)
    method = METHODS["simba"]
    fit = method.fit(data, 2, 0, method.settings(data, 2, {"window": 0, "epochs": 5, "batch": 2}), None)
    assert not fit.diverged
    assert len(fit.history["train_loss"]) == 5


def test_a_record_of_its_own_length_equals_that_record_alone() -> None:
    """A cut would change the loss: one long record after a short one counts to its end."""
    a = architecture("x")
    u, y = signals(a, (5, 40))
    records = tuple(Record(v, w, 1.0) for v, w in zip(u, y, strict=True))
    engine = FastEngine(make(a), *sliding_windows(records, 0, 1), Recipe(dtype="float64"))
    losses = [
        FastEngine(make(a), *sliding_windows((record,), 0, 1), Recipe(dtype="float64")).evaluate(np.arange(1))
        for record in records
    ]
    assert engine.evaluate(np.arange(2)) == pytest.approx((5 * losses[0] + 40 * losses[1]) / 45, rel=1e-12)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_leftover_bytes_are_not_computed_with(monkeypatch: pytest.MonkeyPatch, dtype: str) -> None:
    """What fills up rows to whole registers is zero: subnormal leftovers cost eight times the time, and no number."""
    empty, tiny = np.empty, np.finfo(dtype).smallest_subnormal

    def leftovers(*args: object, **kwargs: object) -> np.ndarray:
        array = empty(*args, **kwargs)
        if array.dtype.kind == "f":
            array[...] = tiny
        return array

    a = replace(architecture("x"), dtype=dtype)
    compiled, engine = (FastEngine(make(a), *signals(a), Recipe(dtype=dtype)) for _ in range(2))
    compiled.train_batch(np.arange(len(LENGTHS)), 1)  # the kernels, too, say np.empty: compiled before it is another
    monkeypatch.setattr(np, "empty", leftovers)
    engine.train_batch(np.arange(len(LENGTHS)), 1)
    space = engine.space
    assert np.isfinite(space).all()
    assert not ((space != 0) & (np.abs(space) < np.finfo(dtype).smallest_normal)).any()
