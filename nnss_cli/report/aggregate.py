"""From runs to numbers: the long table, its summary over seeds, the best runs."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources

import pandas as pd

from nnss_cli.experiment.run import RunResult
from nnss_cli.methods import METHODS

MEAN = "mean"  # name of the mean over outputs in the output column

COLUMNS = [
    "dataset", "protocol", "method", "order", "seed", "split", "output", "rmse", "nrmse", "fit_percent",
    "status", "reason", "epochs", "fit_seconds",
]  # fmt: skip


def long_table(results: Sequence[RunResult]) -> pd.DataFrame:
    """One row per run, split and output; a run that is not ok is one row with its reason."""
    rows = []
    for result in results:
        spec = result.spec
        run = {
            "dataset": spec.dataset, "protocol": spec.protocol, "method": spec.method, "order": spec.order,
            "seed": spec.seed, "status": result.status, "reason": result.reason, "epochs": result.epochs,
            "fit_seconds": result.fit_seconds,
        }  # fmt: skip
        for score in result.scores:
            rows.append(run | vars(score))
        if not result.scores:
            rows.append(run | {"split": "", "output": ""})
    return pd.DataFrame(rows, columns=COLUMNS)


def summary(results: Sequence[RunResult]) -> pd.DataFrame:
    """Statistics of the RMSE over seeds, by order, method, split and output.

    Records of several outputs get a further output "mean": the mean over outputs, then the
    statistics over seeds. `best` is the run that `best_run` picks on validation, on every split.
    """
    scored = long_table([result for result in results if result.status == "ok"])
    if scored.empty:
        return pd.DataFrame()
    if scored["output"].nunique() > 1:
        keys = ["method", "order", "seed", "split"]
        means = scored.groupby(keys, as_index=False)["rmse"].mean().assign(output=MEAN)
        scored = pd.concat([scored, means], ignore_index=True)
    grouped = scored.groupby(["order", "method", "split", "output"])["rmse"]
    table = grouped.agg(
        runs="count", mean="mean", median="median", std="std", min="min",
        q1=lambda v: v.quantile(0.25), q3=lambda v: v.quantile(0.75), max="max",
    ).reset_index()  # fmt: skip
    best_seeds = {
        (method, order): best_run([r for r in results if (r.spec.method, r.spec.order) == (method, order)])
        for method, order in {(r.spec.method, r.spec.order) for r in results}
    }
    values = scored.set_index(["method", "order", "seed", "split", "output"])["rmse"]
    best, seeds = [], []
    for row in table.itertuples():
        run = best_seeds[(row.method, row.order)]
        assert run is not None  # the row exists, so an ok run does
        seeds.append(run.spec.seed)
        best.append(float(values.loc[(row.method, row.order, run.spec.seed, row.split, row.output)]))
    table["best"], table["best_seed"] = best, seeds
    return table


def validation_error(result: RunResult) -> float:
    """Mean over outputs of the normalised validation error: what choices are made on."""
    errors = [score.nrmse for score in result.scores if score.split == "val"]
    return sum(errors) / len(errors) if errors else float("inf")


def best_run(results: Sequence[RunResult]) -> RunResult | None:
    """The ok run with the lowest validation error; the test split has no say."""
    candidates = [result for result in results if result.status == "ok"]
    return min(candidates, key=validation_error, default=None)


def best_by_method(results: Sequence[RunResult]) -> dict[str, RunResult]:
    """The best run of each method over orders and seeds, by validation."""
    chosen = {}
    for method in methods_of(results):
        best = best_run([result for result in results if result.spec.method == method])
        if best:
            chosen[method] = best
    return chosen


def methods_of(results: Sequence[RunResult]) -> list[str]:
    """Methods in the order of the registry, then by name."""
    known = list(METHODS)
    names = {result.spec.method for result in results}
    return sorted(names, key=lambda name: (known.index(name) if name in known else len(known), name))


def scored_split(results: Sequence[RunResult]) -> str:
    """The split that figures show: test, or validation where the files at hand hold no test."""
    return "test" if any(score.split == "test" for result in results for score in result.scores) else "val"


def paper_table() -> pd.DataFrame:
    """RMSE as printed in the paper: dataset, order, method, output, split, rmse."""
    return _reference("paper_tables.csv")


def released_table() -> pd.DataFrame:
    """RMSE of the models that the paper's authors released, mean over outputs: quartiles over ten seeds."""
    return _reference("released_models.csv")


def _reference(name: str) -> pd.DataFrame:
    with (resources.files("nnss_cli.report") / name).open(encoding="utf-8") as stream:
        return pd.read_csv(stream)
