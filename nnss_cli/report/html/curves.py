"""Training curves of every seed, from the histories that the runs keep."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.report.aggregate import methods_of, runs_by_method
from nnss_cli.report.html.looks import Look
from nnss_cli.report.html.pictures import Picture, draw_curves

CURVES = {"val_rmse": "validation RMSE/σ", "train_loss": "training loss"}
"""Name in the history → what it is."""


@dataclass(frozen=True)
class Curves:
    """The pictures of one method and order."""

    look: Look
    """Which method."""
    order: int
    """Of the models."""
    pictures: list[Picture]
    """A line for each seed in each."""


def curves_of(store: Store, results: Sequence[RunResult], looks: dict[str, Look], anchor: str) -> list[Curves]:
    """Pictures for each method and order that was trained over epochs.

    Raises:
        InputError: a run's file is damaged.
    """
    position = methods_of(results)
    found = []
    for (method, order), own in sorted(
        runs_by_method(results).items(), key=lambda item: (position.index(item[0][0]), item[0][1])
    ):
        histories = {r.spec.seed: history_of(store, r) for r in own if r.epochs}
        pictures: list[Picture] = []
        for name, what in CURVES.items():
            lines = {seed: history[name] for seed, history in histories.items() if len(history.get(name, ())) > 1}
            if any(math.isfinite(value) and value > 0 for line in lines.values() for value in line):
                seeds = f"{len(lines)} seed{'s' * (len(lines) > 1)}"
                title = f"{what[0].upper()}{what[1:]} of {looks[method].label}, n = {order}, {seeds}"
                place = f"{anchor}-curve-{looks[method].key}-{order}-{len(pictures)}"
                pictures.append(draw_curves(place, title, what, looks[method], order, lines))
        if pictures:
            found.append(Curves(looks[method], order, pictures))
    return found


def history_of(store: Store, result: RunResult) -> dict[str, list[float]]:
    """Values per epoch: tables are made of runs without them."""
    whole = store.find(result.spec)
    return {} if whole is None else whole.history
