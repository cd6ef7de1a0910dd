"""Studies of NN-SS: what `nnss ablate` found, in words and as a file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from nnss_cli.experiment.ablation import Variant
from nnss_cli.experiment.agreement import telling
from nnss_cli.experiment.store import Store
from nnss_cli.files import write_text
from nnss_cli.report.aggregate import several_outputs
from nnss_cli.report.cells import escaped
from nnss_cli.report.statistics import median_interval
from nnss_cli.report.tables import markdown, option, study_rows


def study_note(variants: Sequence[Variant]) -> str:
    """What the table of a study shows."""
    runs = [result for variant in variants for result in variant.results]
    seeds = len({result.spec.seed for result in runs})
    note = f"{'Mean over outputs of RMSE/σ' if several_outputs(runs) else 'RMSE'}"
    if seeds == 1:
        note += ", of one seed"
    else:
        covered = median_interval(range(seeds)).coverage
        note += (
            f", median over {seeds} seeds with its interval by order statistics: {covered:.1%} of such intervals hold"
        )
    note += ". One switch at a time."
    if any(variant.unbounded is not None for variant in variants):
        note += " Under stress: models whose state left the range of numbers in a long run of extreme inputs."
    return note


UNKNOWN = "not done, or not for this record; `nnss ablate` tells which"
"""Of a variant whose runs are not on disk."""


def changes(variants: Sequence[Variant]) -> list[str]:
    """A line for each variant: its options where they are not those of the first one at the same order, or why no run.

    An option may follow from another one: with a fixed part of the cold model no cold candidate is tried, so that
    `initial` is feedback in the place of auto.
    """
    plain = {result.spec.order: telling(result.spec.settings) for result in variants[0].results}
    lines = []
    for variant in variants[1:]:
        if not variant.results:
            lines.append(f"{variant.name}: no runs: {variant.refused or UNKNOWN}")
            continue
        told: dict[str, list[str]] = {}
        for order, own in {r.spec.order: telling(r.spec.settings) for r in variant.results}.items():
            first = plain.get(order, own)
            apart = [name for name in first | own if name != "recipe" and first.get(name) != own.get(name)]
            text = ", ".join(f"{name} {option(own.get(name))} (for {option(first.get(name))})" for name in apart)
            told.setdefault(text or "nothing: the recipe has it so", []).append(str(order))
        if len(told) == 1:
            lines.append(f"{variant.name}: {next(iter(told))}")
        else:
            lines.append(f"{variant.name}: " + "; ".join(f"{text} at order {', '.join(n)}" for text, n in told.items()))
    return lines


CHANGES = (
    "Options that each variant has in the place of the first one's. Some follow from others: where a part of the cold "
    "model is fixed (λ, windows, widths, epochs), no cold candidate is tried, so `initial` is feedback; a run's own "
    "label then says “changed: initial” too"
)
"""What stands above `changes`."""


def study_text(store: Store, study: str, variants: Sequence[Variant]) -> str:
    """The table of a study in Markdown, with a row per order and variant, and what each variant changes."""
    parts = [
        f"{study_note(variants)} Runs under `{store.out.name}/ablation/{study}/`.",
        markdown(study_rows(variants, intervals=True)),
    ]
    lines = changes(variants)
    if lines:
        parts.append(f"{CHANGES}:\n\n" + "\n".join(f"- {line}" for line in lines))
    return "\n\n".join(parts)


def write_study(store: Store, study: str, variants: Sequence[Variant]) -> Path:
    """Write study-<name>.md."""
    path = store.folder / f"study-{study}.md"
    title = f"# NN-SS on {escaped(store.dataset)}, protocol `{store.protocol}`: {study}"
    write_text(path, f"{title}\n\n{study_text(store, study, variants)}\n")
    return path
