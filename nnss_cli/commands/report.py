"""`nnss report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands.options import Out


def command(
    out: Out = Path("results"),
    times: Annotated[
        bool,
        typer.Option(
            "--times/--no-times", help="Wall times in rmse.csv; without them two reproductions give equal files."
        ),
    ] = True,
) -> None:
    """Rebuild every table and figure from the runs on disk, without training, and write report.md."""
    from nnss_cli.commands.display import console
    from nnss_cli.files import require_writable
    from nnss_cli.report.build import write_report

    if out.is_dir():
        require_writable(out)
    console.print(str(write_report(out, times)), soft_wrap=True, highlight=False)
