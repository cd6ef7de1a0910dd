"""Tables and the figure of a simulated file, and of what a model's folder holds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from nnss_cli.datasets.record import Channels, FloatArray, unscored
from nnss_cli.datasets.units import has_unit, titled
from nnss_cli.experiment.run import Score
from nnss_cli.report.cells import whole
from nnss_cli.report.dense import is_dense
from nnss_cli.report.style import MEASURED, STYLE, axis_label, band_look, style_of
from nnss_cli.report.tables import number, percent
from nnss_cli.report.timeplots import ENVELOPE, draw_line

if TYPE_CHECKING:
    from nnss_cli.trained.simulate import Beyond


def error_rows(scores: Sequence[Score], channels: Channels) -> list[dict[str, str]]:
    """Errors of a simulated file by output."""
    names = [titled(*pair) for pair in zip(channels.outputs, channels.output_units, strict=True)]
    return [
        {
            "output": names[int(score.output[1:]) - 1], "RMSE": number(score.rmse), "RMSE/σ": number(score.nrmse),
            "fit [%]": percent(score.fit_percent),
        }
        for score in scores
    ]  # fmt: skip


def missing_lines(measured: FloatArray | None, channels: Channels, init_window: int) -> list[str]:
    """What of the outputs beyond the init window could not be compared with, a line each."""
    if measured is None:
        return ["Nothing to compare with: the file has no outputs beyond those of the start."]
    lines = []
    for name, there in zip(channels.outputs, np.isfinite(measured[unscored(init_window) :]).T, strict=True):
        if lost := int(np.sum(~there)):
            rest = "errors are over the others" if there.any() else "there is nothing to compare with"
            lines.append(f"'{name}': {lost} of {len(there)} samples are missing: {rest}.")
    return lines


def beyond_rows(found: Sequence[Beyond]) -> list[dict[str, str]]:
    """Signals that leave the range of the training records."""
    return [
        {
            "signal": titled(one.channel, one.unit), "samples": whole(one.samples), "of": whole(one.of),
            "from": number(one.found[0]), "to": number(one.found[1]), "trained from": number(one.trained[0]),
            "trained to": number(one.trained[1]),
        }
        for one in found
    ]  # fmt: skip


def draw_simulated(
    time: FloatArray, u: FloatArray, y: FloatArray, measured: FloatArray | None, channels: Channels, label: str,
    what: str = "simulated", band: tuple[FloatArray, FloatArray, str] | None = None,
) -> Figure:  # fmt: skip
    """Simulated or predicted outputs over the measured ones, where there are any, their differences, the inputs below.

    Args:
        time: instants (K,) [s].
        u: inputs (K, r).
        y: simulated outputs (K, m).
        measured: outputs (K, m), or None.
        channels: names and units.
        label: of the model.
        what: simulated, or how far it is predicted.
        band: lower and upper limit (K, m), and what the band is called.
    """
    m, r = y.shape[1], u.shape[1]
    rows = 1 if measured is None else 2  # for each output
    look = style_of("nnss")
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            rows * m + r, 1, figsize=(7.2, 1.2 + (1.7 + 0.9 * (rows - 1)) * m + 0.9 * r), sharex=True, squeeze=False,
            layout="constrained", height_ratios=([1.9] + [1] * (rows - 1)) * m + [1] * r,
        )  # fmt: skip
        for i in range(m):
            panel = panels[rows * i, 0]
            dense = is_dense(y[:, i])
            if measured is not None:
                draw_line(panel, time, measured[:, i], dense, label="measured", **MEASURED)
                residual = panels[rows * i + 1, 0]
                error = measured[:, i] - y[:, i]
                draw_line(residual, time, error, dense, True, color=look.colour, linewidth=0.8)
                residual.axhline(0, color="0.3", linewidth=0.6)
                unit = channels.output_units[i]
                residual.set_ylabel(f"residual\n[{unit}]" if has_unit(unit) else "residual")
            draw_line(panel, time, y[:, i], dense, color=look.colour, linewidth=1.1, label=what)
            if band is not None:
                low, high, name = band
                around = band_look(look.colour)
                panel.fill_between(time, low[:, i], high[:, i], label=name, **around)
                if measured is not None:  # a narrow one is seen only there
                    residual.fill_between(time, low[:, i] - y[:, i], high[:, i] - y[:, i], **around)
            panel.set_ylabel(axis_label(channels.outputs[i], channels.output_units[i], 24))
        for i in range(r):
            panel = panels[rows * m + i, 0]
            draw_line(
                panel, time, u[:, i], is_dense(u[:, i]), True, color="0.35", linewidth=0.9, drawstyle="steps-post"
            )
            panel.set_ylabel(axis_label(channels.inputs[i], channels.input_units[i], 14))
        if any(is_dense(signal) for signal in (*y.T, *u.T)):
            panels[0, 0].set_title(ENVELOPE, fontsize="small", loc="left")
        for panel in panels[:, 0]:
            panel.margins(x=0.01)
        panels[-1, 0].set_xlabel("time [s]")
        figure.align_ylabels()
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3)
        figure.suptitle(label, fontsize=10)
    return figure


def model_rows(shown: dict[str, Any]) -> list[dict[str, str]]:
    """What a model is and where it comes from."""
    training = shown["training"] or {}
    description = shown["description"].get("architecture") or shown["description"]
    facts: dict[str, Any] = {
        "kind": f"{shown['kind']} (folder of format {shown['format']})",
        "order": shown["order"],
        "sampling time": f"{shown['Ts']:.9g} s",
        "init window": shown["init_window"],
        **{key: value for key, value in description.items() if isinstance(value, str | int | float | list)},
        "members": len(shown["description"].get("members", ())) or None,
        "data": training and f"{training['dataset']} ({training['protocol']}), fingerprint {training['data']}",
        "method": training and f"{training['method']}, version {training['version']}, seed {training['seed']}",
        "made with": training and ", ".join(f"{name} {value}" for name, value in training["provenance"].items()),
        "notes": "; ".join(training.get("notes", ())),
        "remarks": "; ".join(training.get("remarks", ())),
    }
    if isinstance(facts["members"], int):
        facts = {key: value for key, value in facts.items() if not isinstance(value, list)}
    return [{"": key, "value": _text(value)} for key, value in facts.items() if value not in (None, "", {})]


def channel_rows(shown: dict[str, Any]) -> list[dict[str, str]]:
    """Channels with their scaling."""
    channels, scaling = shown["channels"], shown["scaling"]
    rows = []
    for kind, letter in (("input", "u"), ("output", "y")):
        for i, (name, unit) in enumerate(zip(channels[f"{kind}s"], channels[f"{kind}_units"], strict=True)):
            rows.append(
                {
                    "": kind, "name": name, "unit": unit,
                    "mean": number(scaling[f"{letter}_mean"][i] if scaling else None),
                    "deviation": number(scaling[f"{letter}_std"][i] if scaling else None),
                }
            )  # fmt: skip
    return rows


def array_rows(shown: dict[str, Any]) -> list[dict[str, str]]:
    """Arrays by name."""
    return [
        {"array": name, "shape": " × ".join(map(str, array["shape"])) or "1", "type": array["dtype"]}
        for name, array in shown["arrays"].items()
    ]


def setting_rows(shown: dict[str, Any]) -> list[dict[str, str]]:
    """The settings of its training; none where they are not known."""
    settings = (shown["training"] or {}).get("settings", {})
    return [{"setting": name, "value": _text(value)} for name, value in settings.items()]


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return " ".join(map(str, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)
