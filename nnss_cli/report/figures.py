"""Figures of errors: box plots, orders, ranks. Each function draws what it is given; nothing is computed here."""

from __future__ import annotations

import math
import re
import textwrap
import warnings
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullFormatter, NullLocator

from nnss_cli.datasets.record import FloatArray
from nnss_cli.errors import FontWarning
from nnss_cli.files import write_atomically
from nnss_cli.report.style import SCREEN, STYLE, Look, MethodStyle, legend_columns, log_ticks, styles_of

FLAT = 0.02  # of the panel's height: boxes below it would be all outline
PANEL = 2.3  # inches that a panel of the box plot needs, at least
GLYPH = "Glyph .* missing from"  # how matplotlib warns of a letter that the font does not have


def draw_boxplot(
    values: Mapping[str, Mapping[str, Mapping[int, Sequence[float]]]],
    labels: Mapping[str, str],
    title: str,
    titles: Mapping[str, str] | None = None,
    look: Look = SCREEN,
) -> Figure:
    """RMSE over seeds by order and method, logarithmic; the median where there is hardly a spread.

    Args:
        values: panel → method → order → RMSE of each seed.
        labels: panel → what its axis shows.
        title: of the figure.
        titles: panel → what stands above it; nothing unless given.
        look: size of the figure.
    """
    width = look.width or max(4.6, 3.4 * min(len(values), 3))
    across = min(len(values), 3, max(1, int(width / PANEL)))
    down = math.ceil(len(values) / across)
    height = 1.0 + 2.4 * down if look.width else 0.6 + 2.8 * down
    methods = list(dict.fromkeys(method for by_method in values.values() for method in by_method))
    looks = styles_of(methods)
    boxed = {method for method in methods if any(_has_boxes(by_method, method) for by_method in values.values())}
    with plt.rc_context(look.style):
        figure, panels = plt.subplots(
            down,
            across,
            figsize=(width, look.height(height)),
            squeeze=False,
            layout=ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.06),
        )
        for panel in panels.flat[len(values) :]:
            panel.remove()
        for panel, (name, by_method) in zip(panels.flat, values.items(), strict=False):
            _draw_boxes(panel, by_method, looks, boxed)
            panel.set_xlabel("order n")
            panel.set_ylabel(labels[name])
            if titles:
                panel.set_title(titles[name], fontsize="medium")
        handles = [_legend_entry(looks[method], method in boxed) for method in methods]
        add_legend(figure, handles, 3 if across == 1 else 4 if across == 2 else 6)
        figure.suptitle(wrapped(title, width), fontsize="large")
    return figure


def _draw_boxes(
    panel: Any, by_method: Mapping[str, Mapping[int, Sequence[float]]], looks: Mapping[str, MethodStyle],
    boxed: set[str],
) -> None:  # fmt: skip
    """A panel of the box plot: a box or a marker for each method and order."""
    orders = sorted({order for by_order in by_method.values() for order in by_order})
    width = 0.8 / max(1, len(looks))
    for index, (method, look) in enumerate(looks.items()):
        for position, order in enumerate(orders):
            sample = by_method.get(method, {}).get(order, [])
            at = position + (index - (len(looks) - 1) / 2) * width
            if sample and method in boxed:
                box = panel.boxplot(
                    [sample], positions=[at], widths=0.85 * width, patch_artist=True,
                    medianprops={"color": "black", "linewidth": 1.4},
                    flierprops={"marker": "o", "markersize": 3, "markeredgecolor": look.colour},
                )  # fmt: skip
                box["boxes"][0].set(facecolor=look.colour, alpha=0.75, hatch=look.hatch, edgecolor="black")
            elif sample:
                # boxes too flat to show a colour: a marker of the method's own, and the range behind it
                panel.plot([at, at], [min(sample), max(sample)], color="black", linewidth=1)
                panel.plot(at, np.median(sample), look.marker, color=look.colour, markersize=6, markeredgecolor="black")
    panel.set_xticks(range(len(orders)), [str(order) for order in orders])
    panel.set_xlim(-0.6, len(orders) - 0.4)
    panel.set_yscale("log")
    few_log_ticks(panel.yaxis)


