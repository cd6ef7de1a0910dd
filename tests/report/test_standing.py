"""Methods side by side: the unit is the record, one split a table, failures count, nothing is dropped in silence."""

import math

import numpy as np
import pandas as pd
import pytest
from conftest import slow_but

from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.experiment.store import Store
from nnss_cli.report.build import _overall
from nnss_cli.report.figures import cliques
from nnss_cli.report.standing import combinations, effects, missing_runs, record_table
from nnss_cli.report.statistics import paired_tests

CHANNELS = {"inputs": ["u"], "outputs": ["y"], "input_units": ["V"], "output_units": ["m"]}


def run(dataset: str, method: str, order: int, seed: int, **errors: float) -> RunResult:
    """A run with these errors by split; without any, one that diverged."""
    scores = tuple(Score(split, "y1", 1000 * error, error, 0.0) for split, error in errors.items())
    spec = RunSpec(dataset, "strict", method, order, seed, {}, "0", "1")
    return RunResult(spec, "ok" if scores else "diverged", "" if scores else "why", scores, 1, 1.0, {}, {}, CHANNELS)


def rows(text: str) -> list[dict[str, str]]:
    """The last pipe table of a text as dictionaries."""
    last = [block for block in text.split("\n\n") if block.strip().startswith("|")][-1]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in last.strip().splitlines()]
    return [dict(zip(lines[0], cells, strict=True)) for cells in lines[2:]]


def seeds(dataset: str, method: str, order: int, tests: list[float], lost: int = 0) -> list[RunResult]:
    good = [run(dataset, method, order, seed, val=2 * e, test=e) for seed, e in enumerate(tests)]
    return good + [run(dataset, method, order, len(tests) + seed) for seed in range(lost)]


TEN = [float(v) for v in range(1, 11)]  # median 5.5, interval 2–9 at 97.9 %


def test_a_ratio_is_of_medians_with_the_interval_over_seeds() -> None:
    runs = [
        *seeds("a", "nnss", 3, TEN),
        *seeds("a", "n4sid", 3, [20.0]),
        *seeds("a", "simba", 3, [v / 10 for v in TEN]),
    ]
    (row,) = rows(effects(runs, "test"))
    assert row["/ n4sid"] == "0.275 (0.1–0.45)"
    assert row["/ simba"] == "10 (2.22–45)"
    assert row["what the seeds settle"] == "lower than n4sid; higher than simba"
    assert row["interval holds at"] == "≥ 95 %"
    (row,) = rows(effects(runs, "val"))
    assert row["nnss: RMSE/σ"] == "11"


def test_an_order_at_which_the_method_was_not_run_hides_no_other() -> None:
    runs = [*seeds("a", "ssest", 2, TEN), *seeds("a", "nnss", 3, TEN), *seeds("a", "ssest", 3, TEN)]
    assert [row["order"] for row in rows(effects(runs, "test"))] == ["3"]


def test_few_seeds_settle_nothing() -> None:
    runs = [*seeds("a", "nnss", 3, TEN[:3]), *seeds("a", "n4sid", 3, [20.0])]
    (row,) = rows(effects(runs, "test"))
    assert row["interval holds at"] == "75%"
    assert row["what the seeds settle"] == "not settled: n4sid"
    (row,) = rows(effects([*seeds("a", "nnss", 3, [1.0]), *seeds("a", "n4sid", 3, [20.0])], "test"))
    assert (row["/ n4sid"], row["interval holds at"]) == ("0.05", "–")
    assert row["what the seeds settle"] == "not settled: n4sid"


def test_nine_of_ten_diverged_is_no_victory() -> None:
    """The review's case: rank 1 and "ahead −80 %", from the one seed that was left."""
    runs = [*seeds("a", "nnss", 3, [1.0], lost=9), *seeds("a", "n4sid", 3, [5.0])]
    (row,) = rows(effects(runs, "test"))
    assert row["runs"] == "1/10"
    assert row["nnss: RMSE/σ"] == "∞"
    assert row["/ n4sid"] == "no ratio: 9 of 10 runs of nnss without a result"
    assert row["what the seeds settle"] == ""
    table, left_out = record_table(runs)
    assert list(table.columns) == ["n4sid"]
    assert left_out == ["nnss has no rank: 9 of 10 runs on a without a result"]
    tolerated = [*seeds("a", "nnss", 3, TEN[:8], lost=2), *seeds("a", "n4sid", 3, [5.0])]
    (row,) = rows(effects(tolerated, "test"))
    assert row["/ n4sid"] == "1.1 (0.4–∞)"  # the failed ones are its largest values
    assert row["what the seeds settle"] == "not settled: n4sid"
    assert not record_table(tolerated)[1]


