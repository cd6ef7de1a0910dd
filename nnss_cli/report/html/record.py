"""One dataset under one protocol: its table, its pictures and all that its runs keep, ready for the page."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from nnss_cli.datasets.catalog import BENCHMARKS
from nnss_cli.experiment.ablation import studies
from nnss_cli.experiment.agreement import Table
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.report.aggregate import (
    MEAN,
    NORMALISED,
    best_run,
    groups,
    methods_of,
    output_error,
    scored_splits,
    several_outputs,
    split_name,
    splits_of,
    titled_by,
)
from nnss_cli.report.evidence import not_the_papers, optimism_rows, paper_rows, released_rows
from nnss_cli.report.html.candidates import candidate_rows
from nnss_cli.report.html.certificate import certificate_table
from nnss_cli.report.html.curves import Curves, curves_of
from nnss_cli.report.html.looks import Look
from nnss_cli.report.html.origin import Origin, origin_of
from nnss_cli.report.html.pictures import Picture, draw_boxes
from nnss_cli.report.html.signals import simulation_traces, state_trace
from nnss_cli.report.html.trace import Trace
from nnss_cli.report.published import place_tables, published_tables
from nnss_cli.report.statistics import median_interval, quantile
from nnss_cli.report.studies import changes, study_note
from nnss_cli.report.tables import failures, number, outputs_of, remarks, study_rows, versions_apart

LARGEST = 1e308
"""What ∞ sorts as: the script reads finite numbers."""


@dataclass(frozen=True)
class Cell:
    """A number of a table."""

    text: str
    """As it is shown."""
    value: float
    """As it is sorted."""


@dataclass(frozen=True)
class Row:
    """A method and order on one output of one split."""

    look: Look
    """Which method."""
    order: int
    """Of the models."""
    split: str
    """train, val, or the name of a test set."""
    output: str
    """Name and unit, or which mean."""
    cells: list[Cell]
    """By `COLUMNS`."""


COLUMNS = (
    "runs",
    "median",
    "interval of the median",
    "q1–q3",
    "lowest–highest",
    "best by validation",
    "fit, median [%]",
)


@dataclass(frozen=True)
class Reference:
    """Tables of published numbers beside ours."""

    title: str
    """What they show."""
    note: str
    """What a reader must know of them."""
    tables: Sequence[tuple[str, Sequence[dict[str, str]]]]
    """Caption and rows of each; cells by the title of their column."""


@dataclass(frozen=True)
class Study:
    """A study of NN-SS, one switch at a time."""

    name: str
    """recipe, class or stability."""
    note: str
    """What its table shows."""
    rows: list[dict[str, str]]
    """By order and variant; cells by the title of their column."""
    changes: list[str]
    """What each variant changes."""


@dataclass(frozen=True)
class Section:
    """Everything of one dataset and protocol."""

    anchor: str
    """Unique on the page."""
    dataset: str
    """Its name."""
    protocol: str
    """Split and statistics."""
    about: str
    """What the dataset is, and where it is from; "" for files of the user."""
    runs: int
    """Number of runs."""
    looks: list[Look]
    """Of its methods."""
    orders: list[int]
    """Of its models."""
    splits: list[tuple[str, str]]
    """Name of each split and what it is called."""
    shown: list[str]
    """Those that the table begins with: the test sets, validation where there is none."""
    rows: list[Row]
    """Of the table of errors."""
    boxes: list[Picture]
    """Errors over seeds."""
    simulations: list[Trace]
    """Outputs, residuals and inputs of each test set."""
    states: Trace | None
    """Of the best NN-SS model; None where there is none."""
    curves: list[Curves]
    """Of each method and order that has any."""
    candidates: list[dict[str, str]]
    """What was tried before a model was chosen, by run."""
    certificates: list[dict[str, str]]
    """What is known of stability."""
    studies: list[Study]
    """What each switch of NN-SS is worth."""
    references: list[Reference]
    """Published numbers beside ours."""
    departures: list[str]
    """Methods with other settings than the paper's."""
    origin: Origin
    """Where the numbers came from."""
    notes: list[str]
    """What a reader of the scores must know."""
    failures: list[str]
    """Runs without a result."""
    remarks: list[str]
    """What the fits have to tell."""
    left_out: list[str]
    """Runs that do not stand in the tables."""


def section_of(store: Store, made_of: Table, looks: dict[str, Look], anchor: str) -> Section:
    """Gather a section.

    Args:
        store: where the runs are.
        made_of: those of them that go together, at least one.
        looks: of every method of the page.
        anchor: unique on the page.

    Raises:
        InputError: a run's file is damaged.
    """
    results = made_of.results
    found = studies(store)
    entry = BENCHMARKS.usable(store.dataset)
    splits = splits_of(results)
    about = f"{entry.title}. Source: {entry.citation}." if entry else titled_by(results)
    return Section(
        anchor, store.dataset, store.protocol, about,
        len(results), [looks[name] for name in methods_of(results)], sorted({r.spec.order for r in results}),
        [(name, split_name(name)) for name in splits], scored_splits(results),
        _rows(results, looks), _boxes(results, looks, anchor), simulation_traces(store, results, looks, anchor),
        state_trace(store, results, looks, anchor), curves_of(store, results, looks, anchor),
        candidate_rows(store, results), certificate_table(store, results),
        [
            Study(name, study_note(own), study_rows(own, intervals=True), changes(own))
            for name, own in found.items()
        ],
        _references(results),
        not_the_papers(results), origin_of(results),
        [*dict.fromkeys(note for r in results for note in r.notes), *versions_apart(results)], failures(results),
        remarks(results), [*made_of.left_out, *(line for own in found.values() for v in own for line in v.left_out)],
    )  # fmt: skip


