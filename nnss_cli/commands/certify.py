"""`nnss certify`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer


def command(
    model: Annotated[Path, typer.Argument(help="Folder of a run, as `nnss train` prints it.", metavar="MODEL")],
    data: Annotated[
        Path | None,
        typer.Option(
            "--data", metavar="FILE", help="File with a column per input and output, instead of the run's own records."
        ),
    ] = None,
    steps: Annotated[int, typer.Option("--steps", metavar="N", help="Samples of each stress run.", min=1)] = 1_000_000,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Examine a model's stability: spectral radii, certified bounds, a Lyapunov search, long stress runs.

    All values are in the model's normalised units. Exit code 1 when a promised bound is broken.
    """
    from nnss_cli.commands.display import console, print_rows
    from nnss_cli.datasets.experiments import record_of_channels
    from nnss_cli.experiment.certify import certify
    from nnss_cli.experiment.store import records_of
    from nnss_cli.methods import load_model
    from nnss_cli.report.tables import certificate_rows, stress_rows

    loaded = load_model(model)
    if data is None:
        splits = records_of(model, loaded.Ts)
    else:
        splits = {"data": (record_of_channels(data, loaded.channels, loaded.Ts),)}
    found = certify(loaded, splits, steps)
    if as_json:
        typer.echo(json.dumps(found.to_json(), indent=2, ensure_ascii=False))
    else:
        print_rows(certificate_rows(found), f"{model}: stability", text_columns=1)
        print_rows(stress_rows(found), f"Stress runs ({found.stress_seconds:.1f} s)", text_columns=1)
        for line in found.broken:
            console.print(f"BROKEN: {line}", soft_wrap=True, highlight=False)
        if not found.broken:
            console.print(
                "No promised bound is broken." if found.gamma < float("inf") else "This model promises nothing."
            )
    if found.broken:
        raise typer.Exit(1)
