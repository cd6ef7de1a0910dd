"""Standing and statistics on both sides of their limits, and what a table says in each case."""

import itertools
import math
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.report import standing
from nnss_cli.report.standing import (
    combinations,
    effects,
    errors_by_record,
    fails_too_often,
    is_seeded,
    missing_runs,
    no_ranking,
    pair_rows,
    ranking,
    record_name,
    record_table,
    unscored,
)
from nnss_cli.report.statistics import (
    Comparison,
    mean_ranks,
    median_interval,
    paired_tests,
    quantile,
    ratio_interval,
    smallest_adjusted,
)

CHANNELS = {"inputs": ["u"], "outputs": ["y"], "input_units": ["V"], "output_units": ["m"]}


def run(method: str, seed: int = 0, order: int = 2, dataset: str = "a", **errors: float) -> RunResult:
    """A run with these RMSE/σ by split; without any, one that diverged. Its names are new objects, as from disk."""
    scores = tuple(Score("".join(list(split)), "y1", 100 * e, e, 0.0) for split, e in errors.items())
    spec = RunSpec("".join(list(dataset)), "own", "".join(list(method)), order, seed, {}, "0", "1")
    return RunResult(spec, "ok" if scores else "diverged", "", scores, 1, 1.0, {}, {}, CHANNELS)


def rows(text: str) -> list[dict[str, str]]:
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.strip().splitlines()]
    return [dict(zip(lines[0], cells, strict=True)) for cells in lines[2:]]


def seeds(method: str, values: list[float], lost: int = 0, **about: Any) -> list[RunResult]:
    good = [run(method, seed, test=value, **about) for seed, value in enumerate(values)]
    return good + [run(method, len(values) + i, **about) for i in range(lost)]


def test_a_table_of_ratios_cell_by_cell() -> None:
    six = [1.0, 2, 3, 4, 5, 6]
    seven = [*six, 7.0]
    (row,) = rows(effects([*seeds("nnss", seven), *seeds("n4sid", [10.0]), *seeds("ssest", [0.5])], "test"))
    assert row == {
        "dataset": "a", "order": "2", "nnss: RMSE/σ": "4", "runs": "7/7", "/ n4sid": "0.4 (0.1–0.7)",
        "/ ssest": "8 (2–14)", "interval holds at": "≥ 95 %",
        "what the seeds settle": "lower than n4sid; higher than ssest",
    }  # fmt: skip
    (row,) = rows(effects([*seeds("nnss", six), *seeds("n4sid", [6.0]), *seeds("ssest", [1.0])], "test"))
    assert row["what the seeds settle"] == "not settled: n4sid, ssest"  # bounds of exactly one
    assert row["interval holds at"] == "≥ 95 %"
    (row,) = rows(effects([*seeds("nnss", six[:5]), *seeds("n4sid", [60.0]), *seeds("simba", [9.0])], "test"))
    assert row["interval holds at"] == "–"  # of simba's one seed nothing is known
    assert (row["/ n4sid"], row["/ simba"]) == ("0.05 (0.0167–0.0833)", "0.333")
    (row,) = rows(effects([*seeds("nnss", six[:5]), *seeds("n4sid", [60.0])], "test"))
    assert (row["interval holds at"], row["what the seeds settle"]) == ("94%", "not settled: n4sid")


def test_ratios_need_the_method_and_a_rival() -> None:
    assert effects(seeds("nnss", [1.0]), "test") == ""
    assert effects(seeds("ssest", [1.0]), "test") == ""
    assert effects([*seeds("nnss", [1.0]), run("nnss-ensemble", test=1.0)], "test") == ""
    assert effects([*seeds("nnss", [1.0]), *seeds("ssest", [1.0])], "val") == ""
    (row,) = rows(effects([*seeds("nnss", [1.0]), *seeds("ssest", [2.0])], "test", method="ssest"))
    assert (row["ssest: RMSE/σ"], row["/ nnss"]) == ("2", "2")


