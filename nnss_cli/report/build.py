"""Write the tables and figures of a comparison, and the report over all of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nnss_cli.datasets.catalog import BENCHMARKS
from nnss_cli.datasets.record import FloatArray
from nnss_cli.errors import InputError
from nnss_cli.experiment.ablation import Variant
from nnss_cli.experiment.agreement import Table, agreeing
from nnss_cli.experiment.order import OrderRow
from nnss_cli.experiment.provenance import MADE_WITH
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store, stores
from nnss_cli.files import write_text
from nnss_cli.methods import METHODS
from nnss_cli.modelfile import Tensors
from nnss_cli.report import figures
from nnss_cli.report.aggregate import (
    best_by_method,
    long_table,
    methods_of,
    runs_by_method,
    scored_splits,
    several_outputs,
    split_name,
)
from nnss_cli.report.dense import is_dense
from nnss_cli.report.evidence import (
    QUIRKS,
    intervals,
    not_the_papers,
    optimism,
    paper_comparison,
    released_comparison,
)
from nnss_cli.report.published import paper_places, published_comparison
from nnss_cli.report.standing import (
    MEANING,
    combinations,
    effects,
    missing_runs,
    ranking,
    record_table,
    too_few,
    unscored,
)
from nnss_cli.report.statistics import MIN_RECORDS, mean_ranks, paired_tests
from nnss_cli.report.style import FORMATS, SCREEN, Axis, Look, styles_of
from nnss_cli.report.tables import failures, markdown, rmse_markdown, study_rows

HOUR = 3600.0
CYCLES = 160  # samples of which each is to be seen


def write_comparison(store: Store, times: bool = True, table: Table | None = None, look: Look = SCREEN) -> list[Path]:
    """Rebuild rmse.csv, rmse.md and the figures of one dataset and protocol from its runs.

    Args:
        store: where the runs are.
        times: whether rmse.csv holds the wall times; without, equal runs give equal files.
        table: which of them; what agrees unless given.
        look: size and formats of the figures. Those of other formats, of an earlier call, are taken away.

    Returns:
        The files written, figures that have nothing to show left out.

    Raises:
        InputError: there are no finished runs.
    """
    made_of = table or agreeing(store, store.read())
    results = made_of.results
    if not results:
        raise InputError(f"no finished runs in '{store.folder}': run 'nnss compare {store.dataset}' first")
    with store.writing():
        return _write_files(store, made_of, times, look)


def _write_files(store: Store, made_of: Table, times: bool, look: Look) -> list[Path]:
    folder, results = store.folder, made_of.results
    rows = long_table(results)
    if not times:
        rows["fit_seconds"] = None
    write_text(folder / "rmse.csv", rows.to_csv(index=False, lineterminator="\n"))
    write_text(folder / "rmse.md", rmse_markdown(results, made_of.left_out))
    written = [folder / "rmse.csv", folder / "rmse.md"]
    drawn = {
        "boxplot": _boxplot(results, look),
        "states": _states(store, results, look),
        **_simulations(store, results, look),
    }
    for name, figure in drawn.items():
        wanted = look.formats or (("png", "svg") if name == "boxplot" else ("png",))
        for suffix in FORMATS:
            path = folder / f"{name}.{suffix}"
            if figure is None or suffix not in wanted:
                path.unlink(missing_ok=True)  # one of an earlier set of runs, or of an earlier call
            else:
                figures.save_figure(figure, path)
                written.append(path)
        if figure is not None:
            figures.close_figure(figure)
    return written


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
        "Rebuilt by `nnss report` from the runs on disk, without training. RMSE of free simulations from the first "
        "output sample, in physical units.",
    ]
    for protocol in sorted({store.protocol for store in found}):
        parts += _overall([r for s in found if s.protocol == protocol for r in tables[s].results], protocol, out)
    for store in found:
        files = write_comparison(store, times, tables[store], look)
        parts.append(_section(store, tables[store].results, files, out))
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
        return [*parts, too_few(len(table))]
    tests = paired_tests(table)
    figure = figures.draw_ranks(
        mean_ranks(table), [(t.first, t.second) for t in tests if not t.differ],
        f"Mean ranks over {len(table)} records, protocol {protocol}; a bar joins methods not shown to differ at 5 %",
    )  # fmt: skip
    name = f"ranks-{protocol}.png"
    figures.save_figure(figure, out / name)
    figures.close_figure(figure)
    parts += [ranking(table, tests), f"![critical-difference diagram, protocol {protocol}]({name})"]
    return parts + _listed("Left out", left_out)


def _listed(title: str, lines: Sequence[str]) -> list[str]:
    return [f"{title}:\n\n" + "\n".join(f"- {line}" for line in lines)] if lines else []


def write_study(store: Store, study: str, variants: Sequence[Variant]) -> Path:
    """Write study-<name>.md with a row per order and variant."""
    path = store.folder / f"study-{study}.md"
    runs = [result for variant in variants for result in variant.results]
    seeds = len({result.spec.seed for result in runs})
    text = (
        f"# NN-SS on {store.dataset}, protocol `{store.protocol}`: {study}\n\n"
        f"{'Mean over outputs of RMSE/σ' if several_outputs(runs) else 'RMSE'}, median over {seeds} "
        f"seed{'s' * (seeds > 1)} with its interval by order statistics. One switch at a time; runs under "
        f"`{store.out.name}/ablation/{study}/`.\n\n"
    )
    write_text(path, text + markdown(study_rows(variants, intervals=True)) + "\n")
    return path


def write_orders(rows: Sequence[OrderRow], chosen: int, folder: Path, title: str) -> list[Path]:
    """Write order.csv and order.png of an order selection."""
    table = pd.DataFrame([vars(row) | {"suggested": row.order == chosen} for row in rows])
    write_text(folder / "order.csv", table.to_csv(index=False, lineterminator="\n"))
    figure = figures.draw_orders(
        [row.order for row in rows],
        [row.hankel for row in rows],
        [row.train for row in rows],
        [row.val for row in rows],
        chosen,
        title,
    )
    figures.save_figure(figure, folder / "order.png")
    figures.close_figure(figure)
    return [folder / "order.csv", folder / "order.png"]


def _section(store: Store, results: Sequence[RunResult], files: Sequence[Path], out: Path) -> str:
    entry = BENCHMARKS.usable(store.dataset)
    table = (store.folder / "rmse.md").read_text(encoding="utf-8")
    parts = [f"## {store.dataset}, protocol `{store.protocol}`"]
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
            paper_comparison(results),
        ),
        (
            "Beside the models that the authors released\n\nMedians over seeds, mean over outputs in physical units; "
            "only runs of which every setting is the paper's. The released medians' intervals follow from their "
            "quartiles (± 1.57 (q3 − q1)/√n), ours from order statistics.",
            released_comparison(results),
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
        ("Optimism of choosing on test\n\nRMSE/σ on test of the best seed, mean over outputs.", optimism(results)),
    ):
        if body:
            parts.append(f"### {title}\n\n{body}")
    parts += _listed("Run with other settings than the paper's, and so not compared with it", not_the_papers(results))
    for study in sorted(store.folder.glob("study-*.md")):
        title, body = study.read_text(encoding="utf-8").split("\n", 1)
        parts.append(f"### Study: {title.rpartition(': ')[2]}\n{body}".rstrip())
    parts.append("### Figures")
    parts += [
        f"![{path.stem} of {store.dataset}, protocol {store.protocol}]({path.relative_to(out).as_posix()})"
        for path in _pictures(files)
    ]
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


def _axes(result: RunResult, kind: str) -> list[Axis]:
    """Names and units of a run's "input"s or "output"s."""
    channels = result.channels
    return [Axis(name, unit) for name, unit in zip(channels[f"{kind}s"], channels[f"{kind}_units"], strict=True)]


