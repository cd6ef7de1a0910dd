"""How options that many commands share are declared, found again, and added to a command."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Annotated, Any, get_args

import typer

from nnss_cli.errors import InputError


def option(kind: Any, panel: str, flag: str, metavar: str | None, help_text: str) -> Any:
    """The annotation of an option's parameter, under a heading of `--help`."""
    declared = typer.Option(flag, help=help_text, metavar=metavar, rich_help_panel=panel, show_default=False)
    return Annotated[kind, declared]


def flag_of(annotation: Any) -> str:
    """The flag of an option that `option` declared."""
    return str(get_args(annotation)[1].default)  # where typer keeps the first name


def with_parameters(
    command: Callable[..., None], wrapper: Callable[..., None], added: Mapping[str, Any], without: str = ""
) -> Callable[..., None]:
    """`wrapper` in the command's place, with parameters `added` to it: annotation by name."""
    own = inspect.signature(command, eval_str=True)
    parameters = [parameter for name, parameter in own.parameters.items() if name != without]
    parameters += [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation)
        for name, annotation in added.items()
    ]
    wrapper.__doc__ = command.__doc__
    wrapper.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return wrapper


def refuse_without(needed: str, given: Mapping[str, Any]) -> None:
    """Refuse options that do nothing without another one.

    Args:
        needed: what they need, which is not there.
        given: value by flag; None where it was not given.

    Raises:
        InputError: one of them was given.
    """
    for flag, value in given.items():
        if value is not None:
            raise InputError(f"{flag}: does nothing without {needed}: add that, or leave {flag} out")
