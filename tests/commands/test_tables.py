"""Tables of commands: whole at any width, in full precision and alone on stdout for machines."""

import csv
import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from nnss_cli.app import app
from nnss_cli.commands.layout import lines_of
from nnss_cli.report.cells import plain
from nnss_cli.report.tables import number, span

HEADS = {"order": "n", "test": "test\n[ticks/s]", "train": "train\n[m]"}
NAMES = ("order", "method", "runs", "train", "val", "test", "fit", "q1–q3", "best", "remark")
words = st.text("abc d", min_size=1, max_size=30)
numbers = st.floats(1e-6, 1e9).map(number)


@given(st.integers(30, 200), st.lists(st.tuples(words, st.lists(numbers, min_size=7, max_size=7), words), min_size=1))
def test_no_number_is_split_and_no_line_is_too_long(width: int, given: list) -> None:
    rows = [dict(zip(NAMES, ("3", *("a" * 9,), *row[1], row[2]), strict=True)) for row in given]
    lines = lines_of(rows, HEADS, 2, width)
    assert max(map(cell_len, lines)) <= width
    told = " ".join(lines).split()
    for row in rows:
        for cell in (row[name] for name in NAMES if name != "remark"):
            assert cell in told
    assert "n" in told
    assert ("[ticks/s]" in told) or width < 110


def test_what_is_too_wide_stands_below_with_its_row_named() -> None:
    rows = [{"order": "2", "method": f"method-{i}"} | {f"column-{j}": f"{i}.{j}" for j in range(6)} for i in range(2)]
    text = "\n".join(lines_of(rows, {}, 2, 50))
    first, second = text.split("\n\n")
    for block in (first, second):
        assert [line.split()[1] for line in block.splitlines()[2:]] == ["method-0", "method-1"]
    assert "1.5" in second
    assert text.count("\n\n") == 1
    assert lines_of(rows, {}, 2, 200)[0].split() == list(rows[0])


def test_machines_get_numbers_in_full() -> None:
    rows = [{"a": number(1 / 3, 3), "b": span(1 / 3, 2 / 3, ("q1", "q3"), 3), "c": number(None), "d": "–", "e": "x"}]
    assert rows[0]["a"] == "0.333"
    assert rows[0]["b"] == "0.333–0.667"
    assert plain(rows) == [{"a": 1 / 3, "q1": 1 / 3, "q3": 2 / 3, "c": None, "d": None, "e": "x"}]
    assert span(251.234, 410.4, ("q1", "q3"), 3) == "251–410"


COMPARE = ("compare", "twotank-sim", "--methods", "n4sid", "ssregest", "--orders", "1", "2", "--jobs", "1")


