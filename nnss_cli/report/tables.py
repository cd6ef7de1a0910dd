"""Tables as Markdown, and the rows for the terminal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
import pandas as pd
from tabulate import tabulate

from nnss_cli.datasets.record import FITTED_ON
from nnss_cli.experiment.ablation import Variant
from nnss_cli.experiment.order import OrderRow
from nnss_cli.experiment.provenance import MADE_ON, MADE_WITH
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.tune import Trial
from nnss_cli.report.aggregate import (
    NORMALISED,
    is_combination,
    methods_of,
    runs_by_method,
    scored_splits,
    several_outputs,
    shown_error,
    split_name,
    splits_of,
    summary,
    test_sets,
)
from nnss_cli.report.statistics import median_interval, quantile


def number(value: float | None, digits: int = 4) -> str:
    """A few significant digits, without an exponent from 0.0001 to a million; "–" for nothing, "∞" for a failure."""
    if value is None or pd.isna(value):
        return "–"
    if math.isinf(value):
        return "∞"
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return f"{value:.{digits}g}"
    return np.format_float_positional(value, precision=digits, fractional=False, trim="-")


def failures(results: Sequence[RunResult]) -> list[str]:
    """One line for each run that is not ok."""
    return [
        f"{r.spec.method}, order {r.spec.order}, seed {r.spec.seed}: {r.status}: {r.reason}"
        for r in results
        if r.status != "ok"
    ]


def remarks(results: Sequence[RunResult]) -> list[str]:
    """What the fits have to tell, one line for each method, order and remark, with the seeds that it holds for."""
    lines = []
    for (method, order), own in runs_by_method(results).items():
        for remark in dict.fromkeys(remark for r in own for remark in r.remarks):
            seeds = [str(r.spec.seed) for r in own if remark in r.remarks]
            whose = f"seed{'s' * (len(seeds) > 1)} {', '.join(seeds)}" if len(own) > 1 else ""
            lines.append(", ".join(filter(None, (method, f"order {order}", whose))) + f": {remark}")
    return lines


def versions_apart(results: Sequence[RunResult]) -> list[str]:
    """A line for each library that is not the same in all runs, for the machine and for the data."""
    lines = []
    if len({r.spec.data for r in results}) > 1:
        apart = Counter(
            f"{r.spec.method}, order {r.spec.order}" for r in results if r.spec.data != results[0].spec.data
        )
        lines.append(
            f"Made with different versions of the data, so not to be compared with the others: {'; '.join(apart)}."
        )
    for name in (*MADE_WITH, *MADE_ON):
        counts = Counter(r.provenance.get(name, "unknown") for r in results)
        if len(counts) > 1:
            found = ", ".join(f"{version} ({count} runs)" for version, count in sorted(counts.items()))
            where = "on different machines, by" if name in MADE_ON else "with different versions of"
            lines.append(f"Made {where} {name}: {found}.")
    return lines


def rmse_markdown(results: Sequence[RunResult], left_out: Sequence[str] = ()) -> str:
    """The summary over seeds, one table a split, the runs that failed, and those that were left out."""
    first = results[0].spec
    parts = [f"# RMSE of {first.dataset}, protocol `{first.protocol}`", _explanation(results)]
    table = summary(results)
    names = methods_of(results)
    for split in splits_of(results):
        body = rows_of_split(table, split, [name for name in names if not is_combination(name)])
        if body:
            parts.append(f"## {split_name(split).capitalize()}\n\n" + markdown(body))
        apart = rows_of_split(table, split, [name for name in names if is_combination(name)])
        if apart:
            parts.append("Made of runs above, so no independent competitor:\n\n" + markdown(apart))
    for title, lines in (
        ("Runs without a result", failures(results)), ("Left out", left_out), ("Remarks of the fits", remarks(results)),
    ):  # fmt: skip
        if lines:
            parts.append(f"## {title}\n\n" + "\n".join(f"- {line}" for line in lines))
    return "\n\n".join(parts) + "\n"


def rows_of_split(table: pd.DataFrame, split: str, methods: list[str]) -> list[dict[str, str]]:
    """The summary's rows of these methods for one split, as text, by order, method and output."""
    if table.empty:
        return []
    rows = table[(table["split"] == split) & table["method"].isin(methods)]
    return [
        {
            "order": str(row.order), "method": str(row.method), "output": str(row.output),
            "runs": f"{row.ok}/{row.runs}", "mean": number(row.mean), "median": number(row.median),
            "best by validation": f"{number(row.best)} (seed {row.best_seed})" if row.runs > 1 else number(row.best),
            "spread (q1–q3)": f"{number(row.q1)}–{number(row.q3)}" if row.runs > 1 else "–",
            "min–max": f"{number(row.min)}–{number(row.max)}" if row.runs > 1 else "–",
        }
        for row in rows.assign(position=lambda t: t["method"].map(methods.index))
        .sort_values(["order", "position", "output"])
        .itertuples()
    ]  # fmt: skip


def terminal_title(results: Sequence[RunResult]) -> str:
    """What the terminal's table shows."""
    first = results[0].spec
    what = "mean over outputs of RMSE/σ" if several_outputs(results) else "RMSE"
    return (
        f"{first.dataset}, protocol {first.protocol}: {what}, median over seeds; q1–q3 and best "
        f"(the seed chosen on validation): {split_name(scored_splits(results)[0])}"
    )


