"""`nnss certify`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from nnss_cli.commands import options as opt
from nnss_cli.errors import InputError


def command(
    model: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL", help="Folder of a run, as `nnss train` prints it; or of many, of which each is examined."
        ),
    ],
    data: Annotated[
        Path | None,
        typer.Option(
            "--data", metavar="FILE", help="File with a column per input and output, instead of the run's own records."
        ),
    ] = None,
    Ts: opt.FileTs = None,
    steps: Annotated[int, typer.Option("--steps", metavar="N", help="Samples of each stress run.", min=1)] = 1_000_000,
    budget: Annotated[
        float,
        typer.Option("--budget", metavar="SECONDS", help="For attacks and proofs, a model; 0 for none.", min=0.0),
    ] = 40.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables (docs/stability.md).")] = False,
) -> None:
    """Examine stability and gain of one model or of all in a folder: what is proved, refuted, sampled, unknown.

    Bounds by construction, proofs over regions, attacks, a Lyapunov search, long stress runs. Values are in the model's
    normalised units where no other is named. Exit code 1 when a promised bound is broken.
    """
    from nnss_cli.commands.display import console, print_rows
    from nnss_cli.commands.parameters import refuse_without
    from nnss_cli.experiment.certificate.many import folders_below
    from nnss_cli.report.certificates import certificate_rows, examined, statement_rows, stress_rows, summary_rows

    if data is None:
        refuse_without("--data", {"--ts": Ts})
    folders = folders_below(model)
    found: list[tuple[str, Any]] = []
    skipped: list[tuple[str, str]] = []
    for folder in folders or [model]:
        try:
            found += _certificates(folder, model, data, Ts, steps, budget)
        except InputError as error:
            if len(folders) < 2:
                raise
            skipped.append((str(folder), str(error)))
    if not found:
        raise InputError(f"'{model}': none of {len(folders)} models could be examined: {skipped[0][1]}")
    broken = any(certificate.broken for _, certificate in found)
    if as_json:
        if len(folders) < 2 and len(found) == 1:
            content: Any = found[0][1].to_json()
        else:
            content = {
                "models": [{"model": name} | certificate.to_json() for name, certificate in found],
                "skipped": [{"model": name, "reason": reason} for name, reason in skipped],
            }
        typer.echo(json.dumps(content, indent=2, ensure_ascii=False))
    elif len(found) > 1 or len(folders) > 1:
        print_rows(summary_rows(found), f"{model}: {len(found)} models", text_columns=1)
        console.print(
            "P proved, S sampled, R refuted, ? unknown; gains in normalised units; * by stronger inputs than the bound "
            "is of. `nnss certify MODEL` says for which states and inputs.", soft_wrap=True, highlight=False,
        )  # fmt: skip
        for name, certificate in found:
            for line in certificate.broken:
                console.print(f"BROKEN: {name}: {line}", soft_wrap=True, highlight=False)
        for name, reason in skipped:
            console.print(f"skipped: {name}: {reason}", soft_wrap=True, highlight=False)
    else:
        ((name, certificate),) = found
        print_rows(statement_rows(certificate), f"{name}: what is known{examined(certificate)}", text_columns=2)
        print_rows(certificate_rows(certificate), "Figures", text_columns=1)
        print_rows(stress_rows(certificate), f"Stress runs ({certificate.stress_seconds:.1f} s)", text_columns=1)
        for line in certificate.broken:
            console.print(f"BROKEN: {line}", soft_wrap=True, highlight=False)
        if not certificate.broken:
            console.print(
                "No promised bound is broken."
                if certificate.promised
                else "This model promises nothing by construction."
            )
    if broken:
        raise typer.Exit(1)


def _certificates(
    folder: Path, root: Path, data: Path | None, Ts: float | None, steps: int, budget: float
) -> list[tuple[str, Any]]:
    """Name and certificate of the model in a folder, or of each member of an ensemble."""
    from nnss_cli.experiment.certificate import certify
    from nnss_cli.experiment.certificate.many import members, name_of
    from nnss_cli.experiment.store import records_of
    from nnss_cli.trained import load, read_record

    trained = load(folder)
    assert trained.folder is not None
    if data is None:
        splits = records_of(trained.folder, trained.Ts)
    else:
        splits = {"data": (read_record(trained, data, Ts=Ts),)}
    return [
        (name, certify(member, splits, steps, budget=budget, init_window=trained.init_window))
        for name, member in members(name_of(trained.folder, root), trained.model)
    ]
