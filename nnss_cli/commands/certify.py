"""`nnss certify`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands.options import ModelFolder


def command(
    model: ModelFolder,
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
    from nnss_cli.experiment.certificate import certify
    from nnss_cli.experiment.store import records_of
    from nnss_cli.report.tables import certificate_rows, stress_rows
    from nnss_cli.trained import load, read_record

    trained = load(model)
    assert trained.folder is not None
    if data is None:
        splits = records_of(trained.folder, trained.Ts)
    else:
        splits = {"data": (read_record(trained, data),)}
    found = certify(trained.model, splits, steps)
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
