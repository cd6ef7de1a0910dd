"""Attacks and proofs over regions, for a model whose matrices vary: what bounds can be had in a given time."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np

from nnss_cli.datasets.record import FloatArray, Scaling
from nnss_cli.experiment.certificate import attack, lmi, multipliers
from nnss_cli.experiment.certificate.dissipation import storage
from nnss_cli.experiment.certificate.dynamics import Dynamics
from nnss_cli.experiment.certificate.equilibria import two_equilibria
from nnss_cli.experiment.certificate.lti import weighted_norm
from nnss_cli.experiment.certificate.region import Region, invariant, surrounding
from nnss_cli.experiment.certificate.result import Gain, Statement
from nnss_cli.experiment.certificate.statements import ROUNDED, falls, small_gain
from nnss_cli.experiment.certificate.systems import Neural
from nnss_cli.iterative import named_random
from nnss_cli.model.incremental import Lure

SHARES = (1.0, 0.5, 0.25)  # of the inputs' range for which a region is sought
WEAK = (0.5, 0.2, 0.05)  # likewise, of regions that weak inputs do not leave
FIRST_SHARE = (0.7, 0.6, 1.0)  # of the time that is left, for each
LARGEST = 4  # dimensions that are branched on
CORNERS = 16  # of the box of inputs, each of which a proof takes in turn
BOXES = 600_000  # most boxes of one proof
HELD, SIDE_BY_SIDE = 40, 128  # of the simulations that a region is drawn around: samples a level is held, and how many
LEVELS = 80
LEVELS_HELD = (0.1, 0.3, 0.7, 0.9)  # of the inputs' range, about which differences are attacked
PART = (
    0.35,
    0.55,
    0.65,
    0.75,
    0.85,
    1.0,
)  # of the budget: by when regions, gain, quadratic, rate, its gain and the attack must be done
LOOKED = 5.0  # initial states of pairs lie within this multiple of the largest state seen, or in the invariant ball


@dataclass(frozen=True)
class Found:
    """What the searches gave."""

    gain: Gain
    """ℓ2 gain."""
    incremental_gain: Gain
    """Of differences."""
    quadratic: Statement | None
    """Of one Lyapunov function over a region; None where that was not proved."""
    state: Statement | None
    """Of a region that is never left; None where none was proved."""
    incremental: Statement
    """Whether trajectories under one input tend together."""


def not_searched(system: Neural, bounds: tuple[float, float, float], scaling: Scaling, why: str) -> Found:
    """What follows from the construction alone."""
    nothing = Gain("unknown", None, None, None, None, None, "", why)
    gain = _by_construction(system, bounds, scaling) or nothing
    if not system.promise.pairs:
        return Found(gain, nothing, None, None, Statement("incremental", "unknown", TOGETHER, None, "", why))
    claim = falls("‖x1 − x2‖", system.gamma)
    how = "by construction, in exact arithmetic: a slope-restricted layer and one matrix inequality"
    together = Statement("incremental", "proved", claim, system.gamma, "every two x(0) and every input", how)
    differences = nothing
    if bound := system.architecture.gain:
        how = "by construction, in exact arithmetic: --gain"
        physical = _physical(bound, system, scaling)
        differences = Gain("proved", bound, physical, None, None, None, "one x(0) for both, every two inputs", how)
        gain = _better(gain, replace(differences, holds_for="x(0) = 0, every input"))
    return Found(gain, differences, None, None, together)


NO_MULTIPLIERS = "no storage function with a multiplier for each unit was proved"
TOGETHER = "trajectories under one input tend together"


def _by_construction(system: Neural, bounds: tuple[float, float, float], scaling: Scaling) -> Gain | None:
    if not (system.promise.norm and system.gamma < 1):
        return None
    bound = small_gain(system.gamma, *bounds)
    how = "by construction, in exact arithmetic: sup‖C‖ sup‖B‖/(1 − γ) + sup‖D‖"
    return Gain("proved", bound, _physical(bound, system, scaling), None, None, None, "x(0) = 0, every input", how)


def _physical(bound: float, system: Neural, scaling: Scaling) -> float | None:
    """A bound in physical units; of an integrator's part there is none."""
    if system.integrates:
        return None
    return float(bound * np.max(scaling.y_std) / np.min(scaling.u_std)) * (1 + 1e-12)


