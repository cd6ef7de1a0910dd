"""The command line: `nnss`."""

from __future__ import annotations

import atexit
import gc
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

from nnss_cli.machine import prepare

prepare()  # before anything loads numpy

import typer

from nnss_cli.commands import (
    ablate,
    certify,
    compare,
    export,
    fetch,
    inspect,
    methods,
    order,
    predict,
    report,
    results,
    show,
    simulate,
    train,
    tune,
    validate,
)
from nnss_cli.commands.options import with_output, with_plugins
from nnss_cli.commands.variadic import VariadicCommand
from nnss_cli.errors import FontWarning, InputError, RenamedWarning
from nnss_cli.experiment.interrupt import EXIT_CODE, interruptible
from nnss_cli.files import free_space
from nnss_cli.plugins import PluginWarning
from nnss_cli.version import __version__

app = typer.Typer(
    name="nnss",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Example: nnss compare twotank --orders 2 3 4 --seeds 10",
)

for _name, _module, _example in (
    ("fetch", fetch, "nnss fetch daisy-powerplant    nnss fetch twotank --from twotankdata.mat"),
    ("train", train, "nnss train twotank --order 3 --seed 0"),
    ("compare", compare, "nnss compare twotank --orders 2 3 4 --seeds 10 --methods nnss n4sid"),
    ("tune", tune, "nnss tune twotank --order 3 --trials 50"),
    ("ablate", ablate, "nnss ablate twotank --study stability --orders 3 --seeds 10"),
    ("simulate", simulate, "nnss simulate results/twotank/paper/runs/nnss-n3-s0 new.csv --out predicted.csv --plot"),
    ("predict", predict, "nnss predict results/twotank/paper/runs/nnss-n3-s0 new.csv --horizon 10 --interval 0.9"),
    ("validate", validate, "nnss validate results/twotank/strict/runs/nnss-n3-s0 new.csv"),
    ("export", export, "nnss export results/twotank/paper/runs/nnss-n3-s0 --to c --out firmware"),
    ("show", show, "nnss show results/twotank/paper/runs/nnss-n3-s0"),
    ("certify", certify, "nnss certify results/twotank/paper/runs/nnss-n3-s0"),
    ("inspect", inspect, "nnss inspect plant.csv --inputs u --outputs y --ts 0.1 --write plant.toml"),
    ("order", order, "nnss order twotank --max-order 8"),
    ("report", report, "nnss report --out results"),
    ("methods", methods, "nnss methods --plugin my_method.py"),
):
    app.command(_name, cls=VariadicCommand, epilog=f"Example: {_example}")(with_plugins(with_output(_module.command)))


app.add_typer(results.app, name="results")


def _show_version(asked: bool) -> None:
    if asked:
        typer.echo(f"nnss {__version__}")
        raise typer.Exit


@app.callback()
def _global(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and leave."),
    ] = False,
) -> None:
    """A bench for system identification: NN-SS against classical methods, from records to tables."""


# else the interpreter ends with collections that go through all that torch, numba and pandas have made: a second or so
atexit.register(gc.freeze)

UsageError: Any = typer.BadParameter.__bases__[0]  # click's or typer's own, whichever typer has


def main(args: list[str] | None = None) -> None:
    """Run the command line; every error that the user can mend is one line and exit code 2. 130 when interrupted."""
    try:
        with interruptible(), warnings.catch_warnings():
            _show_own_warnings_on_one_line()
            code = app(args, prog_name="nnss", standalone_mode=False)
        if code == EXIT_CODE:  # what later typer makes of it
            raise KeyboardInterrupt
    except UsageError as error:
        _fail(_usage_message(error))
    except InputError as error:
        _fail(str(error))
    except InterruptedError as error:
        _fail(str(error), EXIT_CODE)
    except (KeyboardInterrupt, typer.Abort):  # earlier typer makes the latter of the former
        _fail("interrupted", EXIT_CODE)
    except OSError as error:
        if error.filename is None:
            raise
        free = free_space(Path(error.filename))
        _fail(f"'{error.filename}': {error.strerror}{free}; check the path, its permissions and the free space")
    sys.exit(code if isinstance(code, int) else 0)


def _show_own_warnings_on_one_line() -> None:
    usual = warnings.showwarning

    def show(message: Any, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, PluginWarning):
            print(f"nnss: passed over: {message}", file=sys.stderr)
        elif issubclass(category, RenamedWarning | FontWarning):
            print(f"nnss: {message}", file=sys.stderr)
        else:
            usual(message, category, *where, **more)

    warnings.showwarning = show


def _usage_message(error: Any) -> str:
    message = " ".join(error.format_message().split()).rstrip(".")
    if hasattr(error.__cause__, "errors"):  # pydantic knows the value that typer leaves out
        message += f", found {error.__cause__.errors()[0].get('input')!r}"
    ctx = error.ctx
    command = ctx.command if ctx else None
    if type(error).__name__ == "NoSuchOption" and command is not None:
        names = [name for parameter in command.get_params(ctx) for name in parameter.opts if name.startswith("--")]
        message += f": choose from {', '.join(sorted(set(names)))}"
    elif message.startswith("No such command") and command is not None:
        message += f": choose from {', '.join(command.commands)}"
    elif ctx is not None:
        message += f" (see '{ctx.command_path} --help')"
    return message


def _fail(message: str, code: int = 2) -> None:
    print(f"nnss: {message}", file=sys.stderr)
    sys.exit(code)
