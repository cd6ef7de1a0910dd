"""How our numbers stand beside the paper's and its released models', and how sure that is, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from nnss_cli.experiment.run import RunResult
from nnss_cli.report.aggregate import (
    MEAN,
    long_table,
    methods_of,
    paper_table,
    released_table,
    scored_split,
    summary,
    validation_error,
)
from nnss_cli.report.statistics import (
    critical_difference,
    mean_ranks,
    median_interval,
    paired_tests,
    verdict,
)
from nnss_cli.report.tables import markdown, number

QUIRKS = """\
What a reader of protocol `paper` must know about the paper's protocol:

- Two-tank: validation (samples 1500–1999) lies inside test (1500–2999), so a choice on validation sees part of test.
- Power plant: means and deviations are taken over all 200 rows, validation and test included.
- Robot arm: yv3/uv3, the paper's test record, is not in the files at hand; it is judged on train and validation.
- The paper picks the best of ten seeds on test. Here the best is always chosen on validation; what the paper's way
  of choosing adds is shown once, under "Optimism of choosing on test".
- The Schur formula printed in the paper does not fit in its dimensions; the one of SIMBa, which the authors' code
  computes, is used.
- The patience of 400 is counted in mini-batches: so counted, the recipe ends where the released models did, in epochs
  and in errors. Counted in epochs (`--patience-unit epochs`) it trains on for hundreds of epochs, to much lower errors.

