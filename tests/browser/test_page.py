"""The page in a real browser. With NNSS_PAGE those tests that need no made-up runs look at that page."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from html_runs import HOSTILE, HOSTILE_FOLDER, make_runs
from safetensors.numpy import load_file

LARGEST = 3_000_000  # bytes of a page
WIDTHS = (360, 768, 1400)
PAPER = 703  # pixels of A4 between its margins
WIDER = """() => Array.from(document.querySelectorAll("main *, header *, footer *"))
    .filter((e) => !e.closest(".skip, .symbols, svg") && e.getBoundingClientRect().right > innerWidth + 1)
    .filter((e) => matchMedia("print").matches || !e.closest(".scroll"))
    .map((e) => e.outerHTML.slice(0, 120))"""


def test_it_says_nothing_and_asks_for_nothing(
    page_file: Path, visit: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    """How long it takes to open is printed, not tested: that is the machine's, too. Its size is bounded."""
    opened = [visit(page_file) for _ in range(3)]
    for one in opened:
        assert one.said == []
        assert one.asked == [page_file.as_uri()]
        assert one.page.evaluate("performance.getEntriesByType('resource').length") == 0
    size = page_file.stat().st_size
    clock = [one.page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd / 1000") for one in opened]
    work = [processor_time(one.page) for one in opened]
    with capsys.disabled():
        print(
            f"\n{page_file.name}: {size / 1e6:.2f} MB, opens in {min(clock):.2f} s ({max(clock):.2f} s at worst), "
            f"of which the processor works {min(work):.2f} s"
        )
    assert size < LARGEST


def processor_time(page: Any) -> float:
    """What the page's process has worked since it began [s], on all threads, whatever else the machine does."""
    session = page.context.new_cdp_session(page)
    session.send("Performance.enable")
    return {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}["ProcessTime"]


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_is_wider_than_the_window(page_file: Path, visit: Callable, width: int) -> None:
    page = visit(page_file, width).page
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(WIDER) == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [360, 1400])
def test_axe_finds_nothing(page_file: Path, visit: Callable, axe: str, scheme: str, width: int) -> None:
    page = visit(page_file, width, color_scheme=scheme).page
    page.evaluate("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    page.evaluate(axe)
    found = page.evaluate("axe.run(document, {resultTypes: ['violations', 'incomplete']})")
    assert len(found["passes"]) > 20
    assert [(one["impact"], one["id"], one["nodes"][0]["html"][:150]) for one in found["violations"]] == []


def test_filters_hide_rows_lines_and_boxes(results: Path, visit: Callable) -> None:
    page = visit(results / "report.html").page
    section = page.locator("section.record", has_text="plant, protocol strict")
    rows = section.locator("table.errors tbody tr:visible")
    assert rows.count() == 5 * 2  # of the test split, with which it begins
    assert "10 of 30 rows" in section.locator(".count").inner_text()
    section.get_by_role("checkbox", name="NN-SS", exact=True).uncheck()
    assert rows.count() == 4 * 2
    assert not section.locator(".pictures g[data-method='0']").first.is_visible()
    assert not section.locator(".plot path[data-method='0']").first.is_visible()
    assert section.locator(".plot path[data-method='3']").first.is_visible()
    section.get_by_role("checkbox", name="n = 3").uncheck()
    assert rows.count() == 4
    section.get_by_role("checkbox", name="train").check()
    assert rows.count() == 8
    section.get_by_role("checkbox", name="NN-SS", exact=True).check()
    assert rows.count() == 10
    other = page.locator("section.record", has_text="dense, protocol strict")
    assert other.locator("table.errors tbody tr:visible").count() == 2


def test_the_table_of_a_study_sorts_by_its_medians(results: Path, visit: Callable) -> None:
    page = visit(results / "report.html").page
    table = page.get_by_role("group", name=re.compile("One switch at a time"))
    assert table.locator("tbody tr").count() == 2 * 10  # orders and variants
    head = table.locator("thead th", has_text=re.compile("^test"))
    column = head.evaluate("(cell) => cell.cellIndex + 1")

    def medians() -> list[float]:
        found = table.locator(f"tbody tr td:nth-child({column})").all_inner_texts()
        return [float(text.split()[0]) for text in found]

    assert medians() != sorted(medians())
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert medians() == sorted(medians())


def test_tables_sort_by_any_column(results: Path, visit: Callable) -> None:
    page = visit(results / "report.html").page
    table = page.locator("section.record", has_text="plant, protocol strict").locator("table.errors")
    head = table.locator("thead th", has_text=re.compile("^median"))

    def medians() -> list[float]:
        return [float(text) for text in table.locator("tbody tr:visible td:nth-child(6)").all_inner_texts()]

    assert medians() != sorted(medians())
    head.get_by_role("button").click()
    assert head.get_attribute("aria-sort") == "ascending"
    assert medians() == sorted(medians())
    head.get_by_role("button").press("Enter")  # by the keyboard
    assert head.get_attribute("aria-sort") == "descending"
    assert medians() == sorted(medians(), reverse=True)
    names = table.locator("thead th", has_text="method")
    names.get_by_role("button").click()
    assert head.get_attribute("aria-sort") is None
    shown = table.locator("tbody tr:visible th").all_inner_texts()
    assert [name.strip() for name in shown] == sorted(name.strip() for name in shown)


def live(figure: Any) -> Any:
    """A figure that was scrolled to: only then does the script take it up."""
    figure.scroll_into_view_if_needed()
    figure.locator(".frame[tabindex]").wait_for()
    return figure


def ticks(figure: Any) -> list[float]:
    return [float(text) for text in figure.locator(".xs span").all_inner_texts()]


def test_a_simulation_zooms_and_tells_its_values(results: Path, visit: Callable) -> None:
    page = visit(results / "report.html").page
    figure = live(page.locator("section.record", has_text="two, protocol paper").locator("figure.trace").first)
    plot = figure.locator(".plot").first
    plot.scroll_into_view_if_needed()
    whole, line = ticks(figure), plot.locator("path.line").first
    before = line.get_attribute("d")
    box = plot.bounding_box()
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20)
    told = figure.locator("output").inner_text()
    signals = load_file(results / "two" / "paper" / "runs" / "n4sid-n2-s0" / "signals.safetensors")
    sample = round(float(re.search(r"time ([\d.]+) s", told)[1]) / 0.2)
    assert sample == pytest.approx(0.5 * 149, abs=1)
    for index, panel in enumerate(("level1 [m]", "level2 [m]")):
        shown = re.search(rf"(?<!of ){re.escape(panel)}: measured (\S+);.*?N4SID, n = 2 (\S+)", told)
        for text, name in zip(shown.groups(), ("y", "y_sim"), strict=True):
            values = signals[f"test/0/{name}"][:, index]
            assert float(text.rstrip(";")) == pytest.approx(values[sample], abs=1e-3 * np.ptp(values))
    page.mouse.down()
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 30, steps=4)
    assert figure.locator(".brush").first.is_visible()
    page.mouse.up()
    near = ticks(figure)
    assert whole[0] <= 0.5 * 29.8 - 2 < near[0] <= near[-1] < 0.7 * 29.8 + 1
    assert line.get_attribute("d") != before
    figure.get_by_role("button", name="Later").click()
    assert ticks(figure)[-1] > near[-1]
    figure.get_by_role("button", name="Whole record").click()
    assert ticks(figure) == whole
    assert line.get_attribute("d") == before