def _rows(results: Sequence[RunResult], looks: dict[str, Look]) -> list[Row]:
    rows = []
    for split in splits_of(results):
        for method, order, own in groups(results):
            best = best_run(own)
            for output, name in outputs_of(results).items():
                errors = [output_error(r, split, output) for r in own]
                if best is None or not any(map(math.isfinite, errors)):
                    continue
                rows.append(Row(looks[method], order, split, name, _cells(own, errors, best, split, output)))
    return rows


def _cells(own: Sequence[RunResult], errors: list[float], best: RunResult, split: str, output: str) -> list[Cell]:
    several = len(errors) > 1
    ok = sum(map(math.isfinite, errors))
    median, q1, q3 = (quantile(errors, q) for q in (0.5, 0.25, 0.75))
    bounds = median_interval(errors)
    chosen = output_error(best, split, output)
    # a run without a result has no fit: it counts as the worst
    fits = [next((-s.fit_percent for s in r.scores if (s.split, s.output) == (split, output)), math.inf) for r in own]
    fit = -quantile(fits, 0.5)

    def span(low: float, high: float) -> Cell:
        return Cell(f"{number(low)}–{number(high)}" if several else "–", _finite(high - low) if several else -1.0)

    holds = f" ({bounds.coverage:.0%})" if several and round(bounds.coverage, 2) < 0.95 else ""
    interval = span(bounds.low, bounds.high)
    return [
        Cell(f"{ok}/{len(own)}", ok / len(own)), Cell(number(median), _finite(median)),
        Cell(interval.text + holds, interval.value), span(q1, q3), span(min(errors), max(errors)),
        Cell(number(chosen) + (f" (seed {best.spec.seed})" if several else ""), _finite(chosen)),
        Cell(f"{fit:.1f}" if math.isfinite(fit) else "–", fit if math.isfinite(fit) else -LARGEST),
    ]  # fmt: skip


def _finite(value: float) -> float:
    return value if math.isfinite(value) else LARGEST


def _boxes(results: Sequence[RunResult], looks: dict[str, Look], anchor: str) -> list[Picture]:
    pictures = []
    for i, split in enumerate(scored_splits(results)):
        for j, (output, name) in enumerate(outputs_of(results).items()):
            if output in (MEAN, NORMALISED):
                continue
            values: dict[Look, dict[int, list[float]]] = {}
            for method in methods_of(results):
                for result in results:
                    if result.spec.method == method:
                        by_order = values.setdefault(looks[method], {})
                        by_order.setdefault(result.spec.order, []).append(output_error(result, split, output))
            if any(math.isfinite(v) for by_order in values.values() for own in by_order.values() for v in own):
                title = f"Error over seeds on {split_name(split)}, by order and method: {name}"
                if any(math.isinf(v) for by_order in values.values() for own in by_order.values() for v in own):
                    title += "; a run without a result stands at the top"
                pictures.append(draw_boxes(f"{anchor}-box-{i}-{j}", title, f"RMSE, {name}", values))
    return pictures


def _references(results: Sequence[RunResult]) -> list[Reference]:
    published, sources = published_tables(results)
    places, notes = place_tables(results)
    found = [
        Reference(
            "Beside the paper's table",
            "The paper prints the best of ten seeds, chosen on test, so the verdict is on ours chosen likewise: "
            "reproduced (within 10 %, or in the last printed digit), better or worse. Only runs of which every setting "
            "is the paper's stand here.",
            [("Beside the paper's table", paper_rows(results))],
        ),
        Reference(
            "Beside the models that the authors released",
            "Medians over seeds, mean over outputs in physical units; only runs of which every setting is the paper's. "
            "The released medians' intervals follow from their quartiles (± 1.57 (q3 − q1)/√n), ours from order "
            "statistics.",
            [("Beside the models that the authors released", released_rows(results))],
        ),
        Reference(
            "Place among the paper's and the released models' errors",
            "Ours are medians over seeds of every method and recipe that ran. " + " ".join(notes),
            places,
        ),
        Reference(
            "Among the published results",
            "Ours are medians over seeds, each method at the order that validates best; the published ones are "
            "single models. Scored after the initialisation window. " + " ".join(sources),
            published,
        ),
        Reference(
            "Optimism of choosing on test",
            f"RMSE/σ on test of the best seed{', mean over outputs' * several_outputs(results)}.",
            [("Optimism of choosing on test", optimism_rows(results))],
        ),
    ]
    return [one for one in found if any(rows for _, rows in one.tables)]
