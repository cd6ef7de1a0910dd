"""A step of a model as a list of elementary operations on matrices, of which simulation and every export are made.

The operations are + − × / and < (element by element, a scalar with anything), product, transpose, reshape, part,
stack, sum, square root and sigmoid. Whatever has these can run a model: there is no solver among them. Systems of
equations are solved by elimination without pivoting, which is backward stable where the symmetric part is positive
definite, as that of the Schur parametrisation's M is by construction (A. George and K. Ikramov, SIAM J. Matrix Anal.
Appl. 26(1), 2004; G. Golub and C. Van Loan, "Matrix Computations", 4th ed., 2013, 4.3).

A formula written with `Expression`s is traced into a `Program`, once; a program is data.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[Any]
Shape: TypeAlias = tuple[int, int]

ELEMENTWISE = ("add", "subtract", "multiply", "divide", "less")
OPERATIONS = ("input", "constant", *ELEMENTWISE, "product", "transpose", "reshape", "part", "rows", "columns", "sum",
              "root", "sigmoid")  # fmt: skip
"""All there are: rows and columns stack matrices below and beside each other."""


@dataclass(frozen=True, eq=False)
class Node:
    """One operation and the matrix that it gives."""

    operation: str
    """One of `OPERATIONS`."""
    of: tuple[int, ...]
    """The nodes it takes, by number."""
    shape: Shape
    """Of its result; a vector is a column, a scalar 1 × 1."""
    value: Array | None = None
    """Of a constant."""
    part: tuple[int, int, int, int] = (0, 0, 0, 0)
    """Of a part: first row, row behind the last, first column, column behind the last."""


@dataclass(frozen=True, eq=False)
class Program:
    """A function of matrices: nodes in an order in which they can be computed."""

    nodes: tuple[Node, ...]
    """Each takes earlier ones only."""
    inputs: Mapping[str, int]
    """Node of each argument."""
    outputs: Mapping[str, int]
    """Node of each result."""

    def __call__(self, **given: Array) -> dict[str, Array]:
        """Results by name, of arguments (…, rows, columns) with any leading axes, real or complex."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            return self.run({name: np.asarray(value) for name, value in given.items()}, NUMPY, lambda _, value: value)

    def run(
        self,
        given: Mapping[str, Any],
        operations: Mapping[str, Callable[..., Any]],
        constant: Callable[[int, Array], Any],
    ) -> dict[str, Any]:
        """Results by name, in any kind of values: arrays, symbols, names of variables.

        Args:
            given: the arguments by name.
            operations: by name, each from a node and the values it takes to its value.
            constant: from a constant's node, by number, and its array to its value.
        """
        by_node = {node: given[name] for name, node in self.inputs.items()}
        values: list[Any] = []
        for number, node in enumerate(self.nodes):
            if node.operation == "input":
                values.append(by_node[number])
            elif node.value is not None:
                values.append(constant(number, node.value))
            else:
                values.append(operations[node.operation](node, *(values[i] for i in node.of)))
        return {name: values[node] for name, node in self.outputs.items()}

    def users(self, number: int) -> list[tuple[int, Node]]:
        """The nodes that take a node, with their numbers."""
        return [(i, node) for i, node in enumerate(self.nodes) if number in node.of]

    def is_plain_number(self, number: int) -> bool:
        """Whether a node is a constant scalar that is only used element by element, so that it needs no matrix."""
        node = self.nodes[number]
        elementwise = all(user.operation in ELEMENTWISE for _, user in self.users(number))
        return node.value is not None and node.shape == (1, 1) and elementwise and number not in self.outputs.values()


def _stack(axis: int) -> Callable[..., Array]:
    def stacked(_: Node, *parts: Array) -> Array:
        leading = np.broadcast_shapes(*(part.shape[:-2] for part in parts))
        return np.concatenate([np.broadcast_to(part, leading + part.shape[-2:]) for part in parts], axis=axis)

    return stacked


