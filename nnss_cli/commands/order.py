"""`nnss order`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from nnss_cli.commands import options as opt
from nnss_cli.commands.record_options import with_record_options
from nnss_cli.errors import InputError


@with_record_options
def command(
    dataset: opt.DatasetName,
    largest: Annotated[int, typer.Option("--max-order", metavar="N", help="Largest order to look at.")] = 10,
    horizon: opt.Horizon = None,
    protocol: opt.ProtocolName = "",
    out: opt.Out = Path("results"),
    mirror: opt.Mirror = None,
    offline: opt.Offline = False,
    own: dict[str, Any] | None = None,
) -> None:
    """Show what order the data call for: Hankel singular values and validation errors, and a suggestion."""
    from nnss_cli.commands.data import ready
    from nnss_cli.commands.display import console, print_rows, tell_files
    from nnss_cli.experiment.order import order_table, suggest_order
    from nnss_cli.experiment.store import Store
    from nnss_cli.files import require_writable
    from nnss_cli.methods import chosen_horizon
    from nnss_cli.report.build import write_orders
    from nnss_cli.report.tables import order_rows

    if largest < 1:
        raise InputError(f"--max-order: expected at least 1, found {largest}")
    ready_data = ready(dataset, protocol, mirror, offline, own or {})
    data = ready_data.dataset
    folder = Store(out, data.name, data.protocol).folder
    overrides = ready_data.settings | ({} if horizon is None else {"horizon": horizon})
    chosen_by = chosen_horizon(data.fitting, overrides)
    rows = order_table(data.fitting, largest, chosen_by)
    chosen = suggest_order(rows)
    require_writable(folder)
    measure = "RMSE/σ" if data.fitting.output_count == 1 else "RMS over outputs of RMSE/σ"
    title = f"{data.heading}, protocol {data.protocol}: N4SID by order ({measure}, horizon {chosen_by})"
    print_rows(order_rows(rows, chosen), title, text_columns=1)
    if len(rows) < largest:
        console.print(f"Orders up to {len(rows)}: the model behind the Hankel singular values has no more states.")
    console.print(f"Suggested order: {chosen}, the lowest within 5 % of the best validation error.", highlight=False)
    written = write_orders(rows, chosen, folder, measure, title)
    tell_files(written, suggested=chosen)
