"""Inputs and initial states that make a model look worst, by gradient ascent through its simulation.

With F, G, H, J the model's Jacobians along a trajectory, a cost's gradient by the inputs is that of the adjoint,

    λ(k) = F(k)ᵀ λ(k+1) + H(k)ᵀ e(k),   ∂/∂u(k) = G(k)ᵀ λ(k+1) + J(k)ᵀ e(k)

For the ℓ2 gain e = y, and the next input is the gradient, scaled to the energy of its start and cut to the box: the
power iteration that gives a linear system's gain (J. Tierno et al., "A numerically efficient approach to robustness
analysis", ACC 1995). For pairs λ(K) = ±(x1 − x2)/‖x1 − x2‖² from either end.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.system import STEP_SIZE, System

ITERATIONS = 20
SHORTEST, LONGEST = 200, 2000  # samples of an input
TIME_CONSTANTS = 8.0  # that an input lasts
ENERGIES = (0.03, 0.3, 1.0)  # of the starts, relative to the box: the first sees the linearisation at rest
PAIRS, PAIR_ASCENTS, PAIR_HORIZON = 48, 12, 60

Run: TypeAlias = Callable[[FloatArray, FloatArray, FloatArray], tuple[FloatArray, FloatArray]]
"""y (K, m, b) and x (K, n, b) from u (K, r, b), y(−1) (m, b) and x(0) (n, b)."""


@dataclass(frozen=True, eq=False)
class Attack:
    """The largest ratio that was found."""

    ratio: float
    """‖y‖₂/‖u‖₂ from x(0) = 0, over the samples simulated; the true gain is no smaller."""
    u: FloatArray
    """The input (K, r), or its change."""
    y: FloatArray
    """Its output (K, m), or the change of it."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Two initial states and an input under which they part furthest."""

    growth: float
    """‖x1(K) − x2(K)‖/‖x1(0) − x2(0)‖."""
    ends: FloatArray
    """x1(K) and x2(K) (2, n)."""
    u: FloatArray
    """The last input (r,)."""


def horizon(radius: float) -> int:
    """Samples that show a gain, for poles of this radius."""
    lasting = TIME_CONSTANTS / max(1 - radius, 1e-9)
    return int(np.clip(lasting, SHORTEST, LONGEST))


