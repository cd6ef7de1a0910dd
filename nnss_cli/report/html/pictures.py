"""Box plots over seeds and training curves, as pictures of a fixed size."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from nnss_cli.report.html.looks import SHAPES, Look
from nnss_cli.report.html.svg import Axis, axis_of, few, path, tag
from nnss_cli.report.statistics import quantile
from nnss_cli.report.tables import number

LEFT, RIGHT, TOP, BOTTOM = 62, 10, 10, 40
HEIGHT = 240
SLOT = 17
CURVE_WIDTH, CURVE_HEIGHT = 300, 190
CURVE_BINS = 30


@dataclass(frozen=True)
class Picture:
    """A picture with its caption."""

    title: str
    """What it shows."""
    svg: Markup
    """The picture."""
    method: Look | None = None
    """Of the only method that it shows."""
    order: int = 0
    """The only order that it shows."""


def symbols(looks: Sequence[Look]) -> Markup:
    """Markers and keys of legends, once: the page refers to them."""
    parts = []
    for look in looks:
        marker = tag("path", d=SHAPES[look.marker], class_=f"k{look.key} marker")
        parts.append(tag("symbol", marker, id=f"m{look.key}", viewBox="0 0 10 10", overflow="visible"))
        line = tag("line", x1=1, y1=7, x2=35, y2=7, class_=f"k{look.key} line", stroke_dasharray=look.dash or None)
        parts.append(tag("symbol", line, _use(look, 13, 2, 10), id=f"l{look.key}", viewBox="0 0 36 14"))
    return tag("svg", *parts, width=0, height=0, class_="symbols", aria_hidden="true")


def glyph(look: Look, x: float = 5, y: float = 5, size: float = 9) -> Markup:
    """A method's marker around a point."""
    return _use(look, x - size / 2, y - size / 2, size)


def _use(look: Look, x: float, y: float, size: float) -> Markup:
    return tag("use", href=f"#m{look.key}", x=f"{x:.4g}", y=f"{y:.4g}", width=size, height=size)


def key(look: Look) -> Markup:
    """A method's line and marker, for a legend."""
    return tag("svg", tag("use", href=f"#l{look.key}"), class_="key", aria_hidden="true")


def draw_boxes(name: str, title: str, axis_title: str, values: Mapping[Look, Mapping[int, Sequence[float]]]) -> Picture:
    """Errors over seeds by order and method, logarithmic: quartiles as a box, the range, every seed, the median.

    Args:
        name: unique on the page.
        title: what it shows.
        axis_title: of the vertical axis.
        values: method → order → error of each seed; ∞, at the top, for a run without a result.
    """
    orders = sorted({order for by_order in values.values() for order in by_order})
    width = LEFT + RIGHT + SLOT * (len(values) + 1) * len(orders)
    bottom = HEIGHT - BOTTOM
    axis = axis_of([v for by_order in values.values() for sample in by_order.values() for v in sample], True)

    def y(value: float) -> float:
        return TOP if math.isinf(value) else bottom - float(axis(value)) * (bottom - TOP)

    parts = _frame(axis, width, bottom, axis_title)
    for position, order in enumerate(orders):
        start = LEFT + SLOT * (len(values) + 1) * position
        middle = start + SLOT * (len(values) + 1) / 2
        if position:
            parts.append(tag("line", x1=start, x2=start, y1=TOP, y2=bottom, class_="grid"))
        parts.append(tag("text", order, x=f"{middle:g}", y=bottom + 15, text_anchor="middle"))
        for index, (look, by_order) in enumerate(values.items()):
            if any(map(math.isfinite, by_order.get(order, ()))):
                parts.append(_box(look, order, start + SLOT * (index + 1), by_order[order], y))
    parts.append(
        tag("text", "order n", x=f"{(LEFT + width - RIGHT) / 2:g}", y=HEIGHT - 8, text_anchor="middle", class_="soft")
    )
    words = "The table of this record has the same numbers."
    return Picture(title, _picture(name, title, words, width, HEIGHT, parts))


