"""Tables from runs: choices on validation, failures as rows, files rebuilt bit by bit."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from nnss_cli.datasets.catalog import BENCHMARKS

from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.experiment.store import Store
from nnss_cli.methods import METHODS
from nnss_cli.report.aggregate import COLUMNS, best_run, long_table, released_table, summary
from nnss_cli.report.build import write_report
from nnss_cli.report.comparison import _boxplot, joined, record_lengths, transient, write_comparison
from nnss_cli.report.evidence import intervals, not_the_papers, optimism_rows, paper_rows, released_rows
from nnss_cli.report.figures import plt
from nnss_cli.report.tables import markdown, rmse_markdown, terminal_rows, terminal_title

CHANNELS = {"inputs": ["u"], "outputs": ["level"], "input_units": ["V"], "output_units": ["m"]}
PROVENANCE = dict.fromkeys(("nnss", "python", "numpy", "scipy", "torch", "machine"), "0")


def result(method: str, seed: int, val: float, test: float, order: int = 3, status: str = "ok") -> RunResult:
    scores = tuple(
        Score(split, output, value, value, 0.0)
        for split, value in (("train", 1.0), ("val", val), ("test", test))
        for output in ("y1",)
    )
    spec = RunSpec("twotank", "paper", method, order, seed, {}, "0")
    return RunResult(
        spec, status, "" if status == "ok" else "why not", scores if status == "ok" else (), 7, 1.0,
        PROVENANCE, {}, CHANNELS,
    )  # fmt: skip


RUNS = [
    result("nnss", 0, val=0.5, test=9.0), result("nnss", 1, val=0.4, test=8.0), result("nnss", 2, val=0.6, test=1.0),
    result("nnss", 3, 0, 0, status="diverged"), result("n4sid", 0, val=0.7, test=2.0),
]  # fmt: skip


def test_the_long_table_has_a_row_per_run_split_and_output() -> None:
    table = long_table(RUNS)
    assert list(table.columns) == COLUMNS
    assert len(table) == 4 * 3 + 1
    (failed,) = table[table["status"] != "ok"].to_dict("records")
    assert failed["reason"] == "why not"
    assert failed["split"] == ""
    assert pd.isna(failed["rmse"])


def test_numbers_stand_with_the_outputs_own_name_and_unit() -> None:
    channels = {"inputs": ["u"], "input_units": ["V"], "outputs": ["level", "flow"], "output_units": ["m", "l/s"]}
    scores = [Score("val", output, 1.0, 0.5, 50.0) for output in ("y2", "y1")]
    runs = [replace(RUNS[0], channels=channels, scores=scores), replace(RUNS[3], channels=channels)]
    for table in (long_table(runs), summary(runs)):
        named = {row["output"]: (row["channel"], row["unit"]) for row in table.to_dict("records")}
        assert (named.pop("y1"), named.pop("y2")) == (("level", "m"), ("flow", "l/s"))
        assert all(not name or pd.isna(name) for name, _ in named.values())  # means, and the run without scores


def test_the_best_run_is_chosen_on_validation_not_on_test() -> None:
    assert best_run(RUNS[:4]).spec.seed == 1  # seed 2 is far better on test
    table = summary(RUNS)
    row = table[(table["method"] == "nnss") & (table["split"] == "test")].iloc[0]
    assert (row["best"], row["best_seed"], row["median"], row["runs"]) == (8.0, 1, 8.5, 4)


def two_outputs(method: str, seed: int, val: tuple[float, float], test: tuple[float, float]) -> RunResult:
    """Errors of outputs with σ = 480 and 0.01, in units of σ."""
    scores = tuple(
        Score(split, f"y{i + 1}", error * sigma, error, 0.0)
        for split, errors in (("train", (1.0, 1.0)), ("val", val), ("test", test))
        for i, (error, sigma) in enumerate(zip(errors, (480.0, 0.01), strict=True))
    )
    one = result(method, seed, 0, 0)
    channels = {name: values * 2 for name, values in CHANNELS.items()}
    return replace(one, scores=scores, channels=channels)


# in physical units nnss is ahead, since its large output is; in units of σ it has twice the error
SCALES = [two_outputs("nnss", 0, (0.1, 0.9), (0.1, 0.9)), two_outputs("n4sid", 0, (0.25, 0.25), (0.25, 0.25))]


def test_several_outputs_are_averaged_before_the_seeds_and_ranked_by_sigma() -> None:
    table = summary(SCALES).set_index(["method", "output", "split"])["median"]
    assert ("nnss", "mean", "test") in table
    assert table["nnss", "mean", "test"] == pytest.approx((48 + 0.009) / 2)
    assert table["nnss", "mean of RMSE/σ", "test"] == pytest.approx(0.5)
    assert table["n4sid", "mean of RMSE/σ", "test"] == pytest.approx(0.25)
    rows = {row["method"]: row for row in terminal_rows(SCALES)}
    assert (rows["nnss"]["test"], rows["n4sid"]["test"]) == ("0.5", "0.25")
    assert "mean over outputs of RMSE/σ" in terminal_title(SCALES)
    seeds = [*SCALES[:1], two_outputs("nnss", 1, (0.3, 0.3), (0.3, 0.3))]
    assert best_run(seeds).spec.seed == 1  # in physical units it validates three times worse
    (line,) = (line for line in markdown(optimism_rows(seeds)).splitlines() if "nnss" in line)
    assert [cell.strip() for cell in line.split("|")][4:7] == ["0.3", "0.3", "0 %"]


def test_medians_are_medians() -> None:
    runs = [result("nnss", seed, 1.0, test) for seed, test in enumerate((1.0, 2.0, 30.0))]
    row = summary(runs).set_index("split").loc["test"]
    assert (row["median"], row["mean"]) == (2.0, 11.0)
    assert terminal_rows(runs)[0]["test"] == "2"
    assert "| 2 " in next(line for line in intervals(runs).splitlines() if "nnss" in line)


def test_runs_without_a_result_count() -> None:
    one_good = [result("nnss", 0, 0.1, 0.1), *(result("nnss", seed, 0, 0, status="diverged") for seed in range(1, 10))]
    row = summary(one_good).set_index("split").loc["test"]
    assert (row["ok"], row["runs"], row["median"], row["best"]) == (1, 10, math.inf, 0.1)
    (shown,) = terminal_rows(one_good)
    assert (shown["runs"], shown["test"], shown["best"]) == ("1/10", "∞", "0.1")
    assert "1/10 | –" in " ".join(rmse_markdown(one_good).split())
    assert "9 of 10 NN-SS, n = 3" in boxplot_title(one_good)
    assert "| 1/10 " in markdown(released_rows([replace(r, spec=papers(r.spec)) for r in one_good]))


def boxplot_title(results: list[RunResult]) -> str:
    figure = _boxplot(results)
    title = " ".join(figure.get_suptitle().split())  # it may be in lines
    plt.close(figure)
    return title


def papers(spec: RunSpec) -> RunSpec:
    """The same run with every setting the paper's."""
    settings = METHODS[spec.method].paper_settings(BENCHMARKS[spec.dataset].presets, spec.order)
    return replace(spec, settings=json.loads(json.dumps(settings)))  # as it comes from disk


