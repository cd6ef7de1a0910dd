"""An inspected record as rows for the terminal and as one figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import matplotlib as mpl

mpl.use("Agg")

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from nnss_cli.datasets.units import NO_UNIT
from nnss_cli.experiment.inspection_result import Delay, Inspection
from nnss_cli.report.figures import few_log_ticks
from nnss_cli.report.style import STYLE, TICK_STEPS, shortened, stacked_label
from nnss_cli.report.tables import number

SHOWN = 6  # channels of each role, and inputs and outputs of the responses, that the figure has room for
# Okabe–Ito colours, then some of Paul Tol's, with lines of their own, so that they stay apart in grey: `SHOWN` each
LOOKS = (
    ("#000000", "-"), ("#D55E00", (0, (6, 2))), ("#0072B2", (0, (1, 1))), ("#009E73", (0, (4, 1, 1, 1))),
    ("#CC79A7", (0, (8, 1))), ("#E69F00", (0, (3, 1, 1, 1, 1, 1))), ("#882255", (0, (9, 2, 2, 2))),
    ("#56B4E9", (0, (2, 2))), ("#332288", (0, (2, 1, 5, 1))), ("#999933", (0, (5, 1, 1, 1, 1, 1, 1, 1))),
    ("#AA4499", (0, (1, 3))), ("#666666", (0, (12, 3))),
)  # fmt: skip


def percent(share: float | None, digits: int = 3) -> str:
    """A share in percent; "–" for nothing."""
    return "–" if share is None else f"{number(100 * share, digits)} %"


def channel_rows(found: Inspection) -> list[dict[str, str]]:
    """One row a column of the record: its range."""
    return [
        {
            "channel": c.name, "role": c.role, "unit": c.unit, "kind": c.kind, "missing": str(c.missing),
            "min": number(c.minimum), "max": number(c.maximum), "mean": number(c.mean), "σ": number(c.sigma),
        }
        for c in found.channels
    ]  # fmt: skip


def grid_rows(found: Inspection) -> list[dict[str, str]]:
    """One row a column: its grid, where it stops, spikes and drift."""
    return [
        {
            "channel": c.name,
            "levels": str(c.levels), "step": number(c.step) if c.bits is not None else "–", "bits": number(c.bits, 3),
            "at min": percent(c.at_minimum, 2), "at max": percent(c.at_maximum, 2),
            "spikes": "–" if c.spikes is None else str(c.spikes),
            "trend [σ]": "–" if c.trend is None else f"{c.trend:+.2f}",
        }
        for c in found.channels
    ]  # fmt: skip


def input_rows(found: Inspection) -> list[dict[str, str]]:
    """How each input excites; [] for a record without inputs."""
    unit = frequency_unit(found)
    return [
        {
            "input": e.input,
            "excites order": f"{'≥ ' if e.persistency.order == e.persistency.largest else ''}{e.persistency.order}",
            f"95 % band [{unit}]": "–" if e.band is None else f"{number(e.band[0], 3)}–{number(e.band[1], 3)}",
            "above 0.8 Nyquist": percent(e.near_nyquist, 2),
        }
        for e in found.excitation
    ]


def response_rows(found: Inspection) -> list[dict[str, str]]:
    """Delay of each pair of input and output; [] where there is none to look at."""
    return [
        {
            "input": d.input, "output": d.output,
            "delay [samples]": _said(d),
            "delay [s]": number(d.seconds),
            "largest |correlation|": number(max(map(abs, d.correlation)), 2), "99 % bound": number(d.bound, 2),
        }
        for d in found.delays
    ]  # fmt: skip


def _said(delay: Delay) -> str:
    return "input too smooth" if delay.smooth else "none found" if delay.samples is None else str(delay.samples)


def output_rows(found: Inspection) -> list[dict[str, str]]:
    """What linear models leave of each output."""
    return [
        {
            "output": each.output, "linearly unexplained": percent(each.unexplained, 2),
            "by": "–" if each.unexplained is None else each.source,
            "of one-step residual, by products": percent(each.gain, 2), "p (linear)": number(each.p_value, 2),
        }
        for each in found.linearity
    ]  # fmt: skip


def order_rows(found: Inspection) -> list[dict[str, str]]:
    """Orders tried, the guess marked; RMS errors over the σ of what was fitted."""
    return [
        {
            "order": f"{c.order}{' ←' if c.order == found.order.suggested else ''}",
            "Hankel σn/σ1": "–" if c.hankel is None else f"{c.hankel:.2e}",
            "train [σ]": number(c.train), "validation [σ]": number(c.val),
        }
        for c in found.order.candidates
    ]  # fmt: skip


def record_rows(found: Inspection) -> list[dict[str, str]]:
    """The record as a whole, and what is given or recommended."""
    clock = found.clock
    given = dict.fromkeys(found.given, " (given)")
    rows = {
        "samples": " + ".join(map(str, found.samples)) or "0",
        "Ts": "unknown" if clock.Ts is None else f"{clock.Ts:.9g} s ({clock.source})",
        "jitter": "–" if clock.jitter is None else percent(clock.jitter, 2) + " of a step at most",
        "split": found.split.rule + given.get("split", ""),
        "orders": (" ".join(map(str, found.orders)) or "–") + given.get("orders", ""),
        "init window": f"{found.init_window} samples" + given.get("init_window", ""),
    }
    return [{"record": key, "": value} for key, value in rows.items()]


def frequency_unit(found: Inspection) -> str:
    """Hz, or what there is without a sampling time."""
    return "1/sample" if found.clock.Ts is None else "Hz"


def draw_inspection(found: Inspection, title: str) -> Figure:
    """Channels over time, spectra, coherence, and the response of each output to each input.

    Records with more than six inputs or outputs show the first six, and say so.

    Args:
        found: what is known of the record.
        title: of the figure.
    """
    shown = [c for role in ("input", "output") for c in [c for c in found.channels if c.role == role][:SHOWN]]
    looks = {c.name: look for c, look in zip(shown, LOOKS, strict=False)}
    inputs = list(dict.fromkeys(d.input for d in found.delays))[:SHOWN]
    outputs = list(dict.fromkeys(d.output for d in found.delays))[:SHOWN]
    frequency = bool(found.spectrum) and any(c.name in looks for c in shown)
    heights = [max(1.2, 0.6 + 0.95 * len(shown)), 2.9 + 0.16 * len(shown) if frequency else 0, 0.5 + 1.5 * len(outputs)]
    used = [h for h, there in zip(heights, (True, frequency, bool(outputs)), strict=True) if there]
    with plt.rc_context(STYLE):
        figure = plt.figure(figsize=(max(7.2, 1.6 + 2.4 * len(inputs)), 0.5 + sum(used)), layout="constrained")
        blocks = iter(figure.subfigures(len(used), 1, height_ratios=used, squeeze=False)[:, 0])
        _draw_time(next(blocks), found, shown, looks)
        if frequency:
            _draw_frequency(next(blocks), found, looks)
        if outputs:
            _draw_responses(next(blocks), found, inputs, outputs)
        left_out = len(found.channels) - len(shown)
        figure.suptitle(
            shortened(title, 90, 2) + (f"\n({left_out} more channels not shown)" if left_out else ""), fontsize=10
        )
    return figure


def _draw_time(block: Any, found: Inspection, shown: Sequence[Any], looks: dict[str, Any]) -> None:
    panels = block.subplots(max(1, len(shown)), 1, sharex=True, squeeze=False)[:, 0]
    curves = {(c.role, c.name): e for c, e in zip(found.channels, found.envelopes, strict=True)}
    for panel, channel in zip(panels, shown, strict=False):
        curve = curves[channel.role, channel.name]
        low, high = (np.array([np.nan if v is None else v for v in side]) for side in (curve.low, curve.high))
        largest = max(abs(channel.minimum or 0.0), abs(channel.maximum or 0.0))
        power = int(np.floor(np.log10(largest))) if largest > 1e30 else 0  # more than an axis can hold
        low, high = low / 10.0**power, high / 10.0**power
        colour = looks[channel.name][0]
        steps = "steps-post" if channel.role == "input" else "default"
        if np.array_equal(low, high, equal_nan=True):
            panel.plot(curve.time, low, color=colour, linewidth=0.9, drawstyle=steps)
        else:  # dense: from the smallest to the largest value of each point
            panel.fill_between(curve.time, low, high, color=colour, linewidth=0.6)
        unit = channel.unit if not power else f"1e{power} {channel.unit}"
        panel.set_ylabel(stacked_label(channel.name, unit, 18), fontsize=7, rotation=0, ha="right", va="center")
        panel.yaxis.set_major_locator(MaxNLocator(3, steps=TICK_STEPS))
        panel.tick_params(labelsize=8)
        panel.margins(x=0.01)
    starts = np.cumsum((0, *found.samples))[1:-1] * (found.clock.Ts or 1.0)
    for panel in panels:
        for start in starts:  # of the later experiments
            panel.axvline(start, color="0.5", linewidth=0.8, linestyle="--")
    panels[-1].set_xlabel("time [s]" if found.clock.Ts else "time [samples]")


def _draw_frequency(block: Any, found: Inspection, looks: dict[str, Any]) -> None:
    assert found.spectrum is not None
    spectrum, unit = found.spectrum, frequency_unit(found)
    left, right = block.subplots(1, 2)
    f = np.array(spectrum.frequency)
    for name, density in zip(spectrum.channels, spectrum.density, strict=True):
        if name in looks and max(density) > 0:
            power = np.maximum(density, 1e-12 * max(density))  # a line spectrum has zeros
            left.plot(f, power, color=looks[name][0], linestyle=looks[name][1], linewidth=1.1, label=_legend(name))
    left.set_ylabel(f"power density [σ²/{unit}]" if unit == "Hz" else "power density [σ² samples]")
    for each in found.linearity:
        if each.coherence and each.output in looks:
            label = f"{_legend(each.output)} (unexplained {percent(each.unexplained, 2)}, by {each.source})"
            colour, line = looks[each.output]
            right.plot(f, each.coherence, color=colour, linestyle=line, linewidth=1.1, label=label)
    right.set_ylim(-0.03, 1.03)
    right.set_ylabel("multiple coherence [–]")
    if left.lines:
        left.set_yscale("log")
        few_log_ticks(left.yaxis)
    for panel in (left, right):
        panel.set_xlabel(f"frequency [{unit}]")
        if panel.lines:
            panel.set_xscale("log")
            few_log_ticks(panel.xaxis, 5)
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), fontsize=7, handlelength=3.5)
        else:
            panel.text(0.5, 0.5, "too short, or no input", ha="center", va="center", transform=panel.transAxes)


def _legend(name: str) -> str:
    # matplotlib hides labels that begin with an underscore
    return " " + shortened(name, 36)


def _draw_responses(block: Any, found: Inspection, inputs: Sequence[str], outputs: Sequence[str]) -> None:
    panels = block.subplots(len(outputs), len(inputs), sharex=True, sharey="row", squeeze=False)
    pairs = {(d.output, d.input): d for d in found.delays}
    for i, output in enumerate(outputs):
        for j, name in enumerate(inputs):
            panel, delay = panels[i, j], pairs[output, name]
            lags = np.arange(len(delay.correlation))
            panel.axhspan(-delay.bound, delay.bound, color="0.85", zorder=0)
            panel.vlines(lags, 0, delay.correlation, color="black", linewidth=1.2)
            panel.axhline(0, color="black", linewidth=0.6)
            if delay.samples is not None:
                panel.axvline(delay.samples, color="#D55E00", linestyle="--", linewidth=1)
            said = f"delay: {_said(delay)}"
            panel.set_title(f"{shortened(name, 30, 2)}\n{said}" if i == 0 else said, fontsize=8)
            panel.xaxis.set_major_locator(MaxNLocator(5, integer=True, steps=TICK_STEPS))
            panel.tick_params(labelsize=8)
        panels[i, 0].set_ylabel(stacked_label(output, NO_UNIT, 18), fontsize=7, rotation=0, ha="right", va="center")
    for panel in panels[-1]:
        panel.set_xlabel("lag [samples]", fontsize=8)
    block.suptitle(
        "correlation of prewhitened input and output [–]; grey: 99 % of one lag without a response", fontsize=8
    )
