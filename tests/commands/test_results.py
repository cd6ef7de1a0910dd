"""`nnss results`, `--json` and `--quiet`: the runs of a folder, for people and for machines."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from nnss_cli.datasets.catalog import load

from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.lock import lock
from nnss_cli.methods import select


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """n4sid and ssregest at two orders, on the embedded plant."""
    store = Store(tmp_path_factory.mktemp("made"), "twotank-sim", "strict")
    dataset = load(store.dataset, store.protocol)
    for spec in plan(store, dataset, select(["n4sid", "ssregest"]), [1, 2], [0], {}, False).todo:
        assert execute(spec, dataset, store).status == "ok"
    return store.out


@pytest.fixture
def out(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "results"))


def names(out: Path) -> set[str]:
    return {path.parent.name for path in out.rglob("run.json")}


def test_what_is_removed_and_merged_is_told_to_machines(out: Path, nnss: Callable, tmp_path: Path) -> None:
    def told(*line: object) -> dict:
        return json.loads(nnss("results", *line, "--json").out)

    names = {"twotank-sim/strict/n4sid-n1-s0", "twotank-sim/strict/n4sid-n2-s0"}
    asked = told("rm", "n4sid*", "--out", out)
    assert (asked["event"], asked["removed"], set(asked["kept"])) == ("end", [], names)
    other = shutil.copytree(out, tmp_path / "other")
    gone = told("rm", "n4sid*", "--yes", "--out", out)
    assert (set(gone["removed"]), gone["kept"]) == (names, [])
    merged = told("merge", other, "--out", out)
    assert (set(merged["copied"]), len(merged["same"]), merged["left_out"]) == (names, 2, [])
    quiet = nnss("results", "rm", "n4sid*", "--yes", "--out", out, "--quiet")
    assert (quiet.code, quiet.out) == (0, "")


@pytest.mark.parametrize(
    ("line", "told"),
    [
        (("simulate", "run", "new.csv", "--data", "other.csv"), "--data: does nothing without --interval"),
        (("simulate", "run", "new.csv", "--interval-by", "ensemble"), "--interval-by: does nothing without --interval"),
        (("predict", "run", "new.csv", "--interval-by", "adaptive"), "--interval-by: does nothing without --interval"),
        (("validate", "run", "--time", "t"), "--time: does nothing without a FILE:"),
        (("validate", "run", "--ts", "1"), "--ts: does nothing without a FILE or --data"),
        (("validate", "run", "--sheet", "x"), "--sheet: does nothing without a FILE or --data"),
        (("validate", "run", "--json", "--out", "x.png"), "--out: --json writes no figure, found 'x.png'"),
        (("certify", "run", "--ts", "1"), "--ts: does nothing without --data"),
    ],
)
def test_options_that_would_do_nothing_are_refused(line: tuple[str, ...], told: str, nnss: Callable) -> None:
    done = nnss(*line)
    assert done.code == 2
    assert told in done.err
    assert done.err.count("\n") == 1


def run_file(out: Path, label: str) -> Path:
    return out / "twotank-sim" / "strict" / "runs" / label / "run.json"


def test_a_list_fits_into_80_columns(out: Path, nnss: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nnss_cli.commands.display.console.width", 80)
    long = out / "daisy-powerplant" / "official" / "runs"
    content = json.loads(run_file(out, "n4sid-n1-s0").read_text())
    for seed in range(12):
        label = f"nnss-ensemble-n10-s{seed}"
        content["spec"] |= {"dataset": "daisy-powerplant", "protocol": "official", "method": "nnss-ensemble"}
        content["spec"] |= {"order": 10, "seed": seed}
        content |= {"status": "crashed", "reason": "lost", "scores": []}
        (long / label).mkdir(parents=True)
        (long / label / "run.json").write_text(json.dumps(content))
    told = nnss("results", "list", "--out", out)
    assert told.code == 0
    lines = told.out.splitlines()
    assert max(map(len, lines)) <= 80
    heads = [line.split() for line in lines if "dataset" in line]
    assert heads == [["dataset", "protocol", "method", "n", "ok", "else", "test"]]
    rows = [line.split() for line in lines if line.strip().startswith(("twotank", "daisy"))]
    assert len(rows) == 5
    assert rows[0] == ["daisy-powerplant", "official", "nnss-ensemble", "10", "0/12", "12", "crashed", "∞"]
    found = [json.loads(line) for line in nnss("results", "list", "n4sid-*", "--out", out, "--json").out.splitlines()]
    assert [one["run"] for one in found] == ["twotank-sim/strict/n4sid-n1-s0", "twotank-sim/strict/n4sid-n2-s0"]
    assert found[0]["status"] == "ok"
    assert len(found[0]["scores"]) == 3


def test_a_run_is_shown_with_what_made_it(out: Path, nnss: Callable) -> None:
    told = nnss("results", "show", "twotank-sim/strict/n4sid-n2-s0", "--out", out)
    assert told.code == 0
    for word in ("test", "instructions", "peak memory", "command", "horizon", "started"):
        assert word in told.out
    assert nnss("results", "show", "n4sid-n7-s0", "--out", out).code == 2
    run_file(out, "n4sid-n2-s0").write_text("{}")
    told = nnss("results", "show", "n4sid-n2-s0", "--out", out)
    assert (told.code, len(told.err.splitlines())) == (1, 1)
    assert "n4sid-n2-s0/run.json" in told.err


def test_runs_are_removed_only_when_it_is_said_and_nobody_is_at_them(out: Path, nnss: Callable) -> None:
    everything = names(out)
    told = nnss("results", "rm", "n4sid-*", "--out", out)
    assert told.code == 0
    assert "2 runs would be removed" in told.out
    assert names(out) == everything
    with lock(out / "twotank-sim" / "strict" / "runs" / ".locks" / "n4sid-n1-s0") as held:
        assert held
        told = nnss("results", "rm", "n4sid-*", "--out", out, "--yes")
    assert told.code == 1
    assert "another command is at twotank-sim/strict/n4sid-n1-s0" in told.err
    assert names(out) == everything - {"n4sid-n2-s0"}
    run_file(out, "ssregest-n1-s0").write_text("{}")
    assert nnss("results", "rm", "--status", "damaged", "--out", out, "--yes").code == 0
    assert names(out) == {"n4sid-n1-s0", "ssregest-n2-s0"}
    assert nnss("results", "rm", "--out", out).code == 2


def test_folders_of_several_machines_are_joined(made: Path, tmp_path: Path, nnss: Callable) -> None:
    first, second = (Path(shutil.copytree(made, tmp_path / name)) for name in ("first", "second"))
    out = tmp_path / "joined"
    shutil.rmtree(run_file(first, "n4sid-n1-s0").parent)
    shutil.rmtree(run_file(second, "n4sid-n2-s0").parent)
    assert nnss("results", "merge", first, second, "--out", out).code == 0
    assert names(out) == names(made)
    for path in made.rglob("twotank-sim/strict/runs/[!.]*/*"):
        assert (out / path.relative_to(made)).read_bytes() == path.read_bytes()
    told = nnss("results", "merge", first, "--out", out)
    assert "0 runs copied" in told.out
    assert "3 were there already" in told.out
    assert nnss("results", "merge", tmp_path / "nowhere", "--out", out).code == 2


def test_what_disagrees_is_named_and_left_where_it_is(made: Path, tmp_path: Path, nnss: Callable) -> None:
    other, out = (Path(shutil.copytree(made, tmp_path / name)) for name in ("other", "out"))
    for label in ("n4sid-n1-s0", "n4sid-n2-s0", "ssregest-n1-s0", "ssregest-n2-s0"):
        content = json.loads(run_file(other, label).read_text())
        if label == "n4sid-n1-s0":
            content["spec"]["settings"]["horizon"] = "7"
        elif label == "ssregest-n1-s0":
            content["scores"][0]["nrmse"] *= 2
        elif label == "ssregest-n2-s0":
            content["scores"][0]["rmse"] *= 2
        else:
            shutil.rmtree(run_file(out, label).parent)
            content["spec"]["data"] = "0"
        run_file(other, label).write_text(json.dumps(content))
    before = {path: path.read_bytes() for path in out.rglob("run.json")}
    told = nnss("results", "merge", other, "--out", out)
    assert told.code == 1
    lines = told.err.splitlines()
    assert len(lines) == 4
    for words in (
        "n4sid-n1-s0': another run of this name is there, with other options of n4sid: horizon",
        "n4sid, order 2, seed 0: another version of the data (samples, scaling, names or units) than most",
        "ssregest-n1-s0': another run of this name is there, with other scores",
        "ssregest-n2-s0/signals.safetensors' disagrees with the run.json beside it",
    ):
        assert any(words in line for line in lines), (words, lines)
    assert {path: path.read_bytes() for path in out.rglob("run.json")} == before


def test_runs_of_other_data_do_not_come_beside_those_that_are_there(made: Path, tmp_path: Path, nnss: Callable) -> None:
    other, out = (Path(shutil.copytree(made, tmp_path / name)) for name in ("other", "out"))
    for path in other.rglob("run.json"):
        content = json.loads(path.read_text())
        content["spec"]["data"] = "0"
        path.write_text(json.dumps(content))
    shutil.rmtree(run_file(out, "n4sid-n1-s0").parent)
    told = nnss("results", "merge", other, "--out", out)
    assert told.code == 1
    assert len(told.err.splitlines()) == 4
    assert "n4sid-n1-s0': runs there are of another version of the data" in told.err
    assert names(out) == names(made) - {"n4sid-n1-s0"}


COMPARE = ("compare", "twotank-sim", "--methods", "n4sid", "--orders", "1", "2", "--jobs", "1")


@pytest.mark.system
def test_events_are_one_json_object_a_line(nnss: Callable) -> None:
    told = nnss(*COMPARE, "--json")
    assert (told.code, told.err) == (0, "")
    events = [json.loads(line) for line in told.out.splitlines()]
    assert [one["event"] for one in events] == [
        "plan", "start", "result", "forecast", "start", "result", "table", "end"
    ]  # fmt: skip
    plan_, _, first, forecast, *_, end = events
    assert forecast["expected_seconds"] > 0
    assert (plan_["runs"], plan_["done"]) == (2, 0)
    assert (first["run"], first["status"]) == ("twotank-sim/paper/n4sid-n1-s0", "ok")
    assert {score["split"] for score in first["scores"]} == {"train", "val", "test"}
    assert any(path.endswith("rmse.csv") for path in end["files"])
    assert end["left_out"] == []
    assert json.loads(nnss("report", "--json").out.splitlines()[-1])["files"] == ["results/report.md"]


@pytest.mark.system
def test_quiet_is_quiet_but_for_errors(nnss: Callable) -> None:
    told = nnss(*COMPARE, "--quiet")
    assert (told.code, told.out, told.err) == (0, "", "")
    assert Path("results/twotank-sim/paper/rmse.csv").exists()
    told = nnss("report", "--quiet")
    assert (told.code, told.out, told.err) == (0, "", "")
    assert nnss(*COMPARE).out, "and so only where it is asked for"
    told = nnss("train", "twotank-sim", "--method", "n4sid", "--order", "1000000", "--quiet")
    assert (told.code, told.out, len(told.err.splitlines())) == (2, "", 1)
