"""Cells of tables: text for people, and the value behind it for machines."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any


class Cell(str):
    """A value as a table shows it, which still knows it in full.

    A mapping as `value` stands for several columns, such as the quartiles behind "0.1–0.3".
    """

    value: Any

    def __new__(cls, text: str, value: Any) -> Cell:
        """The text that is shown, and what it stands for."""
        cell = super().__new__(cls, text)
        cell.value = value
        return cell


class Markup(str):
    """Text that is Markdown already."""


_MARKUP = re.compile(r"\\(?=[!-/:-@\[-`{-~])|[`*|$~]|(?<!\w)_+|_+(?!\w)|\](?=[(\[:])|<(?=[A-Za-z/!?])|&(?=#?\w+;)")
"""What Markdown (of GitHub) would take for markup where it stands: an underscore within a word it does not."""


def escaped(text: str) -> str:
    """A text that is the user's, for a page in Markdown: shown as it is, and as it is written where that will do."""
    return _MARKUP.sub(lambda found: "".join(f"\\{letter}" for letter in found[0]), text)


def whole(value: int) -> Cell:
    """A whole number."""
    return Cell(str(value), int(value))


def plain(rows: Sequence[Mapping[str, str]]) -> list[dict[str, Any]]:
    """Rows for machines: numbers in full precision, None for "–"."""
    found = []
    for row in rows:
        values: dict[str, Any] = {}
        for name, cell in row.items():
            value = cell.value if isinstance(cell, Cell) else None if cell == "–" else str(cell)
            values |= value if isinstance(value, dict) else {name: value}
        found.append(values)
    return found
