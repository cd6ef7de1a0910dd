"""N4SID with a simulation focus: MATLAB's choices, or horizons searched on validation.

    x(k+1) = A x + B u,   y = C x   (D = 0)

Γ by a weighted projection, A and C from its shift, B and x0 by least squares on the simulated
output; `subspace` has the steps and their sources.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from nnss_cli.baselines.statespace import LinearStateSpace, simulation_rms
from nnss_cli.baselines.subspace import Horizon, WindowFactors, fit_input_matrix, observability, realise
from nnss_cli.datasets.record import Record

from nnss_cli.errors import InputError


def matlab_horizon(order: int, inputs: int, outputs: int) -> Horizon:
    """The horizons that MATLAB's n4sid takes with N4Horizon 'auto' and no disturbance model.

    One output: f = ⌈1.5 n⌉, p = 4 n past inputs. For several outputs MATLAB's rule is not
    published; its choices for the power plant (5 inputs, 3 outputs) are known at n = 3, 4, 5, and
    elsewhere the rule of one output is used.
    """
    known = {3: (5, 6), 4: (5, 7), 5: (5, 7)}
    if (inputs, outputs) == (5, 3) and order in known:
        return Horizon(*known[order])
    return Horizon(max(2, math.ceil(1.5 * order)), 4 * order)


def n4sid(
    records: tuple[Record, ...], order: int, horizon: Horizon | None = None, factors: WindowFactors | None = None
) -> LinearStateSpace:
    """Identify a linear model from input-output records.

    Args:
        records: experiments, in the units (usually normalised) that the model is to have.
        order: number of states n.
        horizon: horizons and weighting; MATLAB's where it is None.
        factors: of these records, for several horizons; see `observability`.

    Raises:
        InputError: the records are too short for the order.
    """
    m = records[0].output_count
    Gamma = observability(records, order, horizon or matlab_horizon(order, records[0].input_count, m), factors)
    A, C = realise(Gamma, m)
    B, _ = fit_input_matrix(A, C, records)
    return LinearStateSpace(A, B, C, np.zeros((m, B.shape[1])), records[0].Ts)


def candidate_horizons(order: int) -> Iterator[Horizon]:
    """The grid that `n4sid_candidates` tries: both horizons from about n to 8 n, all weightings."""
    for future in dict.fromkeys(max(order + 1, math.ceil(k * order)) for k in (1, 1.5, 2, 3, 5, 8)):
        for past in dict.fromkeys(k * order for k in (1, 2, 4, 8)):
            for past_outputs in (False, True):
                for weighting in ("cva", "moesp", "n4sid"):
                    yield Horizon(future, past, past_outputs, weighting)


def n4sid_candidates(records: tuple[Record, ...], order: int) -> list[tuple[Horizon, LinearStateSpace]]:
    """A model for MATLAB's horizon and for every horizon of the grid that the data allow.

    Raises:
        InputError: no horizon fits the data.
    """
    found = []
    matlab = matlab_horizon(order, records[0].input_count, records[0].output_count)
    reason: Exception | None = None
    horizons = dict.fromkeys([matlab, *candidate_horizons(order)])
    factors = WindowFactors(records, horizons)
    for horizon in horizons:
        try:
            found.append((horizon, n4sid(records, order, horizon, factors)))
        except (InputError, np.linalg.LinAlgError) as error:
            reason = reason or error
    if not found:
        raise InputError(str(reason))
    return found


def n4sid_auto(
    train: tuple[Record, ...], val: tuple[Record, ...], order: int, init_window: int = 1
) -> tuple[LinearStateSpace, Horizon]:
    """The candidate with the lowest validation error of a free simulation, and its horizon.

    Args:
        train: experiments, in normalised units.
        val: validation experiments.
        order: number of states n.
        init_window: first samples of a validation experiment that tell x(0); see `scored_residuals`.

    Raises:
        InputError: no horizon fits the data.
    """
    horizon, model = min(n4sid_candidates(train, order), key=lambda pair: simulation_rms(pair[1], val, init_window))
    return model, horizon
