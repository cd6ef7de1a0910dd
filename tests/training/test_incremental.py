"""Starts and training of the incrementally stable layer, and what commands make of it."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.baselines.ssest import ssest
from nnss_cli.datasets.catalog import load
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights
from nnss_cli.training.feedback import Feedback, feedback_start, fit_feedback
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.lure_start import linear_layer, promising_bases, promising_basis, start_layer
from nnss_cli.training.recipe import Recipe, recipe_of
from nnss_cli.training.warm import linear_start


def make(a: Architecture, seed: int = 0) -> NNSS:
    r, m = a.inputs, a.outputs
    scaling = Scaling(np.zeros(r), np.ones(r), np.zeros(m), np.ones(m))
    model = NNSS(a, scaling, Channels(("u",) * r, ("y",) * m, ("",) * r, ("",) * m), 1.0)
    model.initialise(np.random.default_rng(seed))
    return model


def lure_plant(n: int, m: int, seed: int, strength: float = 0.3) -> tuple[Feedback, np.ndarray]:
    """A stable Lur'e model whose outputs feed back through saturations, and states of it."""
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= 0.8 / np.abs(np.linalg.eigvals(A)).max()
    C = random.standard_normal((m, n))
    model = Feedback(
        A, random.standard_normal((n, 1)), C, np.zeros((m, 1)), -strength * A @ C.T / np.linalg.norm(C) ** 2, 2 * C
    )
    return model, model.states(random.standard_normal((300, 1)), np.zeros(n))


@pytest.mark.system
@pytest.mark.parametrize(("gamma", "gain"), [(1.0, 0.0), (0.99, 0.0), (1.0, 100.0)])
def test_a_linear_start_simulates_like_ssest(gamma: float, gain: float) -> None:
    data = load("twotank-sim").fitting
    train, val = data.normalised()
    train, val = (train[0][:400],), (val[0][:200],)
    a = Architecture(2, 1, 1, (6,), (3,), gamma=gamma, dtype="float64", stability="incremental", gain=gain)
    model = make(a)
    linear_layer(model, linear_start(train, val, 2, gamma), train, np.random.default_rng(0))
    record: Record = val[0]
    linear = ssest(train, val, 2)
    ours = Weights(model).free_run(record.u, record.y[0])[0]
    theirs, _ = linear.simulate(record.u, linear.state_from_output(record.y[0], record.u[0]))
    np.testing.assert_allclose(ours, theirs, atol=1e-8)
    assert model.generator.promised_norm() < 1


@pytest.mark.parametrize(("n", "m", "hidden"), [(2, 1, 1), (3, 2, 8), (4, 1, 12)])
@pytest.mark.parametrize("gain", [0.0, 60.0])
def test_a_lure_model_is_taken_over_exactly(n: int, m: int, hidden: int, gain: float) -> None:
    plant, x = lure_plant(n, m, seed=n)
    a = Architecture(n, 1, m, (hidden,), (m,), dtype="float64", stability="incremental", gain=gain)
    model = make(a)
    T, drawn = start_layer(model, plant.plain(), x, np.random.default_rng(0))
    assert drawn.A is not None
    np.testing.assert_array_equal(drawn.A, plant.A)  # there was no need to draw it in
    u = np.random.default_rng(1).standard_normal((200, 1, 1))
    y, states = Weights(model).free_runs(u, np.zeros((m, 1)), T @ x[5][:, None])
    path = plant.states(u[:, :, 0], x[5])
    np.testing.assert_allclose(states[:, :, 0], path @ T.T, atol=1e-9)
    np.testing.assert_allclose(y[:, :, 0], plant.outputs(u[:, :, 0], path), atol=1e-9)
    assert model.generator.promised_norm() < 1


def test_a_lure_model_that_keeps_no_promise_is_drawn_in_until_it_does() -> None:
    plant, x = lure_plant(2, 1, seed=3)
    steep = plant.plain()._replace(F=-8 * plant.F)  # ρ(A + FG) > 1: some trajectories part
    assert np.abs(np.linalg.eigvals(steep.A + steep.F @ steep.G)).max() > 1
    a = Architecture(2, 1, 1, (4,), (1,), dtype="float64", stability="incremental")
    assert promising_basis(steep, a) is None
    model = make(a)
    _, drawn = start_layer(model, steep, x, np.random.default_rng(0))
    assert 0 < np.linalg.norm(drawn.F) < np.linalg.norm(steep.F)
    assert model.generator.promised_norm() < 1
    small = make(Architecture(3, 1, 2, (1,), (2,), dtype="float64", stability="incremental"))
    with pytest.raises(InputError, match="at least 2 hidden units, found 1"):
        start_layer(small, lure_plant(3, 2, 0)[0].plain(), np.zeros((3, 3)), np.random.default_rng(0))


