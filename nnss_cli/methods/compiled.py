"""Free simulations of long records in compiled code, which a machine compiles once, for seconds.

A run's scores, `nnss simulate` and a predictor's start all come from here, so they agree to the bit.

torch is not loaded for linear models, nor for short records.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.record import FloatArray, Simulation
from nnss_cli.methods.protocol import Model

if TYPE_CHECKING:
    from nnss_cli.model.nnss import NNSS

LONG = 100  # samples from which on an NN-SS is run by compiled kernels: whoever runs it so long mostly does so again


def free_run(model: Model, u: FloatArray, y_init: FloatArray) -> Simulation:
    """`model.simulate`; of a long record by an NN-SS or an ensemble in compiled code, equal up to rounding.

    Args:
        model: of any kind.
        u: inputs (K, r), physical units.
        y_init: first output samples (w, m), physical units.
    """
    if len(u) < LONG or isinstance(model, LinearModel):
        return model.simulate(u, y_init)
    from nnss_cli.model.ensemble import Ensemble
    from nnss_cli.model.nnss import NNSS

    if isinstance(model, Ensemble):
        each = [free_run(member, u, y_init) for member in model.members]
        return Simulation(model.together(np.stack([one.y for one in each])), each[0].x)
    if not isinstance(model, NNSS):
        return model.simulate(u, y_init)
    known = np.atleast_2d(y_init)
    return _run(model, u, model.simulate(u[: len(known)], known).x[0], known[0])


def free_run_from(model: Model, u: FloatArray, z0: FloatArray) -> Simulation | None:
    """The same from z(0) of `nnss_cli.system`, of a long record by an NN-SS; None for anything else.

    Args:
        model: of any kind.
        u: inputs (K, r), physical units.
        z0: x(0), and the output before, in physical units, where that schedules.
    """
    if len(u) < LONG or isinstance(model, LinearModel):
        return None
    from nnss_cli.model.nnss import NNSS

    if not isinstance(model, NNSS):
        return None
    n = model.architecture.states
    # where z has no output before, nothing is scheduled on it, and any does
    return _run(model, u, z0[:n], z0[n:] if len(z0) > n else model.scaling.y_mean)


def _run(model: NNSS, u: FloatArray, x0: FloatArray, y_before: FloatArray) -> Simulation:
    from nnss_cli.training.fast import ready_to_run

    scaling = model.scaling
    y, x = ready_to_run(model).free_runs(
        scaling.normalise_u(u)[:, :, None], scaling.normalise_y(y_before)[:, None], x0[:, None]
    )
    return Simulation(scaling.restore_y(y[:, :, 0].astype(np.float64)), x[:, :, 0].astype(np.float64))
