"""Every number in the page's tables is found in a run's file, or follows from some by arithmetic done here anew.

Nothing of nnss computes what is expected: only run.json, model.json, the signals, and NumPy (html_numbers.py).
"""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from html_numbers import NUMBER, errors_of, is_found, middle, missing, tables_of
from html_runs import make_runs

from nnss_cli.report.html.page import write_html


@pytest.mark.skipif(not os.environ.get("NNSS_PAGE"), reason="NNSS_PAGE names no page beside its runs")
def test_every_number_of_the_page_at_hand_is_found_in_the_runs_files() -> None:
    path = Path(os.environ["NNSS_PAGE"])
    assert missing(path.parent, path.read_text(encoding="utf-8")) == []


@pytest.mark.parametrize("outputs", [1, 2])
def test_every_number_in_the_tables_is_found_in_the_runs_files(tmp_path: Path, outputs: int) -> None:
    make_runs(tmp_path, outputs=outputs)
    make_runs(tmp_path, "other", seeds=3, outputs=outputs, protocol="strict")
    page = write_html(tmp_path).read_text(encoding="utf-8")
    found = tables_of(page)
    cells = [cell for table in found for row in table["rows"] for cell in row]
    assert len(found) >= 10
    assert sum(len(NUMBER.findall(cell)) for cell in cells) > 500
    assert missing(tmp_path, page) == []


def test_each_row_of_the_errors_is_its_own_runs(tmp_path: Path) -> None:
    make_runs(tmp_path, seeds=7)
    page = write_html(tmp_path).read_text(encoding="utf-8")
    (table,) = [table for table in tables_of(page) if table["caption"].startswith("RMSE of free")]
    columns = {name: table["head"].index(name) for name in table["head"]}
    labels = {"NN-SS": "nnss", "NN-SS ensemble": "nnss-ensemble", "SIMBa": "simba", "N4SID": "n4sid"}
    assert len(table["rows"]) == 4 * 2 * 3
    for row in table["rows"]:
        method, order, split = labels[row[1]], row[0], row[2]
        paths = sorted(tmp_path.glob(f"plant/strict/runs/{method}-n{order}-s*/run.json"))
        runs = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
        values = [errors_of(run, split).get("y1", math.inf) for run in runs]
        shown = {name: NUMBER.findall(row[at]) for name, at in columns.items()}
        assert row[columns["runs"]] == f"{sum(map(math.isfinite, values))}/{len(values)}"
        assert is_found(shown["median"][0], np.array([middle(values, 0.5)]))
        if len(values) > 1:
            ordered = sorted(values)
            assert shown["interval of the median"][0] == f"{float(f'{ordered[0]:.4g}'):.10g}"  # 98 % of seven
            assert is_found(shown["q1–q3"][0], np.array([middle(values, 0.25)]))
            assert (row[columns["lowest–highest"]].endswith("∞")) == math.isinf(ordered[-1])
            best = min(runs, key=lambda run: errors_of(run, "val").get("y1", math.inf))
            assert shown["best by validation"][1] == str(best["spec"]["seed"])
            assert is_found(shown["best by validation"][0], np.array([errors_of(best, split)["y1"]]))
