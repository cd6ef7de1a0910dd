"""Increments beside a model: what they are fitted to, what they predict, when a predictor takes them."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.n4sid import n4sid
from nnss_cli.datasets.record import FloatArray, Record

from nnss_cli.model.nnss import NNSS
from nnss_cli.report import simulation
from nnss_cli.validation.disturbance import Increments
from nnss_cli.validation.gain import ALONE, INCREMENTS, Gain, _beats_persistence, estimate_gain
from nnss_cli.validation.predictor import Predictor, step_table, steppers_of

Signals = tuple[FloatArray, FloatArray, FloatArray]


def coefficients(lags: int, m: int = 2, r: int = 3, own: float = 0.4) -> Increments:
    random = np.random.default_rng(lags)
    shapes = (m, m), (lags, m, m), (lags + 1, m, r)
    S, past, driven = (random.standard_normal(shape) for shape in shapes)
    return Increments(own * S, 0.2 * past, driven)


def made(true: Increments, K: int = 120, seed: int = 1) -> Signals:
    """u, y and h that follow the equation from the first sample that has all its lags."""
    random = np.random.default_rng(seed)
    u, h = random.standard_normal((K, true.driven.shape[2])), random.standard_normal((K, len(true.S)))
    y = random.standard_normal(h.shape)
    for k in range(len(true.past) + 1, K):
        y[k] = y[k - 1] + increment(true, u, y, h, k)
    return u, y, h


def increment(true: Increments, u: FloatArray, y: FloatArray, h: FloatArray, k: int) -> FloatArray:
    """The equation, as the docstring has it."""
    found = true.S @ (h[k] - h[k - 1]) + true.driven[0] @ (u[k] - u[k - 1])
    for i, (A, B) in enumerate(zip(true.past, true.driven[1:], strict=True), start=1):
        found = found + A @ (y[k - i] - y[k - i - 1]) + B @ (u[k - i] - u[k - i - 1])
    return np.asarray(found)


@pytest.mark.parametrize("lags", [0, 1, 2, 3])
@pytest.mark.parametrize("own", [0.4, 0.0], ids=["with the model's", "alone"])
def test_the_coefficients_that_made_the_data_are_found(lags: int, own: float) -> None:
    true = coefficients(lags, own=own)
    several = [made(true, seed=seed) for seed in (1, 2)]
    found = Increments.fitted(*map(list, zip(*several, strict=True)), lags, alone=own == 0)
    assert found is not None
    for name in ("S", "past", "driven"):
        np.testing.assert_allclose(getattr(found, name), getattr(true, name), atol=1e-10)


def test_too_few_samples_are_no_fit() -> None:
    u, y, h = made(coefficients(1))  # 2 + 3 + 5 coefficients an output; alone 8
    assert Increments.fitted([u[:32]], [y[:32]], [h[:32]], 1) is not None
    assert Increments.fitted([u[:31]], [y[:31]], [h[:31]], 1) is None
    assert Increments.fitted([u[:26]], [y[:26]], [h[:26]], 1, alone=True) is not None
    assert Increments.fitted([u[:25]], [y[:25]], [h[:25]], 1, alone=True) is None
    assert Increments.fitted([u], [y], [h * np.nan], 1) is None
    assert Increments.fitted([u], [y], [h * np.nan], 1, alone=True) is not None  # which does not look at h


@pytest.mark.parametrize("lags", [0, 1, 3])
@pytest.mark.parametrize("kind", ["linear", "with D", "x+y"])
def test_the_predictor_is_the_equation_on_what_was_measured(
    lags: int, kind: str, linear: LinearModel, neural: Callable[..., NNSS]
) -> None:
    """One step ahead y(k−1) + Δ, and two ahead the same from what was predicted; h from the simulation."""
    model = neural(kind, m=2, r=3) if kind == "x+y" else linear
    if kind == "with D":
        model = replace(linear, system=replace(linear.system, D=np.array([[0.7]])))
    (own,), (m, r) = steppers_of(model), (len(model.channels.outputs), len(model.channels.inputs))
    true = coefficients(lags, m, r)
    by, K = true.disturbance()
    predictor = Predictor(model, (np.concatenate([np.zeros((own.size, m)), K]),), (by,))
    random = np.random.default_rng(3)
    u, y = random.standard_normal((40, r)), random.standard_normal((40, m))
    h, s = model.simulate(u, y[:1]).y, model.scaling
    v, known, h = s.normalise_u(u), s.normalise_y(y), s.normalise_y(h)
    one, two = (s.normalise_y(predictor.predict(u, y, horizon)) for horizon in (1, 2))
    np.testing.assert_allclose(one[0], known[0], rtol=1e-9)  # from which x(0) is found
    for k in range(lags + 2, len(u)):
        np.testing.assert_allclose(one[k], known[k - 1] + increment(true, v, known, h, k), rtol=1e-9, atol=1e-9)
        foreseen = known.copy()
        foreseen[k - 1] = one[k - 1]
        np.testing.assert_allclose(two[k], one[k - 1] + increment(true, v, foreseen, h, k), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("kind", ["linear", "with D", "x+y"])
def test_jacobians_are_those_of_the_step(
    kind: str, linear: LinearModel, neural: Callable[..., NNSS], jacobians_agree: Callable
) -> None:
    model = neural(kind, m=2, r=3) if kind == "x+y" else linear
    if kind == "with D":
        model = replace(linear, system=replace(linear.system, D=np.array([[0.7]])))
    (own,) = steppers_of(model)
    stepper = own.disturbed(coefficients(2, own.outputs, len(model.channels.inputs)).disturbance()[0])
    random = np.random.default_rng(3)
    z, u = random.standard_normal((4, stepper.size)), random.standard_normal((4, len(model.channels.inputs)))
    jacobians_agree(stepper, z, u)


def test_persistence_must_be_beaten_in_every_output(neural: Callable[..., NNSS]) -> None:
    model = neural("x", m=2, r=3)
    (stepper,), u = steppers_of(model), np.random.default_rng(4).standard_normal((60, 3))
    y, random = model.simulate(u, np.zeros((1, 2))).y, np.random.default_rng(5)
    none = Gain(np.zeros((stepper.size, 2)), "none", 0.5, 0.5, {})
    assert _beats_persistence(stepper, none, [Record(u, y + 1e-9 * random.standard_normal(y.shape), model.Ts)], 1)
    walk = np.column_stack([y[:, 0], 1e-6 * np.arange(60.0) + 9])
    assert not _beats_persistence(stepper, none, [Record(u, walk, model.Ts)], 1)


def drifting(model: LinearModel, K: int, seed: int) -> Record:
    """Levels that wander off, and follow what the inputs do at once: nothing that the model's poles could tell."""
    random = np.random.default_rng(seed)
    u = np.cumsum(random.standard_normal((K, 1)), axis=0)
    walk = np.cumsum(3 * random.standard_normal((K, 1)), axis=0)
    return Record(u, -8 * u + walk, model.Ts)