Protocol `strict` has none of the overlaps."""


def as_in_the_paper(results: Sequence[RunResult]) -> list[RunResult]:
    """The runs that repeat the paper's, under its names: NN-SS with the paper's recipe, and the baselines."""
    named = any(r.spec.method == "nnss-paper" for r in results)
    kept = [
        r
        for r in results
        if r.spec.method == "nnss-paper"
        or not r.spec.method.startswith("nnss")
        or (r.spec.method == "nnss" and not named and r.spec.settings.get("recipe", "paper") == "paper")
    ]
    return [r.renamed("nnss") if r.spec.method == "nnss-paper" else r for r in kept]


def paper_comparison(results: Sequence[RunResult]) -> str:
    """The paper's printed values beside ours, a verdict per cell ("" where the paper prints none for these runs).

    The paper prints the best of ten seeds, chosen on test: so the verdict is on ours chosen likewise.
    """
    first = results[0].spec
    printed = paper_table()
    printed = printed[printed["dataset"] == first.dataset]
    ours = summary(as_in_the_paper(results))
    if printed.empty or ours.empty or first.protocol != "paper":
        return ""
    lucky = _chosen_on_test(as_in_the_paper(results))
    merged = printed.merge(ours, how="left", on=["order", "method", "output", "split"])
    merged = merged.merge(lucky, how="left", on=["order", "method", "output", "split"])
    rows = []
    for row in merged.itertuples():
        known = pd.notna(row.lucky)
        unit = 10.0 ** -len(str(row.rmse).partition(".")[2])  # of the last printed digit
        rows.append(
            {
                "order": str(row.order), "method": row.method, "output": row.output, "split": row.split,
                "paper": number(row.rmse), "ours, chosen as the paper does": number(row.lucky),
                "difference": f"{100 * (row.lucky / row.rmse - 1):+.0f} %" if known else "–",
                "verdict": verdict(row.lucky, row.rmse, unit) if known else "–",
                "ours: median": number(row.median), "ours: best by validation": number(row.best),
            }
        )  # fmt: skip
    return markdown(rows)


def released_comparison(results: Sequence[RunResult]) -> str:
    """Medians over seeds beside those of the models that the authors released ("" where there are none)."""
    first = results[0].spec
    released = released_table()
    released = released[released["dataset"] == first.dataset]
    if released.empty or first.protocol != "paper":
        return ""
    ours = seed_errors(as_in_the_paper(results))
    rows = []
    for row in released.itertuples():
        own = ours[(ours["method"] == row.method) & (ours["order"] == row.order) & (ours["split"] == row.split)]
        if own.empty:
            continue
        median, (low, high) = float(own["rmse"].median()), median_interval(own["rmse"].tolist())
        rows.append(
            {
                "order": str(row.order), "method": row.method, "split": row.split, "seeds": str(len(own)),
                "released: median": number(row.median), "ours: median": number(median),
                "95 % interval": f"{number(low)}–{number(high)}",
                "difference": f"{100 * (median / row.median - 1):+.0f} %", "verdict": verdict(median, row.median),
                "released in interval": "yes" if low <= row.median <= high else "no",
            }
        )  # fmt: skip
    return markdown(rows) if rows else ""


def optimism(results: Sequence[RunResult]) -> str:
    """What choosing the best seed on test adds over choosing it on validation ("" without several seeds and a test)."""
    rows = []
    for (method, order), own in _groups(results).items():
        tested = {r.spec.seed: _mean(r, "test") for r in own}
        if len(own) < 2 or any(value is None for value in tested.values()):
            continue
        honest = tested[min(own, key=validation_error).spec.seed]
        lucky = min(value for value in tested.values() if value is not None)
        assert honest is not None
        rows.append(
            {
                "order": str(order), "method": method, "chosen on validation": number(honest),
                "chosen on test": number(lucky), "optimism": f"{100 * (1 - lucky / honest):.0f} %",
            }
        )  # fmt: skip
    return markdown(rows) if rows else ""


def intervals(results: Sequence[RunResult]) -> str:
    """Medians over seeds with bootstrap intervals, mean over outputs, on the split that figures show."""
    split = scored_split(results)
    errors = seed_errors(results)
    rows = []
    for order in sorted(errors["order"].unique()):
        for method in methods_of(results):
            own = errors[(errors["method"] == method) & (errors["order"] == order) & (errors["split"] == split)]["rmse"]
            if own.empty:
                continue
            low, high = median_interval(own.tolist())
            rows.append(
                {
                    "order": str(order), "method": method, "seeds": str(len(own)), "split": split,
                    "median": number(own.median()),
                    "95 % interval": f"{number(low)}–{number(high)}" if len(own) > 1 else "–",
                }
            )  # fmt: skip
    return markdown(rows) if rows else ""


def blocks(results: Sequence[RunResult], split: str = "") -> pd.DataFrame:
    """Median error over seeds by dataset and order (rows) and method (columns), complete rows and columns only.

    On the split that figures show, or on `split`. Five digits: what differs less is a tie.
    """
    parts = []
    for dataset in dict.fromkeys(r.spec.dataset for r in results):
        own = [r for r in results if r.spec.dataset == dataset]
        errors = seed_errors(own)
        if errors.empty:
            continue
        errors = errors[errors["split"] == (split or scored_split(own))]
        medians = errors.pivot_table(index="order", columns="method", values="rmse", aggfunc="median")
        parts.append(medians.set_index(pd.MultiIndex.from_product([[dataset], medians.index])))
    if not parts:
        return pd.DataFrame()
    everything = pd.concat(parts)
    methods = [name for name in methods_of(results) if name in everything.columns]
    return everything[methods].dropna().map(lambda value: float(f"{value:.5g}"))


def ranking(table: pd.DataFrame) -> str:
    """Mean ranks and paired tests over dataset-order pairs, as Markdown."""
    ranks = mean_ranks(table)
    difference = critical_difference(len(ranks), len(table))
    tests = [
        {
            "lower": t.first, "higher": t.second, "lower in": f"{t.wins} of {t.pairs}",
            "p (Wilcoxon)": number(t.p, 2), "p (Holm)": number(t.adjusted, 2),
            "at 5 %": "differ" if t.adjusted < 0.05 else "not shown to differ",
        }
        for t in paired_tests(table)
    ]  # fmt: skip
    return "\n\n".join(
        [
            f"Over {len(table)} dataset-order pairs, medians over seeds. Mean ranks (1 is best): "
            + ", ".join(f"{name} {rank:.2f}" for name, rank in ranks.items())
            + f". Ranks further apart than the critical difference {difference:.2f} differ at the 5 % level (Nemenyi).",
            markdown(tests),
        ]
    )


def ahead(table: pd.DataFrame, validation: pd.DataFrame, method: str = "nnss") -> str:
    """Where a method has the lowest median, where not, and why ("" where it is not among the columns).

    Args:
        table: `blocks` on the split that figures show.
        validation: `blocks` on validation, on which all choices are made.
        method: whose standing is asked for.
    """
    rivals = [name for name in table.columns if not name.startswith("nnss")]
    if method not in table.columns or not rivals:
        return ""
    lines = []
    for at, row in table.iterrows():
        dataset, order = at
        rival = row[rivals].idxmin()
        change = 100 * (row[method] / row[rival] - 1)
        seen, other = validation.loc[at, method], validation.loc[at, rival]
        why = ""
        if change == 0:
            why = "the same: validation refused every step away from the linear start"
        elif change > 0:
            why = f"validation says {number(seen)} against {number(other)}"
            why += ", the other way round" if seen < other else ", behind there too"
        lines.append(
            {
                "dataset": str(dataset), "order": str(order), method: number(row[method]),
                "best other": f"{rival} {number(row[rival])}", "difference": f"{change:+.1f} %",
                "": "ahead" if change < 0 else "level" if change == 0 else "behind", "why": why,
            }
        )  # fmt: skip
    return markdown(lines)


def seed_errors(results: Sequence[RunResult]) -> pd.DataFrame:
    """RMSE by method, order, seed and split: the mean over outputs of the ok runs."""
    table = long_table([result for result in results if result.status == "ok"])
    return table.groupby(["method", "order", "seed", "split"], as_index=False)["rmse"].mean()


def _groups(results: Sequence[RunResult]) -> dict[tuple[str, int], list[RunResult]]:
    found: dict[tuple[str, int], list[RunResult]] = {}
    for result in results:
        if result.status == "ok":
            found.setdefault((result.spec.method, result.spec.order), []).append(result)
    return dict(sorted(found.items(), key=lambda item: (item[0][1], item[0][0])))


def _mean(result: RunResult, split: str) -> float | None:
    errors = [score.rmse for score in result.scores if score.split == split]
    return sum(errors) / len(errors) if errors else None


def _chosen_on_test(results: Sequence[RunResult]) -> pd.DataFrame:
    """Errors of the seed that a choice on test would take (on validation where there is no test)."""
    split = scored_split(results)
    rows = []
    for (method, order), own in _groups(results).items():
        run = min(own, key=lambda r: _mean(r, split) or float("inf"))
        scores = list(run.scores)
        rows += [
            {"method": method, "order": order, "split": s.split, "output": s.output, "lucky": s.rmse} for s in scores
        ]
        for name in dict.fromkeys(score.split for score in scores):
            rows.append({"method": method, "order": order, "split": name, "output": MEAN, "lucky": _mean(run, name)})
    return pd.DataFrame(rows, columns=["method", "order", "split", "output", "lucky"])