def wrapped(title: str, width: float) -> str:
    """A title in lines that fit into so many inches, as few as can be, and of about the same length."""
    return "\n".join(_balanced(line, int(width * 12.5)) for line in title.splitlines())


def _balanced(text: str, most: int) -> str:
    """In the fewest lines of `most` characters, each as short as that allows."""
    fewest = len(textwrap.wrap(text, most))
    longest_word = max(map(len, text.split()), default=1)
    shortest = next(n for n in range(min(longest_word, most), most + 1) if len(textwrap.wrap(text, n)) <= fewest)
    return textwrap.fill(text, shortest)


def add_legend(figure: Figure, handles: Sequence[Artist], most: int) -> None:
    figure.legend(handles=list(handles), loc="outside lower center", ncols=legend_columns(len(handles), most))


def _has_boxes(by_method: Mapping[str, Mapping[int, Sequence[float]]], method: str) -> bool:
    """Whether a box of the method would be high enough to show a colour, on a panel of these values."""
    everything = [value for by_order in by_method.values() for sample in by_order.values() for value in sample]
    quartiles = [np.quantile(sample, [0.25, 0.75]) for sample in by_method.get(method, {}).values() if sample]
    return max(map(_span, quartiles), default=0.0) > FLAT * _span(everything)


def _span(values: Sequence[float] | FloatArray) -> float:
    """Largest over smallest, logarithmic; 0 for none."""
    return math.log(max(values) / max(min(values), np.finfo(float).tiny)) if max(values, default=0) > 0 else 0.0


def _legend_entry(look: MethodStyle, as_box: bool) -> Artist:
    if as_box:
        return Patch(facecolor=look.colour, alpha=0.75, hatch=look.hatch, edgecolor="black", label=look.label)
    return Line2D(
        [], [], linestyle="", marker=look.marker, color=look.colour, markersize=6, markeredgecolor="black",
        label=look.label,
    )  # fmt: skip


def few_log_ticks(axis: Any, most: int = 6) -> None:
    """Plain numbers on a logarithmic axis, with its limits as they are now; it may span less than a decade."""
    low, high = axis.axes.get_ylim() if axis.axis_name == "y" else axis.axes.get_xlim()
    axis.set_major_locator(FixedLocator(log_ticks(low, high, most)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_locator(NullLocator())
    axis.set_minor_formatter(NullFormatter())


def draw_orders(
    orders: Sequence[int],
    hankel: Sequence[float],
    train: Sequence[float | None],
    val: Sequence[float | None],
    chosen: int,
    measure: str,
    title: str,
) -> Figure:
    """Hankel singular values and errors by order, the suggested order marked.

    Args:
        orders: model orders.
        hankel: relative Hankel singular value of each.
        train: training error of each, normalised; None where there is no model.
        val: validation error of each.
        chosen: the suggested order.
        measure: what the errors are.
        title: of the figure.
    """
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.2), layout="constrained")
        left.bar(orders, hankel, color="0.55", edgecolor="black", width=0.7)
        left.set_yscale("log")
        few_log_ticks(left.yaxis)
        left.set_ylabel("Hankel singular value, relative [–]")
        curves = ((train, "training", "s", (0, (4, 2)), "0.45"), (val, "validation", "o", "-", "#0072B2"))
        for errors, label, marker, line, colour in curves:
            known = [(order, error) for order, error in zip(orders, errors, strict=True) if error is not None]
            right.plot(
                *zip(*known, strict=True), color=colour, linestyle=line, marker=marker, markersize=4, label=label
            )
        right.set_ylabel(f"{measure} [–]")
        right.set_ylim(0, 1.08 * (right.dataLim.ymax or 1))
        right.axvline(chosen, color="black", linewidth=0.8, linestyle=":", label=f"suggested: {chosen}")
        right.legend()
        for panel in (left, right):
            panel.set_xlabel("order n")
            panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.suptitle(wrapped(title, 7.2), fontsize=9)
    return figure