def test_what_failed_too_often_is_named_with_how_often() -> None:
    own, rival = seeds("nnss", [1.0], lost=1), seeds("simba", [1.0, 2.0], lost=3)
    (row,) = rows(effects([*own, *rival], "test"))
    assert row["/ simba"] == (
        "no ratio: 1 of 2 runs of nnss without a result, 3 of 5 runs of simba without a result"
    )  # fmt: skip
    assert (row["interval holds at"], row["runs"], row["what the seeds settle"]) == ("–", "1/2", "")
    (row,) = rows(effects([*seeds("nnss", [1.0]), *rival], "test"))
    assert row["/ simba"] == "no ratio: 3 of 5 runs of simba without a result"


@pytest.mark.parametrize(("lost", "count", "often"), [(0, 1, False), (1, 5, False), (2, 9, True), (2, 10, False),
                                                       (3, 10, True), (1, 1, True)])  # fmt: skip
def test_more_than_a_fifth_is_too_often(lost: int, count: int, often: bool) -> None:
    assert fails_too_often([math.inf] * lost + [1.0] * (count - lost)) is often


def test_combinations_stand_beside_what_they_are_made_of() -> None:
    runs = [*seeds("nnss", [1.0, 2.0, 4.0]), run("nnss-ensemble", test=1.5), run("nnss-ensemble", order=3, test=1.0)]
    first, second = rows(combinations(runs, "test"))
    assert first == {
        "dataset": "a", "order": "2", "method": "nnss-ensemble", "RMSE/σ": "1.5", "made of runs of": "nnss",
        "their median": "2", "ratio": "0.75",
    }  # fmt: skip
    assert (second["order"], second["their median"], second["ratio"]) == ("3", "–", "–")
    assert combinations(seeds("nnss", [1.0]), "test") == ""


def test_errors_are_by_dataset_order_and_test_set() -> None:
    runs = [run("nnss", test_a=1.0, b=2.0), run("nnss", 1), run("ssest", order=3, test_a=3.0, b=4.0),
            run("nnss", dataset="z", test=5.0, val=6.0)]  # fmt: skip
    assert errors_by_record(runs, "test") == {
        ("a", 2, "test_a"): {"nnss": [1.0, math.inf]}, ("a", 3, "test_a"): {"ssest": [3.0]},
        ("a", 2, "b"): {"nnss": [2.0, math.inf]}, ("a", 3, "b"): {"ssest": [4.0]}, ("z", 2, "test"): {"nnss": [5.0]},
    }  # fmt: skip
    assert errors_by_record(runs, "val") == {("z", 2, "val"): {"nnss": [6.0]}}
    names = [record_name("a", split) for split in ("test", "train", "val", "b")]
    assert names == ["a", "a", "a", "a: b"]


def test_datasets_with_nothing_to_compare_are_named() -> None:
    runs = [run("nnss", dataset="a", test=1.0), run("nnss", dataset="b", val=1.0), run("nnss", dataset="c")]
    assert unscored(runs, "test") == ["b has no test record under this protocol", "c: no run has a result"]
    assert unscored(runs, "val") == ["a has no val record under this protocol", "c: no run has a result"]


def test_seeds_are_missed_of_what_has_some() -> None:
    runs = [*seeds("nnss", [1.0] * 3), run("simba", 1, test=1.0), run("ssest", 0, test=1.0), run("mine", 2, test=1.0)]
    assert missing_runs(runs) == ["a: simba, order 2, lacks seed 0, 2", "a: mine, order 2, lacks seed 0, 1"]
    assert (is_seeded("nnss"), is_seeded("ssest"), is_seeded("mine")) == (True, False, True)


def test_orders_that_less_than_half_ran_are_left_out_of_ranks() -> None:
    half = [run(m, order=2, test=4.0) for m in ("nnss", "n4sid", "ssest", "simba")]
    half += [run(m, order=3, test=1.0) for m in ("nnss", "n4sid")]  # two of four: used
    table, left_out = record_table(half)
    assert table.to_dict("index") == {"a": {"nnss": 2.0, "n4sid": 2.0}}
    assert left_out == ["simba has no rank: not run on a, order 3", "ssest has no rank: not run on a, order 3"]
    table, left_out = record_table(half[:-1])  # one of four
    assert table.to_dict("index") == {"a": dict.fromkeys(("nnss", "simba", "n4sid", "ssest"), 4.0)}
    assert list(table.columns) == ["nnss", "simba", "n4sid", "ssest"]
    assert left_out == ["a, order 3: run by nnss alone"]


