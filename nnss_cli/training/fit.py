"""The training loop: shuffled mini-batches, a validation run each epoch, early stopping."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from nnss_cli.baselines.subspace import constant_channels
from nnss_cli.datasets.record import FittingData, FloatArray, Record
from nnss_cli.datasets.windows import sliding_windows
from nnss_cli.iterative import EarlyStopping, EpochCallback, named_random
from nnss_cli.model.initial import SINGULAR
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors
from nnss_cli.training.engine import Engine, ReferenceEngine, free_run_rmse
from nnss_cli.training.feedback import feedback_start
from nnss_cli.training.gauss_newton import gauss_newton
from nnss_cli.training.recipe import Recipe
from nnss_cli.training.warm import linear_start, warm_start

FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError, SINGULAR)
"""How a start may fail on poor data: too short, constant, singular."""


@dataclass(frozen=True)
class Training:
    """How a training went."""

    model: NNSS
    """The model of the best validation epoch."""
    epochs: int
    """Epochs that were run."""
    best_epoch: int
    """Epoch of the model kept, from 1; 0 when none was finite, or none better than a linear or feedback start."""
    diverged: str = ""
    """Why the training was given up, or ""."""
    train_loss: list[float] = field(default_factory=list)
    """Mean loss of each epoch."""
    val_rmse: list[float] = field(default_factory=list)
    """Validation error of each epoch: RMSE of a free run in normalised units."""
    remarks: tuple[str, ...] = ()
    """What a reader of the result must know of the start and what came of it."""


def build_engine(model: NNSS, u: Sequence[FloatArray], y: Sequence[FloatArray], recipe: Recipe) -> Engine:
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
        InputError: a training record is shorter than the window.
    """
    torch.set_num_threads(1)  # tiny matrices: more threads are slower, and the result would depend on them
    train, val = data.normalised()
    u, y = sliding_windows(train, recipe.window, recipe.stride)

    architecture = recipe.architecture(order, data.input_count, data.output_count)
    model = NNSS(architecture, data.scaling, data.channels, data.Ts)
    start, remarks = begin(model, recipe.initial, train, val, seed, data.init_window)
    engine = build_engine(model, u, y, recipe)

    batches = max(1, len(u) // recipe.batch) if recipe.optimiser == "adam" else 1
    watch = _Watch(engine, val, data.init_window, recipe, batches, on_epoch)
    try:
        if start != "random":
            watch.start()
        if recipe.optimiser == "adam":
            _adam(engine, len(u), batches, recipe, named_random(seed, "shuffling"), watch)
            if recipe.refine > 0 and not watch.diverged:
                watch.begin_again()
                gauss_newton(engine, y, min(recipe.refine, recipe.epochs), watch.goes_on, recipe.fixed_encoder)
        elif recipe.optimiser == "lbfgs":
            _lbfgs(engine, recipe.epochs, watch)
        else:
            gauss_newton(engine, y, recipe.epochs, watch.goes_on, recipe.fixed_encoder)
    except SINGULAR:  # torch refuses what the compiled step turns into numbers that are not finite
        watch.diverged = f"the step's matrix became singular in epoch {len(watch.losses) + 1}"
    if start != "random" and watch.best_epoch == 0 and not watch.diverged:
        refused = (
            "validation refused every epoch after the" if watch.losses else "no step lowered the training error of the"
        )
        remarks += (f"{refused} {start} start",)
    model.load_state_dict({name: torch.from_numpy(array) for name, array in watch.kept.items()}, strict=False)
    return Training(model, len(watch.losses), watch.best_epoch, watch.diverged, watch.losses, watch.errors, remarks)


def begin(
    model: NNSS, initial: str, train: tuple[Record, ...], val: tuple[Record, ...], seed: int, init_window: int = 1
) -> tuple[str, tuple[str, ...]]:
    """Fill the weights of `model` with the start asked for, or with the next that these data allow.

    Args:
        model: changed in place.
        initial: one of `STARTS`: feedback falls back to linear, linear to random.
        train: experiments in normalised units.
        val: validation experiments.
        seed: of the random weights and the feedback's gain.
        init_window: first samples of a validation experiment that tell x(0).

    Returns:
        The start that was taken, and remarks on those that were not.
    """
    remarks: tuple[str, ...] = ()

    def draw() -> None:
        model.initialise(named_random(seed, "weights"))

    def failed(what: str, error: Exception) -> str:
        text = " ".join(str(error).split())
        constant = [f"; {name} is constant" for name in constant_channels(train) if name not in text]
        return f"{what} failed ({text}{''.join(constant)})"

    draw()
    if initial == "random":
        return initial, remarks
    try:
        linear = linear_start(train, val, model.architecture.order, model.architecture.gamma, init_window)
    except FAILURES as error:
        return "random", (f"{failed('SSEST', error)}: started from random weights",)
    if initial == "feedback":
        try:
            if feedback_start(model, linear, train, val, named_random(seed, "feedback"), init_window):
                return initial, remarks
            remarks += ("feedback start refused: no iterate validated better than the linear model",)
        except FAILURES as error:
            remarks += (f"{failed('feedback start', error)}: started from the linear model",)
            draw()  # what failed may have changed some weights
    try:
        warm_start(model, linear)
    except FAILURES as error:
        draw()
        return "random", (*remarks, f"{failed('linear start', error)}: started from random weights")
    return "linear", remarks


class _Watch:
    """Takes in each epoch: the validation run, the best weights, whether to stop."""

    def __init__(
        self,
        engine: Engine,
        val: tuple[Record, ...],
        init_window: int,
        recipe: Recipe,
        batches: int,
        on_epoch: EpochCallback | None,
    ) -> None:
        self.engine, self.val, self.init_window, self.on_epoch = engine, val, init_window, on_epoch
        self.epoch_waits = batches if recipe.patience_unit == "steps" else 1
        self.stopping = EarlyStopping(recipe.patience, recipe.improvement)
        self.kept, self.best_epoch, self.diverged = engine.weights(), 0, ""
        self.losses: list[float] = []
        self.errors: list[float] = []

    def start(self) -> None:
        """Let the weights before the first epoch count: a warm start may be the best there is."""
        self.stopping.is_best(self.val_error())

    def val_error(self) -> float:
        """Of the weights as they are, by the rule that scores them."""
        return free_run_rmse(self.engine, self.val, self.init_window)

    def begin_again(self) -> None:
        """Go back to the best weights, with fresh patience."""
        self.engine.place(_vector(self.kept))
        self.stopping.waited, self.stopping.reference = 0, self.stopping.best
        self.epoch_waits = 1

    def goes_on(self, loss: float) -> bool:
        """Note an epoch that ended with this loss; whether there is to be another."""
        epoch = len(self.losses) + 1
        if not math.isfinite(loss):
            self.diverged = f"the loss became {loss} in epoch {epoch}"
            return False
        self.losses.append(loss)
        self.errors.append(self.val_error())
        if not math.isfinite(self.errors[-1]):
            self.diverged = f"the validation error became {self.errors[-1]} in epoch {epoch}"
            return False
        if self.stopping.is_best(self.errors[-1], self.epoch_waits):
            self.kept, self.best_epoch = self.engine.weights(), epoch
        if self.on_epoch:
            self.on_epoch(epoch, loss, self.errors[-1])
        return not self.stopping.stop


def _adam(
    engine: Engine, windows: int, batches: int, recipe: Recipe, shuffling: np.random.Generator, watch: _Watch
) -> None:
    """Adam on shuffled mini-batches. As in the released code, an incomplete last one is left out."""
    for epoch in range(1, recipe.epochs + 1):
        shuffled = shuffling.permutation(windows)
        total = 0.0
        for index in range(batches):
            total += engine.train_batch(shuffled[index * recipe.batch : (index + 1) * recipe.batch], epoch)
            if not math.isfinite(total):
                break
        if not watch.goes_on(total / batches):
            return


def _lbfgs(engine: Engine, iterations: int, watch: _Watch) -> None:
    """L-BFGS with the exact gradient over all windows; an iteration counts as an epoch."""
    import scipy.optimize

    def after_iteration(intermediate_result: scipy.optimize.OptimizeResult) -> None:
        engine.place(intermediate_result.x)  # the line search may have left other weights behind
        if not watch.goes_on(float(intermediate_result.fun)):
            raise StopIteration

    start = _vector(engine.weights())
    loss, _ = engine.loss_and_gradient(start)
    if not math.isfinite(loss):
        watch.goes_on(loss)
        return
    scipy.optimize.minimize(
        engine.loss_and_gradient, start, jac=True, method="L-BFGS-B", callback=after_iteration,
        options={"maxiter": iterations, "maxfun": 20 * iterations, "maxcor": 20, "ftol": 0, "gtol": 0},
    )  # fmt: skip


def _vector(weights: Tensors) -> FloatArray:
    return np.concatenate([array.ravel() for array in weights.values()]).astype(np.float64)
