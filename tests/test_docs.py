"""The examples of docs/api.md, run as they stand, and the figures that it claims."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnss_cli.export import TARGETS
from nnss_cli.modelfile import FORMAT
from nnss_cli.testing import small_dataset

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r"```(python|sh)\n(.*?)```", re.DOTALL)


@pytest.mark.system
def test_the_examples_of_the_api_run(nnss: Callable) -> None:
    data = small_dataset(K=450)
    records = [*data.fitting.train, *data.fitting.val, *data.tests["test"]]
    u, y = (np.concatenate([getattr(record, name)[:, 0] for record in records]) for name in "uy")
    pd.DataFrame({"u": u, "y": y}).to_csv("plant.csv", index=False)
    pd.DataFrame({"u": u[100:300], "y": y[100:300]}).to_csv("new.csv", index=False)
    seen: dict[str, Any] = {}
    commands: list[str] = []
    for language, block in BLOCK.findall((DOCS / "api.md").read_text(encoding="utf-8")):
        if language == "python":
            exec(compile(block, "docs/api.md", "exec"), seen)
            continue
        for line in block.splitlines():
            name, *arguments = shlex.split(line, comments=True)
            assert name == "nnss"
            done = nnss(*arguments)
            assert done.code == 0, (line, done.err)
            commands.append(" ".join(arguments))
    assert set(seen["study"].table["method"]) == {"nnss", "n4sid"}
    assert seen["y"].shape == (200, 1)
    assert np.abs(seen["rest"].y[0] - seen["model"].simulate(seen["new"]["u"], seen["new"]["y"][0]).y[100]) < 1e-9
    assert (
        np.abs(seen["response"].y[0] - seen["model"].simulate(seen["new"]["u"], seen["new"]["y"][:1]).y[:, 0]).max()
        < 1e-12
    )
    assert {target for target in TARGETS if any(f"--to {target} " in command for command in commands)} == set(TARGETS)
    assert len(pd.read_csv("predicted.csv")) == 200
    assert Path("firmware/tank.c").exists()
    assert f"`format` ({FORMAT})" in (DOCS / "api.md").read_text(encoding="utf-8")


@pytest.mark.slow
def test_frozen_gain_against_linearised_gain(nnss: Callable, mirror: Path) -> None:
    """The figures of docs/api.md: trained anew, so that they follow the code."""
    from nnss_cli.trained import load

    done = nnss("train", "twotank", "--order", "3", "--seed", "0", "--mirror", mirror)
    assert done.code == 0, done.err
    model = load("results")
    at = model.equilibrium(5.0)
    A, B, C = model.matrices(at.z)
    frozen = (C @ np.linalg.solve(np.eye(3) - A, B)).item()
    slope = (model.equilibrium(5.001).y - model.equilibrium(4.999).y).item() / 0.002
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    assert f"a DC gain of {frozen:.4f} m/V; the linearisation" in text
    assert f"slope of the static curve have {model.linearise(5.0).dcgain().item():.4f} m/V" in text
    assert f"{slope:.4f}" == f"{model.linearise(5.0).dcgain().item():.4f}"


def cells(text: str) -> dict[tuple[str, str], list[str]]:
    """Rows of a table of `compare` by order and method."""
    rows = (line.split() for line in text.splitlines())
    return {(row[0], row[1]): row[2:] for row in rows if len(row) == 9 and row[0].isdigit()}


@pytest.mark.slow
def test_the_quick_start_runs_and_prints_what_it_says(nnss: Callable) -> None:
    """Commands as they stand; linear methods to two digits, NN-SS (two seeds, other processors) within a factor."""
    text = (DOCS / "quickstart.md").read_text(encoding="utf-8")
    told, errors, codes = "", "", []
    for language, block in BLOCK.findall(text):
        if language == "python":
            exec(compile(block, "docs/quickstart.md", "exec"), {})
            continue
        for line in block.splitlines():
            done = nnss(*shlex.split(line)[1:], *(["--jobs", "1"] if " compare " in line else []))
            told, errors = told + done.out, errors + done.err
            codes.append((line.split()[1], done.code))
            again = nnss(*shlex.split(line)[1:])
            assert again.code == (2 if "--write" in line else done.code), (line, again.err)
    assert codes == [("inspect", 0), ("compare", 0), ("validate", 0), ("simulate", 0), ("certify", 0), ("export", 0)]
    shown, found = cells(text), cells(told)
    assert shown.keys() == found.keys()
    for key, row in shown.items():
        for said, is_so in zip(row[1:4], found[key][1:4], strict=True):
            near = 0.02 if key[1] != "nnss" else 1.0
            assert float(is_so) == pytest.approx(float(said), rel=near), (key, said, is_so)
    for said in ("foretell 11 % of what a linear model leaves", "67 % of input 'pump'", "All 4 tests pass."):
        assert said in text
        assert said in " ".join(told.split())
    assert Path("firmware/model.c").exists()
    assert Path("predicted.csv").exists()
    assert Path("results/plant/inspection.png").exists()
