"""A trained model with its predictor and its bands: from the records of its run, or from a record that is given."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast, get_args

import numpy as np

from nnss_cli.datasets.record import FITTED_ON, FloatArray, Record
from nnss_cli.errors import InputError, unknown
from nnss_cli.methods.compiled import free_run
from nnss_cli.trained import TrainedModel
from nnss_cli.trained.simulate import Simulated, require_finite
from nnss_cli.validation.adaptive import adapt
from nnss_cli.validation.bands import Band, calibrate
from nnss_cli.validation.gain import Gain, estimate_gain, growth_along
from nnss_cli.validation.limits import Limits
from nnss_cli.validation.predictor import Guard, Predictor, steppers_of

FITTED = 0.7  # of a record that is given: K is fitted on it, and chosen, with the bands, on the rest

BandScale: TypeAlias = Literal["residuals", "ensemble", "adaptive"]


@dataclass(frozen=True, eq=False)
class Fitting:
    """What a predictor and its bands are made on."""

    train: tuple[Record, ...]
    """K is fitted on these, physical units."""
    val: tuple[Record, ...]
    """K is chosen, and bands are calibrated, on these."""


@dataclass(frozen=True, eq=False)
class Forecaster:
    """A predictor, and what is known of it."""

    trained: TrainedModel
    """The model."""
    predictor: Predictor
    """With the gains."""
    gains: tuple[Gain, ...]
    """One for each member."""
    fitting: Fitting
    """Where they come from."""
    guarded: bool = False
    """Whether predictions are weighed against persistence as errors are seen (`nnss_cli.validation.guard`)."""
    own: Fitting = Fitting((), ())
    """What the model itself was made of, as far as its run keeps it; the gains may come from other records."""

    def predict(self, record: Record, horizon: int) -> FloatArray:
        """ŷ(k | k − h) (K, m), physical units; see `Predictor.predict`."""
        return self._predicted(record, horizon, "residuals", self._own_guard(horizon))[0]

    def rates_along(self, records: Sequence[Record]) -> tuple[float, ...]:
        """Growth a sample of each member's observer error over these records; see `Gain.rate`."""
        systems = zip(steppers_of(self.trained.model), self.gains, strict=True)
        return tuple(growth_along(system, gain, records, self.trained.init_window) for system, gain in systems)

    def guard(self, horizons: Sequence[int]) -> Guard:
        """What guards predictions at these horizons, from the validation records, whether it is used or not."""
        return Guard.of(self.predictor, self.fitting.val, horizons, self.trained.init_window)

    def limits(self, record: Record, horizon: int, level: float, scale: str = "residuals") -> Limits:
        """The band around predictions `horizon` steps ahead, from the validation records; see `interval`.

        Args:
            record: physical units.
            horizon: steps ahead.
            level: share of samples that it is to hold.
            scale: constant (residuals), following an ensemble's spread (ensemble), or the coverage seen up to k − h
                (adaptive).

        Raises:
            InputError: as `interval`.
        """
        by, w, guard = band_scale(scale), self.trained.init_window, self._own_guard(horizon)
        predicted, spread = self._predicted(record, horizon, by, guard)
        if by != "adaptive":
            band = interval(self.fitting.val, w, level, by, lambda each: self._predicted(each, horizon, by, guard))
            return Limits.of(band, predicted, spread, record.y, w)
        errors = [(each.y - self._predicted(each, horizon, by, guard)[0])[w:] for each in self.fitting.val]
        adaptive = adapt(errors, [each.y[w:] for each in self.fitting.val], level, horizon)
        return Limits.following(adaptive, predicted, record.y, w)

    def _own_guard(self, horizon: int) -> Guard | None:
        """What its predictions at this horizon pass through."""
        return self.guard((horizon,)) if self.guarded else None

    def _predicted(
        self, record: Record, horizon: int, scale: BandScale, guard: Guard | None
    ) -> tuple[FloatArray, FloatArray | None]:
        predicted, spread = predicted_with_spread(self.trained, record, horizon, scale, self.predictor)
        if guard is not None:
            predicted, _ = guard.applied(horizon, predicted, record.y)
        return predicted, spread

    def limits_of_simulation(self, records: Sequence[Record], level: float) -> Limits:
        """The band around the free simulation of the first of the records; the share held is of all of them."""
        w = self.trained.init_window
        band = simulation_band(self.trained, self.fitting.val, level, "residuals")
        y = [free_run(self.trained.model, record.u, record.y[:w]).y for record in records]
        return Limits.of_experiments(band, y, [record.y for record in records], w)


def fitting_records(trained: TrainedModel, data: Record | None = None) -> Fitting:
    """The training and validation records of a model's run, or the two parts of a record that is given.

    Raises:
        InputError: neither is there, or the record is too short.
    """
    if data is not None:
        first = int(FITTED * len(data))
        least = trained.init_window + 1
        if min(first, len(data) - first) <= least:
            raise InputError(
                f"the record to fit on has {len(data)} samples: expected at least {int(least / (1 - FITTED)) + 2}, so "
                "that both parts are longer than the init window"
            )
        return Fitting((data[:first],), (data[first:],))
    own = _made_on(trained)
    if not own.train or not own.val:
        raise InputError(
            f"'{trained.folder}' keeps no training and validation records: give a record that the gain and the bands "
            "may be fitted on, with --data FILE"
        )
    return own


def _made_on(trained: TrainedModel) -> Fitting:
    """What the model itself was made on, as far as its run keeps it."""
    kept = trained.records()
    return Fitting(kept.get("train", ()), kept.get("val", ()))


