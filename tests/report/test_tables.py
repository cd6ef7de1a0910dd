"""Tables cell by cell, from runs made by hand."""

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.record import Channels
from nnss_cli.datasets.units import titled

from nnss_cli.experiment.ablation import Variant
from nnss_cli.experiment.order import OrderRow
from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.experiment.tune import Trial
from nnss_cli.report import aggregate, tables
from nnss_cli.report.aggregate import (
    best_by_method,
    best_run,
    long_table,
    methods_of,
    physical_error,
    runs_by_method,
    scored_splits,
    shown_error,
    split_error,
    split_name,
    splits_of,
    summary,
    validation_error,
)
from nnss_cli.report.comparison import _boxplot, record_lengths, starts, transient
from nnss_cli.report.evidence import intervals, optimism_rows
from nnss_cli.report.figures import plt
from nnss_cli.report.listing import group_rows, run_rows
from nnss_cli.report.simulation import draw_simulated, error_rows
from nnss_cli.report.statistics import quartile_interval, ratio, verdict
from nnss_cli.report.tables import error_tables, markdown, options_apart, rmse_markdown
from nnss_cli.testing import small_dataset

ONE = {"inputs": ["u"], "outputs": ["level"], "input_units": ["V"], "output_units": ["m"]}
TWO = {"inputs": ["u"], "outputs": ["level", "flow"], "input_units": ["V"], "output_units": ["m", "–"]}


def run(method: str = "nnss", order: int = 2, seed: int = 0, channels: Any = ONE, **errors: Any) -> RunResult:
    """A run with these errors (RMSE/σ; σ is 10, then 20) by split; without any, one that diverged."""
    scores = tuple(
        Score(split, f"y{i + 1}", 10.0 * (i + 1) * error, error, 100 * (1 - error))
        for split, values in errors.items()
        for i, error in enumerate(np.atleast_1d(values).tolist())
    )
    spec = RunSpec("tank", "strict", method, order, seed, {}, "0", "1")
    status = "ok" if scores else "diverged"
    return RunResult(spec, status, "" if scores else "why", scores, 7, 1.5, {}, {}, channels)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"), (math.nan, "–"), (math.inf, "∞"), (0.0, "0"), (1e-4, "0.0001"), (0.99e-4, "9.9e-05"),
        (0.000123456, "0.0001235"), (123456.0, "123500"), (999_999.0, "1000000"), (1e6, "1e+06"), (2.5e7, "2.5e+07"),
        (-0.5, "-0.5"), (-1.23456, "-1.235"), (3.0, "3"), (12.5, "12.5"),
    ],
)  # fmt: skip
def test_a_number_has_four_digits_and_no_exponent_from_a_ten_thousandth_to_a_million(value: Any, text: str) -> None:
    assert tables.number(value) == text


def test_a_number_has_the_digits_asked_for() -> None:
    assert [tables.number(math.pi, digits) for digits in (1, 2, 3, 6)] == ["3", "3.1", "3.14", "3.14159"]
    assert tables.number(1.23456e-7, 2) == "1.2e-07"


RUNS = [
    run(seed=0, train=0.1, val=0.2, test=0.4), run(seed=1, train=0.3, val=0.1, test=0.6), run(seed=2),
    run("n4sid", 2, 0, train=0.5, val=0.5, test=0.5), run("nnss", 3, 0, train=0.05, val=0.06, test=0.07),
]  # fmt: skip


