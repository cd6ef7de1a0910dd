"""A model near its trajectory: poles of the frozen A(x), and responses of its linearisations at operating points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import FloatArray, Record, Simulation
from nnss_cli.errors import InputError
from nnss_cli.trained import TrainedModel

POINTS = 300  # of the trajectory whose poles are shown
QUANTILES = 0.1, 0.5, 0.9  # of the inputs: the operating points
FREQUENCIES = 200
LONGEST = 2000  # samples of a step response
SETTLED = 0.01


@dataclass(frozen=True, eq=False)
class OperatingPoint:
    """The linearisation, by true Jacobians, at the equilibrium under a constant input. Physical units."""

    u: FloatArray
    """The input (r,)."""
    y: FloatArray
    """The output (m,) there."""
    poles: FloatArray
    """Eigenvalues of the Jacobian (n,), complex."""
    dc_gain: FloatArray
    """Steady-state gain (m, r)."""
    step: FloatArray
    """Outputs' deviation after a unit step of each input (samples, m, r)."""
    magnitude: FloatArray
    """|G| at the frequencies (F, m, r)."""


@dataclass(frozen=True, eq=False)
class Linearisations:
    """Those at several operating points."""

    points: tuple[OperatingPoint, ...]
    """One for each quantile of the inputs; one in all for a linear model."""
    without: tuple[str, ...]
    """Why there is none at a point."""
    frequency: FloatArray
    """Of the magnitudes (F,) [Hz], up to half the sampling rate."""
    Ts: float
    """Sampling time [s]."""


def linearisations(trained: TrainedModel, records: Sequence[Record]) -> Linearisations:
    """Linearisations at the 10, 50 and 90 % quantiles of the inputs over the records."""
    u = np.concatenate([record.u for record in records])
    points: list[tuple[FloatArray, FloatArray, LinearStateSpace]] = []
    without = []
    for at in np.unique(np.quantile(u, QUANTILES, axis=0), axis=0):
        try:
            found = trained.linearise(at)
            y = trained.equilibrium(at).y
        except InputError as error:
            without.append(str(error))
            continue
        system = LinearStateSpace.from_control(found)
        if not any(np.allclose(system.A, other.A) and np.allclose(system.B, other.B) for *_, other in points):
            points.append((at, y, system))
    slowest = max((system.spectral_radius() for *_, system in points), default=0.0)
    count = LONGEST if slowest >= 1 else int(np.clip(np.log(SETTLED) / np.log(max(slowest, 1e-3)), 20, LONGEST))
    frequency = np.geomspace(1 / (LONGEST * trained.Ts), 0.5 / trained.Ts, FREQUENCIES)
    z = np.exp(2j * np.pi * frequency * trained.Ts)
    return Linearisations(
        tuple(OperatingPoint(at, y, s.poles(), s.dc_gain(), _step(s, count), _magnitude(s, z)) for at, y, s in points),
        tuple(without),
        frequency,
        trained.Ts,
    )


def _step(system: LinearStateSpace, count: int) -> FloatArray:
    r = system.B.shape[1]
    each = [system.simulate(np.tile(np.eye(r)[j], (count, 1)), np.zeros(system.order))[0] for j in range(r)]
    return np.stack(each, axis=2)


def _magnitude(system: LinearStateSpace, z: FloatArray) -> FloatArray:
    M = z[:, None, None] * np.eye(system.order) - system.A
    return np.asarray(np.abs(system.C @ np.linalg.solve(M, np.repeat(system.B[None], len(z), axis=0)) + system.D))


def integrators(trained: TrainedModel) -> int:
    """How many outputs of the model sum up what its LPV part gives; of an ensemble's first member."""
    member = getattr(trained.model, "members", (trained.model,))[0]
    return len(trained.channels.outputs) * getattr(getattr(member, "architecture", None), "integrator", False)


def pole_map(trained: TrainedModel, records: Sequence[Record], simulated: Sequence[Simulation]) -> FloatArray:
    """Eigenvalues of A(x) (points, n) at up to 300 points of simulated trajectories; of an ensemble's first member."""
    member = TrainedModel(getattr(trained.model, "members", (trained.model,))[0])
    system = member.system
    x = np.concatenate([simulation.x for simulation in simulated])
    u = np.concatenate([record.u for record in records])
    previous = np.concatenate([np.concatenate([r.y[:1], s.y[:-1]]) for r, s in zip(records, simulated, strict=True)])
    at = np.unique(np.linspace(0, len(x) - 1, min(len(x), POINTS)).astype(int))
    z = np.stack([system.state(x[k], previous[k]) for k in at])
    A = system.frozen(z=z[..., None], u=u[at][..., None])["A"]
    return np.linalg.eigvals(np.broadcast_to(A, (len(at), *A.shape[-2:])))