def cliques(methods: Sequence[str], level: Sequence[tuple[str, str]]) -> list[tuple[int, int]]:
    """First and last position of each longest run of methods of which no two are shown to differ, of two or more.

    Args:
        methods: in the order of their ranks.
        level: pairs that are not shown to differ.
    """
    same = {frozenset(pair) for pair in level}
    found: list[tuple[int, int]] = []
    for i in range(len(methods)):
        j = i
        while j + 1 < len(methods) and all(frozenset((methods[a], methods[j + 1])) in same for a in range(i, j + 1)):
            j += 1
        if j > i and (not found or j > found[-1][1]):
            found.append((i, j))
    return found


def draw_ranks(ranks: pd.Series, level: Sequence[tuple[str, str]], title: str) -> Figure:
    """Critical-difference diagram: mean ranks on a line; a bar joins methods that are not shown to differ.

    Args:
        ranks: mean rank by method, ascending.
        level: pairs that are not shown to differ.
        title: of the figure.
    """
    k = len(ranks)
    values = ranks.to_numpy()
    groups = cliques([str(name) for name in ranks.index], level)
    left = (k + 1) // 2
    looks = styles_of(map(str, ranks.index))
    with plt.rc_context(STYLE):
        rows = max(left, k - left)
        figure, panel = plt.subplots(figsize=(7.2, 1.3 + 0.24 * (rows + len(groups))), layout="constrained")
        panel.axis("off")
        panel.set_xlim(0.2 - 0.25 * k, 1.25 * k + 0.8)
        low = -0.5 - 0.35 * len(groups)
        panel.set_ylim(low - 0.6 * rows - 0.2, 1.0)
        panel.plot([1, k], [0, 0], color="black", linewidth=1)
        for tick in range(1, k + 1):
            panel.plot([tick, tick], [0, 0.18], color="black", linewidth=1)
            panel.text(tick, 0.28, str(tick), ha="center", va="bottom")
        for index, (i, j) in enumerate(groups):
            height = -0.35 - 0.35 * index
            panel.plot([values[i] - 0.05, values[j] + 0.05], [height, height], color="0.35", linewidth=3.5)
        for position, (method, rank) in enumerate(ranks.items()):
            on_left = position < left
            height = low - 0.6 * (position if on_left else k - 1 - position)
            end = 0.8 if on_left else k + 0.2
            style = looks[str(method)]
            panel.plot([rank, rank, end], [0, height, height], color=style.colour, linewidth=1, linestyle=style.line)
            panel.plot([rank], [0], color=style.colour, marker=style.marker, markersize=4)
            panel.text(
                end + (-0.08 if on_left else 0.08), height, f"{style.label} ({rank:.2f})",
                ha="right" if on_left else "left", va="center",
            )  # fmt: skip
        panel.set_title(title, fontsize=9)
    return figure


def save_figure(figure: Figure, *paths: Path) -> None:
    """Write a figure to each of these files, atomically, and close it; equal figures give equal files.

    Letters that the font does not have are boxes; a `FontWarning` says so once, not a warning of each letter.
    """
    for path in paths:
        metadata = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(path.suffix, {"Software": None})
        with plt.rc_context(STYLE), warnings.catch_warnings(record=True) as told:
            warnings.filterwarnings("always", GLYPH)
            write_atomically(path, partial(figure.savefig, metadata=metadata))
        for warning in told:
            if re.match(GLYPH, str(warning.message)):
                _tell_of_the_font()
            else:
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    plt.close(figure)


@cache
def _tell_of_the_font() -> None:
    warnings.warn(
        "figures: the font has no letters for some names, which are boxes there; tables have them as they are. For "
        "figures, name the columns in letters of Latin, Greek or Cyrillic",
        FontWarning, stacklevel=3,
    )  # fmt: skip
