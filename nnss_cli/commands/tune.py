"""`nnss tune`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nnss_cli.commands import options as opt
from nnss_cli.commands.record_options import as_arguments, with_record_options
from nnss_cli.errors import InputError


@with_record_options
@opt.with_fit_options
def command(
    dataset: opt.DatasetName,
    order: Annotated[int, typer.Option("--order", metavar="N", help="Number of states n.")],
    trials: Annotated[
        int, typer.Option("--trials", metavar="N", help="Recipes to try; they add to earlier ones.")
    ] = 50,
    sampler: Annotated[
        str, typer.Option("--sampler", metavar="tpe|gp", help="Parzen estimator, or Gaussian process as in the paper.")
    ] = "tpe",
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Seed of the weights and the search.", min=0)] = 0,
    protocol: opt.ProtocolName = "",
    out: opt.Out = Path("results"),
    mirror: opt.Mirror = None,
    offline: opt.Offline = False,
    changes: dict[str, Any] | None = None,
    own: dict[str, Any] | None = None,
) -> None:
    """Search widths, depths, λ, learning rate and window of NN-SS, on validation only.

    Kept in an SQLite file: the same command goes on from where it stopped. An option that is given is not searched.
    """
    from nnss_cli.commands.data import ready
    from nnss_cli.commands.display import console, print_rows
    from nnss_cli.commands.events import emit
    from nnss_cli.experiment.store import Store
    from nnss_cli.experiment.sweep import check_order
    from nnss_cli.experiment.tune import Trial, tune
    from nnss_cli.files import require_writable
    from nnss_cli.report.tables import trial_rows

    if trials < 1:
        raise InputError(f"--trials: expected at least 1, found {trials}")
    ready_data = ready(dataset, protocol, mirror, offline, own or {})
    data = ready_data.dataset
    check_order(order, data.fitting)
    folder = Store(out, data.name, data.protocol).folder
    require_writable(folder)
    storage = folder / "tune" / f"order-{order}.db"

    def tell(trial: Trial) -> None:
        emit("trial", **vars(trial))
        console.print(f"trial {trial.number}: {trial.state}, val RMSE/σ {trial.val_rmse:.4g}", highlight=False)

    found = tune(data.fitting, order, trials, sampler, seed, ready_data.settings | (changes or {}), storage, tell)
    print_rows(
        trial_rows(found[:10]),
        f"{data.name}, protocol {data.protocol}, order {order}: best of {len(found)} trials, RMSE/σ on validation",
    )
    if found[0].state == "complete":
        protocol_option = "" if protocol == "paper" else f" --protocol {data.protocol}"
        options = opt.as_command_line(found[0].settings)
        line = f"nnss train {as_arguments(dataset, own or {})} --order {order} --seed {seed}{protocol_option} {options}"
        console.print("Train the best one:", line, soft_wrap=True, highlight=False)
    emit("end", best=vars(found[0]), trials=len(found), files=[str(storage)])
    console.print(str(storage), soft_wrap=True, highlight=False)
