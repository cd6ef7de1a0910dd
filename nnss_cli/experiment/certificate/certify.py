"""What can be promised of a model's stability, and what was seen.

A(ρ) Schur at every frozen ρ does not make x(k+1) = A(ρ(k)) x(k) + B(ρ(k)) u(k) stable: products of Schur matrices can
grow without bound (docs/stability.md has an example). ‖A(ρ)‖₂ < γ does, for then, γ < 1,

    ‖x(k)‖ ≤ γᵏ ‖x(0)‖ + (1 − γᵏ) R ≤ max(‖x(0)‖, R),   R = sup‖B‖ sup‖u‖ / (1 − γ)

The generator's last hidden layer is a sigmoid, so sup‖B‖ and sup‖C‖ follow from the last layer's weights, whatever
schedules. For other models a matrix P with A(ρ)ᵀ P A(ρ) ≺ P is searched, for sampled ρ only, and, given time, regions,
gains and rates are proved (search.py); of constant A, B, C, D all is exact (lti.py). All in normalised units.
"""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np

from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.experiment.certificate import statements as say
from nnss_cli.experiment.certificate.box import over_box, spread
from nnss_cli.experiment.certificate.lyapunov import common_lyapunov, only_lyapunov
from nnss_cli.experiment.certificate.result import Certificate, Statement, Stress
from nnss_cli.experiment.certificate.search import not_searched, search
from nnss_cli.experiment.certificate.stress import STRESS_STEPS, stress_runs
from nnss_cli.experiment.certificate.systems import Linear, Neural, radii
from nnss_cli.model.incremental import Lure
from nnss_cli.model.nnss import NNSS

FOR_LYAPUNOV = 0.2  # most of the budget that the search for a common Lyapunov matrix takes