def _box(look: Look, order: int, x: float, sample: Sequence[float], y: Callable[[float], float]) -> Markup:
    """As in the table, a run without a result is ∞, at the top of the picture."""
    q1, median, q3 = (quantile(sample, q) for q in (0.25, 0.5, 0.75))
    low, high = min(sample), max(sample)
    said = f"{look.label}, n = {order}: median {number(median)}"
    if len(sample) > 1:
        said += f", quartiles {number(q1)} to {number(q3)}, range {number(low)} to {number(high)}"
    said += f", {sum(map(math.isfinite, sample))} of {len(sample)} runs"
    parts = [tag("title", said)]
    if len(sample) > 1:
        height = max(y(q1) - y(q3), 0.5)
        parts += [
            tag("line", x1=x, x2=x, y1=f"{y(low):.1f}", y2=f"{y(high):.1f}", class_="whisker"),
            tag("rect", x=x - 5.5, width=11, y=f"{y(q3):.1f}", height=f"{height:.1f}", class_="box"),
            tag("path", d="".join(f"M{x} {y(v):.1f}h0" for v in sample if math.isfinite(v)), class_="seed"),
        ]
    parts.append(glyph(look, x, y(median)))
    return tag("g", *parts, class_=f"k{look.key}", data_method=look.key, data_order=order)


def draw_curves(
    name: str, title: str, axis_title: str, look: Look, order: int, histories: Mapping[int, Sequence[float]]
) -> Picture:
    """A value over the epochs, a line for each seed, logarithmic.

    Args:
        name: unique on the page.
        title: what it shows.
        axis_title: of the vertical axis.
        look: the method's.
        order: of the models.
        histories: seed → value of each epoch.
    """
    bottom, right = CURVE_HEIGHT - BOTTOM, CURVE_WIDTH - RIGHT
    finite = {seed: np.asarray(own, dtype=float) for seed, own in histories.items()}
    axis = axis_of([value for own in finite.values() for value in own], True)
    epochs = Axis(0.0, float(max(max(map(len, finite.values())), 2)))

    def place(a: float, b: float) -> tuple[float, float]:
        return 10 * (LEFT + a * (right - LEFT)), 10 * (bottom - b * (bottom - TOP))

    parts = _frame(axis, CURVE_WIDTH, bottom, axis_title)
    for tick in epochs.ticks(4):
        at = LEFT + tick.at / 100 * (right - LEFT)
        parts.append(tag("text", tick.label, x=f"{at:.1f}", y=bottom + 15, text_anchor="middle"))
    parts.append(tag("text", "epoch", x=(LEFT + right) / 2, y=CURVE_HEIGHT - 8, text_anchor="middle", class_="soft"))
    for seed, values in finite.items():
        if np.isfinite(values).all():
            where, shown = few(values, CURVE_BINS)
        else:
            where, shown = np.arange(len(values), dtype=float), values
        lowest = int(np.nanargmin(values)) if np.isfinite(values).any() else 0
        said = f"seed {seed}: {len(values)} epochs, lowest {number(float(values[lowest]))} at epoch {lowest + 1}"
        line = path(epochs(where + 1), axis(shown), place)
        parts.append(tag("path", tag("title", said), d=line, transform="scale(0.1)", class_=f"k{look.key} curve"))
    words = f"{len(finite)} seeds; " + "; ".join(
        f"seed {seed} ends after {len(own)} epochs at {number(float(own[-1]))}" for seed, own in finite.items()
    )
    return Picture(title, _picture(name, title, words, CURVE_WIDTH, CURVE_HEIGHT, parts), look, order)


def _frame(axis: Axis, width: float, bottom: float, title: str) -> list[Markup]:
    parts = [tag("line", x1=LEFT, x2=LEFT, y1=TOP, y2=bottom, class_="axis")]
    parts.append(tag("line", x1=LEFT, x2=width - RIGHT, y1=bottom, y2=bottom, class_="axis"))
    for tick in axis.ticks():
        y = bottom - tick.at / 100 * (bottom - TOP)
        parts.append(tag("line", x1=LEFT, x2=width - RIGHT, y1=f"{y:.1f}", y2=f"{y:.1f}", class_="grid"))
        parts.append(tag("text", tick.label, x=LEFT - 5, y=f"{y + 4:.1f}", text_anchor="end"))
    middle = (TOP + bottom) / 2
    parts.append(
        tag("text", title, x=12, y=middle, transform=f"rotate(-90 12 {middle:g})", text_anchor="middle", class_="soft")
    )
    return parts


def _picture(name: str, title: str, words: str, width: float, height: float, parts: Sequence[Markup]) -> Markup:
    return tag(
        "svg", tag("title", title, id=f"{name}-title"), tag("desc", words, id=f"{name}-desc"), *parts,
        viewBox=f"0 0 {width:g} {height:g}", width=f"{width:g}", height=f"{height:g}", role="img",
        aria_labelledby=f"{name}-title", aria_describedby=f"{name}-desc", class_="picture",
    )  # fmt: skip
