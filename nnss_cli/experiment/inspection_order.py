"""A first guess of a record's linear order, in bounded time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nnss_cli.baselines.arx import scaling_at_rest
from nnss_cli.baselines.n4sid import matlab_horizon, n4sid
from nnss_cli.baselines.ssregest import high_order_model
from nnss_cli.baselines.statespace import LinearStateSpace, simulation_rms
from nnss_cli.baselines.subspace import Horizon
from nnss_cli.datasets.record import FloatArray, Record, Scaling
from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection_dynamics import excerpt
from nnss_cli.experiment.order import MARGIN

ORDER_SAMPLES = 4_000  # samples fitted on; half as many judge
LARGEST = 6  # order tried
HOW_GUESSED = "N4SID, 4 horizons; 'nnss order' tries all"


@dataclass(frozen=True)
class OrderCandidate:
    """What is known about one order."""

    order: int
    """Number of states n."""
    hankel: float | None
    """n-th Hankel singular value of a regularised high-order ARX model, relative to the first."""
    train: float
    """Training error of N4SID's best model: RMS over samples and outputs, normalised units."""
    val: float
    """Validation error, likewise."""


@dataclass(frozen=True)
class OrderGuess:
    """What a linear model's order might be."""

    suggested: int | None
    """The lowest order whose validation error is within 5 % of the lowest; None where no model could be had."""
    candidates: tuple[OrderCandidate, ...]
    """What is known by order."""
    train_samples: int
    """Samples fitted on."""
    val_samples: int
    """Samples that judged."""
    constant: float | None
    """Validation error of a constant, the training mean, in the same units; None where nothing judged."""
    left: tuple[float | None, ...] = ()
    """Share of each output's power that the best of these models leaves of `whole`; None where none simulates it."""


def guess_order(
    train: Sequence[FloatArray],
    val: Sequence[FloatArray],
    inputs: int,
    about_means: bool = False,
    whole: Sequence[FloatArray] = (),
) -> OrderGuess:
    """A first guess of the linear order, in bounded time: N4SID with four horizons an order, orders 1 … 6.

    `nnss order` searches all horizons, on all samples; this takes up to 4,000 and 2,000.

    Args:
        train: stretches without gaps to fit on (K, c), inputs first.
        val: later stretches, to judge on.
        inputs: number of inputs r, at least 1.
        about_means: models are about the means of the outputs, in the place of the outputs at rest.
        whole: stretches on which to say what the models leave; the guess does not look at them.
    """
    fit, judge = (
        tuple(Record(part[:, :inputs], part[:, inputs:], 1.0) for part in excerpt(parts, limit, inputs))
        for parts, limit in ((train, ORDER_SAMPLES), (val, ORDER_SAMPLES // 2))
    )
    counts = sum(map(len, fit)), sum(map(len, judge))
    if not fit or not judge:
        return OrderGuess(None, (), *counts, None)
    scaling = Scaling.of(fit) if about_means else scaling_at_rest(fit)  # as models of own records are
    fit, judge = tuple(map(scaling.apply, fit)), tuple(map(scaling.apply, judge))
    r, m = fit[0].input_count, fit[0].output_count
    sigma = _hankel(fit, r + m, m)
    found, kept = [], []
    for order in range(1, LARGEST + 1):
        models = [model for model in (_n4sid(fit, order, h) for h in _horizons(order, r, m)) if model is not None]
        errors = [simulation_rms(model, judge) for model in models]
        if errors and math.isfinite(min(errors)):
            hankel = float(sigma[order - 1] / sigma[0]) if len(sigma) >= order and sigma[0] > 0 else None
            kept.append(models[int(np.argmin(errors))])
            found.append(OrderCandidate(order, hankel, simulation_rms(kept[-1], fit), min(errors)))
    lowest = min((candidate.val for candidate in found), default=0.0)
    good = [candidate.order for candidate in found if candidate.val <= MARGIN * lowest]
    mean = np.concatenate([record.y for record in fit]).mean(axis=0)
    constant = float(np.sqrt(np.mean((np.concatenate([record.y for record in judge]) - mean) ** 2)))
    judged = [scaling.apply(Record(part[:, :inputs], part[:, inputs:], 1.0)) for part in whole]
    return OrderGuess(good[0] if good else None, tuple(found), *counts, constant, _left(kept, judged))


def _left(models: Sequence[LinearStateSpace], records: Sequence[Record]) -> tuple[float | None, ...]:
    """Share of each output's power that the best model leaves in free simulation, means apart; () without records.

    A start is fitted to each record, and takes n degrees of freedom from all outputs: counted, since of many short
    stretches starts alone would explain noise.
    """
    if not models or not records:
        return ()
    samples = sum(map(len, records))
    with np.errstate(over="ignore"):  # of what lies far beyond the training part
        power = np.concatenate([record.y for record in records]).var(axis=0)
    best = np.full(len(power), np.inf)
    for model in models:
        freedom = samples - model.order * len(records)
        with np.errstate(all="ignore"):  # of an unstable model
            error = [record.y - model.simulate(record.u, model.initial_state(record))[0] for record in records]
            share = np.concatenate(error).var(axis=0) / power * samples / freedom
        if freedom > 0:
            best = np.fmin(best, share)
    return tuple(float(share) if math.isfinite(share) else None for share in best)


def _horizons(order: int, r: int, m: int) -> tuple[Horizon, ...]:
    """MATLAB's, and three that are longer, with past outputs or another weighting."""
    f = max(order + 2, 8)
    return (
        matlab_horizon(order, r, m), Horizon(f, f, True, "cva"), Horizon(2 * order + 2, 4 * order, True, "moesp"),
        Horizon(2 * f, 2 * f, False, "n4sid"),
    )  # fmt: skip


def _n4sid(records: tuple[Record, ...], order: int, horizon: Horizon) -> LinearStateSpace | None:
    try:
        return n4sid(records, order, horizon)
    except (InputError, np.linalg.LinAlgError):
        return None


def _hankel(records: tuple[Record, ...], channels: int, outputs: int) -> FloatArray:
    """Hankel singular values of a regularised ARX model; none where it fails or would take too long."""
    lags = min(30, 90 // channels)
    if lags < 3 or lags * outputs < LARGEST:
        return np.empty(0)
    try:
        return high_order_model(records, 1, lags=lags).hankel_singular_values()
    except (InputError, ValueError, np.linalg.LinAlgError):
        return np.empty(0)