def test_the_terminals_table_cell_by_cell() -> None:
    assert tables.terminal_rows(RUNS) == [
        {"order": "2", "method": "nnss", "runs": "2/3", "train": "3", "val": "2", "test": "6", "fit": "40.0",
         "q1–q3": "5–∞", "best": "6"},
        {"order": "2", "method": "n4sid", "runs": "1/1", "train": "5", "val": "5", "test": "5", "fit": "50.0",
         "q1–q3": "–", "best": "5"},
        {"order": "3", "method": "nnss", "runs": "1/1", "train": "0.5", "val": "0.6", "test": "0.7", "fit": "93.0",
         "q1–q3": "–", "best": "0.7"},
    ]  # fmt: skip
    assert tables.terminal_title(RUNS) == (
        "tank, protocol strict: RMSE of level [m], test; median over seeds, q1–q3, best (the seed chosen on validation)"
    )
    several = [run(channels=TWO, train=[0.1, 0.3], val=[0.2, 0.4], test_a=[0.5, 0.7], test_b=[0.1, 0.1])]
    mean = {"order": "2", "method": "nnss", "runs": "1/1", "train": "0.2", "val": "0.3", "q1–q3": "–"}
    first = mean | {"test": "0.6", "fit": "40.0", "best": "0.6"}
    assert tables.terminal_rows(several) == tables.terminal_rows(several, split="test_a") == [first]
    assert tables.terminal_rows(several, split="test_b") == [mean | {"test": "0.1", "fit": "90.0", "best": "0.1"}]
    flow = mean | {"train": "6", "val": "8", "test": "14", "fit": "30.0", "best": "14"}
    assert tables.terminal_rows(several, output="y2") == [flow]
    assert tables.terminal_title(several, "test_b").startswith(
        "tank, protocol strict: mean over outputs of RMSE/σ, test_b; "
    )
    shown = [(table.about["split"], table.about["output"], table.rows[0]["test"]) for table in error_tables(several)]
    assert shown == [
        ("test_a", "mean of RMSE/σ", "0.6"), ("test_a", "level [m]", "5"), ("test_a", "flow", "14"),
        ("test_b", "mean of RMSE/σ", "0.1"), ("test_b", "level [m]", "1"), ("test_b", "flow", "2"),
    ]  # fmt: skip
    assert tables.terminal_rows([run()])[0] == {
        "order": "2", "method": "nnss", "runs": "0/1", "train": "–", "val": "–", "test": "–", "fit": "–", "q1–q3": "–",
        "best": "–",
    }  # fmt: skip
    without_test = [run(train=0.1, val=0.2)]
    (row,) = tables.terminal_rows(without_test)
    assert (row["test"], row["fit"], row["best"]) == ("–", "80.0", "2")
    assert ": RMSE of level [m], validation; " in tables.terminal_title(without_test)


def test_the_summary_over_seeds_cell_by_cell() -> None:
    rows = tables.rows_of_split(summary(RUNS), "test", methods_of(RUNS), tables.outputs_of(RUNS))
    assert rows[0] == {
        "order": "2", "method": "nnss", "output": "level [m]", "runs": "2/3", "mean": "–", "median": "6",
        "fit [%]": "40.0", "best by validation": "6 (seed 1)", "spread (q1–q3)": "5–∞", "min–max": "4–∞",
    }  # fmt: skip
    assert rows[1] == {
        "order": "2", "method": "n4sid", "output": "level [m]", "runs": "1/1", "mean": "5", "median": "5",
        "fit [%]": "50.0", "best by validation": "5", "spread (q1–q3)": "–", "min–max": "–",
    }  # fmt: skip
    assert [row["order"] for row in rows] == ["2", "2", "3"]
    assert tables.rows_of_split(summary([run()]), "test", ["nnss"], {}) == []
    two = [run(seed=seed, channels=TWO, val=[0.1, 0.1], test=[0.1 * (seed + 1), 0.3]) for seed in range(3)]
    found = tables.rows_of_split(summary(two), "test", ["nnss"], tables.outputs_of(two))
    assert [(row["output"], row["median"], row["fit [%]"]) for row in found] == [
        ("level [m]", "2", "80.0"), ("flow", "6", "70.0"), ("mean of RMSE/σ", "0.25", "75.0"),
    ]  # fmt: skip
    assert (found[0]["mean"], found[0]["min–max"]) == ("2", "1–3")


