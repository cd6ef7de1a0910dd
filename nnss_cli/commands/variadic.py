"""Options that take several values after one name: `--orders 2 3 4`."""

from __future__ import annotations

from typing import Any

from typer.core import TyperCommand


class VariadicCommand(TyperCommand):
    """Expands `--orders 2 3 4` to `--orders 2 --orders 3 --orders 4` for every repeatable option.

    click refuses such options by design, since an argument after them would be swallowed; here a
    value that follows is taken as long as it does not start with "-".
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Expand, then parse as usual."""
        names = {name for parameter in self.params if getattr(parameter, "multiple", False) for name in parameter.opts}
        return super().parse_args(ctx, expand(args, names))


def expand(args: list[str], names: set[str]) -> list[str]:
    """Repeat an option of `names` before each of the values that follow it."""
    expanded: list[str] = []
    current = ""  # the repeatable option whose values are being read
    taken = 0
    for position, arg in enumerate(args):
        if arg == "--":
            return expanded + args[position:]
        if arg in names:
            current, taken = arg, 0
            expanded.append(arg)
        elif current and not _is_option(arg):
            if taken:
                expanded.append(current)
            expanded.append(arg)
            taken += 1
        else:
            current = ""
            expanded.append(arg)
    return expanded


def _is_option(arg: str) -> bool:
    return arg.startswith("-") and not arg[1:2].isdigit()  # "-1" is a value, if a wrong one