def _sigmoid(_: Node, a: Array) -> Array:
    positive = a.real >= 0
    small = np.exp(np.where(positive, -a, a))  # never overflows
    return np.asarray(np.where(positive, 1.0, small) / (1.0 + small))


def _part(node: Node, a: Array) -> Array:
    i, j, k, l = node.part  # noqa: E741
    return a[..., i:j, k:l]


NUMPY: dict[str, Callable[..., Array]] = {
    "add": lambda _, a, b: a + b,
    "subtract": lambda _, a, b: a - b,
    "multiply": lambda _, a, b: a * b,
    "divide": lambda _, a, b: a / b,
    "less": lambda _, a, b: (a.real < b.real).astype(float),
    "product": lambda _, a, b: a @ b,
    "transpose": lambda _, a: a.swapaxes(-1, -2),
    "reshape": lambda node, a: a.reshape(*a.shape[:-2], *node.shape),
    "part": _part,
    "rows": _stack(-2),
    "columns": _stack(-1),
    "sum": lambda _, a: a.sum(axis=(-2, -1), keepdims=True),
    "root": lambda _, a: np.sqrt(a),
    "sigmoid": _sigmoid,
}
"""The operations of `Program.run` on arrays."""


class Expression:
    """A matrix in a formula that is being traced."""

    def __init__(self, trace: list[Node], node: Node) -> None:
        self._trace, self._number, self.shape = trace, len(trace), node.shape
        trace.append(node)

    def _new(self, operation: str, shape: Shape, *others: Expression, **more: Any) -> Expression:
        return Expression(self._trace, Node(operation, (self._number, *(o._number for o in others)), shape, **more))

    def _of(self, value: Expression | Array | float) -> Expression:
        if isinstance(value, Expression):
            return value
        matrix = np.atleast_2d(np.array(value, dtype=np.float64))
        return Expression(self._trace, Node("constant", (), (matrix.shape[0], matrix.shape[1]), matrix))

    def constant(self, value: Array | float) -> Expression:
        """A constant of the same formula."""
        return self._of(value)

    def _elementwise(self, operation: str, other: Expression | Array | float) -> Expression:
        a, b = self, self._of(other)
        if a.shape != b.shape and (1, 1) not in (a.shape, b.shape):
            raise ValueError(f"{operation}: shapes {a.shape} and {b.shape}")
        return a._new(operation, b.shape if a.shape == (1, 1) else a.shape, b)

    def __add__(self, other: Expression | Array | float) -> Expression:
        return self._elementwise("add", other)

    def __sub__(self, other: Expression | Array | float) -> Expression:
        return self._elementwise("subtract", other)

    def __mul__(self, other: Expression | Array | float) -> Expression:
        return self._elementwise("multiply", other)

    def __truediv__(self, other: Expression | Array | float) -> Expression:
        return self._elementwise("divide", other)

    def less(self, other: Expression | Array | float) -> Expression:
        """1 where an entry is smaller, 0 elsewhere; it has no slope."""
        return self._elementwise("less", other)

    def __matmul__(self, other: Expression | Array) -> Expression:
        b = self._of(other)
        if self.shape[1] != b.shape[0]:
            raise ValueError(f"product: shapes {self.shape} and {b.shape}")
        return self._new("product", (self.shape[0], b.shape[1]), b)

    def __getitem__(self, at: tuple[slice, slice]) -> Expression:
        """Rows i:j and columns k:l, given and within."""
        (i, j, _), (k, l, _) = at[0].indices(self.shape[0]), at[1].indices(self.shape[1])  # noqa: E741
        if (i, j, k, l) == (0, self.shape[0], 0, self.shape[1]):
            return self
        return self._new("part", (j - i, l - k), part=(i, j, k, l))

    @property
    def T(self) -> Expression:
        """Transposed."""
        return self._new("transpose", (self.shape[1], self.shape[0]))

    def reshape(self, rows: int, columns: int) -> Expression:
        """The same entries, row by row."""
        if rows * columns != prod(self.shape):
            raise ValueError(f"reshape: {self.shape} to {(rows, columns)}")
        return self._new("reshape", (rows, columns))

    def sum(self) -> Expression:
        """Of all entries."""
        return self._new("sum", (1, 1))

    def root(self) -> Expression:
        """Square root of each entry."""
        return self._new("root", self.shape)

    def sigmoid(self) -> Expression:
        """1/(1 + exp(−a)) of each entry."""
        return self._new("sigmoid", self.shape)