@pytest.mark.parametrize(
    ("units", "dataset", "protocol", "name"),
    [
        (["m", "m"], "tank", "own", "mean over outputs [m]"), (["m", "K"], "tank", "own", ""),
        (["–", "–"], "tank", "own", ""), (["m", "K"], "daisy-powerplant", "strict", ""),
        (["m", "K"], "daisy-powerplant", "paper", "mean over outputs, units mixed"),
        (["m"], "daisy-powerplant", "paper", ""),
    ],
)  # fmt: skip
def test_a_mean_in_physical_units_is_of_one_unit_or_compared_with_such(
    units: list[str], dataset: str, protocol: str, name: str
) -> None:
    one = run(channels=TWO, val=[0.1, 0.3], test=[0.1, 0.3])
    outputs = ["level", "flow"][: len(units)]
    scores = tuple(score for score in one.scores if int(score.output[1:]) <= len(units))
    spec = replace(one.spec, dataset=dataset, protocol=protocol)
    one = replace(one, spec=spec, scores=scores, channels=TWO | {"outputs": outputs, "output_units": units})
    assert aggregate.mean_name([one]) == name
    text = tables.rmse_markdown([one])
    body = text[text.index("## Test") :].splitlines()[4:]
    own = [titled(*pair) for pair in zip(outputs, units, strict=True)]
    means = [*filter(None, [name]), "mean of RMSE/σ"] if len(units) > 1 else []
    assert [line.split("|")[3].strip() for line in body if line] == own + means
    assert ("mixes units" in text) == name.endswith("units mixed")
    assert (aggregate.MEAN in set(summary([one])["output"])) == bool(name)


def test_a_pipe_in_a_name_is_none_of_the_table() -> None:
    text = tables.rmse_markdown([run(channels=ONE | {"outputs": ["a|b"]}, test=0.1)])
    assert "| a\\|b [m] |" in text


def test_errors_of_a_run_in_each_of_the_ways_that_choices_are_made_by() -> None:
    one = run(channels=TWO, val=[0.2, 0.4], a=[0.5, 0.7], b=[0.1, 0.3])
    assert split_error(one, "a") == pytest.approx(0.6)
    assert validation_error(one) == pytest.approx(0.3)
    assert aggregate.test_error(one) == pytest.approx(0.4)
    assert physical_error(one, "val") == pytest.approx((2 + 8) / 2)
    assert shown_error(one, "val") == pytest.approx(0.3)
    assert shown_error(run(val=0.2), "val") == 2.0
    assert all(
        math.isinf(found)
        for found in (split_error(one, "x"), physical_error(one, "x"), aggregate.test_error(run(val=1.0)))
    )
    assert (splits_of([one]), aggregate.test_sets([one]), scored_splits([one])) == (
        ["val", "a", "b"],
        ["a", "b"],
        ["a", "b"],
    )
    assert scored_splits([run(val=1.0)]) == ["val"]
    shuffled = [run(test=1.0, val=1.0), run(b=1.0, train=1.0)]
    assert splits_of(shuffled) == ["train", "val", "test", "b"]
    assert [split_name(name) for name in ("train", "val", "test", "b")] == ["train", "validation", "test", "test b"]


def test_runs_are_grouped_by_order_then_method_and_the_best_is_the_lowest_on_validation() -> None:
    assert list(runs_by_method(RUNS)) == [("n4sid", 2), ("nnss", 2), ("nnss", 3)]
    assert [r.spec.seed for r in runs_by_method(RUNS)["nnss", 2]] == [0, 1, 2]
    assert best_run(RUNS[:3]) is RUNS[1]
    assert best_run([run()]) is None
    assert best_by_method([*RUNS, run("simba")]) == {"nnss": RUNS[4], "n4sid": RUNS[3]}
    strangers = [run(name, val=1.0) for name in ("zeta", "simba", "alpha", "nnss")]
    assert methods_of(strangers) == ["nnss", "simba", "alpha", "zeta"]
    table = long_table(RUNS[:1])
    row = dict(table.iloc[2])
    assert (row["epochs"], row["fit_seconds"], row["rmse"], row["nrmse"]) == (7, 1.5, 4.0, 0.4)
    assert (row["fit_percent"], row["order"], row["split"]) == (pytest.approx(60), 2, "test")