def test_a_simulation_is_read_by_the_keyboard(results: Path, visit: Callable) -> None:
    page = visit(results / "report.html").page
    figure = live(page.locator("section.record", has_text="dense, protocol strict").locator("figure.trace").first)
    frame = figure.locator(".frame").first
    frame.focus()
    assert frame.evaluate("e => getComputedStyle(e).outlineStyle") == "solid"
    whole = ticks(figure)
    page.keyboard.press("Home")
    page.keyboard.press("ArrowRight")
    told = figure.locator("output").inner_text()
    sample = round(float(re.search(r"time ([\d.]+) s", told)[1]) / 0.2)
    signals = load_file(results / "dense" / "strict" / "runs" / "n4sid-n3-s0" / "signals.safetensors")
    edges = np.linspace(0, 20_000, 1501).astype(int)
    index = int(np.searchsorted(edges, sample, side="right"))
    ends = re.search(r"N4SID, n = 3 (-?[\d.]+) to (-?[\d.]+)", told).groups()
    around = signals["test/0/y_sim"][edges[index - 1] : edges[index], 0]
    assert [float(end) for end in ends] == pytest.approx([around.min(), around.max()], abs=1e-3)
    for _ in range(4):
        page.keyboard.press("+")
    assert ticks(figure)[-1] < whole[-1] / 8
    page.keyboard.press("End")
    page.keyboard.press("0")
    assert ticks(figure) == whole
    assert "1500 intervals" in figure.inner_text()