def dense(weight: Array, bias: Array, a: Expression) -> Expression:
    """W a + b, of constants."""
    return a.constant(weight) @ a + np.reshape(bias, (-1, 1))


def rows(*parts: Expression) -> Expression:
    """One below the other; those without rows are left out."""
    kept = [part for part in parts if part.shape[0]]
    if len(kept) == 1:
        return kept[0]
    return kept[0]._new("rows", (sum(p.shape[0] for p in kept), kept[0].shape[1]), *kept[1:])


def columns(*parts: Expression) -> Expression:
    """One beside the other."""
    return parts[0]._new("columns", (parts[0].shape[0], sum(p.shape[1] for p in parts)), *parts[1:])


def trace(formula: Callable[..., Mapping[str, Expression]], **shapes: Shape) -> Program:
    """The program of a formula.

    Args:
        formula: from an expression for each argument, by name, to its results by name.
        shapes: of the arguments.
    """
    nodes: list[Node] = []
    arguments = {name: Expression(nodes, Node("input", (), shape)) for name, shape in shapes.items()}
    results = {name: result._number for name, result in formula(**arguments).items()}
    return _pruned(nodes, {name: argument._number for name, argument in arguments.items()}, results)


def _pruned(nodes: Sequence[Node], inputs: Mapping[str, int], outputs: Mapping[str, int]) -> Program:
    """Without what no result needs; arguments stay."""
    needed = set(outputs.values())
    for number in reversed(range(len(nodes))):
        if number in needed:
            needed |= set(nodes[number].of)
    kept = sorted(needed | set(inputs.values()))
    at = {old: new for new, old in enumerate(kept)}
    return Program(
        tuple(
            Node(node.operation, tuple(at[i] for i in node.of), node.shape, node.value, node.part)
            for node in (nodes[old] for old in kept)
        ),
        {name: at[number] for name, number in inputs.items()},
        {name: at[number] for name, number in outputs.items()},
    )


def solve(M: Expression, b: Expression) -> Expression:
    """M⁻¹ b by elimination without pivoting, for M whose symmetric part is positive definite."""
    tops = []
    while M.shape[0] > 1:
        pivot, row, top = M[0:1, 0:1], M[0:1, 1:], b[0:1, :]
        tops.append((pivot, row, top))
        factors = M[1:, 0:1] / pivot
        M, b = M[1:, 1:] - factors @ row, b[1:, :] - factors @ top
    z = b / M
    for pivot, row, top in reversed(tops):
        z = rows((top - row @ z) / pivot, z)
    return z


def cholesky(S: Expression) -> list[Expression]:
    """The columns of L below and on the diagonal, (n, 1), (n − 1, 1), …, with S = L Lᵀ."""
    found = []
    while True:
        column = S[:, 0:1] / S[0:1, 0:1].root()
        found.append(column)
        if S.shape[0] == 1:
            return found
        S = S[1:, 1:] - column[1:, :] @ column[1:, :].T


def solve_lower(L: Sequence[Expression], b: Expression) -> Expression:
    """L⁻¹ b, L by its columns."""
    found = []
    for column in L:
        z = b[0:1, :] / column[0:1, :]
        found.append(z)
        if b.shape[0] > 1:
            b = b[1:, :] - column[1:, :] @ z
    return rows(*found)


def solve_upper(L: Sequence[Expression], b: Expression) -> Expression:
    """L⁻ᵀ b, L by its columns."""
    n = len(L)
    z = b[n - 1 : n, :] / L[-1]
    for k in reversed(range(n - 1)):
        z = rows((b[k : k + 1, :] - L[k][1:, :].T @ z) / L[k][0:1, :], z)
    return z
