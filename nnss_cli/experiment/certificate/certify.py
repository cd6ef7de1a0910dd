"""What can be promised of a model's stability, and what was seen.

A(ρ) Schur at every frozen ρ does not make x(k+1) = A(ρ(k)) x(k) + B(ρ(k)) u(k) stable: products of Schur matrices can
grow without bound (docs/stability.md has an example). ‖A(ρ)‖₂ < γ does, for then, γ < 1,

    ‖x(k)‖ ≤ γᵏ ‖x(0)‖ + (1 − γᵏ) R ≤ max(‖x(0)‖, R),   R = sup‖B‖ sup‖u‖ / (1 − γ)

The generator's last hidden layer is a sigmoid, so sup‖B‖ and sup‖C‖ follow from the last layer's weights, whatever
schedules. For other models a matrix P with A(ρ)ᵀ P A(ρ) ≺ P is searched, for sampled ρ only; of a linear model the
only A decides. All in normalised units.
"""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.experiment.certificate.box import over_box, spread
from nnss_cli.experiment.certificate.lyapunov import common_lyapunov, only_lyapunov
from nnss_cli.experiment.certificate.result import Certificate, Stress
from nnss_cli.experiment.certificate.stress import STRESS_STEPS, stress_runs
from nnss_cli.experiment.certificate.systems import Linear, Neural, radii
from nnss_cli.model.nnss import NNSS


def certify(
    model: Any, splits: dict[str, tuple[Record, ...]], steps: int = STRESS_STEPS, search_lyapunov: bool = True
) -> Certificate:
    """Examine a model on the trajectories of these records (physical units) and far beyond.

    Args:
        model: NNSS or LinearModel.
        splits: records by name; their range of inputs bounds the stress runs, which start from the largest x(0).
        steps: of each stress run; 0 for none, which leaves all that is certified.
        search_lyapunov: solve the LMI where a common Lyapunov matrix is not given by construction.

    Raises:
        InputError: the model is of another kind, or the records have other channels.
    """
    if not isinstance(model, NNSS | LinearModel):
        raise InputError(
            f"certify: expected one NN-SS or linear model, found {type(model).__name__}; certify its members"
        )
    system = Neural(model) if isinstance(model, NNSS) else Linear(model)
    scaling = model.scaling
    scaled = {name: tuple(scaling.apply(record) for record in records) for name, records in splits.items()}
    everything = [record for records in scaled.values() for record in records]
    if not everything:
        raise InputError("certify: expected at least one record, found none")
    low = np.min([record.u.min(axis=0) for record in everything], axis=0)
    high = np.max([record.u.max(axis=0) for record in everything], axis=0)
    runs = {name: [system.trajectory(record) for record in own] for name, own in scaled.items() if own}
    points = {
        name: np.concatenate([system.scheduling(record, *run) for record, run in zip(scaled[name], own, strict=True)])
        for name, own in runs.items()
    }
    radius = {name: float(radii(system.matrices(rho)).max()) for name, rho in points.items()}
    state = {name: max(_largest(x) for _, x in own) for name, own in runs.items()}
    seen = np.concatenate(list(points.values()))
    box_radius, box_norm, extremes = over_box(system, seen)
    lyapunov, rate = "not needed: ‖x‖² is one by construction", None
    if isinstance(system, Linear):
        lyapunov, rate = only_lyapunov(system.system.A)
    elif system.stability != "contraction":
        lyapunov, rate = "not searched", None
        if search_lyapunov:
            lyapunov, rate = common_lyapunov(system.matrices(spread(seen, extremes)))
    initial = [system.initial_state(record) for record in everything]
    farthest = int(np.argmax([np.linalg.norm(x0) for x0 in initial]))
    start = everything[farthest].y[0], initial[farthest]
    largest_initial = float(np.linalg.norm(initial[farthest]))
    started = time.perf_counter()
    stress: tuple[Stress, ...] = ()
    if steps:
        stress = stress_runs(system, system.adversary(low, high, *start), low, high, *start, steps)
    seconds = time.perf_counter() - started
    input_bound = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    B_bound, C_bound, D_bound = system.output_bounds()
    bound = invariant = None
    holds_for, limit = "", math.inf
    if isinstance(system, Neural) and system.stability == "contraction" and system.gamma < 1:
        invariant = B_bound * input_bound / (1 - system.gamma)
        bound = max(largest_initial, invariant)
        limit = bound * (1 + system.rounding())
        holds_for = f"x(0) = g(y(0)) of the {len(everything)} records given, inputs within their range"
    broken = []
    largest = max(box_radius, *radius.values())
    if largest >= system.gamma:
        broken.append(f"spectral radius {largest:.8g}, promised below {system.gamma:g}")
    if system.stability == "contraction" and box_norm >= system.gamma:
        broken.append(f"norm {box_norm:.8g}, promised below {system.gamma:g}")
    if bound is not None:
        reached = [(largest, f"along a record of '{name}'") for name, largest in state.items()]
        reached += [(run.state, f"under input '{run.input}'") for run in stress]
        broken += [f"state {x:.4g} {where}, promised at most {bound:.4g}" for x, where in reached if not x <= limit]
    return Certificate(
        system.kind, system.stability, system.covers, system.gamma, len(everything), holds_for, radius, state,
        largest_initial, box_radius, box_norm, bound, invariant, B_bound, C_bound, D_bound, input_bound, lyapunov, rate,
        stress, seconds, tuple(broken),
    )  # fmt: skip


def _largest(x: FloatArray) -> float:
    """Largest ‖x‖ of (K, n); infinite where the state left the range of numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(np.linalg.norm(x.astype(np.float64), axis=1).max())
    return largest if math.isfinite(largest) else math.inf
