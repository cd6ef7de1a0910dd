"""What linear relations explain of a record: known shares, two definitions that agree, and what neither tells."""

from collections.abc import Callable

import numpy as np
import pytest
import scipy.signal
from nnss_cli.baselines.n4sid import n4sid
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.baselines.subspace import Horizon
from nnss_cli.datasets.record import FloatArray, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.experiment.run import score_outputs
from nnss_cli.validation import limit
from nnss_cli.validation.limit import coherence_limits, fitted_limits, larger


def linear_limits(records: list[Record], order: int) -> list[float | None]:
    return larger(coherence_limits(records), fitted_limits(records, order))


@pytest.fixture
def fitted(monkeypatch: pytest.MonkeyPatch) -> Callable[[LinearStateSpace | None], None]:
    """Makes one model, in normalised units, of all that is fitted; or none that could be."""

    def only(model: LinearStateSpace | None) -> None:
        def fit(*_: object) -> LinearStateSpace:
            if model is None:
                raise InputError("too short")
            return model

        monkeypatch.setattr(limit, "ssest", fit)
        monkeypatch.setattr(limit, "n4sid", fit)

    return only


def experiments(levels: tuple[float, ...], noise: tuple[float, float] = (0.5, 2.0)) -> list[Record]:
    """Two inputs, two outputs of a fast plant with white noise, each experiment about a level of its own."""
    random, found = np.random.default_rng(0), []
    for level in levels:
        u, e = random.standard_normal((2, 3000, 2))
        y = scipy.signal.lfilter([1, 0.5], [1, -0.5], u @ [[1, 0.3], [0.5, 1]], axis=0) + noise * e
        found.append(Record(u, y + level, 0.1))
    return found


@pytest.mark.parametrize("levels", [(0.0,), (0.0, 30.0), (-5.0, 40.0, 0.0)])
def test_coherence_leaves_the_noise(levels: tuple[float, ...], fitted: Callable) -> None:
    """Of several experiments, too: their levels are no part of it, as they are none of a fit."""
    fitted(None)
    records = experiments(levels)
    centred = np.concatenate([record.y - record.y.mean(axis=0) for record in records])
    expected = 100 * (1 - np.array([0.5, 2.0]) / centred.std(axis=0))
    np.testing.assert_allclose(linear_limits(records, 2), expected, atol=1.5)


def test_the_fit_of_a_fitted_model_is_that_of_scores(fitted: Callable) -> None:
    """So that a model's fit and the limit can be compared, on experiments at different levels, too."""
    A, B, C = np.array([[0.5, 0.2], [0.0, 0.3]]), np.eye(2), np.array([[0.5, 0.0], [0.2, 0.1]])
    model = LinearStateSpace(A, B, C, 0.1 * np.eye(2), 0.1)
    fitted(model)
    for levels in ((0.0,), (0.0, 3.0)):
        records = [record[:400] for record in experiments(levels)]
        scaling = Scaling.of(tuple(records))
        simulated = [run(model, scaling, each) for each in records]
        for begin in (0, 100):
            y, found = ([part[begin:] for part in parts] for parts in ([each.y for each in records], simulated))
            offset = np.mean(np.concatenate(y) - np.concatenate(found), axis=0)  # that of all these samples is best
            scores = score_outputs("", y, [part + offset for part in found], scaling)
            assert fitted_limits(records, 2, begin) == [pytest.approx(score.fit_percent) for score in scores]


