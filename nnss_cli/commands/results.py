"""`nnss results`: the runs of a results folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from nnss_cli.commands.options import Out, with_output
from nnss_cli.commands.variadic import VariadicCommand
from nnss_cli.errors import InputError

app = typer.Typer(no_args_is_help=True, help="The runs of a results folder: list, show, diff, rm, merge.")

Patterns = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="[RUN]...", help="Names, with * and ?: DATASET/PROTOCOL/METHOD-nORDER-sSEED, or the last part alone."
    ),
]
Statuses = Annotated[
    list[str] | None,
    typer.Option(
        "--status", metavar="NAME …", help="Only such runs: ok, diverged, failed, timeout, memory, crashed, damaged."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON, one line a run.")]


@app.command("list", cls=VariadicCommand, epilog="Example: nnss results list 'twotank/*' --status failed crashed")
@with_output
def list_command(
    runs: Patterns = None, status: Statuses = None, out: Out = Path("results"), as_json: AsJson = False
) -> None:
    """List runs by dataset, method and order. Exit code 1 when files are damaged: each is named."""
    from nnss_cli.commands.display import console, print_rows, tell_left_out
    from nnss_cli.experiment.collection import entries
    from nnss_cli.report.listing import MEDIAN_ERROR, group_rows

    found = entries(out, runs or (), status or ())
    if as_json:
        for entry in found:
            typer.echo(json.dumps(_as_json(entry), ensure_ascii=False))
    elif found:
        print_rows(group_rows(found), f"{len(found)} runs in '{out}'; test: {MEDIAN_ERROR}", text_columns=3)
    else:
        console.print(f"no such runs in '{out}'", highlight=False)
    _end_with([entry.fault for entry in found if entry.fault], tell_left_out)


@app.command("show", cls=VariadicCommand, epilog="Example: nnss results show twotank/paper/nnss-n3-s0")
@with_output
def show_command(runs: Patterns = None, out: Out = Path("results"), as_json: AsJson = False) -> None:
    """Show a run: its scores, what it was made with, its options."""
    from nnss_cli.commands.display import print_rows, tell_left_out
    from nnss_cli.experiment.collection import entries
    from nnss_cli.report.listing import run_rows
    from nnss_cli.report.tables import score_rows

    if not runs:
        raise InputError(
            "show: expected the name of a run, such as twotank/paper/nnss-n3-s0, found none: 'nnss results list' "
            "names them"
        )
    found = entries(out, runs)
    if not found:
        raise InputError(f"no run {', '.join(runs)} in '{out}': 'nnss results list' names those that are there")
    for entry in found:
        if as_json:
            typer.echo(json.dumps(_as_json(entry), ensure_ascii=False))
        elif entry.result is not None:
            if entry.result.scores:
                print_rows(score_rows(entry.result), entry.name)
            print_rows(run_rows(entry), "" if entry.result.scores else entry.name, text_columns=1)
    _end_with([entry.fault for entry in found if entry.fault], tell_left_out)


@app.command("diff", epilog="Example: nnss results diff results lab2/results")
@with_output
def diff_command(
    first: Annotated[Path, typer.Argument(metavar="A", help="A results folder.")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another one.")],
    tolerance: Annotated[
        float, typer.Option("--tolerance", metavar="SHARE", help="Relative change of an error that is none.", min=0)
    ] = 0.0,
) -> None:
    """Compare two results folders run by run: scores, status, data, options and versions; and which runs one lacks.

    Exit code: 0 they are equal, 1 they differ or hold damaged runs. Wall times and machines are no difference.
    """
    from nnss_cli.commands.display import console, print_rows, tell_left_out
    from nnss_cli.commands.events import emit
    from nnss_cli.experiment.comparison import compared
    from nnss_cli.report.listing import difference_rows

    found = compared(first, second, tolerance)
    if found.differing:
        print_rows(difference_rows(found.differing), f"'{first}' (A) and '{second}' (B) differ", text_columns=2)
    lacking = "".join(f", {n} only in {name}" for name, n in (("A", found.only_first), ("B", found.only_second)) if n)
    console.print(f"{found.equal} runs equal, {found.different} different{lacking}", highlight=False)
    emit(
        "end", equal=found.equal, different=found.different, only_in_A=found.only_first, only_in_B=found.only_second,
        left_out=found.faults,
    )  # fmt: skip
    tell_left_out(found.faults)
    if found.differing or found.faults:
        raise typer.Exit(1)


@app.command("rm", cls=VariadicCommand, epilog="Example: nnss results rm 'twotank/paper/nnss-n4-*' --yes")
@with_output
def rm_command(
    runs: Patterns = None,
    status: Statuses = None,
    out: Out = Path("results"),
    yes: Annotated[bool, typer.Option("--yes", help="Remove them; without it they are only named.")] = False,
) -> None:
    """Remove runs: their models, signals and scores. `nnss report` makes the tables anew."""
    from nnss_cli.commands.display import console
    from nnss_cli.commands.events import emit
    from nnss_cli.experiment.collection import entries, remove

    if not runs and not status:
        raise InputError("rm: expected names of runs, or --status, found neither: '*' is all of them")
    chosen = entries(out, runs or (), status or ())
    if not chosen:
        raise InputError(f"no such runs in '{out}': 'nnss results list' names those that are there")
    if not yes:
        for entry in chosen:
            console.print(entry.name, highlight=False, soft_wrap=True)
        console.print(f"{len(chosen)} runs would be removed: --yes removes them", highlight=False)
        emit("end", removed=[], kept=[entry.name for entry in chosen])
        return
    outcomes = [(entry.name, gone) for entry, gone in remove(chosen)]
    busy = [name for name, gone in outcomes if not gone]
    emit("end", removed=[name for name, gone in outcomes if gone], kept=busy)
    console.print(f"{len(chosen) - len(busy)} runs removed; 'nnss report' makes the tables anew", highlight=False)
    if busy:
        typer.echo(f"nnss: another command is at {', '.join(busy)}: not removed", err=True)
        raise typer.Exit(1)


@app.command("merge", cls=VariadicCommand, epilog="Example: nnss results merge lab1/results lab2/results --out results")
@with_output
def merge_command(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER...", help="Results folders of other machines.")],
    out: Out = Path("results"),
) -> None:
    """Copy the runs of other results folders into one. Nothing is replaced.

    Runs that are damaged, or do not go into one table with those that are there (other data or options, other
    scores under one name), are named and left out: exit code 1.
    """
    from nnss_cli.commands.display import console, tell_left_out
    from nnss_cli.commands.events import emit
    from nnss_cli.experiment.collection import merge
    from nnss_cli.files import require_writable

    require_writable(out)
    merged = merge(folders, out)
    console.print(
        f"{len(merged.copied)} runs copied to '{out}', {len(merged.same)} were there already; "
        "'nnss report' makes the tables",
        highlight=False, soft_wrap=True,
    )  # fmt: skip
    emit("end", copied=merged.copied, same=merged.same, left_out=merged.left_out)
    _end_with(merged.left_out, tell_left_out)


def _as_json(entry: Any) -> dict[str, Any]:
    about = {"run": entry.name, "folder": str(entry.folder)}
    if entry.result is None:
        return about | {"status": "damaged", "reason": entry.fault}
    content = entry.result.to_json()
    content.pop("history")  # by the thousands: run.json has it
    return about | content


def _end_with(lines: list[str], tell: Any) -> None:
    tell(lines)
    if lines:
        raise typer.Exit(1)