def _title(result: RunResult) -> str:
    return f"{result.spec.dataset} (protocol {result.spec.protocol})"


def _boxplot(results: Sequence[RunResult], look: Look = SCREEN) -> Figure | None:
    splits = scored_splits(results)
    units = {f"y{i + 1}": axis for i, axis in enumerate(_axes(results[0], "output"))}
    values: dict[str, dict[str, dict[int, list[float]]]] = {}
    labels: dict[str, str] = {}
    titles: dict[str, str] = {}
    for split in splits:
        for method in methods_of(results):
            for result in results:
                for score in result.scores if result.spec.method == method else ():
                    if score.split == split:
                        panel = f"{split}/{score.output}"
                        axis = units[score.output]
                        labels[panel] = f"RMSE{'' if axis.unit in ('–', '') else f' [{axis.unit}]'}"
                        shown = ([split_name(split)] if len(splits) > 1 else []) + [axis.name] * (len(units) > 1)
                        titles[panel] = ", ".join(shown)
                        by_order = values.setdefault(panel, {}).setdefault(method, {})
                        by_order.setdefault(result.spec.order, []).append(score.rmse)
    if not values:
        return None
    what = split_name(splits[0]) if len(splits) == 1 else "test"
    of = f" of {units['y1'].name}" if len(units) == 1 else ""
    title = f"{_title(results[0])}: {what} RMSE{of}{_over_seeds(results)}"
    lost = [
        f"{failed} of {len(own)} {styles_of([method])[method].label}, n = {order}"
        for (method, order), own in runs_by_method(results).items()
        if (failed := sum(result.status != "ok" for result in own))
    ]
    if lost:
        title += "\nnot drawn, without a result: " + "; ".join(lost)
    return figures.draw_boxplot(values, labels, title, titles, look)


