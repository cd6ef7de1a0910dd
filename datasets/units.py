"""Units in the names of columns: "y [V]", "level (cm)"."""

from __future__ import annotations

import re

NO_UNIT = "–"
"""Where none is stated."""

_BRACKETED = re.compile(r"[^\[\]]*\S\s*\[\s*([^\[\]]{1,20}?)\s*\]")
_PARENTHESISED = re.compile(r"[^()]*\S\s*\(\s*([^()]{1,20}?)\s*\)")
_SYMBOL = (
    r"(?:[yzafpnuµμmcdhkMGTPE]|da)?(?:m|s|g|A|K|V|W|N|J|Pa|bar|Hz|Ω|ohm|Ohm|rad|l|L|mol|Wh|VA|T|F|H|C|lm|lx|cd|eV)"
    r"|%|‰|°|°C|°F|degC|degF|deg|min|h|d|rpm|ppm|pH|psi|ft|gal|t"
)
# symbols with whole powers, joined by a product or a quotient: m/s², kg·m^2, N m
_UNIT = re.compile(rf"(?:1/)?(?:{_SYMBOL})(?:\^?-?\d|[²³])?(?:\s*[*·/ ]\s*(?:{_SYMBOL})(?:\^?-?\d|[²³])?)*")
_NUMBER = re.compile(r"[\d.,+-]+")


def unit_in(name: str) -> str:
    """The unit at the end of a column's name; `NO_UNIT` where there is none.

    Whatever stands in brackets is one unless it is a number, as in "y [1]"; in parentheses only what reads as a unit,
    since "tank (left)" has none.
    """
    if (found := _BRACKETED.fullmatch(name)) and not _NUMBER.fullmatch(found[1]):
        return found[1]
    if (found := _PARENTHESISED.fullmatch(name)) and _UNIT.fullmatch(found[1]):
        return found[1]
    return NO_UNIT


def titled(name: str, unit: str) -> str:
    """A channel with its unit: once, and where it has one."""
    return name if unit in ("", NO_UNIT) or unit_in(name) == unit else f"{name} [{unit}]"
