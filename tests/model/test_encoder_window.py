"""An encoder that sees a window of samples: what it sees, both engines, exports, and a state that is found exactly."""

import ctypes
import importlib.util
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Dataset, FittingData, Record, Scaling

from nnss_cli.app import main
from nnss_cli.errors import InputError
from nnss_cli.experiment.certificate import certify
from nnss_cli.export import c99, export
from nnss_cli.iterative import named_random
from nnss_cli.methods import METHODS, load_model
from nnss_cli.model.architecture import COMBINATIONS, Architecture
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.trained import TrainedModel
from nnss_cli.training.encoder import seen_windows
from nnss_cli.training.engine import ReferenceEngine, training_loss
from nnss_cli.training.fast import FastEngine, Weights
from nnss_cli.training.recipe import Recipe, recipe_of
from nnss_cli.training.start import begin

W = 3


def make(seed: int = 0, **changes: Any) -> NNSS:
    """Two inputs, two outputs, three states; random weights, and a scaling that does something."""
    choices = {"hidden": (5,), "encoder": (4,), "dtype": "float64", "encoder_window": W} | changes
    a = Architecture(3, 2, 2, **choices)
    scaling = Scaling(np.array([1.0, 2.0]), np.array([0.5, 3.0]), np.array([-1.0, 4.0]), np.array([2.0, 0.25]))
    model = NNSS(a, scaling, Channels(("u1", "u2"), ("y1", "y2"), ("V", "V"), ("m", "m")), 0.5)
    random = np.random.default_rng(seed)
    model.initialise(random)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.from_numpy(0.1 * random.standard_normal(tuple(parameter.shape))))
    return model