def records_to_validate(trained: TrainedModel, split: str = "") -> tuple[str, tuple[Record, ...]]:
    """The records of a split of the model's run, and its name: by default the first test set, else validation.

    Raises:
        InputError: the run keeps no records, or none of that name.
    """
    kept = trained.records()
    if not kept:
        raise InputError(f"'{trained.folder}' keeps no records: name a FILE to validate on")
    if split and split not in kept:
        raise unknown("split", split, kept)
    name = split or next((name for name in kept if name not in FITTED_ON), "val")
    return name, kept[name]


def forecaster(trained: TrainedModel, data: Record | None = None, guarded: bool = False) -> Forecaster:
    """The predictor of a trained model: its gain is estimated anew, deterministically, and kept nowhere.

    Args:
        trained: the model.
        data: a record to fit on, instead of those of its run.
        guarded: whether its predictions are weighed against persistence as errors are seen.

    Raises:
        InputError: there is nothing to fit on, or the model is of a kind whose step is not known.
    """
    steppers = steppers_of(trained.model)
    fitting = fitting_records(trained, data)
    own = fitting if data is None else _made_on(trained)
    gains = tuple(estimate_gain(each, fitting.train, fitting.val, trained.init_window) for each in steppers)
    predictor = Predictor(trained.model, tuple(gain.K for gain in gains), tuple(gain.disturbance for gain in gains))
    return Forecaster(trained, predictor, gains, fitting, guarded, own)


def simulator(trained: TrainedModel) -> Predictor:
    """The predictor with K = 0, which only simulates."""
    steppers = steppers_of(trained.model)
    return Predictor(trained.model, tuple(np.zeros((each.size, each.outputs)) for each in steppers))


def band_scale(name: str) -> BandScale:
    """The name of a band's scale.

    Raises:
        InputError: it is unknown.
    """
    if name not in get_args(BandScale):
        raise unknown("interval-by", name, get_args(BandScale))
    return cast(BandScale, name)


def simulation_limits(
    trained: TrainedModel, found: Simulated, level: float, scale: str = "residuals", data: Record | None = None
) -> Limits:
    """The band around a simulated file.

    Args:
        trained: the model.
        found: the simulation.
        level: share of samples that it is to hold.
        scale: residuals or ensemble.
        data: a record to calibrate on, instead of the validation records of the run.

    Raises:
        InputError: as `interval`; there is nothing to calibrate on; or an ensemble's spread is asked for a simulation
            from rest.
    """
    by = band_scale(scale)
    if by == "adaptive":
        raise InputError(
            "interval-by adaptive: expected predictions, which know the outputs up to then, found a simulation: use "
            "'nnss predict', or leave --interval-by out"
        )
    if by == "ensemble" and found.from_rest:
        raise InputError(
            "interval-by ensemble: expected a simulation from measured outputs, found one from rest: leave --start or "
            "--interval-by out"
        )
    val = fitting_records(trained).val if data is None else (data,)
    band = simulation_band(trained, val, level, by)
    spread = None
    if by == "ensemble":
        if found.measured is None or not np.isfinite(found.measured).all():
            raise InputError("interval-by ensemble: expected a file with all its outputs, found some missing")
        record = Record(found.u, found.measured, trained.Ts)
        spread = predicted_with_spread(trained, record, None, by)[1]
    return Limits.of(band, found.y, spread, found.measured, 0 if found.from_rest else trained.init_window)


def simulation_band(trained: TrainedModel, val: Sequence[Record], level: float, scale: BandScale) -> Band:
    """The band of the free simulation; see `interval`."""
    return interval(
        val, trained.init_window, level, scale, lambda each: predicted_with_spread(trained, each, None, scale)
    )


def interval(
    val: Sequence[Record],
    init_window: int,
    level: float,
    scale: BandScale,
    predict: Callable[[Record], tuple[FloatArray, FloatArray | None]],
) -> Band:
    """The band ŷ ± … of a simulation, or of predictions, from validation records that have not trained the model.

    Samples of the init window do not count, since they tell the initial state.

    Args:
        val: validation records, physical units.
        init_window: first output samples that tell x(0).
        level: share of samples that it is to hold.
        scale: constant half-width (residuals), or following the spread of an ensemble's members.
        predict: a record's ŷ (K, m) and, where the band is to follow it, the members' spread.

    Raises:
        InputError: the level is out of range, the records are too short for it, or the model is no ensemble.
    """
    errors, spreads = [], []
    for record in val:
        predicted, spread = predict(record)
        errors.append((record.y - predicted)[init_window:])
        spreads.append(None if spread is None else spread[init_window:])
    if scale != "ensemble":
        return calibrate(errors, level)
    return calibrate(errors, level, [spread for spread in spreads if spread is not None])


def predicted_with_spread(
    trained: TrainedModel, record: Record, horizon: int | None, scale: BandScale, predictor: Predictor | None = None
) -> tuple[FloatArray, FloatArray | None]:
    """ŷ (K, m) and, where a band is to follow it, the deviation of an ensemble's members (K, m).

    Raises:
        InputError: a spread is asked of one model alone.
    """
    w = trained.init_window
    if scale != "ensemble":
        if horizon is None:
            simulated = free_run(trained.model, record.u, record.y[:w]).y
            require_finite("the simulation", simulated)
            return simulated, None
        assert predictor is not None
        return predictor.predict(record.u, record.y, horizon, w), None
    predictor = predictor or simulator(trained)
    each = predictor.predict_each(record.u, record.y, (horizon,), w)
    if each.shape[1] < 2:
        raise InputError(
            "interval: a band that follows an ensemble's spread needs an ensemble of two members at least, found one "
            "model: train nnss-ensemble of three seeds or more, or leave --interval-by out"
        )
    return predictor.together(each)[0], each[0].std(axis=0, ddof=1)
