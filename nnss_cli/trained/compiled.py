"""Free simulations of long records in compiled code, which a machine compiles once, for seconds."""

from __future__ import annotations

import numpy as np

from nnss_cli.datasets.record import FloatArray, Simulation
from nnss_cli.methods import Model
from nnss_cli.model.ensemble import Ensemble
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights

LONG = 5000  # samples from which on an NN-SS is run by compiled kernels


def free_run(model: Model, u: FloatArray, y_init: FloatArray) -> Simulation:
    """`model.simulate`; of a long record by an NN-SS or an ensemble in compiled code, equal up to rounding.

    Args:
        model: of any kind.
        u: inputs (K, r), physical units.
        y_init: first output samples (w, m), physical units.
    """
    if len(u) < LONG or not isinstance(model, NNSS | Ensemble):
        return model.simulate(u, y_init)
    if isinstance(model, Ensemble):
        each = [free_run(member, u, y_init) for member in model.members]
        return Simulation(np.mean([one.y for one in each], axis=0), each[0].x)
    known = np.atleast_2d(y_init)
    x0, scaling = model.simulate(u[: len(known)], known).x[0], model.scaling
    y, x = Weights(model).free_runs(
        scaling.normalise_u(u)[:, :, None], scaling.normalise_y(known[:1]).T, x0[:, None]
    )  # fmt: skip
    return Simulation(scaling.restore_y(y[:, :, 0].astype(np.float64)), x[:, :, 0].astype(np.float64))
