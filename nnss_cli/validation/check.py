"""A trained model put to the test on a record: errors, residuals, poles, linearisations, what linear models reach.

The residuals are the errors one step ahead, of the predictor with its noise model (`gain`): those of the simulation are
coloured wherever something but white noise on the outputs disturbs the plant, and that is no fault of a model. All of
it is said of the model's own predictions; what a guard makes of them stands beside their errors by horizon.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.record import Record, Scaling, unscored
from nnss_cli.errors import InputError
from nnss_cli.experiment.run import score_outputs
from nnss_cli.methods.compiled import free_run
from nnss_cli.trained.simulate import beyond_training, require_finite
from nnss_cli.validation.limit import coherence_limits, fitted_limits, larger
from nnss_cli.validation.linearisation import integrators, linearisations, pole_map
from nnss_cli.validation.overlap import samples_in
from nnss_cli.validation.predictor import step_table
from nnss_cli.validation.residuals import dependence, profile, whiteness
from nnss_cli.validation.result import OutputCheck, Validation
from nnss_cli.validation.trained import Fitting, Forecaster
from nnss_cli.validation.verdict import stated, verdict

HORIZONS = 1, 2, 5, 10, 20
FORGOTTEN = 0.01  # of the initial state's error, before residuals are looked at
BAND = 0.9
SHORTEST = 20  # samples of an experiment beyond the init window


def validate(found: Forecaster, records: Sequence[Record], name: str) -> Validation:
    """Put a model to the test.

    Args:
        found: the model with its predictor, without guard.
        records: one or more experiments, physical units.
        name: what the records are called.
    """
    trained, w = found.trained, found.trained.init_window
    shortest = min(map(len, records))
    if shortest < w + SHORTEST:
        raise InputError(
            f"{name}: {shortest} samples are too few to validate on: expected {w + SHORTEST} or more, {SHORTEST} "
            "beyond those that tell the initial state"
        )
    simulated = [free_run(trained.model, record.u, record.y[:w]) for record in records]
    for simulation in simulated:
        require_finite("the simulation", simulation.y)
    one_ahead = [found.predict(record, 1) for record in records]
    needed = _forgetting(max(gain.rate for gain in found.gains))
    rates = tuple(max(gain.rate, here) for gain, here in zip(found.gains, found.rates_along(records), strict=True))
    left_out = max(w, min(needed, shortest // 5))
    begin = unscored(w)
    scaling = trained.scaling or Scaling.of(found.own.train or found.fitting.train)
    scores = score_outputs(name, [r.y[begin:] for r in records], [s.y[begin:] for s in simulated], scaling)
    reached = fitted_limits(records, trained.order, begin)
    if isinstance(trained.model, LinearModel):
        reached = larger(reached, [score.fit_percent for score in scores])
    limits = larger(coherence_limits(records), reached)
    outputs = []
    for i, (channel, unit) in enumerate(zip(trained.channels.outputs, trained.channels.output_units, strict=True)):
        errors = [(r.y - p)[left_out:, i] for r, p in zip(records, one_ahead, strict=True)]
        free = [(r.y - s.y)[left_out:, i] for r, s in zip(records, simulated, strict=True)]
        inputs = [[r.u[left_out:, j] for r in records] for j in range(len(trained.channels.inputs))]
        states = [[s.x[left_out:, j] for s in simulated] for j in range(simulated[0].x.shape[1])]
        pooled = np.concatenate(errors)
        outputs.append(
            OutputCheck(
                channel, unit, scores[i].rmse, float(scaling.y_std[i]), scores[i].fit_percent, limits[i], reached[i],
                float(whiteness(free).correlation[0]), tuple(dependence(free, u).p_value for u in inputs),
                float(np.sqrt(np.mean(pooled**2))), whiteness(errors), tuple(dependence(errors, u) for u in inputs),
                tuple(profile(pooled, np.concatenate(u)) for u in inputs),
                tuple(profile(pooled, np.concatenate(x)) for x in states),
            )
        )  # fmt: skip
    horizons = [h for h in HORIZONS if h < shortest - w] or [1]
    steps = step_table(found.predictor, records, horizons, w, found.guard(horizons))
    poles = pole_map(trained, records, simulated)
    linear = linearisations(trained, records)
    signals = (np.concatenate([getattr(record, name) for record in records]) for name in ("u", "y"))
    beyond = beyond_training(found.own.train, trained.channels, *signals)
    tests = stated(outputs, steps, rates, [gain.origin for gain in found.gains], trained.channels)
    radius = float(np.abs(poles).max()) if poles.size else math.nan
    try:
        band = found.limits_of_simulation(records, BAND)
    except InputError:  # too short a validation record for it
        band = None
    return Validation(
        trained.label, name, sum(map(len, records)), len(records), left_out, trained.channels, tuple(outputs), steps,
        tests,
        (
            *verdict(
                outputs, steps, tests, trained.order, poles, trained.channels, linear, integrators(trained), beyond
            ),
            *_known([found.own, *[found.fitting] * (found.fitting is not found.own)], records),
            *_early(left_out, needed),
        ),
        tuple(gain.origin for gain in found.gains), rates, poles, radius, linear,
        np.arange(len(records[0])) * trained.Ts, records[0].y, simulated[0].y, one_ahead[0], band,
    )  # fmt: skip


def _forgetting(rate: float) -> int:
    """Samples after which the observer's initial error is a hundredth; 0 where it is so at once, or never."""
    return math.ceil(math.log(FORGOTTEN) / math.log(rate)) if 0 < rate < 1 else 0


def _known(made_on: Sequence[Fitting], records: Sequence[Record]) -> Iterator[str]:
    """Whether the model, its gain or its bands had a part of these records already, as protocol paper has it."""
    total = sum(map(len, records))
    for parts, what in (
        ([part for each in made_on for part in each.train], "the model or its predictor was fitted to"),
        (
            [part for each in made_on for part in each.val],
            "the model's epoch, the predictor's gain and the bands were chosen on",
        ),
    ):
        if shared := sum(int(samples_in(record, parts).sum()) for record in records):
            yield f"No independent evidence: {what} {shared} of these {total} samples."


def _early(left_out: int, needed: int) -> Iterator[str]:
    if left_out < needed:
        yield (
            f"The predictor takes {needed} samples to forget 99 % of its start. Residuals leave out the first "
            f"{left_out}, a fifth of the record at most: what is left of the start may colour them."
        )