def test_remarks_and_failures_say_whose_they_are() -> None:
    assert tables.failures(RUNS) == ["nnss, order 2, seed 2: diverged: why"]
    told = [replace(RUNS[i], remarks=("a", "b") if i == 0 else ("a",)) for i in (0, 1, 3)]
    assert tables.remarks(told) == [
        "n4sid, order 2: a",
        "nnss, order 2, seeds 0, 1: a",
        "nnss, order 2, seed 0: b",
    ]


def test_runs_of_other_data_are_named() -> None:
    other = [replace(r, spec=replace(r.spec, data="1")) for r in RUNS[1:2]]
    (line,) = tables.versions_apart([RUNS[0], *other])
    assert line == "Made with different versions of the data, so not to be compared with the others: nnss, order 2."
    apart = [
        replace(RUNS[0], provenance={"cpu": "a", "numpy": "1"}),
        replace(RUNS[1], provenance={"cpu": "b", "numpy": "1"}),
    ]
    assert tables.versions_apart(apart) == ["Made on different machines, by cpu: a (1 runs), b (1 runs)."]


def test_scores_of_one_run_have_names_units_and_digits() -> None:
    (first, second) = tables.score_rows(run(channels=TWO, test=[0.123456, 0.25]))
    assert first == {"split": "test", "output": "level [m]", "RMSE": "1.235", "RMSE/σ": "0.1235", "fit [%]": "87.7"}
    assert second == {"split": "test", "output": "flow", "RMSE": "5", "RMSE/σ": "0.25", "fit [%]": "75.0"}


def test_orders_and_trials_are_tabled() -> None:
    assert tables.order_rows([OrderRow(1, 1.0, 0.5, 0.61234), OrderRow(2, 0.0123456, None, None)], 1) == [
        {"order": "1 ←", "Hankel σn/σ1": "1.00e+00", "train": "0.5", "validation": "0.6123"},
        {"order": "2", "Hankel σn/σ1": "1.23e-02", "train": "–", "validation": "–"},
    ]
    settings = {"hidden": (40, 20), "consistency": 0.01234, "learning_rate": 0.000876, "window": 79, "batch": None}
    assert tables.trial_rows([Trial(3, "complete", 0.123456, settings)]) == [
        {"trial": "3", "state": "complete", "val": "0.123", "hidden": "40 20", "encoder": "–", "λ": "0.012",
         "rate": "0.00088", "window": "79", "batch": "–"}
    ]  # fmt: skip


def test_a_study_compares_medians_and_counts_what_runs_away() -> None:
    plain = Variant("plain", tuple(RUNS[:3]), None)
    other = Variant("other", (RUNS[4], run(order=2)), None)
    assert tables.study_rows([plain, other]) == [
        {"order": "2", "variant": "plain", "runs": "2/3", "train": "3", "val": "2", "test": "6"},
        {"order": "2", "variant": "other", "runs": "0/1", "train": "–", "val": "–", "test": "–"},
        {"order": "3", "variant": "plain", "runs": "–", "train": "–", "val": "–", "test": "–"},
        {"order": "3", "variant": "other", "runs": "1/1", "train": "0.5", "val": "0.6", "test": "0.7"},
    ]
    assert tables.study_rows([plain], intervals=True)[0]["train"] == "3 (1–∞)"
    assert tables.study_rows([other], intervals=True)[1]["train"] == "0.5"
    stressed = [replace(plain, unbounded=(RUNS[0],)), other]
    assert [row["unbounded under stress"] for row in tables.study_rows(stressed)][:2] == ["1 of 2", "0 of 0"]


