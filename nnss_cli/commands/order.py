"""`nnss order`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands import options as opt
from nnss_cli.errors import InputError


def command(
    dataset: opt.DatasetName,
    largest: Annotated[int, typer.Option("--max-order", metavar="N", help="Largest order to look at.")] = 10,
    protocol: opt.ProtocolName = "",
    out: opt.Out = Path("results"),
    mirror: opt.Mirror = None,
    offline: opt.Offline = False,
) -> None:
    """Show what order the data call for: Hankel singular values and validation errors, and a suggestion."""
    from nnss_cli.commands.data import ready_dataset
    from nnss_cli.commands.display import console, print_rows
    from nnss_cli.experiment.order import order_table, suggest_order
    from nnss_cli.experiment.store import Store
    from nnss_cli.files import require_writable
    from nnss_cli.report.build import write_orders
    from nnss_cli.report.tables import order_rows

    if largest < 1:
        raise InputError(f"--max-order: expected at least 1, found {largest}")
    data = ready_dataset(dataset, protocol, mirror, offline)
    folder = Store(out, dataset, data.protocol).folder
    rows = order_table(data.fitting, largest)
    chosen = suggest_order(rows)
    require_writable(folder)
    title = f"{dataset}, protocol {data.protocol}: N4SID by order (RMSE/σ)"
    print_rows(order_rows(rows, chosen), title, text_columns=1)
    console.print(f"Suggested order: {chosen}, the lowest within 5 % of the best validation error.", highlight=False)
    for path in write_orders(rows, chosen, folder, title):
        console.print(str(path), soft_wrap=True, highlight=False)
