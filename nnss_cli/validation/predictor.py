"""k steps ahead by innovations: the model corrected by what it did not foresee.

    x̂(k+1) = f(x̂(k), u(k)) + K (y(k) − ŷ(k)),   ŷ(k) = h(x̂(k), u(k))

ŷ(k) is the prediction one step ahead: of the outputs it knows those before k. h steps ahead, ŷ(k | k − h) knows the
outputs up to k − h, and the inputs up to k; the model runs freely from x̂(k − h + 1). Where h is larger than k, and for
K = 0, it is the free simulation from x(0). Source: L. Ljung, "System Identification", 2nd ed., 1999, section 4.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.methods import Model
from nnss_cli.trained.simulate import require_finite
from nnss_cli.validation.disturbance import Disturbance
from nnss_cli.validation.guard import prior_strength, weights
from nnss_cli.validation.stepping import CHUNK, Linear, Stepper


def steppers_of(model: Model) -> tuple[Stepper, ...]:
    """The members of an ensemble, or the one system that a model is. For linear models torch is not loaded.

    Raises:
        InputError: the model is of a plug-in's kind, which has no step to look at.
    """
    return tuple(_stepper(member) for member in getattr(model, "members", (model,)))


def _stepper(model: Model) -> Stepper:
    if isinstance(model, LinearModel):
        return Linear(model)
    from nnss_cli.model.nnss import NNSS
    from nnss_cli.validation.neural import Neural

    if isinstance(model, NNSS):
        return Neural(model)
    raise InputError(
        f"expected an NN-SS or linear model, or an ensemble of them, found {type(model).__name__}: of other kinds only "
        "the simulation is known, not the step"
    )


@dataclass(frozen=True, eq=False)
class Predictor:
    """A model with a gain; of an ensemble, each member has its own, and its rule puts what they predict together."""

    model: Model
    """What runs between the corrections."""
    gains: tuple[FloatArray, ...]
    """K (s, m) of each member, in normalised units: s is the order, m more where the previous output schedules, and
    as many more as the state of a disturbance has."""
    disturbances: tuple[Disturbance | None, ...] = ()
    """What each member's outputs have beside its own, and the innovations correct, too; none for any where empty."""

    def predict(self, u: FloatArray, y: FloatArray, horizon: int | None, init_window: int = 1) -> FloatArray:
        """ŷ(k | k − h) for every k (K, m), physical units.

        Args:
            u: inputs (K, r), physical units.
            y: measured outputs (K, m), physical units.
            horizon: steps ahead h ≥ 1; None for the free simulation.
            init_window: first output samples w from which x(0) is found, as in `simulate`: up to k = w the prediction
                knows them all.

        Raises:
            InputError: the horizon is not positive, or the prediction leaves the finite range.
        """
        return self.together(self.predict_each(u, y, (horizon,), init_window))[0]

    def together(self, each: FloatArray) -> FloatArray:
        """What is predicted at each horizon (horizons, K, m), from what each member does (horizons, members, K, m)."""
        together = getattr(self.model, "together", None)  # an ensemble's rule
        return np.stack([together(at_one) for at_one in each]) if together else np.asarray(each[:, 0])

    def predict_each(
        self, u: FloatArray, y: FloatArray, horizons: Sequence[int | None], init_window: int = 1
    ) -> FloatArray:
        """What each member predicts at each horizon (horizons, members, K, m), physical units; see `predict`."""
        members = [
            self._member(system if by is None else system.disturbed(by), K, u, y, horizons, init_window)
            for system, K, by in zip(
                steppers_of(self.model), self.gains, self.disturbances or [None] * len(self.gains), strict=True
            )
        ]
        found = np.stack(members, axis=1)
        for each in found:
            require_finite("the prediction", each.sum(axis=0))
        return found

    def _member(
        self, system: Stepper, K: FloatArray, u: FloatArray, y: FloatArray, horizons: Sequence[int | None], w: int
    ) -> FloatArray:
        free = system.simulate(u, y[:w])
        known, inputs = system.scaling.normalise_y(y), system.scaling.normalise_u(u)
        z0 = system.start(free.x[0], known[0], inputs[0])
        z, one_ahead = system.observe(K[None], z0[None], inputs[:, None], known[:, None])
        found = []
        for horizon in horizons:
            if horizon is not None and horizon < 1:
                raise InputError(f"horizon: expected at least 1 step ahead, found {horizon}")
            predicted = free.y.copy()
            if horizon is not None and horizon <= len(u):
                first = horizon - 1
                ahead = one_ahead[:, 0] if horizon == 1 else _run_on(system, z[: len(u) - first, 0], inputs, first)
                predicted[first:] = system.scaling.restore_y(ahead)
            found.append(predicted)
        return np.stack(found)


