"""What the user changes of methods' options: flags for every method that has them, --set for one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import Any

from nnss_cli.errors import InputError, nearest
from nnss_cli.methods import METHODS, Method, select
from nnss_cli.methods.options import Option, options_of


def gathered(
    flags: Mapping[str, Any], assignments: Sequence[str], names: Sequence[str], flag_of: Mapping[str, str]
) -> dict[str, Any]:
    """Options by name for every method that has them, and by 'METHOD.OPTION' for one.

    Args:
        flags: options that were given as flags, by name.
        assignments: METHOD.OPTION=VALUE each.
        names: the methods that are to run; the default ones where there are none.
        flag_of: option → its flag.

    Raises:
        InputError: a method or option is unknown or not among those that run, a value has the wrong type, or
            an option is given twice.
    """
    chosen = select(names)
    running = dict.fromkeys(member for method in chosen for member in (method.name, method.members) if member)
    for option in flags:
        if not any(option in _options(METHODS[name]) for name in running):
            owners = [name for name, method in METHODS.all_usable().items() if option in _options(method)]
            told = f"{flag_of[option]}: no chosen method ({', '.join(running)}) has the option '{option}'"
            if not owners:
                valid = list(dict.fromkeys(own for name in running for own in _options(METHODS[name])))
                meant = nearest(option, valid)
                raise InputError(
                    f"{told}, nor has any other: "
                    + (f"did you mean '{meant}'?" if meant else f"choose from {', '.join(valid)}")
                )
            raise InputError(f"{told}; {', '.join(owners)} {'has' if len(owners) == 1 else 'have'} it")
    changes = dict(flags)
    for assignment in assignments:
        option, value = _assigned(assignment, tuple(running))
        if option in changes:
            raise InputError(f"--set {option} is given twice: give it once")
        name = option.partition(".")[2]
        if name in flags:
            raise InputError(f"{flag_of[name]} and --set {option} are the same option: give one of them")
        changes[option] = value
    return changes


def _options(method: Method) -> dict[str, Option]:
    return options_of(method.options)


def _assigned(assignment: str, running: Sequence[str]) -> tuple[str, Any]:
    """'METHOD.OPTION' and its value."""
    target, equals, text = assignment.partition("=")
    name, dot, option = target.partition(".")
    if not (equals and dot and option):
        raise InputError(
            f"--set: expected METHOD.OPTION=VALUE, such as {running[0]}.OPTION=VALUE, found '{assignment}'"
        )
    try:
        method = METHODS[name]
    except KeyError:
        raise InputError(f"--set {target}: unknown method '{name}': {_choose(name, METHODS)}") from None
    known = _options(method)
    if option not in known:
        if method.members:
            raise InputError(
                f"--set {target}: {name} combines runs of {method.members}: --set {method.members}.{option}={text}"
            )
        raise InputError(f"--set {target}: unknown option '{option}' of {name}: {_choose(option, known)}")
    if name not in running:
        raise InputError(f"--set {target}: {name} is not among the methods that run ({', '.join(running)})")
    try:
        return target, known[option].parse(text)
    except InputError as error:
        raise InputError(f"--set {name}.{error}") from error


def _choose(found: str, valid: Mapping[str, Any]) -> str:
    """The valid names, with the nearest."""
    near = get_close_matches(found, valid, 1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    return hint + (f"choose from {', '.join(valid)}" if valid else "it has none")