def signals(*shape: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.standard_normal((*shape, 2)), random.standard_normal((*shape, 2))


def test_it_sees_outputs_then_inputs_sample_after_sample() -> None:
    u, y = np.arange(100.0, 110.0).reshape(5, 2), np.arange(10.0).reshape(5, 2)
    expected = np.array([[*y[k : k + W].ravel(), *u[k : k + W].ravel()] for k in range(3)])
    assert np.array_equal(seen_windows(u, y, W), expected)
    side_by_side = seen_windows(np.stack([u, -u], axis=2), np.stack([y, -y], axis=2), W)
    assert np.array_equal(side_by_side, np.stack([expected, -expected], axis=2))
    model = make()
    assert np.array_equal(model.seen(torch.tensor(u), torch.tensor(y)).numpy(), expected)
    assert np.array_equal(model.seen(*(torch.tensor(np.stack([s, -s])) for s in (u, y)))[1].numpy(), -expected)
    assert model.architecture.encoder_inputs == len(expected[0]) == 12
    plain = make(encoder_window=1)
    assert np.array_equal(plain.seen(torch.tensor(u), torch.tensor(y)).numpy(), y)  # the paper's
    assert np.array_equal(seen_windows(u, y, 1), y)


@pytest.mark.parametrize("integrator", [False, True])
@pytest.mark.parametrize(("stability", "scheduling"), COMBINATIONS)
def test_engines_agree_on_loss_gradient_and_simulation(stability: str, scheduling: str, integrator: bool) -> None:
    """In torch by its own differentiation; windows of two lengths, the shortest one sample longer than what it sees."""
    if integrator and "y" in scheduling:
        return  # refused: it would close a loop around the integrator
    model = make(stability=stability, scheduling=scheduling, integrator=integrator, feedthrough=True, gamma=0.9)
    lengths = (W + 1, 9, 9)
    u, y = ([signals(L, seed=L + i)[signal] for i, L in enumerate(lengths)] for signal in (0, 1))
    recipe = Recipe(dtype="float64", consistency=0.3)
    fast, plain = FastEngine(model, u, y, recipe), ReferenceEngine(model, u, y, recipe)
    vector = np.concatenate([array.ravel() for array in fast.weights().values()])
    if not integrator:  # Adam trains none in the compiled engine
        ours, theirs = fast.loss_and_gradient(vector), plain.loss_and_gradient(vector)
        assert ours[0] == pytest.approx(theirs[0], rel=1e-12)
        np.testing.assert_allclose(ours[1], theirs[1], atol=1e-12 * np.abs(theirs[1]).max())
        encoder = np.concatenate([["encoder" in name] * array.size for name, array in fast.weights().items()])
        assert np.abs(theirs[1][encoder]).min() > 0  # all that it sees counts
    known = y[1][: W + 2]
    np.testing.assert_allclose(fast.free_run(u[1], known), plain.free_run(u[1], known), atol=1e-12)
    scaling = model.scaling
    physical = u[1] * scaling.u_std + scaling.u_mean, scaling.restore_y(known)
    np.testing.assert_allclose(scaling.normalise_y(model.simulate(*physical).y), fast.free_run(u[1], known), atol=1e-12)


def test_the_loss_asks_the_encoder_wherever_its_window_is_whole() -> None:
    model, (u, y) = make(), signals(2, 7)
    U, Y = torch.tensor(u), torch.tensor(y)
    simulated, x = model(U, model.seen(U, Y)[:, 0])
    guesses = np.array([[model.encode(torch.tensor([*b[k : k + W].ravel(), *a[k : k + W].ravel()])).tolist()
                         for k in range(5)] for a, b in zip(u, y, strict=True)])  # fmt: skip
    np.testing.assert_allclose(x[:, 0].detach().numpy(), guesses[:, 0], atol=1e-14)
    drift = np.mean((x[:, 1:5].detach().numpy() - guesses[:, 1:]) ** 2)
    expected = np.mean((simulated.detach().numpy() - y) ** 2) + 0.3 * drift
    assert training_loss(model, U, Y, 0.3).item() == pytest.approx(expected, rel=1e-12)


def test_float32_agrees_too() -> None:
    model, (u, y) = make(dtype="float32"), signals(8, 12)
    recipe = Recipe(consistency=0.3)
    fast, plain = FastEngine(model, list(u), list(y), recipe), ReferenceEngine(model, list(u), list(y), recipe)
    vector = np.concatenate([array.ravel() for array in fast.weights().values()])
    ours, theirs = fast.loss_and_gradient(vector), plain.loss_and_gradient(vector)
    assert ours[0] == pytest.approx(theirs[0], rel=1e-5)
    np.testing.assert_allclose(ours[1], theirs[1], atol=1e-4 * np.abs(theirs[1]).max())


def test_a_simulation_starts_where_the_encoder_says_and_knows_no_later_output() -> None:
    model, (u, y) = make(), signals(20)
    expected = model.simulate(u, y[:W])
    assert np.array_equal(model.simulate(u, y[:10]).y, expected.y)
    moved = y.copy()
    moved[W - 1] += 1
    assert not np.allclose(model.simulate(u, moved[:W]).y, expected.y)
    for few in (y[0], y[: W - 1]):
        with pytest.raises(InputError, match="y_init: expected the first 3 output samples or more, .* found [12]$"):
            model.simulate(u, few)
        with pytest.raises(InputError, match="y_init: expected the first 3"):
            Weights(model).free_run(u, few)


def test_an_integrator_begins_at_the_first_output_of_the_window() -> None:
    model, (u, y) = make(integrator=True), signals(20)
    np.testing.assert_allclose(model.simulate(u, y[:W]).y[0], y[0], rtol=1e-12)


def test_it_is_kept_and_one_of_before_sees_one_sample(tmp_path: Path) -> None:
    model, (u, y) = make(), signals(20)
    model.save(tmp_path / "new")
    assert np.array_equal(load_model(tmp_path / "new").simulate(u, y[:W]).y, model.simulate(u, y[:W]).y)
    make(encoder_window=1).save(tmp_path / "old")
    text = (tmp_path / "old" / "model.json").read_text()
    assert '"encoder_window": 1' in text
    (tmp_path / "old" / "model.json").write_text(re.sub(r',\s*"encoder_window": 1', "", text))
    assert load_model(tmp_path / "old").architecture.encoder_window == 1


# exports


@pytest.mark.parametrize("changes", [{}, {"integrator": True}, {"scheduling": "x+y"}])
def test_the_elementary_start_is_the_encoders(changes: dict) -> None:
    (u, y), models = signals(20), tuple(make(seed, **changes) for seed in (0, 1))
    for model in (models[0], Ensemble(models)):
        system, trained = model.elementary(), TrainedModel(model)
        assert system.first == W
        z0 = system.start(y[:W], u[:W])
        np.testing.assert_allclose(z0, trained.initial_state(u, y[:W]), atol=1e-12)
        np.testing.assert_allclose(system.simulate(u, z0)[0], model.simulate(u, y[:W]).y, atol=1e-9)
        if "integrator" not in changes:  # which has none
            assert np.isfinite(trained.equilibrium(np.zeros(2)).z).all()
    assert make(encoder_window=1).elementary().first == 1


@pytest.mark.system
def test_exports_start_from_the_window_and_say_so(tmp_path: Path) -> None:
    model, (u, y) = TrainedModel(make(scheduling="x+u+y")), signals(20)
    expected = model.initial_state(u, y[:W])
    export(model, "control", tmp_path / "control", name="plant")
    spec = importlib.util.spec_from_file_location("plant_of_a_window", tmp_path / "control" / "plant.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    np.testing.assert_allclose(module.initial(y[:W], u[:W]), expected, atol=1e-12)
    said = "the first 3 output samples (3 m,) and their inputs (3 r,), sample after sample"
    assert said in module.initial.__doc__
    export(model, "c", tmp_path / "c", name="plant")
    assert said in (tmp_path / "c" / "plant.h").read_text()
    c99.compile_c([tmp_path / "c" / "plant.c"], tmp_path / "plant.so", "-shared", "-fPIC")
    z = np.empty(len(expected))
    first = [np.ascontiguousarray(signal[:W]) for signal in (y, u)]
    ctypes.CDLL(str(tmp_path / "plant.so")).plant_initial(*(ctypes.c_void_p(a.ctypes.data) for a in (*first, z)))
    np.testing.assert_allclose(z, expected, atol=1e-12)
    export(model, "mat", tmp_path / "mat", name="plant")
    assert said in (tmp_path / "mat" / "plant_initial.m").read_text()


@pytest.mark.system
def test_a_certificate_names_the_start_and_covers_it() -> None:
    model, (u, y) = make(stability="quadratic", gamma=0.9), signals(40)
    y[:W] *= 100
    found = certify(model, {"train": (Record(u, y, 0.5),)}, steps=50, init_window=10)
    assert found.holds_for == "x(0) = g of the first 3 samples of the 1 records given, inputs within their range"
    start = np.linalg.norm(model.simulate(u, y[:W]).x[0])
    assert found.initial_state == pytest.approx(start)
    assert found.state_bound >= start


# training


@pytest.fixture
def driven(small_data: Callable[..., Dataset], system: Callable) -> FittingData:
    """Records without noise of a slow linear plant that begin anywhere: one output does not tell where."""
    random = np.random.default_rng(3)
    plant = LinearStateSpace(*system(2, 1, 1, 5, radius=0.97), 0.5)

    def record(K: int) -> Record:
        u = random.standard_normal((K, 1))
        return Record(u, plant.simulate(u, 5 * random.standard_normal(2))[0], 0.5)

    train, val = tuple(record(K) for K in (90, 60, 70)), (record(60), record(60))
    unit = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.full(1, 3.0))  # at rest where u = y = 0, as the plant is
    return replace(small_data().fitting, train=train, val=val, scaling=unit, init_window=4)


@pytest.mark.system
@pytest.mark.parametrize(("changes", "error"), [
    ({"initial": "feedback"}, 1e-3), ({"initial": "linear"}, 2e-3),
    ({"initial": "linear", "stability": "incremental"}, 2e-3), ({"initial": "linear", "scheduling": "x+y"}, 2e-3),
    ({"initial": "linear", "stability": "quadratic"}, 8e-3),
])  # fmt: skip
def test_a_window_tells_the_state_that_one_output_does_not(changes: dict, error: float, driven: FittingData) -> None:
    """Within a few thousandths of a deviation from the first sample on, which an encoder of y(0) misses by far."""
    method, errors = METHODS["nnss"], {}
    val = driven.val[0]
    for window in (1, 4):
        alone = replace(driven, init_window=4 if window > 1 else 1)  # else x(0) would be fitted to the window
        settings = method.settings(alone, 2, {"hidden": (2,), "epochs": 20, "encoder_window": window, **changes})
        fit = method.fit(alone, 2, 0, settings, None)
        y = fit.model.simulate(val.u, val.y[:window]).y
        errors[window] = float(np.sqrt(np.mean((y - val.y) ** 2)) / driven.scaling.y_std[0])
    assert errors[4] < error
    assert errors[1] > 3 * error


def test_a_random_start_is_left_as_it_was_drawn(driven: FittingData) -> None:
    a = recipe_of("paper", {}, 2).replace(encoder_window=4).architecture(2, 1, 1)
    one, other = (NNSS(a, driven.scaling, driven.channels, 0.5) for _ in range(2))
    begin(one, "random", *driven.normalised(), 7, 4)
    other.initialise(named_random(7, "weights"))
    for name, weight in one.state_dict().items():
        assert torch.equal(weight, other.state_dict()[name]), name


def test_adam_trains_one_and_both_engines_alike(driven: FittingData) -> None:
    method, found = METHODS["nnss"], []
    for engine in ("fast", "reference"):
        settings = method.settings(
            driven, 2, {"recipe": "paper", "encoder_window": 4, "window": 12, "hidden": (6,), "encoder": (3,),
                        "epochs": 8, "engine": engine, "dtype": "float64", "patience_unit": "epochs", "stride": 4},
        )  # fmt: skip
        found.append(method.fit(driven, 2, 0, settings, None).history["val_rmse"])
    assert len(found[0]) == 8
    assert found[0][-1] < found[0][0]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-8)


