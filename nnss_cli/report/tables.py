"""Tables as Markdown, and the rows for the terminal."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from tabulate import tabulate

from nnss_cli.datasets.catalog import BENCHMARKS
from nnss_cli.datasets.record import FITTED_ON, heading
from nnss_cli.datasets.units import has_unit
from nnss_cli.experiment.ablation import Variant
from nnss_cli.experiment.order import OrderRow
from nnss_cli.experiment.provenance import MADE_ON, MADE_WITH
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.tune import Trial
from nnss_cli.report.aggregate import (
    MEAN,
    NORMALISED,
    UNITS_MIXED,
    is_combination,
    mean_name,
    methods_of,
    places,
    runs_by_method,
    scored_splits,
    several_outputs,
    shown_error,
    split_name,
    splits_of,
    summary,
    titled_by,
)
from nnss_cli.report.cells import Cell, Markup, escaped, whole
from nnss_cli.report.statistics import median_interval, quantile

SIGMA_AND_FIT = (
    "RMSE/σ: σ is the output's standard deviation over the data that the protocol scales with, the training data "
    "unless a note says otherwise, so that splits can be compared. fit = 100 (1 − RMSE/s): s is the output's standard "
    "deviation within the split itself, about the mean of each record, so 0 % is no better than these means."
)
"""What the two relative errors are relative to."""
FREE = "free simulation from the first output sample, or from those of an init window, which are not scored"
"""What is scored, of any run."""
MIXED = (
    " Their mean in physical units mixes units, so that the largest output rules it: it is here since errors to "
    "compare with are such means."
)
"""Of a mean over outputs of several units."""


def number(value: float | None, digits: int = 4) -> Cell:
    """A few significant digits, without an exponent from 0.0001 to a million; "–" for nothing, "∞" for a failure."""
    if value is None or pd.isna(value):
        return Cell("–", None)
    value = float(value)
    if math.isinf(value):
        return Cell("∞" if value > 0 else "−∞", value)
    if value == 0 or not 1e-4 <= abs(value) < 1e6:
        return Cell(f"{value:.{digits}g}", value)
    return Cell(np.format_float_positional(value, precision=digits, fractional=False, trim="-"), value)


def span(low: float, high: float, names: tuple[str, str], digits: int = 4) -> Cell:
    """Two numbers as a range, each a column of its own for machines."""
    cells = number(low, digits), number(high, digits)
    return Cell("–".join(cells), {name: cell.value for name, cell in zip(names, cells, strict=True)})


def percent(value: float) -> Cell:
    """With one digit, as fits are given."""
    return Cell(f"{value:.1f}" if math.isfinite(value) else number(value), value)


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


def options_apart(results: Sequence[RunResult]) -> list[str]:
    """A line for each method whose runs at different orders have different options, naming these and their values.

    Runs of one order always agree (`agreement`); tables hold all orders.
    """
    lines = []
    for method in methods_of(results):
        settings = {r.spec.order: r.spec.settings for r in results if r.spec.method == method}
        names = [name for name in dict.fromkeys(key for own in settings.values() for key in own) if name != "members"]
        told = []
        for name in names:
            orders: dict[str, list[str]] = {}
            for order in sorted(settings):
                orders.setdefault(option(settings[order].get(name)), []).append(str(order))
            if len(orders) > 1:
                values = (f"{value} at order {', '.join(own)}" for value, own in orders.items())
                told.append(f"{name} {'; '.join(values)}")
        if told:
            lines.append(f"{method} has other options at different orders: {'. '.join(told)}.")
    return lines


def option(value: object) -> str:
    """An option's value as text."""
    return " ".join(map(str, value)) if isinstance(value, list | tuple) else str("–" if value is None else value)


def rmse_markdown(results: Sequence[RunResult], left_out: Sequence[str] = ()) -> str:
    """The summary over seeds, one table a split, the runs that failed, and those that were left out."""
    first = results[0].spec
    called = escaped(heading(titled_by(results), first.dataset))
    parts = [f"# RMSE of {called}, protocol `{first.protocol}`", _explanation(results)]
    table = summary(results)
    names, outputs = methods_of(results), outputs_of(results)
    for split in splits_of(results):
        body = rows_of_split(table, split, [name for name in names if not is_combination(name)], outputs)
        if body:
            parts.append(f"## {escaped(split_name(split).capitalize())}\n\n" + markdown(body))
        apart = rows_of_split(table, split, [name for name in names if is_combination(name)], outputs)
        if apart:
            parts.append("Made of runs above, so no independent competitor:\n\n" + markdown(apart))
    for title, lines in (
        ("Runs without a result", failures(results)), ("Left out", left_out), ("Remarks of the fits", remarks(results)),
    ):  # fmt: skip
        if lines:
            parts.append(f"## {title}\n\n" + "\n".join(f"- {escaped(line)}" for line in lines))
    return "\n\n".join(parts) + "\n"