def test_one_split_a_table() -> None:
    """The robot arm's validation stood beside others' test errors."""
    runs = [*seeds("a", "nnss", 3, TEN), *seeds("a", "n4sid", 3, [20.0])]
    without = [run("b", name, 3, 0, train=1.0, val=0.001) for name in ("nnss", "n4sid")]
    assert [row["dataset"] for row in rows(effects(runs + without, "test"))] == ["a"]
    assert [row["dataset"] for row in rows(effects(runs + without, "val"))] == ["a", "b"]
    table, left_out = record_table(runs + without)
    assert list(table.index) == ["a"]
    assert left_out == ["b has no test record under this protocol"]


def test_one_extra_run_drops_nothing_and_what_is_missing_is_named() -> None:
    """One extra `simba` run shrank a ranking from nine blocks to one."""
    runs = [
        r for dataset in "abc" for order in (2, 3, 4) for method in ("nnss", "n4sid", "ssest")
        for r in seeds(dataset, method, order, [1.0 + order])
    ]  # fmt: skip
    extra = [*runs, *seeds("b", "simba", 3, [0.1]), *seeds("a", "nnss", 7, [0.1])]
    table, left_out = record_table(extra)
    assert table.shape == (3, 3)
    pd.testing.assert_frame_equal(table, record_table(runs)[0])
    assert left_out == ["a, order 7: run by nnss alone", "simba has no rank: not run on b, order 2, 4"]
    assert missing_runs(extra) == [
        "a: n4sid was not run at order 7", "a: ssest was not run at order 7", "b: simba was not run at order 2, 4",
    ]  # fmt: skip
    fewer = [*seeds("a", "nnss", 2, TEN), *seeds("a", "simba", 2, TEN[:8])]
    assert missing_runs(fewer) == ["a: simba, order 2, lacks seed 8, 9"]
    assert rows(effects(extra, "test"))[1]["/ simba"] == "not run"


def test_a_dataset_of_failures_is_named() -> None:
    runs = [*seeds("a", "nnss", 2, [1.0]), *seeds("a", "n4sid", 2, [1.0]), *seeds("z", "nnss", 2, [], lost=3)]
    assert "z: no run has a result" in record_table(runs)[1]
    assert "z: no run has a result" in "\n".join(_overall(runs, "strict", Store))  # type: ignore[arg-type]


def test_an_ensemble_is_no_competitor() -> None:
    runs = [*seeds("a", "nnss", 3, TEN), *seeds("a", "n4sid", 3, [20.0]), run("a", "nnss-ensemble", 3, 0, test=0.55)]
    assert "nnss-ensemble" not in effects(runs, "test")
    assert "nnss-ensemble" not in record_table(runs)[0].columns
    (row,) = rows(combinations(runs, "test"))
    assert (row["RMSE/σ"], row["their median"], row["ratio"]) == ("0.55", "5.5", "0.1")


def study(random: np.random.Generator, records: int, orders: int, methods: int) -> list[RunResult]:
    """A null study: no method is better, but each has its luck with a record, shared by its orders."""
    names = ["nnss", "n4sid", "ssest", "ssregest", "simba", "nnss-paper", "another"][:methods]
    return [
        run(f"record{i}", name, order, 0, test=float(np.exp(3 * of_record + luck + 0.1 * random.standard_normal())))
        for i in range(records)
        for of_record in [random.standard_normal()]
        for name in names
        for luck in [random.standard_normal()]
        for order in range(2, 2 + orders)
    ]