@pytest.mark.parametrize(("changes", "init_window", "message"), [
    ({"encoder_window": 0}, 5, "encoder window: expected at least 1 sample, found 0"),
    ({"encoder_window": 6}, 5,
     "encoder window: expected at most the first 5 of a record's samples, since the others are scored, found 6: take "
     "--encoder-window 5 or less"),
    ({"encoder_window": 2}, 1,
     "encoder window: expected at most the first 1 of a record's samples, since the others are scored, found 2: take a "
     "protocol that leaves some unscored, or give your data an init_window (docs/own-data.md)"),
    ({"encoder_window": 12, "window": 12}, 20,
     "encoder window: expected fewer samples than the 12 of a training window, found 12: take --encoder-window 11 or "
     "less, or a longer --window"),
])  # fmt: skip
def test_a_window_that_cannot_be_is_one_line(
    changes: dict, init_window: int, message: str, driven: FittingData
) -> None:
    data = replace(driven, init_window=init_window)
    with pytest.raises(InputError) as told:
        METHODS["nnss"].settings(data, 2, changes)
    assert str(told.value) == message


def test_the_cold_candidate_is_left_out_where_its_windows_are_no_longer_than_the_encoders() -> None:
    recipe = recipe_of("best", {}, 2)
    assert "initial" in recipe.replace(encoder_window=59).alternatives(1000)
    assert "initial" not in recipe.replace(encoder_window=60).alternatives(1000)


def test_the_option_reaches_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="2"):
        main(["train", "twotank-sim", "--order", "2", "--encoder-window", "5"])
    assert "encoder window: expected at most the first 1" in capsys.readouterr().err
