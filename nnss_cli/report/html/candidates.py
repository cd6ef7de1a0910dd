"""What was tried before a model was chosen: the candidates that a run keeps, with their validation errors."""

from __future__ import annotations

from collections.abc import Sequence

from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.report.html.curves import history_of
from nnss_cli.report.tables import number

PREFIX = "val_rmse, "
"""Before a candidate's name in the history."""
TAKEN = " taken: "
"""Between the name of what was taken and why, in the remarks."""


def candidate_rows(store: Store, results: Sequence[RunResult]) -> list[dict[str, str]]:
    """A row for each run that tried more than one candidate: validation RMSE/σ of each, and which was taken."""
    found: list[tuple[RunResult, dict[str, float]]] = []
    for result in results:
        if result.epochs:
            history = history_of(store, result)
            tried = {name.removeprefix(PREFIX): own[0] for name, own in history.items() if name.startswith(PREFIX)}
            if len(tried) > 1:
                found.append((result, tried))
    names = dict.fromkeys(name for _, tried in found for name in tried)
    rows = []
    for result, tried in sorted(found, key=lambda one: (one[0].spec.order, one[0].spec.method, one[0].spec.seed)):
        taken = [remark.partition(TAKEN)[0] for remark in result.remarks if TAKEN in remark]
        rows.append(
            {
                "order": str(result.spec.order), "method": result.spec.method, "seed": str(result.spec.seed),
                **{name: number(tried.get(name)) for name in names},
                "taken": ", then ".join(taken) or next(iter(tried)),
            }
        )  # fmt: skip
    return rows
