"""`nnss report`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands.options import Columns, Formats, Out


def command(
    out: Out = Path("results"),
    times: Annotated[
        bool,
        typer.Option(
            "--times/--no-times", help="Wall times in rmse.csv; without them two reproductions give equal files."
        ),
    ] = True,
    formats: Formats = None,
    columns: Columns = None,
    html: Annotated[
        bool, typer.Option("--html", help="Write report.html too: one page, to be opened without network.")
    ] = False,
) -> None:
    """Rebuild every table and figure from the runs on disk, without training, and write report.md.

    A run whose files are damaged or disagree is named and left out: exit code 1.
    """
    from nnss_cli.commands.display import tell_files, tell_left_out
    from nnss_cli.files import require_writable
    from nnss_cli.report.build import write_report
    from nnss_cli.report.style import Look

    look = Look(tuple(formats or ()), columns)

    if out.is_dir():
        require_writable(out)
    left_out: list[str] = []
    try:
        written = [write_report(out, times, left_out.append, look)]
        if html:
            from nnss_cli.report.html.page import write_html

            written.append(write_html(out))
        tell_files(written, left_out=left_out)
    finally:
        tell_left_out(left_out)
    if left_out:
        raise typer.Exit(1)
