"""A model as a state-space system in elementary operations and physical units: what is linearised and exported."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from nnss_cli.elementary import Expression, Program, columns, rows, trace

Array: TypeAlias = NDArray[Any]

FAR = 5.0
"""Median deviations from their median, to which the outputs of an ensemble's members are clipped."""
STEP_SIZE = 1e-30
"""Of complex-step derivatives: too small to leave any rounding, far above underflow."""


@dataclass(frozen=True, eq=False)
class System:
    """z(k+1) = f(z(k), u(k)), y(k) = h(z(k), u(k)).

    u and y are physical. z = [x; y(k−1)]: x the model's own states, which belong to normalised signals, and below
    them, where the matrices are scheduled on it, the previous output in physical units, once for each member.
    """

    step: Program
    """z (N, 1), u (r, 1) → z_next (N, 1), y (m, 1)."""
    initial: Program
    """y0 (W m, 1), u0 (W r, 1) → z (N, 1): the start from the first W samples, one below the other."""
    frozen: Program
    """z, u → A (n, n), B (n, r), C (m, n), D (m, r): x(k+1) = A x + B (u − ū), y = C x + D (u − ū) + ȳ."""
    n: int
    """Number of states x."""
    outputs_kept: int
    """Number of previous outputs in z: 0, m, or m for each member of an ensemble."""
    inputs: int
    """Number of inputs r."""
    outputs: int
    """Number of outputs m."""
    u_mean: Array
    """ū (r,), physical units."""
    y_mean: Array
    """ȳ (m,), physical units."""
    feedthrough: bool
    """Whether y(k) depends on u(k) through a D."""
    first: int
    """Number W of samples from which `initial` starts: 1, unless an encoder sees more."""

    @property
    def size(self) -> int:
        """N, the length of z."""
        return self.n + self.outputs_kept

    @property
    def state_names(self) -> tuple[str, ...]:
        """x1 …, then y_previous1 …"""
        return (
            *(f"x{i + 1}" for i in range(self.n)),
            *(f"y_previous{i + 1}" for i in range(self.outputs_kept)),
        )

    @property
    def starts_from(self) -> str:
        """What `initial` takes, in words."""
        if self.first == 1:
            return "the first output sample (m,) and its input (r,)"
        return (
            f"the first {self.first} output samples ({self.first} m,) and their inputs ({self.first} r,), sample after "
            "sample"
        )

    def start(self, y0: Array, u0: Array) -> Array:
        """z(0) (N,) from the first W output samples (W, m) and their inputs (W, r)."""
        return np.asarray(self.initial(y0=y0.reshape(-1, 1), u0=u0.reshape(-1, 1))["z"][:, 0])

    def state(self, x: Array, y_previous: Array) -> Array:
        """z (N,) of states x (n,) and the output before (m,)."""
        return np.concatenate([x, np.tile(y_previous, self.outputs_kept // self.outputs)])

    def advance(self, z: Array, u: Array) -> tuple[Array, Array]:
        """z(k+1) (…, N) and y(k) (…, m) from z (…, N) and u (…, r)."""
        found = self.step(z=z[..., None], u=u[..., None])
        return found["z_next"][..., 0], found["y"][..., 0]

    def simulate(self, u: Array, z0: Array) -> tuple[Array, Array]:
        """y (K, m) and z (K, N) of inputs u (K, r) from z0 (N,)."""
        y, states = np.empty((len(u), self.outputs)), np.empty((len(u), self.size))
        z = z0
        for k in range(len(u)):
            states[k] = z
            z, y[k] = self.advance(z, u[k])
        return y, states

    def jacobians(self, z: Array, u: Array) -> tuple[Array, Array, Array, Array]:
        """∂f/∂z (N, N), ∂f/∂u (N, r), ∂h/∂z (m, N), ∂h/∂u (m, r) at z (N,) and u (r,), to the last digits.

        By the complex step: a program is analytic, so Im f(z + ih)/h is its derivative without any difference taken
        (W. Squire and G. Trapp, SIAM Review 40(1), 1998).
        """
        N, r = self.size, self.inputs
        directions = STEP_SIZE * 1j * np.eye(N + r)
        moved, y = self.advance(z + directions[:, :N], u + directions[:, N:])
        F, H = moved.imag.T / STEP_SIZE, y.imag.T / STEP_SIZE
        return F[:, :N], F[:, N:], H[:, :N], H[:, N:]


@dataclass(frozen=True, eq=False)
class Parts:
    """One model's formulas in normalised units, of which `system_of` makes a system in physical ones."""

    advance: Any
    """x (n, 1), ũ (r, 1), ỹ(k−1) (m, 1) → x(k+1), ỹ(k)."""
    initial: Any
    """ỹ (W m, 1), ũ (W r, 1) of the first W samples → x(0)."""
    frozen: Any
    """x, ũ, ỹ(k−1) → A, B, C, D in normalised units."""
    n: int
    """Number of states."""
    keeps_output: bool
    """Whether ỹ(k−1) is used."""
    feedthrough: bool
    """Whether there is a D."""
    first: int = 1
    """Number of samples W that `initial` takes; the same for all of an ensemble."""


def system_of(members: Sequence[Parts], scaling: Any, clipped: bool = False) -> System:
    """The system of one model, or of several whose outputs are averaged.

    Args:
        members: at least one, all of the same signals.
        scaling: of `nnss_cli.datasets.record.Scaling`, the same for all.
        clipped: whether outputs far from the others are moved nearer first (`nnss_cli.model.ensemble`); of three
            members or more.
    """
    u_mean, u_std, y_mean, y_std = (
        np.asarray(part, dtype=np.float64)[:, None]
        for part in (scaling.u_mean, scaling.u_std, scaling.y_mean, scaling.y_std)
    )
    r, m = len(u_mean), len(y_mean)
    keeping = [member for member in members if member.keeps_output]
    n, (W,) = sum(member.n for member in members), {member.first for member in members}

    def split(z: Expression) -> list[tuple[Expression, Expression]]:
        """x and ỹ(k−1) of each member; one that does not use the output gets any."""
        found, at, kept = [], 0, n
        for member in members:
            x = z[at : at + member.n, :]
            at += member.n
            if member.keeps_output:
                y = (z[kept : kept + m, :] - y_mean) / y_std
                kept += m
            else:
                y = z.constant(np.zeros((m, 1)))
            found.append((x, y))
        return found

    equal: list[Expression | Array] = [np.full((m, 1), 1 / len(members))] * len(members)

    def shared(values: Sequence[Expression], shares: Sequence[Expression | Array]) -> list[Expression]:
        """What each member has (m, ·) times the share (m, 1) that it has in each output."""
        if len(values) == 1:
            return [values[0]]
        return [
            value * (share if value.shape[1] == 1 else share @ np.ones((1, value.shape[1])))
            for value, share in zip(values, shares, strict=True)
        ]

    def step(z: Expression, u: Expression) -> dict[str, Expression]:
        u = (u - u_mean) / u_std
        moved = [member.advance(x, u, y) for member, (x, y) in zip(members, split(z), strict=True)]
        y = [own * y_std + y_mean for _, own in moved]
        kept = [own for own, member in zip(y, members, strict=True) if member.keeps_output]
        return {
            "z_next": rows(*(x for x, _ in moved), *kept),
            "y": _total(shared(y, _clipped_shares(y) if clipped else equal)),
        }

    def initial(y0: Expression, u0: Expression) -> dict[str, Expression]:
        y, u = (y0 - _down(y_mean, W)) / _down(y_std, W), (u0 - _down(u_mean, W)) / _down(u_std, W)
        return {"z": rows(*(member.initial(y, u) for member in members), *[y0[:m, :]] * len(keeping))}

    def frozen(z: Expression, u: Expression) -> dict[str, Expression]:
        u = (u - u_mean) / u_std
        begun = split(z)
        found = [member.frozen(x, u, y) for member, (x, y) in zip(members, begun, strict=True)]
        shares = equal
        if clipped:
            shares = _clipped_shares([one.advance(x, u, y)[1] for one, (x, y) in zip(members, begun, strict=True)])
        A = [
            columns(*(own if i == j else z.constant(np.zeros((own.shape[0], members[j].n))) for j in range(len(found))))
            for i, (own, *_) in enumerate(found)
        ]
        to_output, from_input = z.constant(np.diag(y_std[:, 0])), z.constant(np.diag(1 / u_std[:, 0]))
        return {
            "A": rows(*A),
            "B": rows(*(B @ from_input for _, B, _, _ in found)),
            "C": to_output @ columns(*shared([C for _, _, C, _ in found], shares)),
            "D": to_output @ _total(shared([D for *_, D in found], shares)) @ from_input,
        }

    N = n + m * len(keeping)
    return System(
        trace(step, z=(N, 1), u=(r, 1)),
        trace(initial, y0=(W * m, 1), u0=(W * r, 1)),
        trace(frozen, z=(N, 1), u=(r, 1)),
        n, N - n, r, m, u_mean[:, 0], y_mean[:, 0], any(member.feedthrough for member in members), W,
    )  # fmt: skip


def _total(values: Sequence[Expression]) -> Expression:
    total = values[0]
    for value in values[1:]:
        total = total + value
    return total


def _products(some: Sequence[Expression], others: Sequence[Expression]) -> list[Expression]:
    return [one * other for one, other in zip(some, others, strict=True)]


def _clipped_shares(values: Sequence[Expression]) -> list[Expression | Array]:
    """The weights w (m, 1) of some values y (m, 1) in their clipped mean, which is Σ wᵢ yᵢ.

    With p the weights of the median, r those of the median deviation, σ the deviations' signs and q = 1 where one is
    clipped, Σ wᵢ yᵢ = Σ pᵢ yᵢ + (1/k) Σⱼ [(1 − qⱼ) (yⱼ − ỹ) + qⱼ σⱼ 5 s], ỹ = Σ pᵢ yᵢ, s = Σ rᵢ σᵢ (yᵢ − ỹ).
    """
    p = _median_shares(values)
    centre = _total(_products(values, p))
    off = [value - centre for value in values]
    signs = [each.less(0.0) * -2.0 + 1.0 for each in off]
    sizes = _products(off, signs)
    r = _products(_median_shares(sizes), signs)
    limit = _total(_products(off, r)) * FAR
    beyond = [limit.less(size) for size in sizes]
    within = [each * -1.0 + 1.0 for each in beyond]
    pulled = _total(_products(beyond, signs)) * FAR
    left = _total(within) + pulled * _total(r)
    return [p[i] + (within[i] - p[i] * left + pulled * r[i]) / float(len(values)) for i in range(len(values))]


def _median_shares(values: Sequence[Expression]) -> list[Expression]:
    """The weights (m, 1) of some values (m, 1) in their median: one of them, or two half, count."""
    ranks = [value.constant(np.zeros(value.shape)) for value in values]
    for j in range(len(values)):
        for i in range(j):  # of equal ones the first counts as the lower
            smaller = values[j].less(values[i])
            ranks[i], ranks[j] = ranks[i] + smaller, ranks[j] - smaller + 1.0
    first, last = (len(values) - 1) // 2, len(values) // 2
    return [(rank.less(last + 0.5) - rank.less(first - 0.5)) / (last - first + 1.0) for rank in ranks]


def _down(column: Array, times: int) -> Array:
    """A column (n, 1) so many times below itself."""
    return np.tile(column, (times, 1))
