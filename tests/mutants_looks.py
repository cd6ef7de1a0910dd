"""Which faults change a figure's looks alone, so that no claim of the project is broken by them.

A rule, not a judgement of single mutants: the changed place lies in an argument of a drawing function that sets a size,
a thickness, a place of a text or a dash, in an entry of a dictionary by the name of such an argument, or in a table of
such numbers. What is drawn (data, scales, limits, ticks,
labels, legends, colours by name, order) is never within it.
"""

from __future__ import annotations

import ast

DRAWING = ("import matplotlib", "class MethodStyle")
"""Only files with one of these have looks: those that draw, and the one that says how."""
ARGUMENTS = {
    "alpha", "bbox_to_anchor", "borderaxespad", "figsize", "font.size", "fontsize", "h_pad", "handlelength",
    "height_ratios", "labelsize", "linestyle", "linewidth", "linewidths", "markersize", "numticks", "rotation", "w_pad",
    "width_ratios", "widths", "zorder",
}  # fmt: skip
"""Of calls of matplotlib, and of dictionaries that are handed to them."""
TABLES = {"STYLE", "STYLES", "MORE", "LOOKS", "heights", "medianprops", "flierprops"}
"""Names that hold looks: rc settings, dashes by method, heights of panels, and arguments that are dictionaries."""

Place = tuple[tuple[int, int], tuple[int, int]]


def places_of_looks(source: str) -> list[Place]:
    """Start and end, each (line from 1, column from 0), of what sets looks alone; [] in a file that draws nothing."""
    if not any(line in source for line in DRAWING):
        return []
    found = []
    for node in ast.walk(ast.parse(source)):
        values: list[ast.expr | None] = []
        if isinstance(node, ast.keyword):
            margins = node.arg == "x" and isinstance(node.value, ast.Constant)
            values = [node.value] if margins or node.arg in ARGUMENTS | TABLES else []
        elif isinstance(node, ast.Dict):
            pairs = zip(node.keys, node.values, strict=True)
            values = [value for key, value in pairs if isinstance(key, ast.Constant) and key.value in ARGUMENTS]
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            values = [node.value] if {t.id for t in targets if isinstance(t, ast.Name)} & TABLES else []
        for value in filter(None, values):
            # ast counts columns in bytes, Cosmic Ray in characters
            start, end = (value.lineno, value.col_offset), (value.end_lineno, value.end_col_offset)
            found.append((_at(source, *start), _at(source, *end)))
    return found


def _at(source: str, line: int | None, column: int | None) -> tuple[int, int]:
    assert line is not None
    assert column is not None
    text = source.splitlines()[line - 1].encode()
    return line, len(text[:column].decode())


def sets_looks(place: Place, looks: list[Place]) -> bool:
    """Whether a place lies in one of these."""
    return any(start <= place[0] and place[1] <= end for start, end in looks)
