"""`nnss predict`."""

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
    horizon: Annotated[int, typer.Option("--horizon", metavar="N", help="Steps ahead.")] = 1,
    guard: Annotated[
        bool,
        typer.Option(
            "--guard",
            help="Weigh the prediction against persistence by the errors seen up to then; at first it is the model's.",
        ),
    ] = False,
    interval: opt.Interval = None,
    interval_by: opt.IntervalBy = None,
    data: opt.FittedOn = None,
    out: opt.Predicted = None,
    plot: Annotated[bool, typer.Option("--plot", help="Draw them beside it, as .png.")] = False,
    time: opt.FileTime = None,
    Ts: opt.FileTs = None,
    sheet: opt.FileSheet = None,
    force: opt.Force = False,
) -> None:
    """Predict the outputs of a file some steps ahead, from its inputs and its outputs up to then.

    The model is corrected by what it did not foresee, x(k+1) = f(x(k), u(k)) + K (y(k) - y_predicted(k)). K is
    estimated each time, on the run's training record, and chosen on its validation record. Beside the errors stand
    those of persistence, y(k) = y(k - N), and those with --guard, given or not.
    Signals that leave the range of the training records by more than a hundredth of it are told.
    """
    from nnss_cli.commands.display import console, print_rows, tell_files
    from nnss_cli.commands.parameters import refuse_without
    from nnss_cli.files import places, require_writable, write_text
    from nnss_cli.report.simulation import beyond_rows
    from nnss_cli.report.validation import gain_lines, guard_lines, step_rows
    from nnss_cli.trained import load, read_record, read_timed
    from nnss_cli.trained.simulate import beyond_training, output_table
    from nnss_cli.validation.predict import predict_record
    from nnss_cli.validation.trained import forecaster

    if interval is None:
        refuse_without("--interval", {"--interval-by": interval_by})
    trained = load(model)
    record, t = read_timed(trained, file, time=time, Ts=Ts, sheet=sheet)
    given = None if data is None else read_record(trained, data, Ts=Ts, sheet=sheet)
    written = places(out, "predicted.csv", *[".png"] * plot, force=force, read=(file, data))
    predictor = forecaster(trained, given, guard)
    found = predict_record(predictor, record, horizon, interval, interval_by or "residuals")
    require_writable(written[0].parent)
    write_text(written[0], output_table(trained, found.y, found.limits.pair if found.limits else None, t=t))
    print_rows(step_rows(found.steps, trained.channels), f"{file.name}: {trained.label}", text_columns=1)
    if beyond := beyond_training(predictor.own.train, trained.channels, record.u, record.y):
        print_rows(beyond_rows(beyond), f"{file.name}: beyond the training records no data speak for the model", 1)
    lines = gain_lines(predictor.gains) + (
        guard_lines(found.weight, trained.channels) if found.weight is not None else []
    )
    for line in lines + (found.limits.told(trained.channels) if found.limits else []):
        console.print(line, soft_wrap=True, highlight=False)
    if plot:
        from nnss_cli.report.figures import save_figure
        from nnss_cli.report.simulation import draw_simulated
        from nnss_cli.validation.gain import ALONE

        # a reader of the figure alone must not take a regression's work for the model's
        without = "increments alone, without " * all(gain.origin == ALONE for gain in predictor.gains)
        figure = draw_simulated(
            found.seconds(trained.Ts), record.u, found.y, record.y, trained.channels, without + trained.label,
            f"{horizon} step{'s' * (horizon != 1)} ahead{', guarded' * guard}",
            (*found.limits.pair, found.limits.name) if found.limits else None,
        )  # fmt: skip
        save_figure(figure, written[1])
    tell_files(written)
