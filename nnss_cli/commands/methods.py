"""`nnss methods`."""

from __future__ import annotations


def command() -> None:
    """List the methods, plug-ins included: version, where each comes from, and its options for --set."""
    from nnss_cli.commands.display import console, print_rows
    from nnss_cli.commands.events import emit
    from nnss_cli.methods import METHODS, version_of
    from nnss_cli.methods.options import options_of

    methods = METHODS.all_usable()
    rows = [
        {
            "method": name, "from": METHODS.origin(name).title, "version": version_of(method),
            "repeated": "by seed" if method.seeded else "no", "made of": method.members or "–",
        }
        for name, method in methods.items()
    ]  # fmt: skip
    print_rows(rows, "Methods", text_columns=5)
    for name, method in methods.items():
        for option in options_of(method.options).values():
            text = option.doc or f"{option.expected[0].upper()}{option.expected[1:]}."
            emit("option", method=name, option=option.name, text=text)
            console.print(f"--set {name}.{option.name}=…  {text}", soft_wrap=True, highlight=False, markup=False)