def rows_of(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


@pytest.mark.system
def test_compare_as_csv_and_json_is_the_table_of_its_files(nnss: Callable) -> None:
    told = nnss(*COMPARE, "--csv")
    assert (told.code, told.err) == (0, "")
    rows = rows_of(told.out)
    assert [(row["order"], row["method"]) for row in rows] == [
        ("1", "n4sid"), ("1", "ssregest"), ("2", "n4sid"), ("2", "ssregest")
    ]  # fmt: skip
    text = Path("results/twotank-sim/paper/rmse.csv").read_text()
    kept = {(r["method"], r["order"], r["split"]): r for r in rows_of(text)}
    for row in rows:
        score = kept[row["method"], row["order"], "test"]
        assert float(row["test"]) == float(score["rmse"])
        assert float(row["fit"]) == pytest.approx(float(score["fit_percent"]))
    events = [json.loads(line) for line in nnss(*COMPARE, "--json").out.splitlines()]
    (table,) = (event for event in events if event["event"] == "table")
    assert [row["test"] for row in table["rows"]] == [float(row["test"]) for row in rows]
    both = nnss(*COMPARE, "--json", "--csv")
    assert (both.code, both.out) == (2, "")


@pytest.mark.slow
def test_every_command_that_prints_a_table_prints_it_for_machines(nnss: Callable) -> None:
    """The commands are those whose source calls `print_rows`."""
    folder = Path(__file__).parents[2] / "nnss_cli" / "commands"
    named = {path.stem for path in folder.glob("*.py") if "print_rows(" in path.read_text() and path.stem != "display"}
    assert nnss("compare", "twotank-sim", "--methods", "n4sid", "--orders", "2", "--jobs", "1").code == 0
    model = "results/twotank-sim/paper/runs/n4sid-n2-s0"
    data = Path("new.csv")
    signals = nnss("fetch", "--list").out  # the table for people stays
    assert "twotank-sim" in signals
    write_record(Path(model), data)
    lines = {
        "fetch": ("fetch", "--list"), "methods": ("methods",), "show": ("show", model),
        "train": ("train", "twotank-sim", "--method", "n4sid", "--order", "2"),
        "order": ("order", "twotank-sim", "--max-order", "2"), "inspect": ("inspect", "new.csv", "--ts", "0.2"),
        "simulate": ("simulate", model, "new.csv", "--force"), "predict": ("predict", model, "new.csv", "--force"),
        "validate": ("validate", model, "--force"), "results": ("results", "list"),
        "compare": None, "ablate": None, "tune": None, "certify": None,  # slow: by their options below
    }  # fmt: skip
    assert named == set(lines)
    for name, line in lines.items():
        if line is None:
            continue
        told = nnss(*line, "--csv")
        assert told.code in (0, 1), (name, told.err)
        assert rows_of(told.out), name
        assert None not in rows_of(told.out)[0], name
        if name == "train":
            continue  # its events are those of compare
        told = nnss(*line, "--json")
        assert told.code in (0, 1), (name, told.err)
        try:
            json.loads(told.out)  # a document, or
        except json.JSONDecodeError:
            events = [json.loads(part)["event"] for part in told.out.splitlines()]
            assert events[-1] == ("end" if name in ("order", "simulate", "predict") else "table"), name
    told = nnss("results", "show", "n4sid-n2-s0", "--csv")
    assert rows_of(told.out)[0]["output"]
    options = {one.name or one.callback.__name__: one for one in app.registered_commands}
    for name in ("compare", "ablate", "tune", "certify"):
        assert {"as_csv", "as_json"} <= options[name].callback.__annotations__.keys(), name


def write_record(model: Path, path: Path) -> None:
    """The model's test record as a file."""
    from nnss_cli.trained import load

    trained = load(model)
    record = trained.records()["test"][0]
    names = [*trained.channels.inputs, *trained.channels.outputs]
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(names)
        writer.writerows([*u, *y] for u, y in zip(record.u, record.y, strict=True))


@pytest.mark.system
def test_folders_are_compared_run_by_run(nnss: Callable) -> None:
    assert nnss(*COMPARE).code == 0
    shutil.copytree("results", "other")
    told = nnss("results", "diff", "results", "other")
    assert (told.code, told.out.strip()) == (0, "4 runs equal, 0 different")
    again = (
        "compare",
        "twotank-sim",
        "--methods",
        "n4sid",
        "--orders",
        "2",
        "--jobs",
        "1",
        "--out",
        "other",
        "--force",
    )
    assert nnss(*again, "--horizon", "auto").code == 0
    runs = Path("other/twotank-sim/paper/runs")
    shutil.rmtree(runs / "ssregest-n1-s0")
    (runs / "n4sid-n1-s0" / "run.json").write_text("{}")
    told = nnss("results", "diff", "results", "other", "--json")
    assert told.code == 1
    table, end = (json.loads(line) for line in told.out.splitlines())
    found = {(row["run"].rpartition("/")[2], row["what"]): row for row in table["rows"]}
    assert found["ssregest-n1-s0", "run"]["B"] == "missing"
    assert (found["n4sid-n2-s0", "horizon"]["A"], found["n4sid-n2-s0", "horizon"]["B"]) == ("matlab", "auto")
    error = found["n4sid-n2-s0", "RMSE test y1"]
    assert error["change"] == pytest.approx(error["B"] / error["A"] - 1)
    assert error["change"] != 0
    assert {name: end[name] for name in ("equal", "different", "only_in_A", "only_in_B")} == {
        "equal": 1, "different": 1, "only_in_A": 1, "only_in_B": 0,
    }  # fmt: skip
    turned = nnss("results", "diff", "other", "results")
    assert turned.out.splitlines()[-1] == "1 runs equal, 1 different, 1 only in B"
    assert any("n4sid-n1-s0" in line for line in end["left_out"])
    assert nnss("results", "diff", "results", "nowhere").code == 2
    assert "no runs under 'nowhere'" in nnss("results", "diff", "results", "nowhere").err


@pytest.mark.system
def test_a_small_change_may_be_none(nnss: Callable) -> None:
    assert nnss(*COMPARE[:-2], "--jobs", "1").code == 0
    shutil.copytree("results", "other")
    for path in Path("other").rglob("run.json"):
        text = path.read_text()
        path.write_text(re.sub(r'"python": "[^"]*"', '"python": "2.7"', text))
    told = nnss("results", "diff", "results", "other", "--tolerance", "0.1", "--csv")
    assert told.code == 1
    assert {row["what"] for row in rows_of(told.out)} == {"python"}