def search(
    system: Neural, bounds: tuple[float, float, float], scaling: Scaling, low: FloatArray, high: FloatArray,
    radius: float, largest_state: float, budget: float,
) -> Found:  # fmt: skip
    """Attack a model and prove what can be proved of it in `budget` seconds.

    Args:
        system: the model.
        bounds: sup‖B‖, sup‖C‖, sup‖D‖.
        scaling: to physical units.
        low: least inputs of the records (r,), normalised.
        high: largest.
        radius: largest ρ(A) seen, for the length of inputs.
        largest_state: largest ‖x‖ seen.
        budget: wall time [s]; proofs that are not done by then are given up.
    """
    started = time.perf_counter()
    until = [started + part * budget for part in PART]
    low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)  # rest is an input, too
    random = named_random(0, "certificate")
    found = not_searched(system, bounds, scaling, "")
    dynamics = system.dynamics()
    why = dynamics if isinstance(dynamics, str) else _too_much(dynamics)
    region: Region | None = None
    weak: Gain | None = None
    share, incremental = 1.0, found.incremental
    quadratic = state = None
    gain, incremental_gain = found.gain, found.incremental_gain
    if system.promise.pairs:
        gain, incremental_gain, incremental, state = _of_layer(system, found, scaling, low, high, until[4])
    elif incremental_gain.status == "unknown":
        incremental_gain = replace(incremental_gain, how=why)
    if isinstance(dynamics, Dynamics) and not system.promise.pairs:
        incremental = _pairs(system, dynamics, low, high, _widest(system, bounds, low, high, largest_state))
        refuted = incremental.status == "refuted"
        if not why:
            region, share = _region(system, dynamics, low, high, until[0], random)
            where = ""
            if region is not None:
                where = f"inputs within {_range(region.low, region.high)}" + _of_records(share)
                state = Statement(
                    "state", "proved", f"‖x(k)‖ ≤ {region.radius:.6g}", region.radius, f"x(0) = 0, {where}",
                    f"a polytope of {len(region.normals)} faces is never left: branch and bound, {ROUNDED}",
                )  # fmt: skip
                gain = _better(gain, _gain(system, dynamics, region, scaling, where, False, until[1], random))
                if not system.promise.norm:
                    quadratic = _rate(dynamics, region, where, False, until[2], random)
                if refuted:
                    incremental_gain = replace(incremental_gain, how="differences need not vanish: see 'incremental'")
                else:
                    closer = _rate(dynamics, region, where, True, until[3], random)
                    incremental = closer if closer is not None else incremental
                    incremental_gain = _gain(system, dynamics, region, scaling, where, True, until[4], random)
            else:
                why = "no region was found that inputs within the records' range do not leave"
                incremental_gain = replace(incremental_gain, how=why)
                weak = _of_small_energy(system, dynamics, low, high, scaling, until[4], random)
                gain = _better(gain, weak)
    if gain.status == "unknown" and not gain.how:
        gain = replace(gain, how=why)
    low, high = share * low, share * high
    middle = (time.perf_counter() + until[5]) / 2 if incremental_gain.bound else until[5]
    only_weak = gain is weak
    gain = _attacked(gain, system, scaling, low, high, radius, middle)
    if only_weak:  # the attack's inputs are not among those that the bound is of
        gain = replace(gain, tightness=None)
    if incremental_gain.bound:  # what is reached from rest is reached by a pair, of which one is at rest
        incremental_gain = replace(incremental_gain, attack=gain.attack, attack_physical=gain.attack_physical)
        levels = tuple(low + (high - low) * part for part in LEVELS_HELD)
        incremental_gain = _attacked(incremental_gain, system, scaling, low, high, radius, until[5], levels)
    return Found(gain, incremental_gain, quadratic, state, incremental)


def _widest(
    system: Neural, bounds: tuple[float, float, float], low: FloatArray, high: FloatArray, largest_state: float
) -> float:
    """Radius of the ball in which pairs begin."""
    if system.promise.norm and system.gamma < 1:
        return bounds[0] * float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high)))) / (1 - system.gamma)
    return LOOKED * max(largest_state, 1e-6)


def _too_much(dynamics: Dynamics) -> str:
    d = dynamics.n + dynamics.r * dynamics.bends
    if d > LARGEST:
        return f"{d} dimensions are too many to be branched on, at most {LARGEST}"
    if 2**dynamics.r > CORNERS:
        return f"{dynamics.r} inputs have too many corners"
    return "" if lmi.available() else lmi.MISSING


def _range(low: FloatArray, high: FloatArray) -> str:
    return " × ".join(f"[{a:.4g}, {b:.4g}]" for a, b in zip(low, high, strict=True))


def _of_records(share: float) -> str:
    return " (the records' range)" if share == 1 else f" ({share:g} of the records' range)"


