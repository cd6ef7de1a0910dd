"""From runs to numbers: the long table, its summary over seeds, the best runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache
from importlib import resources

import pandas as pd

from nnss_cli.datasets.record import FITTED_ON
from nnss_cli.datasets.units import has_unit
from nnss_cli.experiment.run import RunResult
from nnss_cli.methods import METHODS
from nnss_cli.report.statistics import quantile
from nnss_cli.report.style import Axis

MEAN = "mean"  # name of the mean over outputs in the output column
NORMALISED = "mean of RMSE/σ"
UNITS_MIXED = "mean over outputs, units mixed"

COLUMNS = [
    "dataset", "protocol", "method", "order", "seed", "split", "output", "channel", "unit", "rmse", "nrmse",
    "fit_percent", "status", "reason", "epochs", "fit_seconds",
]  # fmt: skip


def long_table(results: Sequence[RunResult]) -> pd.DataFrame:
    """One row per run, split and output, which has its place, name and unit; a run not ok is one with its reason."""
    rows = []
    for result in results:
        spec = result.spec
        run = {
            "dataset": spec.dataset, "protocol": spec.protocol, "method": spec.method, "order": spec.order,
            "seed": spec.seed, "status": result.status, "reason": result.reason, "epochs": result.epochs,
            "fit_seconds": result.fit_seconds,
        }  # fmt: skip
        outputs = places(result)
        for score in result.scores:
            rows.append(run | vars(score) | _named(outputs[score.output]))
        if not result.scores:
            rows.append(run | {"split": "", "output": ""})
    return pd.DataFrame(rows, columns=COLUMNS)


def titled_by(results: Sequence[RunResult]) -> str:
    """The dataset's title for heads: that of the run that was finished last; "" for none."""
    return max(results, key=lambda result: result.provenance.get("finished", "")).title


def axes(result: RunResult, kind: str) -> list[Axis]:
    """Names and units of a run's "input"s or "output"s."""
    channels = result.channels
    return [Axis(name, unit) for name, unit in zip(channels[f"{kind}s"], channels[f"{kind}_units"], strict=True)]


def places(result: RunResult) -> dict[str, Axis]:
    """y1, y2, …, as scores have it, → the output's own name and unit."""
    return {f"y{i + 1}": axis for i, axis in enumerate(axes(result, "output"))}


def _named(axis: Axis) -> dict[str, str]:
    return {"channel": axis.name, "unit": axis.unit}


def mean_name(results: Sequence[RunResult]) -> str:
    """What the mean over outputs of the RMSE in physical units is called; "" where there is none to show.

    Of several units it says little: the output of the largest numbers rules it. It is there where all have one unit,
    and where errors to compare with are known as such means.
    """
    first, outputs = results[0].spec, axes(results[0], "output")
    units = {axis.unit for axis in outputs}
    if len(outputs) == 1:
        return ""
    if len(units) == 1 and has_unit(outputs[0].unit):
        return str(Axis("mean over outputs", *units))
    return UNITS_MIXED if first.protocol == "paper" and first.dataset in _known_as_means() else ""


@cache
def _known_as_means() -> frozenset[str]:
    printed = paper_table()
    return frozenset([*printed.loc[printed["output"] == MEAN, "dataset"], *released_table()["dataset"]])


def summary(results: Sequence[RunResult]) -> pd.DataFrame:
    """Statistics of the RMSE over seeds, by order, method, split and output.

    Runs without a result enter medians and quartiles as ∞: `runs` counts all, `ok` those that have one; the mean
    is nan unless all have. Records of several outputs get a further output "mean of RMSE/σ", on which methods are
    ranked, and, where `mean_name` has a name for it, "mean" (physical units, as the released models are scored). `fit`
    is the median of the fit [%]. `best` is the run that `best_run` picks on validation, on every split.
    """
    scored = long_table([result for result in results if result.status == "ok"])
    if scored.empty:
        return pd.DataFrame()
    if scored["output"].nunique() > 1:
        keys = ["method", "order", "seed", "split"]
        means = scored.groupby(keys, as_index=False)[["rmse", "nrmse", "fit_percent"]].mean()
        physical = [means.assign(output=MEAN)] if mean_name(results) else []
        scored = pd.concat([scored, *physical, means.assign(output=NORMALISED, rmse=means["nrmse"])], ignore_index=True)
    runs = {key: list(own) for key, own in runs_by_method(results).items()}
    outputs, rows = places(results[0]), []
    for (order, method, split, output), own in scored.groupby(["order", "method", "split", "output"]):
        everything = runs[(method, order)]
        failed = sum(run.status != "ok" for run in everything)
        values = [*own["rmse"], *[math.inf] * failed]
        best = best_run(everything)
        assert best is not None  # the row exists, so an ok run does
        rows.append(
            {
                "order": order, "method": method, "split": split, "output": output,
                **_named(outputs.get(str(output), Axis("", ""))),
                "runs": len(everything), "ok": len(everything) - failed,
                "mean": float(own["rmse"].mean()) if not failed else math.nan,
                "median": quantile(values, 0.5), "fit": -quantile([*-own["fit_percent"], *[math.inf] * failed], 0.5),
                "min": min(values), "q1": quantile(values, 0.25),
                "q3": quantile(values, 0.75), "max": max(values),
                "best": float(own.loc[own["seed"] == best.spec.seed, "rmse"].iloc[0]), "best_seed": best.spec.seed,
            }
        )  # fmt: skip
    return pd.DataFrame(rows)


