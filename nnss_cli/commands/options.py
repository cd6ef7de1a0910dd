"""Options that several commands share, each declared once."""

from __future__ import annotations

import inspect
import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from nnss_cli.commands.parameters import flag_of, option, with_parameters
from nnss_cli.errors import InputError, unknown


def _dataset_names(incomplete: str) -> list[str]:
    """Shell completion of a dataset's name."""
    from nnss_cli.datasets.catalog import BENCHMARKS

    return [name for name in BENCHMARKS if name.startswith(incomplete)]


def _method_names(incomplete: str) -> list[str]:
    """Shell completion of a method's name."""
    from nnss_cli.methods import METHODS

    return [name for name in METHODS if name.startswith(incomplete)]


def _assignments(incomplete: str) -> list[str]:
    """Shell completion of METHOD.OPTION= for --set."""
    from nnss_cli.methods import METHODS
    from nnss_cli.methods.options import options_of

    name, dot, _ = incomplete.partition(".")
    method = METHODS.usable(name) if dot else None
    found = [f"{name}.{option}=" for option in options_of(method.options)] if method else [f"{n}." for n in METHODS]
    return [text for text in found if text.startswith(incomplete)]


DatasetName = Annotated[
    list[str],
    typer.Argument(
        metavar="DATASET|FILE...",
        help="A benchmark (`nnss fetch --list`), a description (.toml), or a file for each experiment.",
        autocompletion=_dataset_names,
        show_default=False,
    ),
]
DatasetNames = Annotated[
    list[str] | None, typer.Argument(metavar="[DATASET]...", help="Datasets to fetch.", autocompletion=_dataset_names)
]
MethodNames = Annotated[
    list[str] | None,
    typer.Option(
        "--methods", metavar="NAME …", help="Methods to compare.", show_default="all", autocompletion=_method_names
    ),
]
Out = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for results.")]
ProtocolName = Annotated[
    str,
    typer.Option(
        "--protocol",
        metavar="NAME",
        help="Split and statistics: paper, strict (without the paper's overlaps) or official; a dataset names its own.",
        show_default="the dataset's first",
    ),
]
Orders = Annotated[
    list[int] | None,
    typer.Option("--orders", metavar="N …", help="Model orders, e.g. --orders 2 3 4.", show_default="the paper's"),
]
Seeds = Annotated[int, typer.Option("--seeds", metavar="N", help="Number of seeds: 0 to N−1.")]
Jobs = Annotated[
    int | None,
    typer.Option("--jobs", metavar="N", help="Processes; the numbers do not depend on it.", show_default="cores"),
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
PluginFiles = Annotated[
    list[Path] | None,
    typer.Option(
        "--plugin", metavar="FILE.py …", help="Files with a METHOD or a BENCHMARK of your own: their code is executed."
    ),
]
Assignments = Annotated[
    list[str] | None,
    typer.Option(
        "--set",
        metavar="METHOD.OPTION=VALUE …",
        help="Options of one method; `nnss methods` lists them.",
        autocompletion=_assignments,
    ),
]
TimeLimit = Annotated[
    float | None,
    typer.Option("--time-limit", metavar="SECONDS", help="Wall time a run may take.", show_default="none"),
]
MemoryLimit = Annotated[
    float | None,
    typer.Option(
        "--memory-limit", metavar="GB", help="Memory the process of a run may hold (Linux).", show_default="none"
    ),
]
RetryFailed = Annotated[
    bool, typer.Option("--retry-failed", help="Try runs again that timed out, took too much memory or crashed.")
]
FailFast = Annotated[bool, typer.Option("--fail-fast", help="Stop at the first run without a result.")]
ExecutorName = Annotated[
    str,
    typer.Option("--executor", metavar="local|dask", help="Processes of this machine, or workers of a Dask scheduler."),
]
Scheduler = Annotated[
    str, typer.Option("--scheduler", metavar="ADDRESS", help="Of --executor dask, such as tcp://10.0.0.1:8786.")
]
DryRun = Annotated[bool, typer.Option("--dry-run", help="Say what is to do and how long it may take, and leave.")]
Yes = Annotated[bool, typer.Option("--yes", help="Start even if it will take more than a day.")]
Formats = Annotated[
    list[str] | None,
    typer.Option("--format", metavar="NAME …", help="Files of figures: png, svg, pdf.", show_default="png"),
]
Columns = Annotated[
    int | None,
    typer.Option(
        "--columns", metavar="1|2", help="Figures as wide as so many columns of a paper.", show_default="for a screen"
    ),
]
Quiet = Annotated[bool | None, typer.Option("--quiet", help="Print nothing but errors.")]
AsJson = Annotated[
    bool | None, typer.Option("--json", help="Print events for machines: one JSON object a line (docs/reliability.md).")
]
AsCsv = Annotated[
    bool | None, typer.Option("--csv", help="Print the table as CSV, in full precision, and nothing else.")
]
OUTPUT = {"quiet": Quiet, "as_json": AsJson, "as_csv": AsCsv}
Force = Annotated[bool, typer.Option("--force", help="Do it again even if it is there.")]
Predicted = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="FILE.csv",
        help="Where the outputs go (default: predicted.csv, with a number where that is there).",
    ),
]
ModelFolder = Annotated[
    Path,
    typer.Argument(
        metavar="MODEL", help="Folder of a run, as `nnss train` prints it; or of results (--out) with one model."
    ),
]
FileTime = Annotated[
    str | None, typer.Option("--time", metavar="COLUMN", help="Column of the time, checked against the model.")
]
FileTs = Annotated[
    float | None, typer.Option("--ts", metavar="SECONDS", help="Sampling time of the file, checked against the model.")
]
FittedOn = Annotated[
    Path | None,
    typer.Option(
        "--data", metavar="FILE",
        help="Record to fit the gain and the bands on, instead of the training and validation records of the run.",
    ),
]  # fmt: skip
Interval = Annotated[
    float | None,
    typer.Option(
        "--interval", metavar="SHARE",
        help="Add a band for each output that holds this share of samples, such as 0.9: split conformal on blocks of "
        "the validation record. It assumes blocks of the new record to be exchangeable with them.",
    ),
]  # fmt: skip
IntervalBy = Annotated[
    str | None,
    typer.Option(
        "--interval-by", metavar="residuals|ensemble|adaptive",
        help="Width of the band: constant (default), following the spread of an ensemble's members or, in predict, the "
        "coverage seen up to then.",
    ),
]  # fmt: skip
FileSheet = Annotated[str | None, typer.Option("--sheet", metavar="NAME", help="Sheet of an Excel file.")]

