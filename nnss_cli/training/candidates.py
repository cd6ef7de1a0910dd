"""Which candidates a recipe tries on a record, by which data they are judged, and what one must gain to be taken."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from nnss_cli.baselines.arx import feedthrough_p_value, longest_time_constant
from nnss_cli.datasets.record import FittingData, FloatArray, Record
from nnss_cli.datasets.windows import SHORTEST
from nnss_cli.training.attempt import LENGTHS, WINDOWED
from nnss_cli.training.recipe import Recipe

LEVEL = 0.01
"""Of the test whether u(k) shows in y(k), at most; else no feedthrough is tried."""
PAYS = 0.2
"""What a further candidate must take off the error, relative, unless it is a simpler one, or surely better."""
BY_CHANCE = 0.05
"""At most, of a lower error; a candidate that is taken wrongly at that level is as good as its rival."""
STRETCHES = 8
"""Of a validation record, whose mean square errors are compared one by one."""
STRETCH = 50
"""Samples of one, at least: in fewer, errors of a simulation are too much like those before."""
BLOCKS = 5
"""Blocks of cross-validation, at most."""
SIMPLEST = "as it is"
ALTERNATIVES = {
    "feedthrough": "feedthrough",
    "integrator": "integrator",
    "both": "integrator and feedthrough",
    "scheduling": "scheduling on u",
    "lengthen": "windows that lengthen",
    "stability": "incremental layer",
    "cascade": "incremental layer from a cascade",
    "initial": "cold start",
}
"""Field of a recipe that leaves something open, or several together, → the name of what is tried then."""


def worth_trying(data: FittingData, order: int, recipe: Recipe, first: tuple[Record, ...]) -> tuple[str, ...]:
    """The alternatives of the recipe that these data speak for, by the names of its fields. Only training is asked.

    A feedthrough where the input shows at once in the output, an integrator where a pole cannot be told from one, both
    together where both are (the input may show at once in what is summed up), windows that lengthen where the weights
    and the states of the shortest are half as many as the measured outputs or fewer (else it says nothing that they
    fit), an incrementally stable layer where the first stage is all there is and its weights do not outnumber the
    measured outputs, a deep cold model where the generator's do. A layer of few weights is ahead on a short beginning
    of a record, and may be behind on all of it, so that on longer ones it is tried from a cascade alone, which must be
    ahead by far.

    Args:
        data: physical units.
        order: number of states n.
        recipe: with something left open.
        first: records of the first stage.
    """
    open_ones = recipe.alternatives(min(map(len, first)))
    known = sum(record.y.size for record in data.train)
    staged = sum(map(len, first)) < sum(map(len, data.train))
    windowed = min(sum(map(len, first)), WINDOWED)

    def weights(changes: dict[str, Any]) -> int:
        model = recipe.simplest().replace(**changes, encoder_window=1)  # the encoder's are a regression on states
        return model.architecture(order, data.input_count, data.output_count).weights

    speaks: dict[str, Callable[[], bool]] = {
        "feedthrough": lambda: feedthrough_p_value(data.train) <= LEVEL,
        "integrator": lambda: (
            recipe.simplest().integrates
            and order > data.output_count
            and longest_time_constant(data.train) >= max(map(len, data.train))
        ),
        "both": lambda: {"feedthrough", "integrator"} <= set(found),
        "scheduling": lambda: True,
        "lengthen": lambda: 2 * (weights({}) + order * (windowed // LENGTHS[0][0])) <= windowed * data.output_count,
        "stability": lambda: not staged and weights(open_ones["stability"]) <= known,
        "cascade": lambda: staged and order >= 2,
        "initial": lambda: weights({}) > known,
    }
    found: list[str] = []
    for name in open_ones:  # both come after each
        if speaks[name]():
            found.append(name)
    return tuple(found)


def blocks(
    train: tuple[Record, ...], val: tuple[Record, ...], init_window: int = 1
) -> list[tuple[tuple[Record, ...], tuple[Record, ...]]]:
    """Other ways to part the same data: training records cut along time into blocks, each held out once.

    A block has about as many samples as validation, or more, so that there are at most `BLOCKS` with validation
    itself, which is trained on here. What lies before and after a block becomes an experiment each; pieces too short
    to simulate are left out.

    Args:
        train: experiments.
        val: validation experiments.
        init_window: first samples of a held-out experiment that tell x(0).

    Returns:
        Training and held-out experiments of each block; none where training is shorter than validation.
    """
    total, validation = (sum(map(len, records)) for records in (train, val))
    count = min(BLOCKS - 1, total // validation)
    shortest = max(SHORTEST, init_window + 1)  # of what is held out
    found = []
    for begin, end in pairwise(total * i // max(count, 1) for i in range(count + 1)):
        kept: list[Record] = []
        held: list[Record] = []
        at = 0
        for record in train:
            K = len(record)
            a, b = (min(max(bound - at, 0), K) for bound in (begin, end))
            held += _piece(record, a, b, shortest)
            kept += _piece(record, 0, a, SHORTEST) + _piece(record, b, K, SHORTEST)
            at += K
        if held:
            found.append(((*kept, *val), tuple(held)))
    return found


def _piece(record: Record, begin: int, end: int, shortest: int) -> list[Record]:
    """These samples of it, or nothing where they are too few."""
    return [record[begin:end]] if end - begin >= shortest else []


def pooled(errors: Sequence[float], lengths: Sequence[int]) -> float:
    """RMSE over several records from that of each and its length [samples]; inf where one diverged."""
    total = sum(lengths)
    return math.hypot(*(error * math.sqrt(length / total) for error, length in zip(errors, lengths, strict=True)))


def chance(squares: FloatArray, rival: FloatArray) -> float:
    """How likely so much lower squares are by chance, where on the average they are not lower: a one-sided p-value.

    Neighbouring errors of a simulation are alike, so samples are no evidence each. Student's test is of the mean
    differences over `STRETCHES` consecutive stretches, which may have any variances and hardly depend on each other.
    Source: R. Ibragimov and U. Müller, "t-statistic based correlation and heterogeneity robust inference", Journal of
    Business & Economic Statistics 28(4), 2010; of forecasts' errors, F. Diebold and R. Mariano, ibid. 13(3), 1995.

    Args:
        squares: of a candidate's errors on what was held out (K,), in order.
        rival: of its rival's.

    Returns:
        1 where there are fewer than `STRETCH` samples a stretch.
    """
    if len(squares) < STRETCH * STRETCHES:
        return 1.0
    means = np.array([part.mean() for part in np.array_split(rival - squares, STRETCHES)])
    spread = float(means.std(ddof=1))
    if not spread > 0:
        return float(not means[0] > 0)
    from scipy.stats import t as student

    return float(student.sf(means.mean() / spread * math.sqrt(STRETCHES), STRETCHES - 1))


def pays(error: float, rival: float, simpler: bool = False, by_chance: float = 1.0) -> bool:
    """Whether a candidate is taken: its error is lower than its rival's, and if it is more complex, clearly so.

    That is by more than `PAYS`, or by anything that chance explains at `BY_CHANCE` or less.

    Args:
        error: inf for one that diverged.
        rival: of the best candidate so far.
        simpler: whether it has fewer weights than that, and promises more.
        by_chance: of `chance`.
    """
    return error < (1 if simpler or by_chance <= BY_CHANCE else 1 - PAYS) * rival