def test_no_nan_reaches_a_table() -> None:
    text = rmse_markdown(RUNS)
    assert "nan" not in text.lower()
    assert "nnss, order 3, seed 3: diverged: why not" in text
    assert [row["runs"] for row in terminal_rows(RUNS)] == ["3/4", "1/1"]
    only_failed = [result("nnss", 0, 0, 0, status="failed")]
    assert "failed: why not" in rmse_markdown(only_failed)
    assert terminal_rows(only_failed)[0]["test"] == "–"


def test_an_ensemble_stands_apart() -> None:
    runs = [*RUNS, result("nnss-ensemble", 0, 0.1, 0.1)]
    assert [row["method"] for row in terminal_rows(runs)] == ["nnss", "n4sid"]
    assert [row["method"] for row in terminal_rows(runs, apart=True)] == ["nnss-ensemble"]
    before, _, after = rmse_markdown(runs).partition("no independent competitor")
    assert "nnss-ensemble" not in before
    assert "nnss-ensemble" in after


def test_remarks_are_told_with_the_seeds_that_they_hold_for() -> None:
    runs = [replace(r, remarks=("the start was kept",) if r.spec.seed != 1 else ()) for r in RUNS[:3]]
    assert "- nnss, order 3, seeds 0, 2: the start was kept" in rmse_markdown(runs)
    assert "Remarks" not in rmse_markdown(RUNS)


