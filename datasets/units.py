"""Units in the names of columns: "y [V]", "level (cm)", and of a time "time_ms"; the wording of a p-value."""

from __future__ import annotations

import re
from fractions import Fraction

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

SECONDS = {
    "s": Fraction(1), "ms": Fraction(1, 10**3), "us": Fraction(1, 10**6), "ns": Fraction(1, 10**9),
    "min": Fraction(60), "h": Fraction(3600), "d": Fraction(86400),
}  # fmt: skip
"""Units of time that a time column may have, in seconds."""
_SPELLINGS = {
    "s": "s sec secs second seconds", "ms": "ms msec msecs millis millisecond milliseconds",
    "us": "us µs μs usec usecs micros microsecond microseconds",
    "ns": "ns nsec nsecs nanos nanosecond nanoseconds",
    "min": "min mins minute minutes", "h": "h hr hrs hour hours", "d": "d day days",
}  # fmt: skip
_UNIT_OF_TIME = {word: unit for unit, words in _SPELLINGS.items() for word in words.split()}
_WORDS = "|".join(_UNIT_OF_TIME)
_TIME_ENDING = re.compile(rf"(?:.*[\W_])?({_WORDS})", re.IGNORECASE)
_SINCE = re.compile(rf"(?:.*[\W_])?({_WORDS})[\W_]since(?:[\W_].*)?", re.IGNORECASE)
_CAPITALISED = re.compile(rf"(.*[a-z])({'|'.join(word.capitalize() for word in _UNIT_OF_TIME if len(word) > 1)})")
_TIME = re.compile(r"(t|time|timestamp|date|datetime)([^a-z].*)?", re.IGNORECASE)
# in parentheses no words, but these: counts, and what is or ends in a unit of time or begins with a number, as "10 ms"
_OF_TIME = re.compile(rf"samples?|ticks?|steps?|counts?|cycles?|index|(?:.*[\W_\d])?(?:{_WORDS})|\d.*", re.IGNORECASE)


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


def without_unit(name: str) -> str:
    """A column's name without the unit that `unit_in` finds at its end."""
    return name if unit_in(name) == NO_UNIT else re.split(r"\s*[\[(]", name)[0]


def time_unit_in(name: str) -> str:
    """The unit at the end of a time column's name, as "t [ms]", "Time (min)", "time_ms", "timeMs" or "t/h", or in
    "ms_since_start".

    One of `SECONDS`; what stands in the brackets where that is none of time, as "10 ms"; `NO_UNIT` where there is none.
    """
    unit = unit_in(name)
    if found := _SINCE.fullmatch(name):
        unit = found[1]
    if unit == NO_UNIT and (found := _PARENTHESISED.fullmatch(name)) and not _NUMBER.fullmatch(found[1]):
        unit = found[1] if _OF_TIME.fullmatch(found[1]) else NO_UNIT
    if unit == NO_UNIT and (found := _TIME_ENDING.fullmatch(name)):
        unit = found[1]
    elif unit == NO_UNIT and (found := _CAPITALISED.fullmatch(name)):
        unit = found[2]
    return _UNIT_OF_TIME.get(unit.lower(), unit)


def is_time_name(name: str) -> bool:
    """Whether a name reads as a time's, as "t", "Time [s]", "timeMs"; a temperature's, "T [°C]" or "tMin", does not."""
    unit = time_unit_in(name)
    if (found := _CAPITALISED.fullmatch(name)) and len(found[1]) > 1:
        name = found[1]
    of_another_quantity = unit not in SECONDS and _UNIT.fullmatch(unit) is not None
    return _TIME.fullmatch(name) is not None and not of_another_quantity


def has_unit(unit: str) -> bool:
    """Whether a channel's unit is one: neither left out nor `NO_UNIT`."""
    return unit not in ("", NO_UNIT)


def titled(name: str, unit: str) -> str:
    """A channel with its unit: once, and where it has one."""
    return name if not has_unit(unit) or unit_in(name) == unit else f"{name} [{unit}]"


def p_text(p: float) -> str:
    """A p-value as it is told; 0 is none."""
    return "p < 1e-16" if p < 1e-16 else f"p = {p:.2g}"
