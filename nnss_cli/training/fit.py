"""The training loop: candidates, shuffled mini-batches, a validation run each epoch, early stopping."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np
import torch

from nnss_cli.baselines.subspace import constant_channels
from nnss_cli.datasets.record import FittingData, FloatArray, Record
from nnss_cli.datasets.windows import SHORTEST, beginnings, sliding_windows
from nnss_cli.errors import InputError
from nnss_cli.iterative import EarlyStopping, EpochCallback, named_random, waiting_for
from nnss_cli.model.initial import SINGULAR
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors
from nnss_cli.training.candidates import ALTERNATIVES, PAYS, SIMPLEST, blocks, chance, pays, pooled, worth_trying
from nnss_cli.training.cascade import cascade_start, train_cascade
from nnss_cli.training.engine import Engine, ReferenceEngine, free_run_errors, free_run_rmse
from nnss_cli.training.feedback import feedback_start
from nnss_cli.training.gauss_newton import gauss_newton
from nnss_cli.training.lure_start import linear_layer
from nnss_cli.training.recipe import Recipe
from nnss_cli.training.warm import LinearStart, differences, linear_start, see_windows, step_size, sum_up, warm_start

LinearStarter: TypeAlias = Callable[[tuple[Record, ...], tuple[Record, ...], int, float, int, bool], LinearStart]
"""`linear_start`, or what remembers its results."""
FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError, SINGULAR)
"""How a start may fail on poor data: too short, constant, singular."""
TRIAL = 0.25
"""Share of the epochs after which a candidate is given up that is behind the one before."""
FEW = 10
"""Epochs after which one is given up where none was better than its start, if the share above is as many or more."""
REPLACED = {("stability", "initial"), ("integrator", "both")}
"""What was taken before, and what takes its place: a cold start that of a layer."""


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
    candidates: dict[str, float] = field(default_factory=dict)
    """Name of a candidate → validation error after the first stage, where there were several."""


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
    clock = _Clock(recipe.budget)
    train, val = data.normalised()
    first, *further = stages(train, recipe)
    names = worth_trying(data, order, recipe, first)
    linear = _remembering()
    parts = [(first, val)]
    if names and recipe.judge == "blocks":
        parts += blocks(first, val, data.init_window)
    epochs = 0

    def judge(base: Recipe, alternative: str, rivals: list[float]) -> list[_Attempt]:
        """A candidate, trained on each part of the data."""
        nonlocal epochs
        tried: list[_Attempt] = []
        for (records, held), rival in zip(parts, rivals, strict=True):
            changes = recipe.alternatives(min(map(len, records))).get(alternative, {})
            report = _after(epochs, on_epoch)
            candidate = base.replace(**changes)
            tried.append(_Attempt(data, order, seed, candidate, records, held, rival, clock, report, linear))
            if not clock.up:
                tried[-1].train(records, tried[-1].recipe.epochs)
            epochs += len(tried[-1].watch.losses)
        return tried

    best = judge(recipe.simplest(), "", [math.inf] * len(parts))
    taken = best[0]
    if clock.up and taken.samples == 0:
        raise InputError(
            f"budget: {recipe.budget:g} s are too few for one candidate, whose start alone took {clock.elapsed:.1f} s: "
            "give more, or --start random"
        )
    lengths = [sum(map(len, held)) for _, held in parts]

    def error_of(each: list[_Attempt]) -> float:
        return pooled([one.error for one in each], lengths)

    def squares_of(each: list[_Attempt]) -> FloatArray:
        return np.concatenate([one.squares() for one in each])

    errors: dict[str, float] = {SIMPLEST: error_of(best)}
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
        if taken.model.architecture.integrator and not taken.recipe.replace(**without).integrates:
            continue  # the optimiser of this alternative cannot train one
        tried = judge(taken.recipe, name, [one.error for one in best])
        if clock.up and len(parts) > 1:  # some part was not trained to its end
            unfinished.append(name)
            continue
        kept = [won for won in held if (won, name) not in REPLACED]
        label = " with ".join(ALTERNATIVES[won] for won in [*kept, name])
        error, rival = error_of(tried), error_of(best)
        errors[label] = error
        before, after = (each[0].model.architecture.weights for each in (best, tried))
        if name == "stability" and after < before:
            taking, margin = pays(error, rival, simpler=True), f"with {after} weights for {before}"
        elif taking := pays(error, rival):
            margin = f"by more than {PAYS:.0%}"
        elif error < rival:
            p = chance(squares_of(tried), squares_of(best))
            taking = pays(error, rival, by_chance=p)
            margin = f"by {1 - error / rival:.1%}, hardly by chance (p = {p:.1g})"
        if taking:
            best, taken, held = tried, tried[0], [*kept, name]
            remarks += (f"{label} taken: it lowers the {judged} {margin}",)
    for index, records in enumerate(further, 1):
        if not taken.watch.diverged and not clock.up:
            taken.train(records, taken.epochs(index))
        elif clock.up:
            unfinished.append(f"stage of {sum(map(len, records))} samples")
    weights, outputs = taken.model.architecture.weights, sum(record.y.size for record in train)
    if weights > outputs and taken.recipe.optimiser == "gauss-newton":
        lower = "a lower order or" if order > 1 else "a lower"  # no order is below 1
        remarks += (f"{weights} weights for {outputs} measured outputs: take {lower} --hidden, or more samples",)
    if unfinished or clock.up:
        left = f", without {', '.join(unfinished)}" if unfinished else ""
        remarks += (f"stopped by the budget of {recipe.budget:g} s{left}",)
    return taken.training(remarks, errors if len(errors) > 1 else {})


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


class _Clock:
    """What is left of a budget [s]; without one, always something."""

    def __init__(self, budget: float) -> None:
        self.budget, self.began = budget or math.inf, time.monotonic()

    @property
    def elapsed(self) -> float:
        """Seconds since the training began."""
        return time.monotonic() - self.began

    @property
    def up(self) -> bool:
        """Whether nothing is left."""
        return self.elapsed > self.budget


class _Attempt:
    """One candidate: its model, its start and what came of it so far."""

    def __init__(
        self,
        data: FittingData,
        order: int,
        seed: int,
        recipe: Recipe,
        train: tuple[Record, ...],
        val: tuple[Record, ...],
        rival: float,
        clock: _Clock,
        on_epoch: EpochCallback | None,
        linear: LinearStarter,
    ) -> None:
        """Build the model and its start from records of the first stage and of validation, normalised.

        It is given up where after a share `TRIAL` of its epochs it is still behind `rival`, the lowest error before it,
        or where none of the first `FEW` was better than its start.
        """
        self.recipe, self.seed = recipe, seed
        architecture = recipe.architecture(order, data.input_count, data.output_count)
        self.model = NNSS(architecture, data.scaling, data.channels, data.Ts)
        self.start, self.remarks = begin(
            self.model, recipe.initial, train, val, seed, data.init_window, linear, lambda: not clock.up
        )
        self.watch = _Watch(val, data.init_window, recipe, rival, clock, on_epoch)
        self.samples = 0  # of the last stage that ended well

    def epochs(self, stage: int) -> int:
        """Epochs of a later stage, 1, 2, …, at most: half as many as before, but for a cascade, of so few weights."""
        return self.recipe.epochs if self.start == "cascade" else max(1, self.recipe.epochs // 2**stage)

    @property
    def error(self) -> float:
        """Lowest validation error so far; inf for a training that was given up."""
        return math.inf if self.watch.diverged else self.watch.stopping.best

    def squares(self) -> FloatArray:
        """Of the best weights' errors on the validation records (K,), over all outputs of a sample."""
        self.watch.begin_again()
        self.watch.see()
        errors = free_run_errors(self.watch.engine, self.watch.val, self.watch.init_window)
        return np.concatenate([np.square(each).sum(axis=1) for each in errors])

    def train(self, records: tuple[Record, ...], epochs: int) -> None:
        """Go on from the best weights so far, on these records, normalised."""
        recipe, watch, later = self.recipe, self.watch, self.samples > 0
        u, y = sliding_windows(records, recipe.window, recipe.stride)
        batches = max(1, len(u) // recipe.batch) if recipe.optimiser == "adam" else 1
        watch.take(build_engine(self.model, u, y, recipe), records, batches if recipe.patience_unit == "steps" else 1)
        try:
            if later:
                watch.begin_again()
                watch.trial = 0  # it was taken: no rival is left, and what its start was is long past
            elif self.start != "random":
                watch.start()
            if recipe.optimiser == "adam":
                _adam(watch.engine, len(u), batches, recipe, named_random(self.seed, "shuffling"), watch)
                if recipe.refine > 0 and not watch.diverged:
                    watch.begin_again()
                    self.gauss_newton(u, y, min(recipe.refine, epochs))
            elif recipe.optimiser == "lbfgs":
                _lbfgs(watch.engine, epochs, watch)
            else:
                self.gauss_newton(u, y, epochs)
        except SINGULAR:  # torch refuses what the compiled step turns into numbers that are not finite
            watch.diverged = f"the step's matrix became singular in epoch {len(watch.losses) + 1}"
        samples = sum(len(record) for record in records)
        if later and watch.diverged:
            self.remarks += (f"trained on the first {self.samples} samples: on {samples}, {watch.diverged}",)
            watch.diverged = ""
            return
        self.samples = samples

    def gauss_newton(self, u: Sequence[FloatArray], y: Sequence[FloatArray], iterations: int) -> None:
        """Gauss–Newton iterations from the weights as they are, of windows u (L, r), y (L, m)."""
        a = self.model.architecture
        if self.start == "cascade" and not a.integrator:
            train_cascade(
                self.model, self.watch.engine, u, y, iterations, self.watch.goes_on, self.recipe.fixed_encoder,
                self.recipe.threads,
            )  # fmt: skip
            return
        gauss_newton(
            self.watch.engine, u, y, iterations, self.watch.goes_on, a.encoder_window, self.recipe.fixed_encoder,
            a.integrator, self.recipe.threads,
        )  # fmt: skip

    def training(self, further: tuple[str, ...], candidates: dict[str, float]) -> Training:
        """What came of it, with the best weights in the model, and `further` remarks."""
        watch, remarks = self.watch, self.remarks
        if self.start != "random" and watch.best_epoch == 0 and not watch.diverged:
            refused = (
                "validation refused every epoch after the"
                if watch.losses
                else "no step lowered the training error of the"
            )
            remarks += (f"{refused} {self.start} start",)
        self.model.load_state_dict({name: torch.from_numpy(array) for name, array in watch.kept.items()}, strict=False)
        watch.begin_again()
        self.model.initial_spread.copy_(torch.from_numpy(watch.engine.see(watch.records)))
        return Training(
            self.model,
            len(watch.losses),
            watch.best_epoch,
            watch.diverged,
            watch.losses,
            watch.errors,
            remarks + further,
            candidates,
        )


def begin(
    model: NNSS,
    initial: str,
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    seed: int,
    init_window: int = 1,
    linear: LinearStarter | None = None,
    in_time: Callable[[], bool] = lambda: True,
) -> tuple[str, tuple[str, ...]]:
    """Fill the weights of `model` with the start asked for, or with the next that these data allow.

    With an integrator the start is that of the outputs' differences. An encoder that sees windows gets the regression
    of the start's own states on them.

    Args:
        model: changed in place.
        initial: one of `STARTS`: feedback and cascade fall back to linear, linear to random.
        train: experiments in normalised units.
        val: validation experiments.
        seed: of the random weights and the feedback's gain.
        init_window: first samples of a validation experiment that tell x(0).
        linear: what remembers the results of `linear_start`, which is called where it is None.
        in_time: whether there is time for another iteration of a feedback or cascade.

    Returns:
        The start that was taken, and remarks on those that were not.
    """
    linear, a = linear or linear_start, model.architecture
    if a.integrator:
        size = step_size(train)
        steps, held = (differences(records, size) for records in (train, val))
        begun = _begin(model, initial, steps, held, seed, init_window, linear, in_time)
        sum_up(model, size, train)
    else:
        begun = _begin(model, initial, train, val, seed, init_window, linear, in_time)
    if a.encoder_window > 1 and begun[0] != "random":
        see_windows(model, train)
    return begun


def _begin(
    model: NNSS,
    initial: str,
    train: tuple[Record, ...],
    val: tuple[Record, ...],
    seed: int,
    init_window: int,
    linear: LinearStarter,
    in_time: Callable[[], bool],
) -> tuple[str, tuple[str, ...]]:
    """`begin` without a look at the integrator."""
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
        a = model.architecture
        waiting_for("SSEST, to start from")
        start = linear(train, val, a.order, a.gamma, init_window, a.feedthrough)
    except FAILURES as error:
        return "random", (f"{failed('SSEST', error)}: started from random weights",)
    beyond = {
        "feedback": ("saturated feedback", feedback_start, "no iterate validated better than the linear model"),
        "cascade": ("two linear parts with units between", cascade_start, "no iterate keeps the layer's promise"),
    }
    if initial in beyond:
        what, make, why = beyond[initial]
        waiting_for(f"{what}, to start from")
        try:
            if make(model, start, train, val, named_random(seed, initial), init_window, in_time):
                return initial, remarks
            remarks += (f"{initial} start refused: {why if in_time() else 'the budget was over'}",)
        except FAILURES as error:
            remarks += (f"{failed(f'{initial} start', error)}: started from the linear model",)
            draw()  # what failed may have changed some weights
    try:
        if a.stability == "incremental":
            linear_layer(model, start, train, named_random(seed, "units"))
        else:
            warm_start(model, start)
    except FAILURES as error:
        draw()
        return "random", (*remarks, f"{failed('linear start', error)}: started from random weights")
    return "linear", remarks


class _Watch:
    """Takes in each epoch: the validation run, the best weights, whether to stop."""

    engine: Engine

    def __init__(
        self,
        val: tuple[Record, ...],
        init_window: int,
        recipe: Recipe,
        rival: float,
        clock: _Clock,
        on_epoch: EpochCallback | None,
    ) -> None:
        self.val, self.init_window, self.clock, self.on_epoch = val, init_window, clock, on_epoch
        # Adam begins far behind whatever it comes to, so does what was a start for differences, and a layer of few
        # weights goes on getting better where a generator of many has begun to overfit
        patient = recipe.optimiser == "adam" or recipe.integrator == "yes" or recipe.stability == "incremental"
        self.rival, self.trial = rival, 0 if patient else max(1, int(TRIAL * recipe.epochs))
        self.stopping = EarlyStopping(recipe.patience, recipe.improvement)
        self.kept: Tensors = {}
        self.best_epoch, self.diverged, self.epoch_waits = 0, "", 1
        self.losses: list[float] = []
        self.errors: list[float] = []

    def take(self, engine: Engine, records: tuple[Record, ...], epoch_waits: int) -> None:
        """Watch this engine, trained on these records, from now on; an epoch adds `epoch_waits` to the wait."""
        self.engine, self.records, self.epoch_waits = engine, records, epoch_waits
        self.kept = self.kept or engine.weights()

    def start(self) -> None:
        """Let the weights before the first epoch count: a warm start may be the best there is."""
        self.stopping.is_best(self.val_error())

    def val_error(self) -> float:
        """Of the weights as they are, by the rule that scores them."""
        self.see()
        return free_run_rmse(self.engine, self.val, self.init_window)

    def see(self) -> None:
        """Where a window tells x(0): how far from the guess it may be, by the weights as they are."""
        if self.init_window > 1:
            self.engine.see(self.records)

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
        behind = epoch == self.trial and self.stopping.best > self.rival
        hopeless = epoch == FEW <= self.trial and self.best_epoch == 0
        return not (self.stopping.stop or behind or hopeless or self.clock.up)


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
