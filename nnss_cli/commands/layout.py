"""Tables as lines of a terminal: numbers are never split; what is too wide stands below and is not squeezed."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence

from rich.cells import cell_len

GAP = 2
NARROW = 16  # columns of words are not made narrower than this


def lines_of(rows: Sequence[Mapping[str, str]], heads: Mapping[str, str], text_columns: int, width: int) -> list[str]:
    """A table of so many columns of a terminal at most, where one number fits into it beside the first columns.

    Cells of words are wrapped. What is still too wide is cut between columns: the others stand in a further table, with
    the first columns repeated.

    Args:
        rows: cells by name; all rows have the same names.
        heads: name → header, where it is another one; a second line of it is a unit, left out where it asks for
            more room than there is.
        text_columns: columns that say what a row is, to the left; the others are to the right, unless they are words.
        width: of the terminal.
    """
    names = list(rows[0])
    titles = {name: heads.get(name, name).split("\n") for name in names}
    if _total(_widest(rows, titles, names), names) > width:
        bare = _widest(rows, {name: lines[:1] for name, lines in titles.items()}, names)
        titles = {
            name: [line for line in lines if line == lines[0] or cell_len(line) <= bare[name]]
            for name, lines in titles.items()
        }
    widest, least = _widest(rows, titles, names), _least(rows, titles, names, text_columns, width)
    keys = names[:text_columns]
    if any(_total(least, [*keys, name]) > width for name in names[text_columns:]):
        keys = names[:1]
    blocks = [[*keys]]
    for name in names[len(keys) :]:
        if len(blocks[-1]) > len(keys) and _total(least, [*blocks[-1], name]) > width:
            blocks.append([*keys])
        blocks[-1].append(name)
    lines: list[str] = []
    for block in blocks:
        left = set(names[:text_columns]) | {name for name in block if _words(rows, name)}
        lines += [""] * bool(lines) + _block(rows, titles, block, left, _widths(widest, least, block, width))
    return lines


def _block(
    rows: Sequence[Mapping[str, str]], titles: Mapping[str, list[str]], names: Sequence[str], left: set[str],
    widths: Mapping[str, int],
) -> list[str]:  # fmt: skip
    def line(cells: Mapping[str, str]) -> str:
        parts = []
        for name in names:
            space = " " * (widths[name] - cell_len(cells[name]))
            parts.append(cells[name] + space if name in left else space + cells[name])
        return (" " * GAP).join(parts).rstrip()

    high = max(len(titles[name]) for name in names)
    header = [line({name: (titles[name] + [""] * high)[i] for name in names}) for i in range(high)]
    body = []
    for row in rows:
        cells = {name: textwrap.wrap(row[name], widths[name], break_on_hyphens=False) or [""] for name in names}
        body += [
            line({name: part[i] if i < len(part) else "" for name, part in cells.items()})
            for i in range(max(map(len, cells.values())))
        ]
    return [*header, "─" * _total(widths, names), *body]


def _words(rows: Sequence[Mapping[str, str]], name: str) -> bool:
    return any(" " in row[name] for row in rows)


def _widest(rows: Sequence[Mapping[str, str]], titles: Mapping[str, list[str]], names: Sequence[str]) -> dict[str, int]:
    return {name: max(map(cell_len, [*titles[name], *(row[name] for row in rows)])) for name in names}


def _least(
    rows: Sequence[Mapping[str, str]], titles: Mapping[str, list[str]], names: Sequence[str], text_columns: int,
    width: int,
) -> dict[str, int]:  # fmt: skip
    """As narrow as each column can be: cells of words down to their longest word, all others as they are."""
    least = _widest(rows, titles, names)
    for index, name in enumerate(names):
        if _words(rows, name) and (index >= text_columns or least[name] > width // 3):  # a short name is not broken
            words = [word for row in rows for word in row[name].split()]
            longest = max(map(cell_len, [*titles[name], *words]), default=0)
            least[name] = min(least[name], max(longest, NARROW if index >= text_columns else 0))
    return least


def _widths(widest: Mapping[str, int], least: Mapping[str, int], names: Sequence[str], width: int) -> dict[str, int]:
    """Widths that fill the terminal at most: what is missing is taken from the widest column that can give it."""
    found = {name: widest[name] for name in names}
    over = _total(found, names) - width
    while over > 0 and (giving := [name for name in names if found[name] > least[name]]):
        name = max(giving, key=lambda name: found[name])
        given = min(over, found[name] - least[name])
        found[name] -= given
        over -= given
    return found


def _total(widths: Mapping[str, int], names: Sequence[str]) -> int:
    return sum(widths[name] for name in names) + GAP * (len(names) - 1)
