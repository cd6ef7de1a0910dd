"""Tables from runs: choices on validation, failures as rows, files rebuilt bit by bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.experiment.store import Store
from nnss_cli.report.aggregate import COLUMNS, best_run, long_table, summary
from nnss_cli.report.build import transient, write_comparison, write_report
from nnss_cli.report.evidence import ahead, blocks, optimism, paper_comparison, ranking, released_comparison
from nnss_cli.report.tables import rmse_markdown, terminal_rows

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


def test_the_best_run_is_chosen_on_validation_not_on_test() -> None:
    assert best_run(RUNS[:4]).spec.seed == 1  # seed 2 is far better on test
    table = summary(RUNS)
    row = table[(table["method"] == "nnss") & (table["split"] == "test")].iloc[0]
    assert (row["best"], row["best_seed"], row["median"], row["runs"]) == (8.0, 1, 8.0, 3)


def test_several_outputs_are_averaged_before_the_seeds() -> None:
    two = [
        replace(r, scores=(*r.scores, *(replace(s, output="y2", rmse=s.rmse + 1) for s in r.scores))) for r in RUNS[:3]
    ]
    table = summary(two)
    mean = table[(table["split"] == "test") & (table["output"] == "mean")].iloc[0]
    assert mean["median"] == pytest.approx(8.5)


def test_no_nan_reaches_a_table() -> None:
    text = rmse_markdown(RUNS)
    assert "nan" not in text.lower()
    assert "nnss, order 3, seed 3: diverged: why not" in text
    assert [row["runs"] for row in terminal_rows(RUNS)] == ["3/4", "1/1"]
    only_failed = [result("nnss", 0, 0, 0, status="failed")]
    assert "failed: why not" in rmse_markdown(only_failed)
    assert terminal_rows(only_failed)[0]["test"] == "–"


def test_the_papers_values_stand_beside_ours() -> None:
    text = paper_comparison(RUNS)
    line = next(line for line in text.splitlines() if "nnss" in line and "test" in line)
    assert "0.01" in line
    assert "8" in line
    assert "worse" in line
    assert paper_comparison([replace(r, spec=replace(r.spec, protocol="strict")) for r in RUNS]) == ""


def test_only_the_papers_recipe_stands_beside_the_paper() -> None:
    best = [replace(r, spec=replace(r.spec, settings={"recipe": "best"})) for r in RUNS]
    line = next(line for line in paper_comparison(best).splitlines() if "nnss" in line and "test" in line)
    assert "| –" in line
    by_name = [*best, result("nnss-paper", 0, val=0.5, test=0.01)]
    line = next(line for line in paper_comparison(by_name).splitlines() if "nnss" in line and "test" in line)
    assert "reproduced" in line
    released = released_comparison(by_name)
    assert any("0.02" in line and "better" in line for line in released.splitlines() if "| test" in line)


def test_choosing_on_test_is_shown_to_be_optimistic() -> None:
    (line,) = (line for line in optimism(RUNS).splitlines() if "nnss" in line)
    assert [cell.strip() for cell in line.split("|")][3:6] == ["8", "1", "88 %"]


def test_methods_are_ranked_over_datasets_and_orders() -> None:
    runs = [
        result(method, 0, val=1.0, test=error + order, order=order)
        for order in (2, 3, 4)
        for method, error in (("nnss", 1.0), ("n4sid", 2.0), ("simba", 0.5 if order == 2 else 3.0))
    ]
    table = blocks([*runs, result("ssest", 0, 1.0, 1.0, status="failed")])
    assert table.shape == (3, 3)
    assert "nnss 1.33" in ranking(table)
    standing = [line.split("|") for line in ahead(table, blocks(runs, "val")).splitlines()[2:]]
    assert [cells[-3].strip() for cells in standing] == ["behind", "ahead", "ahead"]
    assert "behind there too" in standing[0][-2]
    level = [result("nnss", 0, val=1.0, test=2.0 + 1e-9), result("n4sid", 0, val=1.0, test=2.0)]
    assert "level" in ahead(blocks(level), blocks(level, "val"))


def test_everything_is_rebuilt_from_disk_to_the_bit(tmp_path: Path, nnss) -> None:
    out = tmp_path / "results"
    outcome = nnss(
        "compare", "twotank-sim", "--orders", "2", "--seeds", "2", "--epochs", "1", "--jobs", "1", "--out", out,
        "--window", "40", "--stride", "100", "--hidden", "5",
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
