"""The figures. Each function draws what it is given; nothing is computed or chosen here."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter

from nnss_cli.datasets.record import FloatArray
from nnss_cli.datasets.units import titled
from nnss_cli.files import write_atomically

STYLE: Any = {
    "font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "0.9", "axes.axisbelow": True, "legend.frameon": False, "figure.dpi": 100, "savefig.dpi": 200,
    "svg.hashsalt": "nnss",  # equal data, equal file
}  # fmt: skip

FLAT = 0.02  # of the panel's height: boxes below it would be all outline


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
    "nnss-ensemble": MethodStyle("NN-SS ensemble", "#000000", (0, (8, 1)), "--", "X"),
    "nnss-paper": MethodStyle("NN-SS, paper's recipe", "#56B4E9", (0, (2, 2)), "oo", "h"),
    "simba": MethodStyle("SIMBa", "#E69F00", (0, (6, 2)), "//", "s"),
    "n4sid": MethodStyle("N4SID", "#D55E00", (0, (4, 1, 1, 1)), "\\\\", "D"),
    "ssest": MethodStyle("SSEST", "#009E73", (0, (1, 1)), "xx", "^"),
    "ssregest": MethodStyle("SSREGEST", "#CC79A7", (0, (3, 1, 1, 1, 1, 1)), "..", "v"),
}


def style_of(method: str) -> MethodStyle:
    """The method's look; a plain one for a method that has none."""
    return STYLES.get(method, MethodStyle(method, "0.4", "-", "++", "P"))


@dataclass(frozen=True)
class Axis:
    """Name and unit of a signal."""

    name: str
    unit: str

    def __str__(self) -> str:
        return titled(self.name, self.unit)


def draw_boxplot(
    values: Mapping[str, Mapping[str, Mapping[int, Sequence[float]]]],
    labels: Mapping[str, str],
    title: str,
) -> Figure:
    """RMSE over seeds by order and method, logarithmic; the median where there is hardly a spread.

    Args:
        values: panel → method → order → RMSE of each seed.
        labels: panel → what its axis shows.
        title: of the figure.
    """
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, len(values), figsize=(max(4.6, 3.4 * len(values)), 3.4), squeeze=False, layout="constrained"
        )
        methods = list(dict.fromkeys(method for by_method in values.values() for method in by_method))
        boxed = {method for method in methods if any(_has_boxes(by_method, method) for by_method in values.values())}
        for panel, (output, by_method) in zip(panels[0], values.items(), strict=True):
            orders = sorted({order for by_order in by_method.values() for order in by_order})
            width = 0.8 / max(1, len(methods))
            for index, method in enumerate(methods):
                look = style_of(method)
                for position, order in enumerate(orders):
                    sample = by_method.get(method, {}).get(order, [])
                    at = position + (index - (len(methods) - 1) / 2) * width
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
                        panel.plot(
                            at, np.median(sample), look.marker, color=look.colour, markersize=6, markeredgecolor="black"
                        )
            panel.set_xticks(range(len(orders)), [str(order) for order in orders])
            panel.set_xlim(-0.6, len(orders) - 0.4)
            panel.set_yscale("log")
            _few_log_ticks(panel)
            panel.set_xlabel("order n")
            panel.set_ylabel(labels[output])
        handles = [_legend_entry(method, method in boxed) for method in methods]
        figure.legend(handles=handles, loc="outside lower center", ncols=3 if len(values) == 1 else len(handles))
        figure.suptitle(title, fontsize=10)
    return figure


def _has_boxes(by_method: Mapping[str, Mapping[int, Sequence[float]]], method: str) -> bool:
    """Whether a box of the method would be high enough to show a colour, on a panel of these values."""
    everything = [value for by_order in by_method.values() for sample in by_order.values() for value in sample]
    quartiles = [np.quantile(sample, [0.25, 0.75]) for sample in by_method.get(method, {}).values() if sample]
    return max(map(_span, quartiles), default=0.0) > FLAT * _span(everything)


def _span(values: Sequence[float] | FloatArray) -> float:
    """Largest over smallest, logarithmic; 0 for none."""
    return math.log(max(values) / max(min(values), np.finfo(float).tiny)) if max(values, default=0) > 0 else 0.0


def _legend_entry(method: str, as_box: bool) -> Artist:
    look = style_of(method)
    if as_box:
        return Patch(facecolor=look.colour, alpha=0.75, hatch=look.hatch, edgecolor="black", label=look.label)
    return Line2D(
        [],
        [],
        linestyle="",
        marker=look.marker,
        color=look.colour,
        markersize=6,
        markeredgecolor="black",
        label=look.label,
    )


def _few_log_ticks(panel: Any) -> None:
    """Plain numbers on a logarithmic axis that may span less than a decade."""
    low, high = panel.get_ylim()
    if high / low > 20:
        subs: tuple[float, ...] = (1.0, 2.0, 5.0)
    elif high / low > 3:
        subs = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)
    else:
        subs = tuple(np.arange(1.0, 10.0, 1.0 if high / low > 1.6 else 0.5))
    panel.yaxis.set_major_locator(LogLocator(subs=subs, numticks=12))
    panel.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    panel.yaxis.set_minor_formatter(NullFormatter())


