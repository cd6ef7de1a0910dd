"""Which runs may stand in one table: of the same data; of a method and order, also of the same versions and options."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from nnss_cli.experiment.run import RunResult, RunSpec
from nnss_cli.experiment.store import Found, Store
from nnss_cli.version import __version__

OTHER_DATA = "another version of the data (samples, scaling, names or units)"
SAME_NUMBERS = ("threads",)
"""Options that change no number, to the last bit."""


def telling(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that tell runs apart."""
    return {name: value for name, value in settings.items() if name not in SAME_NUMBERS}


@dataclass(frozen=True)
class Table:
    """The runs of a folder that go together."""

    results: list[RunResult]
    """In a fixed order."""
    left_out: list[str]
    """A line for each run that is damaged, and for each group that does not go with the others."""


def difference(spec: RunSpec, result: RunResult) -> str:
    """Why a finished run must not be mixed with `spec` in one table ("" where it may)."""
    other = result.spec
    if other.data != spec.data:
        return OTHER_DATA
    if (other.method, other.order) != (spec.method, spec.order):
        return ""
    made = result.provenance.get("nnss", "unknown")
    if made != __version__:
        return f"nnss {made} instead of {__version__}"
    if other.version != spec.version:
        return f"version {other.version or 'unknown'} of the method instead of {spec.version}"
    return _differing(other, spec)


def conflict(spec: RunSpec, results: Iterable[RunResult]) -> str:
    """Which finished runs must not be mixed with `spec`, and how they differ ("" if there are none)."""
    for result in results:
        found = difference(spec, result)
        if found:
            return f"{result.spec.method}, order {result.spec.order}, with {found}"
    return ""


def unlike(spec: RunSpec, results: Iterable[RunResult]) -> str:
    """How runs differ from `spec` such that no table may hold both, whoever made them ("" where they do not)."""
    for result in results:
        other = result.spec
        if other.data != spec.data:
            return OTHER_DATA
        if (other.method, other.order) == (spec.method, spec.order):
            if other.version != spec.version:
                return f"version {other.version or 'unknown'} of {spec.method} instead of {spec.version or 'unknown'}"
            if _text(other.settings) != _text(spec.settings):
                return f"other options of {spec.method}: {_differing(other, spec)}"
    return ""


def agreeing(store: Store, found: Found, apart: Mapping[str, str] | None = None) -> Table:
    """What of a folder makes one table.

    Runs of other data than most are left out, then, in each method and order, those of another version of the method or
    with other options than most. Of groups of one size the one that was finished last stays. Other versions
    of nnss and its libraries are no reason: a table says which made it.

    Args:
        store: where the runs are.
        found: what there is of them.
        apart: runs that do not go with what was asked for, by label, and why.
    """
    faults = found.faults | dict(apart or {})
    results = [result for result in found.results if result.spec.label not in faults]
    kept, others = _largest(results, lambda result: result.spec.data)
    lines = _lines(store, others, f"{OTHER_DATA} than most runs there")
    groups: dict[tuple[str, int], list[RunResult]] = {}
    for result in kept:
        groups.setdefault((result.spec.method, result.spec.order), []).append(result)
    together: list[RunResult] = []
    for group in groups.values():
        kept, others = _largest(group, lambda result: (result.spec.version, _text(result.spec.settings)))
        together += kept
        lines += _lines(store, others, "another version or other options than most runs of it there")
    return Table(together, [*faults.values(), *lines])


def _largest(
    results: Sequence[RunResult], key: Callable[[RunResult], object]
) -> tuple[list[RunResult], list[RunResult]]:
    """The largest group of the same key, and the others."""
    groups: dict[object, list[RunResult]] = {}
    for result in results:
        groups.setdefault(key(result), []).append(result)
    if not groups:
        return [], []
    largest = max(groups.values(), key=lambda own: (len(own), max(r.provenance.get("finished", "") for r in own)))
    chosen = {id(result) for result in largest}
    return largest, [result for result in results if id(result) not in chosen]


def _lines(store: Store, others: Sequence[RunResult], why: str) -> list[str]:
    seeds: dict[tuple[str, int], list[str]] = {}
    for result in others:
        seeds.setdefault((result.spec.method, result.spec.order), []).append(str(result.spec.seed))
    return [
        f"'{store.folder}': {method}, order {order}, seed {', '.join(own)}: {why}; remove them with 'nnss results rm', "
        "or run them again with --force"
        for (method, order), own in seeds.items()
    ]


def _differing(other: RunSpec, spec: RunSpec) -> str:
    return ", ".join(
        f"{name} {_value(other.settings, name)} instead of {_value(spec.settings, name)}"
        for name in telling(spec.settings | other.settings)
        if _value(other.settings, name) != _value(spec.settings, name)
    )


def _text(settings: dict[str, Any]) -> str:
    return json.dumps(telling(settings), sort_keys=True)  # tuples and lists are one there


def _value(settings: dict[str, Any], name: str) -> Any:
    value = settings.get(name)
    return list(value) if isinstance(value, tuple) else value