def rows_of_split(
    table: pd.DataFrame, split: str, methods: list[str], outputs: Mapping[str, str]
) -> list[dict[str, str]]:
    """The summary's rows of these methods for one split, as text, by order, method and output.

    Args:
        table: the summary.
        split: which one.
        methods: in their order.
        outputs: of `outputs_of`.
    """
    if table.empty:
        return []
    rows = table[(table["split"] == split) & table["method"].isin(methods)]
    return [
        {
            "order": whole(row.order), "method": str(row.method), "output": outputs[str(row.output)],
            "runs": f"{row.ok}/{row.runs}", "mean": number(row.mean), "median": number(row.median),
            "fit [%]": percent(row.fit),
            "best by validation": f"{number(row.best)} (seed {row.best_seed})" if row.runs > 1 else number(row.best),
            "spread (q1–q3)": f"{number(row.q1)}–{number(row.q3)}" if row.runs > 1 else "–",
            "min–max": f"{number(row.min)}–{number(row.max)}" if row.runs > 1 else "–",
        }
        for row in rows.assign(
            position=lambda t: t["method"].map(methods.index), place=lambda t: t["output"].map([*outputs].index)
        )
        .sort_values(["order", "position", "place"])
        .itertuples()
    ]  # fmt: skip


@dataclass(frozen=True)
class ErrorTable:
    """A table of a comparison for the terminal: one test set and one output, or the mean over outputs."""

    title: str
    """What it shows, with the unit."""
    rows: list[dict[str, str]]
    """By order and method."""
    heads: dict[str, str]
    """Headers with units."""
    about: dict[str, str]
    """The test set and the output, for machines."""


def error_tables(results: Sequence[RunResult], apart: bool = False) -> list[ErrorTable]:
    """A table for each test set (validation where there is none) and output; of several outputs first their mean.

    Args:
        results: the runs.
        apart: show the methods that are made of others' runs, instead of the independent ones.
    """
    names = output_names(results[0])
    found = []
    for split in scored_splits(results):
        for output in [NORMALISED, *names] if several_outputs(results) else list(names):
            rows = terminal_rows(results, apart, split, output)
            if rows:
                unit = "" if output == NORMALISED else results[0].channels["output_units"][list(names).index(output)]
                shown = {"train", "val", "test", "best"} if has_unit(unit) else set()
                heads = {"order": "n", "fit": "fit\n[%]"} | {name: f"{name}\n[{unit}]" for name in shown}
                about = {"split": split, "output": names.get(output, output)}
                found.append(ErrorTable(terminal_title(results, split, output), rows, heads, about))
    return found


def output_names(result: RunResult) -> dict[str, str]:
    """y1, y2, … → the output's own name with its unit."""
    return {place: str(axis) for place, axis in places(result).items()}


def outputs_of(results: Sequence[RunResult]) -> dict[str, str]:
    """Name of an output in the scores, or of a mean over them → what it is called, with its unit."""
    mean = mean_name(results)
    means = ({MEAN: mean} if mean else {}) | ({NORMALISED: NORMALISED} if several_outputs(results) else {})
    return output_names(results[0]) | means


def terminal_title(results: Sequence[RunResult], split: str = "", output: str = "") -> str:
    """What a terminal's table shows."""
    first = results[0].spec
    output = output or (NORMALISED if several_outputs(results) else "y1")
    what = "mean over outputs of RMSE/σ" if output == NORMALISED else f"RMSE of {output_names(results[0])[output]}"
    called = heading(titled_by(results), first.dataset)
    return (
        f"{called}, protocol {first.protocol}: {what}, {split_name(split or scored_splits(results)[0])}; "
        "median over seeds, q1–q3, best (the seed chosen on validation)"
    )


def terminal_rows(
    results: Sequence[RunResult], apart: bool = False, split: str = "", output: str = ""
) -> list[dict[str, str]]:
    """A short table: medians on train, validation and a test set, fit, quartiles and the best run on the latter.

    Args:
        results: the runs.
        apart: show the methods that are made of others' runs, instead of the independent ones.
        split: the test set; the first, or validation where there is none, unless given.
        output: y1, y2, …; the only one, or the mean over outputs of RMSE/σ, unless given.
    """
    table = summary(results)
    shown_split = split or scored_splits(results)[0]
    splits = {name: name for name in FITTED_ON} | {"test": shown_split if shown_split not in FITTED_ON else "test"}
    output = output or (NORMALISED if several_outputs(results) else "y1")
    position = methods_of(results)
    rows = []
    runs = runs_by_method(results)
    for method, order in sorted(runs, key=lambda key: (key[1], position.index(key[0]))):
        if is_combination(method) != apart:
            continue
        own = runs[method, order]
        ok = sum(r.status == "ok" for r in own)
        cells = {} if table.empty else _cells(table, method, order, output)
        shown = cells.get(shown_split)
        nothing = Cell("–", {"q1": None, "q3": None})
        rows.append(
            {
                "order": whole(order), "method": method,
                "runs": Cell(f"{ok}/{len(own)}", {"ok": ok, "runs": len(own)}),
                **{name: number(cells[key]["median"] if key in cells else None, 3) for name, key in splits.items()},
                "fit": percent(shown["fit"]) if shown is not None else Cell("–", None),
                "q1–q3": span(shown["q1"], shown["q3"], ("q1", "q3"), 3)
                if shown is not None and len(own) > 1 else nothing,
                "best": number(shown["best"] if shown is not None else None, 3),
            }
        )  # fmt: skip
    return rows