def draw_simulation(
    time: FloatArray, measured: FloatArray, simulated: Mapping[str, tuple[str, FloatArray]],
    outputs: Sequence[Axis], time_unit: str, title: str, zoom: slice | None = None, breaks: Sequence[int] = (),
) -> Figure:  # fmt: skip
    """Measured and simulated outputs, one row an output, with a second column for a part of a long record.

    Args:
        time: instants (K,).
        measured: outputs (K, m).
        simulated: method → (what to add to its label, outputs (K, m)).
        outputs: names and units.
        time_unit: unit of `time`.
        title: of the figure.
        zoom: samples of the second column; None for none.
        breaks: samples at which another record begins.
    """
    parts = [slice(None)] if zoom is None else [slice(None), zoom]
    with plt.rc_context(STYLE):
        m = measured.shape[1]
        figure, panels = plt.subplots(
            m, len(parts), figsize=(7.2 if zoom is None else 9.6, 1.2 + 1.9 * m), sharex="col", squeeze=False,
            layout="constrained", width_ratios=[3, 2][: len(parts)],
        )  # fmt: skip
        for i in range(m):
            for part, panel in zip(parts, panels[i], strict=True):
                panel.plot(time[part], measured[part, i], color="black", linewidth=2.2, alpha=0.35, label="measured")
                for method, (detail, y) in simulated.items():
                    look = style_of(method)
                    panel.plot(
                        time[part],
                        y[part, i],
                        color=look.colour,
                        linestyle=look.line,
                        linewidth=1.1,
                        label=f"{look.label} {detail}",
                    )
                panel.margins(x=0.01)
            _mark_breaks(panels[i, 0], time, breaks)
            panels[i, 0].set_ylabel(str(outputs[i]))
            if zoom is not None:  # where the second column stands in the first
                panels[i, 0].axvspan(time[zoom][0], time[zoom][-1], color="0.85", zorder=0)
        for panel in panels[-1]:
            panel.set_xlabel(f"time [{time_unit}]")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        figure.suptitle(title, fontsize=10)
    return figure


def _mark_breaks(panel: Any, time: FloatArray, breaks: Sequence[int]) -> None:
    for at in breaks:
        panel.axvline(time[at], color="0.3", linewidth=0.8, linestyle=(0, (5, 3)))


def draw_states(
    time: FloatArray,
    states: FloatArray,
    measured: FloatArray,
    outputs: Sequence[Axis],
    time_unit: str,
    title: str,
    breaks: Sequence[int] = (),
) -> Figure:
    """Latent states over time, with the measured outputs that they follow above them.

    Args:
        time: instants (K,).
        states: x(k) (K, n).
        measured: outputs (K, m), physical units.
        outputs: names and units.
        time_unit: unit of `time`.
        title: of the figure.
        breaks: samples at which another record begins.
    """
    with plt.rc_context(STYLE):
        n, m = states.shape[1], measured.shape[1]
        figure, panels = plt.subplots(
            n + m, 1, figsize=(7.2, 0.9 + 1.05 * (n + m)), sharex=True, squeeze=False, layout="constrained"
        )
        for i in range(m):
            panels[i, 0].plot(time, measured[:, i], color="black", linewidth=1.0)
            panels[i, 0].set_ylabel(textwrap.fill(str(outputs[i]), 16), fontsize=8)
        for i in range(n):
            panels[m + i, 0].plot(time, states[:, i], color=style_of("nnss").colour, linewidth=1.1)
            panels[m + i, 0].set_ylabel(f"$x_{{{i + 1}}}$ [–]")
        for panel in panels[:, 0]:
            _mark_breaks(panel, time, breaks)
            panel.margins(x=0.01)
            panel.yaxis.set_major_locator(MaxNLocator(3))
        figure.align_ylabels()
        panels[-1, 0].set_xlabel(f"time [{time_unit}]")
        figure.suptitle(title, fontsize=10)
    return figure


def draw_orders(
    orders: Sequence[int],
    hankel: Sequence[float],
    train: Sequence[float | None],
    val: Sequence[float | None],
    chosen: int,
    title: str,
) -> Figure:
    """Hankel singular values and errors by order, the suggested order marked.

    Args:
        orders: model orders.
        hankel: relative Hankel singular value of each.
        train: training error of each, normalised; None where there is no model.
        val: validation error of each.
        chosen: the suggested order.
        title: of the figure.
    """
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 3.2), layout="constrained")
        left.bar(orders, hankel, color="0.55", edgecolor="black", width=0.7)
        left.set_yscale("log")
        left.set_ylabel("Hankel singular value, relative [–]")
        curves = ((train, "training", "s", (0, (4, 2)), "0.45"), (val, "validation", "o", "-", "#0072B2"))
        for errors, label, marker, line, colour in curves:
            known = [(order, error) for order, error in zip(orders, errors, strict=True) if error is not None]
            right.plot(
                *zip(*known, strict=True), color=colour, linestyle=line, marker=marker, markersize=4, label=label
            )
        right.set_ylabel("RMSE/σ of the simulation [–]")
        right.set_ylim(bottom=0)
        right.axvline(chosen, color="black", linewidth=0.8, linestyle=":", label=f"suggested: {chosen}")
        right.legend()
        for panel in (left, right):
            panel.set_xlabel("order n")
            panel.xaxis.set_major_locator(MaxNLocator(integer=True))
        figure.suptitle(title, fontsize=9)
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
            style = style_of(str(method))
            panel.plot([rank, rank, end], [0, height, height], color=style.colour, linewidth=1, linestyle=style.line)
            panel.plot([rank], [0], color=style.colour, marker=style.marker, markersize=4)
            panel.text(
                end + (-0.08 if on_left else 0.08), height, f"{style.label} ({rank:.2f})",
                ha="right" if on_left else "left", va="center",
            )  # fmt: skip
        panel.set_title(title, fontsize=9)
    return figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure atomically and close it; equal figures give equal files."""
    metadata = {"Date": None} if path.suffix == ".svg" else {"Software": None}
    with plt.rc_context(STYLE):
        write_atomically(path, lambda temporary: figure.savefig(temporary, metadata=metadata))


def close_figure(figure: Figure) -> None:
    """Free a figure's memory."""
    plt.close(figure)