def test_intervals_and_optimism_are_by_hand() -> None:
    seeds = [run(seed=seed, val=1.0 - 0.1 * seed, test=0.1 * (seed + 1)) for seed in range(3)]
    (line,) = intervals(seeds).splitlines()[2:]
    assert [cell.strip() for cell in line.split("|")[1:-1]] == ["2", "nnss", "3/3", "test", "2", "1–3", "75.0%"]
    (line,) = markdown(optimism_rows(seeds)).splitlines()[2:]
    assert [cell.strip() for cell in line.split("|")[1:-1]] == ["2", "nnss", "3/3", "0.3", "0.1", "67 %"]
    assert markdown(optimism_rows(seeds[:1])) == intervals(seeds[:1]) == ""
    assert markdown(optimism_rows([run(seed=seed, val=0.1) for seed in range(2)])) == ""


@pytest.mark.parametrize(
    ("ours", "theirs", "unit", "word"),
    [
        (1.0999, 1.0, 0.0, "reproduced"), (1.11, 1.0, 0.0, "worse"), (0.9001, 1.0, 0.0, "reproduced"),
        (0.89, 1.0, 0.0, "better"), (0.0149, 0.01, 0.01, "reproduced"), (0.0151, 0.01, 0.01, "worse"),
    ],
)  # fmt: skip
def test_reproduced_is_within_a_tenth_or_half_a_printed_unit(
    ours: float, theirs: float, unit: float, word: str
) -> None:
    assert verdict(ours, theirs, unit) == word


@pytest.mark.parametrize(
    ("first", "second", "found"),
    [([0.0], [0.0], 1.0), ([2.0], [0.0], math.inf), ([0.0], [2.0], 0.0), ([1.0], [math.inf], 0.0), ([3.0], [2.0], 1.5),
     ([math.inf], [1.0], math.inf), ([math.inf], [math.inf], math.nan)],
)  # fmt: skip
def test_a_ratio_of_nothing_and_of_failures_is_said(first: list[float], second: list[float], found: float) -> None:
    assert ratio(first, second) == pytest.approx(found, nan_ok=True)


def test_a_notch_is_157_hundredths_of_the_quartiles_distance_over_the_root() -> None:
    assert quartile_interval(10.0, 8.0, 12.0, 4) == pytest.approx((10 - 3.14, 10 + 3.14))


def test_a_long_records_zoom_is_a_twelfth_of_it_and_sixty_samples_at_least() -> None:
    def zoom(K: int, at: int) -> slice | None:
        y = np.zeros((K, 2))
        y[at:, 1] = 1e-6  # a small output's step counts as much as a large one's
        y[:, 0] = 1e3 * np.sin(np.arange(K) / K)
        return transient(y)

    assert zoom(199, 100) is None
    assert (found := zoom(200, 100)) is not None
    assert found.stop - found.start == 60
    assert (found := zoom(1200, 700)) is not None
    assert found.stop - found.start == 100
    assert found.start < 700 < found.stop
    lengths = record_lengths({"val/0/y": np.zeros((3, 1)), "val/1/y": np.zeros((5, 1)), "val/1/x": np.zeros(1)}, "val")
    assert (lengths, starts([3, 5, 2]), starts([4])) == ([3, 5], [3, 8], [])


