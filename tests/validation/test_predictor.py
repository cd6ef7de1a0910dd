"""Predictors: K = 0, causality, time invariance, the gain that made the data, persistence on real records."""

import subprocess
import sys
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.catalog import BENCHMARKS, load
from nnss_cli.datasets.download import fetch
from nnss_cli.datasets.record import Channels, FloatArray, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.methods import Model, compiled
from nnss_cli.methods.linear import subspace_model
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.trained import TrainedModel
from nnss_cli.validation import neural as neural_module
from nnss_cli.validation.disturbance import Disturbance, Increments, constant
from nnss_cli.validation.gain import ALONE, _candidates, _contraction, estimate_gain
from nnss_cli.validation.predictor import Predictor, persistence, step_table, steppers_of
from nnss_cli.validation.stepping import Stepper

HORIZONS = (1, 2, 5, 10, 20)


def signals(model: Model, K: int = 80, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng(seed)
    r, m = len(model.channels.inputs), len(model.channels.outputs)
    return random.standard_normal((K, r)), random.standard_normal((K, m))


def gains(model: Model, size: float, seed: int = 2) -> tuple[FloatArray, ...]:
    random = np.random.default_rng(seed)
    return tuple(size * random.standard_normal((each.size, each.outputs)) for each in steppers_of(model))


@pytest.fixture(params=["linear", "x", "x+u", "x+y", "x+u+y", "float32", "two outputs", "ensemble"])
def model(request: pytest.FixtureRequest, linear: LinearModel, neural: Callable[..., NNSS]) -> Model:
    """A model of each kind."""
    if request.param == "linear":
        return linear
    if request.param == "ensemble":
        return Ensemble((neural("x"), neural("x+y", seed=0, n=3), neural("x+u", seed=4)), "clipped")
    if request.param == "two outputs":
        return neural("x+y", n=3, r=2, m=2)
    return neural("x", dtype="float32") if request.param == "float32" else neural(request.param)


@pytest.mark.system
@pytest.mark.parametrize("window", [1, 4])
def test_without_gain_it_is_the_simulation(model: Model, window: int) -> None:
    u, y = signals(model, 40)
    predictor = Predictor(model, gains(model, 0.0))
    simulated = model.simulate(u, y[:window]).y
    np.testing.assert_array_equal(predictor.predict(u, y, 1, window), simulated)
    np.testing.assert_array_equal(predictor.predict(u, y, None, window), simulated)
    np.testing.assert_array_equal(predictor.predict(u, y, 1000, window), simulated)
    tolerance = 1e-5 if getattr(model, "dtype", None) is not None and "32" in str(model.dtype) else 1e-12
    for horizon in (2, 7, 40):
        np.testing.assert_allclose(predictor.predict(u, y, horizon, window), simulated, rtol=tolerance, atol=tolerance)


def test_along_a_hundred_samples_an_observer_steps_in_compiled_code(
    model: Model, monkeypatch: pytest.MonkeyPatch
) -> None:
    u, y = signals(model, K=100)
    disturbed = [plain.disturbed(constant_of(plain)) for plain in steppers_of(model)]
    starts = [each.start(each.model.simulate(u[:1], y[:1]).x[0], y[0], u[0]) for each in disturbed]
    by_torch: list[int] = []
    own = neural_module.Neural.step
    monkeypatch.setattr(neural_module.Neural, "step", lambda *at: by_torch.append(1) or own(*at))
    found = Predictor(model, gains(model, 0.0)).predict(u, y, 1)
    tolerance = 1e-4 if getattr(model, "dtype", None) is torch.float32 else 1e-9
    np.testing.assert_allclose(found, model.simulate(u, y[:1]).y, rtol=tolerance, atol=tolerance)
    for each, z0 in zip(disturbed, starts, strict=True):
        each.observe(np.zeros((1, each.size, each.outputs)), z0[None], u[:, None], y[:, None])
    assert not by_torch


@pytest.mark.parametrize("K", [90, 120])
@pytest.mark.parametrize("horizon", [1, 5])
@pytest.mark.parametrize("kind", [{"dtype": "float32"}, {"stability": "quadratic"}])
def test_a_prediction_beyond_all_numbers_is_named(
    kind: dict, horizon: int, K: int, neural: Callable[..., NNSS], recwarn: pytest.WarningsRecorder
) -> None:
    model = neural("x", **kind)
    with pytest.raises(InputError, match="the prediction"):
        Predictor(model, gains(model, 1e8)).predict(*signals(model, K), horizon)
    assert not recwarn.list


def test_a_gain_is_no_simulation(model: Model) -> None:
    u, y = signals(model)
    predicted = Predictor(model, gains(model, 0.3)).predict(u, y, 1)
    assert np.abs(predicted - model.simulate(u, y[:1]).y).max() > 0.05


@pytest.mark.system
@pytest.mark.parametrize("horizon", [1, 4])
def test_predictions_know_outputs_up_to_the_horizon_only(model: Model, horizon: int) -> None:
    u, y = signals(model)
    predictor, K = Predictor(model, gains(model, 0.1)), 30
    plain = predictor.predict(u, y, horizon)
    later = y.copy()
    later[K:] += 7
    changed = predictor.predict(u, later, horizon)
    np.testing.assert_array_equal(changed[: K + horizon], plain[: K + horizon])
    assert (changed[K + horizon] != plain[K + horizon]).all()
    other = u.copy()
    other[K:] += 7
    np.testing.assert_array_equal(predictor.predict(other, y, horizon)[:K], plain[:K])
    np.testing.assert_array_equal(predictor.predict(u, y, horizon), plain)  # and again


def test_prediction_does_not_depend_on_the_clock(model: Model) -> None:
    """From the state reached at k the predictor goes on as from the start of a record."""
    u, y = signals(model)
    for stepper, K in zip(steppers_of(model), gains(model, 0.1), strict=True):
        z0 = stepper.start(stepper.model.simulate(u[:1], y[:1]).x[0], y[0], u[0])[None]
        z, predicted = stepper.observe(K[None], z0, u[:, None], y[:, None])
        again, tail = stepper.observe(K[None], z[30], u[30:, None], y[30:, None])
        np.testing.assert_allclose(tail, predicted[30:], rtol=1e-9)
        np.testing.assert_allclose(again, z[30:], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("horizon", [1, 6])
def test_a_record_that_begins_later_is_predicted_alike(
    horizon: int, linear: LinearModel, true_gain: FloatArray
) -> None:
    """Once the observer has forgotten its start: time invariance of the whole predictor."""
    u, y = signals(linear)
    predictor = Predictor(linear, (true_gain,))
    rate = np.abs(np.linalg.eigvals(linear.system.A - true_gain @ linear.system.C)).max()
    begin, settled = 10, 10 + int(np.ceil(np.log(1e-10) / np.log(rate)))
    u, y = np.tile(u, (3, 1)), np.tile(y, (3, 1))
    whole, later = predictor.predict(u, y, horizon), predictor.predict(u[begin:], y[begin:], horizon)
    assert settled + 50 < len(u)
    np.testing.assert_allclose(later[settled - begin :], whole[settled:], rtol=1e-7)
    assert np.abs(later[horizon] - whole[begin + horizon]).max() > 1e-3


def constant_of(stepper: Stepper) -> Disturbance:
    """A disturbance of each output that does not vary."""
    return constant(stepper.model.scaling.u_mean.size, stepper.outputs)


def increments_of(stepper: Stepper) -> Disturbance:
    """Increments from random coefficients, two lags."""
    random, r, m = np.random.default_rng(9), stepper.model.scaling.u_mean.size, stepper.outputs
    draw = (0.2 * random.standard_normal(shape) for shape in ((m, m), (2, m, m), (3, m, r)))
    return Increments(*draw).disturbance()[0]


@pytest.mark.parametrize("by", [None, constant_of, increments_of], ids=["none", "constant", "increments"])
def test_the_observer_is_the_equation(model: Model, by: Callable[[Stepper], Disturbance] | None) -> None:
    """ẑ(k+1) = f(ẑ, u) + K (y − ŷ), step by step; linear models have it in one recursion."""
    u, y = signals(model)
    for plain in steppers_of(model):
        stepper = plain if by is None else plain.disturbed(by(plain))
        K = 0.2 * np.random.default_rng(5).standard_normal((stepper.size, stepper.outputs))
        z0 = np.random.default_rng(6).standard_normal((1, stepper.size))
        z, predicted = stepper.observe(K[None], z0, u[:, None], y[:, None])
        at = z0
        for k in range(len(u)):
            following, expected = stepper.step(at, u[k : k + 1])
            np.testing.assert_allclose(predicted[k], expected, rtol=1e-5, atol=1e-7)
            at = following + (y[k] - expected) @ K.T
            np.testing.assert_allclose(z[k + 1], at, rtol=1e-5, atol=1e-7)
        if by is constant_of:  # it adds to the output, and lasts
            shifted = z0 + np.r_[np.zeros(plain.size), np.ones(stepper.outputs)]
            np.testing.assert_allclose(stepper.step(shifted, u[:1])[1], stepper.step(z0, u[:1])[1] + 1, rtol=1e-5)


KINDS = ["x", "x+y", "float32", "integrator", "ensemble"]


def of_kind(kind: str, neural: Callable[..., NNSS]) -> NNSS | Ensemble:
    if kind == "integrator":
        return integrating("x+u")
    if kind == "ensemble":
        return Ensemble((neural("x"), neural("x+y", n=3), neural("x", seed=4)), "clipped")
    return neural("x", dtype="float32") if kind == "float32" else neural(kind, n=3, r=2, m=2)


@pytest.mark.system
@pytest.mark.parametrize("window", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_along_a_long_record_it_is_the_same_in_compiled_code(
    kind: str, window: int, neural: Callable[..., NNSS], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = of_kind(kind, neural)
    u, y = signals(model)
    tolerance = 1e-4 if kind == "float32" else 1e-9

    def found() -> list[FloatArray]:
        simulation = compiled.free_run(model, u, y[:window])
        several = []  # candidates side by side, with a disturbance
        for plain in steppers_of(model):
            system = plain.disturbed(increments_of(plain))
            K = 0.05 * np.random.default_rng(3).standard_normal((4, system.size, system.outputs))
            z0 = np.repeat(system.start(plain.model.simulate(u[:window], y[:window]).x[0], y[0], u[0])[None], 4, axis=0)
            several += system.observe(K, z0, *(np.repeat(signal[:, None], 4, axis=1) for signal in (u, y)))
        predicted = Predictor(model, gains(model, 0.05)).predict_each(u, y, (1, 5, None), window)
        return [simulation.y, simulation.x, predicted, *several]

    plain = found()
    monkeypatch.setattr(compiled, "LONG", 1)
    fast = found()
    for part in (slice(2), slice(3, None)):
        pairs = zip(fast[part], plain[part], strict=True)
        assert any((one != other).any() for one, other in pairs), "nothing was compiled"
    for one, other in zip(fast, plain, strict=True):
        np.testing.assert_allclose(one, other, rtol=tolerance, atol=tolerance)
        assert one.dtype == other.dtype


def integrating(scheduling: str) -> NNSS:
    """An NN-SS model whose outputs sum up what its stable part gives."""
    random = np.random.default_rng(4)
    scaling = Scaling(
        random.normal(size=1), random.uniform(0.5, 2, 1), random.normal(size=2), random.uniform(0.5, 2, 2)
    )
    a = Architecture(
        2, 1, 2, hidden=(6,), encoder=(4,), scheduling=scheduling, dtype="float64", gamma=0.9, integrator=True
    )
    named = Channels(("u1",), ("y1", "y2"), ("V",), ("m", "m"))
    model = NNSS(a, scaling, named, 0.1)
    model.initialise(random)
    model.step_size.fill_(0.05)
    return model


@pytest.mark.parametrize("scheduling", ["x", "x+u"])
def test_an_integrators_predictor(scheduling: str, jacobians_agree: Callable) -> None:
    """Its outputs are states: the step and its Jacobians have them, and K = 0 simulates."""
    model = integrating(scheduling)
    (system,) = steppers_of(model)
    assert system.size == model.architecture.states == 4
    u, y = signals(model)
    simulated = model.simulate(u, y[:1])
    np.testing.assert_array_equal(Predictor(model, gains(model, 0.0)).predict(u, y, 1), simulated.y)
    z, v = simulated.x[:5], model.scaling.normalise_u(u)[:5]
    following, output = system.step(z, v)
    np.testing.assert_allclose(following, simulated.x[1:6], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(model.scaling.restore_y(output), simulated.y[:5], rtol=1e-9)
    jacobians_agree(system, z, v)


@pytest.mark.system
def test_a_gain_holds_an_integrator_that_drifts() -> None:
    """Its simulation follows no drift of the outputs, and noise lies on them: the observer does, and is stable."""
    model = integrating("x")
    (system,) = steppers_of(model)
    u, y = signals(model, K=300)
    simulated = model.simulate(u, y[:1])
    random = np.random.default_rng(7)
    walk = simulated.y + np.cumsum(0.05 * random.standard_normal(y.shape), axis=0)
    record = Record(u, walk + 0.02 * random.standard_normal(y.shape), 0.1)
    gain = estimate_gain(system, [record[:150]], [record[150:]])
    assert gain.origin != "none"
    assert gain.rate < 1
    table = step_table(Predictor(model, (gain.K,), (gain.disturbance,)), [record[150:]], (1,))
    assert (table.predicted[0] < table.persistence[0]).all()
    assert (table.predicted[0] < 0.5 * table.simulated).all()


def test_a_horizon_of_none_or_less_is_refused(linear: LinearModel) -> None:
    u, y = signals(linear)
    with pytest.raises(InputError, match="horizon: expected at least 1 step ahead, found 0"):
        Predictor(linear, gains(linear, 0.1)).predict(u, y, 0)


def test_models_without_a_known_step_are_refused() -> None:
    class Foreign:
        pass

    with pytest.raises(InputError, match="found Foreign: of other kinds only the simulation is known"):
        steppers_of(Foreign())  # type: ignore[arg-type]


@pytest.mark.parametrize("scheduling", ["x", "x+u", "x+y", "x+u+y"])
def test_jacobians_are_those_of_the_elementary_step(neural: Callable[..., NNSS], scheduling: str) -> None:
    """Reverse differentiation in torch against the complex step of `nnss_cli.system`."""
    model = neural(scheduling, n=3, r=2, m=2)
    (stepper,), system = steppers_of(model), TrainedModel(model).system
    scaling, random = model.scaling, np.random.default_rng(3)
    z, u = random.standard_normal((5, stepper.size)), random.standard_normal((5, 2))
    F, H = stepper.jacobians(z, u)
    unit = np.ones(stepper.size)
    unit[3:] = scaling.y_std[: stepper.size - 3]  # the previous output is physical there
    for k in range(5):
        physical = z[k] * unit + np.concatenate([np.zeros(3), scaling.y_mean[: stepper.size - 3]])
        F_there, _, H_there, _ = system.jacobians(physical, u[k] * scaling.u_std + scaling.u_mean)
        np.testing.assert_allclose(F[k], F_there * unit / unit[:, None], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(H[k], H_there * unit / scaling.y_std[:, None], rtol=1e-9, atol=1e-12)


def innovations_record(model: Model, K: FloatArray, samples: int, sigma: float, seed: int, calm: float = 1.0) -> Record:
    """Data of the model itself: y = h(z, u) + e, z(k+1) = f(z, u) + K e."""
    (stepper,), random = steppers_of(model), np.random.default_rng(seed)
    u, e = (
        calm * random.standard_normal((samples, stepper.model.scaling.u_mean.size)),
        random.standard_normal((samples, stepper.outputs)),
    )
    z, y = np.zeros((1, stepper.size)), np.empty((samples, stepper.outputs))
    for k in range(samples):
        following, clean = stepper.step(z, u[k : k + 1])
        y[k] = clean[0] + sigma * e[k]
        z = following + sigma * (K @ e[k])[None]
    s = stepper.scaling
    return Record(u * s.u_std + s.u_mean, s.restore_y(y), model.Ts)


@pytest.mark.system
@pytest.mark.parametrize("kind", ["linear", "neural"])
def test_on_data_of_the_model_itself_errors_grow_with_the_horizon(
    kind: str, linear: LinearModel, neural: Callable[..., NNSS], true_gain: FloatArray
) -> None:
    model: Model = linear if kind == "linear" else neural()
    K = true_gain if kind == "linear" else np.array([[3.0], [-2.0]])
    record = innovations_record(model, K, 4000, 0.5, seed=4, calm=0.3)
    table = step_table(Predictor(model, (K,)), (record,), HORIZONS, 1)
    errors = [*table.predicted[:, 0], table.simulated[0]]
    slack = 1.005  # of 4,000 samples; far ahead the errors are those of the simulation
    assert all(later > earlier / slack for earlier, later in pairwise(errors)), errors
    sigma = 0.5 * float(model.scaling.y_std[0])  # type: ignore[attr-defined]
    assert errors[0] == pytest.approx(sigma, rel=0.02)
    assert errors[-1] > 1.1 * errors[0]


def test_pieces_of_a_record_begin_where_an_encoder_sees_enough(neural: Callable[..., NNSS]) -> None:
    """Training is cut into pieces, each of which begins with an x(0): of a window where the encoder sees one."""
    model = neural(encoder_window=5)
    (system,) = steppers_of(model)
    u, y = signals(model, K=1000)
    gain = estimate_gain(system, [Record(u[:800], y[:800], 0.1)], [Record(u[800:], y[800:], 0.1)], 5)
    assert gain.rate < 1


@pytest.mark.system
def test_the_gain_that_made_the_data_is_found(linear: LinearModel, true_gain: FloatArray) -> None:
    train, val, test = (innovations_record(linear, true_gain, 3000, 0.5, seed) for seed in (5, 6, 7))
    (stepper,) = steppers_of(linear)
    found = estimate_gain(stepper, (train,), (val,), 1)
    assert found.origin in ("Kalman", "least one-step error")
    assert found.rate < 1
    refined = estimate_gain(stepper, (train,), (val,), 1)
    np.testing.assert_array_equal(refined.K, found.K)  # deterministic
    error = step_table(Predictor(linear, (found.K,), (found.disturbance,)), (test,), (1,), 1).predicted[0, 0]
    best = step_table(Predictor(linear, (true_gain,)), (test,), (1,), 1).predicted[0, 0]
    assert error == pytest.approx(best, rel=0.02)


def test_the_least_squares_gain_is_the_true_one(linear: LinearModel, true_gain: FloatArray) -> None:
    train = innovations_record(linear, true_gain, 4000, 0.5, seed=5)
    candidates = _candidates(steppers_of(linear)[0], (train,), 1, (0.0,))
    np.testing.assert_allclose(candidates["least one-step error, round 2"], true_gain, atol=0.06)


def test_no_gain_where_white_noise_is_all_that_disturbs(linear: LinearModel, true_gain: FloatArray) -> None:
    train, val = (innovations_record(linear, 0 * true_gain, 2000, 0.5, seed) for seed in (8, 9))
    found = estimate_gain(steppers_of(linear)[0], (train,), (val,), 1)
    assert found.origin == "none"
    assert not found.K.any()


def test_an_offset_that_training_did_not_have_is_followed(linear: LinearModel, true_gain: FloatArray) -> None:
    train, val, test = (innovations_record(linear, 0 * true_gain, 600, 0.2, seed) for seed in (10, 11, 12))
    val, test = (Record(each.u, each.y + 20, each.Ts) for each in (val, test))
    (stepper,) = steppers_of(linear)
    found = estimate_gain(stepper, (train,), (val,), 1)
    assert "disturbance" in found.origin
    table = step_table(Predictor(linear, (found.K,), (found.disturbance,)), (test,), (1, 10), 1)
    assert table.predicted[0, 0] < 0.25 * table.simulated[0]
    assert table.predicted[1, 0] < 0.25 * table.simulated[0]


def test_contraction_of_a_linear_observer_is_its_spectral_radius(linear: LinearModel, true_gain: FloatArray) -> None:
    (stepper,) = steppers_of(linear)
    K = np.stack([0 * true_gain, true_gain, [[4.0], [0.0]], true_gain])
    z, u = np.zeros((4000, 4, 2)), np.zeros((4000, 1))
    z[7, 3, 1] = np.nan
    closed = stepper.jacobians(z[0, :1], u[:1])[0] - K @ linear.system.C
    radii = [*np.abs(np.linalg.eigvals(closed[:3])).max(axis=1), np.inf]
    for paths in ([(z, u)], [(z, u), (np.zeros((50, 4, 2)), u[:50])], [(np.zeros((50, 4, 2)), u[:50]), (z, u)]):
        rates, frozen = _contraction(stepper, K, paths)
        assert frozen == pytest.approx(radii)
        assert rates == pytest.approx(radii, rel=0.05 if len(paths) > 1 else 2e-3)  # 50 samples tell less
    assert rates[2] > 1  # so that such a gain is left out


def test_an_observer_that_forgets_at_once_has_no_rate() -> None:
    """A dead beat: the product of F − K H is 0 from some sample on; beside it another grows."""
    jacobians = np.zeros((20, 2, 2)), np.zeros((20, 1, 2))
    jacobians[0][1::2] = 2 * np.eye(2)  # that of the second gain
    system = SimpleNamespace(size=2, jacobians=lambda *_: jacobians)
    rates, radii = _contraction(system, np.zeros((2, 2, 1)), [(np.zeros((10, 2, 2)), np.zeros((10, 1)))])  # type: ignore[arg-type]
    np.testing.assert_allclose(rates, [0, 2])
    np.testing.assert_allclose(radii, [0, 2])


def test_each_observer_has_the_rate_of_its_own_path() -> None:
    """F(k) = z(k) + u(k), a number: the rate is its geometric mean, the radius the largest, over the worse record."""
    random = np.random.default_rng(0)
    paths = [(random.uniform(0.1, 1, (N, 3, 1)), random.uniform(0.1, 1, (N, 1))) for N in (20, 30)]
    system = SimpleNamespace(
        size=1, jacobians=lambda z, u: ((z + u)[:, :, None], np.ones((len(z), 1, 1)))
    )  # fmt: skip
    K = np.array([0.0, 0.05, -0.2]).reshape(3, 1, 1)
    rates, radii = _contraction(system, K, paths)  # type: ignore[arg-type]
    closed = [np.abs(z[:, :, 0] + u - K.ravel()) for z, u in paths]
    np.testing.assert_allclose(rates, np.max([np.exp(np.log(F).mean(axis=0)) for F in closed], axis=0))
    np.testing.assert_allclose(radii, np.max([F.max(axis=0) for F in closed], axis=0))


def test_persistence_repeats_what_was_measured() -> None:
    y = np.arange(6.0)[:, None]
    np.testing.assert_array_equal(persistence(y, 2)[:, 0], [0, 0, 0, 1, 2, 3])


@pytest.mark.system
@pytest.mark.parametrize(
    ("name", "order"),
    [
        ("twotank", 3), ("robotarm", 5), ("cascaded-tanks", 3), ("ced", 3), ("daisy-powerplant", 4),
        pytest.param("emps", 3, marks=pytest.mark.slow),
        pytest.param("silverbox", 2, marks=pytest.mark.slow),
        pytest.param("wiener-hammerstein", 6, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_one_step_ahead_it_beats_persistence_on_real_records(name: str, order: int, mirror: Path) -> None:
    """With N4SID, on the test sets, in every output."""
    benchmark = BENCHMARKS[name]
    fetch(benchmark, mirror=str(mirror), offline=True)
    dataset = load(name, "strict" if "strict" in benchmark.protocols else benchmark.protocols[0])
    fitting, w = dataset.fitting, dataset.fitting.init_window
    model = LinearModel.of(subspace_model(fitting, order, "auto"), fitting)
    found = estimate_gain(steppers_of(model)[0], fitting.train, fitting.val, w)
    for records in dataset.tests.values():
        table = step_table(
            Predictor(model, (found.K,), (found.disturbance,)), [each[:20_000] for each in records], (1,), w
        )
        assert (table.predicted[0] < 0.9 * table.persistence[0]).all()
        assert (table.predicted[0] < table.simulated).all()
    assert (found.origin == ALONE) == (name == "daisy-powerplant")


@pytest.mark.system
def test_of_a_linear_model_nothing_needs_torch_or_scipys_signals() -> None:
    """Which take three seconds to load, of the ten that a validation took."""
    code = """import sys
import nnss_cli.report.validation
from nnss_cli.methods import select
from nnss_cli.testing import small_dataset
from nnss_cli.trained import TrainedModel
from nnss_cli.validation.trained import forecaster
dataset = small_dataset(K=450)
model = TrainedModel(select(["n4sid"])[0].fit(dataset.fitting, 2, 0, {"horizon": "matlab"}, None).model)
(test,) = dataset.tests["test"]
forecaster(model, dataset.fitting.train[0]).predict(test, 3)
assert not {"torch", "scipy.signal"} & set(sys.modules)"""
    subprocess.run([sys.executable, "-c", code], check=True)
