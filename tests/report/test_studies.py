"""Studies of NN-SS in report.md and on the page: rebuilt from their runs, one table in both."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
from html_numbers import missing, tables_of
from html_runs import make_runs

from nnss_cli.experiment import ablation
from nnss_cli.experiment.ablation import STRESS, STRESSED, STUDIES, studies, variant_store
from nnss_cli.experiment.store import Store
from nnss_cli.report.build import write_report
from nnss_cli.report.html.page import write_html
from nnss_cli.report.studies import changes


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A comparison with two studies: three variants of one of them, and all of stability, of which one run grows."""
    folder = tmp_path_factory.mktemp("studied")
    store = make_runs(folder, methods=("nnss", "n4sid"))
    for study, names in (("recipe", [*STUDIES["recipe"]][:3]), ("stability", [*STUDIES["stability"]])):
        for i, name in enumerate(names):
            own = make_runs(variant_store(store, study, name).out, methods=("nnss",), seeds=3 + i, K=150 + 20 * i)
            for run in own.results() if study == "stability" else ():
                grown = name == "none" and (run.spec.order, run.spec.seed) == (3, 1)
                kept = json.dumps({"steps": STRESS, "unbounded": grown})
                (own.run_folder(run.spec) / STRESSED).write_text(kept, encoding="utf-8")
    write_report(folder)
    write_html(folder)
    return folder


def of_markdown(text: str) -> list[list[str]]:
    rows = [line.strip("| ").split("|") for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in row] for row in (rows[0], *rows[2:])]


@pytest.mark.parametrize("study", ["recipe", "stability"])
def test_the_page_has_the_table_of_the_report_in_its_order(out: Path, study: str) -> None:
    text = (out / "report.md").read_text(encoding="utf-8")
    own = text.partition(f"### Study: {study}")[2].partition("\n### ")[0]
    page = (out / "report.html").read_text(encoding="utf-8")
    (shown,) = tables_of(page.partition(f"Study of NN-SS: {study}")[2].partition("<h3>")[0])
    expected = of_markdown(own)
    assert expected == of_markdown((out / f"plant/strict/study-{study}.md").read_text(encoding="utf-8"))
    assert [shown["head"], *shown["rows"]] == expected
    assert len(shown["rows"]) == 2 * len(STUDIES[study])
    assert "Study of NN-SS: class" not in page  # of which there are no runs


def test_every_number_of_a_study_is_found_in_its_runs(out: Path) -> None:
    page = (out / "report.html").read_text(encoding="utf-8")
    assert missing(out, page) == []
    (table,) = tables_of(page.partition("Study of NN-SS: recipe")[2].partition("<h3>")[0])
    median = table["rows"][0][3].split()[0]
    assert missing(out, page.replace(f"<td>{median} ", "<td>0.87654 "))


def test_models_that_grew_are_counted_and_those_never_tried_are_not_known(out: Path, tmp_path: Path) -> None:
    rows = of_markdown((out / "plant/strict/study-stability.md").read_text(encoding="utf-8"))
    at = rows[0].index("unbounded under stress")
    assert [row[at] for row in rows[1:]] == [
        f"{grown} of {runs}" for grown, runs in ((0, 3), (0, 4), (0, 5), (0, 6), (0, 3), (0, 4), (0, 5), (1, 6))
    ]
    store = make_runs(tmp_path, methods=("nnss",))
    make_runs(variant_store(store, "stability", "none").out, methods=("nnss",), seeds=2)
    (variants,) = studies(store).values()
    assert [variant.unbounded for variant in variants] == [(), (), (), None]


def test_what_came_of_stress_is_kept_with_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = make_runs(tmp_path, methods=("nnss",), orders=(2,), seeds=1)
    (run,) = store.results()
    assert ablation._stressed(store, run) is None
    kept = store.run_folder(run.spec) / STRESSED
    for text, unbounded in (
        (json.dumps({"steps": STRESS, "unbounded": True}), True), (json.dumps({"steps": 5, "unbounded": True}), None),
        ("{", None), ("[]", None),
    ):  # fmt: skip
        kept.write_text(text, encoding="utf-8")
        assert ablation._stressed(store, run) is unbounded
    kept.write_text(json.dumps({"steps": STRESS, "unbounded": False}), encoding="utf-8")
    monkeypatch.setattr(ablation, "load_model", lambda _: pytest.fail("it was tried before"))
    ablation._stress(store, run)


def test_what_a_variant_changes_is_said_with_what_follows_from_it(out: Path) -> None:
    plain, other, third, *_ = studies(Store(out, "plant", "strict"))["recipe"]
    settings = {
        "consistency": 0.1,
        "initial": "feedback",
        "recipe": "best, changed: consistency, initial",
        "threads": 2,
    }
    base = {"consistency": 0.0, "initial": "auto", "recipe": "best", "threads": 1}

    def given(variant: ablation.Variant, own: dict[str, object]) -> ablation.Variant:
        runs = (replace(run, spec=replace(run.spec, settings=own)) for run in variant.results)
        return replace(variant, results=tuple(runs))

    variants = [given(plain, base), given(other, settings), given(third, base)]
    assert changes(variants) == [
        f"{other.name}: consistency 0.1 (for 0.0), initial feedback (for auto)",
        f"{third.name}: nothing: the recipe has it so",
    ]
    none = replace(other, results=())
    assert changes([variants[0], replace(none, refused="expected one"), none]) == [
        f"{other.name}: no runs: expected one",
        f"{other.name}: no runs: not done, or not for this record; `nnss ablate` tells which",
    ]
    text = (out / "report.md").read_text(encoding="utf-8")
    assert "“changed: initial” too" in text
