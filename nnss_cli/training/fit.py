"""The training loop: shuffled mini-batches, a validation run each epoch, early stopping."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from nnss_cli.datasets.record import FittingData, FloatArray
from nnss_cli.datasets.windows import sliding_windows
from nnss_cli.iterative import EarlyStopping, EpochCallback, named_random
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.engine import Engine, ReferenceEngine, free_run_rmse
from nnss_cli.training.recipe import Recipe


@dataclass(frozen=True)
class Training:
    """How a training went."""

    model: NNSS
    """The model of the best validation epoch."""
    epochs: int
    """Epochs that were run."""
    best_epoch: int
    """Epoch of the model kept, from 1; 0 when none was finite."""
    diverged: str = ""
    """Why the training was given up, or ""."""
    train_loss: list[float] = field(default_factory=list)
    """Mean loss of each epoch."""
    val_rmse: list[float] = field(default_factory=list)
    """Validation error of each epoch: RMSE of a free run in normalised units."""


def build_engine(model: NNSS, u: FloatArray, y: FloatArray, recipe: Recipe) -> Engine:
    """The engine that the recipe names."""
    if recipe.engine == "reference":
        return ReferenceEngine(model, u, y, recipe)
    from nnss_cli.training.fast import FastEngine

    return FastEngine(model, u, y, recipe)


def train_nnss(
    data: FittingData, order: int, seed: int, recipe: Recipe, on_epoch: EpochCallback | None = None
) -> Training:
    """Train an NN-SS model.

    Args:
        data: train and validation records, physical units.
        order: number of states n.
        seed: of the initial weights and the shuffling.
        recipe: architecture and training.
        on_epoch: called after each epoch with its number, loss and validation error.

    Raises:
        InputError: the window is longer than the training record.
    """
    torch.set_num_threads(1)  # tiny matrices: more threads are slower, and the result would depend on them
    scaling = data.scaling
    train = tuple(scaling.apply(record) for record in data.train)
    val = tuple(scaling.apply(record) for record in data.val)
    u, y = sliding_windows(train, recipe.window, recipe.stride)

    architecture = recipe.architecture(order, data.input_count, data.output_count)
    model = NNSS(architecture, scaling, data.channels, data.Ts)
    model.initialise(named_random(seed, "weights"))
    engine = build_engine(model, u, y, recipe)

    shuffling = named_random(seed, "shuffling")
    stopping = EarlyStopping(recipe.patience, recipe.improvement)
    kept, best_epoch, diverged = engine.weights(), 0, ""
    losses: list[float] = []
    errors: list[float] = []
    # As in the released code, an incomplete last mini-batch is left out.
    batches = max(1, len(u) // recipe.batch)
    for epoch in range(1, recipe.epochs + 1):
        shuffled = shuffling.permutation(len(u))
        total = 0.0
        for index in range(batches):
            loss = engine.train_batch(shuffled[index * recipe.batch : (index + 1) * recipe.batch], epoch)
            if not math.isfinite(loss):
                diverged = f"the loss became {loss} in epoch {epoch}"
                break
            total += loss
        if diverged:
            break
        losses.append(total / batches)
        errors.append(free_run_rmse(engine, val))
        if not math.isfinite(errors[-1]):
            diverged = f"the validation error became {errors[-1]} in epoch {epoch}"
            break
        if stopping.is_best(errors[-1]):
            kept, best_epoch = engine.weights(), epoch
        if on_epoch:
            on_epoch(epoch, losses[-1], errors[-1])
        if stopping.stop:
            break
    model.load_state_dict({name: torch.from_numpy(array) for name, array in kept.items()}, strict=False)
    return Training(model, len(losses), best_epoch, diverged, losses, errors)
