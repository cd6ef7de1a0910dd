"""How figures look: fonts, one look for each method, sizes and file formats."""

from __future__ import annotations

import math
import textwrap
import zlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from nnss_cli.datasets.units import has_unit, titled, unit_in
from nnss_cli.errors import InputError, unknown

STYLE: Any = {
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "0.9", "axes.axisbelow": True, "legend.frameon": False, "figure.dpi": 100, "savefig.dpi": 200,
    "svg.hashsalt": "nnss",  # equal data, equal file
    "pdf.fonttype": 42,  # text stays text
    # a dollar sign is one, since names of channels are the user's; what is a formula says so (`parse_math`)
    "text.parse_math": False, "axes.formatter.use_mathtext": False,
}  # fmt: skip

MEASURED: Any = {"color": "0.78", "linewidth": 3.0, "solid_capstyle": "butt"}
"""A measured signal: a broad pale line under all others, which no method's look resembles, in grey neither."""


def band_look(colour: str) -> dict[str, Any]:
    """A band around a signal of this colour: its limits are lines, since a pale area alone is lost under a measured
    signal, on paper in grey, and where it is narrow."""
    return {"facecolor": (colour, 0.22), "edgecolor": (colour, 0.9), "linewidth": 0.7, "linestyle": (0, (4, 1.5))}


@dataclass(frozen=True)
class MethodStyle:
    """One look per method in every figure; lines and hatches tell them apart in grey."""

    label: str
    colour: str
    line: str | tuple[int, tuple[int, ...]]
    hatch: str
    marker: str