def terminal_rows(results: Sequence[RunResult], apart: bool = False) -> list[dict[str, str]]:
    """A short table: medians of all splits, quartiles and the best run on the split that figures show.

    Args:
        results: the runs.
        apart: show the methods that are made of others' runs, instead of the independent ones.
    """
    table = summary(results)
    shown_split, *_ = scored_splits(results)
    splits = dict.fromkeys([*FITTED_ON, *(test_sets(results) or ["test"])])
    output = NORMALISED if several_outputs(results) else "y1"
    position = methods_of(results)
    rows = []
    runs = runs_by_method(results)
    for method, order in sorted(runs, key=lambda key: (key[1], position.index(key[0]))):
        if is_combination(method) != apart:
            continue
        own = runs[method, order]
        ok = sum(r.status == "ok" for r in own)
        row = {"order": str(order), "method": method, "runs": f"{ok}/{len(own)}"}
        cells = {} if table.empty else _cells(table, method, order, output)
        for split in splits:
            row[split] = number(cells[split]["median"], 3) if split in cells else "–"
        shown = cells.get(shown_split)
        row["q1–q3"] = (
            f"{number(shown['q1'], 2)}–{number(shown['q3'], 2)}" if shown is not None and len(own) > 1 else "–"
        )
        row["best"] = number(shown["best"], 3) if shown is not None else "–"
        rows.append(row)
    return rows


def score_rows(result: RunResult) -> list[dict[str, str]]:
    """One run's errors by split and output, each with its own name and unit."""
    names, units = result.channels["outputs"], result.channels["output_units"]
    titles = [name if unit == "–" else f"{name} [{unit}]" for name, unit in zip(names, units, strict=True)]
    outputs = {f"y{i + 1}": title for i, title in enumerate(titles)}
    return [
        {
            "split": score.split, "output": outputs[score.output], "RMSE": number(score.rmse),
            "RMSE/σ": number(score.nrmse), "fit [%]": f"{score.fit_percent:.1f}",
        }
        for score in result.scores
    ]  # fmt: skip


def order_rows(rows: Sequence[OrderRow], chosen: int) -> list[dict[str, str]]:
    """Order selection as text, the suggested order marked."""
    return [
        {
            "order": f"{row.order}{' ←' if row.order == chosen else ''}",
            "Hankel σn/σ1": f"{row.hankel:.2e}",
            "train": number(row.train),
            "validation": number(row.val),
        }
        for row in rows
    ]


def study_rows(variants: Sequence[Variant], intervals: bool = False) -> list[dict[str, str]]:
    """A study as text: medians of `shown_error` by order and variant, a run without a result as ∞."""
    rows = []
    for order in sorted({r.spec.order for v in variants for r in v.results}):
        for variant in variants:
            own = [r for r in variant.results if r.spec.order == order]
            ok = [r for r in own if r.status == "ok"]
            row = {"order": str(order), "variant": variant.name, "runs": f"{len(ok)}/{len(own)}"}
            for split in splits_of([r for v in variants for r in v.results]):
                if not any(score.split == split for r in ok for score in r.scores):
                    row[split] = "–"
                    continue
                errors = [shown_error(r, split) if r.status == "ok" else math.inf for r in own]
                row[split] = number(quantile(errors, 0.5))
                if intervals and len(errors) > 1:
                    bounds = median_interval(errors)
                    row[split] += f" ({number(bounds.low, 3)}–{number(bounds.high, 3)})"
            if any(v.unbounded is not None for v in variants):
                unbounded = sum(r.spec.order == order for r in variant.unbounded or ())
                row["unbounded under stress"] = f"{unbounded} of {len(ok)}"
            rows.append(row)
    return rows


def trial_rows(trials: Sequence[Trial]) -> list[dict[str, str]]:
    """Trials of a search as text; – for what the recipe decides."""

    def widths(trial: Trial, name: str) -> str:
        return " ".join(map(str, trial.settings.get(name, ("–",))))

    def plain(trial: Trial, name: str) -> str:
        value = trial.settings.get(name)
        return number(value, 2) if isinstance(value, float) else str("–" if value is None else value)

    return [
        {
            "trial": str(t.number), "state": t.state, "val": number(t.val_rmse, 3), "hidden": widths(t, "hidden"),
            "encoder": widths(t, "encoder"), "λ": plain(t, "consistency"), "rate": plain(t, "learning_rate"),
            "window": plain(t, "window"), "batch": plain(t, "batch"),
        }
        for t in trials
    ]  # fmt: skip


def _cells(table: pd.DataFrame, method: str, order: int, output: str) -> dict[str, pd.Series]:
    own = table[(table["method"] == method) & (table["order"] == order) & (table["output"] == output)]
    return {str(row["split"]): row for _, row in own.iterrows()}


def _explanation(results: Sequence[RunResult]) -> str:
    notes = list(dict.fromkeys(note for result in results for note in result.notes))
    lines = [
        "Free simulation from the first output sample, physical units. Statistics are over seeds; a run without a "
        "result counts as ∞ in medians and quartiles. The best run is chosen on validation, never on test. Every "
        "number is rebuilt from `runs/` by `nnss report`."
    ]
    if several_outputs(results):
        lines.append(
            "Output `mean` is the mean over outputs in physical units, which the largest output rules; methods are "
            "ranked by `mean of RMSE/σ`, σ being the deviation that the protocol scales with."
        )
    return "\n\n".join(lines + [f"Note: {note}" for note in [*notes, *versions_apart(results)]])


def markdown(rows: Sequence[dict[str, object]] | Sequence[dict[str, str]]) -> str:
    """A pipe table."""
    return tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True)
