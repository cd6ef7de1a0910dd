"""Tables of predictors and of a validated model."""

from __future__ import annotations

from collections.abc import Sequence

from nnss_cli.datasets.record import Channels
from nnss_cli.report.simulation import titled
from nnss_cli.report.tables import number
from nnss_cli.validation.gain import Gain
from nnss_cli.validation.predictor import StepTable


def step_rows(steps: StepTable, channels: Channels) -> list[dict[str, str]]:
    """Errors by horizon and output; ∞ is the free simulation."""
    rows = []
    for i, (name, unit) in enumerate(zip(channels.outputs, channels.output_units, strict=True)):
        for h, predicted, lasting in zip(
            (*map(str, steps.horizons), "∞"),
            (*steps.predicted[:, i], steps.simulated[i]),
            (*steps.persistence[:, i], None),
            strict=True,
        ):
            rows.append(
                {
                    "output": titled(name, unit), "steps ahead": h, "RMSE": number(predicted),
                    "persistence": number(lasting),
                }
            )  # fmt: skip
    return rows


def gain_lines(gains: Sequence[Gain]) -> list[str]:
    """How the gain was come by, a line for each member."""
    lines = []
    for number_, gain in enumerate(gains, start=1):
        whose = f"member {number_}: " if len(gains) > 1 else ""
        if not gain.K.any():
            lines.append(f"{whose}K = 0: no gain predicts the validation record better than the simulation does")
        else:
            lines.append(
                f"{whose}gain: {gain.origin}; the observer's errors change by a factor of {gain.rate:.3g} a sample"
            )
    return lines
