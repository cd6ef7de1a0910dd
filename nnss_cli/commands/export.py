"""`nnss export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands import options as opt


def command(
    model: opt.ModelFolder,
    to: Annotated[str, typer.Option("--to", metavar="control|casadi|onnx|c|mat", help="For which tool.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the files.")],
    name: Annotated[str, typer.Option("--name", metavar="NAME", help="Of the files and functions.")] = "model",
    force: opt.Force = False,
) -> None:
    """Write a model for another tool, checked against its simulation on its test record.

    Exit code 1, and no file, where what was written computes something else.
    """
    from nnss_cli.commands.display import console, tell_files
    from nnss_cli.export import ParityError, export
    from nnss_cli.trained import load

    try:
        done = export(load(model), to, out, name, force)
    except ParityError as error:
        typer.echo(f"nnss: {error}", err=True)
        raise typer.Exit(1) from error
    for found in done.parity or [
        f"{to}: the arrays are the model's; the functions were not run, for there is no Octave"
    ]:
        console.print(str(found), soft_wrap=True, highlight=False)
    for said in filter(None, (done.left_out, done.start)):
        console.print(said, soft_wrap=True, highlight=False)
    tell_files(done.files, parity=[vars(found) for found in done.parity], left_out=done.left_out, start=done.start)
