"""Two equilibria under one input: a model that has them does not forget its initial state.

An equilibrium is proved by Krawczyk's test (R. Krawczyk, Computing 4, 1969): with g(x) = f(x, u) − x, Y ≈ g'(x)⁻¹ and a
box X around x,

    x − Y g(x) + (I − Y g'(X)) (X − x) ⊂ X

means that X holds exactly one. Two such boxes that do not meet are two trajectories, constant and apart for ever.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.certificate.affine import EPS, Affine, over_boxes
from nnss_cli.experiment.certificate.attack import Pair, Run
from nnss_cli.experiment.certificate.dynamics import Dynamics
from nnss_cli.experiment.certificate.region import constant

SETTLING = 3000  # samples that a held input is given
NEWTON = 30
TRIED = 16  # pairs
WIDTHS = (1e-9, 1e-7, 1e-5, 1e-3)  # half of a box, relative to the state's size


@dataclass(frozen=True, eq=False)
class Equilibria:
    """Two states, each proved to be one up to `margin`."""

    u: FloatArray
    """The constant input (r,)."""
    first: FloatArray
    """x1 (n,)."""
    second: FloatArray
    """x2 (n,)."""
    margin: float
    """Largest distance, entry by entry, of either from a true equilibrium."""


def two_equilibria(dynamics: Dynamics, run: Run, pairs: list[Pair]) -> Equilibria | None:
    """Two equilibria under one constant input, proved, from pairs of trajectories that stayed apart; None without."""
    tried = pairs[:TRIED]
    if not tried:
        return None
    u = np.stack([pair.u for pair in tried], axis=1)
    ends = [np.stack([pair.ends[i] for pair in tried], axis=1) for i in (0, 1)]
    held = np.repeat(u[None], SETTLING, axis=0)
    settled = [run(held, np.zeros((dynamics.m, u.shape[1])), end)[1][-1] for end in ends]
    for c in range(len(tried)):
        both = [settled[i][:, c].astype(np.float64) for i in (0, 1)]
        if not np.isfinite(both).all() or np.linalg.norm(both[0] - both[1]) <= 1e-6 * (1 + np.linalg.norm(both[0])):
            continue
        found = [equilibrium(dynamics, x, u[:, c]) for x in both]
        if found[0] is None or found[1] is None:
            continue
        (first, one), (second, other) = found[0], found[1]
        if (np.abs(first - second) > one + other).any():
            return Equilibria(u[:, c], first, second, max(one, other))
    return None


def equilibrium(dynamics: Dynamics, x: FloatArray, u: FloatArray) -> tuple[FloatArray, float] | None:
    """An equilibrium near x and half the width of a box around it that is proved to hold one; None without."""
    n = dynamics.n
    for _ in range(NEWTON):
        off = dynamics.at(dynamics.step, x[None], u)[0, :, 0] - x
        slope = dynamics.at(dynamics.tangent, x[None], u)[0, :n, :n] - np.eye(n)
        try:
            step = np.linalg.solve(slope, off)
        except np.linalg.LinAlgError:
            return None
        x = x - step
        if not np.isfinite(x).all():
            return None
    for relative in WIDTHS:
        half = relative * (1 + float(np.abs(x).max()))
        point = constant(x, 1)
        moved = dynamics.over(dynamics.step, point, constant(u, 1))
        off = np.abs(moved.c[0, :, 0] - x) + moved.spread()[0, :, 0] + 2 * EPS * np.abs(x)
        try:
            Y = np.linalg.inv(dynamics.at(dynamics.tangent, x[None], u)[0, :n, :n] - np.eye(n))
        except np.linalg.LinAlgError:
            return None
        box = over_boxes(x[None], half * np.eye(n)[None])
        slopes: Affine = dynamics.over(dynamics.tangent, box, constant(u, n))
        centre, spread = slopes.c[0, :n, :n] - np.eye(n), slopes.spread()[0, :n, :n]
        rest = np.abs(np.eye(n) - Y @ centre) + np.abs(Y) @ spread
        rest += 4 * (n + 4) * EPS * (np.abs(Y) @ (np.abs(centre) + spread) + 1)
        reached = (np.abs(Y) @ off + rest.sum(axis=1) * half) * (1 + 1e-9)
        if (reached < half).all():
            return x, half * (1 + 1e-9)
    return None