def _over_seeds(results: Sequence[RunResult]) -> str:
    """How many seeds a box is over, where there are any: other methods have one run."""
    known = methods_of(results)
    seeded = [name for name in known if name in METHODS and METHODS[name].seeded]
    seeded += [
        name for name in known if name not in METHODS and any(r.spec.seed for r in results if r.spec.method == name)
    ]
    seeds = len({result.spec.seed for result in results if result.spec.method in seeded})
    if not seeds:
        return ""
    over = f" over {seeds} seed{'s' * (seeds > 1)}"
    return over if len(seeded) == len(known) else f"{over}; of methods without seeds one run"


def _simulations(store: Store, results: Sequence[RunResult], look: Look = SCREEN) -> dict[str, Figure | None]:
    """A figure for each test set (validation where there is none), by the name of its file."""
    best = best_by_method(results)
    if not best:
        return {"simulation": None}
    signals = {method: store.signals(result.spec) for method, result in best.items()}
    found: dict[str, Figure | None] = {}
    for split in scored_splits(results):
        simulated = {
            method: (f"(n = {result.spec.order})", joined(signals[method], split, "y_sim"))
            for method, result in best.items()
        }
        any_signals = next(iter(signals.values()))
        measured, lengths = joined(any_signals, split, "y"), record_lengths(any_signals, split)
        time, unit = _time(len(measured), float(any_signals["Ts"][0]))
        title = f"{_title(results[0])}: {_records(split, lengths)}, each method's best run by validation"
        name = "simulation" if split in ("test", "val") else f"simulation-{split}"
        inputs = list(zip(_axes(results[0], "input"), joined(any_signals, split, "u").T, strict=True))
        found[name] = figures.draw_simulation(
            time, measured, simulated, _axes(results[0], "output"), unit, title, transient(measured[: lengths[0]]),
            starts(lengths), inputs, True, look,
        )  # fmt: skip
    return found


def record_lengths(signals: Tensors, split: str) -> list[int]:
    """Samples of each record of a split, in order."""
    count = sum(name.startswith(f"{split}/") and name.endswith("/y") for name in signals)
    return [len(signals[f"{split}/{index}/y"]) for index in range(count)]


def joined(signals: Tensors, split: str, name: str) -> FloatArray:
    """A signal of all records of a split, one after the other (ΣK, ·)."""
    return np.concatenate([signals[f"{split}/{i}/{name}"] for i in range(len(record_lengths(signals, split)))])


def starts(lengths: Sequence[int]) -> list[int]:
    """Samples at which the second and later records begin."""
    return list(itertools.accumulate(lengths))[:-1]


def _records(split: str, lengths: Sequence[int]) -> str:
    name = split_name(split)
    return f"{name} record" if len(lengths) == 1 else f"{len(lengths)} {name} records, one after the other"


def transient(measured: FloatArray) -> slice | None:
    """The part of a long record (200 samples or more) over which its outputs range most; else None.

    A twelfth of it; some oscillations of a record that has very many.
    """
    K = len(measured)
    if K < 200:
        return None
    length = max(60, K // 12)
    if any(is_dense(y) for y in measured.T):
        length = min(length, CYCLES)
    spread = np.maximum(measured.max(axis=0) - measured.min(axis=0), np.finfo(float).tiny)
    windows = np.lib.stride_tricks.sliding_window_view(measured / spread, length, axis=0)
    start = int(np.argmax((windows.max(axis=2) - windows.min(axis=2)).sum(axis=1)))
    return slice(start, start + length)


def _states(store: Store, results: Sequence[RunResult], look: Look = SCREEN) -> Figure | None:
    split, *_ = scored_splits(results)
    result = best_by_method(results).get("nnss")
    if result is None:
        return None
    signals = store.signals(result.spec)
    measured, lengths = joined(signals, split, "y"), record_lengths(signals, split)
    time, unit = _time(len(measured), float(signals["Ts"][0]))
    title = (
        f"{_title(result)}: latent states of the best NN-SS run by validation\n"
        f"(n = {result.spec.order}, seed {result.spec.seed}; {_records(split, lengths)}, measured outputs on top)"
    )
    return figures.draw_states(
        time, joined(signals, split, "x"), measured, _axes(result, "output"), unit, title, starts(lengths), look
    )


def _time(K: int, Ts: float) -> tuple[FloatArray, str]:
    time = np.arange(K) * Ts
    return (time / HOUR, "h") if K * Ts > 3 * HOUR else (time, "s")
