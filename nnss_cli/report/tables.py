"""Tables as Markdown, and the rows for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from tabulate import tabulate

from nnss_cli.datasets.record import SPLITS
from nnss_cli.experiment.ablation import Variant
from nnss_cli.experiment.order import OrderRow
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.tune import Trial
from nnss_cli.report.aggregate import MEAN, methods_of, scored_split, summary
from nnss_cli.report.statistics import median_interval

if TYPE_CHECKING:  # it imports torch, which a report does without
    from nnss_cli.experiment.certify import Certificate

SPLIT_NAMES = {"train": "Train", "val": "Validation", "test": "Test"}


def number(value: float | None, digits: int = 4) -> str:
    """A few significant digits; "–" for nothing."""
    return "–" if value is None or pd.isna(value) else f"{value:.{digits}g}"


def failures(results: Sequence[RunResult]) -> list[str]:
    """One line for each run that is not ok."""
    return [
        f"{r.spec.method}, order {r.spec.order}, seed {r.spec.seed}: {r.status}: {r.reason}"
        for r in results
        if r.status != "ok"
    ]


def rmse_markdown(results: Sequence[RunResult]) -> str:
    """The summary over seeds, one table a split, and the runs that failed."""
    first = results[0].spec
    parts = [f"# RMSE of {first.dataset}, protocol `{first.protocol}`", _explanation(results)]
    table = summary(results)
    for split in SPLITS:
        body = rows_of_split(table, split, methods_of(results))
        if body:
            parts.append(f"## {SPLIT_NAMES[split]}\n\n" + markdown(body))
    lines = failures(results)
    if lines:
        parts.append("## Runs without a result\n\n" + "\n".join(f"- {line}" for line in lines))
    return "\n\n".join(parts) + "\n"


def rows_of_split(table: pd.DataFrame, split: str, methods: list[str]) -> list[dict[str, str]]:
    """The summary's rows for one split, as text, by order, method and output."""
    if table.empty:
        return []
    rows = table[table["split"] == split].assign(position=lambda t: t["method"].map(methods.index))
    return [
        {
            "order": str(row.order), "method": str(row.method), "output": str(row.output), "runs": str(row.runs),
            "mean": number(row.mean), "median": number(row.median),
            "best by validation": f"{number(row.best)} (seed {row.best_seed})" if row.runs > 1 else number(row.best),
            "spread (q1–q3)": f"{number(row.q1)}–{number(row.q3)}" if row.runs > 1 else "–",
            "min–max": f"{number(row.min)}–{number(row.max)}" if row.runs > 1 else "–",
        }
        for row in rows.sort_values(["order", "position", "output"]).itertuples()
    ]  # fmt: skip


def terminal_rows(results: Sequence[RunResult]) -> list[dict[str, str]]:
    """A short table: medians of all splits, the test error of the best run; mean over outputs."""
    table = summary(results)
    methods = methods_of(results)
    shown_split = scored_split(results)
    rows = []
    for order in sorted({r.spec.order for r in results}):
        for method in methods:
            own = [r for r in results if (r.spec.method, r.spec.order) == (method, order)]
            if not own:
                continue
            ok = sum(r.status == "ok" for r in own)
            row = {"order": str(order), "method": method, "runs": f"{ok}/{len(own)}"}
            cells = _cells(table, method, order)
            for split in SPLITS:
                row[split] = number(cells[split]["median"], 3) if split in cells else "–"
            shown = cells.get(shown_split)
            row["q1–q3"] = f"{number(shown['q1'], 2)}–{number(shown['q3'], 2)}" if shown is not None and ok > 1 else "–"
            row["best"] = number(shown["best"], 3) if shown is not None else "–"
            rows.append(row)
    return rows


