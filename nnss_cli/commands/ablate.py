"""`nnss ablate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nnss_cli.commands import options as opt
from nnss_cli.commands.record_options import with_record_options


@with_record_options
@opt.with_fit_options
def command(
    dataset: opt.DatasetName,
    study: Annotated[
        str,
        typer.Option(
            "--study",
            metavar="recipe|class|stability",
            help="Which switches: the recipe's, of the model class, or of stability.",
        ),
    ] = "recipe",
    orders: opt.Orders = None,
    seeds: opt.Seeds = 10,
    protocol: opt.ProtocolName = "",
    out: opt.Out = Path("results"),
    jobs: opt.Jobs = None,
    mirror: opt.Mirror = None,
    offline: opt.Offline = False,
    changes: dict[str, Any] | None = None,
    own: dict[str, Any] | None = None,
) -> None:
    """Change one switch of NN-SS at a time: λ, start, windows, encoder, scheduling; or what makes it stable."""
    from nnss_cli.commands.data import ready
    from nnss_cli.commands.display import console, print_rows, tell_left_out
    from nnss_cli.commands.events import emit
    from nnss_cli.datasets.units import titled
    from nnss_cli.experiment.ablation import ablate
    from nnss_cli.experiment.store import Store
    from nnss_cli.files import require_writable
    from nnss_cli.report.studies import write_study
    from nnss_cli.report.tables import study_rows

    workers = opt.check_counts(seeds, jobs)
    ready_data = ready(dataset, protocol, mirror, offline, own or {})
    data = ready_data.dataset
    store = Store(out, data.name, data.protocol)
    require_writable(store.folder)

    def planned(name: str, count: int) -> None:
        emit("plan", variant=name, runs=count)
        console.print(f"{name}: {count} runs to do", highlight=False)

    found = ablate(
        store, data, study, ready_data.orders_or(orders), range(seeds), ready_data.settings | (changes or {}), workers,
        planned, lambda _: None,
        lambda result: emit("result", run=result.spec.name, status=result.status, reason=result.reason),
    )  # fmt: skip
    channels = data.fitting.channels
    unit = f"RMSE of {titled(channels.outputs[0], channels.output_units[0])}"
    what = unit if len(channels.outputs) == 1 else "mean over outputs of RMSE/σ"
    print_rows(study_rows(found), f"{data.name}, protocol {data.protocol}: {study}, {what}, median over seeds")
    left_out = [line for variant in found for line in variant.left_out]
    written = write_study(store, study, found)
    console.print(str(written), soft_wrap=True, highlight=False)
    refused = [f"{variant.name}: {variant.refused}" for variant in found if variant.refused]
    emit("end", files=[str(written)], left_out=[*refused, *left_out])
    tell_left_out([*refused, *left_out])
    if left_out:
        raise typer.Exit(1)