def _run_on(system: Stepper, z: FloatArray, u: FloatArray, steps: int) -> FloatArray:
    """h(z, u) (N, m) after `steps` free steps from each of N states z (N, s), under the inputs u (N + steps, r)."""
    parts = []
    for start in range(0, len(z), CHUNK):
        part, k = z[start : start + CHUNK], start
        for _ in range(steps):
            part = system.step(part, u[k : k + len(part)])[0]
            k += 1
        parts.append(system.step(part, u[k : k + len(part)])[1])
    return np.concatenate(parts)


def persistence(y: FloatArray, horizon: int) -> FloatArray:
    """ŷ(k | k − h) = y(k − h) (K, m); y(0) before."""
    return np.asarray(y[np.maximum(np.arange(len(y)) - horizon, 0)])


@dataclass(frozen=True, eq=False)
class Guard:
    """The guard of a predictor (`nnss_cli.validation.guard`) at some horizons."""

    strengths: dict[int, FloatArray]
    """a of each output (m,), by horizon, from the validation records."""
    init_window: int
    """First output samples that tell x(0), which do not count."""

    @classmethod
    def of(cls, predictor: Predictor, val: Sequence[Record], horizons: Sequence[int], init_window: int = 1) -> Guard:
        """For a predictor, from its validation records (physical units)."""
        gaps: dict[int, list[FloatArray]] = {horizon: [] for horizon in horizons}
        for record in val:
            each = predictor.together(predictor.predict_each(record.u, record.y, horizons, init_window))
            for horizon, predicted in zip(horizons, each, strict=True):
                gaps[horizon].append((persistence(record.y, horizon) - predicted)[init_window:])
        return cls({horizon: prior_strength(own, horizon) for horizon, own in gaps.items()}, init_window)

    def applied(self, horizon: int, predicted: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The guarded prediction and the weight v(k) of persistence in it, (K, m) each, from ŷ and y (K, m)."""
        gaps = persistence(y, horizon) - predicted
        v = weights(y - predicted, gaps, self.strengths[horizon], horizon, self.init_window)
        return predicted + v * gaps, v


@dataclass(frozen=True, eq=False)
class StepTable:
    """Errors k steps ahead: of the predictor, beside persistence and the free simulation."""

    horizons: tuple[int, ...]
    """Steps ahead."""
    predicted: FloatArray
    """RMSE of the predictor by horizon and output (horizons, m), physical units."""
    persistence: FloatArray
    """RMSE of ŷ(k | k − h) = y(k − h), likewise."""
    simulated: FloatArray
    """RMSE of the free simulation (m,)."""
    guarded: FloatArray | None = None
    """RMSE of the predictor with its guard (`nnss_cli.validation.guard`), as `predicted`; None where none was asked."""


def step_table(
    predictor: Predictor,
    records: Sequence[Record],
    horizons: Sequence[int],
    init_window: int = 1,
    guard: Guard | None = None,
) -> StepTable:
    """Errors over the samples of all records after the init window, or after y(0), from which the simulation starts.

    Args:
        predictor: what predicts.
        records: physical units.
        horizons: steps ahead, each at least 1.
        init_window: first output samples that tell x(0).
        guard: of the predictor at each of the horizons, where its errors are wanted, too.
    """
    wanted: tuple[int | None, ...] = (*horizons, None)
    squares, persisting, guarding, count = 0.0, 0.0, 0.0, 0
    for record in records:
        each = predictor.together(predictor.predict_each(record.u, record.y, wanted, init_window))
        lasting = np.stack([persistence(record.y, horizon) for horizon in horizons])
        squares = squares + np.square(each - record.y)[:, init_window:].sum(axis=1)
        persisting = persisting + np.square(lasting - record.y)[:, init_window:].sum(axis=1)
        if guard is not None:
            each = np.stack([guard.applied(*pair, record.y)[0] for pair in zip(horizons, each, strict=False)])
            guarding = guarding + np.square(each - record.y)[:, init_window:].sum(axis=1)
        count += max(0, len(record) - init_window)
    errors, lasting_errors = np.sqrt(squares / max(count, 1)), np.sqrt(persisting / max(count, 1))
    guarded = None if guard is None else np.sqrt(guarding / max(count, 1))
    return StepTable(tuple(horizons), errors[:-1], lasting_errors, errors[-1], guarded)