@pytest.mark.parametrize(
    ("runs", "title", "panels"),
    [
        ([run(train=0.1, val=0.2)], "tank (protocol strict): validation\nRMSE of level over 1 seed",
         [("", "RMSE [m]")]),
        ([run(seed=s, val=0.2, test=0.3) for s in range(2)], "tank (protocol strict): test RMSE of level over 2 seeds",
         [("", "RMSE [m]")]),
        ([run(val=0.2, test=0.3), run(seed=1)],
         "tank (protocol strict): test RMSE of level over 2 seeds\nnot drawn, without a result: 1 of 2 NN-SS, n = 2",
         [("", "RMSE [m]")]),
        ([run(channels=TWO, val=[0.1, 0.1], a=[0.2, 0.3], b=[0.4, 0.5])],
         "tank (protocol strict): test RMSE over 1 seed",
         [("test a, level", "RMSE [m]"), ("test a, flow", "RMSE"), ("test b, level", "RMSE [m]"),
          ("test b, flow", "RMSE")]),
        ([run(channels=TWO, val=[0.1, 0.1], test=[0.2, 0.3])], "tank (protocol strict): test RMSE over 1 seed",
         [("level", "RMSE [m]"), ("flow", "RMSE")]),
    ],
)  # fmt: skip
def test_a_box_plot_says_whose_errors_it_shows(
    runs: list[RunResult], title: str, panels: list[tuple[str, str]]
) -> None:
    figure = _boxplot(runs)
    assert figure is not None
    assert figure.get_suptitle() == title
    assert [(axis.get_title(), axis.get_ylabel()) for axis in figure.axes] == panels
    plt.close(figure)
    assert _boxplot([run()]) is None


# what has been kept


def entry(result: RunResult | None, label: str = "", fault: str = "") -> Any:
    return SimpleNamespace(store=SimpleNamespace(dataset="tank", protocol="strict"), result=result, label=label,
                           fault=fault, folder="runs/x")  # fmt: skip


def test_what_is_kept_is_listed_by_method_and_order() -> None:
    rows = group_rows([*map(entry, RUNS), entry(None, "nnss-n2-s9", "no run.json")])
    assert rows == [
        {"dataset": "tank", "protocol": "strict", "method": "n4sid", "n": "2", "ok": "1/1", "else": "–", "test": "5"},
        {"dataset": "tank", "protocol": "strict", "method": "nnss", "n": "2", "ok": "2/3", "else": "1 diverged",
         "test": "6"},
        {"dataset": "tank", "protocol": "strict", "method": "nnss", "n": "3", "ok": "1/1", "else": "–", "test": "0.7"},
        {"dataset": "tank", "protocol": "strict", "method": "nnss-n2-s9", "n": "–", "ok": "0/1", "else": "1 damaged",
         "test": "–"},
    ]  # fmt: skip
    told = {row[""]: row["found"] for row in run_rows(entry(replace(RUNS[0], provenance={"numpy": "2"}, notes=("n",))))}
    assert told == {
        "status": "ok", "fit [s]": "1.5", "epochs": "7", "data": "0", "method's version": "1", "numpy": "2",
        "notes": "n", "folder": "runs/x",
    }  # fmt: skip
    assert run_rows(entry(None, fault="no run.json")) == [
        {"": "status", "found": "damaged"},
        {"": "reason", "found": "no run.json"},
    ]


# a simulated file


def test_errors_of_a_simulated_file_have_their_outputs_name() -> None:
    channels = small_dataset().fitting.channels
    rows = error_rows([Score("test", f"y{i + 1}", 1.23456, 0.5, 50.04) for i in range(len(channels.outputs))], channels)
    names = [titled(*pair) for pair in zip(channels.outputs, channels.output_units, strict=True)]
    assert rows == [{"output": name, "RMSE": "1.235", "RMSE/σ": "0.5", "fit [%]": "50.0"} for name in names]
    assert (titled("y", "m"), titled("y", "–"), titled("y", "")) == ("y [m]", "y", "y")


