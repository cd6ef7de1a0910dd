"""`validate` against a second computation in plain loops: two inputs and outputs, feedthrough, an init window."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, FloatArray, Record, Scaling

from nnss_cli.trained import TrainedModel
from nnss_cli.validation import check
from nnss_cli.validation.check import validate
from nnss_cli.validation.gain import Gain
from nnss_cli.validation.overlap import samples_in
from nnss_cli.validation.predictor import Predictor
from nnss_cli.validation.residuals import dependence, whiteness
from nnss_cli.validation.result import as_dict
from nnss_cli.validation.trained import Fitting, Forecaster

W = 3
A = np.array([[0.9, 0.2, 0.0], [-0.2, 0.9, 0.1], [0.0, 0.0, 0.5]])
B = np.array([[1.0, 0.0], [0.3, -0.5], [0.0, 1.0]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -1.0]])
D = np.array([[0.4, 0.0], [-0.3, 0.8]])
SCALING = Scaling(np.array([1.0, -2.0]), np.array([2.0, 0.5]), np.array([3.0, 0.0]), np.array([4.0, 0.1]))


@pytest.fixture
def validated(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """What `validate` finds of a linear model with a gain K that contracts by a rate, beside linear limits."""

    def run(records: list[Record], K: FloatArray, rate: float, limits: tuple[float | None, ...]) -> Any:
        monkeypatch.setattr(check, "coherence_limits", lambda _: list(limits))
        asked: list[tuple[int, ...]] = []  # order and first samples that are not scored
        monkeypatch.setattr(check, "fitted_limits", lambda _, *of: asked.append(of) or [None] * len(limits))
        named = Channels(("u1", "u2"), ("y1", "y2"), ("–", "–"), ("–", "–"))
        model = LinearModel(LinearStateSpace(A, B, C, D, 0.5), SCALING, named)
        trained = TrainedModel(
            model,
            origin=SimpleNamespace(init_window=W, order=3, method="n4sid", seed=0, dataset="plant", protocol="strict"),
        )  # type: ignore[arg-type]
        gain = Gain(K, "Kalman", rate, rate, {"none": 1.0})
        found = validate(
            Forecaster(trained, Predictor(model, (K,)), (gain,), Fitting((records[0],), (records[0],))), records, "new"
        )
        assert asked == [(3, W)]
        return found

    return run


def experiments(lengths: tuple[int, ...]) -> list[Record]:
    """Records of the plant with noise, each about a level of its own, from an initial state that is far off."""
    random, found = np.random.default_rng(0), []
    for level, K in enumerate(lengths):
        u, x = random.standard_normal((K, 2)), np.array([8.0, -5.0, 3.0])
        y = np.empty((K, 2))
        for k in range(K):
            y[k] = C @ x + D @ u[k] + 0.3 * random.standard_normal(2)
            x = A @ x + B @ u[k]
        found.append(Record(u * SCALING.u_std + SCALING.u_mean, (y + level) * SCALING.y_std + SCALING.y_mean, 0.5))
    return found


def by_hand(record: Record, K: FloatArray) -> FloatArray:
    """ŷ(k | k − 1) from the least-squares x(0) of the first W samples."""
    u, y = (record.u - SCALING.u_mean) / SCALING.u_std, (record.y - SCALING.y_mean) / SCALING.y_std
    rows, forced, x = [], [], np.zeros(3)
    for k in range(W):
        rows.append(C @ np.linalg.matrix_power(A, k))
        forced.append(C @ x + D @ u[k])
        x = A @ x + B @ u[k]
    x = np.linalg.lstsq(np.concatenate(rows), y[:W].ravel() - np.concatenate(forced), rcond=None)[0]
    predicted = np.empty_like(y)
    for k in range(len(y)):
        predicted[k] = C @ x + D @ u[k]
        x = A @ x + B @ u[k] + K @ (y[k] - predicted[k])
    return np.asarray(predicted * SCALING.y_std + SCALING.y_mean)


def test_samples_that_a_part_of_the_model_has_seen_are_told() -> None:
    """Of protocol paper's two-tank validation is the first third of test."""
    records = experiments((300, 160))
    fitting = Fitting((records[1],), (records[0][40:90],))
    lines = list(check._known((fitting,), records))
    assert lines == [
        "No independent evidence: the model or its predictor was fitted to 160 of these 460 samples.",
        "No independent evidence: the model's epoch, the predictor's gain and the bands were chosen on 50 of these 460 "
        "samples.",
    ]
    own, given = Fitting((records[0][:100],), ()), Fitting((records[0][80:150],), (records[1],))
    assert [line.split(": ")[1] for line in check._known((own, given), records)] == [
        "the model or its predictor was fitted to 150 of these 460 samples.",  # those that both have count once
        "the model's epoch, the predictor's gain and the bands were chosen on 160 of these 460 samples.",
    ]
    assert list(check._known((fitting,), [replace(records[0], y=records[0].y + 1e-9)])) == []
    later = records[0].y.copy()
    later[89] += 1e-9  # the last sample of validation
    (told,) = check._known((fitting,), [replace(records[0], y=later)])
    assert "chosen on 49 of these 300 samples" in told
    (told,) = check._known((fitting,), [Record(records[0].u[:70], records[0].y[:70], 0.5)])  # ends in the midst of it
    assert "chosen on 30 of these 70 samples" in told


