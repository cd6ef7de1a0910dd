"""A quadratically stable model whose trajectories part: what `quadratic` does not promise.

x(k+1) = a(x) x + u with a(x) from 0 below c to ½ above: |a| ≤ ½, so x² is a Lyapunov function for all schedulings. But
d(a(x) x)/dx = a(x) + a'(x) x is about 5 at x = c, so two trajectories on either side of c part under the constant input
that holds c: one tends to u, the other to 2u.
"""

from __future__ import annotations

import numpy as np
import torch
from nnss_cli.baselines.schur import contraction_inverse
from nnss_cli.datasets.record import Channels, FloatArray, Scaling

from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS

STEEP, CENTRE = 40.0, 1.0
LOW, HIGH = 0.0, 0.5  # of a(x)


def parting_model(gamma: float = 0.9) -> NNSS:
    """`--stability quadratic`, n = 1: a(x) is near `LOW` below `CENTRE` and near `HIGH` above; B = 1, C = 1."""
    a = Architecture(1, 1, 1, (1,), (1,), dtype="float64", stability="quadratic", gamma=gamma)
    one = np.ones(1)
    model = NNSS(a, Scaling(0 * one, one, 0 * one, one), Channels(("u",), ("y",), ("",), ("",)), 1.0)
    low, high = (contraction_inverse(np.array([[value]]), gamma, a.epsilon).ravel() for value in (LOW, HIGH))
    rest = np.array([0.0, 1.0, 1.0])  # V, B, C
    with torch.no_grad():
        model.generator[0].weight.fill_(STEEP)
        model.generator[0].bias.fill_(-STEEP * CENTRE)
        model.generator[2].weight[:4] = torch.from_numpy(high - low)[:, None]
        model.generator[2].bias.copy_(torch.from_numpy(np.concatenate([low, rest])))
    return model


def parting_pair(model: NNSS, steps: int = 60) -> tuple[FloatArray, FloatArray, FloatArray]:
    """u (K, 1), which holds x = `CENTRE`, and x1(0), x2(0) (1,) beside it, 10⁻³ apart: they end 0.7 apart."""
    W, V, *_ = model.matrices(torch.tensor([[CENTRE]], dtype=torch.float64))
    held = CENTRE * (1 - float(model.state_matrix(W, V).detach()))
    return np.full((steps, 1), held), np.array([CENTRE - 5e-4]), np.array([CENTRE + 5e-4])