def test_increments_are_taken_where_nothing_else_beats_persistence(linear: LinearModel) -> None:
    train, val, test = (drifting(linear, K, seed) for K, seed in ((300, 1), (150, 2), (150, 3)))
    (stepper,) = steppers_of(linear)
    found = estimate_gain(stepper, (train,), (val,))
    assert found.origin == ALONE
    assert found.rate < 1
    assert len(found.K) == stepper.size + found.disturbance.size  # type: ignore[union-attr]
    tried = {name for name in found.val if name.startswith(INCREMENTS)}
    assert tried == {f"{kind}, {lags} lags" for kind in (ALONE, INCREMENTS) for lags in (0, 1, 2, 3)}
    table = step_table(Predictor(linear, (found.K,), (found.disturbance,)), (test,), (1,))
    assert table.predicted[0, 0] == pytest.approx(3, rel=0.1)  # what nobody can foresee
    assert table.persistence[0, 0] > 2 * table.predicted[0, 0]


def test_they_are_not_tried_where_a_gain_will_do(plant_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    fitting = plant_data(coloured=True).fitting
    monkeypatch.setattr(Increments, "fitted", lambda *_: pytest.fail("there was no need of it"))
    found = estimate_gain(steppers_of(LinearModel.of(n4sid(fitting.normalised()[0], 2), fitting))[0],
                          fitting.train, fitting.val)  # fmt: skip
    assert "increments" not in found.origin


@pytest.mark.system
def test_what_is_predicted_without_the_model_is_told_and_fails(
    nnss: Callable, plant_run: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    random = np.random.default_rng(5)
    u = np.cumsum(random.standard_normal(600))
    y = -8 * u + np.cumsum(3 * random.standard_normal(600))
    Path("new.csv").write_text("u1,y1\n" + "\n".join(f"{a:.17g},{b:.17g}" for a, b in zip(u, y, strict=True)))
    drawn: list[str] = []
    plain = simulation.draw_simulated
    monkeypatch.setattr(simulation, "draw_simulated", lambda *args: drawn.append(args[5]) or plain(*args))
    done = nnss("predict", plant_run(), "new.csv", "--data", "new.csv", "--plot")
    assert drawn == ["increments alone, without ssest, order 2, seed 0, trained on plant (strict)"]
    assert done.code == 0, done.err
    assert "the model has no part in this: increments of inputs and outputs alone validate better" in done.out
    done = nnss("validate", plant_run(), "new.csv", "--data", "new.csv", "--json")
    assert done.code == 1
    found = json.loads(done.out)
    assert found["gains"] == [ALONE]
    failed = [test["name"] for test in found["tests"] if not test["passed"]]
    assert failed[-1] == "on validation, a gain of the model beats persistence"
    assert any("do not rely on its levels" in line for line in found["verdict"])