def test_shared_samples_are_found_by_stretches_that_move() -> None:
    random = np.random.default_rng(0)
    u, y = random.standard_normal((200, 2)), random.standard_normal((200, 1))
    record = Record(u, y, 0.5)

    def shared(*parts: Record) -> list[int]:
        return np.flatnonzero(samples_in(record, parts)).tolist()

    cut, short = Record(u[50:90], y[50:90], 0.5), Record(u[50:69], y[50:69], 0.5)
    other = Record(np.vstack([-u[:30], u[60:79]]), np.vstack([y[:30], y[60:79]]), 0.5)
    assert shared(cut) == list(range(50, 90))
    assert shared(other) == []  # 19 in a row are no stretch of a longer record
    assert shared(short) == list(range(50, 69))  # but the whole of this one
    assert shared(cut, Record(u[:200:3], y[:200:3], 0.5), Record(u[150:], y[150:], 0.5)) == [
        *range(50, 90), *range(150, 200),
    ]  # fmt: skip
    assert shared(Record(u, y[::-1], 0.5)) == []  # inputs alone
    assert samples_in(cut, [record]).all()
    zeros = [np.where(np.arange(200) % 40, y.T, zero).T for zero in (0.0, -0.0)]
    assert samples_in(Record(u, zeros[0], 0.5), [Record(u, zeros[1], 0.5)]).all()
    rest = Record(np.where(np.arange(200) < 120, 0, u.T).T, np.where(np.arange(200) < 120, -0.0, y.T).T, 0.5)
    again = Record(np.zeros((200, 2)), np.zeros((200, 1)), 0.5)
    assert not samples_in(rest, [again]).any()
    assert not samples_in(again, [rest]).any()


def test_an_observer_that_grows_along_the_record_fails(validated: Callable) -> None:
    """Whatever it did along training: K H takes the eigenvalues of F − K H out of the unit disc."""
    records, K = experiments((300, 160)), np.array([[2.5, 0.0], [0.0, 0.0], [0.0, 0.0]])
    found = validated(records[:1], K, 0.5, (None, None))
    (rate,) = found.rates
    assert rate == pytest.approx(np.abs(np.linalg.eigvals(A - K @ C)).max(), rel=0.01)
    assert rate > 1
    assert [test.passed for test in found.tests if test.name == "the observer is stable"] == [False]


@pytest.mark.parametrize(
    ("rate", "left_out", "limits"),
    [(0.8, 21, (10.0, 99.9)), (0.2, W, (None, 10.0)), (0.95, 32, (99.9, None)), (1.0, W, (10.0, 10.0))],
)
def test_numbers_are_those_of_a_second_computation(
    rate: float, left_out: int, limits: tuple[float | None, ...], validated: Callable
) -> None:
    """Residuals begin where 99 % of the start are forgotten, at a fifth of the shortest record, or after the window."""
    records, K = experiments((300, 160)), np.array([[0.3, 0.0], [0.1, 0.2], [0.0, -0.1]])
    found = validated(records, K, rate, limits)
    assert found.left_out == left_out
    assert any("90 samples to forget" in line and "the first 32" in line for line in found.verdict) == (rate == 0.95)
    free, one_ahead = ([record.y - by_hand(record, own) for record in records] for own in (0 * K, K))
    for i, each in enumerate(found.outputs):
        errors = np.concatenate([part[W:, i] for part in free])
        varying = np.concatenate([record.y[W:, i] - record.y[W:, i].mean() for record in records])
        assert each.rmse == pytest.approx(np.sqrt(np.mean(errors**2)))
        assert each.fit_percent == pytest.approx(100 * (1 - np.sqrt(np.sum(errors**2) / np.sum(varying**2))))
        assert each.sigma == SCALING.y_std[i]
        assert each.limit == max(limits[i] or 0.0, each.fit_percent)
        assert each.reached == each.fit_percent  # by a linear model
        assert 20 < each.fit_percent < 95
        own = [part[left_out:, i] for part in one_ahead]
        assert each.residual_rmse == pytest.approx(np.sqrt(np.mean(np.concatenate(own) ** 2)))
        assert each.white.statistic == pytest.approx(whiteness(own).statistic)
        assert each.simulation_r1 == pytest.approx(whiteness([part[left_out:, i] for part in free]).correlation[0])
        for j in range(2):
            u = [record.u[left_out:, j] for record in records]
            assert each.depends[j].statistic == pytest.approx(dependence(own, u).statistic)
            assert each.simulation_depends[j] == pytest.approx(
                dependence([part[left_out:, i] for part in free], u).p_value
            )
    squares = sum(np.sum(part[W:] ** 2, axis=0) for part in one_ahead)
    np.testing.assert_allclose(found.steps.predicted[0], np.sqrt(squares / (460 - 2 * W)))
    assert found.steps.horizons == (1, 2, 5, 10, 20)
    half = found.limits.band.half_width  # from the first record, which is 300 samples of 460
    held = sum(np.sum(np.abs(part[W:]) <= half, axis=0) for part in free) / (460 - 2 * W)
    np.testing.assert_allclose(found.limits.held, held)
    assert np.all(held != np.mean(np.abs(free[0][W:]) <= half, axis=0))
    np.testing.assert_allclose(found.limits.high[:, 0], records[0].y[:, 0] - free[0][:, 0] + half[0])  # which is drawn
    assert (found.experiments, found.samples) == (2, 460)
    assert as_dict(found)["band"]["held"] == held.tolist()  # type: ignore[index]
    assert found.radius == pytest.approx(np.abs(np.linalg.eigvals(A)).max())
