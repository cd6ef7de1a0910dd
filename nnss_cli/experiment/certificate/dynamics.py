"""What a proof over a region speaks of: a model's step, its matrices and its Jacobians, as programs to be enclosed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.elementary import Array, Expression, Node, Program, columns, rows, trace
from nnss_cli.experiment.certificate.affine import Affine, enclosed
from nnss_cli.system import Parts


@dataclass(frozen=True, eq=False)
class Dynamics:
    """x(k+1) = f(x, u), y = h(x, u) in normalised units, for a model that is not scheduled on its previous output."""

    n: int
    """Number of states."""
    r: int
    """Number of inputs."""
    m: int
    """Number of outputs."""
    step: Program
    """x (n, 1), u (r, 1) → moved: f(x, u) (n, 1)."""
    frozen: Program
    """x, u → matrix: [A, B; C, D] (n + m, n + r) with f = A x + B u, h = C x + D u."""
    tangent: Program
    """x, u → matrix: the Jacobians [∂f/∂x, ∂f/∂u; ∂h/∂x, ∂h/∂u] (n + m, n + r)."""
    bends: bool
    """Whether u schedules; else `step` and `tangent` are affine in u, and `frozen` does not depend on it."""

    @classmethod
    def of(cls, parts: Parts, r: int, m: int, bends: bool) -> Dynamics:
        """From a model's formulas."""
        n = parts.n
        at = {"x": (n, 1), "u": (r, 1)}

        def mean(x: Expression) -> Expression:
            return x.constant(np.zeros((m, 1)))

        def frozen(x: Expression, u: Expression) -> dict[str, Expression]:
            A, B, C, D = parts.frozen(x, u, mean(x))
            return {"matrix": rows(columns(A, B), columns(C, D))}

        step = trace(lambda x, u: {"moved": parts.advance(x, u, mean(x))[0]}, **at)
        both = trace(lambda x, u: {"moved": rows(*parts.advance(x, u, mean(x)))}, **at)
        return cls(n, r, m, step, trace(frozen, **at), differentiated(both), bends)

    def over(self, program: Program, x: Affine, u: Affine) -> Affine:
        """Enclosures of the one result of a program of this model."""
        (found,) = enclosed(program, x=x, u=u).values()
        return found

    def at(self, program: Program, x: FloatArray, u: FloatArray) -> FloatArray:
        """The one result of a program of this model at points x (N, n) and u (N, r) or (r,)."""
        u = np.broadcast_to(u, (len(x), self.r))
        (found,) = program(x=x[:, :, None], u=u[:, :, None]).values()
        return np.asarray(np.broadcast_to(found, (len(x), *found.shape[-2:])))


def differentiated(program: Program) -> Program:
    """The Jacobian of a program's only result (p, 1) by its arguments, columns side by side, as a program again.

    Forward mode: beside each value its derivatives by every entry of the arguments, None where they vanish.
    """
    shapes = {name: program.nodes[number].shape for name, number in program.inputs.items()}

    def formula(**arguments: Expression) -> dict[str, Expression]:
        some = next(iter(arguments.values()))

        def constant(_: int, value: Array) -> Pair:
            return some.constant(value), None

        found = []
        for name, shape in shapes.items():
            for i in range(shape[0]):
                unit = np.zeros(shape)
                unit[i] = 1.0
                given = {
                    other: (value, value.constant(unit) if other == name else None)
                    for other, value in arguments.items()
                }
                results = program.run(given, FORWARD, constant)
                value, slope = next(iter(results.values()))
                found.append(value.constant(np.zeros(value.shape)) if slope is None else slope)
        return {"matrix": columns(*found)}

    return trace(formula, **shapes)


Pair = tuple[Expression, Expression | None]


def _whole(slope: Expression, value: Expression) -> Expression:
    """A scalar's derivative where the value is a matrix."""
    return slope if slope.shape == value.shape else slope + value.constant(np.zeros(value.shape))


def _forward_add(_: Node, a: Pair, b: Pair) -> Pair:
    value = a[0] + b[0]
    if a[1] is None or b[1] is None:
        slope = b[1] if a[1] is None else a[1]
        return value, None if slope is None else _whole(slope, value)
    return value, a[1] + b[1]


def _forward_subtract(node: Node, a: Pair, b: Pair) -> Pair:
    if b[1] is None:
        return a[0] - b[0], None if a[1] is None else _whole(a[1], a[0] - b[0])
    return a[0] - b[0], _forward_add(node, a, (b[0], b[1] * -1.0))[1]


def _bilinear(of: Callable[[Expression, Expression], Expression]) -> Callable[[Node, Pair, Pair], Pair]:
    def moved(_: Node, a: Pair, b: Pair) -> Pair:
        terms = [of(a[1], b[0])] * (a[1] is not None) if a[1] is not None else []
        terms += [of(a[0], b[1])] if b[1] is not None else []
        slope = None if not terms else terms[0] if len(terms) == 1 else terms[0] + terms[1]
        return of(a[0], b[0]), slope

    return moved


def _forward_divide(_: Node, a: Pair, b: Pair) -> Pair:
    value = a[0] / b[0]
    over = None if a[1] is None else a[1] / b[0]
    if b[1] is None:
        return value, over
    under = value * (b[1] / b[0])
    return value, under * -1.0 if over is None else over - under


def _linear(of: Callable[[Node, Expression], Expression]) -> Callable[[Node, Pair], Pair]:
    return lambda node, a: (of(node, a[0]), None if a[1] is None else of(node, a[1]))


def _stacked(of: Callable[..., Expression]) -> Callable[..., Pair]:
    def moved(_: Node, *parts: Pair) -> Pair:
        value = of(*(part for part, _ in parts))
        if all(slope is None for _, slope in parts):
            return value, None
        return value, of(*(part.constant(np.zeros(part.shape)) if slope is None else slope for part, slope in parts))

    return moved


def _forward_root(_: Node, a: Pair) -> Pair:
    value = a[0].root()
    return value, None if a[1] is None else a[1] / (value * 2.0)


def _forward_sigmoid(_: Node, a: Pair) -> Pair:
    value = a[0].sigmoid()
    return value, None if a[1] is None else value * (value * -1.0 + 1.0) * a[1]


FORWARD: dict[str, Callable[..., Pair]] = {
    "add": _forward_add, "subtract": _forward_subtract, "multiply": _bilinear(lambda a, b: a * b),
    "divide": _forward_divide, "product": _bilinear(lambda a, b: a @ b), "transpose": _linear(lambda _, a: a.T),
    "reshape": _linear(lambda node, a: a.reshape(*node.shape)),
    "part": _linear(lambda node, a: a[node.part[0] : node.part[1], node.part[2] : node.part[3]]),
    "rows": _stacked(rows), "columns": _stacked(columns), "sum": _linear(lambda _, a: a.sum()),
    "root": _forward_root, "sigmoid": _forward_sigmoid,
}  # fmt: skip
"""The operations of `Program.run` on pairs of a value and its derivative, while a formula is traced."""
