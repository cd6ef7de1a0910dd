"""Programs as source text of languages that have matrices: Python with NumPy, and MATLAB or Octave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from nnss_cli.elementary import Array, Node, Program

Template = Callable[..., str]


def _python_part(node: Node, a: str) -> str:
    i, j, k, l = node.part  # noqa: E741
    return f"{a}[{i}:{j}, {k}:{l}]"


def _matlab_part(node: Node, a: str) -> str:
    i, j, k, l = node.part  # noqa: E741
    return f"{a}({i + 1}:{j}, {k + 1}:{l})"


PYTHON: dict[str, Template] = {
    "add": lambda _, a, b: f"{a} + {b}",
    "subtract": lambda _, a, b: f"{a} - {b}",
    "multiply": lambda _, a, b: f"{a} * {b}",
    "divide": lambda _, a, b: f"{a} / {b}",
    "less": lambda _, a, b: f"({a} < {b}) * 1.0",
    "product": lambda _, a, b: f"{a} @ {b}",
    "transpose": lambda _, a: f"{a}.T",
    "reshape": lambda node, a: f"{a}.reshape{node.shape}",
    "part": _python_part,
    "rows": lambda _, *parts: f"np.vstack([{', '.join(parts)}])",
    "columns": lambda _, *parts: f"np.hstack([{', '.join(parts)}])",
    "sum": lambda _, a: f"{a}.sum(keepdims=True)",
    "root": lambda _, a: f"np.sqrt({a})",
    "sigmoid": lambda _, a: f"1.0 / (1.0 + np.exp(-{a}))",
}
MATLAB: dict[str, Template] = PYTHON | {
    "multiply": lambda _, a, b: f"{a} .* {b}",
    "divide": lambda _, a, b: f"{a} ./ {b}",
    "product": lambda _, a, b: f"{a} * {b}",
    "transpose": lambda _, a: f"{a}.'",
    # its arrays lie column by column
    "reshape": lambda node, a: f"reshape({a}.', {node.shape[1]}, {node.shape[0]}).'",
    "part": _matlab_part,
    "rows": lambda _, *parts: f"[{'; '.join(parts)}]",
    "columns": lambda _, *parts: f"[{', '.join(parts)}]",
    "sum": lambda _, a: f"sum({a}(:))",
    "root": lambda _, a: f"sqrt({a})",
    "sigmoid": lambda _, a: f"1 ./ (1 + exp(-{a}))",
}


class Constants:
    """Arrays that programs use, each under one name."""

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.arrays: dict[str, Array] = {}
        self._names: dict[tuple[Any, bytes], str] = {}

    def name(self, value: Array) -> str:
        """Of an array, the same for equal ones."""
        key = (value.shape, value.tobytes())
        if key not in self._names:
            self._names[key] = f"c{len(self._names)}"
            self.arrays[self._names[key]] = value
        return self.prefix + self._names[key]


def statements(
    program: Program, language: Mapping[str, Template], constants: Constants, end: str
) -> tuple[list[str], dict[str, str]]:
    """A line for each operation, and the variable of each result.

    Arguments have the names of the program's; all are matrices, vectors are columns.
    """
    lines: list[str] = []

    def line(template: Template) -> Template:
        def written(node: Node, *of: str) -> str:
            name = f"v{len(lines)}"
            lines.append(f"{name} = {template(node, *of)}{end}")
            return name

        return written

    results = program.run(
        {name: name for name in program.inputs},
        {name: line(template) for name, template in language.items()},
        lambda number, value: repr(float(value[0, 0])) if program.is_plain_number(number) else constants.name(value),
    )
    return lines, results
