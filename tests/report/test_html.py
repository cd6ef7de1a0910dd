"""The page: one file that loads nothing, whose numbers are those of the runs, and to which names are data."""

import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import pytest
from html_runs import HOSTILE, HOSTILE_FOLDER, make_runs

from nnss_cli.report.build import write_report
from nnss_cli.report.html import candidates
from nnss_cli.report.html.page import write_html
from nnss_cli.report.tables import FREE


class Page(HTMLParser):
    """What a browser finds in a page: elements with their attributes, and the texts of tables."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))


@pytest.mark.system
def test_one_command_writes_a_page_that_loads_nothing(tmp_path: Path, nnss: Callable) -> None:
    make_runs(tmp_path / "results")
    done = nnss("report", "--html", "--out", tmp_path / "results")
    assert done.code == 0, done.err
    assert done.out.split() == [str(tmp_path / "results" / name) for name in ("report.md", "report.html")]
    text = (tmp_path / "results" / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"(https?:)?//\w", re.sub(r"http://www\.w3\.org/2000/svg", "", text))
    loading = ("src", "srcset", "data", "poster", "action", "formaction", "background")
    page = Page(text)
    (policy,) = (a["content"] for _, a in page.elements if a.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    for name, attributes in page.elements:
        assert not set(loading) & set(attributes), (name, attributes)
        assert name not in ("iframe", "object", "embed", "base")
        assert attributes.get("href", "#").startswith("#") or attributes["href"] == "data:,"


def test_without_the_option_there_is_no_page(tmp_path: Path, nnss: Callable) -> None:
    make_runs(tmp_path / "results", seeds=1)
    assert nnss("report", "--out", tmp_path / "results").code == 0
    assert not (tmp_path / "results" / "report.html").exists()


def test_names_from_files_are_data(tmp_path: Path) -> None:
    clean, hostile = (
        Page(write_html(_runs(tmp_path / str(index), *names)).read_text(encoding="utf-8"))
        for index, names in enumerate((("plant", "other", ""), (HOSTILE_FOLDER, HOSTILE_FOLDER, HOSTILE)))
    )
    assert [name for name, _ in hostile.elements] == [name for name, _ in clean.elements]
    assert not any(key.startswith("on") for _, attributes in hostile.elements for key in attributes)


def _runs(out: Path, dataset: str, method: str, text: str) -> Path:
    make_runs(out, dataset, ("nnss", "simba", "n4sid", method), seeds=2, text=text)
    return out


@pytest.mark.system
@pytest.mark.parametrize("size", [1, 3])
def test_several_outputs_and_small_folders(tmp_path: Path, size: int) -> None:
    make_runs(tmp_path, methods=("n4sid",), orders=(2,), seeds=1, outputs=size, K=12)
    text = write_html(tmp_path).read_text(encoding="utf-8")
    assert text.count('class="panel"') == 2 * size + 1
    assert ("mean of RMSE/σ</td>" in text) == (size > 1)
    assert ("mean over outputs [m]</td>" in text) == (size > 1)
    assert f"Errors are those of {FREE}." in text
    assert f"RMSE in physical units of {FREE}." in write_report(tmp_path).read_text(encoding="utf-8")


def test_candidates_say_what_their_errors_are_over(monkeypatch: pytest.MonkeyPatch) -> None:
    histories = {
        0: {"val_rmse": [0.3], "val_rmse, as it is": [0.25], "val_rmse, cold start": [0.5]},
        1: {"val_rmse": [0.3], "block_rmse, as it is": [0.125], "block_rmse, cold start": [0.5]},
        2: {"val_rmse": [0.3]},
    }
    monkeypatch.setattr(candidates, "history_of", lambda _, result: histories[result.spec.seed])
    runs = [
        SimpleNamespace(epochs=1, remarks=(), spec=SimpleNamespace(order=2, method="nnss", seed=seed))
        for seed in histories
    ]
    rows = candidates.candidate_rows(None, runs)  # type: ignore[arg-type]
    assert [(row["seed"], row["over"], row["as it is"]) for row in rows] == [
        ("0", "validation", "0.25"), ("1", "blocks", "0.125"),
    ]  # fmt: skip
