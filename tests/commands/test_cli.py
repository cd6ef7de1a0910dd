"""The command line as scripts use it."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnss_cli.commands.variadic import expand
from nnss_cli.methods import DEFAULT, METHODS
from nnss_cli.version import __version__

QUICK = ("--epochs", "1", "--window", "40", "--stride", "100", "--hidden", "5", "--encoder", "3")


@pytest.mark.parametrize(
    ("args", "expected"),
    [
        ("x --orders 2 3 4 --seeds 1", "x --orders 2 --orders 3 --orders 4 --seeds 1"),
        ("--orders 2 --orders 3", "--orders 2 --orders 3"),
        ("--seeds 3 x --orders 2", "--seeds 3 x --orders 2"),
        ("--orders -1 2", "--orders -1 --orders 2"),
        ("--orders 2 -- x", "--orders 2 -- x"),
        ("--orders", "--orders"),
        ("--orders=2 x", "--orders=2 x"),
    ],
)
def test_values_after_one_option_are_repeated(args: str, expected: str) -> None:
    assert expand(args.split(), {"--orders"}) == expected.split()


def test_version_and_help(nnss: Callable) -> None:
    assert nnss("--version").out.strip() == f"nnss {__version__}"
    for command in ("fetch", "train", "compare", "tune", "ablate", "certify", "order", "report", "methods"):
        outcome = nnss(command, "--help")
        assert outcome.code == 0
        assert "Example: nnss " + command in " ".join(outcome.out.split())


@pytest.mark.system
def test_tune_goes_on_where_it_stopped(nnss: Callable) -> None:
    pytest.importorskip("optuna")
    few = ("--stride", "100", "--epochs", "2")  # windows, whatever their batches
    call = ("tune", "twotank-sim", "--order", "2", *few, "--window", "40", "--trials", "2")
    outcome = nnss(*call)
    assert outcome.code == 0, outcome.err
    assert Path("results/twotank-sim/paper/tune/order-2.db").exists()
    outcome = nnss(*call, "--sampler", "gp")
    assert outcome.code == 0, outcome.err
    assert "best of 4 trials" in outcome.out
    line = next(line for line in outcome.out.splitlines() if "nnss train" in line)
    trained = nnss(*line.partition("nnss ")[2].split(), *few, "--window", "40")
    assert trained.code == 0, trained.err
    refused = nnss(*call[:-4], "--window", "50", "--trials", "2")
    assert refused.code == 2
    assert "instead of" in refused.err


@pytest.mark.system
@pytest.mark.parametrize(
    "study", ["class", *(pytest.param(name, marks=pytest.mark.slow) for name in ("recipe", "stability"))]
)
def test_studies(nnss: Callable, study: str, small_data: Callable) -> None:
    dataset = small_data(K=450)
    records = (*dataset.fitting.train, *dataset.fitting.val, *dataset.tests["test"])
    signals = {name: np.concatenate([getattr(record, name)[:, 0] for record in records]) for name in "uy"}
    pd.DataFrame(signals).to_csv("short.csv", index=False)
    record = ("short.csv", "--inputs", "u", "--outputs", "y", "--ts", "0.5")
    call = ("ablate", *record, "--orders", "2", "--seeds", "1", "--epochs", "2", "--jobs", "1", "--study")
    outcome = nnss(*call, study)
    assert outcome.code == 0, outcome.err
    assert ("left out: encoder of 10 samples: encoder window: " in outcome.err) == (study == "class")
    (page,) = Path("results/short").glob(f"*/study-{study}.md")
    text = page.read_text()
    assert ("quadratic" in text) == (study == "stability")
    again = nnss(*call, study)
    assert ": 0 runs to do" in again.out
    assert page.read_text() == text
    assert nnss(*call, "magic").code == 2


def test_python_dash_m() -> None:
    done = subprocess.run([sys.executable, "-m", "nnss_cli", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == f"nnss {__version__}"


def test_shell_completion() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "nnss_cli", "--show-completion", "bash"], capture_output=True, text=True, check=True,
        env=os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
    )  # fmt: skip
    assert "complete" in done.stdout


def test_fetch_list_several_and_from(nnss: Callable, mirror: Path) -> None:
    listed = nnss("fetch", "--list").out
    names = ("twotank", "robotarm", "daisy-powerplant", "twotank-sim")
    for name in names:
        assert name in listed
    assert nnss("fetch", *names, "--mirror", mirror, "--offline").code == 0
    assert nnss("fetch", "daisy-powerplant", "--offline").code == 0
    outcome = nnss("fetch", "twotank", "--from", mirror / "TwoTanksMatlab.mat")
    assert outcome.code == 0
    assert "twotank.mat" in outcome.out


@pytest.mark.system
def test_train_then_compare_uses_the_run(nnss: Callable) -> None:
    outcome = nnss("train", "twotank-sim", "--order", "2", "--seed", "0", *QUICK)
    assert outcome.code == 0, outcome.err
    assert "test" in outcome.out
    run = Path("results/twotank-sim/paper/runs/nnss-n2-s0/run.json")
    before, remarks = run.stat().st_mtime_ns, json.loads(run.read_text())["remarks"]
    assert remarks
    assert all(remark in " ".join(outcome.out.split()) for remark in remarks)
    assert nnss("train", "twotank-sim", "--order", "2", "--seed", "0", *QUICK, "--quiet").out == ""
    outcome = nnss("compare", "twotank-sim", "--orders", "2", "--seeds", "2", *QUICK, "--jobs", "1")
    assert outcome.code == 0, outcome.err
    wanted = {name: {0, 1} if METHODS[name].seeded else {0} for name in DEFAULT}
    count = sum(map(len, wanted.values()))
    assert f"{count - 1} runs to do, 1 done already" in outcome.out
    assert run.stat().st_mtime_ns == before
    table = pd.read_csv("results/twotank-sim/paper/rmse.csv")
    assert {name: set(own["seed"]) for name, own in table.groupby("method")} == wanted
    assert nnss("report").code == 0
    assert json.loads(run.read_text())["provenance"]["nnss"] == __version__
    assert not list(Path("results").rglob(".tmp-*"))


@pytest.mark.slow
@pytest.mark.usefixtures("weak_adversary")
def test_a_former_name_is_told_once_and_kept_runs_and_models_of_it_are_todays(nnss: Callable) -> None:
    call = ("compare", "twotank-sim", "--methods", "nnss", "--orders", "2", "--seeds", "1", "--jobs", "1", *QUICK)
    former = nnss(*call, "--stability", "contraction")
    assert former.code == 0
    assert former.err.count("\n") == 1
    assert "'contraction' is now called 'quadratic'" in former.err
    runs = Path("results/twotank-sim/paper/runs")
    for path in (*runs.glob("*/run.json"), *runs.glob("*/model.json")):  # as they were kept before
        text = path.read_text()
        assert '"contraction"' not in text
        content = json.loads(text.replace('"quadratic"', '"contraction"'))
        for kept in (content.get("spec", {}).get("settings", {}), content.get("architecture", {})):
            kept.pop("gain", None)  # it had not been there yet
        path.write_text(json.dumps(content))
    for option, told in ((("--stability", "quadratic"), 0), (("--set", "nnss.stability=contraction"), 1)):
        again = nnss(*call, *option)
        assert (again.code, again.err.count("\n")) == (0, told), again.err
        assert "0 runs to do, 1 done already" in again.out
    refused = nnss(*call, "--stability", "none")
    assert "stability quadratic instead of none" in refused.err
    certified = nnss("certify", str(runs / "nnss-n2-s0"), "--steps", "100", "--budget", "0", "--json")
    assert certified.code == 0, certified.err
    assert json.loads(certified.out)["stability"] == "quadratic"


@pytest.mark.system
def test_repeated_orders_and_methods(nnss: Callable) -> None:
    outcome = nnss(
        "compare", "twotank-sim", "--orders", "1", "--orders", "2", "--methods", "n4sid", "--out", "elsewhere"
    )
    assert outcome.code == 0, outcome.err
    assert set(pd.read_csv("elsewhere/twotank-sim/paper/rmse.csv")["order"]) == {1, 2}
    assert not Path("elsewhere/twotank-sim/paper/states.png").exists()  # no NN-SS run, no states


@pytest.mark.system
def test_order_selection(nnss: Callable) -> None:
    outcome = nnss("order", "twotank-sim", "--max-order", "4")
    assert outcome.code == 0, outcome.err
    assert "Suggested order:" in outcome.out
    table = pd.read_csv("results/twotank-sim/paper/order.csv")
    assert list(table["order"]) == [1, 2, 3, 4]
    assert table["suggested"].sum() == 1
    assert Path("results/twotank-sim/paper/order.png").stat().st_size > 10_000
    assert "by order (RMSE/σ, horizon" in outcome.out
    assert "Orders up to" not in outcome.out
    more = nnss("order", "twotank-sim", "--max-order", "100")
    assert (more.code, f"Orders up to {len(pd.read_csv('results/twotank-sim/paper/order.csv'))}: " in more.out) == (
        0,
        True,
    )


@pytest.mark.system
def test_orders_of_several_outputs_are_compared_by_what_is_said(nnss: Callable) -> None:
    """By the RMS over outputs, where other tables take the mean."""
    random = np.random.default_rng(0)
    u = random.standard_normal(400)
    y = np.stack([np.convolve(u, 0.8 ** np.arange(9))[:400], np.roll(u, 1)], axis=1) + 0.1 * random.normal(
        size=(400, 2)
    )
    pd.DataFrame({"u": u, "y": y[:, 0], "z": y[:, 1]}).to_csv("two.csv", index=False)
    done = nnss("order", "two.csv", "--inputs", "u", "--outputs", "y", "z", "--ts", "1", "--max-order", "2")
    assert done.code == 0, done.err
    assert "by order (RMS over outputs of RMSE/σ, horizon" in " ".join(done.out.split())


def test_the_paper_protocol_of_the_robot_arm_scores_no_test(nnss: Callable, mirror: Path) -> None:
    outcome = nnss("compare", "robotarm", "--orders", "4", "--methods", "n4sid", "--mirror", mirror, "--offline")
    assert outcome.code == 0, outcome.err
    assert "lacks the paper's test record" in outcome.out
    assert set(pd.read_csv("results/robotarm/paper/rmse.csv")["split"]) == {"train", "val"}


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["train", "nothing", "--order", "2"], ["unknown dataset 'nothing'", "twotank", "robotarm"]),
        (["fetch", "nothing"], ["unknown dataset 'nothing'", "daisy-powerplant"]),
        (["fetch"], ["--all"]),
        (["compare", "twotank-sim", "--methods", "magic"], ["unknown method 'magic'", "nnss", "n4sid"]),
        (["compare", "twotank-sim", "--protocol", "lax"], ["unknown protocol of twotank-sim 'lax'", "paper, strict"]),
        (["compare", "twotank-sim", "--sedes", "1"], ["--sedes", "--seeds"]),
        (["compaer"], ["compaer", "compare"]),
        (["compare", "twotank-sim", "--orders", "two"], ["two", "--orders"]),
        (["compare", "twotank-sim", "--orders", "0"], ["order", "found 0"]),
        (["compare", "twotank-sim", "--orders", "-3"], ["order", "found -3"]),
        (["compare", "twotank-sim", "--orders", "100000"], ["order", "expected 1 to 500"]),
        (["compare", "twotank-sim", "--seeds", "0"], ["--seeds", "at least 1"]),
        (["compare", "twotank-sim", "--horizon", "far"], ["unknown horizon 'far'", "matlab, auto"]),
        (["compare", "twotank-sim", "--kernel", "rbf"], ["unknown kernel 'rbf'", "tc, dc, ss"]),
        (["compare", "twotank-sim", "--simba-start", "zero"], ["start of simba", "n4sid, random"]),
        (["order", "twotank-sim", "--max-order", "0"], ["--max-order", "at least 1"]),
        (["compare", "twotank-sim", "--engine", "warp"], ["unknown engine 'warp'", "auto, fast, reference"]),
        (["compare", "twotank-sim", "--jobs", "0"], ["--jobs", "at least 1"]),
        (["compare", "twotank-sim", "--epochs", "0"], ["epochs", "at least 1"]),
        (["compare", "twotank-sim", "--window", "2000"], ["window", "1500 samples"]),
        (["train", "twotank-sim", "--order", "2", "--window", "1501"], ["window", "1500 samples"]),
        (["train", "twotank-sim", "--order", "2", "--scheduling", "y"], ["unknown scheduling 'y'", "x+u"]),
        (["train", "twotank-sim", "--order", "2", "--gamma", "2"], ["gamma"]),
        (["train", "twotank-sim", "--order", "2", "--dtype", "half"], ["unknown dtype", "float64"]),
        (["train", "twotank-sim"], ["--order"]),
        (["train", "twotank-sim", "--order", "2", "--seed", "-1"], ["--seed"]),
        (["train", "twotank", "--order", "2", "--offline"], ["twotank", "--from FILE", "--mirror"]),
        (["report", "--out", "nowhere"], ["no finished runs", "compare"]),
        (["fetch", "twotank", "robotarm", "--from", "x.mat"], ["exactly one"]),
        (["fetch", "twotank", "--from", "missing.mat"], ["missing.mat"]),
        (["fetch", "twotank-sim", "--from", "x.mat"], ["simulated"]),
    ],
)  # fmt: skip
def test_bad_input_is_one_line_and_exit_code_2(
    args: list[str], words: list[str], nnss: Callable, own_cache: Path
) -> None:
    outcome = nnss(*args)
    assert outcome.code == 2
    assert len(outcome.err.strip().splitlines()) == 1, outcome.err
    assert "Traceback" not in outcome.err
    for word in words:
        assert word in outcome.err
    assert not list(Path().rglob("*")), "nothing half-written"
    assert not own_cache.exists()


def test_a_file_in_the_way_of_the_results(nnss: Callable) -> None:
    Path("results").write_text("in the way")
    outcome = nnss("compare", "twotank-sim", "--methods", "n4sid", "--orders", "2")
    assert outcome.code == 2
    assert "results" in outcome.err
    assert "--out" in outcome.err
    assert Path("results").read_text() == "in the way"


def test_a_truncated_file_is_refused(nnss: Callable, mirror: Path, tmp_path: Path, own_cache: Path) -> None:
    half = tmp_path / "half.mat"
    half.write_bytes((mirror / "RobotArm.mat").read_bytes()[:100_000])
    outcome = nnss("fetch", "robotarm", "--from", half)
    assert outcome.code == 2
    assert "half.mat" in outcome.err
    assert not own_cache.exists()


@pytest.mark.system
def test_ctrl_c_keeps_finished_runs_and_says_how_to_go_on(tmp_path: Path) -> None:
    command = [
        sys.executable, "-m", "nnss_cli", "compare", "twotank-sim", "--orders", "2", "--seeds", "3",
        "--methods", "n4sid", "nnss", "--epochs", "100000", "--patience", "100000", "--jobs", "2",
    ]  # fmt: skip
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # a background job of a script inherits SIGINT as ignored, and Python would leave it so
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    finished = tmp_path / "results/twotank-sim/paper/runs/n4sid-n2-s0/run.json"
    deadline = time.monotonic() + 60
    while not finished.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "interrupted: finished runs are kept" in err
    assert "the same command goes on" in err
    assert "Traceback" not in err
    assert finished.exists()
    assert not list(tmp_path.rglob("nnss-n2-*/run.json"))
