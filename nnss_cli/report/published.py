"""Our errors on an official benchmark among the published ones, as Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence

from nnss_cli.experiment.run import RunResult
from nnss_cli.report.aggregate import (
    methods_of,
    physical_error,
    published_table,
    runs_by_method,
    split_name,
    test_sets,
    validation_error,
)
from nnss_cli.report.statistics import median_interval, quantile
from nnss_cli.report.tables import markdown, number

OTHERWISE = {
    "arXiv 2405.10779, table of baselines": (
        "trained on half of the training data (700 of 1024 samples of the tanks), and scored on other windows (993 to "
        "1021 of 1024 samples of the tanks, 69 to 99 of 100 of the drives)"
    ),
    "arXiv 2405.10779, table of published results": "as each paper split and scored the record",
}
"""Source → how its protocol differs from protocol official."""


def published_comparison(results: Sequence[RunResult]) -> str:
    """`published_tables` as Markdown ("" where there are none)."""
    tables, notes = published_tables(results)
    parts = [f"{title}:\n\n{markdown(_ours_in_bold(rows))}" for title, rows in tables]
    return "\n\n".join([*parts, "  \n".join(notes)]) if parts else ""


def published_tables(results: Sequence[RunResult]) -> tuple[list[tuple[str, list[dict[str, str]]]], list[str]]:
    """A table for each test set: the published errors, and each of our methods at the order that validates best.

    Ours are medians over seeds with their intervals; a run without a result counts as ∞. None where nothing is
    published for the dataset, or the protocol is not the official one.

    Returns:
        Title and rows of each table, and the notes that the sources of the rows refer to.
    """
    first = results[0].spec
    known = published_table()
    known = known[known["dataset"] == first.dataset]
    if known.empty or first.protocol != "official":
        return [], []
    orders = _orders(results)
    sources: dict[str, int] = {}
    tables = []
    for split in test_sets(results):
        rows = []
        for row in known[known["test_set"] == split].itertuples():
            note = sources.setdefault(row.source, len(sources) + 1)
            rows.append(
                (row.rmse, {"method": row.method, "RMSE": number(row.rmse), "interval": "", "source": f"[{note}]"})
            )
        unit = known.loc[known["test_set"] == split, "unit"]
        if not rows:
            continue
        for method, (order, own) in orders.items():
            errors = [physical_error(run, split) for run in own]
            median, bounds = quantile(errors, 0.5), median_interval(errors)
            interval = f"{number(bounds.low)}–{number(bounds.high)}" if bounds.coverage else "–"
            ok = sum(map(math.isfinite, errors))
            name = f"{method}, order {order}"
            rows.append(
                (
                    median,
                    {"method": name, "RMSE": number(median), "interval": interval, "source": f"{ok}/{len(own)} runs"},
                )
            )
        rows.sort(key=lambda row: row[0])
        table = [{"place": str(place), **row} for place, (_, row) in enumerate(rows, 1)]
        tables.append((f"{split_name(split).capitalize()}, {unit.iloc[0]}", table))
    notes = [
        f"[{note}] {source}" + (f": {OTHERWISE[source]}" if source in OTHERWISE else "")
        for source, note in sources.items()
    ]
    return tables, notes


def _ours_in_bold(rows: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    return [row if row["source"].startswith("[") else row | {"method": f"**{row['method']}**"} for row in rows]


def _orders(results: Sequence[RunResult]) -> dict[str, tuple[int, list[RunResult]]]:
    """Each method's order whose median validation error is lowest, and its runs."""
    found: dict[str, tuple[int, list[RunResult]]] = {}
    runs = runs_by_method(results)
    for method in methods_of(results):
        errors = {
            order: quantile([validation_error(run) for run in own], 0.5)
            for (name, order), own in runs.items()
            if name == method
        }
        order = min(errors, key=lambda order: (errors[order], order))
        if math.isfinite(errors[order]):
            found[method] = order, runs[(method, order)]
    return found
