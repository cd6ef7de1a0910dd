"""The training of an NN-SS model: candidates on the first stage, the one taken on the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nnss_cli.datasets.record import FittingData, FloatArray, Record
from nnss_cli.datasets.units import p_text
from nnss_cli.datasets.windows import SHORTEST, beginnings
from nnss_cli.errors import InputError
from nnss_cli.iterative import EpochCallback
from nnss_cli.training.attempt import HIDDEN, Attempt, Clock, Training
from nnss_cli.training.candidates import ALTERNATIVES, PAYS, SIMPLEST, blocks, chance, pays, pooled, worth_trying
from nnss_cli.training.recipe import Recipe
from nnss_cli.training.start import LinearStarter
from nnss_cli.training.warm import LinearStart, linear_start

REPLACED = {("stability", "initial"), ("lengthen", "initial"), ("integrator", "both")}
"""What was taken before, and what takes its place: a cold start that of a layer, and all windows."""


@dataclass(frozen=True)
class _Judged:
    """A candidate, trained for each way to divide the data."""

    attempts: tuple[Attempt, ...]
    """By validation, then, where blocks judge, by each other block."""
    lengths: tuple[int, ...]
    """Samples that each is judged by."""

    @property
    def attempt(self) -> Attempt:
        """That by validation, which is gone on with."""
        return self.attempts[0]

    @property
    def error(self) -> float:
        """Over all that was held out."""
        return pooled([each.error for each in self.attempts], self.lengths)

    @property
    def weights(self) -> int:
        """Of its model."""
        return self.attempt.model.architecture.weights

    def squares(self) -> FloatArray:
        """Errors, squared, sample by sample."""
        return np.concatenate([each.squares() for each in self.attempts])


def train_nnss(
    data: FittingData, order: int, seed: int, recipe: Recipe, on_epoch: EpochCallback | None = None
) -> Training:
    """Train an NN-SS model.

    On the first stage the recipe's simplest candidate is trained, then each alternative that `worth_trying` names, as
    a change of the best so far; one is taken where it `pays`. The one taken goes through the other stages.

    They are judged on validation, or by the RMSE over all `blocks`: each is trained on the others then as well.

    Args:
        data: train and validation records, physical units.
        order: number of states n.
        seed: of the initial weights and the shuffling.
        recipe: architecture and training.
        on_epoch: called after each epoch with its number, loss and validation error. Epochs count on over candidates.

    Raises:
        InputError: a training record is shorter than the window, or the budget too small for one epoch.
    """
    torch.set_num_threads(1)  # tiny matrices: more threads are slower, and the result would depend on them
    clock = Clock(recipe.budget)
    train, val = data.normalised()
    first, *further = stages(train, recipe)
    names = worth_trying(data, order, recipe, first)
    linear = _remembering()
    parts = [(first, val)]
    if names and recipe.judge == "blocks":
        parts += blocks(first, val, data.init_window)
    lengths = tuple(sum(map(len, held)) for _, held in parts)
    epochs = 0

    def judge(base: Recipe, name: str = "", rival: _Judged | None = None) -> _Judged:
        """A candidate, trained on each part of the data."""
        nonlocal epochs
        tried: list[Attempt] = []
        rivals: Sequence[Attempt | None] = rival.attempts if rival else [None] * len(parts)
        for (records, held), other in zip(parts, rivals, strict=True):
            changes = recipe.alternatives(min(map(len, records))).get(name, {})
            report = _after(epochs, on_epoch)
            candidate = base.replace(**changes)
            tried.append(Attempt(data, order, seed, candidate, records, held, other, clock, report, linear))
            if not clock.up:
                tried[-1].train(records, tried[-1].recipe.epochs)
            epochs += len(tried[-1].watch.losses)
        return _Judged(tuple(tried), lengths)

    best = judge(recipe.simplest())
    if clock.up and best.attempt.samples == 0:
        raise InputError(
            f"budget: {recipe.budget:g} s are too few for one candidate, whose start alone took {clock.elapsed:.1f} s: "
            "give more, or --start random"
        )
    errors: dict[str, float] = {SIMPLEST: best.error}
    held: list[str] = []
    remarks: tuple[str, ...] = ()
    judged = f"error over {len(parts)} blocks" if len(parts) > 1 else "validation error"
    unfinished: list[str] = []
    alternatives = recipe.alternatives(min(map(len, first)))
    for name in names:
        if clock.up:
            unfinished.append(name)
            continue
        if name == "both" and "feedthrough" in held:
            continue  # the integrator was tried with it
        without = alternatives[name] | {"integrator": "no"}
        if best.attempt.model.architecture.integrator and not best.attempt.recipe.replace(**without).integrates:
            continue  # the optimiser of this alternative cannot train one
        tried = judge(best.attempt.recipe, name, best)
        if clock.up and len(parts) > 1:  # some part was not trained to its end
            unfinished.append(name)
            continue
        if any(each.needless for each in tried.attempts):
            continue
        kept = [won for won in held if (won, name) not in REPLACED]
        label = " with ".join(ALTERNATIVES[won] for won in [*kept, name])
        errors[label] = tried.error
        if not all(each.hidden for each in tried.attempts):
            if tried.error < best.error:
                remarks += (f"{label} left: the training error falls by less than {1 - HIDDEN:.0%}",)
        elif gain := _gain(name, tried, best):
            best, held = tried, [*kept, name]
            remarks += (f"{label} taken: it lowers the {judged} {gain}",)
    taken = best.attempt
    for index, records in enumerate(further, 1):
        if not taken.watch.diverged and not clock.up:
            taken.train(records, taken.epochs(index))
        elif clock.up:
            unfinished.append(f"stage of {sum(map(len, records))} samples")
    weights, outputs = best.weights, sum(record.y.size for record in train)
    if weights > outputs and taken.recipe.optimiser == "gauss-newton":
        lower = "a lower order or" if order > 1 else "a lower"  # no order is below 1
        remarks += (f"{weights} weights for {outputs} measured outputs: take {lower} --hidden, or more samples",)
    if unfinished or clock.up:
        left = f", without {', '.join(unfinished)}" if unfinished else ""
        remarks += (f"stopped by the budget of {recipe.budget:g} s{left}",)
    judged_by = "block_rmse" if len(parts) > 1 else "val_rmse"
    return taken.training(remarks, errors if len(errors) > 1 else {}, judged_by)


def _gain(name: str, tried: _Judged, best: _Judged) -> str:
    """By how much an alternative is better than the best so far, where it is taken; else ""."""
    error, rival = tried.error, best.error
    if name == "stability" and tried.weights < best.weights:
        return f"with {tried.weights} weights for {best.weights}" * pays(error, rival, simpler=True)
    if pays(error, rival):
        return f"by more than {PAYS:.0%}"
    if error < rival:
        p = chance(tried.squares(), best.squares())
        return f"by {1 - error / rival:.1%}, hardly by chance ({p_text(p)})" * pays(error, rival, by_chance=p)
    return ""


def stages(train: tuple[Record, ...], recipe: Recipe) -> list[tuple[Record, ...]]:
    """What Gauss–Newton on whole records sees, one after the other: their beginnings, four times as much each time.

    A long record costs as much an iteration as all those that a short beginning of it needs. Elsewhere there is one
    stage. The last one is all there is, and the one before at most half of it.

    Args:
        train: experiments.
        recipe: `lead` is the length of the first stage, samples of all experiments together.
    """
    total, found = sum(len(record) for record in train), []
    if recipe.lead and recipe.window == 0 and recipe.optimiser == "gauss-newton":
        length = recipe.lead
        while 2 * length <= total:
            found.append(beginnings(train, length, SHORTEST))
            length *= 4
    return [*found, train]


def _after(before: int, on_epoch: EpochCallback | None) -> EpochCallback | None:
    """`on_epoch` with numbers that go on after those `before`."""
    if on_epoch is None or before == 0:
        return on_epoch
    return lambda epoch, loss, error: on_epoch(before + epoch, loss, error)


def _remembering() -> LinearStarter:
    """`linear_start` that makes SSEST's model once: candidates that differ in their generator alone share it."""
    made: dict[tuple[object, ...], tuple[object, LinearStart]] = {}

    def linear(train: tuple[Record, ...], val: tuple[Record, ...], *rest: Any) -> LinearStart:
        key = (*map(id, train), None, *map(id, val), *rest)
        if key not in made:  # the records are kept, so that no other has their ids
            made[key] = ((train, val), linear_start(train, val, *rest))
        return made[key][1]

    return linear
