"""A page, and a headless browser to open it in."""

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from html_runs import make_runs

FETCHED = Path(__file__).parents[2] / ".browser"
NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome", "chromium-headless-shell")


def lacking(what: str) -> Any:
    """Skip, or fail where the tests of the page are what was asked for: `make test-page`."""
    message = f"no {what}: `make test-page` brings it"
    return pytest.fail(message) if os.environ.get("NNSS_BROWSER_REQUIRED") else pytest.skip(message)


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """A running browser: NNSS_BROWSER, what `make test-page` brought, or the system's."""
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        lacking("playwright")
    named = os.environ.get("NNSS_BROWSER") or (str(FETCHED / "chromium") if (FETCHED / "chromium").exists() else None)
    program = named or next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        lacking("browser")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=["--no-sandbox"])  # root in a container
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def axe() -> str:
    """The script of axe-core."""
    path = FETCHED / "node_modules" / "axe-core" / "axe.min.js"
    if not path.exists():
        lacking("axe-core")
    return path.read_text(encoding="utf-8")


@pytest.fixture(scope="session")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A results folder with three records, several outputs, a dense record, runs without a result, and its page."""
    from nnss_cli.experiment.ablation import STUDIES, variant_store
    from nnss_cli.report.html.page import write_html

    out = tmp_path_factory.mktemp("page") / "results"
    methods = ("nnss", "nnss-ensemble", "simba", "n4sid", "ssest")
    plant = make_runs(out, "plant", methods, seeds=3)
    for number, name in enumerate(STUDIES["recipe"]):
        make_runs(variant_store(plant, "recipe", name).out, "plant", ("nnss",), seeds=3, K=150 + 10 * number)
    make_runs(out, "dense", ("nnss", "n4sid"), orders=(3,), seeds=1, K=20_000)
    make_runs(out, "two", ("nnss", "n4sid"), orders=(2,), seeds=2, outputs=2, protocol="paper")
    write_html(out)
    return out


@pytest.fixture(scope="session")
def page_file(results: Path) -> Path:
    """The page: that of NNSS_PAGE, which a study made, or of the made-up runs."""
    return Path(os.environ.get("NNSS_PAGE") or results / "report.html")


@dataclass
class Opened:
    """A page in the browser, with all that it said and asked for."""

    page: Any
    said: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)


@pytest.fixture
def visit(chromium: Any) -> Iterator[Callable[..., Opened]]:
    """Open a file in a window of its own."""
    contexts = []

    def open_(path: Path, width: int = 1400, height: int = 900, **options: Any) -> Opened:
        context = chromium.new_context(viewport={"width": width, "height": height}, **options)
        contexts.append(context)
        opened = Opened(context.new_page())
        opened.page.on("console", lambda message: opened.said.append(f"{message.type}: {message.text}"))
        opened.page.on("pageerror", lambda error: opened.said.append(f"error: {error}"))
        opened.page.on("dialog", lambda dialog: (opened.said.append("dialog"), dialog.dismiss()))
        opened.page.on("request", lambda request: opened.asked.append(request.url))
        opened.page.goto(path.as_uri())
        return opened

    yield open_
    for context in contexts:
        context.close()
