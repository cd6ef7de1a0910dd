"""README and docs name nothing that does not exist: links, anchors, commands, options, files, make targets."""

import doctest
import re
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from html_runs import make_runs

import nnss_cli.api
from nnss_cli.app import app
from nnss_cli.commands.layout import lines_of
from nnss_cli.report.tables import error_tables
from nnss_cli.testing import small_dataset

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.DOTALL | re.MULTILINE)
CODE = re.compile(r"`([^`\n]+)`")
PATH = re.compile(r"^(?:nnss_cli|datasets|baselines|tests|benchmarks|docs)/[\w./-]+$")
INSIDE = {"nnss_cli/datasets": "datasets", "nnss_cli/baselines": "baselines"}


def ids(path: Path) -> str:
    return path.name


def anchors(page: Path) -> set[str]:
    """Anchors of a page's headings, as GitHub and MkDocs make them."""
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    heads = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).strip().replace(" ", "-") for head in heads}


def links(page: Path) -> Iterator[str]:
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    yield from (link for link in LINK.findall(text) if not re.match(r"[a-z]+:", link))


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_links_lead_somewhere(page: Path) -> None:
    for link in links(page):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), f"{page.name}: {link}"
        if anchor:
            assert anchor in anchors(target), f"{page.name}: {link}"
        if page.parent.name == "docs":
            assert target.is_relative_to(ROOT / "docs"), f"{page.name}: {link} leaves the site"


def command_lines(page: Path) -> Iterator[list[str]]:
    """Every `nnss …` of a page, in blocks and in running text; other words before it are none."""
    text = page.read_text(encoding="utf-8")
    lines = [line for _, block in FENCE.findall(text) for line in block.replace("\\\n", " ").splitlines()]
    lines += CODE.findall(FENCE.sub("", text).replace("\n", " "))
    for line in lines:
        if line.lstrip("$ ").startswith("nnss "):
            with_comment = re.sub(r"\s#.*", "", line.lstrip("$ "))
            yield shlex.split(with_comment.replace("'", '"') if with_comment.count("'") % 2 else with_comment)[1:]


def known_options() -> dict[str, set[str]]:
    """Command → its options, by typer itself."""
    import typer

    group = typer.main.get_command(app)
    found: dict[str, set[str]] = {"": {"--version", "--install-completion", "--help"}}
    for name, command in group.commands.items():
        for own, one in {
            name: command,
            **{f"{name} {n}": c for n, c in getattr(command, "commands", {}).items()},
        }.items():
            found[own] = {opt for parameter in one.params for opt in (*parameter.opts, *parameter.secondary_opts)}
            found[own] |= {"--help", "-h"}
    return found


OPTIONS = known_options()


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_commands_and_their_options_exist(page: Path) -> None:
    for words in command_lines(page):
        name = words[0] if words and not words[0].startswith("-") else ""
        if name == "results" and len(words) > 1:
            names = [f"results {part}" for part in words[1].split("|")]
        else:
            names = name.split("|")
        for one in names:
            assert one in OPTIONS, f"{page.name}: nnss {' '.join(words)}"
            for word in words:
                option = word.strip("[]").partition("=")[0].partition("|")[0]
                if option.startswith("--"):
                    assert option in OPTIONS[one], f"{page.name}: {option} of nnss {one}"


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_options_of_the_text_are_those_of_some_command(page: Path) -> None:
    everything = set().union(*OPTIONS.values())
    text = FENCE.sub("", page.read_text(encoding="utf-8"))
    for code in CODE.findall(text):
        if code.startswith("--"):
            option = re.match(r"--[a-z][a-z-]*", code)
            assert option, code
            assert option.group() in everything, f"{page.name}: {code}"


@pytest.mark.parametrize("page", PAGES, ids=ids)
def test_files_and_targets_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    blocks = [line for _, block in FENCE.findall(text) for line in block.splitlines()]
    for code in [*CODE.findall(FENCE.sub("", text)), *blocks]:
        made = re.match(r"make ([a-z-]+)", code.strip())
        if made:
            assert made.group(1) in targets, f"{page.name}: {code}"
        for word in code.split():
            path = word.split("::")[0].rstrip(",;")
            if PATH.match(path) and not path.startswith("docs/_"):
                inside = next(
                    (real + path[len(name) :] for name, real in INSIDE.items() if path.startswith(name)), path
                )
                assert (ROOT / inside).exists(), f"{page.name}: {path}"
    for name in re.findall(r"\b[A-Z][A-Z_]+\.md\b", text):
        assert (ROOT / name).exists(), f"{page.name}: {name}"


def test_the_examples_of_docstrings_run(nnss: Callable) -> None:
    """Beside a file plant.csv with columns u and y; `nnss` is here for its empty folder."""
    data = small_dataset(K=300)
    records = [*data.fitting.train, *data.fitting.val, *data.tests["test"]]
    u, y = (np.concatenate([getattr(record, name)[:, 0] for record in records]) for name in "uy")
    pd.DataFrame({"u": u, "y": y}).to_csv("plant.csv", index=False)
    found = doctest.testmod(nnss_cli.api, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE)
    assert found.failed == 0
    assert found.attempted >= 6


def test_the_front_pages_table_is_laid_out_as_it_is_printed(tmp_path: Path) -> None:
    """Its rows, under the heads that runs with a unit have, give its text to the letter."""
    (found,) = error_tables(make_runs(tmp_path, seeds=2).results())
    (shown,) = (body for _, body in FENCE.findall((ROOT / "README.md").read_text(encoding="utf-8")) if "q1–q3" in body)
    lines = shown.splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith("n "))
    rule = next(i for i, line in enumerate(lines) if line.startswith("─"))
    rows = [dict(zip(found.rows[0], line.split(), strict=True)) for line in lines[rule + 1 :]]
    assert len(rows) == 18
    assert "\n".join(lines[head:]) == "\n".join(lines_of(rows, found.heads, 2, 80))
    title = " ".join(lines[:head]).partition(": RMSE of ")[2].partition("]")[2]
    assert title == found.title.partition(": RMSE of ")[2].partition("]")[2]


def test_the_front_pages_figures_stand_in_the_pages_it_links_to() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    rows = [
        line for line in text.partition("## Two commands")[0].splitlines() if line.startswith("|") and "make" in line
    ]
    assert len(rows) == 4
    for row in rows:
        _, _, ours, others, source, _ = row.split("|")
        (link,) = LINK.findall(source)
        page = (ROOT / link).read_text(encoding="utf-8")
        numbers = re.findall(r"\d+(?:[. ]\d+)*", ours + others.replace("N4SID", ""))
        assert len(numbers) >= 3
        for number in numbers:
            assert re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.])", page), f"{number} is not in {link}"
    assert "![" in text.partition("## Two commands")[0]
