"""`nnss show`."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from nnss_cli.commands.options import ModelFolder


def command(
    model: ModelFolder,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")] = False,
) -> None:
    """Say what a model is: its kind, channels, scaling, arrays, and what it was trained on and how."""
    from nnss_cli.commands.display import print_rows
    from nnss_cli.report.simulation import array_rows, channel_rows, model_rows, setting_rows
    from nnss_cli.trained import load
    from nnss_cli.trained.show import shown

    found = shown(load(model))
    if as_json:
        typer.echo(json.dumps(found, indent=2, ensure_ascii=False))
        return
    for rows, title, text in (
        (model_rows(found), found["folder"], 1), (channel_rows(found), "Channels and their scaling", 3),
        (array_rows(found), "Arrays (model.safetensors)", 1), (setting_rows(found), "Settings of the training", 1),
    ):  # fmt: skip
        if rows:
            print_rows(rows, title, text_columns=text)