def score_rows(result: RunResult) -> list[dict[str, str]]:
    """One run's errors by split and output."""
    return [
        {
            "split": score.split, "output": score.output, "RMSE": number(score.rmse),
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


def certificate_rows(found: Certificate) -> list[dict[str, str]]:
    """A certificate as text."""

    def known(value: float | None) -> str:
        return "–" if value is None else number(value, 6)

    promise = {
        "schur": f"ρ(A(ρ)) < {found.gamma:g} at every ρ", "contraction": f"‖A(ρ)‖ < {found.gamma:g} at every ρ",
    }.get(found.stability, "nothing")  # fmt: skip
    linear = found.kind == "linear"
    where = "the only A" if linear else "box, sampled"
    rows = {
        "promised": promise,
        **{f"largest ρ(A), {split}": known(radius) for split, radius in found.radius.items()},
        **{f"largest ‖x‖, {split}": known(state) for split, state in found.state.items()},
        f"largest ρ(A), {where}": known(found.box_radius),
        f"largest ‖A‖, {where}": known(found.box_norm),
        "certified rate": known(found.gamma) if found.stability == "contraction" else "–",
        "certified sup‖x‖": f"{known(found.state_bound)}{', for ' * bool(found.holds_for)}{found.holds_for}",
        "invariant ball ‖x‖ ≤": known(found.invariant_radius),
        "largest ‖x(0)‖ of the records": known(found.initial_state),
        "sup‖B‖, sup‖C‖": f"{known(found.B_bound)}, {known(found.C_bound)}",
        "sup‖u‖": known(found.input_bound),
        "common Lyapunov matrix": found.lyapunov,
        "its rate" if linear else "its rate, sampled set": known(found.lyapunov_rate),
    }
    return [{"": name, "found": value} for name, value in rows.items()]


def stress_rows(found: Certificate) -> list[dict[str, str]]:
    """Stress runs as text."""
    return [
        {"input": run.input, "steps": str(run.steps), "max ‖x‖": number(run.state), "max |y|": number(run.output)}
        for run in found.stress
    ]


def study_rows(variants: Sequence[Variant], intervals: bool = False) -> list[dict[str, str]]:
    """A study as text: medians by order and variant."""
    rows = []
    for order in sorted({r.spec.order for v in variants for r in v.results}):
        for variant in variants:
            own = [r for r in variant.results if r.spec.order == order]
            ok = [r for r in own if r.status == "ok"]
            row = {"order": str(order), "variant": variant.name, "runs": f"{len(ok)}/{len(own)}"}
            for split in SPLITS:
                errors = [sum(e) / len(e) for r in ok if (e := [s.rmse for s in r.scores if s.split == split])]
                row[split] = number(float(np.median(errors))) if errors else "–"
                if intervals and len(errors) > 1:
                    low, high = median_interval(errors)
                    row[split] += f" ({number(low, 3)}–{number(high, 3)})"
            if any(v.unbounded is not None for v in variants):
                row["unbounded under stress"] = str(sum(r.spec.order == order for r in variant.unbounded or ()))
            rows.append(row)
    return rows


def trial_rows(trials: Sequence[Trial]) -> list[dict[str, str]]:
    """Trials of a search as text."""
    return [
        {
            "trial": str(t.number), "state": t.state, "val": number(t.val_rmse, 3),
            "hidden": f"{t.values['width']}×{t.values['depth']}",
            "encoder": f"{t.values['encoder_width']}×{t.values['encoder_depth']}",
            "λ": number(t.values["lambda"], 2), "rate": number(t.values["learning_rate"], 2),
            "window": str(t.values["window"]), "batch": str(t.values["batch"]),
        }
        for t in trials
    ]  # fmt: skip


def _cells(table: pd.DataFrame, method: str, order: int) -> dict[str, pd.Series]:
    if table.empty:
        return {}
    own = table[(table["method"] == method) & (table["order"] == order)]
    output = MEAN if (own["output"] == MEAN).any() else "y1"
    return {str(row["split"]): row for _, row in own[own["output"] == output].iterrows()}


def _explanation(results: Sequence[RunResult]) -> str:
    notes = list(dict.fromkeys(note for result in results for note in result.notes))
    lines = [
        "Free simulation from the first output sample, physical units. Statistics are over seeds; the best run "
        "is chosen on validation, never on test. Every number is rebuilt from `runs/` by `nnss report`."
    ]
    return "\n\n".join(lines + [f"Note: {note}" for note in notes])


def markdown(rows: Sequence[dict[str, object]] | Sequence[dict[str, str]]) -> str:
    """A pipe table."""
    return tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True)
