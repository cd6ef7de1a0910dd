"""Where the numbers of a folder came from, and how to have them again: what its runs keep of it."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from nnss_cli.experiment.estimate import is_combined
from nnss_cli.experiment.run import RunResult
from nnss_cli.report.aggregate import groups, methods_of, runs_by_method
from nnss_cli.report.statistics import quantile
from nnss_cli.report.tables import number

OF_A_RUN = ("command", "started", "finished", "seconds", "peak memory [MB]")
"""What every run has a value of its own for."""


OUT = re.compile(r"--out[= ]('[^']*'|\S+)")
"""The results folder of a command line, quoted as it is there."""


@dataclass(frozen=True)
class Origin:
    """What is known of how a folder's runs were made."""

    facts: list[dict[str, str]]
    """Code, libraries, machine, data: a row for each value, with the number of runs that have it."""
    costs: list[dict[str, str]]
    """Time and memory by method and order."""
    settings: list[dict[str, str]]
    """Options of each method, with the orders that have them."""
    commands: list[str]
    """Command lines that made runs of this folder, as they were kept, and the one that makes the page anew."""
    commits: list[str]
    """Commits that made them."""
    dirty: bool
    """Whether one of them had files that were changed since."""


def origin_of(results: Sequence[RunResult]) -> Origin:
    """What the runs tell."""
    commits = list(dict.fromkeys(r.provenance["commit"] for r in results if r.provenance.get("commit")))
    return Origin(
        _facts(results), _costs(results), _settings(results),
        _commands(results),
        commits, any(commit.endswith("-dirty") for commit in commits),
    )  # fmt: skip


def _commands(results: Sequence[RunResult]) -> list[str]:
    made = list(dict.fromkeys(r.provenance["command"] for r in results if r.provenance.get("command")))
    if not made:
        return []
    folders = {folder for line in made for folder in OUT.findall(line)} or {"results"}
    again = "nnss report --html"
    return [
        *made,
        again if folders == {"results"} else f"{again} --out {folders.pop()}" if len(folders) == 1 else again,
    ]


def _facts(results: Sequence[RunResult]) -> list[dict[str, str]]:
    names = dict.fromkeys(name for r in results for name in r.provenance if name not in OF_A_RUN)
    counted = {name: Counter(r.provenance.get(name, "not known") for r in results) for name in names}
    counted["data, fingerprint"] = Counter(r.spec.data for r in results)
    rows = [
        {"what": name, "found": value, "runs": str(count)}
        for name, values in counted.items()
        for value, count in values.items()
    ]
    for name, pick in (("first run started", min), ("last run finished", max)):
        times = [r.provenance[name.split()[-1]] for r in results if name.split()[-1] in r.provenance]
        if times:
            rows.append({"what": name, "found": pick(times), "runs": str(len(times))})
    return rows


def _costs(results: Sequence[RunResult]) -> list[dict[str, str]]:
    rows = []
    for method, order, own in groups(results):
        seconds = [r.fit_seconds for r in own]
        memory = [float(text) for r in own if _is_number(text := r.provenance.get("peak memory [MB]", ""))]
        rows.append(
            {
                "order": str(order), "method": method + ", with its members" * any(is_combined(r.spec) for r in own),
                "runs": str(len(own)),
                "fit, median [s]": number(quantile(seconds, 0.5), 3), "longest [s]": number(max(seconds), 3),
                "together [s]": number(sum(seconds), 4),
                "epochs, median": number(quantile([float(r.epochs) for r in own], 0.5)),
                "peak memory, largest [MB]": number(max(memory)) if memory else "–",
            }
        )  # fmt: skip
    return rows


def _settings(results: Sequence[RunResult]) -> list[dict[str, str]]:
    """A row for each method, option and value, with the orders that have it."""
    orders: dict[tuple[str, str, str], list[int]] = {}
    for (method, order), own in runs_by_method(results).items():
        for name, value in own[0].spec.settings.items():
            orders.setdefault((method, name, json.dumps(value, ensure_ascii=False)), []).append(order)
    position = methods_of(results)
    return [
        {"method": method, "option": name, "value": value, "orders": ", ".join(map(str, own))}
        for (method, name, value), own in sorted(orders.items(), key=lambda one: position.index(one[0][0]))
    ]


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