def test_three_of_seven_methods_are_less_than_half() -> None:
    names = ["nnss", "n4sid", "ssest", "simba", "ssregest", "mine", "theirs"]
    runs = [run(m, order=2, test=4.0) for m in names] + [run(m, order=3, test=1.0) for m in names[:3]]
    table, left_out = record_table(runs)
    assert set(table.loc["a"]) == {4.0}
    assert left_out == ["a, order 3: run by n4sid, nnss, ssest alone"]


def test_a_method_without_a_record_has_no_rank_and_one_of_several_sets_counts_once() -> None:
    runs = [
        run("nnss", test_a=1.0, test_b=3.0),
        run("n4sid", test_a=5.0, test_b=7.0),
        run("nnss", dataset="b", test=1.0),
    ]
    table, left_out = record_table(runs)
    assert table.to_dict("index") == {"a": {"nnss": 2.0}, "b": {"nnss": 1.0}}
    assert left_out == ["n4sid has no rank: not run on b"]
    table, left_out = record_table([run("nnss", val=1.0)])
    assert (len(table), left_out) == (0, ["a has no test record under this protocol"])


@pytest.mark.parametrize(("close", "tie"), [(1.000001, True), (1.0001, False)])
def test_errors_of_the_same_five_digits_are_a_tie(close: float, tie: bool) -> None:
    (row,) = record_table([run("nnss", test=1.0), run("n4sid", test=close)])[0].to_dict("records")
    assert (row["nnss"] == row["n4sid"]) is tie


def comparison(adjusted: float) -> Comparison:
    return Comparison("a", "b", 4, 6, 0.01234, adjusted)


def test_pairs_are_told_with_whether_they_differ() -> None:
    first, second = pair_rows([comparison(0.05), comparison(0.0501)])
    assert first == {
        "lower": "a", "higher": "b", "lower on": "4 of 6 records", "p (Wilcoxon)": "0.012", "p (Holm)": "0.05",
        "at 5 %": "differ",
    }  # fmt: skip
    assert second["at 5 %"] == "not shown to differ"


def test_a_ranking_says_where_no_difference_can_be_shown() -> None:
    def told(records: int, methods: int) -> str:
        columns = {name: np.arange(1.0, records + 1) + i for i, name in enumerate("abc"[:methods])}
        return ranking(pd.DataFrame(columns), [comparison(0.05)])

    text = told(6, 2)
    assert text.startswith("Over 6 records, each counted once (test;")
    assert "Mean ranks (1 is best): a 1.00, b 2.00." in text
    assert "cannot show" not in text  # the smallest p is 0.03
    assert "So few records for 3 methods cannot show any difference: the smallest p" in told(6, 3)
    assert "could give is 0.094." in told(6, 3)
    assert "lower on" in text.partition("\n\n")[2]


def test_too_few_records_are_counted() -> None:
    assert [no_ranking(n, 2).partition(" with")[0] for n in (0, 1, 5)] == ["0 records", "1 record", "5 records"]
    assert "(at least 6)" in no_ranking(1, 2)


def test_the_meaning_names_the_share_of_failures_that_is_tolerated() -> None:
    assert "fails on more than 20 % of its runs" in standing.MEANING


# statistics


@pytest.mark.parametrize(("n", "k"), [(1, 1), (5, 1), (6, 1), (8, 1), (9, 2), (11, 2), (12, 3), (14, 3), (15, 4)])
def test_order_statistics_of_the_interval_of_a_median(n: int, k: int) -> None:
    # the table in Conover, Practical Nonparametric Statistics, for 95 %: the ranks change at 6, 9, 12, 15
    bounds = median_interval(range(1, n + 1))
    assert (bounds.low, bounds.high) == (k, n + 1 - k)


