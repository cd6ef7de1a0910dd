"""`nnss simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands import options as opt


def command(
    model: opt.ModelFolder,
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="File with a column for each input and output, by the model's names.")
    ],
    out: opt.Predicted = None,
    plot: Annotated[bool, typer.Option("--plot", help="Draw them beside it, as .png.")] = False,
    start: Annotated[
        str,
        typer.Option(
            "--start", metavar="outputs|rest", help="From the file's first outputs, or at rest under its first input."
        ),
    ] = "outputs",
    interval: opt.Interval = None,
    interval_by: opt.IntervalBy = None,
    data: opt.FittedOn = None,
    states: Annotated[bool, typer.Option("--states", help="Write the states, too.")] = False,
    time: opt.FileTime = None,
    Ts: opt.FileTs = None,
    sheet: opt.FileSheet = None,
    force: opt.Force = False,
) -> None:
    """Simulate the inputs of a file freely, and compare with its outputs where they are there.

    The first outputs tell the initial state, as many as the model's init window has; the rest may be empty. Inputs and
    simulated outputs that leave the range of the training records by more than a hundredth of it are told.
    """
    from nnss_cli.commands.display import console, print_rows, tell_files
    from nnss_cli.commands.parameters import refuse_without
    from nnss_cli.errors import InputError
    from nnss_cli.files import places, require_writable, write_text
    from nnss_cli.trained import load, read_record
    from nnss_cli.trained.simulate import beyond_training, simulate_file, simulated_table

    if interval is None:
        refuse_without("--interval", {"--interval-by": interval_by, "--data": data})
    trained = load(model)
    found = simulate_file(trained, file, start, time=time, Ts=Ts, sheet=sheet)
    written = places(out, "predicted.csv", *[".png"] * plot, force=force, read=(file, data))
    limits = None
    if interval is not None:
        from nnss_cli.validation.trained import simulation_limits

        given = None if data is None else read_record(trained, data, Ts=Ts, sheet=sheet)
        limits = simulation_limits(trained, found, interval, interval_by or "residuals", given)
    require_writable(written[0].parent)
    write_text(written[0], simulated_table(trained, found, states, limits.pair if limits else None))
    for note in trained.origin.notes if trained.origin else ():
        console.print(f"Note on the training: {note}", soft_wrap=True, highlight=False)
    if found.scores:
        from nnss_cli.report.simulation import error_rows
        from nnss_cli.report.tables import SIGMA_AND_FIT

        print_rows(error_rows(found.scores, trained.channels), f"{file.name}: {trained.label}", text_columns=1)
        console.print(SIGMA_AND_FIT, highlight=False)
    if not found.from_rest or found.measured is not None:
        from nnss_cli.report.simulation import missing_lines

        for line in missing_lines(found.measured, trained.channels, 0 if found.from_rest else trained.init_window):
            console.print(line, soft_wrap=True, highlight=False)
    try:
        beyond = beyond_training(trained.records().get("train", ()), trained.channels, found.u, found.y)
    except InputError as error:  # a simulation needs no records
        beyond, unknown = (), f"Note: whether signals leave the range of the training records is not known: {error}"
        console.print(unknown, soft_wrap=True, highlight=False)
    if beyond:
        from nnss_cli.report.simulation import beyond_rows

        print_rows(beyond_rows(beyond), f"{file.name}: beyond the training records no data speak for the model", 1)
    if limits is not None:
        calibrated = "The band is that of simulations from measured outputs; it holds where the plant was at rest."
        for line in (*limits.told(trained.channels), *[calibrated] * found.from_rest):
            console.print(line, soft_wrap=True, highlight=False)
    if plot:
        from nnss_cli.report.figures import save_figure
        from nnss_cli.report.simulation import draw_simulated

        figure = draw_simulated(
            found.seconds(trained.Ts), found.u, found.y, found.measured, trained.channels, trained.label,
            band=(*limits.pair, limits.name) if limits else None,
        )  # fmt: skip
        save_figure(figure, written[1])
    tell_files(written)
