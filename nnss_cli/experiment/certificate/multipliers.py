"""Gain and rate of a slope-restricted layer for every input and state, of any order: one LMI with multipliers.

    x(k+1) = A x + B u + F z,   y = C x + D u + E z,   z_i = δ_i v_i,   v = Gx + Hu,   0 ≤ δ_i ≤ s_i

holds from rest with the slopes δ of tanh's secants from its bias, and for differences of two trajectories with those of
any two of its points, s = 1. About the middle of the slopes, w = (2z − sv)/s has |w_i| ≤ |v_i|, so that for any λ > 0

    ‖ [S⁻¹ĀS, S⁻¹B̄/γ, S⁻¹F̄Λ⁻¹; C̄S, D̄/γ, ĒΛ⁻¹; ΛGS, ΛH/γ, 0] ‖₂ ≤ 1,   Ā = A + F s G/2,  F̄ = F s/2,  …,  Λ = diag(λ)

gives V(x(k+1)) − V(x) ≤ γ²‖u‖² − ‖y‖² for x = S z, V = ‖z‖²: an ℓ2 gain of γ. The columns of x and w and the rows of x
and v alone, the first column over a rate, give V(Δx(k+1)) ≤ rate² V(Δx). S and Λ come from an LMI in S⁻ᵀS⁻¹ and Λ²; the
norm is then bounded with the rounding of its own computation counted in. The source of the multiplier is that of
`baselines/incremental.py`, which promises the same with S = I by construction.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.certificate import lmi
from nnss_cli.experiment.certificate.affine import EPS, Affine
from nnss_cli.experiment.certificate.region import inverse, product
from nnss_cli.model.incremental import PlainArrays

ABOVE = (1e-4, 1e-3, 1e-2, 0.1)  # what is tried on top of the LMI's γ, relative
ROOM = (1e-9, 1e-7, 1e-5)  # of the LMI, relative to the size of its matrices
CLOSE = 5e-3  # bisection of the rate, relative to 1 − rate


@dataclass(frozen=True, eq=False)
class Bound:
    """What was proved of a layer."""

    number: float
    """γ, or the rate."""
    S: FloatArray
    """x = S z, V(x) = ‖z‖² (n, n)."""


def steepest_secants(b: FloatArray) -> FloatArray:
    """Upper bounds s (q,) on the slopes of tanh's secants from b (q,), (tanh(v + b) − tanh b)/v for any v.

    By symmetry b ≥ 0. To points w ≥ 0 they fall with w, as tanh is concave there, so that w = 0 is the worst. To w ≤ 0,
    where it is convex and lies above its tangent in any p ≤ 0, they are at most that tangent's slope σ = 1 − tanh²p if
    the tangent passes b no higher than tanh does: σ (b − p) ≥ tanh b − tanh p. The p farthest from 0 follows by
    bisection, and is tested with more than rounding to spare.
    """
    b = np.abs(b)

    def passes(p: FloatArray) -> FloatArray:
        return np.asarray((1 - np.tanh(p) ** 2) * (b - p) * (1 - 1e-12) >= (np.tanh(b) - np.tanh(p)) * (1 + 1e-12))

    near, far = np.zeros_like(b), -np.maximum(b, 1.0)
    for _ in range(60):
        middle = (near + far) / 2
        inside = passes(middle)
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    return np.asarray(np.where(passes(near), np.minimum((1 - np.tanh(near) ** 2) * (1 + 1e-12), 1.0), 1.0))


def gain(plain: PlainArrays, slopes: FloatArray, deadline: float) -> Bound | None:
    """The smallest ℓ2 gain from u to y that this proves; None without.

    Args:
        plain: the layer's matrices.
        slopes: s (q,): `steepest_secants` from rest, ones for differences.
        deadline: on `time.perf_counter`.
    """
    for room in ROOM:
        found = _proposed(plain, slopes, None, room, deadline)
        if found is None:
            continue
        S, weights, least = found
        for above in ABOVE:
            number = least * (1 + above)
            if number > 0 and norm(plain, slopes, S, weights, number, None) <= 1:
                return Bound(number, S)
    return None


def rate(plain: PlainArrays, deadline: float) -> Bound | None:
    """The smallest rate below 1 at which any two trajectories under one input are proved to tend together; or None."""
    ones = np.ones(len(plain.G))
    best: Bound | None = None
    low, high = 0.0, 1.0
    while high - low > CLOSE * (1 - low) and time.perf_counter() < deadline:
        # 1 − rate on a logarithmic scale at first: slow models have their rate close to 1
        tried = 1 - math.sqrt((1 - low) * max(1 - high, 1e-4 * (1 - low)))
        found = _proposed(plain, ones, tried, ROOM[0], deadline)
        number = tried + 1e-3 * (1 - tried)
        if found is not None and norm(plain, ones, found[0], found[1], math.inf, number) <= 1:
            best, high = Bound(number, found[0]), tried
        else:
            low = tried
    return best


def norm(
    plain: PlainArrays, slopes: FloatArray, S: FloatArray, weights: FloatArray, gamma: float, rate: float | None
) -> float:
    """Bound on the norm above, rounding included; of the rate's matrix where one is given, and γ does not count.

    Args:
        plain: the layer's matrices.
        slopes: s (q,).
        S: (n, n).
        weights: λ (q,).
        gamma: γ.
        rate: or the rate.
    """
    n, r, m, q = len(plain.A), plain.B.shape[1], len(plain.C), len(plain.G)
    blocks = _middle(plain, slopes)
    scale = (1.0 / weights) * (1 + 4 * EPS)  # no smaller than Λ⁻¹: w is then said to be larger than it is
    back = inverse(S)
    if rate is not None:
        kept_rows, kept_columns = np.r_[0:n, n + m : n + m + q], np.r_[0:n, n + r : n + r + q]
        blocks = Affine(*(part[..., kept_rows, :][..., kept_columns] for part in (blocks.c, blocks.l, blocks.r)))
        rows: list[FloatArray] = [np.diag(weights)]
        right: list[FloatArray] = [S / (rate * (1 - 4 * EPS)), np.diag(scale)]
    else:
        rows = [np.eye(m), np.diag(weights)]
        right = [S, np.eye(r) / gamma * (1 + 4 * EPS), np.diag(scale)]
    c = scipy.linalg.block_diag(back.c, *rows)
    left = Affine(c, np.zeros((1, *c.shape)), scipy.linalg.block_diag(back.r, *(0 * part for part in rows)))
    found = product(product(left, blocks), scipy.linalg.block_diag(*right))
    return float(np.linalg.norm(found.c, 2) + np.linalg.norm(found.r)) * (1 + 1e-12)


def _middle(plain: PlainArrays, slopes: FloatArray) -> Affine:
    """[Ā, B̄, F̄; C̄, D̄, Ē; G, H, 0] with the rounding of the products."""
    A, B, F, G, H, _, C, D, E = plain
    q = len(G)
    inner = np.concatenate([F, E]) * (slopes / 2)
    seen = np.concatenate([G, H], axis=1)
    outer = np.block([[A, B], [C, D]])
    c = np.block([[outer + inner @ seen, inner], [seen, np.zeros((q, q))]])
    lost = (q + 8) * EPS * (np.abs(outer) + np.abs(inner) @ np.abs(seen))
    r = np.block([[lost, 4 * EPS * np.abs(inner)], [0 * seen, np.zeros((q, q))]])
    return Affine(c, np.zeros((1, *c.shape)), r)


def _proposed(
    plain: PlainArrays, slopes: FloatArray, rate: float | None, room: float, deadline: float
) -> tuple[FloatArray, FloatArray, float] | None:
    """S, λ and γ (0 for a rate) of the LMI; None where it was not solved."""
    import cvxpy as cp

    n, r, m, q = len(plain.A), plain.B.shape[1], len(plain.C), len(plain.G)
    blocks = _middle(plain, slopes).c
    columns = np.r_[0:n, n : n + r * (rate is None), n + r : n + r + q]
    top, bottom, seen = (part[:, columns] for part in np.split(blocks, (n, n + m)))
    size, inputs = len(columns), len(columns) - n - q
    of_x, of_u, of_w = np.split(np.eye(size), (n, n + inputs))
    P, T, square = cp.Variable((n, n), symmetric=True), cp.Variable(q, nonneg=True), cp.Variable(nonneg=True)
    before, after = of_x.T @ P @ of_x, top.T @ P @ top
    if rate is None:
        before, after = before + square * (of_u.T @ of_u), after + bottom.T @ bottom
        objective, constraints = square, [P >> 1e-9 * np.eye(n)]
    else:
        before, bound = rate**2 * before, cp.Variable()
        objective, constraints = bound, [P >> np.eye(n), P << bound * np.eye(n)]
    squares = [T[i] * (np.outer(of_w[i], of_w[i]) - np.outer(seen[i], seen[i])) for i in range(q)]
    kept = before - after + sum(squares)
    constraints.append(kept >> room * np.eye(size))
    if not lmi.solved(cp.Problem(cp.Minimize(objective), constraints), deadline):
        return None
    found = lmi.value(T)
    weights = np.sqrt(np.maximum(found, max(1e-12 * float(found.max()), 1e-300)))
    return lmi.factor(P), weights, 0.0 if rate is not None else math.sqrt(max(float(lmi.value(square)), 0.0))
