"""What a predictor is made on and predicts with: the parts of a given record, members' deviation, horizons told."""

import statistics
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.record import FloatArray, Record

from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.trained import TrainedModel
from nnss_cli.validation.predict import predict_record
from nnss_cli.validation.predictor import Predictor
from nnss_cli.validation.trained import (
    Fitting,
    Forecaster,
    fitting_records,
    predicted_with_spread,
    records_to_validate,
)


def record(samples: int, r: int = 1, m: int = 1) -> Record:
    random = np.random.default_rng(2)
    return Record(random.standard_normal((samples, r)), random.standard_normal((samples, m)), 0.5)


def test_a_given_record_is_fitted_on_its_first_seven_tenths(linear: LinearModel) -> None:
    given = record(95)
    found = fitting_records(TrainedModel(linear), given)
    (train,), (val,) = found.train, found.val
    assert len(train) == 66
    np.testing.assert_array_equal(np.concatenate([train.y, val.y]), given.y)
    np.testing.assert_array_equal(np.concatenate([train.u, val.u]), given.u)


@pytest.mark.parametrize(
    ("kept", "split", "taken"),
    [("train val night day", "", "night"), ("val train", "", "val"), ("train val night", "train", "train")],
)
def test_the_first_test_set_is_validated_on_else_val(kept: str, split: str, taken: str) -> None:
    records = {name: (record(30),) for name in kept.split()}
    trained: Any = SimpleNamespace(records=lambda: records)
    assert records_to_validate(trained, split) == (taken, records[taken])


@pytest.mark.parametrize("horizon", [None, 2])
def test_the_spread_is_the_members_standard_deviation(horizon: int | None, neural: Callable[..., NNSS]) -> None:
    """With N − 1 in the denominator, sample by sample, whatever the rule that puts them together."""
    members = tuple(neural("x", n=n, r=2, m=2, seed=0) for n in (2, 3, 4))
    new = record(12, 2, 2)
    K: tuple[FloatArray, ...] = tuple(0.1 * np.ones((n, 2)) for n in (2, 3, 4))
    trained = TrainedModel(Ensemble(members, "clipped"))
    predictor = Predictor(trained.model, K)
    y, spread = predicted_with_spread(trained, new, horizon, "ensemble", predictor)
    each = [
        Predictor(*pair).predict(new.u, new.y, horizon) for pair in zip(members, [(own,) for own in K], strict=True)
    ]
    assert spread is not None
    for k in range(12):
        for i in range(2):
            assert spread[k, i] == pytest.approx(statistics.stdev(float(part[k, i]) for part in each))
    np.testing.assert_array_equal(y, predictor.predict(new.u, new.y, horizon))


@pytest.mark.parametrize(("horizon", "told"), [(1, (1,)), (6, (1, 2, 5, 6)), (70, (1, 2, 5, 10, 20, 50, 70))])
def test_errors_are_told_at_horizons_up_to_the_one_asked_for(
    horizon: int, told: tuple[int, ...], linear: LinearModel
) -> None:
    new = record(90)
    found = Forecaster(
        TrainedModel(linear), Predictor(linear, (np.array([[0.6], [0.3]]),)), (), Fitting((new,), (new,))
    )
    predicted = predict_record(found, new, horizon)
    assert predicted.steps.horizons == told
    error = np.sqrt(np.mean((predicted.y - new.y)[1:] ** 2))
    assert predicted.steps.predicted[-1, 0] == pytest.approx(error)
