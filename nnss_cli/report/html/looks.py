"""Colours of the page, light and dark, and a look for each method: a colour, a dash and a marker.

Whoever sees no colours, or prints in grey, tells methods apart by dash and marker. Text has a contrast of 4.5 to what
it stands on and lines one of 3, as WCAG 2.2 AA asks (1.4.3, 1.4.11).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nnss_cli.report.style import style_of

SURFACES: dict[str, tuple[str, str]] = {
    "page": ("#ffffff", "#14181d"),
    "card": ("#f4f6f8", "#1e242b"),
    "mark": ("#fff3cd", "#4a3d10"),
}
"""Name → colour of what text stands on, light and dark."""

INKS: dict[str, tuple[str, str]] = {
    "text": ("#1a1f24", "#e8ecf0"),
    "soft": ("#4d5761", "#b3bdc7"),
    "link": ("#00579c", "#7cc0ff"),
}
"""Name → colour of text, light and dark."""

LINES: dict[str, tuple[str, str]] = {
    "axis": ("#6b757f", "#8a949e"),
    "focus": ("#b3261e", "#ffb4a9"),
    "measured": ("#808890", "#99a2ab"),
}
"""Name → colour of lines that mean something, light and dark."""

DECORATION: dict[str, tuple[str, str]] = {"grid": ("#dde2e7", "#333b44")}
"""Name → colour of lines that mean nothing by themselves."""

SHAPES = {
    "circle": "M5 1a4 4 0 1 0 0 8a4 4 0 1 0 0-8z",
    "cross": "M2 0.5L5 3.5L8 0.5L9.5 2L6.5 5L9.5 8L8 9.5L5 6.5L2 9.5L0.5 8L3.5 5L0.5 2z",
    "ring": "M5 0.5a4.5 4.5 0 1 0 0 9a4.5 4.5 0 1 0 0-9zM5 3a2 2 0 1 1 0 4a2 2 0 1 1 0-4z",
    "square": "M1.3 1.3H8.7V8.7H1.3z",
    "pentagon": "M5 0.5L9.5 3.9L7.8 9.3H2.2L0.5 3.9z",
    "diamond": "M5 0.2L9.4 5L5 9.8L0.6 5z",
    "triangle": "M5 0.8L9.5 9H0.5z",
    "wedge": "M5 9.2L9.5 1H0.5z",
    "plus": "M3.6 0.5H6.4V3.6H9.5V6.4H6.4V9.5H3.6V6.4H0.5V3.6H3.6z",
    "bar": "M3 0.5H7V9.5H3z",
    "beam": "M0.5 3H9.5V7H0.5z",
    "star": "M5 0.2L6.4 3.6L10 3.9L7.2 6.2L8.1 9.7L5 7.8L1.9 9.7L2.8 6.2L0 3.9L3.6 3.6z",
}
"""Name → outline of a marker, in a box of 10."""


@dataclass(frozen=True)
class Look:
    """How a method is drawn."""

    method: str
    """Its name, as in the runs."""
    label: str
    """Its name in figures."""
    colour: tuple[str, str]
    """Of lines and markers, light and dark."""
    dash: str
    """Dashes and gaps, as SVG takes them; "" for a line without gaps."""
    marker: str
    """One of `SHAPES`."""
    key: int
    """Its number on this page, which its styles are named by: a method's name is no safe name of a style."""


KNOWN: dict[str, tuple[tuple[str, str], str, str]] = {
    "nnss": (("#0060a8", "#5ab0f0"), "", "circle"),
    "nnss-ensemble": (("#101418", "#f2f5f8"), "14 3", "cross"),
    "nnss-clipped": (("#6a4a5c", "#d0b3c4"), "14 3 2 3", "pentagon"),
    "nnss-paper": (("#3a86b8", "#9cd2f5"), "2 2", "star"),
    "simba": (("#a86a00", "#f0b429"), "8 3", "square"),
    "n4sid": (("#b03a00", "#ff8f52"), "6 2 1.5 2", "diamond"),
    "ssest": (("#007a58", "#3cc79a"), "1.5 2", "triangle"),
    "ssregest": (("#a8487f", "#e9a2cb"), "5 2 1.5 2 1.5 2", "wedge"),
}
"""Method → colours, dash, marker."""

OTHERS: tuple[tuple[tuple[str, str], str, str], ...] = (
    (("#6b6b00", "#c9c75a"), "10 2 2 2", "plus"),
    (("#7a4a2b", "#d8a47f"), "4 4", "ring"),
    (("#5b4fc4", "#b0a8ff"), "12 2 2 2 2 2", "bar"),
    (("#5c6670", "#b9c2cb"), "3 1", "beam"),
)
"""The looks of methods that have none of their own, in turn."""


def looks_of(methods: Sequence[str]) -> dict[str, Look]:
    """A look for each method, all different as long as there are no more than four that have none of their own."""
    found = {}
    strangers = [name for name in methods if name not in KNOWN]
    for key, name in enumerate(methods):
        colour, dash, marker = KNOWN[name] if name in KNOWN else OTHERS[strangers.index(name) % len(OTHERS)]
        found[name] = Look(name, style_of(name).label, colour, dash, marker, key)
    return found


def variables(looks: Sequence[Look], dark: bool) -> dict[str, str]:
    """The page's colours by the name of their CSS variable."""
    theme = int(dark)
    named = SURFACES | INKS | LINES | DECORATION
    return {name: pair[theme] for name, pair in named.items()} | {f"k{look.key}": look.colour[theme] for look in looks}


def contrast(first: str, second: str) -> float:
    """Contrast of two colours '#rrggbb', 1 to 21, as WCAG 2.2 defines it."""
    bright, dim = sorted((_luminance(first), _luminance(second)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


def _luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]
