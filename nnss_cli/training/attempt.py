"""One candidate's training: shuffled mini-batches or Gauss–Newton, a validation run each epoch, early stopping."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from nnss_cli.datasets.record import FittingData, FloatArray, Record
from nnss_cli.datasets.windows import SHORTEST, beginnings, sliding_windows
from nnss_cli.iterative import EarlyStopping, EpochCallback, named_random
from nnss_cli.model.initial import SINGULAR
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import Tensors
from nnss_cli.training.cascade import train_cascade
from nnss_cli.training.engine import Engine, ReferenceEngine, free_run_errors, free_run_rmse
from nnss_cli.training.gauss_newton import gauss_newton
from nnss_cli.training.recipe import Recipe
from nnss_cli.training.start import LinearStarter, begin

LENGTHS = ((20, 40), (60, 30), (200, 20))
"""Samples of windows that lengthen, and Gauss–Newton iterations on each."""
WINDOWED = 2000
"""Samples that windows are of, all together and at most: each of their states costs as much as a weight."""
HIDDEN = 0.5
"""Share of a rival's training error that windows with states of their own must come below, and the whole records after
them: else no better optimum is hidden from whole records, and what validates better does so for other reasons."""
PACE = 5
"""Iterations whose pace tells whether windows will come below it."""
TRIAL = 0.25
"""Share of the epochs after which a candidate is given up that is behind the one before."""
FEW = 10
"""Epochs after which one is given up where none was better than its start, if the share above is as many or more."""


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
    """Name of a candidate → its error after the first stage, by which it was judged, where there were several."""
    judged_by: str = "val_rmse"
    """What that error is: on validation, or "block_rmse" over blocks of training and validation."""


def build_engine(model: NNSS, u: Sequence[FloatArray], y: Sequence[FloatArray], recipe: Recipe) -> Engine:
    """The engine that the recipe names."""
    if recipe.engine == "reference":
        return ReferenceEngine(model, u, y, recipe)
    from nnss_cli.training.fast import FastEngine

    return FastEngine(model, u, y, recipe)


class Clock:
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


class Attempt:
    """One candidate: its model, its start and what came of it so far."""

    def __init__(
        self,
        data: FittingData,
        order: int,
        seed: int,
        recipe: Recipe,
        train: tuple[Record, ...],
        val: tuple[Record, ...],
        rival: Attempt | None,
        clock: Clock,
        on_epoch: EpochCallback | None,
        linear: LinearStarter,
    ) -> None:
        """Build the model and its start from records of the first stage and of validation, normalised.

        It is given up where after a share `TRIAL` of its epochs it is still behind `rival`, the best before it,
        or where none of the first `FEW` was better than its start.
        """
        self.recipe, self.seed = recipe, seed
        # a rival's training error, where windows are tried against it
        self.fitted_before = rival.fitted if rival and recipe.lengthen == "yes" != rival.recipe.lengthen else math.inf
        self.needless = False  # windows do not come below `bar`, so nothing was trained
        architecture = recipe.architecture(order, data.input_count, data.output_count)
        self.model = NNSS(architecture, data.scaling, data.channels, data.Ts)
        self.start, self.remarks = begin(
            self.model, recipe.initial, train, val, seed, data.init_window, linear, lambda: not clock.up
        )
        self.watch = Watch(val, data.init_window, recipe, rival.error if rival else math.inf, clock, on_epoch)
        self.samples = 0  # of the last stage that ended well

    def epochs(self, stage: int) -> int:
        """Epochs of a later stage, 1, 2, …, at most: half as many as before, but for a cascade, of so few weights."""
        return self.recipe.epochs if self.start == "cascade" else max(1, self.recipe.epochs // 2**stage)

    @property
    def error(self) -> float:
        """Lowest validation error so far; inf for a training that was given up."""
        return math.inf if self.watch.diverged else self.watch.stopping.best

    @property
    def fitted(self) -> float:
        """Lowest training error so far, RMSE/σ; inf before the first epoch."""
        return math.sqrt(min(self.watch.losses, default=math.inf))

    @property
    def bar(self) -> float:
        """The training error that windows must come below; inf where they are not tried against a rival."""
        return HIDDEN * self.fitted_before

    @property
    def hidden(self) -> bool:
        """Whether it has found an optimum that whole records hid from its rival; so has any that was not to."""
        return math.isinf(self.bar) or self.fitted < self.bar

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
        watch, cascade = self.watch, self.start == "cascade"
        if cascade and not self.model.architecture.integrator:
            train_cascade(
                self.model, watch.engine, u, y, iterations, watch.goes_on, self.recipe.fixed_encoder,
                self.recipe.threads,
            )  # fmt: skip
            return
        begin = self.lengthen() if self.recipe.lengthen == "yes" and self.samples == 0 and not cascade else None
        if self.needless:
            return
        self._descend(watch.engine, u, y, iterations, watch.goes_on, begin)

    def _descend(
        self,
        engine: Engine,
        u: Sequence[FloatArray],
        y: Sequence[FloatArray],
        iterations: int,
        goes_on: Callable[[float], bool],
        begin: FloatArray | None,
    ) -> list[FloatArray]:
        """`nnss_cli.training.gauss_newton.gauss_newton` as the recipe has it."""
        a, recipe = self.model.architecture, self.recipe
        return gauss_newton(
            engine, u, y, iterations, goes_on, a.encoder_window, recipe.fixed_encoder, a.integrator, recipe.threads,
            begin,
        )  # fmt: skip

    def lengthen(self) -> FloatArray | None:
        """Gauss–Newton on windows with states of their own, each longer one from the states found; x(0) of the records.

        Over a whole record of a plant that rings, errors in phase pile up, and the nearest optimum may be far from the
        best; over 20 samples they do not. Source: H. G. Bock, "Recent advances in parameter identification techniques
        for O.D.E.", in: Numerical Treatment of Inverse Problems in Differential and Integral Equations, 1983 (multiple
        shooting). Here the windows are not tied together but grow.

        With more free states a window's error is no higher than a whole record's could become, but for an optimum that
        is missed here as well. So it ends, and is `needless`, as soon as a window's is not below `bar`, or is below
        the rival's and falls too slowly. Above the rival's it may stand still for a while: it is not at an optimum.

        Returns:
            None where no window fits twice into the shortest record, or no step lowered an error.
        """
        watch, records = self.watch, self.watch.records
        if sum(map(len, records)) > WINDOWED:
            records = beginnings(records, WINDOWED, SHORTEST)
        losses: list[float] = []  # of one length

        def goes_on(loss: float) -> bool:
            losses.append(loss)
            slow = loss < self.fitted_before**2 and not in_reach(losses, most - len(losses), self.bar)
            return math.isfinite(loss) and not slow and not watch.clock.up

        paths: list[FloatArray] = []  # states of each record, as far as whole windows go
        for L, iterations in LENGTHS:
            if min(map(len, records)) < 2 * L or self.model.architecture.encoder_window >= L:
                continue
            u, y = sliding_windows(records, L, L)
            engine = build_engine(self.model, u, y, self.recipe)
            engine.place(_vector(watch.engine.weights()))
            begins = [path[: len(record) - L + 1 : L] for path, record in zip(paths, records, strict=False)]
            most = min(iterations, self.recipe.epochs)
            losses.clear()
            states = self._descend(engine, u, y, most, goes_on, np.concatenate(begins) if begins else None)
            if not states:
                break
            if math.sqrt(losses[-1]) >= self.bar:
                self.needless = True
                return None
            watch.engine.place(_vector(engine.weights()))
            ends = np.cumsum([len(record) // L * L for record in records])
            paths = np.split(np.concatenate(states), ends[:-1])
        self.needless = not paths and math.isfinite(self.bar)
        return np.array([path[0] for path in paths]) if paths else None

    def training(self, further: tuple[str, ...], candidates: dict[str, float], judged_by: str) -> Training:
        """What came of it, with the best weights in the model, `further` remarks and what else was tried."""
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
            judged_by,
        )


def in_reach(losses: Sequence[float], left: int, bar: float) -> bool:
    """Whether a mean square error that falls as over the last `PACE` iterations comes below bar² in those left.

    Where there were no more than those yet, it may.
    """
    return len(losses) <= PACE or losses[-1] * (losses[-1] / losses[-1 - PACE]) ** (left / PACE) < bar**2


class Watch:
    """Takes in each epoch: the validation run, the best weights, whether to stop."""

    engine: Engine

    def __init__(
        self,
        val: tuple[Record, ...],
        init_window: int,
        recipe: Recipe,
        rival: float,
        clock: Clock,
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
    engine: Engine, windows: int, batches: int, recipe: Recipe, shuffling: np.random.Generator, watch: Watch
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


def _lbfgs(engine: Engine, iterations: int, watch: Watch) -> None:
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
