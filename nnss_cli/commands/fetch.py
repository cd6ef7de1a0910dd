"""`nnss fetch`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands.options import DatasetNames, Force, Mirror, Offline
from nnss_cli.errors import InputError


def command(
    datasets: DatasetNames = None,
    everything: Annotated[bool, typer.Option("--all", help="Fetch every dataset.")] = False,
    show: Annotated[bool, typer.Option("--list", help="List the datasets and whether they are here.")] = False,
    file: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="FILE", help="Take a file, zip or folder that you have instead of fetching one."
        ),
    ] = None,
    mirror: Mirror = None,
    offline: Offline = False,
    force: Force = False,
) -> None:
    """Fetch benchmark records into the cache (NNSS_DATA_DIR, else the platform's cache folder)."""
    from nnss_cli.commands.display import DownloadProgress, console, print_rows
    from nnss_cli.commands.events import emit
    from nnss_cli.datasets.catalog import BENCHMARKS, benchmark
    from nnss_cli.datasets.download import cache_folder, fetch, install, is_cached
    from nnss_cli.report.cells import Cell

    if show:
        entries = list(BENCHMARKS.all_usable().values())
        rows = [
            {
                "dataset": entry.name,
                "what": entry.title,
                "here": "built in" if not entry.sources else "yes" if is_cached(entry) else "no",
                "orders": Cell(
                    " ".join(map(str, entry.orders)), {"orders": list(entry.orders), "cite": entry.citation}
                ),
            }
            for entry in entries
        ]
        print_rows(rows, f"Datasets (cache: {cache_folder()})", text_columns=3)
        for entry in entries:
            console.print(f"Cite for {entry.name}: {entry.citation}", soft_wrap=True, highlight=False)
        return
    names = list(BENCHMARKS.all_usable()) if everything else list(datasets or [])
    if not names:
        raise InputError(f"expected a dataset ({', '.join(BENCHMARKS)}), --all or --list, found none of them")
    entries = [benchmark(name) for name in names]
    if file is not None:
        if len(entries) != 1:
            raise InputError(
                f"--from: expected one dataset, which the file is of, found {len(entries)}: name exactly one"
            )
        path = install(entries[0], file)
        emit("end", dataset=entries[0].name, files=[str(path)])
        console.print(f"{entries[0].name}: {path}", soft_wrap=True, highlight=False)
        return
    failures = []
    for entry in entries:
        if not entry.sources:
            console.print(f"{entry.name}: simulated, nothing to fetch", highlight=False)
            continue
        try:
            path = fetch(entry, mirror=mirror, offline=offline, force=force, progress=DownloadProgress)
            emit("end", dataset=entry.name, files=[str(path)])
            console.print(f"{entry.name}: {path}", soft_wrap=True, highlight=False)
        except InputError as error:  # the others may still be had
            failures.append(str(error))
    if failures:
        raise InputError("; ".join(failures))
