"""What was tried before a model was chosen: the candidates that a run keeps, with the errors that judged them."""

from __future__ import annotations

from collections.abc import Sequence

from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.report.html.curves import history_of
from nnss_cli.report.tables import number

JUDGED_BY = {"val_rmse": "validation", "block_rmse": "blocks"}
"""What stands before a comma and a candidate's name in the history → what its error is over."""
TAKEN = " taken: "
"""Between the name of what was taken and why, in the remarks."""


def candidate_rows(store: Store, results: Sequence[RunResult]) -> list[dict[str, str]]:
    """A row for each run that tried more than one candidate: RMSE/σ of each, over what, and which was taken."""
    found: list[tuple[RunResult, str, dict[str, float]]] = []
    for result in results:
        if result.epochs:
            history = history_of(store, result)
            for prefix, over in JUDGED_BY.items():
                own = {name.partition(", ")[2]: e[0] for name, e in history.items() if name.startswith(f"{prefix}, ")}
                if len(own) > 1:
                    found.append((result, over, own))
    names = dict.fromkeys(name for *_, tried in found for name in tried)
    rows = []
    for result, over, tried in sorted(found, key=lambda one: (one[0].spec.order, one[0].spec.method, one[0].spec.seed)):
        taken = [remark.partition(TAKEN)[0] for remark in result.remarks if TAKEN in remark]
        rows.append(
            {
                "order": str(result.spec.order), "method": result.spec.method, "seed": str(result.spec.seed),
                "over": over,
                **{name: number(tried.get(name)) for name in names},
                "taken": ", then ".join(taken) or next(iter(tried)),
            }
        )  # fmt: skip
    return rows
