"""`nnss train`."""

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
    order: Annotated[int, typer.Option("--order", metavar="N", help="Number of states n.")],
    seed: Annotated[int, typer.Option("--seed", metavar="N", help="Seed of weights and shuffling.", min=0)] = 0,
    method: Annotated[str, typer.Option("--method", metavar="NAME", help="Method to train.")] = "nnss",
    protocol: opt.ProtocolName = "",
    out: opt.Out = Path("results"),
    mirror: opt.Mirror = None,
    offline: opt.Offline = False,
    force: opt.Force = False,
    changes: dict[str, Any] | None = None,
    own: dict[str, Any] | None = None,
) -> None:
    """Train one model, keep it under results/ and print its errors and remarks. Exit code 1 when it has no result."""
    from nnss_cli.commands.data import ready
    from nnss_cli.commands.display import RunProgress, console, print_rows, tell_left_out
    from nnss_cli.commands.events import emit
    from nnss_cli.experiment.store import Store
    from nnss_cli.experiment.sweep import plan, sweep
    from nnss_cli.files import require_writable
    from nnss_cli.methods import select
    from nnss_cli.report.tables import SIGMA_AND_FIT, score_rows

    methods = select([method])
    ready_data = ready(dataset, protocol, mirror, offline, own or {})
    data = ready_data.dataset
    store = Store(out, data.name, data.protocol)
    todo = plan(store, data, methods, [order], [seed], ready_data.settings | (changes or {}), force)
    require_writable(store.folder)
    with RunProgress(todo.todo) as progress:
        sweep(todo.todo, data, store, 1, progress.on_event, progress.on_result)
    kept_seed = seed if methods[0].seeded else 0
    asked = [
        r for r in store.read().results if (r.spec.method, r.spec.order, r.spec.seed) == (method, order, kept_seed)
    ]
    tell_left_out(todo.faults.values())
    if not asked:
        raise typer.Exit(1)
    (result,) = asked
    emit(
        "end", run=result.spec.name, status=result.status, reason=result.reason, done_before=bool(todo.done),
        scores=[vars(score) for score in result.scores], folder=str(store.run_folder(result.spec)),
    )  # fmt: skip
    if result.status != "ok":
        typer.echo(f"nnss: {result.spec.label} {result.status}: {result.reason}", err=True)
        raise typer.Exit(1)
    if todo.done:
        console.print("This run was finished already: --force trains it again.")
    for note in data.notes:
        console.print(f"Note: {note}", soft_wrap=True, highlight=False)
    print_rows(
        score_rows(result),
        f"{data.heading}, protocol {data.protocol}, {method}, order {order}, seed {result.spec.seed}",
    )
    for remark in result.remarks:
        console.print(remark, soft_wrap=True, highlight=False, markup=False)
    console.print(SIGMA_AND_FIT, highlight=False)
    console.print(f"Model: {store.run_folder(result.spec)}", soft_wrap=True, highlight=False)
