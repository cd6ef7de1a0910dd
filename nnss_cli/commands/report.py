"""`nnss report`."""

from __future__ import annotations

from pathlib import Path

from nnss_cli.commands.options import Out


def command(out: Out = Path("results")) -> None:
    """Rebuild every table and figure from the runs on disk, without training, and write report.md."""
    from nnss_cli.commands.display import console
    from nnss_cli.files import require_writable
    from nnss_cli.report.build import write_report

    if out.is_dir():
        require_writable(out)
    console.print(str(write_report(out)), soft_wrap=True, highlight=False)