def test_runs_of_several_versions_are_told() -> None:
    mixed = [RUNS[0], replace(RUNS[1], provenance=PROVENANCE | {"numpy": "1.26"})]
    assert "different versions of numpy: 0 (1 runs), 1.26 (1 runs)" in rmse_markdown(mixed)
    assert "different versions" not in rmse_markdown(RUNS)


PAPERS = [replace(r, spec=papers(r.spec)) for r in RUNS]


def test_the_papers_values_stand_beside_ours() -> None:
    text = markdown(paper_rows(PAPERS))
    line = next(line for line in text.splitlines() if "nnss" in line and "test" in line)
    assert [cell.strip() for cell in line.split("|")][5:10] == ["0.01", "1", "3/4", "+9900 %", "worse"]
    assert markdown(paper_rows([replace(r, spec=replace(r.spec, protocol="strict")) for r in PAPERS])) == ""


def line_of(text: str, method: str, split: str) -> str:
    return next((line for line in text.splitlines() if f"| {method} " in line and f"| {split} " in line), "")


def test_only_the_papers_recipe_stands_beside_the_paper() -> None:
    best = [replace(r, spec=replace(r.spec, settings=r.spec.settings | {"recipe": "best"})) for r in PAPERS[:3]]
    assert line_of(markdown(paper_rows([*best, PAPERS[4]])), "nnss", "test") == ""  # only what was run has a row
    assert line_of(markdown(paper_rows([*best, PAPERS[4]])), "n4sid", "test")
    own = result("nnss-paper", 0, val=0.5, test=0.01)
    by_name = [*best, replace(own, spec=papers(own.spec))]
    assert "reproduced" in line_of(markdown(paper_rows(by_name)), "nnss", "test")
    assert "better" in line_of(markdown(released_rows(by_name)), "nnss", "test")


@pytest.mark.parametrize("field", ["hidden", "stability", "epochs", "dtype", "patience_unit", "window", "consistency"])
def test_a_recipe_is_the_papers_only_when_every_field_is(field: str) -> None:
    changed = {"hidden": [4], "stability": "none", "epochs": 7, "dtype": "float64", "patience_unit": "epochs",
               "window": 40, "consistency": 0.0}[field]  # fmt: skip
    runs = [replace(r, spec=replace(r.spec, settings=r.spec.settings | {field: changed})) for r in PAPERS[:3]]
    assert markdown(paper_rows(runs)) == markdown(released_rows(runs)) == ""
    assert not_the_papers(runs) == [f"nnss, order 3: {field}"]
    assert not_the_papers(PAPERS) == []
    engine = [replace(r, spec=replace(r.spec, settings=r.spec.settings | {"engine": "reference"})) for r in PAPERS]
    assert markdown(paper_rows(engine)) == markdown(paper_rows(PAPERS))  # it computes the same


def test_baselines_stand_beside_the_paper_only_with_the_papers_settings() -> None:
    auto = replace(PAPERS[4], spec=replace(PAPERS[4].spec, settings={"horizon": "auto"}))
    assert line_of(markdown(paper_rows([*PAPERS[:3], auto])), "n4sid", "test") == ""
    assert "| – " not in markdown(paper_rows(PAPERS))
    assert not_the_papers([auto]) == ["n4sid, order 3: horizon"]
    assert line_of(markdown(paper_rows(PAPERS)), "n4sid", "test").split("|")[6].strip() == "2"


def test_released_medians_have_a_spread_of_their_own() -> None:
    # released: median 0.0211; ours end below it, but within what its own quartiles leave open
    released = released_table().set_index(["dataset", "order", "method", "split"]).loc["twotank", 3, "nnss", "test"]
    low = released["median"] - 1.57 * (released["q3"] - released["q1"]) / math.sqrt(10)
    near = [result("nnss", seed, 1.0, low + 1e-5) for seed in range(10)]
    far = [result("nnss", seed, 1.0, low - 1e-5) for seed in range(10)]
    for runs, word in ((near, "yes"), (far, "no")):
        line = line_of(markdown(released_rows([replace(r, spec=papers(r.spec)) for r in runs])), "nnss", "test")
        assert line.split("|")[-2].strip() == word


