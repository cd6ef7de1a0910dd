"""The place of our errors among published ones, those of the paper and of the official benchmarks, as Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeAlias

from nnss_cli.experiment.run import RunResult
from nnss_cli.report.aggregate import (
    MEAN,
    methods_of,
    output_error,
    paper_table,
    physical_error,
    published_table,
    released_table,
    runs_by_method,
    scored_splits,
    several_outputs,
    split_name,
    test_sets,
    validation_error,
)
from nnss_cli.report.cells import Markup, escaped
from nnss_cli.report.statistics import median_interval, quantile, quartile_interval
from nnss_cli.report.tables import markdown, number, output_names, span

OTHERWISE = {
    "arXiv 2405.10779, table of baselines": (
        "trained on half of the training data (700 of 1024 samples of the tanks), and scored on other windows (993 to "
        "1021 of 1024 samples of the tanks, 69 to 99 of 100 of the drives)"
    ),
    "arXiv 2405.10779, table of published results": "as each paper split and scored the record",
}
"""Source → how its protocol differs from protocol official."""


PAPERS = {
    "the paper's table": (
        "the best of ten seeds, chosen on test; for the power plant with means and deviations over all rows, for the "
        "two-tank with a validation record inside the test record"
    ),
    "models that the authors released": (
        "scored here as ours are: the median of their ten seeds, with ± 1.57 (q3 − q1)/√n as its interval"
    ),
}
"""Source → how its figure came about."""


Tables: TypeAlias = list[tuple[str, list[dict[str, str]]]]
"""Title and rows of each table."""


def paper_places(results: Sequence[RunResult]) -> str:
    """`place_tables` as Markdown ("" where there are none)."""
    return _in_markdown(*place_tables(results))


def place_tables(results: Sequence[RunResult]) -> tuple[Tables, list[str]]:
    """The paper's printed errors, those of the released models and ours, by place: a table for each order and output.

    Ours are medians over seeds of every method and recipe that ran, on the test record (validation where the files
    hold none). None under another protocol than the paper's, and where neither printed nor released errors are known.

    Returns:
        The tables, and the notes that the sources of their rows refer to.
    """
    first = results[0].spec
    if first.protocol != "paper":
        return [], []
    split = scored_splits(results)[0]
    several = several_outputs(results)
    printed, released = (table[(table["dataset"] == first.dataset) & (table["split"] == split)] for table in (
        paper_table(), released_table()
    ))  # fmt: skip
    notes = {source: note for note, source in enumerate(PAPERS, 1)}
    printed_note, released_note = (f"[{note}]" for note in notes.values())
    names = output_names(results[0])
    tables = []
    for order in sorted({r.spec.order for r in results}):
        for output in [*names, MEAN] if several else list(names):
            rows = [
                (row.rmse, {"method": row.method, "RMSE": number(row.rmse), "interval": "", "source": printed_note})
                for row in printed[(printed["order"] == order) & (printed["output"] == output)].itertuples()
            ]
            if output == (MEAN if several else "y1"):
                for row in released[released["order"] == order].itertuples():
                    low, high = quartile_interval(row.median, row.q1, row.q3, row.seeds)
                    cells = {
                        "method": row.method,
                        "RMSE": number(row.median),
                        "interval": span(low, high, ("low", "high")),
                    }
                    rows.append((row.median, cells | {"source": released_note}))
            own = {m: runs for (m, n), runs in runs_by_method(results).items() if n == order}
            if not rows:
                continue
            for method in methods_of(results):
                if method in own:
                    rows.append(_ours(method, [output_error(run, split, output) for run in own[method]]))
            what = "mean over outputs" if output == MEAN else names[output]
            tables.append((f"Order {order}, {what}, {split_name(split)}", _by_place(rows)))
    return tables, [f"[{note}] {source}: {PAPERS[source]}" for source, note in notes.items()]


def _ours(name: str, errors: Sequence[float]) -> tuple[float, dict[str, str]]:
    """Our median with its interval over seeds, a run without a result as ∞; and what it is sorted by."""
    median, bounds = quantile(errors, 0.5), median_interval(errors)
    interval = span(bounds.low, bounds.high, ("low", "high")) if bounds.coverage else "–"
    ok = sum(map(math.isfinite, errors))
    row = {"method": name, "RMSE": number(median), "interval": interval, "source": f"{ok}/{len(errors)} runs"}
    return median, row


def _by_place(rows: Sequence[tuple[float, dict[str, str]]]) -> list[dict[str, str]]:
    ordered = sorted(rows, key=lambda row: row[0])
    return [{"place": str(place), **row} for place, (_, row) in enumerate(ordered, 1)]


def published_comparison(results: Sequence[RunResult]) -> str:
    """`published_tables` as Markdown ("" where there are none)."""
    return _in_markdown(*published_tables(results))


def _in_markdown(tables: Tables, notes: Sequence[str]) -> str:
    parts = [f"{escaped(title)}:\n\n{markdown(_ours_in_bold(rows))}" for title, rows in tables]
    return "\n\n".join([*parts, "  \n".join(notes)]) if parts else ""


def published_tables(results: Sequence[RunResult]) -> tuple[Tables, list[str]]:
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
            rows.append(_ours(f"{method}, order {order}", [physical_error(run, split) for run in own]))
        tables.append((f"{split_name(split).capitalize()}, {unit.iloc[0]}", _by_place(rows)))
    notes = [
        f"[{note}] {source}" + (f": {OTHERWISE[source]}" if source in OTHERWISE else "")
        for source, note in sources.items()
    ]
    return tables, notes


def _ours_in_bold(rows: Sequence[dict[str, str]]) -> list[dict[str, str]]:
    return [
        row if row["source"].startswith("[") else row | {"method": Markup(f"**{escaped(row['method'])}**")}
        for row in rows
    ]


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
