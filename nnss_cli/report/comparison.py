"""Write the tables and figures of one dataset and protocol, made of its runs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from nnss_cli.datasets.record import FloatArray
from nnss_cli.datasets.units import has_unit
from nnss_cli.errors import InputError
from nnss_cli.experiment.agreement import Table, agreeing
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.files import write_text
from nnss_cli.methods import METHODS
from nnss_cli.modelfile import Tensors
from nnss_cli.report import figures, timeplots
from nnss_cli.report.aggregate import (
    axes,
    best_by_method,
    long_table,
    methods_of,
    places,
    runs_by_method,
    scored_splits,
    split_name,
    titled_by,
)
from nnss_cli.report.dense import is_dense
from nnss_cli.report.style import FORMATS, SCREEN, Look, shortened, styles_of
from nnss_cli.report.tables import rmse_markdown

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
            if figure is None or suffix not in wanted:  # one of an earlier set of runs, or of an earlier call
                (folder / f"{name}.{suffix}").unlink(missing_ok=True)
        if figure is not None:
            paths = [folder / f"{name}.{suffix}" for suffix in FORMATS if suffix in wanted]
            figures.save_figure(figure, *paths)
            written += paths
    return written


def _title(results: Sequence[RunResult]) -> str:
    title, name, protocol = titled_by(results), results[0].spec.dataset, f"protocol {results[0].spec.protocol}"
    return f"{shortened(title, 100)} ({name}, {protocol})" if title else f"{name} ({protocol})"


def _boxplot(results: Sequence[RunResult], look: Look = SCREEN) -> Figure | None:
    splits = scored_splits(results)
    units = places(results[0])
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
                        labels[panel] = f"RMSE [{axis.unit}]" if has_unit(axis.unit) else "RMSE"
                        shown = ([split_name(split)] if len(splits) > 1 else []) + [shortened(axis.name, 40)] * (
                            len(units) > 1
                        )
                        titles[panel] = ", ".join(shown)
                        by_order = values.setdefault(panel, {}).setdefault(method, {})
                        by_order.setdefault(result.spec.order, []).append(score.rmse)
    if not values:
        return None
    what = split_name(splits[0]) if len(splits) == 1 else "test"
    of = f" of {shortened(units['y1'].name, 60)}" if len(units) == 1 else ""
    title = f"{_title(results)}: {what} RMSE{of}{_over_seeds(results)}"
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
        title = f"{_title(results)}: {_records(split, lengths)}, each method's best run by validation"
        name = "simulation" if split in ("test", "val") else f"simulation-{split}"
        inputs = list(zip(axes(results[0], "input"), joined(any_signals, split, "u").T, strict=True))
        found[name] = timeplots.draw_simulation(
            time, measured, simulated, axes(results[0], "output"), unit, title, transient(measured[: lengths[0]]),
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
        f"{_title(results)}: latent states of the best NN-SS run by validation\n"
        f"(n = {result.spec.order}, seed {result.spec.seed}; {_records(split, lengths)}, measured outputs on top)"
    )
    return timeplots.draw_states(
        time, joined(signals, split, "x"), measured, axes(result, "output"), unit, title, starts(lengths), look
    )


def _time(K: int, Ts: float) -> tuple[FloatArray, str]:
    time = np.arange(K) * Ts
    return (time / HOUR, "h") if K * Ts > 3 * HOUR else (time, "s")