def test_an_interval_of_a_lower_level_is_narrower() -> None:
    assert (median_interval(range(10), 0.5).low, median_interval(range(10), 0.5).high) == (3, 6)
    # exactly as much as is asked for will do: 1 − 2 · 11/1024
    level = 1 - 22 / 1024
    assert median_interval(range(10), level).low == 1
    assert median_interval(range(10), level + 1e-9).low == 0


def test_a_ratios_interval_is_of_both_medians_at_half_the_error_each() -> None:
    a, b = list(range(1, 11)), [10.0 * v for v in range(1, 11)]
    # at 97.5 % ten seeds give x(2)–x(9) (97.9 %), so that two hold at 95.7 %
    bounds = ratio_interval(a, b, (False, False))
    assert (bounds.low, bounds.high) == (2 / 90, 9 / 20)
    assert bounds.coverage == pytest.approx(1 - 4 * 11 / 1024)
    # nine seeds: x(2)–x(8) holds at 96.1 %, enough beside what is known exactly, not beside another interval
    one = ratio_interval(a[:9], [2.0], (False, True))
    assert (one.low, one.high, one.coverage) == (1.0, 4.0, pytest.approx(1 - 20 / 512))
    both = ratio_interval(a[:9], a[:9], (False, False))
    assert (both.low, both.high) == (1 / 9, 9.0)
    other = ratio_interval([2.0], a[:9], (True, False))
    assert (other.low, other.high) == (2 / 8, 1.0)
    known = ratio_interval([3.0], [2.0], (True, True))
    assert (known.low, known.high, known.coverage) == (1.5, 1.5, 1.0)
    assert ratio_interval([1.0], [2.0], (False, False)).coverage == 0.0


@pytest.mark.parametrize(
    ("values", "q", "found"),
    [
        ([1.0, 2.0, math.inf], 0.25, 1.5), ([1.0, 3.0, math.inf, math.inf, math.inf], 0.25, 3.0),
        ([math.inf, 4.0, 2.0, 1.0], 0.25, 1.75), ([1.0, 2.0, math.inf], 0.51, math.inf), ([math.inf], 0.0, math.inf),
        ([1.0, math.inf], 0.0, 1.0), ([1.0, math.inf], 1.0, math.inf), ([4.0, 8.0, math.inf], 0.125, 5.0),
    ],
)  # fmt: skip
def test_a_quantile_between_finite_values_is_finite(values: list[float], q: float, found: float) -> None:
    assert quantile(values, q) == found


def test_the_smallest_p_is_of_all_signs_alike_times_the_pairs() -> None:
    assert smallest_adjusted(6, 2) == 2 / 64
    assert smallest_adjusted(6, 3) == 3 * 2 / 64
    assert smallest_adjusted(3, 4) == 1.0


def test_ties_count_in_ranks_by_half_and_not_in_pairs() -> None:
    table = pd.DataFrame({"a": [1.0] * 6, "b": [1.0] * 6, "c": [2.0, 2, 2, 2, 2, 1]})
    ranks = mean_ranks(table)
    assert ranks["a"] == ranks["b"] == pytest.approx((5 * 1.5 + 2) / 6)
    assert ranks["c"] == pytest.approx((5 * 3 + 2) / 6)
    found = {(t.first, t.second): t for t in paired_tests(table)}
    same = found["a", "b"]
    assert (same.wins, same.pairs, same.p, same.adjusted) == (0, 0, 1.0, 1.0)
    other = found["a", "c"]
    assert (other.wins, other.pairs, other.p) == (5, 5, pytest.approx(2 / 32))
    assert other.adjusted == pytest.approx(3 * 2 / 32)
    assert list(found) == list(itertools.combinations(ranks.index, 2))


def test_a_single_win_is_counted_for_the_first() -> None:
    table = pd.DataFrame({"a": [1.0, 1, 1, 1, 1, 3], "b": [2.0, 2.1, 2.2, 2.3, 2.4, 2.9]})
    (found,) = paired_tests(table)
    assert (found.first, found.second, found.wins, found.pairs) == ("a", "b", 5, 6)
    assert found.p == pytest.approx(4 / 64)
