"""Colours of the page: contrast as WCAG 2.2 AA asks, and methods that are told apart without any."""

import re
from pathlib import Path

import pytest
from html_runs import make_runs

from nnss_cli.report.html import looks
from nnss_cli.report.html.looks import INKS, KNOWN, LINES, OTHERS, SHAPES, SURFACES, contrast, looks_of
from nnss_cli.report.html.page import write_html

METHODS = [*KNOWN, *(f"plugin-{i}" for i in range(len(OTHERS)))]
# Viénot, Brettel and Mollon 1999: linear RGB as dichromats without red, and without green cones, see it
DICHROMATS = {
    "protan": ((0.1124, 0.8876, 0.0), (0.1124, 0.8876, 0.0), (0.0040, -0.0040, 1.0)),
    "deutan": ((0.2927, 0.7073, 0.0), (0.2927, 0.7073, 0.0), (-0.0223, 0.0223, 1.0)),
}


def linear(colour: str) -> list[float]:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    return [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]


def test_contrast_is_that_of_wcag() -> None:
    assert contrast("#000000", "#ffffff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)  # the known grey that just fails
    assert contrast("#ffffff", "#767676") == pytest.approx(4.54, abs=0.005)


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
@pytest.mark.parametrize("surface", SURFACES)
def test_text_and_lines_have_the_contrast_of_wcag_aa(surface: str, theme: int) -> None:
    ground = SURFACES[surface][theme]
    for name, pair in INKS.items():
        assert contrast(pair[theme], ground) >= 4.5, name  # 1.4.3
    for name, pair in LINES.items():
        assert contrast(pair[theme], ground) >= 3, name  # 1.4.11
    for look in looks_of(METHODS).values():
        assert contrast(look.colour[theme], ground) >= 3, look.method


def test_methods_differ_by_dash_and_by_marker_and_not_by_colour_alone() -> None:
    found = looks_of(METHODS).values()
    for names in ("dash", "marker", "key", "colour"):
        assert len({getattr(look, names) for look in found}) == len(METHODS), names
    assert {look.marker for look in found} <= set(SHAPES)


@pytest.mark.parametrize("theme", [0, 1], ids=["light", "dark"])
@pytest.mark.parametrize("eye", DICHROMATS)
def test_colours_of_the_methods_at_hand_differ_for_dichromats(eye: str, theme: int) -> None:
    """A fiftieth of the whole range apart, in some channel: what dashes and markers say, colours do not deny."""
    seen = {
        name: [sum(k * part for k, part in zip(row, linear(pair[theme]), strict=True)) for row in DICHROMATS[eye]]
        for name, (pair, _, _) in KNOWN.items()
    }
    for first, one in seen.items():
        for second, other in seen.items():
            if first < second:
                apart = max(abs(a - b) for a, b in zip(one, other, strict=True))
                assert apart >= 0.02, (first, second, apart)


def test_the_page_has_no_other_colours(tmp_path: Path) -> None:
    make_runs(tmp_path, orders=(2,), seeds=1)
    page = write_html(tmp_path).read_text(encoding="utf-8")
    (style,) = re.findall(r"<style>(.*?)</style>", page, re.DOTALL)
    named = {**SURFACES, **INKS, **LINES, **looks.DECORATION}
    known = {colour for pair in named.values() for colour in pair}
    known |= {colour for look in looks_of(METHODS).values() for colour in look.colour}
    assert set(re.findall(r"#[0-9a-fA-F]{3,8}\b(?=[;\s])", style)) <= known
    assert not re.findall(r"\b(?:rgba?|hsla?|color-mix)\(", page)
    assert set(re.findall(r"var\(--([\w-]+)\)", style)) <= set(named) | {f"k{i}" for i in range(4)}
    assert not re.search(r'(?:fill|stroke|color)="(?!none|currentColor)', page.partition("<body>")[2])