@pytest.mark.parametrize("scheduling", ["x", "x+u"])
def test_a_feedback_start_simulates_like_the_lure_model(scheduling: str) -> None:
    plant, _ = lure_plant(2, 1, seed=2)
    random = np.random.default_rng(5)

    def record(K: int) -> Record:
        u = random.standard_normal((K, 1))
        return Record(u, plant.outputs(u, plant.states(u, np.zeros(2))) + 0.01 * random.standard_normal((K, 1)), 1.0)

    train, val = (record(400),), (record(200),)
    a = Architecture(2, 1, 1, (6,), (4,), scheduling, dtype="float64", stability="incremental")
    linear = linear_start(train, val, 2, 1.0)
    model = make(a)
    assert feedback_start(model, linear, train, val, np.random.default_rng(1))
    gain = 2.0 * np.exp(0.5 * np.random.default_rng(1).standard_normal())

    def bases(each: Feedback) -> Iterator[tuple[float, np.ndarray]]:
        return ((norm, T) for norm, T, _ in promising_bases(each.plain(), a))

    found = fit_feedback(linear, train, val, 1.0, a.epsilon, gain, bases=bases)
    assert found is not None
    y = Weights(model).free_run(val[0].u, val[0].y[0])[0]
    E = np.linalg.lstsq(np.column_stack([train[0].y, np.ones(400)]), found[1], rcond=None)[0]
    path = found[0].states(val[0].u, val[0].y[0] @ E[:-1] + E[-1])
    np.testing.assert_allclose(y, found[0].outputs(val[0].u, path), atol=1e-7)


@pytest.mark.system
@pytest.mark.parametrize("optimiser", ["gauss-newton", "adam", "lbfgs"])
@pytest.mark.parametrize("engine", ["fast", "reference"])
def test_training_goes_down_in_both_engines(optimiser: str, engine: str) -> None:
    data = load("twotank-sim").fitting
    recipe = Recipe(
        hidden=(4,), encoder=(3,), stability="incremental", initial="linear", window=20, stride=500, batch=2,
        dtype="float64", optimiser=optimiser, epochs=3, engine=engine, consistency=0.0,
    )  # fmt: skip
    training = train_nnss(data, 2, 0, recipe)
    assert training.remarks == () or "refused every epoch" in training.remarks[0]
    assert training.train_loss[-1] < training.train_loss[0]
    assert training.model.generator.promised_norm() < 1


def test_the_best_recipe_takes_it_and_keeps_the_gain() -> None:
    data = load("twotank-sim").fitting
    recipe = recipe_of("best", data.presets, 2).replace(stability="incremental", epochs=4, gain=20.0)
    training = train_nnss(data, 2, 0, recipe)
    assert training.model.architecture.gain == 20.0
    assert training.model.generator.promised_norm() < 1
    assert not set(training.candidates) & {"cold start", "integrator"}


@pytest.mark.system
@pytest.mark.usefixtures("weak_adversary")
def test_commands(nnss: Callable, tmp_path: Path) -> None:
    quick = ("twotank-sim", "--order", "2", "--stability", "incremental", "--epochs", "2")
    done = nnss("train", *quick, "--gain", "30", "--gamma", "0.999")
    assert done.code == 0, done.err
    run = "results/twotank-sim/paper/runs/nnss-n2-s0"
    certified = nnss("certify", run, "--steps", "1000", "--budget", "2")
    assert certified.code == 0, certified.out
    assert "‖x1(k) − x2(k)‖ ≤ 0.999ᵏ" in certified.out
    assert "No promised bound is broken." in certified.out
    content = json.loads(Path(run, "model.json").read_text())["architecture"]
    assert (content["stability"], content["gain"]) == ("incremental", 30.0)
    csv = tmp_path / "new.csv"
    csv.write_text("u,y\n" + "\n".join(f"{0.1 * (i % 7)},0.1" for i in range(60)) + "\n")
    assert nnss("show", run).code == 0
    assert nnss("export", run, "--to", "control", "--out", str(tmp_path / "out")).code == 0


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--stability", "incremental", "--scheduling", "x+y"), "expected scheduling x or x+u, found x+y"),
        (("--stability", "incremental", "--hidden", "8", "8"), "expected one hidden layer, found 2"),
        (("--stability", "incremental", "--recipe", "paper", "--hidden", "8", "8"), "expected one hidden layer"),
        (("--stability", "incremental", "--gain", "-1"), "gain: expected a positive bound"),
        (("--stability", "incremental", "--gain", "3", "--integrator", "yes"), "gain: expected no integrator"),
        (
            ("--gain", "3"),
            "expected stability incremental, which can promise one, found auto: give --stability incremental",
        ),
    ],
)
def test_what_does_not_go_together_is_one_line(options: tuple, told: str, nnss: Callable) -> None:
    refused = nnss("train", "twotank-sim", "--order", "2", *options)
    assert refused.code == 2
    assert told in refused.err
    assert refused.err.count("\n") == 1
