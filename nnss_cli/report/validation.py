"""Tables of predictors and of a validated model, and the page of figures of the latter."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from nnss_cli.datasets.record import Channels, FloatArray
from nnss_cli.datasets.units import has_unit, p_text, titled
from nnss_cli.report.cells import whole
from nnss_cli.report.figures import few_log_ticks
from nnss_cli.report.inspection import LOOKS
from nnss_cli.report.style import STYLE, axis_label, band_look, shortened, style_of
from nnss_cli.report.tables import number, percent
from nnss_cli.validation.gain import ALONE, MARGIN, Gain
from nnss_cli.validation.predictor import StepTable
from nnss_cli.validation.residuals import Profile
from nnss_cli.validation.result import OutputCheck, Validation

ABOVE: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 1), "borderaxespad": 0}
"""Where a legend is above its panel: at the right, since the factor of an axis (1e6) stands at the left."""


def step_rows(steps: StepTable, channels: Channels) -> list[dict[str, str]]:
    """Errors by horizon and output: the model's own predictions, guarded ones, persistence; ∞ is the simulation."""
    rows = []
    for i, (name, unit) in enumerate(zip(channels.outputs, channels.output_units, strict=True)):
        columns = {"RMSE": [*steps.predicted[:, i], steps.simulated[i]]}
        if steps.guarded is not None:
            columns["guarded"] = [*steps.guarded[:, i], None]
        columns["persistence"] = [*steps.persistence[:, i], None]
        for k, h in enumerate((*map(str, steps.horizons), "∞")):
            errors = {column: number(values[k]) for column, values in columns.items()}
            rows.append({"output": titled(name, unit), "steps ahead": h} | errors)
    return rows


def gain_lines(gains: Sequence[Gain]) -> list[str]:
    """How the gain was come by, a line for each member."""
    lines = []
    for number_, gain in enumerate(gains, start=1):
        whose = f"member {number_}: " if len(gains) > 1 else ""
        if gain.origin == ALONE:
            lines.append(
                f"{whose}the model has no part in this: increments of inputs and outputs alone validate better; the "
                f"observer's errors change by a factor of {gain.rate:.3g} a sample"
            )
        elif not gain.K.any():
            lines.append(f"{whose}K = 0: {_why_none(gain)}")
        else:
            lines.append(
                f"{whose}gain: {gain.origin}; the observer's errors change by a factor of {gain.rate:.3g} a sample"
            )
    return lines


def _why_none(gain: Gain) -> str:
    """Why validation took no gain, by the rule of `nnss_cli.validation.gain`."""
    simulation, lowest = gain.val["none"], min(gain.val.values())
    if lowest >= simulation:
        return "no gain predicts the validation record better than the simulation does"
    better = f"{number(100 * (1 - lowest / simulation), 2)} % better than the simulation does"
    if simulation <= MARGIN * lowest:
        return f"the best gain predicts the validation record only {better}, and within 2 % the simplest is taken"
    return (
        f"gains predict the validation record up to {better}, but their observers do not contract along it and the "
        "training record, or err more than the simulation over the whole of one"
    )


def guard_lines(weight: FloatArray, channels: Channels) -> list[str]:
    """What a guard gave to persistence: weights (K, m), a line for each output."""
    return [
        f"guard, {name}: persistence had {100 * own.mean():.1f} % of the weight, {100 * own[-1]:.1f} % at the end"
        for name, own in zip(channels.outputs, weight.T, strict=True)
    ]


def output_rows(found: Validation) -> list[dict[str, str]]:
    """Errors of the simulation by output. σ is that of the training data."""
    return [
        {
            "output": titled(each.name, each.unit), "fit [%]": percent(each.fit_percent),
            "linear limit [%]": "–" if each.limit is None else percent(each.limit), "RMSE": number(each.rmse),
            "RMSE/σ": number(each.rmse / each.sigma), "σ (training)": number(each.sigma),
        }
        for each in found.outputs
    ]  # fmt: skip


def residual_rows(found: Validation) -> list[dict[str, str]]:
    """Residual tests by output and input."""
    rows = []
    for each in found.outputs:
        rows.append(
            {
                "output": each.name, "residuals": "with themselves", "RMSE": number(each.residual_rmse),
                "largest |r|": _largest(each.white.correlation), "99 % band": number(each.white.band, 2),
                "p": number(each.white.p_value, 2),
            }
        )  # fmt: skip
        for name, tie in zip(found.channels.inputs, each.depends, strict=True):
            rows.append(
                {
                    "output": each.name, "residuals": f"with {name}", "RMSE": "",
                    "largest |r|": _largest(tie.correlation), "99 % band": number(tie.band, 2),
                    "p": number(tie.p_value, 2),
                }
            )  # fmt: skip
    return rows


def _largest(correlation: Any) -> str:
    return number(float(np.max(np.abs(correlation))), 2)


