"""Weights before the first epoch: drawn, or by SSEST's model, a saturated feedback, two linear parts in a row."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from nnss_cli.baselines.subspace import constant_channels
from nnss_cli.datasets.record import Record
from nnss_cli.iterative import named_random, waiting_for
from nnss_cli.model.initial import SINGULAR
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.cascade import cascade_start
from nnss_cli.training.feedback import feedback_start
from nnss_cli.training.lure_start import linear_layer
from nnss_cli.training.warm import LinearStart, differences, linear_start, see_windows, step_size, sum_up, warm_start

LinearStarter: TypeAlias = Callable[[tuple[Record, ...], tuple[Record, ...], int, float, int, bool], LinearStart]
"""`linear_start`, or what remembers its results."""
FAILURES = (ValueError, ArithmeticError, np.linalg.LinAlgError, SINGULAR)
"""How a start may fail on poor data: too short, constant, singular."""


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
