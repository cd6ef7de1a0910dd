"""`nnss validate`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from nnss_cli.commands import options as opt


def command(
    model: opt.ModelFolder,
    file: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FILE]",
            help="File with a column for each input and output, by the model's names; without, a test set of the run.",
            show_default=False,
        ),
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            "--split",
            metavar="NAME",
            help="Records of the run: train, val or a test set (default: the first test set, else val).",
        ),
    ] = "",
    data: opt.FittedOn = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            metavar="FILE.png",
            help="Where the figures go (default: validation-RUN.png, with a number where that is there).",
        ),
    ] = None,
    time: opt.FileTime = None,
    Ts: opt.FileTs = None,
    sheet: opt.FileSheet = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables, and write no figure.")] = False,
    force: opt.Force = False,
) -> None:
    """Put a model to the test: errors, residuals, k steps ahead, poles, linearisations; a page of figures, a verdict.

    Stated tests: residuals one step ahead are white, and independent of the inputs, each at the level of 1 %; the model
    beats persistence one step ahead, on validation so does a gain of its own; its observer is stable. Exit code 1 when
    one fails.
    """
    from nnss_cli.commands.display import console, print_rows
    from nnss_cli.commands.parameters import refuse_without
    from nnss_cli.errors import InputError
    from nnss_cli.files import places, require_writable
    from nnss_cli.report.style import FORMATS
    from nnss_cli.report.validation import gain_lines, output_rows, point_rows, residual_rows, step_rows, test_rows
    from nnss_cli.trained import load, read_record
    from nnss_cli.validation.check import validate
    from nnss_cli.validation.result import as_dict
    from nnss_cli.validation.trained import forecaster, records_to_validate

    if as_json and out is not None:
        raise InputError(f"--out: --json writes no figure, found '{out}': leave one of them out")
    if file is None:
        refuse_without("a FILE", {"--time": time})
        if data is None:
            refuse_without("a FILE or --data", {"--ts": Ts, "--sheet": sheet})
    if out is not None and out.suffix.removeprefix(".") not in FORMATS:
        raise InputError(
            f"--out: expected a figure, such as {out.stem}.{', .'.join(FORMATS)}, found '{out}': rename it"
        )
    if file is not None and split:
        raise InputError("expected a FILE or --split, found both: leave one out")
    trained = load(model)
    if file is None:
        name, records = records_to_validate(trained, split)
    else:
        name, records = file.name, (read_record(trained, file, time=time, Ts=Ts, sheet=sheet),)
    given = None if data is None else read_record(trained, data, Ts=Ts, sheet=sheet)
    assert trained.folder is not None
    usual = f"validation-{trained.folder.resolve().name}.png"
    written = [] if as_json else places(out, usual, force=force)
    predictor = forecaster(trained, given)
    found = validate(predictor, records, name)
    if as_json:
        typer.echo(json.dumps(as_dict(found), indent=2, ensure_ascii=False))
    else:
        for rows, what, text in (
            (output_rows(found), f"{name}: {trained.label}", 1),
            (step_rows(found.steps, found.channels), "Ahead, after the samples that tell x(0)", 1),
            (residual_rows(found), "Residuals: errors one step ahead", 2),
            (point_rows(found), "Linearisations at equilibria", 2), (test_rows(found), "Tests", 1),
        ):  # fmt: skip
            if rows:
                print_rows(rows, what, text_columns=text)
        for line in gain_lines(predictor.gains) + (found.limits.told(found.channels) if found.limits else []):
            console.print(line, soft_wrap=True, highlight=False)
        for line in found.verdict:
            console.print(f"- {line}", soft_wrap=True, highlight=False)
        from nnss_cli.report.figures import save_figure
        from nnss_cli.report.validation import draw_validation

        require_writable(written[0].parent)
        figure = draw_validation(found)
        save_figure(figure, written[0])
        console.print(str(written[0]), soft_wrap=True, highlight=False)
    if not found.passed:
        raise typer.Exit(1)
