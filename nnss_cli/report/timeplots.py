"""Figures of signals over time: simulations and states. Each function draws what it is given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nnss_cli.datasets.record import FloatArray
from nnss_cli.datasets.units import has_unit
from nnss_cli.report.dense import envelope, is_dense, rms, thinned
from nnss_cli.report.figures import add_legend, wrapped
from nnss_cli.report.style import MEASURED, SCREEN, TICK_STEPS, Axis, Look, axis_label, shortened, style_of, styles_of

ROOM = 1.5  # ranges of the measured output that a panel reaches beyond it
ENVELOPE = "envelope: least and largest values"


def draw_simulation(
    time: FloatArray, measured: FloatArray, simulated: Mapping[str, tuple[str, FloatArray]],
    outputs: Sequence[Axis], time_unit: str, title: str, zoom: slice | None = None, breaks: Sequence[int] = (),
    inputs: Sequence[tuple[Axis, FloatArray]] = (), residuals: bool = False, look: Look = SCREEN,
) -> Figure:  # fmt: skip
    """Measured and simulated outputs, one row an output, with a part of a long record beside the whole.

    A record whose line would be a band of ink is drawn by its envelope: the least and largest values of each piece.

    Args:
        time: instants (K,).
        measured: outputs (K, m).
        simulated: method → (what to add to its label, outputs (K, m)).
        outputs: names and units.
        time_unit: unit of `time`.
        title: of the figure.
        zoom: samples of the part; None for none. In a single column of a paper it stands below the whole.
        breaks: samples at which another record begins.
        inputs: name and samples (K,) of each, in panels below; several share one, each over its range.
        residuals: whether a panel below each output shows measured minus simulated; of an envelope its rms.
        look: size of the figure.
    """
    m = measured.shape[1]
    parts = [slice(None)] if zoom is None else [slice(None), zoom]
    looks = styles_of(simulated)
    heights = [1.9, 0.95] * m if residuals else [1.9] * m
    if inputs:
        heights.append(0.95 if len(inputs) == 1 else 0.5 + 0.3 * len(inputs))
    below = look.columns == 1 and zoom is not None
    width = look.width or (7.2 if zoom is None else 9.6)
    height = (1.2 + sum(heights) * (2 if below else 1)) * (0.85 if look.width else 1.0)
    with plt.rc_context(look.style):
        figure = plt.figure(figsize=(width, look.height(height)), layout="constrained")
        columns = _stacked(figure, heights, len(parts)) if below else _beside(figure, heights, len(parts))
        for panels, part in zip(columns, parts, strict=True):
            t = time[part]
            bands = False
            for i in range(m):
                row = i * (2 if residuals else 1)
                dense = is_dense(measured[part, i])
                bands = bands or dense
                draw_line(panels[row], t, measured[part, i], dense, label="measured", **MEASURED)
                for method, (detail, y) in simulated.items():
                    own = looks[method]
                    style: dict[str, Any] = {"color": own.colour, "linestyle": own.line, "linewidth": 1.1}
                    draw_line(panels[row], t, y[part, i], dense, label=f"{own.label} {detail}", **style)
                    if residuals:
                        error = measured[part, i] - y[part, i]
                        style = style | {"linewidth": 0.9}
                        panels[row + 1].plot(*(rms(t, error) if dense else thinned(t, error)), **style)
                _keep_in_view(
                    panels[row], panels[row + 1] if residuals else None, t, measured[part, i],
                    {looks[method].label: y[part, i] for method, (_, y) in simulated.items()}, dense,
                )  # fmt: skip
                panels[row].set_ylabel(axis_label(outputs[i].name, outputs[i].unit, 24))
                if residuals:
                    panels[row + 1].axhline(0, color="0.3", linewidth=0.6)
                    panels[row + 1].set_ylabel(f"residual{', rms' * dense}{_unit(outputs[i])}")
            if inputs:
                _draw_inputs(panels[-1], t, [(axis, u[part]) for axis, u in inputs])
            if bands:
                panels[0].set_title(ENVELOPE, fontsize="small", loc="left")
            elif panels is not columns[0]:
                panels[0].set_title("a part of it", fontsize="small", loc="left")
            if not bands and any(is_dense(u[part]) for _, u in inputs):
                panels[-1].set_title(ENVELOPE, fontsize="small", loc="left")
            for panel in panels:
                panel.margins(x=0.01)
                panel.yaxis.set_major_locator(MaxNLocator(4, steps=TICK_STEPS)) if not panel.get_label() else None
            panels[-1].set_xlabel(f"time [{time_unit}]")
            figure.align_ylabels(panels[:-1] if len(inputs) > 1 else panels)
        for panel in columns[0]:
            _mark_breaks(panel, time, breaks)
            if zoom is not None:  # where the part stands in the whole
                panel.axvspan(time[zoom][0], time[zoom][-1], color="0.93", zorder=0)
        if zoom is not None:  # a short part of a long record has long numbers
            columns[1][-1].xaxis.set_major_locator(MaxNLocator(4, steps=TICK_STEPS))
        add_legend(figure, columns[0][0].get_legend_handles_labels()[0], 2 if look.columns == 1 else 4)
        figure.suptitle(wrapped(title, width), fontsize="large")
    return figure


def _keep_in_view(
    panel: Any, below: Any, time: FloatArray, measured: FloatArray, simulated: Mapping[str, FloatArray], dense: bool
) -> None:
    """Cut the axes of an output and its residuals where a simulation goes so far that the others could not be seen.

    A panel reaches `ROOM` ranges of the measured output beyond it, at most, and names what leaves it.
    """
    low, high = float(measured.min()), float(measured.max())
    room = ROOM * (high - low)
    away = [name for name, y in simulated.items() if y.min() < low - room or y.max() > high + room]
    if not away or room == 0:
        return
    inside = [np.clip(y, low - room, high + room) for y in simulated.values()]
    panel.set_ylim(*_with_margin([measured, *inside]))
    panel.set_title(f"leaving the panel: {', '.join(away)}", fontsize="small", loc="right")
    if below is not None:
        errors = [measured - y for y in inside]
        below.set_ylim(*_with_margin([rms(time, error)[1] for error in errors] if dense else errors))


def _with_margin(values: Sequence[FloatArray]) -> tuple[float, float]:
    low, high = min(float(v.min()) for v in values), max(float(v.max()) for v in values)
    return low - 0.05 * (high - low), high + 0.05 * (high - low)


def _beside(figure: Figure, heights: Sequence[float], parts: int) -> list[list[Any]]:
    """Panels of each part in a column of its own."""
    panels = figure.subplots(
        len(heights), parts, sharex="col", squeeze=False, width_ratios=[3, 2][:parts], height_ratios=heights
    )
    return [list(column) for column in panels.T]


def _stacked(figure: Figure, heights: Sequence[float], parts: int) -> list[list[Any]]:
    """Panels of each part below those of the one before, with a time axis of their own."""
    panels = figure.subplots(len(heights) * parts, 1, squeeze=False, height_ratios=[*heights] * parts)[:, 0]
    blocks = [list(block) for block in np.split(panels, parts)]
    for *others, last in blocks:
        for panel in others:
            panel.sharex(last)
            panel.tick_params(labelbottom=False)
    return blocks


def draw_line(panel: Any, time: FloatArray, values: FloatArray, dense: bool, alone: bool = False, **style: Any) -> None:
    """A signal as a line, or by its envelope: filled where it is the measured one or stands alone, else its edges."""
    if not dense:
        panel.plot(*thinned(time, values), **style)
        return
    edges = envelope(time, values)
    if alone or style.get("label") == "measured":
        look = {"color": style["color"], "linewidth": 0.6} if alone else {"color": "0.85", "linewidth": 0}
        panel.fill_between(edges.time, edges.low, edges.high, label=style.get("label"), step="post", **look)
        return
    panel.plot(edges.time, edges.high, **style)
    panel.plot(edges.time, edges.low, **style | {"label": None})


def _draw_inputs(panel: Any, time: FloatArray, inputs: Sequence[tuple[Axis, FloatArray]]) -> None:
    """One input in its unit; several above each other, each over its range."""
    for row, (_, u) in enumerate(inputs):
        if len(inputs) > 1:
            span = float(np.ptp(u))
            u = row + 0.8 * ((u - u.min()) / span if span > 0 else np.full(len(u), 0.5))
        draw_line(panel, time, u, is_dense(u), True, color="0.25", linewidth=0.9, drawstyle="steps-post")
    if len(inputs) == 1:
        panel.set_ylabel(axis_label(inputs[0][0].name, inputs[0][0].unit, 14))
        return
    panel.set_label("inputs")
    names = [shortened(axis.name, 24) for axis, _ in inputs]
    panel.set_yticks([row + 0.4 for row in range(len(inputs))], names, fontsize="x-small")
    panel.set_ylabel("inputs, each\nover its range")
    panel.grid(False, axis="y")


def _unit(axis: Axis) -> str:
    return f"\n[{axis.unit}]" if has_unit(axis.unit) else ""


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
    look: Look = SCREEN,
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
        look: size of the figure.
    """
    with plt.rc_context(look.style):
        n, m = states.shape[1], measured.shape[1]
        figure, panels = plt.subplots(
            n + m, 1, figsize=(look.width or 7.2, look.height(0.9 + 1.05 * (n + m))), sharex=True, squeeze=False,
            layout="constrained",
        )  # fmt: skip
        for i in range(m):
            draw_line(panels[i, 0], time, measured[:, i], is_dense(measured[:, i]), True, color="black", linewidth=0.9)
            panels[i, 0].set_ylabel(axis_label(outputs[i].name, outputs[i].unit, 16), fontsize="small")
        for i in range(n):
            dense = is_dense(states[:, i])
            draw_line(panels[m + i, 0], time, states[:, i], dense, True, color=style_of("nnss").colour, linewidth=0.9)
            panels[m + i, 0].set_ylabel(f"$x_{{{i + 1}}}$ [–]", parse_math=True)
        if any(is_dense(signal) for signal in (*measured.T, *states.T)):
            panels[0, 0].set_title(ENVELOPE, fontsize="small", loc="left")
        for panel in panels[:, 0]:
            _mark_breaks(panel, time, breaks)
            panel.margins(x=0.01)
            panel.yaxis.set_major_locator(MaxNLocator(3, steps=TICK_STEPS))
        figure.align_ylabels()
        panels[-1, 0].set_xlabel(f"time [{time_unit}]")
        figure.suptitle(wrapped(title, look.width or 7.2), fontsize="large")
    return figure
