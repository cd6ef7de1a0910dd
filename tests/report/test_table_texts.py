"""The page of errors and its cells: order, heads, and what is said where there is nothing to say."""

import math
from dataclasses import replace
from typing import Any

from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.report import tables
from nnss_cli.report.aggregate import MEAN, NORMALISED, groups, output_error

CHANNELS = {"inputs": ["u"], "outputs": ["y"], "input_units": ["V"], "output_units": ["m"]}


def run(method: str, seed: int = 0, order: int = 2, **errors: float) -> RunResult:
    """A run with these RMSE/σ by split, σ = 100; without any, one that diverged."""
    scores = tuple(Score("".join(list(split)), "y1", 100 * e, e, 0.0) for split, e in errors.items())
    spec = RunSpec("a", "own", method, order, seed, {}, "0", "1")
    return RunResult(spec, "ok" if scores else "diverged", "", scores, 1, 1.0, {}, {}, CHANNELS)


def test_numbers_that_are_not_finite_have_signs_of_their_own() -> None:
    assert [tables.number(value) for value in (math.inf, -math.inf)] == ["∞", "−∞"]
    assert (tables.number(-1e-5), tables.number(-2e6)) == ("-1e-05", "-2e+06")
    assert [tables.percent(value) for value in (math.inf, -math.inf, math.nan, 12.345)] == ["∞", "−∞", "–", "12.3"]
    assert (tables.percent(12.345).value, tables.number(None).value, tables.number(2).value) == (12.345, None, 2.0)
    cell = tables.span(1.23456, math.inf, ("low", "high"), 3)
    assert (cell, cell.value) == ("1.23–∞", {"low": 1.23456, "high": math.inf})


def test_an_option_that_an_order_does_not_have_is_told_and_members_are_none() -> None:
    def with_options(order: int, **settings: Any) -> RunResult:
        one = run("nnss", order=order, test=1.0)
        return replace(one, spec=replace(one.spec, settings=settings))

    runs = [with_options(3, epochs=3, members=[1]), with_options(2, epochs=3, members=[2], batch=None)]
    assert tables.options_apart(runs) == []
    runs += [with_options(4, epochs=4, batch=8)]
    assert tables.options_apart(runs) == [
        "nnss has other options at different orders: epochs 3 at order 2, 3; 4 at order 4. "
        "batch – at order 2, 3; 8 at order 4."
    ]


def test_a_page_of_errors_has_its_parts_in_order() -> None:
    runs = [run("nnss", 0, val=0.25, test=0.5), run("nnss", 1), run("nnss-ensemble", val=0.125, test=0.25)]
    runs[0] = replace(runs[0], notes=("mind this",), remarks=("it kept its start",))
    text = tables.rmse_markdown(runs, ["a damaged run"])
    assert text.startswith("# RMSE of a, protocol `own`\n\nFree simulation from the first output sample")
    marks = [
        "\n\nRMSE/σ: σ is", "\n\nNote: mind this\n\n", "\n\n## Validation\n\n|", "\n\n## Test\n\n|",
        "\n\n## Runs without a result\n\n- nnss, order 2, seed 1: diverged: ", "\n\n## Left out\n\n- a damaged run\n\n",
        "## Remarks of the fits\n\n- nnss, order 2, seed 0: it kept its start\n",
    ]  # fmt: skip
    places = [text.find(mark) for mark in marks]
    assert -1 not in places
    assert places == sorted(places)
    assert text.count("Made of runs above, so no independent competitor:\n\n|") == 2
    assert text.endswith("start\n")
    assert "Output `mean`" not in text


def test_a_page_of_one_run_has_no_part_without_lines() -> None:
    plain = tables.rmse_markdown([run("ssest", val=0.25, test=0.5)])
    assert [line for line in plain.splitlines() if line.startswith("#")] == [
        "# RMSE of a, protocol `own`", "## Validation", "## Test",
    ]  # fmt: skip
    assert "Made of runs" not in plain
    row = next(line for line in plain.splitlines() if "| ssest" in line)
    assert [cell.strip() for cell in row.split("|")[1:-1]] == [
        "2", "ssest", "y [m]", "1/1", "25", "25", "0.0", "25", "–", "–",
    ]  # fmt: skip
    alone = tables.rmse_markdown([run("nnss-ensemble", test=0.25)])
    assert "## Test" not in alone
    assert "Made of runs above" in alone


def test_several_outputs_have_their_two_means_explained() -> None:
    two = replace(run("nnss", test=1.0), channels={name: values * 2 for name, values in CHANNELS.items()})
    assert "methods are ranked by `mean of RMSE/σ`" in tables.rmse_markdown([two])


def test_heads_have_the_unit_and_a_table_of_combinations_stands_apart() -> None:
    runs = [run("nnss", val=0.25, test=0.5), run("nnss-ensemble", val=0.125, test=0.25)]
    (one,), (apart,) = tables.error_tables(runs), tables.error_tables(runs, apart=True)
    assert one.heads == {
        "order": "n", "fit": "fit\n[%]", **{name: f"{name}\n[m]" for name in ("train", "val", "test", "best")},
    }  # fmt: skip
    assert (one.about, one.rows[0]["test"]) == ({"split": "test", "output": "y [m]"}, "50")
    assert [row["method"] for row in apart.rows] == ["nnss-ensemble"]
    assert tables.error_tables(runs[:1], apart=True) == []
    for unit in ("–", ""):
        bare = replace(runs[0], channels=CHANNELS | {"output_units": [unit]})
        assert tables.error_tables([bare])[0].heads == {"order": "n", "fit": "fit\n[%]"}


def test_rows_of_the_terminal_are_by_order_then_as_methods_are_listed() -> None:
    runs = [run(m, order=n, test=1.0) for n in (10, 9) for m in ("ssest", "n4sid", "nnss")]
    found = [(row["order"], row["method"]) for row in tables.terminal_rows(runs)]
    assert found == [(n, m) for n in ("9", "10") for m in ("nnss", "n4sid", "ssest")]
    assert [(method, order) for method, order, _ in groups(runs)] == [(m, int(n)) for n, m in found]


def test_an_error_of_an_output_is_its_own_or_a_mean() -> None:
    scores = (
        Score("test", "y1", 1.0, 0.5, 0.0), Score("test", "y2", 3.0, 0.25, 0.0), Score("val", "y1", 9.0, 9.0, 0.0),
    )  # fmt: skip
    one = replace(run("nnss", test=1.0), scores=scores)
    assert [output_error(one, "test", name) for name in ("y1", "y2", MEAN, NORMALISED)] == [1.0, 3.0, 2.0, 0.375]
    assert output_error(one, "test", "y3") == output_error(one, "train", "y1") == math.inf