def largest_gain(
    system: System, run: Run, low: FloatArray, high: FloatArray, K: int, random: np.random.Generator,
    deadline: float, held: FloatArray | None = None,
) -> Attack:  # fmt: skip
    """Ascend the ℓ2 gain from several starts: held, sinusoidal and random inputs of several energies.

    With an input that is held, that of differences: of y to what it is under that input alone, per change of the input.

    Args:
        system: the model in normalised units.
        run: its simulation.
        low: least inputs (r,).
        high: largest.
        K: samples.
        random: for starts.
        deadline: on `time.perf_counter`; at least one round is made.
        held: inputs (r,) within the range; 0 without, from which y is that of rest.
    """
    r, k = len(low), np.arange(K)
    held = np.zeros(r) if held is None else held
    low, high = low - held, high - held
    largest = np.maximum(np.abs(low), np.abs(high))
    shapes = [np.ones((K, r)) * (np.where(high > -low, 1.0, -1.0)), -np.ones((K, r)) * np.where(high > -low, 1.0, -1.0)]
    shapes += [np.sin(2 * np.pi * k / period)[:, None] * np.ones(r) for period in (K / 2, K / 8, 16.0)]
    shapes.append(np.repeat(random.uniform(-1, 1, (K // 20 + 1, r)), 20, axis=0)[:K])
    starts = [size * largest * shape for size in ENERGIES for shape in shapes]
    u = np.clip(np.stack(starts, axis=2), low[:, None], high[:, None])
    b = u.shape[2]
    energy = np.linalg.norm(u, axis=(0, 1))
    best = Attack(0.0, u[:, :, 0], np.zeros((K, system.outputs)))
    rest = np.zeros((system.n, b))
    alone: FloatArray = np.zeros((K, system.outputs, 1))
    if held.any():
        alone, _ = run(np.tile(held[:, None], (K, 1, 1)), np.zeros((system.outputs, 1)), rest[:, :1])
    for _ in range(ITERATIONS):
        with np.errstate(over="ignore", invalid="ignore"):
            y, x = run(u + held[:, None], np.zeros((system.outputs, b)), rest)
            off = y - alone
            sizes = np.linalg.norm(u, axis=(0, 1))
            ratios = np.linalg.norm(off, axis=(0, 1)) / np.where(sizes > 0, sizes, np.inf)
        leader = int(np.argmax(np.where(np.isfinite(ratios), ratios, -1.0)))
        if np.isfinite(ratios[leader]) and ratios[leader] > best.ratio:
            best = Attack(float(ratios[leader]), u[:, :, leader].copy(), off[:, :, leader].copy())
        if time.perf_counter() > deadline:
            break
        slope, _ = gradients(system, u + held[:, None], y, x, off, np.zeros((system.n, b)))
        size = np.linalg.norm(slope, axis=(0, 1))
        usable = np.isfinite(size) & (size > 0)
        moved = np.where(usable, energy / np.where(usable, size, 1.0), 0.0) * np.where(usable, slope, 0.0)
        u = np.where(usable, np.clip(moved, low[:, None], high[:, None]), u)
    return best


def gradients(
    system: System, u: FloatArray, y: FloatArray, x: FloatArray, e: FloatArray, last: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives by u (K, r, b) and x(0) (n, b) of Σ eᵀ y + lastᵀ x(K) at trajectories y (K, m, b), x (K, n, b)."""
    K, n, b = x.shape
    before = np.concatenate([np.zeros((1, *y.shape[1:])), y[:-1]])
    parts = [x] + [before] * bool(system.outputs_kept)
    z = np.moveaxis(np.concatenate(parts, axis=1), 1, 2).astype(np.float64)
    F, G, H, J = jacobians(system, z, np.moveaxis(u, 1, 2))
    adjoint = np.zeros((b, z.shape[2]))
    adjoint[:, :n] = last.T
    slope = np.empty((K, b, u.shape[1]))
    drive = np.moveaxis(e, 1, 2)
    with np.errstate(over="ignore", invalid="ignore"):
        for i in range(K - 1, -1, -1):
            slope[i] = np.einsum("bnr,bn->br", G[i], adjoint) + np.einsum("bmr,bm->br", J[i], drive[i])
            adjoint = np.einsum("bnp,bn->bp", F[i], adjoint) + np.einsum("bmp,bm->bp", H[i], drive[i])
    return np.moveaxis(slope, 2, 1), adjoint[:, :n].T


def jacobians(system: System, z: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """F, G, H, J (…, ·, ·) at points z (…, N) and u (…, r), all side by side, by the complex step."""
    N = system.size
    directions = STEP_SIZE * 1j * np.eye(N + u.shape[-1])
    found = [system.advance(z + d[:N], u + d[N:]) for d in directions]
    moved, output = (np.stack([pair[i].imag / STEP_SIZE for pair in found], axis=-1) for i in (0, 1))
    return moved[..., :N], moved[..., N:], output[..., :N], output[..., N:]


def widest_pair(
    system: System, run: Run, low: FloatArray, high: FloatArray, radius: float, random: np.random.Generator
) -> list[Pair]:
    """Ascend ‖x1(K) − x2(K)‖/‖x1(0) − x2(0)‖ over inputs, held in pieces, and both initial states in a ball.

    The widest first; their ends are where a search for two equilibria starts.
    """
    r, b = len(low), PAIRS
    middle, half = ((high + low) / 2)[:, None], ((high - low) / 2)[:, None]
    levels = random.uniform(-1, 1, (r, b))
    u = np.repeat(levels[None], PAIR_HORIZON, axis=0)  # held, so that what they tend to can be told apart
    x0 = random.standard_normal((2, system.n, b))
    x0 *= radius * 10 ** random.uniform(-2, 0, (2, 1, b)) / np.linalg.norm(x0, axis=1, keepdims=True)
    x0[1, :, ::2] = x0[0, :, ::2] + 1e-3 * radius * random.standard_normal((system.n, (b + 1) // 2))  # close ones
    rest = np.zeros((system.outputs, b))
    found: dict[int, Pair] = {}
    for step in range(PAIR_ASCENTS):
        inputs = middle + half * u
        runs = [run(inputs, rest, x0[i]) for i in (0, 1)]
        gap, first = runs[0][1][-1] - runs[1][1][-1], x0[0] - x0[1]
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            growth = np.linalg.norm(gap, axis=0) / np.linalg.norm(first, axis=0)
            pull = gap / np.maximum(np.sum(gap**2, axis=0), 1e-300)
        for c in map(int, np.flatnonzero(np.isfinite(growth))):
            if c not in found or growth[c] > found[c].growth:
                ends = np.stack([runs[0][1][-1][:, c], runs[1][1][-1][:, c]])
                found[c] = Pair(float(growth[c]), ends, inputs[-1, :, c])
        slopes = [gradients(system, inputs, *runs[i], 0 * runs[i][0], (1 - 2 * i) * pull) for i in (0, 1)]
        of_u = np.mean(slopes[0][0] + slopes[1][0], axis=0)
        size = 0.3 / (1 + step / 4)
        u = np.clip(u + size * np.sign(np.nan_to_num(of_u)), -1, 1)
        for i in (0, 1):
            # of the logarithm: the initial distance counts against it
            own = np.nan_to_num(slopes[i][1]) - (1 - 2 * i) * first / np.maximum(np.sum(first**2, axis=0), 1e-300)
            moved = x0[i] + size * np.linalg.norm(first, axis=0) * own / np.maximum(np.linalg.norm(own, axis=0), 1e-300)
            x0[i] = moved * np.minimum(1.0, radius / np.maximum(np.linalg.norm(moved, axis=0), 1e-300))
    return sorted(found.values(), key=lambda pair: -pair.growth)