def point_rows(found: Validation) -> list[dict[str, str]]:
    """Linearisations, one row a point and output: where, their slowest pole, and steady-state gains from each input."""
    c = found.channels
    return [
        {
            "point": whole(1 + index), "output": titled(output, unit),
            **{f"at {name}": number(value) for name, value in zip(c.inputs, point.u, strict=True)},
            "at rest": number(point.y[i]), "largest |pole|": number(float(np.abs(point.poles).max())),
            **{f"gain from {name}": number(value) for name, value in zip(c.inputs, point.dc_gain[i], strict=True)},
        }
        for index, point in enumerate(found.linear.points)
        for i, (output, unit) in enumerate(zip(c.outputs, c.output_units, strict=True))
    ]  # fmt: skip


def test_rows(found: Validation) -> list[dict[str, str]]:
    """The stated tests."""
    return [{"test": test.name, "": "passes" if test.passed else "FAILS", "found": test.found} for test in found.tests]


def draw_validation(found: Validation) -> Figure:
    """One page: the record, residuals, errors ahead, poles and linearisations.

    Of several outputs and inputs the one with the largest RMSE/σ, and the input that its residuals depend on most, are
    drawn, and of several experiments the signals of the first; the title says which.
    """
    index = int(np.argmax([each.rmse / each.sigma for each in found.outputs]))
    each = found.outputs[index]
    driver = int(np.argmin([tie.p_value for tie in each.depends]))
    several = len(found.outputs) > 1 or len(found.channels.inputs) > 1
    names = shortened(each.name, 60), shortened(found.channels.inputs[driver], 60)
    drawn = [f"signals of record 1 of {found.experiments}"] * (found.experiments > 1)
    drawn += [f"output {names[0]}", f"input {names[1]}"] * several
    title = f"{found.label}\non {found.record}, {found.samples} samples"
    if drawn:
        title += f"\ndrawn: {', '.join(drawn)}"
    with plt.rc_context(STYLE | {"font.size": 8}):
        lines = [line for text in found.verdict for line in textwrap.wrap(f"– {text}", 150, subsequent_indent="   ")]
        heights = [0.7 + 0.14 * len(lines), 2.7, 2.3, 2.3, *[2.4] * bool(found.linear.points)]
        figure = plt.figure(figsize=(9.6, sum(heights)), layout="constrained")
        rows: Any = figure.subfigures(len(heights), 1, height_ratios=heights)
        _draw_verdict(rows[0], lines, title)
        _draw_record(rows[1], found, index)
        _draw_residuals(rows[2], found, each, driver)
        _draw_profiles(rows[3], found, each, driver)
        if found.linear.points:
            _draw_linear(rows[4], found, index, driver)
    return figure


def _draw_verdict(block: Any, lines: Sequence[str], title: str) -> None:
    panel = block.subplots()
    panel.axis("off")
    panel.set_title(title, fontsize=10)
    panel.text(0, 1, "\n".join(lines), va="top", fontsize=7.5, transform=panel.transAxes)


def _draw_record(block: Any, found: Validation, i: int) -> None:
    top, low = block.subplots(2, 1, sharex=True, height_ratios=[2, 1.1])
    look = style_of("nnss")
    top.plot(found.time, found.measured[:, i], color="black", linewidth=2, alpha=0.35, label="measured")
    top.plot(found.time, found.simulated[:, i], color=look.colour, linewidth=0.9, label="simulated")
    if found.limits is not None:
        low_limit, high_limit = (limit[:, i] for limit in found.limits.pair)
        top.fill_between(found.time, low_limit, high_limit, label=found.limits.name, **band_look(look.colour))
    each = found.outputs[i]
    top.set_ylabel(axis_label(each.name, each.unit, 22))
    top.legend(ncols=3, **ABOVE)
    low.plot(
        found.time, found.measured[:, i] - found.simulated[:, i], color=look.colour, linewidth=0.7,
        label=f"simulation, r1 = {each.simulation_r1:.2f}",
    )  # fmt: skip
    low.plot(
        found.time, found.measured[:, i] - found.one_ahead[:, i], color="#D55E00", linewidth=0.6,
        label=f"one step ahead, r1 = {each.white.correlation[0]:.2f}",
    )  # fmt: skip
    low.set_ylabel(f"error [{each.unit}]" if has_unit(each.unit) else "error")
    low.legend(ncols=2, **ABOVE)
    low.set_xlabel("time [s]")
    for panel in (top, low):
        panel.margins(x=0.01)