@pytest.mark.parametrize(
    ("records", "orders", "methods"),
    slow_but((0, 3, 7), [(3, 3, 6), (3, 3, 7), (5, 2, 2), (6, 3, 2), (7, 3, 7), (9, 3, 6), (20, 3, 7), (20, 1, 3)]),
)
def test_where_nothing_differs_the_report_says_so_in_19_of_20_studies(
    records: int, orders: int, methods: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The review's null simulation: with orders as blocks, some pair "differed" in 27 to 66 % of studies."""
    monkeypatch.setattr("gc.collect", lambda *_: 0)  # statsmodels calls it each time
    random = np.random.default_rng(100 * records + 10 * orders + methods)
    false, studies = 0, 120
    for _ in range(studies):
        table, left_out = record_table(study(random, records, orders, methods))
        assert table.shape == (records, methods)
        assert not left_out
        if records >= 6:
            false += any(found.differ for found in paired_tests(table))
    assert false / studies <= 0.05 + 3 * math.sqrt(0.05 * 0.95 / studies)
    assert records >= 6 or not false


@pytest.mark.parametrize("records", [3, 5])
def test_few_records_are_not_tested(records: int, tmp_path) -> None:
    # even where one method is better on every record and order
    runs = [
        r for i in range(records) for order in (2, 3, 4) for name, e in (("nnss", 1.0), ("n4sid", 9.0), ("ssest", 8.0))
        for r in seeds(f"record{i}", name, order, [e + 0.01 * i + 0.1 * order])
    ]  # fmt: skip
    text = "\n".join(_overall(runs, "strict", tmp_path))
    assert f"{records} records with a test: too few" in text
    assert "differ" not in text.replace("different", "")
    assert "Mean ranks" not in text
    assert not list(tmp_path.iterdir())
    assert "It says nothing about another record" in " ".join(text.split())


def test_enough_records_without_two_methods_in_common_are_not_said_to_be_too_few(tmp_path) -> None:
    runs = [
        r for i in range(7) for name in ("n4sid", "ssest" if i else "nnss")
        for r in seeds(f"record{i}", name, 2, [1.0 + 0.01 * i])
    ]  # fmt: skip
    text = "\n".join(_overall(runs, "strict", tmp_path))
    assert "7 records with a test, but 1 method with results on all of them: there is no ranking" in text
    assert "- ssest has no rank: not run on record0" in text
    assert "too few" not in text
    text = "\n".join(_overall([r for r in runs if r.spec.method != "n4sid"], "strict", tmp_path))
    assert "7 records with a test, but no methods with results on all of them" in text


def test_enough_records_are_ranked_by_record(tmp_path) -> None:
    random = np.random.default_rng(0)
    runs = [
        r for i in range(9) for order in (2, 3) for name, e in (("nnss", 0.0), ("n4sid", 2.0), ("ssest", 2.0))
        for r in seeds(f"record{i}", name, order, [float(np.exp(e + 0.3 * random.standard_normal()))])
    ]  # fmt: skip
    text = "\n".join(_overall(runs, "strict", tmp_path))
    assert "Over 9 records, each counted once" in text
    found = {(row["lower"], row["higher"]): row["at 5 %"] for row in rows(text.partition("\n![")[0])}
    assert {pair: word for pair, word in found.items() if "nnss" in pair} == {
        pair: "differ" for pair in found if "nnss" in pair
    }
    assert len(found) == 3
    assert (tmp_path / "ranks-strict.png").exists()


def test_where_the_correction_leaves_no_chance_it_is_said(tmp_path) -> None:
    random = np.random.default_rng(0)
    text = "\n".join(_overall(study(random, 7, 1, 7), "strict", tmp_path))
    assert "cannot show any difference" in text


def test_a_bar_joins_methods_of_which_no_two_differ() -> None:
    level = [("a", "b"), ("b", "c"), ("c", "d"), ("b", "d")]
    assert cliques("abcd", level) == [(0, 1), (1, 3)]
    assert cliques("abcd", []) == []
    assert cliques("abc", [("a", "b"), ("b", "c"), ("a", "c")]) == [(0, 2)]


def test_the_error_of_a_record_is_the_geometric_mean_over_orders_of_medians() -> None:
    runs = [*seeds("a", "nnss", 2, [1.0, 2.0, 30.0]), *seeds("a", "nnss", 3, [8.0]), *seeds("a", "n4sid", 2, [1.0])]
    runs += seeds("a", "n4sid", 3, [1.0])
    assert record_table(runs)[0].loc["a", "nnss"] == 4.0


def test_equal_errors_are_ties() -> None:
    runs = [run("a", name, 2, 0, test=2.0 + e) for name, e in (("nnss", 1e-9), ("n4sid", 0.0))]
    table, _ = record_table(runs)
    assert table.loc["a", "nnss"] == table.loc["a", "n4sid"]