MAX_JOBS = 1024
"""Processes of one machine."""

_TRAINING = "Training of NN-SS, and of SIMBa where it applies (default: the recipe's)"
_BASELINES = "Baselines"


def _training(kind: Any, name: str, metavar: str, help_text: str) -> Any:
    return option(kind | None, _TRAINING, name, metavar, help_text)


def _baseline(kind: Any, name: str, metavar: str | None, help_text: str) -> Any:
    return option(kind | None, _BASELINES, name, metavar, help_text)


Horizon = _baseline(str, "--horizon", "matlab|auto", "N4SID: MATLAB's (default of protocol paper), or searched.")

# Setting of a method → the option that changes it. A method takes those that it has.
FIT_OPTIONS: dict[str, Any] = {
    "recipe": _training(str, "--recipe", "paper|best", "Of method nnss: as in the paper, or trained well (default)."),
    "epochs": _training(int, "--epochs", "N", "Epochs at most."),
    "patience": _training(int, "--patience", "N", "Wait for a 5 % better validation error before it stops."),
    "patience_unit": _training(str, "--patience-unit", "epochs|steps", "What patience counts: steps are mini-batches."),
    "window": _training(int, "--window", "L", "Window length, samples; 0 for whole records."),
    "stride": _training(int, "--stride", "N", "Samples between the starts of windows."),
    "batch": _training(int, "--batch", "N", "Windows in a mini-batch."),
    "learning_rate": _training(float, "--learning-rate", "RATE", "Step size of Adam."),
    "consistency": _training(float, "--lambda", "λ", "Weight of the state-consistency term."),
    "hidden": _training(list[int], "--hidden", "N …", "Widths of the generator's layers, e.g. --hidden 100 100."),
    "encoder": _training(list[int], "--encoder", "N …", "Widths of the encoder's layers."),
    "encoder_window": _training(
        int, "--encoder-window", "W", "First samples of y and u from which the encoder tells x(0); 1: y(0) alone."
    ),
    "scheduling": _training(str, "--scheduling", "x|x+u|x+y|x+u+y|auto", "What schedules the matrices."),
    "feedthrough": _training(
        str,
        "--feedthrough",
        "auto|yes|no",
        "D in y = C x + D u, of NN-SS and SSEST; auto: validation decides (NN-SS: if u(k) shows in y(k) in training).",
    ),
    "integrator": _training(
        str, "--integrator", "auto|yes|no", "Whether the outputs sum up what the stable part gives."
    ),
    "lengthen": _training(
        str,
        "--lengthen",
        "auto|yes|no",
        "Begin on windows of 20, 60, 200 samples, for plants that ring; auto: where whole records hide an optimum.",
    ),
    "budget": _training(float, "--budget", "SECONDS", "Of a fit: no candidate and no epoch begins after it."),
    "judge": _training(
        str, "--judge", "validation|blocks", "What candidates are compared on; blocks: of training and validation both."
    ),
    "threads": _training(int, "--threads", "1|2", "Of a fit, for long records; the numbers are the same."),
    "stability": _training(
        str,
        "--stability",
        "auto|schur|quadratic|incremental|none",
        "What is stable by construction (docs/stability.md).",
    ),
    "gamma": _training(float, "--gamma", "γ", "Bound on what --stability bounds, at most 1."),
    "gain": _training(
        float, "--gain", "Γ", "Bound on the incremental ℓ2 gain from u to y, in deviations, of --stability incremental."
    ),
    "epsilon": _training(float, "--eps", "ε", "Added to S in the Schur parametrisation."),
    "dtype": _training(str, "--dtype", "float32|float64", "Precision."),
    "optimiser": _training(
        str, "--optimiser", "adam|lbfgs|gauss-newton", "Adam on mini-batches, or the others on all windows at once."
    ),
    "refine": _training(int, "--refine", "N", "Gauss–Newton iterations after Adam, at most."),
    "initial": _training(
        str,
        "--start",
        "random|linear|feedback|cascade|auto",
        "Random weights, SSEST's model, that with saturated feedback, or with units between two linear parts; auto: "
        "feedback, or what validates better.",
    ),
    "fixed_encoder": option(bool | None, _TRAINING, "--fixed-encoder", None, "Leave the encoder as it starts."),
    "engine": _training(str, "--engine", "auto|reference|fast", "Compiled, or plain torch; auto is compiled."),
    "horizon": Horizon,
    "kernel": _baseline(str, "--kernel", "tc|dc|ss", "SSREGEST: prior of the impulse responses (default tc)."),
    "start": _baseline(str, "--simba-start", "n4sid|random", "SIMBa: where it starts (default n4sid)."),
}


