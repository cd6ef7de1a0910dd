"""`nnss inspect`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from nnss_cli.commands import options as opt
from nnss_cli.commands.record_options import as_arguments, with_record_options


@with_record_options
def command(
    files: Annotated[
        list[str], typer.Argument(metavar="FILE...", help="A description (.toml), or a file for each experiment.")
    ],
    write: Annotated[
        Path | None,
        typer.Option("--write", metavar="FILE.toml", help="Write a description, to be edited and compared."),
    ] = None,
    out: opt.Out = Path("results"),
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables, and write no figure.")] = False,
    force: opt.Force = False,
    own: dict[str, Any] | None = None,
) -> None:
    """Say what is in a record: length, gaps, excitation, delays, coherence, a first guess of the order, a split.

    Columns whose roles are not given are guessed by their names; it is said how, and marked in what --write writes.
    A split, orders and a window that are not given are recommended.
    Asked for --missing, --resample, --downsample or --detrend linear, it shows the record as training takes it then.
    """
    from nnss_cli.commands.display import console, print_rows
    from nnss_cli.errors import InputError
    from nnss_cli.experiment.inspection_files import examine_files, suggested
    from nnss_cli.experiment.inspection_order import HOW_GUESSED
    from nnss_cli.files import refuse_to_replace, require_writable, write_text
    from nnss_cli.report.figures import save_figure
    from nnss_cli.report.inspection import (
        channel_rows,
        draw_inspection,
        grid_rows,
        input_rows,
        order_rows,
        output_rows,
        record_rows,
        response_rows,
    )

    if write is not None and write.exists() and not force:
        raise InputError(f"'{write}' exists already: name another file with --write, or --force to replace it")
    if write is not None:
        refuse_to_replace(write, [Path(name) for name in files], "--write")
    seen = examine_files(files, own or {})
    description = None if write is None else suggested(seen, files, own or {}, write)
    if as_json:
        typer.echo(json.dumps(seen.found.as_dict() | {"guessed": list(seen.guesses)}, indent=2, ensure_ascii=False))
    else:
        title = ", ".join(Path(name).name for name in files)
        for rows, what, text in (
            (record_rows(seen.found), f"{title}: the record", 1), (channel_rows(seen.found), "Columns", 4),
            (grid_rows(seen.found), "Their grid, stops, spikes and drift", 1),
            (input_rows(seen.found), "What the inputs excite", 1), (response_rows(seen.found), "Delays", 2),
            (output_rows(seen.found), "What linear models leave unexplained", 1),
            (order_rows(seen.found), f"A first guess of the linear order ({HOW_GUESSED})", 1),
        ):  # fmt: skip
            if rows:
                print_rows(rows, what, text_columns=text)
        for line in (*seen.guesses, *seen.found.used, *seen.found.remarks):
            console.print(f"- {line}", soft_wrap=True, highlight=False, markup=False)
        folder = out / seen.name
        require_writable(folder)
        figure = draw_inspection(seen.found, title)
        save_figure(figure, folder / "inspection.png")
        console.print(str(folder / "inspection.png"), soft_wrap=True, highlight=False)
    if write is not None and description is not None:
        write_text(write, description)
        if not as_json:
            console.print(f"{write}: compare it with 'nnss compare {as_arguments([str(write)], {})}'", soft_wrap=True)
