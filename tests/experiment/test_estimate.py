"""How much is planned and how long it takes is said as soon as anything tells."""

from dataclasses import replace

import pytest

from nnss_cli.experiment.estimate import OVERHEAD, Forecast, amount, estimate
from nnss_cli.experiment.run import RunResult, RunSpec

SPEC = RunSpec("d", "p", "nnss", 2, 0, {"epochs": 300}, "x")
MEAN = replace(SPEC, method="nnss-ensemble", settings={"epochs": 300, "members": [0, 1]})


def result(spec: RunSpec, seconds: float) -> RunResult:
    return RunResult(spec, "failed", "why", (), 0, seconds, {}, {}, {})


def test_what_is_planned_is_said_by_method() -> None:
    todo = [replace(SPEC, order=n, seed=s) for n in (2, 3) for s in range(600)]
    todo += [replace(SPEC, method="n4sid", order=n, settings={}) for n in range(1, 61)]
    assert amount(todo) == ("nnss 1,200 runs of order 2, 3, each of 300 epochs at most; n4sid 60 runs of order 1 to 60")
    assert amount(todo[:1]) == "nnss 1 run of order 2, each of 300 epochs at most"
    mixed = [SPEC, replace(SPEC, order=3, settings={"epochs": 1000})]
    assert amount(mixed) == "nnss 2 runs of order 2, 3, each of 300 to 1,000 epochs at most"
    assert amount([MEAN]) == "nnss-ensemble 1 run of order 2, made of the others' runs"


def test_a_combination_is_expected_to_take_what_it_takes_itself() -> None:
    """Its fit's time has its members' in it, which are planned or done by themselves."""
    made = replace(result(MEAN, 79.0), provenance={"seconds": "0.4"})
    told = estimate([replace(MEAN, order=3)], [made], 1)
    assert told.seconds == pytest.approx(0.4 + OVERHEAD)
    for text in ({}, {"seconds": "soon"}):  # of an older nnss, or of a damaged file
        assert estimate([MEAN], [replace(made, provenance=text)], 1).seconds == pytest.approx(79.0 + OVERHEAD)


def test_a_first_study_is_estimated_from_its_own_first_runs() -> None:
    todo = [replace(SPEC, seed=s) for s in range(10)] + [replace(SPEC, method="simba", seed=s) for s in range(10)]
    forecast = Forecast(todo, [], 2)
    assert forecast.after(result(todo[0], 4.0)) is None, "nothing tells of simba yet"
    assert forecast.after(result(todo[1], 6.0)) is None
    told = forecast.after(result(todo[10], 1.0))
    assert told is not None
    assert told.seconds == pytest.approx((8 * 5.0 + 9 * 1.0 + 17 * OVERHEAD) / 2)
    assert forecast.after(result(todo[2], 5.0)) is None, "once"
    assert Forecast(todo, [result(todo[0], 1.0), result(todo[10], 1.0)], 2).after(result(todo[1], 9.0)) is None
