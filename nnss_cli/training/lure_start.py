"""Start an incrementally stable layer at a linear or Lur'e model: find the norm in which it keeps the promise.

A linear model gets a basis in which its norm lies midway between ρ(A) and γ. For a Lur'e model P of V(Δx) = ΔxᵀPΔx and
the multiplier come from the bounded real lemma of the loop about the units' middle slope: with v = ½Gx (and y/Γ) as
outputs and the units' (and u) as inputs, the Riccati equation's solution makes K of `nnss_cli.baselines.incremental` a
contraction in the basis T with TᵀT = P. What is infeasible is drawn in by the least of `DRAWN_IN`. The layer's
other units start without effect, where the margin of K leaves them room.

Source: C. E. de Souza and L. Xie, "On the discrete-time bounded real lemma", Systems & Control Letters 18(1), 1992.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TypeAlias, cast

import numpy as np
import scipy.linalg

from nnss_cli.baselines.schur import bounded_real_basis, contracting_basis
from nnss_cli.baselines.statespace import spectral_radius
from nnss_cli.datasets.record import FloatArray, Record
from nnss_cli.errors import InputError
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.incremental import Lure, PlainArrays, whole
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.encoder import set_encoder
from nnss_cli.training.warm import DRAWN_IN, LinearStart, encoder_layers

SLOPES = 0.5, 4.0  # of a unit, per deviation of what it sees
MARGINS = np.geomspace(1e-7, 1, 15)
WEIGHTS = np.geomspace(1e-2, 1e2, 9)
SHARE = 0.9  # of the room that K leaves, for the units without effect


Basis: TypeAlias = Callable[[PlainArrays], tuple[FloatArray, float] | None]
"""From matrices to a T and λ as `promising_basis` gives them."""


def start_layer(
    model: NNSS, plain: PlainArrays, x: FloatArray, random: np.random.Generator, basis_of: Basis | None = None
) -> tuple[FloatArray, PlainArrays]:
    """Set the layer of `model` to a Lur'e model of no more units, and its other units at random, without effect.

    Args:
        model: changed in place, but for its encoder.
        plain: with p ≤ q units: G (p, n), F (n, p), E (m, p), H (p, r).
        x: states of that model (K, n), for slopes and centres of the other units.
        random: draws them.
        basis_of: finds the basis; `promising_basis` where it is None.

    Returns:
        T (n, n), by which the layer's states are those of the model, and the matrices, which may have been drawn in.

    Raises:
        InputError: it keeps no promise, however far it is drawn in, or has more units than the layer.
    """
    a = model.architecture
    if len(plain.G) > a.hidden[0]:
        raise InputError(f"expected at least {len(plain.G)} hidden units, found {a.hidden[0]}")
    layer = cast(Lure, model.generator)
    for inside in DRAWN_IN:
        drawn = drawn_in(plain, 1 - inside, a.gain > 0)
        basis = promising_basis(drawn, a) if basis_of is None else basis_of(drawn)
        if basis is None:
            continue
        T, weight = basis
        try:
            whole_layer, scale = with_idle_units(transformed(drawn, T), weight, x @ T.T, a, random)
            layer.place(whole_layer, scale)
        except InputError:
            continue
        return T, drawn
    raise InputError("expected a model that can be made incrementally stable, found none near it")


def linear_layer(model: NNSS, linear: LinearStart, train: tuple[Record, ...], random: np.random.Generator) -> None:
    """Set `model` such that it simulates like SSEST's, from the same x(0).

    Args:
        model: changed in place.
        linear: of `linear_start`.
        train: experiments in normalised units, whose states the units without effect are laid out on.
        random: draws these.

    Raises:
        InputError: see `start_layer`.
    """
    start, E = linear
    (m, r), n = start.D.shape, start.order
    plain = PlainArrays(
        start.A, start.B, np.zeros((n, 0)), np.zeros((0, n)), np.zeros((0, r)), np.zeros(0), start.C,
        start.D * model.architecture.feedthrough, np.zeros((m, 0)),
    )  # fmt: skip
    x = np.concatenate([start.simulate(record.u, E @ record.y[0])[1] for record in train])
    T, _ = start_layer(model, plain, x, random)
    set_encoder(encoder_layers(model), T @ E, np.zeros(n))


def drawn_in(plain: PlainArrays, share: float, gain: bool) -> PlainArrays:
    """A and F times a share below 1; C and D too where their gain counts."""
    kept = {"A": plain.A * share, "F": plain.F * share}
    if gain:
        kept |= {"C": plain.C * share**2, "D": plain.D * share**2}
    return plain._replace(**kept)


def transformed(plain: PlainArrays, T: FloatArray) -> PlainArrays:
    """The same model with states T x."""
    inverse = np.linalg.inv(T)
    return plain._replace(
        A=T @ plain.A @ inverse, B=T @ plain.B, F=T @ plain.F, G=plain.G @ inverse, C=plain.C @ inverse
    )


def midway_basis(A: FloatArray, gamma: float) -> FloatArray | None:
    """T with ‖T A T⁻¹‖₂² < (ρ(A)² + γ²)/2: half of what the radius leaves is room for units, in all directions."""
    try:
        return contracting_basis(A, math.sqrt((spectral_radius(A) ** 2 + gamma**2) / 2))
    except InputError:
        return None


def promising_basis(plain: PlainArrays, a: Architecture) -> tuple[FloatArray, float] | None:
    """T and λ of the smallest norm among `promising_bases`; None where there are none.

    Without units and gain, where λ only scales P: a T in which A contracts, and 1.
    """
    if not len(plain.G) and not a.gain:
        T = midway_basis(plain.A, a.gamma)
        return None if T is None else (T, 1.0)
    best = min(promising_bases(plain, a), key=lambda each: each[0], default=None)
    return best and best[1:]


def promising_bases(plain: PlainArrays, a: Architecture) -> Iterator[tuple[float, FloatArray, float]]:
    """‖K‖₂ < 1 in the states T x with Λ = λ/2, with T (n, n) and λ: those found over a range of margins and of λ.

    Without a gain λ only scales P, and is 1.

    Args:
        plain: its units see no u, and y none of them. At least one unit, unless there is a gain.
        a: γ and Γ.
    """
    n, r, p = len(plain.A), plain.B.shape[1], len(plain.G)
    A, F = (plain.A + plain.F @ plain.G / 2) / a.gamma, plain.F / a.gamma
    for weight in WEIGHTS if a.gain and p else (1.0,):
        seen, fed, D = weight * plain.G / 2, F / weight, np.zeros((p, p))
        if a.gain:
            seen, fed = np.concatenate([plain.C / a.gain, seen]), np.concatenate([plain.B / a.gamma, fed], axis=1)
            D = scipy.linalg.block_diag(plain.D / a.gain, D)
        Q, S, R = seen.T @ seen, seen.T @ D, D.T @ D - np.eye(r * (a.gain > 0) + p)
        for margin in MARGINS * np.trace(Q) / len(seen):
            T = bounded_real_basis(A, fed, Q + margin * np.eye(n), R, S)
            if T is None:
                continue
            norm = float(np.linalg.norm(matrix(transformed(plain, T), np.full(p, 2.0 / weight), a), 2))
            if norm < 1:
                yield norm, T, float(weight)


def matrix(plain: PlainArrays, scale: FloatArray, a: Architecture) -> FloatArray:
    """K as one matrix."""
    K1, K21 = whole(plain, scale, a.gamma, a.gain)
    return np.block([[K1], [K21, np.zeros((len(K21), len(K21)))]])


def with_idle_units(
    plain: PlainArrays, weight: float, x: FloatArray, a: Architecture, random: np.random.Generator
) -> tuple[PlainArrays, FloatArray]:
    """The model with units beside its own up to the layer's, that change nothing yet; and Λ⁻¹ of all (q,).

    A unit sees a direction of x at random, or one of the outputs', with a slope and a centre at random. Its Λᵢ² is a
    share of 1/GᵢS⁻¹Gᵢᵀ, S what K leaves of I for x, so that all of them together take no more than `SHARE` of it.

    Args:
        plain: in the basis in which it keeps the promise with Λ = λ/2.
        weight: λ.
        x: its states (K, n).
        a: the layer's sizes.
        random: draws directions, slopes and centres.

    Raises:
        InputError: K leaves no room for them.
    """
    n, r, m, q, p = a.order, a.inputs, a.outputs, a.hidden[0], len(plain.G)
    idle, scale = q - p, np.full(p, 2.0 / weight)
    low, high = np.log(SLOPES)
    spread = np.linalg.cholesky(x.T @ x / len(x) + 1e-9 * np.mean(x**2) * np.eye(n))
    directions = np.linalg.solve(spread.T, random.standard_normal((n, idle))).T
    shown = random.integers(0, 2, idle).astype(bool)
    directions[shown] = plain.C[random.integers(0, m, idle)][shown]
    spans = np.sqrt(np.mean((x @ directions.T) ** 2, axis=0))
    G = directions / np.maximum(spans, 1e-12)[:, None] * np.exp(random.uniform(low, high, idle))[:, None]
    b = -np.sum(G * x[random.integers(len(x), size=idle)], axis=1)
    room = np.eye(n + p + r * (a.gain > 0)) - (K := matrix(plain, scale, a)).T @ K
    seen = slice(r * (a.gain > 0), r * (a.gain > 0) + n)
    inverse = np.linalg.inv(room)[seen, seen]  # of the Schur complement S
    squares = np.einsum("ij,jk,ik->i", G, inverse, G) * max(idle, 1) / SHARE
    if not (squares > 0).all():  # rounding, where poor data leave K no room
        raise InputError("expected room beside the model for units without effect, found none")
    own = np.sqrt(squares)
    found = PlainArrays(
        plain.A, plain.B, np.pad(plain.F, ((0, 0), (0, idle))), np.concatenate([plain.G, G]), np.zeros((q, r)),
        np.concatenate([plain.b, b]), plain.C, plain.D, np.zeros((m, q)),
    )  # fmt: skip
    return found, np.concatenate([scale, own])