def test_medians_stand_beside_released_medians() -> None:
    runs = [result("nnss", seed, 1.0, test) for seed, test in enumerate((0.01, 0.02, 0.3))]  # released: 0.02113
    runs.append(result("nnss", 3, 0, 0, status="diverged"))
    for lost, cells in ((0, ["3/3", "0.02113", "0.02", "-5 %"]), (1, ["3/4", "0.02113", "0.16", "+657 %"])):
        own = [replace(r, spec=papers(r.spec)) for r in runs[: 3 + lost]]
        line = [cell.strip() for cell in line_of(markdown(released_rows(own)), "nnss", "test").split("|")]
        assert [line[i] for i in (4, 5, 7, 9)] == cells
        assert line[10] == ("worse" if lost else "reproduced")


def test_choosing_on_test_takes_the_seed_with_the_lowest_test_error() -> None:
    (line,) = (line for line in markdown(optimism_rows(RUNS)).splitlines() if "nnss" in line)
    assert [cell.strip() for cell in line.split("|")][3:7] == ["3/4", "8", "1", "88 %"]
    printed = line_of(markdown(paper_rows(PAPERS)), "nnss", "test").split("|")
    assert printed[6].strip() == "1"  # of 9, 8 and 1


def test_two_records_are_both_drawn() -> None:
    signals = {f"test/{i}/{name}": np.full((K, 1), i) for i, K in enumerate((4, 6)) for name in ("y", "x")}
    assert record_lengths(signals, "test") == [4, 6]
    assert joined(signals, "test", "y").ravel().tolist() == [0.0] * 4 + [1.0] * 6


@pytest.mark.system
def test_everything_is_rebuilt_from_disk_to_the_bit(tmp_path: Path, nnss) -> None:
    out = tmp_path / "results"
    outcome = nnss(
        "compare", "twotank-sim", "--orders", "2", "--seeds", "2", "--epochs", "1", "--jobs", "1", "--out", out,
        "--window", "40", "--stride", "100", "--hidden", "5", "--recipe", "paper",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    folder = Store(out, "twotank-sim", "paper").folder
    names = ["rmse.csv", "rmse.md", "boxplot.png", "boxplot.svg", "simulation.png", "states.png"]
    before = {name: (folder / name).read_bytes() for name in names}
    for name in names:
        (folder / name).unlink()
    report = write_report(out)
    assert {name: (folder / name).read_bytes() for name in names} == before
    text = report.read_text(encoding="utf-8")
    assert "twotank-sim/paper/boxplot.png" in text
    assert "nan" not in text.lower()
    assert set(pd.read_csv(folder / "rmse.csv")["split"]) == {"train", "val", "test"}
    assert write_comparison(Store(out, "twotank-sim", "paper"))


@pytest.mark.system
def test_equal_runs_give_equal_files_without_times(tmp_path: Path, nnss) -> None:
    files = []
    for name in ("one", "two"):
        out = tmp_path / name
        train = ("train", "twotank-sim", "--order", "2", "--method", "simba", "--epochs", "2", "--out", out)
        assert nnss(*train).code == 0
        assert nnss("report", "--out", out).code == 0
        csv = Store(out, "twotank-sim", "paper").folder / "rmse.csv"
        assert pd.read_csv(csv)["fit_seconds"].notna().all()
        assert nnss("report", "--no-times", "--out", out).code == 0
        files.append(csv.read_bytes())
        assert list(pd.read_csv(csv).columns) == COLUMNS
    assert files[0] == files[1]


def test_the_zoom_shows_where_the_record_changes_most() -> None:
    step = np.where(np.arange(1200) < 700, 0.0, 1.0)[:, None] + 0.1 * np.sin(np.arange(1200))[:, None]
    part = transient(step)
    assert part.start < 700 < part.stop
    assert part.stop - part.start == 100
    assert transient(step[:150]) is None
    assert transient(np.ones((300, 2))) == slice(0, 60)
