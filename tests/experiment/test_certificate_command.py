"""`nnss certify` on folders of many models, and the schema of its JSON."""

import json
import shutil
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from nnss_cli.experiment.certificate.many import folders_below
from nnss_cli.experiment.certificate.result import Certificate, Gain, Statement, Stress
from nnss_cli.experiment.schema import validated

DOCS = Path(__file__).parents[2] / "docs" / "stability.md"
QUICK = ("--epochs", "1", "--window", "40", "--stride", "100", "--hidden", "4", "--encoder", "3", "--recipe", "paper")
FAST = ("--steps", "100", "--budget", "0")
pytestmark = pytest.mark.usefixtures("weak_adversary")


def check_schema(content: dict[str, Any]) -> None:
    """What is printed is a certificate: every field, of its type, and no other."""
    validated(Certificate, content)
    for kind, parts in (
        (Certificate, [content]),
        (Statement, content["statements"]),
        (Gain, [content["gain"], content["incremental_gain"]]),
        (Stress, content["stress"]),
    ):
        for part in parts:
            assert set(part) == {field.name for field in fields(kind)}
    assert [each["name"] for each in content["statements"]] == ["frozen", "quadratic", "state", "incremental"]
    for each in [*content["statements"], content["gain"], content["incremental_gain"]]:
        assert each["status"] in ("proved", "sampled", "refuted", "unknown")
        if each["status"] == "proved":  # never without saying for what, and how
            assert each["holds_for"]
            assert each["how"]
        assert ("bound" in each) <= ((each.get("bound") is not None) == (each["status"] == "proved"))


@pytest.mark.slow
def test_a_folder_of_models_gives_one_table(nnss: Callable) -> None:
    done = nnss(
        "compare", "twotank-sim", "--orders", "2", "--seeds", "1", "--jobs", "1", "--methods", "nnss", "nnss-ensemble",
        "n4sid", "--stability", "quadratic", *QUICK,
    )  # fmt: skip
    assert done.code == 0, done.err
    runs = Path("results/twotank-sim/paper/runs")
    damaged = runs / "nnss-n2-s9"
    shutil.copytree(runs / "nnss-n2-s0", damaged)
    (damaged / "model.json").write_text("{")
    (runs / "notes").mkdir()
    (runs / "notes" / "readme.txt").write_text("no model")

    outcome = nnss("certify", "results/twotank-sim", *FAST, "--json")
    assert outcome.code == 0, outcome.err
    found = json.loads(outcome.out)
    names = [each.pop("model") for each in found["models"]]
    assert names == ["paper/n4sid-n2-s0", "paper/nnss-ensemble-n2-s0, member 1", "paper/nnss-n2-s0"]
    for each in found["models"]:
        check_schema(each)
    (skipped,) = found["skipped"]
    assert skipped["model"].endswith("nnss-n2-s9")
    assert "model.json" in skipped["reason"]
    linear = found["models"][names.index("paper/n4sid-n2-s0")]
    assert linear["gain"]["status"] == "proved"

    table = nnss("certify", "results", *FAST)
    assert table.code == 0, table.err
    assert "3 models" in table.out
    assert "skipped: " in table.out
    assert len(folders_below(Path("results"))) == len(folders_below(runs)) == 4

    single = nnss("certify", str(runs / "nnss-n2-s0"), *FAST)
    assert "what is known" in single.out
    for folder in [*runs.glob("n*-s0"), runs / "notes"]:
        shutil.rmtree(folder)
    refused = nnss("certify", "results", *FAST)  # the damaged one is left
    assert refused.code == 2
    assert "model.json" in refused.err


@pytest.mark.system
def test_wrong_json_is_no_certificate(nnss: Callable) -> None:
    assert nnss("train", "twotank-sim", "--order", "2", "--stability", "none", *QUICK).code == 0
    content = json.loads(nnss("certify", "results", *FAST, "--json").out)
    check_schema(content)
    assert content["gamma"] is None  # nothing is promised
    for wrong in (
        content | {"gain": content["gain"] | {"status": "likely"}},
        content | {"records": "3"},
        {name: value for name, value in content.items() if name != "statements"},
    ):
        with pytest.raises((ValueError, KeyError)):
            check_schema(wrong)


def test_the_documented_schema_is_that_of_the_code() -> None:
    text = DOCS.read_text(encoding="utf-8")
    section = text[text.index("## The JSON of `nnss certify --json`") :]
    for kind in (Certificate, Statement, Gain, Stress):
        for field in fields(kind):
            assert f"`{field.name}`" in section, f"{kind.__name__}.{field.name}"
    named = {word for word in section.split("`")[1::2] if word.isidentifier()}
    known = {field.name for kind in (Certificate, Statement, Gain, Stress) for field in fields(kind)}
    statuses = {"proved", "sampled", "refuted", "unknown", "frozen", "quadratic", "state", "incremental", "null"}
    assert named <= known | statuses | {"models", "skipped", "model", "reason"}
