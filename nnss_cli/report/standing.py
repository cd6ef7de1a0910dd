"""Methods side by side: ratios of errors on each record and order, and ranks over records where there are enough."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import pandas as pd

from nnss_cli.datasets.record import FITTED_ON
from nnss_cli.experiment.run import RunResult
from nnss_cli.methods import METHODS
from nnss_cli.report.aggregate import (
    is_combination,
    methods_of,
    runs_by_method,
    split_error,
    splits_of,
    test_error,
    test_sets,
)
from nnss_cli.report.statistics import (
    LEVEL,
    MIN_RECORDS,
    Comparison,
    mean_ranks,
    quantile,
    ratio,
    ratio_interval,
    smallest_adjusted,
)
from nnss_cli.report.tables import markdown, number

FAILED_SHARE = 0.2  # a method that fails on more of its runs has no ratio and no rank

MEANING = f"""\
Errors are RMSE/σ, mean over outputs, σ as the protocol scales; medians over seeds, a run without a result counts as ∞.
A ratio below 1 says that NN-SS has the lower error. Its interval is over seeds: how far the ratio depends on initial
weights and shuffling, *on this record and split*. It says nothing about another record, and each interval stands by
itself. By order statistics it holds at 95 % or more from seven seeds on; with fewer, at the share given. A method that
fails on more than {100 * FAILED_SHARE:.0f} % of its runs has no ratio and no rank.
Combinations of other runs are no competitors of these and stand apart."""


def effects(results: Sequence[RunResult], split: str, method: str = "nnss") -> str:
    """Ratios of a method's median error to each other's, by record and order, as Markdown ("" where there are none).

    Args:
        results: of one protocol.
        split: the split that all of them are taken from; records without it are left out.
        method: whose standing is asked for.
    """
    names = methods_of(results)
    rivals = [name for name in names if name != method and not is_combination(name)]
    if method not in names or not rivals:
        return ""
    rows = []
    for (dataset, order, name), errors in errors_by_record(results, split).items():
        if method not in errors:
            continue
        own = errors[method]
        row = {
            "dataset": record_name(dataset, name), "order": str(order), f"{method}: RMSE/σ": number(quantile(own, 0.5)),
            "runs": f"{sum(map(math.isfinite, own))}/{len(own)}",
        }  # fmt: skip
        lower: list[str] = []
        higher: list[str] = []
        undecided: list[str] = []
        coverage: list[float] = []
        for rival in rivals:
            theirs = errors.get(rival, [])
            lost = [one for one, values in ((method, own), (rival, theirs)) if fails_too_often(values)]
            if not theirs:
                row[f"/ {rival}"] = "not run"
            elif lost:
                row[f"/ {rival}"] = "no ratio: " + ", ".join(
                    f"{sum(map(math.isinf, errors[one]))} of {len(errors[one])} runs of {one} without a result"
                    for one in lost
                )
            else:
                bounds = ratio_interval(own, theirs, (not is_seeded(method), not is_seeded(rival)))
                coverage.append(bounds.coverage)
                row[f"/ {rival}"] = f"{number(ratio(own, theirs), 3)}" + (
                    f" ({number(bounds.low, 3)}–{number(bounds.high, 3)})" if bounds.coverage else ""
                )
                settled = bounds.coverage >= LEVEL
                (lower if settled and bounds.high < 1 else higher if settled and bounds.low > 1 else undecided).append(
                    rival
                )
        row["interval holds at"] = (
            "–"
            if not coverage or min(coverage) == 0
            else "≥ 95 %"
            if min(coverage) >= LEVEL
            else f"{min(coverage):.0%}"
        )
        parts = [("lower than", lower), ("higher than", higher), ("not settled:", undecided)]
        row["what the seeds settle"] = "; ".join(f"{word} {', '.join(those)}" for word, those in parts if those)
        rows.append(row)
    return markdown(rows)


def combinations(results: Sequence[RunResult], split: str) -> str:
    """Combinations beside the median of the runs that they are made of, as Markdown ("" where there are none)."""
    rows = []
    for (dataset, order, test), errors in errors_by_record(results, split).items():
        for name in filter(is_combination, errors):
            parts = errors.get(METHODS[name].members, [])
            rows.append(
                {
                    "dataset": record_name(dataset, test), "order": str(order), "method": name,
                    "RMSE/σ": number(quantile(errors[name], 0.5)), "made of runs of": METHODS[name].members,
                    "their median": number(quantile(parts, 0.5)) if parts else "–",
                    "ratio": number(ratio(errors[name], parts), 3) if parts else "–",
                }
            )  # fmt: skip
    return markdown(rows)


def unscored(results: Sequence[RunResult], split: str) -> list[str]:
    """A line for each dataset that has nothing to compare on a split."""
    return [
        f"{dataset} has no {split} record under this protocol"
        if any(r.status == "ok" for r in own)
        else f"{dataset}: no run has a result"
        for dataset, own in _by_dataset(results).items()
        if not _has(own, split)
    ]


def missing_runs(results: Sequence[RunResult]) -> list[str]:
    """A line for each method that lacks orders or seeds that others of its dataset have."""
    lines = []
    for dataset, own in _by_dataset(results).items():
        runs = runs_by_method(own)
        orders = sorted({order for _, order in runs})
        seeds = {r.spec.seed for r in own}
        seeded = {method for (method, _), found in runs.items() if is_seeded(method)}
        for method in methods_of(own):
            lacking = [order for order in orders if (method, order) not in runs]
            if lacking:
                lines.append(f"{dataset}: {method} was not run at order {', '.join(map(str, lacking))}")
            for order in orders:
                found = {r.spec.seed for r in runs.get((method, order), [])}
                gone = sorted(seeds - found)
                if found and gone and method in seeded:
                    lines.append(f"{dataset}: {method}, order {order}, lacks seed {', '.join(map(str, gone))}")
    return lines


def record_table(results: Sequence[RunResult]) -> tuple[pd.DataFrame, list[str]]:
    """Test errors by record (rows) and method (columns), none missing, and what had to be left out.

    The error of a record is the geometric mean over its orders of the median over seeds, of the mean over its test
    sets, so that a record counts once whatever the number of orders and sets. Five digits: what differs less is a tie.
    """
    left_out = unscored(results, "test")
    cells: dict[str, dict[int, dict[str, list[float]]]] = {}
    for dataset, own in _by_dataset(results).items():
        if _has(own, "test"):
            cells[dataset] = {}
            for (method, order), runs in runs_by_method(own).items():
                if not is_combination(method):
                    cells[dataset].setdefault(order, {})[method] = [_error(r, test_error) for r in runs]
    rows: dict[str, dict[str, float]] = {}
    unranked: dict[str, str] = {}
    for dataset, by_order in cells.items():
        names = sorted({name for errors in by_order.values() for name in errors})
        used = [order for order, errors in by_order.items() if 2 * len(errors) >= len(names)]
        left_out += [
            f"{dataset}, order {order}: run by {', '.join(by_order[order])} alone"
            for order in by_order
            if order not in used
        ]
        for name in names:
            lacking = [str(order) for order in used if name not in by_order[order]]
            values = [value for order in used for value in by_order[order].get(name, [])]
            if lacking:
                unranked[name] = f"not run on {dataset}, order {', '.join(lacking)}"
            elif any(fails_too_often(by_order[order][name]) for order in used):
                failed = sum(map(math.isinf, values))
                unranked[name] = f"{failed} of {len(values)} runs on {dataset} without a result"
            else:
                medians = [quantile(by_order[order][name], 0.5) for order in used]
                rows.setdefault(dataset, {})[name] = float(f"{np.exp(np.mean(np.log(medians))):.5g}")
    for name in {name for row in rows.values() for name in row}:
        gone = [dataset for dataset in rows if name not in rows[dataset]]
        if gone and name not in unranked:
            unranked[name] = f"not run on {', '.join(gone)}"
    table = pd.DataFrame.from_dict(rows, orient="index")
    kept = [name for name in methods_of(results) if name in table.columns and name not in unranked]
    left_out += [f"{name} has no rank: {reason}" for name, reason in sorted(unranked.items())]
    return table[kept] if len(table) else table, left_out


def ranking(table: pd.DataFrame, tests: Sequence[Comparison]) -> str:
    """Mean ranks and paired tests over records, as Markdown."""
    ranks = mean_ranks(table)
    lowest = smallest_adjusted(len(table), len(ranks))
    text = (
        f"Over {len(table)} records, each counted once (test; geometric mean over its orders of medians over seeds). "
        "Mean ranks (1 is best): " + ", ".join(f"{name} {rank:.2f}" for name, rank in ranks.items()) + "."
    )
    if lowest > 1 - LEVEL:
        text += (
            f" So few records for {len(ranks)} methods cannot show any difference: "
            f"the smallest p that Holm's correction could give is {number(lowest, 2)}."
        )
    return f"{text}\n\n{markdown(pair_rows(tests))}"


def pair_rows(tests: Sequence[Comparison]) -> list[dict[str, str]]:
    """Paired tests over records as text."""
    return [
        {
            "lower": t.first, "higher": t.second, "lower on": f"{t.wins} of {t.pairs} records",
            "p (Wilcoxon)": number(t.p, 2), "p (Holm)": number(t.adjusted, 2),
            "at 5 %": "differ" if t.differ else "not shown to differ",
        }
        for t in tests
    ]  # fmt: skip


def no_ranking(records: int, methods: int) -> str:
    """Why there is none of so many records, and methods that all of them have."""
    if records >= MIN_RECORDS:
        return (
            f"{records} records with a test, but {methods or 'no'} method{'s' * (methods != 1)} with results on all of "
            "them: there is no ranking of fewer than two. Run the same methods on each record."
        )
    return (
        f"{records} record{'s' * (records != 1)} with a test: too few to test methods against each other over records "
        f"(at least {MIN_RECORDS}), so there is no ranking. What is known is what the table says, record by record."
    )


def fails_too_often(errors: Sequence[float]) -> bool:
    """Whether more than `FAILED_SHARE` of the runs have no result."""
    return sum(map(math.isinf, errors)) > FAILED_SHARE * len(errors)


def _by_dataset(results: Sequence[RunResult]) -> dict[str, list[RunResult]]:
    found: dict[str, list[RunResult]] = {}
    for result in results:
        found.setdefault(result.spec.dataset, []).append(result)
    return found


def is_seeded(method: str) -> bool:
    """Whether runs differ by seed; of a method that is not installed here it is assumed."""
    return method not in METHODS or METHODS[method].seeded


def _has(results: Sequence[RunResult], split: str) -> bool:
    return bool(_names(results, split))


def _names(results: Sequence[RunResult], split: str) -> list[str]:
    """The splits that "test" (every test set) or another name stands for, where there are scores."""
    return test_sets(results) if split == "test" else [name for name in splits_of(results) if name == split]


def record_name(dataset: str, split: str) -> str:
    """A dataset, with its test set where that has a name of its own."""
    return dataset if split in ("test", *FITTED_ON) else f"{dataset}: {split}"


def _error(result: RunResult, measure: Callable[[RunResult], float]) -> float:
    return measure(result) if result.status == "ok" else math.inf


def errors_by_record(results: Sequence[RunResult], split: str) -> dict[tuple[str, int, str], dict[str, list[float]]]:
    """RMSE/σ of every run by dataset, order and split, then method; ∞ for a run without a result."""
    found: dict[tuple[str, int, str], dict[str, list[float]]] = {}
    for dataset, own in _by_dataset(results).items():
        for name in _names(own, split):
            for (method, order), runs in runs_by_method(own).items():
                measure = partial(split_error, split=name)
                found.setdefault((dataset, order, name), {})[method] = [_error(r, measure) for r in runs]
    return found
