"""Enclosures of a program in elementary operations over boxes: affine arithmetic, rounding included.

A value over a box is  f(s) ∈ c + Σ_i s_i l_i ± r  for all s ∈ [−1, 1]^d, entry by entry: what is of first order in the
box is exact and keeps its correlations, the rest is in r ≥ 0, so that an enclosure's excess falls with the box's
square. Every operation adds to r what float64 may have rounded away, with a factor to spare: k ε times the magnitudes
of what was summed, ε twice the unit roundoff. Where an operation is not defined all over the box, r is infinite.

Source: J. Stolfi and L. H. de Figueiredo, "Self-validated numerical methods and applications", 1997, ch. 3.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.elementary import NUMPY, Node, Program

EPS = 2.0 * np.finfo(np.float64).eps
LARGEST_CURVATURE = 0.0962251  # of |σ''|, 1/(6 √3), rounded up


@dataclass(frozen=True, eq=False)
class Affine:
    """Matrices over boxes; all arrays broadcast along their leading axes, of which there is one entry a box."""

    c: FloatArray
    """Centre (…, p, q)."""
    l: FloatArray  # noqa: E741
    """Slopes (d, …, p, q)."""
    r: FloatArray
    """Bound on what is left (…, p, q), never negative."""

    def spread(self) -> FloatArray:
        """Largest |f − c|."""
        return np.asarray(np.abs(self.l).sum(axis=0) + self.r)

    def largest(self) -> FloatArray:
        """Bound on |f|."""
        return np.asarray(np.abs(self.c) + self.spread())


Value = Affine | FloatArray  # an array is a constant


def over_boxes(centre: FloatArray, slopes: FloatArray) -> Affine:
    """The points centre (N, p) + slopes (N, p, d) s as columns (p, 1)."""
    return Affine(
        centre[:, :, None], np.moveaxis(slopes, 2, 0)[..., None], EPS * np.abs(slopes).sum(axis=2)[:, :, None]
    )


def _add(_: Node, a: Value, b: Value) -> Affine:
    return _sum(a, b, 1.0)


def _subtract(_: Node, a: Value, b: Value) -> Affine:
    return _sum(a, b, -1.0)


def _sum(a: Value, b: Value, sign: float) -> Affine:
    if not isinstance(b, Affine):
        assert isinstance(a, Affine)
        c = a.c + sign * b
        return Affine(c, *_fitted(a, c), _fit(a.r, c) + 4 * EPS * (np.abs(a.c) + np.abs(b) + a.spread()))
    if not isinstance(a, Affine):
        c = a + sign * b.c
        (slopes,) = _fitted(b, c)
        return Affine(c, sign * slopes, _fit(b.r, c) + 4 * EPS * (np.abs(a) + np.abs(b.c) + b.spread()))
    return Affine(a.c + sign * b.c, a.l + sign * b.l, a.r + b.r + 4 * EPS * (a.largest() + b.largest()))


def _fit(part: FloatArray, like: FloatArray) -> FloatArray:
    return np.asarray(np.broadcast_to(part, like.shape))


def _fitted(a: Affine, like: FloatArray) -> tuple[FloatArray]:
    """Slopes of a (d, …), where a scalar meets a matrix of constants."""
    return (np.asarray(np.broadcast_to(a.l, (len(a.l), *like.shape))),)


def _multiply(_: Node, a: Value, b: Value) -> Affine:
    return _times(a, b, np.multiply, 1)


def _product(_: Node, a: Value, b: Value) -> Affine:
    return _times(a, b, np.matmul, (a.c if isinstance(a, Affine) else a).shape[-1])


@np.errstate(over="ignore", invalid="ignore")  # 0 times an infinite remainder is not a number, and proves nothing
def _times(a: Value, b: Value, of: Callable[..., Any], terms: int) -> Affine:
    """A bilinear operation that sums up as many terms an entry."""
    if not isinstance(b, Affine):
        assert isinstance(a, Affine)
        size = np.abs(b)
        lost = (terms + 8) * EPS * of(a.largest(), size)
        return Affine(of(a.c, b), of(a.l, b), of(a.r, size) + lost)
    if not isinstance(a, Affine):
        size = np.abs(a)
        lost = (terms + 8) * EPS * of(size, b.largest())
        return Affine(of(a, b.c), of(a, b.l), of(size, b.r) + lost)
    first, second = np.abs(a.l).sum(axis=0), np.abs(b.l).sum(axis=0)
    # (c + l + r)(c' + l' + r') but for c c', c l' and l c'
    rest = of(np.abs(a.c), b.r) + of(a.r, np.abs(b.c) + second + b.r) + of(first, second + b.r)
    lost = 4 * (terms + 8) * EPS * of(a.largest(), b.largest())
    return Affine(of(a.c, b.c), of(a.c, b.l) + of(a.l, b.c), rest + lost)


def _divide(node: Node, a: Value, b: Value) -> Affine:
    return _multiply(node, a, _reciprocal(b) if isinstance(b, Affine) else 1.0 / b)


def _reciprocal(b: Affine) -> Affine:
    """1/(c + δ) = 1/c − δ/c² + δ²/(c² (c + δ))."""
    spread = b.spread()
    left = np.abs(b.c) - spread * (1 + 4 * EPS)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        square = 1.0 / b.c**2
        rest = b.r * square + spread**2 * square / left
        rest = np.where(left > 0, rest * (1 + 16 * EPS) + 16 * EPS * (np.abs(1 / b.c) + spread * square), np.inf)
        return Affine(np.where(left > 0, 1 / b.c, 0.0), np.where(left > 0, -b.l * square, 0.0), rest)


def _root(_: Node, a: Value) -> Affine:
    """√(c + δ) = √c + δ/(2√c) − δ²/(2√c (√(c + δ) + √c)²); by the range alone where that may reach 0.

    Of what is negative there is no root, so that the range begins at 0.
    """
    assert isinstance(a, Affine)
    spread = a.spread()
    inside = (a.c - spread * (1 + 4 * EPS) >= 0) & (a.c > 0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        root = np.sqrt(a.c)
        rest = (a.r + spread**2 / a.c) / (2 * root)
        half = np.sqrt(np.maximum(a.c + spread, 0.0)) / 2 * (1 + 16 * EPS)
        rest = np.where(inside, rest * (1 + 16 * EPS) + 16 * EPS * (root + spread / root), half)
        return Affine(np.where(inside, root, half), np.where(inside, a.l / (2 * root), 0.0), rest)


def _sigmoid(node: Node, a: Value) -> Affine:
    """By the tangent in the centre, or by the range alone where that says more."""
    assert isinstance(a, Affine)
    spread = a.spread() * (1 + 4 * EPS)
    sigma: Callable[[FloatArray], FloatArray] = lambda t: NUMPY["sigmoid"](node, t)  # noqa: E731
    with np.errstate(over="ignore", invalid="ignore"):
        middle = sigma(a.c)
        slope = middle * sigma(-a.c)
        nearest = np.maximum(np.abs(a.c) - spread, 0.0)
        curvature = np.minimum(sigma(nearest) * sigma(-nearest), LARGEST_CURVATURE)  # |σ''| ≤ σ' ≤ that of the nearest
        rest = slope * a.r + 0.5 * curvature * spread**2
        low, high = sigma(a.c - spread), sigma(a.c + spread)
    flat = ~(rest < (high - low) / 2)
    lost = 32 * EPS
    return Affine(
        np.where(flat, (low + high) / 2, middle),
        np.where(flat, 0.0, slope * np.where(flat, 0.0, a.l)),
        np.where(flat, (high - low) / 2, rest) * (1 + 32 * EPS) + lost,
    )


def _each(of: Callable[[FloatArray], FloatArray]) -> Callable[[Node, Value], Value]:
    """An operation that moves entries about."""

    def moved(_: Node, a: Value) -> Value:
        return Affine(of(a.c), of(a.l), of(a.r)) if isinstance(a, Affine) else of(a)

    return moved


def _reshape(node: Node, a: Value) -> Value:
    return _each(lambda x: x.reshape(*x.shape[:-2], *node.shape))(node, a)


def _part(node: Node, a: Value) -> Value:
    i, j, k, l = node.part  # noqa: E741
    return _each(lambda x: x[..., i:j, k:l])(node, a)


def _stack(axis: int) -> Callable[..., Value]:
    def stacked(_: Node, *parts: Value) -> Value:
        found = [part for part in parts if isinstance(part, Affine)]
        if not found:
            return np.concatenate(parts, axis=axis)  # type: ignore[arg-type]
        d, lead = len(found[0].l), np.broadcast_shapes(*(part.c.shape[:-2] for part in found))
        whole = [part if isinstance(part, Affine) else _exact(part, d, lead) for part in parts]

        def joined(arrays: list[FloatArray], *front: int) -> FloatArray:
            return np.concatenate([np.broadcast_to(x, (*front, *lead, *x.shape[-2:])) for x in arrays], axis=axis)

        return Affine(
            joined([part.c for part in whole]), joined([part.l for part in whole], d), joined([p.r for p in whole])
        )

    return stacked


def _exact(value: FloatArray, d: int, lead: tuple[int, ...]) -> Affine:
    value = np.broadcast_to(value, (*lead, *value.shape[-2:]))
    return Affine(value, np.zeros((d, *value.shape)), np.zeros(value.shape))


def _total(node: Node, a: Value) -> Value:
    total = _each(lambda x: x.sum(axis=(-2, -1), keepdims=True))(node, a)
    if not isinstance(a, Affine) or not isinstance(total, Affine):
        return total
    terms = a.c.shape[-1] * a.c.shape[-2]
    return Affine(total.c, total.l, total.r + (terms + 4) * EPS * a.largest().sum(axis=(-2, -1), keepdims=True))


def _of_constants(name: str, operation: Callable[..., Value]) -> Callable[..., Value]:
    def either(node: Node, *values: Value) -> Value:
        if any(isinstance(value, Affine) for value in values):
            return operation(node, *values)
        return NUMPY[name](node, *values)

    return either


OF_ENCLOSURES: dict[str, Callable[..., Value]] = {
    "add": _add, "subtract": _subtract, "multiply": _multiply, "divide": _divide, "product": _product,
    "transpose": _each(lambda x: x.swapaxes(-1, -2)), "reshape": _reshape, "part": _part, "rows": _stack(-2),
    "columns": _stack(-1), "sum": _total, "root": _root, "sigmoid": _sigmoid,
}  # fmt: skip
OPERATIONS = {name: _of_constants(name, operation) for name, operation in OF_ENCLOSURES.items()}
"""The operations of `Program.run` on enclosures."""


def enclosed(program: Program, **given: Affine) -> dict[str, Affine]:
    """Enclosures of a program's results, by name.

    What does not depend on the arguments is an enclosure without width.
    """
    lead = np.broadcast_shapes(*(value.c.shape[:-2] for value in given.values()))
    d = len(next(iter(given.values())).l)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = program.run(given, OPERATIONS, lambda _, value: value)
    return {name: value if isinstance(value, Affine) else _exact(value, d, lead) for name, value in found.items()}