def _draw_residuals(block: Any, found: Validation, each: OutputCheck, driver: int) -> None:
    left, middle, right = block.subplots(1, 3)
    tie, of = each.depends[driver], shortened(found.channels.inputs[driver], 60)
    for panel, correlation, first, band, title, p in (
        (left, each.white.correlation, 1, each.white.band, "residuals with themselves", each.white.p_value),
        (middle, tie.correlation, 0, tie.band, f"residuals with {of}", tie.p_value),
    ):
        lags = np.arange(first, first + len(correlation))
        panel.axhspan(-band, band, color="0.88", label="99 % band of one lag")
        panel.vlines(lags, 0, correlation, color="#0072B2", linewidth=1.4)
        panel.axhline(0, color="black", linewidth=0.6)
        panel.set_title(textwrap.fill(f"{title}, {p_text(p)}", 40), fontsize=8)
        panel.set_xlabel("lag [samples]")
        panel.set_ylabel("correlation")
        largest = max(1.6 * band, 1.15 * float(np.abs(correlation).max()))
        panel.set_ylim(-largest, largest)
    left.legend(fontsize=7)
    steps, i = found.steps, found.outputs.index(each)
    right.plot(steps.horizons, steps.predicted[:, i], color="#0072B2", marker="o", markersize=3, label="predictor")
    right.plot(
        steps.horizons, steps.persistence[:, i], color="#D55E00", marker="s", markersize=3, linestyle=(0, (5, 2)),
        label="persistence",
    )  # fmt: skip
    right.axhline(steps.simulated[i], color="black", linewidth=1, linestyle=":", label="simulation")
    right.set_xscale("log")
    right.set_xticks(steps.horizons, [str(h) for h in steps.horizons])
    right.minorticks_off()
    right.set_yscale("log")
    few_log_ticks(right.yaxis)
    right.set_xlabel("steps ahead")
    right.set_ylabel(f"RMSE {'' if each.unit == '–' else f'[{each.unit}]'}".strip())
    right.legend(fontsize=7)


def _draw_profiles(block: Any, found: Validation, each: OutputCheck, driver: int) -> None:
    left, middle, right = block.subplots(1, 3)
    state = int(np.argmax([-1.0 if part is None else part.share for part in each.by_state]))
    unit = found.channels.input_units[driver]
    _draw_profile(left, each.by_input[driver], axis_label(found.channels.inputs[driver], unit, 30), each)
    _draw_profile(middle, each.by_state[state], f"state x{state + 1}", each)
    angle = np.linspace(0, 2 * np.pi, 400)
    right.plot(np.cos(angle), np.sin(angle), color="0.6", linewidth=0.8)
    poles = found.poles.ravel()
    right.plot(poles.real, poles.imag, ".", color="#0072B2", markersize=2.5, label="A(x) on the trajectory")
    for number_, point in enumerate(found.linear.points):
        label = "linearisations" if number_ == 0 else None
        right.plot(point.poles.real, point.poles.imag, "x", color=LOOKS[1][0], markersize=5, label=label)
    everything = np.concatenate([poles, *(point.poles for point in found.linear.points)])
    if everything.size:
        centre = (min(everything.real.min(), 0.8) + max(1.0, everything.real.max())) / 2
        half = max(max(1.0, everything.real.max()) - centre, float(np.abs(everything.imag).max())) * 1.15
        right.set_xlim(centre - half, centre + half)
        right.set_ylim(-half, half)
    right.set_aspect("equal", adjustable="box")
    right.set_xlabel("real part")
    right.set_ylabel("imaginary part")
    right.set_title(f"poles, largest modulus {found.radius:.4f}", fontsize=8)
    right.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2, frameon=False)


def _draw_profile(panel: Any, part: Profile | None, name: str, each: OutputCheck) -> None:
    panel.set_xlabel(name)
    panel.set_ylabel(f"mean residual {'' if each.unit == '–' else f'[{each.unit}]'}".strip())
    if part is None:
        panel.set_title("it does not vary", fontsize=8)
        return
    panel.errorbar(part.centres, part.means, yerr=part.bands, color="#0072B2", marker="o", markersize=3, capsize=2)
    panel.axhline(0, color="black", linewidth=0.6)
    panel.set_title(f"{100 * part.share:.1f} % of the variance beyond a line, 99 % bands", fontsize=8)


def _factor(unit: str) -> str:
    """A unit as a part of a quotient."""
    return unit if unit.isalpha() or unit in ("%", "°C") else f"({unit})"


def _draw_linear(block: Any, found: Validation, i: int, driver: int) -> None:
    left, right = block.subplots(1, 2)
    unit, of = found.channels.output_units[i], found.channels.input_units[driver]
    single = f" {of}" * (len(found.channels.inputs) == 1 and has_unit(of))
    for point, (colour, line) in zip(found.linear.points, LOOKS, strict=False):
        at = f"u = {', '.join(number(value, 3) for value in point.u[:3])}{', …' * (len(point.u) > 3)}{single}"
        left.plot(
            np.arange(len(point.step)) * found.linear.Ts, point.step[:, i, driver], color=colour, linestyle=line,
            drawstyle="steps-post", label=at,
        )  # fmt: skip
        right.plot(found.linear.frequency, point.magnitude[:, i, driver], color=colour, linestyle=line, label=at)
    left.set_xlabel("time [s]")
    step = f"response to a step of 1 {of}" if has_unit(of) else "unit step response"
    left.set_ylabel(titled(step, unit))
    left.set_title("linearised at equilibria", fontsize=8)
    right.set_xscale("log")
    right.set_yscale("log")
    right.set_xlabel("frequency [Hz]")
    right.set_ylabel("magnitude" if {"", "–"} & {unit, of} else f"magnitude [{_factor(unit)}/{_factor(of)}]")
    few_log_ticks(right.xaxis)
    few_log_ticks(right.yaxis)
    left.legend(fontsize=7)
