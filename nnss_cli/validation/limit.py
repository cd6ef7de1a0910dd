"""What linear relations explain of a record: by coherence, and by linear models fitted to this very record.

Coherence says which share of an output's power the inputs leave unexplained linearly, S_yy (1 − γ²) summed over the
frequencies; but what outlasts its segments passes for unexplained, which on short records of slow plants is much. A
linear model that was fitted to the record and simulates it better than that is a proof that more can be reached: it is
fitted to an excerpt of a long record, and scored, as the model beside it, on the whole. The larger of both is told, an
estimate of what any linear relation explains: models may reach more, where neither sees it, or less, since coherence
counts acausal relations, too. Of u(k) = y(k − 1) with white y it tells nearly 100 %, where no model simulates anything.
Under feedback, whose inputs follow from past outputs and their noise, it is an upper figure.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence

import numpy as np

from nnss_cli.baselines.n4sid import matlab_horizon, n4sid
from nnss_cli.baselines.ssest import ssest
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.baselines.subspace import Horizon
from nnss_cli.datasets.record import FloatArray, Record, Scaling, about_mean
from nnss_cli.errors import InputError
from nnss_cli.experiment.inspection_dynamics import excerpt, multiple_coherence, welch

SAMPLES = 2048  # that linear models are fitted to
ORDERS = 2, 4, 6  # of N4SID, beside SSEST of the model's own and one more


def larger(first: Sequence[float | None], second: Sequence[float | None]) -> list[float | None]:
    """The larger of two limits of each output; None where neither is known."""
    both = ([value for value in pair if value is not None] for pair in zip(first, second, strict=True))
    return [max(known) if known else None for known in both]


def coherence_limits(records: Sequence[Record]) -> list[float | None]:
    """The fit (`Score.fit_percent`) that coherence allows linear relations, acausal ones among them, by output.

    Args:
        records: experiments, any units.

    Returns:
        None where they are too short, or a signal does not vary.
    """
    r, m = records[0].input_count, records[0].output_count
    parts = [np.concatenate([record.u, record.y], axis=1) for record in records]
    centred = list(map(about_mean, parts))  # each by its own mean, as the fit has it
    deviation = _rms(centred)
    alive = deviation > 0
    used = int(alive[:r].sum())
    if not used:
        return [None] * m
    spectra = welch([part[:, alive] / deviation[alive] for part in centred], used)
    found: list[float | None] = []
    for i in range(m):
        unexplained = None
        if spectra is not None and alive[r + i]:
            _, unexplained = multiple_coherence(spectra, used, int(alive[r : r + i].sum()))
        found.append(None if unexplained is None else 100 * (1 - math.sqrt(unexplained)))
    return found


def fitted_limits(records: Sequence[Record], own: int, begin: int = 0) -> list[float | None]:
    """The largest fit that linear models reach which are fitted to these records themselves, by output.

    A, B, C and D come from up to `SAMPLES` lively samples, x(0) of each record and the outputs' offset from the whole.

    Args:
        records: experiments, any units.
        own: order of the model that is compared.
        begin: first samples of each record that are not scored, those of that model.

    Returns:
        None where no model could be fitted.
    """
    r, m = records[0].input_count, records[0].output_count
    parts = excerpt([np.concatenate([record.u, record.y], axis=1) for record in records], SAMPLES, r)
    cut = tuple(Record(part[:, :r], part[:, r:], records[0].Ts) for part in parts)
    best = np.full(m, -np.inf)
    if not cut:
        return [None] * m
    scaling = Scaling.of(cut)
    fitted, scored = (tuple(map(scaling.apply, each)) for each in (cut, records))
    spread = _rms([about_mean(record.y[begin:]) for record in scored])
    ways: list[Callable[[], LinearStateSpace]] = [functools.partial(ssest, fitted, fitted, n) for n in (own, own + 1)]
    for order in ORDERS:
        for horizon in (matlab_horizon(order, r, m), Horizon(4 * order, 4 * order, True, "moesp")):
            ways.append(functools.partial(n4sid, fitted, order, horizon))
    for way in ways:
        try:
            model = way()
        except (InputError, np.linalg.LinAlgError):
            continue
        errors = [(each.y - model.simulate(each.u, model.initial_state(each))[0])[begin:] for each in scored]
        with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # it may run away beyond the excerpt
            fit = 100 * (1 - np.concatenate(errors).std(axis=0) / spread)
        best = np.maximum(best, np.where(np.isfinite(fit), fit, -np.inf))
    return [float(value) if math.isfinite(value) else None for value in best]


def _rms(parts: Sequence[FloatArray]) -> FloatArray:
    return np.asarray(np.sqrt(np.mean(np.concatenate(parts) ** 2, axis=0)))
