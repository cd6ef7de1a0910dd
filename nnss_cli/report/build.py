"""Write the report over all comparisons, and an order selection."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import pandas as pd

from nnss_cli.datasets.catalog import BENCHMARKS
from nnss_cli.datasets.record import heading
from nnss_cli.errors import InputError
from nnss_cli.experiment.ablation import Variant, studies
from nnss_cli.experiment.agreement import agreeing
from nnss_cli.experiment.order import OrderRow
from nnss_cli.experiment.provenance import MADE_WITH
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store, stores
from nnss_cli.files import write_text
from nnss_cli.report import figures
from nnss_cli.report.aggregate import titled_by
from nnss_cli.report.cells import escaped
from nnss_cli.report.comparison import write_comparison
from nnss_cli.report.evidence import (
    QUIRKS,
    intervals,
    not_the_papers,
    optimism_rows,
    paper_rows,
    released_rows,
)
from nnss_cli.report.published import paper_places, published_comparison
from nnss_cli.report.standing import (
    MEANING,
    combinations,
    effects,
    missing_runs,
    no_ranking,
    ranking,
    record_table,
    unscored,
)
from nnss_cli.report.statistics import MIN_RECORDS, mean_ranks, paired_tests
from nnss_cli.report.studies import study_text, write_study
from nnss_cli.report.style import FORMATS, SCREEN, Look
from nnss_cli.report.tables import FREE, failures, markdown


def write_report(
    out: Path, times: bool = True, tell: Callable[[str], None] = lambda _: None, look: Look = SCREEN
) -> Path:
    """Rebuild every comparison under `out` and write report.md.

    Args:
        out: folder of results.
        times: as in `write_comparison`.
        tell: hears of each run, or group of runs, that is left out because its files are damaged or disagree.
        look: as in `write_comparison`.

    Raises:
        InputError: there are no finished runs.
    """
    tables = {store: agreeing(store, store.read()) for store in stores(out)}
    for line in (line for table in tables.values() for line in table.left_out):
        tell(line)
    found = [store for store, table in tables.items() if table.results]
    if not found:
        raise InputError(f"no finished runs under '{out}': run 'nnss compare DATASET' first, or give --out")
    parts = [
        "# Comparison of identification methods",
        f"Rebuilt by `nnss report` from the runs on disk, without training. RMSE in physical units of {FREE}.",
    ]
    for protocol in sorted({store.protocol for store in found}):
        parts += _overall([r for s in found if s.protocol == protocol for r in tables[s].results], protocol, out)
    for store in found:
        files = write_comparison(store, times, tables[store], look)
        found_studies = studies(store)
        for line in (line for variants in found_studies.values() for one in variants for line in one.left_out):
            tell(line)
        parts.append(_section(store, tables[store].results, found_studies, files, out))
    path = out / "report.md"
    write_text(path, "\n\n".join(parts) + "\n")
    return path


def _overall(results: Sequence[RunResult], protocol: str, out: Path) -> list[str]:
    """Methods over all datasets and orders of a protocol, on one split a table."""
    parts = [QUIRKS] if protocol == "paper" else []
    tables = {split: effects(results, split) for split in ("test", "val")}
    if not any(tables.values()):
        return parts
    parts += [f"## All datasets, protocol `{protocol}`", MEANING]
    for split, title in (
        ("test", "Test"),
        ("val", "Validation: what methods were stopped and chosen on, so no evidence of how they stand"),
    ):
        apart = combinations(results, split)
        parts.append(f"### {title}\n\n{tables[split] or 'Nothing to compare.'}")
        if apart:
            parts.append(f"Combinations of runs, beside the runs that they are made of:\n\n{apart}")
        parts += _listed("Not in this table", unscored(results, split))
    parts += _listed("Missing runs", missing_runs(results))
    table, left_out = record_table(results)
    parts.append("### Ranks over records")
    if len(table) < MIN_RECORDS or table.shape[1] < 2:
        why = no_ranking(*table.shape)
        return [*parts, why, *(_listed("Left out", left_out) if len(table) >= MIN_RECORDS else [])]
    tests = paired_tests(table)
    figure = figures.draw_ranks(
        mean_ranks(table), [(t.first, t.second) for t in tests if not t.differ],
        f"Mean ranks over {len(table)} records, protocol {protocol}; a bar joins methods not shown to differ at 5 %",
    )  # fmt: skip
    name = f"ranks-{protocol}.png"
    figures.save_figure(figure, out / name)
    parts += [ranking(table, tests), f"![critical-difference diagram, protocol {protocol}]({name})"]
    return parts + _listed("Left out", left_out)


def _listed(title: str, lines: Sequence[str]) -> list[str]:
    return [f"{title}:\n\n" + "\n".join(f"- {escaped(line)}" for line in lines)] if lines else []


def write_orders(rows: Sequence[OrderRow], chosen: int, folder: Path, measure: str, title: str) -> list[Path]:
    """Write order.csv and order.png of an order selection."""
    table = pd.DataFrame([vars(row) | {"suggested": row.order == chosen} for row in rows])
    write_text(folder / "order.csv", table.to_csv(index=False, lineterminator="\n"))
    figure = figures.draw_orders(
        [row.order for row in rows],
        [row.hankel for row in rows],
        [row.train for row in rows],
        [row.val for row in rows],
        chosen,
        measure,
        title,
    )
    figures.save_figure(figure, folder / "order.png")
    return [folder / "order.csv", folder / "order.png"]


def _section(
    store: Store, results: Sequence[RunResult], found: dict[str, list[Variant]], files: Sequence[Path], out: Path
) -> str:
    entry = BENCHMARKS.usable(store.dataset)
    table = (store.folder / "rmse.md").read_text(encoding="utf-8")
    parts = [f"## {escaped(heading(titled_by(results), store.dataset))}, protocol `{store.protocol}`"]
    if entry:
        parts.append(f"{entry.title}. Source: {entry.citation}.")
    # The comparison's own page, its headings one level down.
    parts.append("\n".join(f"#{line}" if line.startswith("##") else line for line in table.splitlines()[2:]).strip())
    for title, body in (
        (
            "Medians over seeds\n\nWith intervals by order statistics: how far the median depends on the seed, on this "
            "record and split. They say nothing about another record.",
            intervals(results),
        ),
        (
            "Beside the paper's table\n\nThe paper prints the best of ten seeds, chosen on test, so the verdict is on "
            "ours chosen likewise: reproduced (within 10 %, or in the last printed digit), better or worse. Only runs "
            "of which every setting is the paper's stand here.",
            markdown(paper_rows(results)),
        ),
        (
            "Beside the models that the authors released\n\nMedians over seeds, mean over outputs in physical units; "
            "only runs of which every setting is the paper's. The released medians' intervals follow from their "
            "quartiles (± 1.57 (q3 − q1)/√n), ours from order statistics.",
            markdown(released_rows(results)),
        ),
        (
            "Places beside the paper and its released models\n\nEvery method and recipe that ran (bold), medians over "
            "seeds, among what the paper prints and its authors released. A place is no test: intervals that overlap "
            "settle nothing.",
            paper_places(results),
        ),
        (
            "Among the published results\n\nOurs are medians over seeds, each method at the order that validates best; "
            "the published ones are single models. Scored after the initialisation window.",
            published_comparison(results),
        ),
        (
            "Optimism of choosing on test\n\nRMSE/σ on test of the best seed, mean over outputs.",
            markdown(optimism_rows(results)),
        ),
    ):
        if body:
            parts.append(f"### {title}\n\n{body}")
    parts += _listed("Run with other settings than the paper's, and so not compared with it", not_the_papers(results))
    for study, variants in found.items():
        write_study(store, study, variants)
        parts.append(f"### Study: {study}\n\n{study_text(store, study, variants)}".rstrip())
    parts.append("### Figures")
    for path in _pictures(files):
        shown = escaped(f"{path.stem} of {store.dataset}, protocol {store.protocol}")
        parts.append(f"![{shown}]({path.relative_to(out).as_posix()})")
    versions = sorted({_versions(result) for result in results})
    parts.append(
        f"{len(results)} runs, {len(failures(results))} without a result. Made with " + "; ".join(versions) + "."
    )
    return "\n\n".join(parts)


def _versions(result: RunResult) -> str:
    return ", ".join(f"{name} {result.provenance.get(name, 'unknown')}" for name in (*MADE_WITH, "machine", "cpu"))


def _pictures(files: Sequence[Path]) -> list[Path]:
    """One file of each figure: a PNG where there is one, else what a page shows as well as it can."""
    best: dict[str, Path] = {}
    for suffix in FORMATS:
        for path in files:
            if path.suffix == f".{suffix}":
                best.setdefault(path.stem, path)
    return [best[path.stem] for path in dict.fromkeys(path.with_suffix("") for path in files) if path.stem in best]
