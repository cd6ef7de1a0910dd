"""Options that several commands share, each declared once."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for results.")]
ProtocolName = Annotated[
    str,
    typer.Option(
        "--protocol",
        metavar="paper|strict",
        help="Split and statistics: as in the paper, or without its overlaps.",
    ),
]
Mirror = Annotated[
    str | None,
    typer.Option(
        "--mirror",
        metavar="DIR|URL",
        envvar="NNSS_MIRROR",
        help="Folder or address to try before the original sources.",
    ),
]
Offline = Annotated[bool, typer.Option("--offline", help="Touch no network: use the cache or a mirror folder.")]
Force = Annotated[bool, typer.Option("--force", help="Do it again even if it is there.")]

_TRAINING = "Training of NN-SS (default: the paper's recipe)"


def _training(name: str, help_text: str, metavar: str | None = None) -> Any:
    return typer.Option(name, help=help_text, metavar=metavar, rich_help_panel=_TRAINING, show_default=False)


Epochs = Annotated[int | None, _training("--epochs", "Epochs at most.", "N")]
Patience = Annotated[
    int | None, _training("--patience", "Epochs without a 5 % better validation error before it stops.", "N")
]
Window = Annotated[int | None, _training("--window", "Window length L, samples.", "L")]
Stride = Annotated[int | None, _training("--stride", "Samples between the starts of windows.", "N")]
Batch = Annotated[int | None, _training("--batch", "Windows in a mini-batch.", "N")]
LearningRate = Annotated[float | None, _training("--learning-rate", "Step size of Adam.", "RATE")]
Consistency = Annotated[float | None, _training("--lambda", "Weight of the state-consistency term.", "λ")]
Hidden = Annotated[
    list[int] | None, _training("--hidden", "Widths of the generator's layers, e.g. --hidden 100 100.", "N …")
]
Encoder = Annotated[list[int] | None, _training("--encoder", "Widths of the encoder's layers.", "N …")]
Scheduling = Annotated[str | None, _training("--scheduling", "What schedules the matrices.", "x|x+u|x+y|x+u+y")]
Gamma = Annotated[float | None, _training("--gamma", "Bound on the spectral radius of A, at most 1.", "γ")]
Epsilon = Annotated[float | None, _training("--eps", "Added to S in the Schur parametrisation.", "ε")]
Optimiser = Annotated[
    str | None, _training("--optimiser", "Adam on mini-batches, or L-BFGS on all windows.", "adam|lbfgs")
]
Engine = Annotated[
    str,
    typer.Option(
        "--engine", metavar="auto|reference|fast", help="Compiled training, or plain torch.", rich_help_panel=_TRAINING
    ),
]
Dtype = Annotated[str | None, _training("--dtype", "Precision.", "float32|float64")]

_BASELINES = "Baselines"


def _baseline(name: str, help_text: str, metavar: str) -> Any:
    return typer.Option(name, help=help_text, metavar=metavar, rich_help_panel=_BASELINES, show_default=False)


HorizonChoice = Annotated[
    str | None,
    _baseline("--horizon", "Horizons of N4SID: MATLAB's (default of protocol paper), or searched.", "matlab|auto"),
]
KernelChoice = Annotated[str | None, _baseline("--kernel", "Prior of SSREGEST (default tc).", "tc|dc|ss")]
SimbaStart = Annotated[str | None, _baseline("--simba-start", "Where SIMBa starts (default n4sid).", "n4sid|random")]
Feedthrough = Annotated[
    bool, typer.Option("--feedthrough", help="SSEST estimates D as well.", rich_help_panel=_BASELINES)
]


def overrides(**values: Any) -> dict[str, Any]:
    """What the user has set, with lists as tuples; None means the recipe's value."""
    return {
        name: tuple(value) if isinstance(value, list) else value
        for name, value in values.items()
        if value is not None and value != []
    }


def default_jobs() -> int:
    """One process per core."""
    return os.cpu_count() or 1