# Okabe–Ito colours, which stay apart for colour-blind readers; lightness differs for print in grey.
STYLES: dict[str, MethodStyle] = {
    "nnss": MethodStyle("NN-SS", "#0072B2", "-", "", "o"),
    "nnss-ensemble": MethodStyle("NN-SS ensemble", "#000000", (0, (7, 2)), "--", "X"),
    "nnss-clipped": MethodStyle("NN-SS ensemble, clipped", "#6A4A5C", (0, (7, 2, 1, 2)), "|-", "p"),
    "nnss-paper": MethodStyle("NN-SS, paper's recipe", "#56B4E9", (0, (2, 2)), "oo", "h"),
    "simba": MethodStyle("SIMBa", "#E69F00", (0, (6, 2)), "//", "s"),
    "n4sid": MethodStyle("N4SID", "#D55E00", (0, (4, 1, 1, 1)), "\\\\", "D"),
    "ssest": MethodStyle("SSEST", "#009E73", (0, (1, 1)), "xx", "^"),
    "ssregest": MethodStyle("SSREGEST", "#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "..", "v"),
}

# For methods of plug-ins: Paul Tol's muted colours.
MORE: tuple[MethodStyle, ...] = (
    MethodStyle("", "#882255", (0, (9, 2, 2, 2)), "++", "P"),
    MethodStyle("", "#999933", (0, (5, 1, 1, 1, 1, 1, 1, 1)), "**", "*"),
    MethodStyle("", "#332288", (0, (2, 1, 5, 1)), "||", "<"),
    MethodStyle("", "#AA4499", (0, (1, 3)), "OO", ">"),
)


def style_of(method: str) -> MethodStyle:
    """The method's look; one of `MORE`, by its name, for a method that has none of its own."""
    return styles_of([method])[method]


def styles_of(methods: Iterable[str]) -> dict[str, MethodStyle]:
    """A look for each method of a figure: its own, or one of `MORE` that no other one there has, while they last."""
    found: dict[str, MethodStyle] = {}
    names = list(dict.fromkeys(methods))
    taken: list[int] = []
    for name in sorted(set(names) - set(STYLES)):
        slot = zlib.crc32(name.encode()) % len(MORE)  # by its name, so that it is the same in all figures
        slot = next((s % len(MORE) for s in range(slot, slot + len(MORE)) if s % len(MORE) not in taken), slot)
        taken.append(slot)
        look = MORE[slot]
        found[name] = MethodStyle(name, look.colour, look.line, look.hatch, look.marker)
    return {name: STYLES.get(name) or found[name] for name in names}


@dataclass(frozen=True)
class Axis:
    """Name and unit of a signal."""

    name: str
    unit: str

    def __str__(self) -> str:
        return titled(self.name, self.unit)


def shortened(text: str, width: int, lines: int = 1) -> str:
    """A text in at most so many lines of `width` characters, cut where it is longer."""
    wrapped = textwrap.wrap(text, width)
    if len(wrapped) > lines:
        wrapped = [*wrapped[: lines - 1], wrapped[lines - 1][: width - 1] + "…"]
    return "\n".join(wrapped)


def axis_label(name: str, unit: str, width: int, lines: int = 3) -> str:
    """A signal with its unit for an axis, in at most so many lines: of a longer name the unit is kept."""
    wrapped = textwrap.wrap(titled(name, unit), width)
    return "\n".join(wrapped) if len(wrapped) <= lines else stacked_label(name, unit, width, lines)


def stacked_label(name: str, unit: str, width: int, lines: int = 3) -> str:
    """A signal, cut to so many lines but one, and its unit in a line below."""
    if not has_unit(unit):
        return shortened(name, width, lines - 1)
    if unit_in(name) == unit:
        name = name[: max(name.rfind("["), name.rfind("("))].strip()
    return f"{shortened(name, width, lines - 1)}\n{shortened(f'[{unit}]', width)}"


FORMATS = ("png", "svg", "pdf")
WIDTHS = {1: 3.5, 2: 7.16}
"""Columns of a paper → width [inch]."""


PAGE = 9.2
"""Height of a page's text [inch]."""


@dataclass(frozen=True)
class Look:
    """What figures are written as."""

    formats: tuple[str, ...] = ()
    """Of `FORMATS`; () for PNG, and SVG of the box plot."""
    columns: int | None = None
    """Columns of a paper that a figure is as wide as, 1 or 2; None for a screen."""

    def __post_init__(self) -> None:
        """Refuse what there is not.

        Raises:
            InputError: an unknown format, or another number of columns.
        """
        for name in self.formats:
            if name not in FORMATS:
                raise unknown("format", name, FORMATS)
        if self.columns is not None and self.columns not in WIDTHS:
            raise InputError(f"--columns: expected 1 or 2, found {self.columns}")

    @property
    def width(self) -> float | None:
        """Of a figure [inch]; None for what a screen has room for."""
        return None if self.columns is None else WIDTHS[self.columns]

    def height(self, wanted: float) -> float:
        """Of a figure [inch]: what it asks for, on paper no more than a page has."""
        return wanted if self.columns is None else min(wanted, PAGE)

    @property
    def style(self) -> Any:
        """`STYLE` with letters for that width: 8 pt across a page, 7 pt in a column, as papers ask."""
        return STYLE | ({} if self.columns is None else {"font.size": {1: 7, 2: 8}[self.columns]})


SCREEN = Look()
"""Figures for a screen, in the usual formats."""


TICK_STEPS = [1, 2, 2.5, 5, 10]
"""Steps between the numbers of a linear axis."""


def legend_columns(entries: int, most: int) -> int:
    """Columns of a legend, at most so many, such that no row holds a single entry where that can be helped."""
    rows = math.ceil(entries / most)
    for columns in range(math.ceil(entries / rows), 1, -1):
        if entries % columns != 1:
            return columns
    return max(1, math.ceil(entries / rows))


def log_ticks(low: float, high: float, most: int = 6) -> list[float]:
    """Plain numbers for a logarithmic axis, two at least, wherever it lies and however short it is."""
    decades = range(math.floor(math.log10(low)), math.floor(math.log10(high)) + 1)
    coarse: Sequence[Sequence[float]] = (
        (1,), (1, 3), (1, 2, 5), (1, 1.5, 2, 3, 5, 7), (1, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9),
    )  # fmt: skip
    best: list[float] = []
    for steps in coarse:
        ticks = [step * 10.0**decade for decade in decades for step in steps]
        ticks = [float(f"{tick:.3g}") for tick in ticks if low <= tick <= high]
        if len(ticks) > most:
            break
        best = ticks
    if len(decades) > most and not best:
        every = math.ceil(len(decades) / most)
        best = [10.0**decade for decade in decades if decade % every == 0 and low <= 10.0**decade <= high]
    return best if len(best) >= 3 or (len(decades) > 2 and len(best) >= 2) else _linear_ticks(low, high, most)


def _linear_ticks(low: float, high: float, most: int) -> list[float]:
    """As many round numbers as fit: for an axis of less than half a decade, where logarithms are nearly straight."""
    for exponent in range(math.floor(math.log10(high - low)) - 2, math.floor(math.log10(high)) + 1):
        for step in (1, 2, 5):
            width = step * 10.0**exponent
            first, last = math.ceil(low / width - 1e-9), math.floor(high / width + 1e-9)
            if last - first + 1 <= most:
                return [float(f"{k * width:.12g}") for k in range(first, last + 1) if k > 0]
    return []