def score_rows(result: RunResult) -> list[dict[str, str]]:
    """One run's errors by split and output, each with its own name and unit."""
    outputs = output_names(result)
    return [
        {
            "split": score.split, "output": outputs[score.output], "RMSE": number(score.rmse),
            "RMSE/σ": number(score.nrmse), "fit [%]": percent(score.fit_percent),
        }
        for score in result.scores
    ]  # fmt: skip


def order_rows(rows: Sequence[OrderRow], chosen: int) -> list[dict[str, str]]:
    """Order selection as text, the suggested order marked."""
    return [
        {
            "order": Cell(
                f"{row.order}{' ←' * (row.order == chosen)}", {"order": row.order, "suggested": row.order == chosen}
            ),
            "Hankel σn/σ1": Cell(f"{row.hankel:.2e}", float(row.hankel)),
            "train": number(row.train),
            "validation": number(row.val),
        }
        for row in rows
    ]


def promise_of(stability: str, gamma: float | None) -> str:
    """What an option of stability promises of every model that is made with it."""
    if gamma is None:
        return "nothing"
    return {
        "incremental": f"‖x1(k) − x2(k)‖ ≤ {gamma:g}ᵏ ‖x1(0) − x2(0)‖ under any one input",
        "schur": f"ρ(A(ρ)) < {gamma:g} at every ρ", "quadratic": f"‖A(ρ)‖ < {gamma:g} at every ρ",
    }.get(stability, "nothing")  # fmt: skip


def study_rows(variants: Sequence[Variant], intervals: bool = False) -> list[dict[str, str]]:
    """A study as text: medians of `shown_error` by order and variant, a run without a result as ∞."""
    rows = []
    for order in sorted({r.spec.order for v in variants for r in v.results}):
        for variant in variants:
            own = [r for r in variant.results if r.spec.order == order]
            ok = [r for r in own if r.status == "ok"]
            row: dict[str, str] = {
                "order": whole(order), "variant": variant.name,
                "runs": Cell(f"{len(ok)}/{len(own)}" if own else "–", {"ok": len(ok), "runs": len(own)}),
            }  # fmt: skip
            for split in splits_of([r for v in variants for r in v.results]):
                if not any(score.split == split for r in ok for score in r.scores):
                    row[split] = "–"
                    continue
                errors = [shown_error(r, split) if r.status == "ok" else math.inf for r in own]
                row[split] = number(quantile(errors, 0.5))
                if intervals and len(errors) > 1:
                    bounds = median_interval(errors)
                    median = number(quantile(errors, 0.5))
                    between = f"{number(bounds.low, 3)}–{number(bounds.high, 3)}"
                    row[split] = Cell(f"{median} ({between})", median.value)
            if any(v.unbounded is not None for v in variants):
                unbounded = sum(r.spec.order == order for r in variant.unbounded or ())
                unknown = variant.unbounded is None and ok  # `nnss ablate` tries what was not tried
                row["unbounded under stress"] = "–" if unknown else Cell(f"{unbounded} of {len(ok)}", unbounded)
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
            "trial": whole(t.number), "state": t.state, "val": number(t.val_rmse, 3), "hidden": widths(t, "hidden"),
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
        f"{FREE[0].upper()}{FREE[1:]}; physical units. Statistics are over seeds; a run without a result counts as ∞ "
        "in medians and quartiles. The best run is chosen on validation, never on test. Every number is rebuilt from "
        "`runs/` by `nnss report`."
    ]
    lines.append(SIGMA_AND_FIT)
    if several_outputs(results):
        mixed = MIXED if mean_name(results) == UNITS_MIXED else ""
        lines.append(f"Over outputs, methods are ranked by `{NORMALISED}`.{mixed}")
    if results[0].spec.dataset not in BENCHMARKS:  # theirs are ours, and Markdown
        notes = list(map(escaped, notes))
    told = [*notes, *map(escaped, (*options_apart(results), *versions_apart(results)))]
    return "\n\n".join(lines + [f"Note: {note}" for note in told])


def markdown(rows: Sequence[dict[str, object]] | Sequence[dict[str, str]]) -> str:
    """A pipe table, "" of no rows; what would be markup in a name, which is the user's, is none, but for `Markup`."""
    kept = [
        {
            escaped(key): escaped(value) if isinstance(value, str) and not isinstance(value, Markup) else value
            for key, value in row.items()
        }
        for row in rows
    ]
    return tabulate(kept, headers="keys", tablefmt="pipe", disable_numparse=True)