def runs_by_method(results: Sequence[RunResult]) -> dict[tuple[str, int], list[RunResult]]:
    """The runs of each method and order, failed ones too, in the order of orders and methods."""
    found: dict[tuple[str, int], list[RunResult]] = {}
    for result in results:
        found.setdefault((result.spec.method, result.spec.order), []).append(result)
    return dict(sorted(found.items(), key=lambda item: (item[0][1], item[0][0])))


def groups(results: Sequence[RunResult]) -> list[tuple[str, int, list[RunResult]]]:
    """Method, order and runs, failed ones too: by order, then as `methods_of` has the methods."""
    position = methods_of(results)
    found = [(method, order, own) for (method, order), own in runs_by_method(results).items()]
    return sorted(found, key=lambda group: (group[1], position.index(group[0])))


def split_error(result: RunResult, split: str) -> float:
    """Mean over outputs of RMSE/σ on a split: what runs are ranked by. ∞ for a run without a result there."""
    errors = [score.nrmse for score in result.scores if score.split == split]
    return sum(errors) / len(errors) if errors else math.inf


def validation_error(result: RunResult) -> float:
    """`split_error` on validation: what choices are made on."""
    return split_error(result, "val")


def test_error(result: RunResult) -> float:
    """Mean of `split_error` over the test sets; ∞ where there is none."""
    errors = [split_error(result, name) for name in test_sets([result])]
    return sum(errors) / len(errors) if errors else math.inf


def physical_error(result: RunResult, split: str) -> float:
    """Mean over outputs of the RMSE in physical units, as the released models are scored; ∞ without a result."""
    errors = [score.rmse for score in result.scores if score.split == split]
    return sum(errors) / len(errors) if errors else math.inf


def output_error(result: RunResult, split: str, output: str) -> float:
    """RMSE of an output (y1, y2, …), or a mean over outputs (`MEAN`, `NORMALISED`); ∞ for a run without a result."""
    if output == MEAN:
        return physical_error(result, split)
    if output == NORMALISED:
        return split_error(result, split)
    return next((s.rmse for s in result.scores if (s.split, s.output) == (split, output)), math.inf)


def shown_error(result: RunResult, split: str) -> float:
    """The one figure of a run in short tables: RMSE in physical units of a single output, else `split_error`."""
    return split_error(result, split) if several_outputs([result]) else physical_error(result, split)


def several_outputs(results: Sequence[RunResult]) -> bool:
    """Whether the records have more than one output."""
    return any(len(result.channels["outputs"]) > 1 for result in results)


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


def is_combination(method: str) -> bool:
    """Whether a method is made of another one's runs, and so no independent competitor."""
    return method in METHODS and bool(METHODS[method].members)


def splits_of(results: Sequence[RunResult]) -> list[str]:
    """The splits that have scores: train, validation, then the test sets in their order."""
    found = dict.fromkeys(score.split for result in results for score in result.scores)
    return [*(split for split in FITTED_ON if split in found), *(split for split in found if split not in FITTED_ON)]


def test_sets(results: Sequence[RunResult]) -> list[str]:
    """The names of the test sets that have scores."""
    return [split for split in splits_of(results) if split not in FITTED_ON]


def scored_splits(results: Sequence[RunResult]) -> list[str]:
    """The splits that figures show: the test sets, or validation where the files at hand hold no test."""
    return test_sets(results) or ["val"]


def split_name(split: str) -> str:
    """A split in words; a test set whose name begins with "test" says itself that it is one."""
    return {"train": "train", "val": "validation"}.get(split, split if split.startswith("test") else f"test {split}")


def paper_table() -> pd.DataFrame:
    """RMSE as printed in the paper: dataset, order, method, output, split, rmse."""
    return _reference("paper_tables.csv")


def released_table() -> pd.DataFrame:
    """RMSE of the models that the paper's authors released, mean over outputs: quartiles over ten seeds."""
    return _reference("released_models.csv")


def published_table() -> pd.DataFrame:
    """Errors published for the official benchmarks: dataset, test_set, unit, method, rmse, source."""
    return _reference("published_benchmarks.csv")


def _reference(name: str) -> pd.DataFrame:
    with (resources.files("nnss_cli.report") / name).open(encoding="utf-8") as stream:
        return pd.read_csv(stream)