def _reached(system: Neural, low: FloatArray, high: FloatArray, random: np.random.Generator) -> FloatArray:
    """States (N, n) of simulations from 0 under inputs held for a while, many of them at an end of their range."""
    r, n = len(low), system.architecture.order
    shape = (LEVELS, r, SIDE_BY_SIDE)
    ends = np.where(random.random(shape) < 0.5, low[:, None], high[:, None])
    inside = low[:, None] + (high - low)[:, None] * random.random(shape)
    levels = np.where(random.random(shape) < 0.5, ends, inside)
    levels[:, :, 0], levels[:, :, 1] = low, high
    u = np.repeat(levels, HELD, axis=0)
    _, x = system.run(u, np.zeros((system.architecture.outputs, SIDE_BY_SIDE)), np.zeros((n, SIDE_BY_SIDE)))
    states = np.moveaxis(x, 1, 2).reshape(-1, n).astype(np.float64)
    return states[np.isfinite(states).all(axis=1)]


def _region(
    system: Neural, dynamics: Dynamics, low: FloatArray, high: FloatArray, deadline: float, random: np.random.Generator
) -> tuple[Region | None, float]:
    """The region for the largest share of the inputs' range for which one is proved; 0 lies in it."""
    for i, share in enumerate(SHARES):
        left = (deadline - time.perf_counter()) * FIRST_SHARE[i]
        reached = _reached(system, share * low, share * high, random)
        region, _ = invariant(
            dynamics, reached, share * low, share * high, random, BOXES, time.perf_counter() + max(left, 0)
        )
        if region is not None and region.holds(np.zeros((1, dynamics.n))):
            return region, share
    return None, 1.0


def _gain(
    system: Neural, dynamics: Dynamics, region: Region, scaling: Scaling, where: str, differences: bool,
    deadline: float, random: np.random.Generator,
) -> Gain:  # fmt: skip
    program = dynamics.tangent if differences else dynamics.frozen
    found, why = storage(dynamics, program, region, True, BOXES, deadline, random)
    if found is None:
        return Gain("unknown", None, None, None, None, None, "", f"over the region that is never left: {why}")
    holds = f"one x(0) for both, of a region around 0, {where}" if differences else f"x(0) = 0, {where}"
    how = f"one storage function over a region that is never left: branch and bound, {found.boxes} boxes, {ROUNDED}"
    return Gain("proved", found.number, _physical(found.number, system, scaling), None, None, None, holds, how)


def _rate(
    dynamics: Dynamics, region: Region, where: str, differences: bool, deadline: float, random: np.random.Generator
) -> Statement | None:
    program = dynamics.tangent if differences else dynamics.frozen
    found, _ = storage(dynamics, program, region, False, BOXES, deadline, random)
    if found is None:
        return None
    how = f"branch and bound, {found.boxes} boxes, {ROUNDED}"
    if differences:
        claim = falls("‖S⁻¹(x1 − x2)‖", found.number)
        holds = f"any two x(0) of a region around 0 that is never left, {where}"
        return Statement("incremental", "proved", claim, found.number, holds, how)
    claim = falls("V(x) = ‖S⁻¹x‖²", found.number, "²") + " for u = 0"
    return Statement(
        "quadratic", "proved", claim, found.number, f"every x of a region that is never left, {where}", how
    )


def _of_small_energy(
    system: Neural, dynamics: Dynamics, low: FloatArray, high: FloatArray, scaling: Scaling, deadline: float,
    random: np.random.Generator,
) -> Gain:  # fmt: skip
    """A gain for inputs too weak to lead out of a region on which a storage function is proved.

    V(x(k)) ≤ γ² Σ_{j<k} ‖u(j)‖²: while that is below the level of V that fits into the region, the state is inside.
    """
    why = ""
    for i, share in enumerate(WEAK):
        left = (deadline - time.perf_counter()) / (len(WEAK) - i)
        region = surrounding(dynamics, _reached(system, share * low, share * high, random), share * low, share * high)
        found, why = storage(dynamics, dynamics.frozen, region, True, BOXES, time.perf_counter() + max(left, 0), random)
        if found is None or not region.holds(np.zeros((1, dynamics.n))):
            continue
        energy = region.level(found.S) / found.number
        holds = f"x(0) = 0, ‖u‖₂ ≤ {energy:.4g} in normalised units over all samples"
        if dynamics.bends:
            holds += f", inputs within {_range(region.low, region.high)}"
        how = f"one storage function over a region that such inputs do not leave: {found.boxes} boxes, {ROUNDED}"
        return Gain("proved", found.number, _physical(found.number, system, scaling), None, None, None, holds, how)
    why = f"no region was found that inputs within the records' range do not leave; for weak ones: {why}"
    return Gain("unknown", None, None, None, None, None, "", why)


