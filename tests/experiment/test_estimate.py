"""How much is planned and how long it takes is said as soon as anything tells."""

from dataclasses import replace

import pytest

from nnss_cli.experiment.estimate import OVERHEAD, Estimate, Forecast, amount, duration, estimate
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


def test_the_nearest_order_tells_the_lower_one_of_two_and_processes_share_the_work() -> None:
    earlier = [result(replace(SPEC, order=n, seed=s), 10.0 * n + s) for n in (2, 6) for s in (0, 1)]
    todo = [replace(SPEC, order=n) for n in (1, 4, 5, 9)] + [replace(SPEC, order=4, seed=1)]
    found = estimate(todo, earlier, 2)
    assert [(g.method, g.order, g.runs, g.seconds) for g in found.groups] == [
        ("nnss", 1, 1, 20.5), ("nnss", 4, 2, 20.5), ("nnss", 5, 1, 60.5), ("nnss", 9, 1, 60.5),
    ]  # fmt: skip
    assert found.seconds == pytest.approx((3 * 20.5 + 2 * 60.5 + 5 * OVERHEAD) / 2)
    assert found.unknown == ()
    assert estimate(todo, earlier, 1).seconds == pytest.approx(2 * found.seconds)
    assert estimate(todo, earlier, 99).seconds == pytest.approx(2 * found.seconds / 5)  # no more processes than runs
    assert estimate(todo, earlier, 0).seconds == pytest.approx(2 * found.seconds)
    assert estimate([], earlier, 2) == Estimate((), 0.0, ())


def test_methods_of_which_nothing_tells_are_named_once() -> None:
    todo = [replace(SPEC, method=method, order=n) for method in ("simba", "nnss", "n4sid") for n in (2, 3)]
    found = estimate(todo, [result(SPEC, 3.0)], 1)
    assert found.unknown == ("simba", "n4sid")
    assert found.seconds == pytest.approx(2 * 3.0 + 6 * OVERHEAD)
    assert [group.seconds for group in found.groups] == [None, None, 3.0, 3.0, None, None]


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        (0.0, "1 s"), (1.4, "1 s"), (119.0, "119 s"), (120.0, "2 min"), (7199.0, "120 min"), (7200.0, "2 h"),
        (86_400.0, "24 h"), (172_799.0, "48 h"), (172_800.0, "2 days"), (1e6, "11.6 days"),
    ],
)  # fmt: skip
def test_a_time_is_told_in_the_unit_that_suits_it(seconds: float, told: str) -> None:
    assert duration(seconds) == told


@pytest.mark.parametrize(("count", "told"), [(5, "1, 2, 3, 4, 5"), (6, "1 to 6")])
def test_up_to_five_orders_are_listed(count: int, told: str) -> None:
    todo = [replace(SPEC, order=n, settings={}) for n in range(count, 0, -1)]
    assert amount(todo) == f"nnss {count} runs of order {told}"
