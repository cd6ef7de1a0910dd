"""An NN-SS whose outputs integrate: the structure for any weights, both engines, and a plant that is found again."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from nnss_cli.baselines.arx import longest_time_constant
from nnss_cli.datasets.record import Channels, FittingData, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS, load_model
from nnss_cli.model.architecture import STABILITIES, Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training import fast as fast_module
from nnss_cli.training.candidates import worth_trying
from nnss_cli.training.engine import ReferenceEngine
from nnss_cli.training.fast import FastEngine, Weights
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.recipe import Recipe, recipe_of

RECIPE = Recipe(
    hidden=(6,), encoder=(4,), dtype="float64", window=0, optimiser="gauss-newton", initial="feedback", epochs=40,
    patience=40, consistency=0.0, integrator="auto",
)  # fmt: skip


def make(r: int = 2, m: int = 2, scheduling: str = "x", stability: str = "schur", feedthrough: bool = True) -> NNSS:
    a = Architecture(
        3, r, m, (7,), (4,), scheduling, dtype="float64", stability=stability, feedthrough=feedthrough, integrator=True
    )
    scaling = Scaling(np.zeros(r), np.ones(r), np.full(m, 2.0), np.full(m, 3.0))
    model = NNSS(a, scaling, Channels(("u",) * r, ("y",) * m, ("",) * r, ("",) * m), 1.0)
    model.initialise(np.random.default_rng(0))
    model.step_size[:] = torch.linspace(0.2, 0.3, m)
    torch.nn.init.uniform_(model.generator_drift.bias, -1, 1, generator=torch.Generator().manual_seed(0))
    return model


@pytest.mark.parametrize("stability", STABILITIES)
@pytest.mark.parametrize("scheduling", ["x", "x+u"])
def test_the_integrator_is_exact_and_feeds_nothing_back(scheduling: str, stability: str) -> None:
    model, random = make(scheduling=scheduling, stability=stability), np.random.default_rng(1)
    x, u = (torch.tensor(random.standard_normal((1, size))) for size in (5, 2))
    J = torch.autograd.functional.jacobian(lambda x: model.step(x, u, x[:, 3:])[0], x)[0, :, 0].numpy()
    np.testing.assert_array_equal(J[:3, 3:], 0.0)
    np.testing.assert_array_equal(J[3:, 3:], np.eye(2))
    following, y = model.step(x, u, x[:, 3:])
    assert torch.equal(y, x[:, 3:])
    part = NNSS(replace(model.architecture, integrator=False), model.scaling, model.channels, 1.0)
    own = {name: array for name, array in model.state_dict().items() if name != "initial_spread"}
    part.load_state_dict(own, strict=False)
    inner, v = part.step(x[:, :3], u, x[:, 3:])
    assert torch.equal(
        following, torch.cat([inner, x[:, 3:] + model.step_size * (v + model.generator_drift.bias)], dim=1)
    )


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("stability", STABILITIES)
@pytest.mark.parametrize("scheduling", ["x", "x+u"])
def test_engines_agree(
    scheduling: str, stability: str, feedthrough: bool, whole: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fast_module, "STRETCH", 4)
    model, random = make(2, 2, scheduling, stability, feedthrough), np.random.default_rng(2)
    u, y, x0 = (random.standard_normal(shape) for shape in ((2, 11, 2), (2, 11, 2), (2, 5)))
    fast, reference = (
        whole(engine(model, u, y, Recipe()).sensitivities(x0), x0) for engine in (FastEngine, ReferenceEngine)
    )
    for ours, theirs in zip(fast, reference, strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * max(1.0, np.abs(theirs).max()))
    long = random.standard_normal((60, 2))
    for known in (y[0, :1], y[0, :8]):
        expected = model.simulate(long, model.scaling.restore_y(known))
        ours, states = Weights(model).free_run(long, known)
        np.testing.assert_allclose(model.scaling.restore_y(ours), expected.y, atol=1e-8)
        np.testing.assert_allclose(states, expected.x, atol=1e-8)
        assert expected.x.shape == (60, 5)


def test_it_begins_at_the_measured_output_and_is_read_back(tmp_path: Path) -> None:
    model, random = make(), np.random.default_rng(3)
    u, first = random.standard_normal((30, 2)), random.standard_normal((1, 2))
    simulated = model.simulate(u, first)
    np.testing.assert_allclose(simulated.y[0], first[0], rtol=1e-12)
    L = np.tril(random.standard_normal((5, 5)))
    model.initial_spread.copy_(torch.from_numpy(L))
    model.save(tmp_path)
    np.testing.assert_array_equal(load_model(tmp_path).simulate(u, first).y, simulated.y)
    part = load_model(tmp_path).lpv_part().initial_spread.numpy()
    np.testing.assert_allclose(part @ part.T, (L @ L.T)[:3, :3])  # the covariance of its own states


def drive(u: np.ndarray, friction: float = 0.1) -> np.ndarray:
    """Position of a mass with viscous and saturating friction, driven by a force."""
    velocity, position, y = 0.0, 0.0, np.empty((len(u), 1))
    for k, (force,) in enumerate(u):
        y[k] = position
        position += velocity
        velocity = 0.95 * velocity + 0.1 * force - friction * np.tanh(velocity)
    return y


def data_of(base: FittingData, friction: float) -> FittingData:
    random = np.random.default_rng(5)
    train, val = (Record(u, drive(u, friction), 1.0) for u in (random.standard_normal((K, 1)) for K in (900, 400)))
    return replace(base, train=(train,), val=(val,), scaling=Scaling.of((train,)), init_window=10)


@pytest.fixture
def driven(small_data: Callable) -> FittingData:
    return data_of(small_data().fitting, 0.1)


@pytest.mark.system
@pytest.mark.parametrize(("friction", "hidden", "error"), [(0.0, 2, 1e-3), (0.1, 6, 1e-2)])
def test_an_integrator_is_found_from_data_without_noise(
    friction: float, hidden: int, error: float, small_data: Callable
) -> None:
    recipe = RECIPE.replace(hidden=(hidden,), epochs=60, patience=60)
    training = train_nnss(data_of(small_data().fitting, friction), 2, 0, recipe)
    assert training.model.architecture.integrator
    assert training.model.architecture.states == 2
    assert training.candidates["integrator"] < error
    assert training.candidates["integrator"] < 0.2 * training.candidates["as it is"]
    assert "integrator taken: it lowers the validation error by more than 20%" in training.remarks


def test_it_is_tried_only_where_a_pole_cannot_be_told_from_one(driven: FittingData, small_data: Callable) -> None:
    assert longest_time_constant(driven.train) >= 900
    assert worth_trying(driven, 2, RECIPE, driven.train) == ("integrator",)
    assert worth_trying(driven, 1, RECIPE, driven.train) == ()  # no state would be left
    assert worth_trying(driven, 2, RECIPE.replace(optimiser="adam"), driven.train) == ()
    assert worth_trying(driven, 2, RECIPE.replace(integrator="no"), driven.train) == ()
    assert worth_trying(small_data().fitting, 2, RECIPE, small_data().fitting.train) == ()
    leak = replace(driven, train=(replace(driven.train[0], y=np.diff(driven.train[0].y, axis=0, prepend=0.0)),))
    assert worth_trying(leak, 2, RECIPE, leak.train) == ()


def test_what_cannot_integrate_is_refused(driven: FittingData) -> None:
    with pytest.raises(InputError, match="integrator: expected scheduling x or x\\+u, found x\\+y"):
        Architecture(2, 1, 1, scheduling="x+y", integrator=True)
    with pytest.raises(InputError, match="integrator: 1 of the states integrate, so expected an order above, found 1"):
        METHODS["nnss"].settings(driven, 1, {"integrator": "yes"})
    with pytest.raises(InputError, match="integrator: the fast engine .* found optimiser adam: take gauss-newton"):
        Recipe(integrator="yes")
    with pytest.raises(InputError, match="integrator 'perhaps'.*auto, yes, no"):
        Recipe(integrator="perhaps")
    assert recipe_of("paper", {}, 2).integrator == "no"
    assert recipe_of("best", {}, 2).integrator == "auto"


@pytest.mark.system
def test_the_plain_engine_trains_one_by_adam_too(driven: FittingData) -> None:
    recipe = Recipe(
        integrator="yes", engine="reference", hidden=(4,), encoder=(4,), window=40, stride=40, epochs=3, dtype="float64"
    )
    training = train_nnss(driven, 2, 0, recipe)
    assert training.model.architecture.integrator
    assert training.train_loss[-1] < training.train_loss[0]


@pytest.mark.parametrize("stability", STABILITIES)
@pytest.mark.parametrize("scheduling", ["x", "x+u"])
def test_in_elementary_operations_it_is_the_same_model(scheduling: str, stability: str) -> None:
    """What is linearised and exported."""
    model, random = make(scheduling=scheduling, stability=stability), np.random.default_rng(4)
    system, u = model.elementary(), random.standard_normal((80, 2))
    first = random.standard_normal(2)
    expected = model.simulate(u, first)
    y, z = system.simulate(u, system.start(first, u[0]))
    np.testing.assert_allclose(y, expected.y, rtol=0, atol=1e-10)
    np.testing.assert_allclose(z, expected.x, rtol=0, atol=1e-10)
    A, B, C, D = (system.frozen(z=z[5][:, None], u=u[5][:, None])[name] for name in "ABCD")
    np.testing.assert_allclose(A[3:], np.hstack([A[3:, :3], np.eye(2)]))
    assert not A[:3, 3:].any()
    assert not D.any()
    drift = np.append(np.zeros(3), (model.step_size * model.generator_drift.bias.detach()).numpy())
    np.testing.assert_allclose(A @ z[5] + B @ (u[5] - system.u_mean) + drift, z[6], rtol=0, atol=1e-10)
    assert C.shape == (2, 5)
    assert abs(np.linalg.eigvals(system.jacobians(z[5], u[5])[0]) - 1).min() < 1e-9