def test_a_long_record_is_scored_as_a_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linear models are fitted to its lively part, where any fits better: on the whole none beats the true plant."""
    random = np.random.default_rng(3)
    amplitude = np.repeat([1.0, 0.02], [2100, 8000])[:, None]
    u, e = amplitude * random.standard_normal((10_100, 1)), 0.1 * random.standard_normal((10_100, 1))
    plant = scipy.signal.lfilter([0.0, 0.5], [1, -0.8], u, axis=0)
    y = plant + e + 3 * (amplitude < 1)  # another level: the offset is that of all samples
    monkeypatch.setattr(limit, "ssest", lambda records, _, order: limit.n4sid(records, order))  # which is quick
    for record, simulated in ((Record(u, plant + e, 1.0), plant), (Record(u, y, 1.0), plant)):
        error, centred = record.y - simulated, record.y - record.y.mean()
        (found,) = fitted_limits([record], 2)
        assert found == pytest.approx(100 * (1 - error.std() / centred.std()), abs=1)
    lively = slice(0, 2048)
    assert 100 * (1 - e[lively].std() / (plant + e)[lively].std()) > 85  # as the excerpt would have it
    assert 100 * (1 - e.std() / (plant + e).std()) < 80


def test_linear_models_of_several_orders_are_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    """SSEST of the model's own order and one more, N4SID of 2, 4 and 6 by two weightings."""
    tried: list[tuple[str, int]] = []

    def refuse(name: str, order: int) -> LinearStateSpace:
        tried.append((name, order))
        raise InputError("too short")

    monkeypatch.setattr(limit, "ssest", lambda _, __, order: refuse("ssest", order))
    monkeypatch.setattr(limit, "n4sid", lambda _, order, __: refuse("n4sid", order))
    assert fitted_limits(experiments((0.0,)), 3) == [None, None]
    assert tried == [("ssest", 3), ("ssest", 4), *(("n4sid", order) for order in (2, 2, 4, 4, 6, 6))]


def run(model: LinearStateSpace, scaling: Scaling, record: Record) -> FloatArray:
    scaled = scaling.apply(record)
    return scaling.restore_y(model.simulate(scaled.u, model.initial_state(scaled))[0])


def test_the_limit_is_the_larger_of_both(monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow plant outlasts the segments of coherence, which counts what no model can use: inputs that repeat y."""
    monkeypatch.setattr(limit, "ssest", lambda records, _, order: limit.n4sid(records, order))  # which is quick
    white = np.random.default_rng(1).standard_normal((1001, 1))
    slow = Record(white[1:], scipy.signal.lfilter([0, 0.02], [1, -0.98], white[1:], axis=0), 1.0)
    acausal = Record(white[:-1], white[1:], 1.0)  # u(k) = y(k − 1)
    both = [linear_limits([record], 2)[0] for record in (slow, acausal)]
    monkeypatch.setattr(limit, "welch", lambda *_: None)
    fitted_alone = [linear_limits([record], 2)[0] for record in (slow, acausal)]
    assert both[0] == fitted_alone[0] == pytest.approx(100)
    assert both[1] > 95  # type: ignore[operator]
    assert fitted_alone[1] < 5  # type: ignore[operator]


@pytest.mark.parametrize(("order", "failing"), [(6, "ssest"), (3, "n4sid")])
def test_orders_up_to_six_and_one_more_than_the_models_own_are_fitted(
    order: int, failing: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plant without noise of order 6, or of one more than the model's 2: by either way alone nothing is left."""

    def short(*_: object) -> LinearStateSpace:
        raise InputError("too short")

    def quick(records: tuple[Record, ...], _: object, order: int) -> LinearStateSpace:
        return n4sid(records, order, Horizon(4 * order, 4 * order, True, "moesp"))

    monkeypatch.setattr(limit, "ssest", quick)
    monkeypatch.setattr(limit, failing, short)
    poles = np.linspace(0.3, 0.9, order) * (-1.0) ** np.arange(order)
    u = np.random.default_rng(0).standard_normal((600, 1))
    u = np.concatenate([u - u.mean(), np.zeros((100, 1))])  # from rest to rest, so that means go with each other
    record = Record(u, scipy.signal.lfilter([0.0, 1.0], np.poly(poles), u, axis=0), 1.0)
    assert fitted_limits([record], 2) == [pytest.approx(100, abs=0.1)]


def test_what_does_not_vary_has_no_limit(fitted: Callable) -> None:
    fitted(None)
    (record,) = experiments((0.0,))
    flat = np.full((len(record), 1), 0.1)
    assert linear_limits([Record(flat, record.y, 0.1)], 2) == [None, None]
    whole = linear_limits([record], 2)
    found = linear_limits([Record(np.hstack([flat, record.u]), np.hstack([flat, record.y]), 0.1)], 2)
    assert found == [None, *(pytest.approx(value) for value in whole)]
    stuck = [Record(record.u, np.full((len(record), 1), level), 0.1) for level in (0.3, 0.1, 1e6 / 3)]
    assert linear_limits(stuck, 2) == [None]