def test_the_page_is_walked_by_tab_and_begins_with_a_way_to_the_content(results: Path, visit: Callable) -> None:
    page = visit(results / "report.html").page
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.className") == "skip"
    assert page.evaluate("document.activeElement.getBoundingClientRect().left") >= 0
    page.keyboard.press("Enter")
    page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.closest('main') !== null")


def test_without_scripts_everything_is_shown(results: Path, visit: Callable) -> None:
    page = visit(results / "report.html", java_script_enabled=False).page
    section = page.locator("section.record", has_text="plant, protocol strict")
    assert section.locator("table.errors tbody tr:visible").count() == 30
    assert page.locator(".script:visible").count() == 0  # nothing that would do nothing
    for picture in (".plot path.line", ".plot path.measured", ".picture .box", ".picture .curve"):
        box = section.locator(picture).first.bounding_box()
        assert box["width"] * box["height"] > 0, picture
    assert ticks(section.locator("figure.trace").first)[0] == 0


def test_colours_follow_the_system_and_the_button(results: Path, visit: Callable) -> None:
    def ground(page: Any) -> str:
        return page.evaluate("getComputedStyle(document.body).backgroundColor")

    light, dark = (visit(results / "report.html", color_scheme=scheme).page for scheme in ("light", "dark"))
    assert ground(light) == "rgb(255, 255, 255)"
    assert ground(dark) == "rgb(20, 24, 29)"
    button = dark.locator("#theme")
    button.click()
    assert button.inner_text() == "Colours: light"
    assert ground(dark) == ground(light)
    dark.reload()
    assert ground(dark) == ground(light)  # it is remembered
    button.click()
    assert ground(dark) == "rgb(20, 24, 29)"


def test_it_prints(page_file: Path, visit: Callable, tmp_path: Path) -> None:
    opened = visit(page_file, color_scheme="dark")
    printed = opened.page.pdf(path=tmp_path / "page.pdf", format="A4")
    assert printed.startswith(b"%PDF")
    assert len(re.findall(rb"/Type\s*/Page\b", printed)) >= 3
    assert opened.page.locator("details[open]").count() == 0  # folded again
    opened.page.emulate_media(media="print")
    assert opened.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    opened.page.set_viewport_size({"width": PAPER, "height": 1000})
    assert opened.page.evaluate(WIDER) == []
    assert not opened.page.locator("nav").is_visible()
    assert opened.page.locator(".script:visible").count() == 0
    assert opened.said == []


def test_names_from_files_do_nothing(visit: Callable, tmp_path: Path) -> None:
    from nnss_cli.report.html.page import write_html

    make_runs(tmp_path, HOSTILE_FOLDER, ("nnss", "n4sid", HOSTILE_FOLDER), seeds=2, text=HOSTILE)
    opened = visit(write_html(tmp_path))
    figure = live(opened.page.locator("figure.trace").first)
    figure.locator(".frame").first.focus()
    opened.page.keyboard.press("ArrowRight")
    assert HOSTILE in figure.locator("output").inner_text()  # the script writes names, too
    opened.page.locator("thead button").first.click()
    assert opened.page.evaluate("window.boom") is None
    assert opened.said == []
    assert len(opened.asked) == 1
    assert opened.page.locator("main img").count() == 0
