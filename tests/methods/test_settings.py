"""What identifies a run: the settings of every built-in method, to the letter, as runs on disk hold them."""

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from nnss_cli.datasets.catalog import load

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS

GOLDEN = Path(__file__).with_name("golden_settings.json")
CHANGES: dict[str, dict[str, Any]] = {
    "none": {},
    "shared": {"epochs": 7, "window": 40, "learning_rate": 0.01, "patience_unit": "steps", "gamma": 0.9},
    "of nnss": {"recipe": "paper", "hidden": (5, 6), "consistency": 0.5, "engine": "reference", "fixed_encoder": True},
    "of the others": {"horizon": "matlab", "kernel": "dc", "feedthrough": "yes", "start": "random"},
}


def settings_of_all() -> dict[str, dict[str, Any]]:
    """Method, protocol, order and changes → settings as JSON."""
    found = {}
    for protocol in ("paper", "strict"):
        data = load("twotank-sim", protocol).fitting
        for name in ("nnss", "nnss-ensemble", "nnss-paper", "simba", "n4sid", "ssest", "ssregest"):
            for order in (2, 3):
                for label, changes in CHANGES.items():
                    settings = METHODS[name].settings(data, order, changes)
                    found[f"{name}, {protocol}, order {order}, {label}"] = json.loads(json.dumps(settings))
            papers = METHODS[name].paper_settings(data.presets, 2)
            found[f"{name}, {protocol}, as in the paper"] = json.loads(json.dumps(papers))
    return found


def test_settings_are_those_of_the_runs_on_disk() -> None:
    """Made by `python tests/methods/test_settings.py`.

    Since e12defe `feedthrough`, `lead`, `integrator`, `budget`, `gain`, `judge`, `threads`, `encoder_window` and
    `lengthen` were added; `initial`, `stability` and `lengthen` of best became auto.
    """
    assert settings_of_all() == json.loads(GOLDEN.read_text(encoding="utf-8"))


CHANGED = {
    "hidden": (4,), "encoder": (3,), "scheduling": "x+u", "stability": "none", "feedthrough": "yes",
    "integrator": "auto", "gamma": 0.9, "epsilon": 1e-3, "dtype": "float64", "window": 40, "stride": 3, "batch": 7,
    "learning_rate": 0.01, "consistency": 0.5, "epochs": 7, "patience": 9, "patience_unit": "epochs",
    "improvement": 0.1, "optimiser": "lbfgs", "lead": 10, "refine": 3, "initial": "linear", "fixed_encoder": True,
    "budget": 60.0, "judge": "blocks", "lengthen": "auto",
}  # fmt: skip


def test_a_recipe_is_the_papers_only_where_every_field_is() -> None:
    data = load("twotank-sim").fitting
    method = METHODS["nnss"]
    papers = method.paper_settings(data.presets, 2)
    assert method.settings(data, 2, {"recipe": "paper"}) == papers
    assert method.settings(data, 2, {"recipe": "paper", "engine": "reference"})["recipe"] == "paper"  # the same numbers
    assert method.settings(data, 2, {"recipe": "paper", "threads": 2})["recipe"] == "paper"
    assert set(CHANGED) | {"engine", "threads", "recipe", "gain", "encoder_window"} == set(
        papers
    )  # a new field is to be added here
    for name, value in CHANGED.items():
        assert method.settings(data, 2, {"recipe": "paper", name: value})["recipe"] == f"paper, changed: {name}"
    several = method.settings(data, 2, {"recipe": "paper", "stability": "none", "hidden": (4,)})
    assert several["recipe"] == "paper, changed: hidden, stability"
    promising = {"recipe": "paper", "stability": "incremental", "hidden": (4,), "gain": 2.0}  # no gain without
    assert method.settings(data, 2, promising)["recipe"] == "paper, changed: gain, hidden, stability"
    unscored = replace(data, init_window=20)
    seen = method.settings(unscored, 2, {"recipe": "paper", "encoder_window": 20})["recipe"]
    assert seen == "paper, changed: encoder_window"


@pytest.mark.parametrize("name", ["simba", "nnss-paper"])
def test_a_default_window_fits_a_short_record_and_the_fit_says_so(name: str) -> None:
    known = load("twotank-sim").fitting
    data = replace(known, train=(known.train[0][:48],), val=(known.val[0][:48],))
    method = METHODS[name]
    assert method.settings(known, 2, {})["window"] == 100
    settings = method.settings(data, 2, {"epochs": 1})
    assert settings["window"] == 48
    told = "windows of 48 samples, the shortest training record, where 100 are usual"
    assert told in method.fit(data, 2, 0, settings, None).remarks
    assert not method.fit(data, 2, 0, method.settings(data, 2, {"epochs": 1, "window": 40}), None).remarks
    with pytest.raises(InputError, match=f"^{name}: window: expected at most the 48 samples .* --set {name}.window=48"):
        method.settings(data, 2, {"window": 80})


def test_the_automatic_engine_is_the_recipes() -> None:
    data = load("twotank-sim").fitting
    for name in ("nnss", "nnss-paper"):
        assert METHODS[name].settings(data, 2, {"engine": "auto"}) == METHODS[name].settings(data, 2, {})


def test_the_order_of_the_methods_is_that_of_the_tables() -> None:
    assert list(METHODS)[:8] == [
        "nnss", "nnss-ensemble", "nnss-clipped", "nnss-paper", "simba", "n4sid", "ssest", "ssregest",
    ]  # fmt: skip


if __name__ == "__main__":
    sys.exit(GOLDEN.write_text(json.dumps(settings_of_all(), indent=0, sort_keys=True) + "\n", encoding="utf-8") < 1)