def with_fit_options(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command --set and every option of FIT_OPTIONS; its parameter `changes` gets those that the user set.

    They are for the methods that the command's parameter `methods` or `method` names, or for NN-SS.
    """

    def wrapper(**given: Any) -> None:
        flags = {name: given.pop(name) for name in FIT_OPTIONS}
        assignments = given.pop("assignments") or []
        from nnss_cli.experiment.changes import gathered

        changes = gathered(
            {
                name: tuple(value) if isinstance(value, list) else value
                for name, value in flags.items()
                if value is not None and value != []
            },
            assignments,
            (given["methods"] or []) if "methods" in given else [given.get("method", "nnss")],
            {name: flag_of(annotation) for name, annotation in FIT_OPTIONS.items()},
        )
        command(**given, changes=changes)

    return with_parameters(command, wrapper, {"assignments": Assignments, **FIT_OPTIONS}, without="changes")


def with_plugins(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command --plugin: the files are in use while it runs."""

    def wrapper(plugin: list[Path] | None = None, **given: Any) -> None:
        from nnss_cli.plugins import read_source, use

        use([read_source(path) for path in plugin or ()])
        if plugin:
            from nnss_cli.datasets.catalog import BENCHMARKS
            from nnss_cli.methods import METHODS

            METHODS.of_files()
            BENCHMARKS.of_files()
        command(**given)

    return with_parameters(command, wrapper, {"plugin": PluginFiles})


def with_output(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command --quiet, --json and --csv, but for those that it has itself."""
    own = inspect.signature(command).parameters
    added = {name: kind for name, kind in OUTPUT.items() if name not in own}

    def wrapper(**given: Any) -> None:
        from nnss_cli.commands.display import output

        asked = {name: bool(given.pop(name)) for name in added}
        with output(asked.get("quiet", False), asked.get("as_json", False), asked["as_csv"]):
            if asked["as_csv"] and given.get("as_json"):
                raise InputError("expected --json or --csv, found both: leave one out")
            command(**given)

    return with_parameters(command, wrapper, added)


def as_command_line(settings: dict[str, Any]) -> str:
    """The options that give these settings, in full precision: what `with_fit_options` would turn back into them."""
    parts: list[str] = []
    for name, value in settings.items():
        if name not in FIT_OPTIONS:
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            parts += ["--set", f"nnss.{name}={text}"]
            continue
        flag = flag_of(FIT_OPTIONS[name])
        if isinstance(value, bool):
            parts += [flag] * value
        else:
            parts += [flag, *map(str, value if isinstance(value, tuple) else (value,))]
    return shlex.join(parts)


def check_executor(executor: str, scheduler: str) -> None:
    """Refuse an executor that is unknown, or without what it needs.

    Raises:
        InputError: it is.
    """
    if executor not in ("local", "dask"):
        raise unknown("executor", executor, ("local", "dask"))
    if (executor == "dask") != bool(scheduler):
        found = f"--scheduler {scheduler}" if scheduler else "none"
        raise InputError(
            f"--executor {executor}: expected --scheduler ADDRESS with dask, and only there, found {found}"
        )


def check_counts(seeds: int, jobs: int | None) -> int:
    """The number of processes: one per core unless the user says.

    Raises:
        InputError: there are no seeds or processes, or more than any folder or machine holds.
    """
    from nnss_cli.experiment.sweep import MAX_RUNS

    if not 1 <= seeds <= MAX_RUNS:
        raise InputError(f"--seeds: expected at least 1 and at most {MAX_RUNS:,}, found {seeds:,}")
    workers = (os.cpu_count() or 1) if jobs is None else jobs
    if not 1 <= workers <= MAX_JOBS:
        raise InputError(f"--jobs: expected at least 1 and at most {MAX_JOBS:,}, found {workers:,}")
    return workers