def test_a_simulated_file_is_drawn_over_what_was_measured_with_its_inputs_below() -> None:
    channels = Channels(("a", "b"), ("x", "y"), ("V", "–"), ("m", "K"))
    time, u, y = np.arange(4) / 2, np.arange(8.0).reshape(4, 2), np.arange(8.0).reshape(4, 2) + 10
    true = y + np.arange(1.0, 5.0)[:, None]
    figure = draw_simulated(time, u, y, true, channels, "the model", "predicted", (y - 2, y + 2, "90 %"))
    assert [axis.get_ylabel() for axis in figure.axes] == [
        "x [m]", "residual\n[m]", "y [K]", "residual\n[K]", "a [V]", "b",
    ]  # fmt: skip
    assert [axis.get_xlabel() for axis in figure.axes] == [""] * 5 + ["time [s]"]
    for i in range(2):
        output, residual = figure.axes[2 * i : 2 * i + 2]
        measured, drawn = output.lines
        assert measured.get_ydata().tolist() == true[:, i].tolist()
        assert drawn.get_ydata().tolist() == y[:, i].tolist()
        (band,) = output.collections
        assert band.get_linewidth()[0] > 0.5  # its limits are lines, seen in grey and where it is narrow, too
        box = band.get_paths()[0].get_extents()
        assert (box.y0, box.y1) == (y[0, i] - 2, y[-1, i] + 2)
        error, zero = residual.lines
        assert error.get_xdata().tolist() == time.tolist()
        assert error.get_ydata().tolist() == (true - y)[:, i].tolist() == [1.0, 2.0, 3.0, 4.0]
        assert list(zero.get_ydata()) == [0, 0]
        (around,) = residual.collections
        box = around.get_paths()[0].get_extents()
        assert (box.y0, box.y1) == (-2, 2)
        (held,) = figure.axes[4 + i].lines
        assert held.get_ydata().tolist() == u[:, i].tolist()
        assert held.get_drawstyle() == "steps-post"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["measured", "predicted", "90 %"]
    plt.close(figure)
    alone = draw_simulated(time, u, y, None, channels, "the model")
    assert [text.get_text() for text in alone.legends[0].get_texts()] == ["simulated"]
    assert [axis.get_ylabel() for axis in alone.axes] == ["x [m]", "y [K]", "a [V]", "b"]
    assert len(alone.axes[0].lines) == 1
    plt.close(alone)


def test_quartiles_have_three_digits_and_fit_its_column(result: Callable) -> None:
    runs = [result("nnss", seed, error=error) for seed, error in enumerate((251.34, 333.3, 412.7))]
    (table,) = error_tables(runs)
    assert (table.rows[0]["q1–q3"], table.rows[0]["fit"]) == ("292–373", "-233.3")
    assert table.heads["test"] == "test\n[m]"
    assert "RMSE of level [m], test" in table.title
    assert "fit [%]" in rmse_markdown(runs)
    assert "s is the output's standard deviation within the split itself" in rmse_markdown(runs)


def test_outputs_stand_apart_by_their_names(result: Callable) -> None:
    channels = {"inputs": ["u"], "outputs": ["hot", "cold"], "input_units": ["V"], "output_units": ["K", "–"]}
    scores = tuple(Score(s, f"y{i}", float(i), i / 10, 0.0) for s in ("train", "val", "test") for i in (1, 2))
    run = replace(result("nnss", 0), channels=channels, scores=scores)
    tables = error_tables([run])
    assert [table.about["output"] for table in tables] == ["mean of RMSE/σ", "hot [K]", "cold"]
    assert [table.rows[0]["test"] for table in tables] == ["0.15", "1", "2"]
    assert "mean over outputs of RMSE/σ" in tables[0].title
    assert "RMSE of hot [K], test" in tables[1].title
    assert tables[1].heads["test"] == "test\n[K]"
    assert "test" not in tables[2].heads


def test_a_table_says_when_a_method_has_other_options_at_other_orders(result: Callable) -> None:
    runs = [result("nnss", 0, order, settings={"hidden": [order * 10], "epochs": 7}) for order in (2, 3, 4)]
    runs[2] = result("nnss", 0, 4, settings={"hidden": [20], "epochs": 7})
    (line,) = options_apart(runs)
    assert line == "nnss has other options at different orders: hidden 20 at order 2, 4; 30 at order 3."
    assert f"Note: {line}" in rmse_markdown(runs)
    assert options_apart([runs[0], runs[2], result("ssest", 0, settings={"epochs": 8})]) == []
