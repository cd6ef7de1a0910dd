"""Simulations, residuals, inputs and states along the records of a folder."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.datasets.units import titled
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.modelfile import Tensors
from nnss_cli.report.aggregate import best_by_method, scored_splits, split_name
from nnss_cli.report.comparison import HOUR, joined, record_lengths, starts
from nnss_cli.report.html.looks import Look
from nnss_cli.report.html.trace import Panel, Series, Trace, draw_trace


def simulation_traces(store: Store, results: Sequence[RunResult], looks: dict[str, Look], anchor: str) -> list[Trace]:
    """For each test set (validation where there is none) the outputs of each method's best run by validation.

    Under each output stand the residuals y − ŷ, and last the inputs.
    """
    best = best_by_method(results)
    if not best:
        return []
    signals = {method: store.signals(result.spec) for method, result in best.items()}
    own = next(iter(signals.values()))
    channels = next(iter(best.values())).channels
    found = []
    for index, split in enumerate(scored_splits(results)):
        y, u = joined(own, split, "y"), joined(own, split, "u")
        panels = []
        for i, name in enumerate(_names(channels, "output")):
            simulated = {m: joined(signals[m], split, "y_sim")[:, i] for m in best}
            lines = [Series("measured", y[:, i])]
            lines += [_of(best[m], looks, values) for m, values in simulated.items()]
            panels.append(Panel(name, lines, 190))
            errors = [_of(best[m], looks, y[:, i] - values) for m, values in simulated.items()]
            panels.append(Panel(f"residual of {name}", errors, 110))
        for i, name in enumerate(_names(channels, "input")):
            panels.append(Panel(name, [Series(channels["inputs"][i], u[:, i], held=True)], 80))
        lengths = record_lengths(own, split)
        what = split_name(split)
        records = f"{what} record" if len(lengths) == 1 else f"{len(lengths)} {what} records, one after the other"
        listed = ", ".join(f"{looks[m].label} (n = {r.spec.order}, seed {r.spec.seed})" for m, r in best.items())
        found.append(
            _trace(
                f"{anchor}-sim-{index}", f"Simulation of the {records}: each method's best run by validation",
                f"Outputs measured and simulated, residuals and inputs over time. Simulated by {listed}.", panels,
                own, lengths,
            )
        )  # fmt: skip
    return found


def state_trace(store: Store, results: Sequence[RunResult], looks: dict[str, Look], anchor: str) -> Trace | None:
    """The states of the best NN-SS run by validation, on the first test set (validation where there is none)."""
    result = best_by_method(results).get("nnss")
    if result is None:
        return None
    signals = store.signals(result.spec)
    split, *_ = scored_splits(results)
    x = joined(signals, split, "x")
    label, n, seed = looks["nnss"].label, result.spec.order, result.spec.seed
    panels = [Panel(f"state x{i + 1} [–]", [_of(result, looks, x[:, i])], 80) for i in range(x.shape[1])]
    return _trace(
        f"{anchor}-states", f"States of the best {label} run by validation (n = {n}, seed {seed})",
        f"The {n} states over time, in the model's own coordinates.", panels, signals, record_lengths(signals, split),
    )  # fmt: skip


def _of(result: RunResult, looks: dict[str, Look], values: FloatArray) -> Series:
    look = looks[result.spec.method]
    return Series(f"{look.label}, n = {result.spec.order}", values, look, result.spec.order)


def _trace(
    name: str, title: str, words: str, panels: Sequence[Panel], signals: Tensors, lengths: Sequence[int]
) -> Trace:
    Ts = float(np.ravel(signals["Ts"])[0])
    hours = sum(lengths) * Ts > 3 * HOUR
    return draw_trace(name, title, words, panels, Ts / HOUR if hours else Ts, "h" if hours else "s", starts(lengths))


def _names(channels: dict[str, Any], kind: str) -> list[str]:
    return [titled(*pair) for pair in zip(channels[f"{kind}s"], channels[f"{kind}_units"], strict=True)]