def certify(
    model: Any,
    splits: dict[str, tuple[Record, ...]],
    steps: int = STRESS_STEPS,
    search_lyapunov: bool = True,
    budget: float = 0.0,
    init_window: int = 1,
) -> Certificate:
    """Examine a model on the trajectories of these records (physical units) and far beyond.

    Args:
        model: NNSS or LinearModel.
        splits: records by name; their range of inputs bounds the stress runs, which start from the largest x(0).
        steps: of each stress run; 0 for none, which leaves all that is certified.
        search_lyapunov: solve the LMI where a common Lyapunov matrix is not given by construction.
        budget: seconds for it and for proofs of gains and rates; 0 for as many as the former needs, no proofs and no
            attacks. What is exact without is stated.
        init_window: w, first samples from which the model's x(0) is found; for w > 1 those are covered beside g(y(0)),
            but where its encoder sees a window itself.

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
    runs = {name: [run for record in own for run in _runs(system, record, init_window)] for name, own in scaled.items()}
    points = {name: np.concatenate([system.scheduling(*run) for run in own]) for name, own in runs.items() if own}
    sizes = {name: radii(system.matrices(rho)) for name, rho in points.items()}
    radius = {name: float(own.max()) for name, own in sizes.items()}
    state: dict[str, float | None] = {name: max(_largest(x) for _, _, x in own) for name, own in runs.items() if own}
    seen = np.concatenate(list(points.values()))
    box_radius, box_norm, extremes = over_box(system, seen)
    constant = system.constant()
    lyapunov, rate = "not needed: ‖x‖² is one by construction", None
    if constant is not None:
        lyapunov, rate = only_lyapunov(constant.A)
    elif not system.promise.norm:
        lyapunov, rate = "not searched", None
        if search_lyapunov:
            started = time.perf_counter()
            until = started + FOR_LYAPUNOV * budget if budget > 0 else math.inf
            lyapunov, rate = common_lyapunov(system.matrices(spread(seen, extremes)), until)
            budget = max(budget - (time.perf_counter() - started), 0.01 * budget)
    initial = [(record.y[0], x[0].astype(np.float64)) for own in runs.values() for record, _, x in own]
    start = initial[int(np.argmax([np.linalg.norm(x0) for _, x0 in initial]))]
    largest_initial = float(np.linalg.norm(start[1]))
    started = time.perf_counter()
    stress: tuple[Stress, ...] = ()
    if steps:
        stress = stress_runs(system, system.adversary(low, high, *start), low, high, *start, steps)
    seconds = time.perf_counter() - started
    input_bound = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    bounds = system.output_bounds()
    bound = invariant = None
    holds_for, limit = "", math.inf
    if isinstance(system, Neural) and system.promise.norm and system.gamma < 1:
        invariant = bounds[0] * input_bound / (1 - system.gamma)
        bound = max(largest_initial, invariant)
        limit = bound * (1 + system.rounding())
        holds_for = f"{system.starts(len(everything), init_window)}, inputs within their range"
    largest = max(box_radius, *radius.values())
    broken = _broken(system, largest, box_norm)
    worst = np.concatenate([extremes, *(points[name][[own.argmax()]] for name, own in sizes.items())])
    sampled = say.Sampled(largest, box_norm, rate, lyapunov, _beyond(system, worst, largest))
    said = [
        say.frozen(system.promise, system.gamma, sampled, tuple(broken)),
        say.quadratic(system.promise, system.gamma, sampled, tuple(broken)),
    ]
    if bound is not None:
        reached = [(x, f"along a record of '{name}'") for name, x in state.items()]
        reached += [(run.state, f"under input '{run.input}'") for run in stress]
        beyond = [
            f"state {_number(x):.4g} {where}, promised at most {bound:.4g}"
            for x, where in reached
            if not _number(x) <= limit
        ]
        broken += beyond
        how = f"by construction, in exact arithmetic; rounding explains {system.rounding():.1e} of it"  # type: ignore[union-attr]
        said.append(
            Statement("state", "refuted" if beyond else "proved", f"‖x(k)‖ ≤ {bound:.6g}", bound,
                      "" if beyond else holds_for, "; ".join(beyond) or how)
        )  # fmt: skip
    else:
        said.append(
            Statement("state", "unknown", "the state stays bounded", None, "", "nothing follows by construction")
        )
    started = time.perf_counter()
    if constant is not None:  # all is exact
        gain = incremental_gain = say.gain_of_one_matrix(constant, scaling.u_std, scaling.y_std, system.integrates)
        said = [*say.of_one_matrix(constant, input_bound)]
    else:
        assert isinstance(system, Neural)
        largest_state = max(map(_number, state.values()))
        if budget > 0 and math.isfinite(largest_state):
            found = search(system, bounds, scaling, low, high, largest, largest_state, budget)
        else:
            why = (
                "not searched" if math.isfinite(largest_state) else "the state left the range of numbers along a record"
            )
            found = not_searched(system, bounds, scaling, why)
        gain, incremental_gain = found.gain, found.incremental_gain
        proved = {each.name: each for each in (found.quadratic, found.state) if each is not None}
        said = [own if own.status in ("proved", "refuted") else proved.get(own.name, own) for own in said]
        said.append(found.incremental)
    if broken and system.promise.pairs:  # nothing is proved by a construction that does not hold
        why = "; ".join(broken)
        said = [replace(s, status="unknown", holds_for="", how=why) if s.name == "incremental" else s for s in said]
        gain, incremental_gain = (
            replace(each, status="unknown", bound=None, bound_physical=None, tightness=None, holds_for="", how=why)
            for each in (gain, incremental_gain)
        )
    return Certificate(
        system.kind, system.stability, system.covers, system.gamma, len(everything), holds_for, radius, state,
        largest_initial, box_radius, box_norm, bound, invariant, *bounds, input_bound, tuple(map(float, low)),
        tuple(map(float, high)), lyapunov, rate, tuple(said), gain, incremental_gain, stress, seconds,
        time.perf_counter() - started, tuple(broken),
    )  # fmt: skip


def _runs(system: Neural | Linear, record: Record, w: int) -> list[tuple[Record, FloatArray, FloatArray]]:
    """The record with y (K, m) and x (K, n) simulated from its first sample, and also from its first w."""
    found = [(record, *system.trajectory(record))]
    if system.finds_state and w > 1 and len(record) >= w:
        x0 = system.state_from_window(record, w)
        y, x = system.run(record.u[:, :, None], record.y[0][:, None], x0[:, None])
        found.append((record, y[:, :, 0], x[:, :, 0]))
    return found


def _beyond(system: Neural | Linear, rho: FloatArray, largest: float) -> tuple[float, float] | None:
    """ρ(A), where among these ρ (N, ·) it is proved to be largest, and its margin; None where it reaches no promise."""
    level = min(system.gamma, 1.0)
    if isinstance(system, Linear) or largest < level:
        return None
    found = max((system.proved_radius(each) for each in rho), key=lambda each: each[0] - each[1])
    return found if found[0] - found[1] >= level else None


def _broken(system: Neural | Linear, radius: float, norm: float) -> list[str]:
    """What was seen against the promises for A(ρ)."""
    broken = []
    if radius >= system.gamma:
        broken.append(f"spectral radius {radius:.8g}, promised below {system.gamma:g}")
    if system.promise.norm and norm >= system.gamma:
        broken.append(f"norm {norm:.8g}, promised below {system.gamma:g}")
    if isinstance(system, Neural) and isinstance(system.model.generator, Lure):
        size = system.model.generator.promised_norm()
        if not size < 1:
            broken.append(f"matrix of the layer's promise: norm {size:.8g}, expected below 1")
    return broken


def _number(value: float | None) -> float:
    return math.inf if value is None else value


def _largest(x: FloatArray) -> float:
    """Largest ‖x‖ of (K, n); infinite where the state left the range of numbers."""
    with np.errstate(over="ignore", invalid="ignore"):
        largest = float(np.linalg.norm(x.astype(np.float64), axis=1).max())
    return largest if math.isfinite(largest) else math.inf
