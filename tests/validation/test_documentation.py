"""The examples of docs/validation.md, executed."""

import re
import shlex
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
from nnss_cli.datasets.catalog import load

DOCUMENT = Path(__file__).parents[2] / "docs" / "validation.md"


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.slow
def test_the_examples_run(nnss: Callable) -> None:
    (commands,), (program,) = blocks("sh"), blocks("python")
    dataset = load("twotank-sim", "strict")
    (record,), channels = dataset.tests["test"], dataset.fitting.channels
    columns = dict(zip((*channels.inputs, *channels.outputs), (*record.u.T, *record.y.T), strict=True))
    pd.DataFrame(columns).to_csv("new.csv", index=False)
    for line in commands.splitlines():
        command, _, comment = line.partition("#")
        done = nnss(*shlex.split(command)[1:])
        # the plant is nonlinear and the model is not, which either record shows
        assert done.code == (1 if "validate" in command else 0), (line, done.err)
        assert ("exit code 1" in comment) <= (done.code == 1)
    made = {"predicted.csv", "predicted.png", "simulated.csv", "validation-n4sid-n2-s0.png"}
    assert made <= {p.name for p in Path().iterdir()}
    names: dict[str, object] = {}
    exec(program, names)
    assert len(names["y"]) == len(record)  # type: ignore[arg-type]
    assert not names["report"].passed  # type: ignore[attr-defined]