def _of_layer(
    system: Neural, found: Found, scaling: Scaling, low: FloatArray, high: FloatArray, deadline: float
) -> tuple[Gain, Gain, Statement, Statement | None]:
    """Gain, gain of differences, rate and state of a slope-restricted layer, by one LMI each, for every input."""
    layer = system.model.generator
    assert isinstance(layer, Lure)
    plain = layer.arrays()
    how = f"one storage function and a multiplier for each unit, {ROUNDED}"
    gain, differences, incremental = found.gain, found.incremental_gain, found.incremental
    if not lmi.available():
        gain, differences = (
            replace(each, how=lmi.MISSING) if each.bound is None else each for each in (gain, differences)
        )
        return gain, differences, incremental, None

    def proved(slopes: FloatArray, holds_for: str) -> Gain:
        bound = multipliers.gain(plain, slopes, deadline)
        if bound is None:
            return Gain("unknown", None, None, None, None, None, "", NO_MULTIPLIERS)
        physical = _physical(bound.number, system, scaling)
        return Gain("proved", bound.number, physical, None, None, None, holds_for, how)

    of_pairs = proved(np.ones(len(plain.G)), "one x(0) for both, every two inputs")
    differences = _better(differences, of_pairs)
    rest = "x(0) = 0, every input"
    if of_pairs.bound is not None:  # of a pair one may be at rest
        gain = _better(gain, replace(of_pairs, holds_for=rest))
    gain = _better(gain, proved(multipliers.steepest_secants(plain.b), rest))
    slowest = multipliers.rate(plain, deadline)
    if slowest is None:
        return gain, differences, incremental, None
    if system.gamma == 1:  # by construction the distance does not grow, which says less
        claim = falls("‖S⁻¹(x1 − x2)‖", slowest.number)
        incremental = Statement("incremental", "proved", claim, slowest.number, "every two x(0) and every input", how)
    reach = weighted_norm(np.hstack([np.zeros_like(plain.A), plain.B + plain.F @ plain.H / 2]), slowest.S)
    reach += weighted_norm(np.hstack([np.zeros_like(plain.A), plain.F]), slowest.S) * float(np.linalg.norm(plain.H)) / 2
    largest = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    size = float(np.linalg.norm(slowest.S, 2) * reach * largest / (1 - slowest.number)) * (1 + 1e-9)
    where = f"x(0) = 0, inputs within {_range(low, high)}" + _of_records(1.0)
    return gain, differences, incremental, Statement("state", "proved", f"‖x(k)‖ ≤ {size:.6g}", size, where, how)


def _better(one: Gain, other: Gain) -> Gain:
    """The smaller bound; of equal ones the first, which holds for more."""
    if other.bound is None:
        return one if one.bound is not None else other
    return other if one.bound is None or other.bound < one.bound else one


def _attacked(
    gain: Gain, system: Neural, scaling: Scaling, low: FloatArray, high: FloatArray, radius: float, deadline: float,
    held: tuple[FloatArray | None, ...] = (None,),
) -> Gain:  # fmt: skip
    """The gain with the largest ratio that attacks reach, if that is more than is told of already."""
    for i, level in enumerate(held):
        now = time.perf_counter()
        found = attack.largest_gain(
            system.in_elementary_operations(), system.run, low, high, attack.horizon(radius), named_random(0, "gain"),
            now + (deadline - now) / (len(held) - i), level,
        )  # fmt: skip
        if gain.attack is not None and not found.ratio > gain.attack:
            continue
        physical = None
        if not system.integrates:
            size = float(np.linalg.norm(found.u * scaling.u_std))
            physical = float(np.linalg.norm(found.y * scaling.y_std)) / size if size > 0 else 0.0
        gain = replace(gain, attack=found.ratio, attack_physical=physical)
    return replace(gain, tightness=gain.attack / gain.bound if gain.bound and gain.attack is not None else None)


def _pairs(system: Neural, dynamics: Dynamics, low: FloatArray, high: FloatArray, radius: float) -> Statement:
    """Two equilibria under one input refute; else the widest growth that was seen is told."""
    pairs = attack.widest_pair(
        system.in_elementary_operations(), system.run, low, high, radius, named_random(0, "pairs")
    )
    if (found := two_equilibria(dynamics, system.run, pairs)) is not None:
        (u, first, second) = (v.tolist() for v in (found.u, found.first, found.second))
        how = (
            f"two equilibria under u = {u}: x1 = {first} and x2 = {second}, proved to exist within {found.margin:.1e} "
            "of these numbers (Krawczyk's test), so that their distance stays"
        )
        return Statement("incremental", "refuted", TOGETHER, float(np.linalg.norm(found.first - found.second)), "", how)
    how = "attack on pairs: no two equilibria under one input were found; " + (
        f"after {attack.PAIR_HORIZON} samples a distance was {pairs[0].growth:.4g} times what it began with, at most"
        if pairs
        else f"no pair stayed finite for {attack.PAIR_HORIZON} samples"
    )
    return Statement("incremental", "unknown", TOGETHER, None, "", how)
