"""Runs of a results folder as rows for the terminal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from nnss_cli.experiment.collection import Entry
from nnss_cli.experiment.comparison import Difference
from nnss_cli.experiment.estimate import is_combined
from nnss_cli.report.aggregate import scored_splits, shown_error
from nnss_cli.report.cells import Cell, whole
from nnss_cli.report.statistics import quantile
from nnss_cli.report.tables import number

MEDIAN_ERROR = "median RMSE in the record's unit, or mean of RMSE/σ over several outputs"


def group_rows(entries: Sequence[Entry]) -> list[dict[str, str]]:
    """A row for each dataset, protocol, method and order: runs with a result, what else there is, the median error.

    It is RMSE, or RMSE/σ over several outputs, on the first test set (validation where there is none); a run
    without a result counts as ∞.
    """
    groups: dict[tuple[str, str, str, int], list[Entry]] = {}
    for entry in entries:
        method, order = (entry.result.spec.method, entry.result.spec.order) if entry.result else (entry.label, 0)
        groups.setdefault((entry.store.dataset, entry.store.protocol, method, order), []).append(entry)
    rows = []
    for (dataset, protocol, method, order), own in sorted(groups.items()):
        results = [entry.result for entry in own if entry.result]
        others = Counter(entry.result.status if entry.result else "damaged" for entry in own)
        ok = others.pop("ok", 0)
        errors = [shown_error(r, scored_splits(results)[0]) if r.status == "ok" else math.inf for r in results]
        others_told = " ".join(f"{count} {name}" for name, count in others.items())
        rows.append(
            {
                "dataset": dataset, "protocol": protocol, "method": method,
                "n": whole(order) if order else Cell("–", None),
                "ok": Cell(f"{ok}/{len(own)}", {"ok": ok, "runs": len(own)}), "else": others_told or "–",
                "test": number(quantile(errors, 0.5) if errors else None, 3),
            }
        )  # fmt: skip
    return rows


def run_rows(entry: Entry) -> list[dict[str, str]]:
    """What is kept with a run: status, remarks, provenance, options."""
    result = entry.result
    if result is None:
        return [{"": "status", "found": "damaged"}, {"": "reason", "found": entry.fault}]
    rows = {
        "status": result.status, "reason": result.reason,
        "fit [s]": f"{result.fit_seconds:g}{', with its members' * is_combined(result.spec)}",
        "epochs": str(result.epochs), "data": result.spec.data, "method's version": result.spec.version,
        **result.provenance, **{name: str(value) for name, value in result.spec.settings.items()},
        "notes": " ".join(result.notes), "remarks": " ".join(result.remarks), "folder": str(entry.folder),
    }  # fmt: skip
    return [{"": name, "found": value} for name, value in rows.items() if value]


def difference_rows(differing: Sequence[Difference]) -> list[dict[str, str]]:
    """A row for each thing in which a run differs between two folders."""
    rows = []
    for one in differing:
        change = one.change
        rows.append(
            {
                "run": one.name, "what": one.what, "A": _side(one.first), "B": _side(one.second),
                "change": Cell("–" if change is None else f"{100 * change:+.2g} %", change),
            }
        )  # fmt: skip
    return rows


def _side(value: float | str | None) -> Cell:
    return Cell(value, value) if isinstance(value, str) else number(value)
