"""What Python has of the commands: `fit`, `compare` and `inspect`, with the same records, runs and folders.

import nnss_cli as nnss

study = nnss.compare("plant.csv", inputs=["u"], outputs=["y"], Ts=0.1, orders=[2, 3], seeds=5)
study.table                       # a DataFrame
model = study.best()              # by validation; the test has no say
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pandas as pd

from nnss_cli.datasets.description import Description
from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError, unknown
from nnss_cli.experiment.changes import gathered
from nnss_cli.experiment.inspection_files import Seen, examine_files
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.source import Ready, ready
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan, sweep
from nnss_cli.files import require_writable
from nnss_cli.methods import METHODS, Method, select
from nnss_cli.methods.options import options_of
from nnss_cli.report.aggregate import best_run, long_table, summary
from nnss_cli.trained import TrainedModel, load

Source: TypeAlias = str | Path | Sequence[str | Path] | Dataset
"""A benchmark's name, a description (.toml), a file or several with an experiment each, or a dataset."""


class NoModelError(ArithmeticError):
    """A fit that gave no model; the message says why."""


@dataclass(frozen=True, eq=False)
class Study:
    """Finished runs on one dataset: methods × orders × seeds."""

    dataset: Dataset
    """What was fitted and scored."""
    results: tuple[RunResult, ...]
    """A run each; one that failed is a result with a reason."""
    store: Store
    """Where they are kept."""

    @cached_property
    def table(self) -> pd.DataFrame:
        """RMSE over seeds, by order, method, split and output: median, quartiles, the seed best on validation."""
        return summary(self.results)

    @cached_property
    def runs(self) -> pd.DataFrame:
        """One row per run, split and output; a run without a result is one row with its reason."""
        return long_table(self.results)

    def best(self, method: str | None = None, order: int | None = None) -> TrainedModel:
        """The model with the lowest validation error, of all or of one method or order.

        Raises:
            InputError: none of these runs has a model.
        """
        own = [
            result
            for result in self.results
            if method in (None, result.spec.method) and order in (None, result.spec.order)
        ]
        chosen = best_run(own)
        if chosen is None:
            found = ", ".join(dict.fromkeys(f"{r.spec.method} of order {r.spec.order}" for r in self.results))
            raise InputError(
                f"expected a run with a model, of method {method or 'any'} and order {order or 'any'}: "
                f"found {found or 'no run'}, {len(own)} asked for and none of them ok"
            )
        return load(self.store.run_folder(chosen.spec))


def compare(
    data: Source,
    *,
    orders: Sequence[int] | None = None,
    seeds: int = 10,
    methods: Sequence[str] | None = None,
    settings: Mapping[str, Any] | None = None,
    out: str | Path = "results",
    jobs: int = 1,
    force: bool = False,
    protocol: str = "",
    mirror: str | None = None,
    offline: bool = False,
    **record: Any,
) -> Study:
    """Run methods × orders × seeds; finished runs under `out` are not repeated.

    Args:
        data: what to identify.
        orders: numbers of states n; the dataset's own where it has some.
        seeds: number of seeds, from 0 on, of methods that have one.
        methods: by name; all built-in ones by default.
        settings: options of methods, for each that has them, or "METHOD.OPTION" for one (`nnss methods`).
        out: folder of results, as that of the commands.
        jobs: processes; a script that asks for several needs `if __name__ == "__main__":`.
        force: repeat finished runs.
        protocol: of a benchmark; its first by default.
        mirror: where to fetch a benchmark's file from first.
        offline: touch no network.
        record: keys of a description (docs/own-data.md): inputs, outputs, Ts or time, split, …

    Raises:
        InputError: whatever is wrong with the files or arguments, in one line.

    Examples:
        >>> study = compare(
        ...     "plant.csv", inputs=["u"], outputs=["y"], Ts=0.1, orders=[1, 2], seeds=1, methods=["n4sid", "ssregest"]
        ... )
        >>> [(result.spec.method, result.spec.order, result.status) for result in study.results]
        [('n4sid', 1, 'ok'), ('n4sid', 2, 'ok'), ('ssregest', 1, 'ok'), ('ssregest', 2, 'ok')]
        >>> study.best(order=2).order
        2
    """
    prepared = _prepared(data, protocol, mirror, offline, record)
    seeds, jobs = _whole("seeds", seeds, 1), _whole("jobs", jobs, 1)
    if isinstance(methods, str):
        raise InputError(f"methods: expected a list of names, found '{methods}': write ['{methods}']")
    chosen = select(_several("methods", methods or (), "names"))
    own = (
        None
        if orders is None
        else [_whole("orders", order, 1) for order in _several("orders", orders, "whole numbers")]
    )
    return _studied(prepared, chosen, prepared.orders_or(own), range(seeds), settings, out, jobs, force)


def fit(
    data: Source,
    order: int,
    *,
    method: str = "nnss",
    seed: int = 0,
    settings: Mapping[str, Any] | None = None,
    out: str | Path = "results",
    force: bool = False,
    protocol: str = "",
    mirror: str | None = None,
    offline: bool = False,
    **record: Any,
) -> TrainedModel:
    """Train one model, as `nnss train` does, and open it.

    Args:
        data: as for `compare`.
        order: number of states n.
        method: by name.
        seed: of weights and shuffling.
        settings: options of the method.
        out: folder of results.
        force: train it again even if it is there.
        protocol: of a benchmark.
        mirror: where to fetch a benchmark's file from first.
        offline: touch no network.
        record: keys of a description.

    Raises:
        InputError: whatever is wrong with the files or arguments.
        NoModelError: the fit diverged or could not be done; the message says why.

    Examples:
        >>> model = fit("plant.csv", 2, method="n4sid", inputs=["u"], outputs=["y"], Ts=0.1)
        >>> model.simulate([0.0, 1.0, 1.0, 0.0]).y.shape  # at rest under the first input
        (4, 1)
    """
    prepared = _prepared(data, protocol, mirror, offline, record)
    (chosen, *_) = select([method])
    order, seed = _whole("order", order, 1), _whole("seed", seed, 0)
    study = _studied(prepared, [chosen], [order], [seed], settings, out, 1, force)
    wanted = (method, order, seed if chosen.seeded else 0)
    result = next(r for r in study.results if (r.spec.method, r.spec.order, r.spec.seed) == wanted)
    if result.status != "ok":
        raise NoModelError(f"{result.spec.label} {result.status}: {result.reason}")
    return load(study.store.run_folder(result.spec))


def inspect(files: str | Path | Sequence[str | Path], **record: Any) -> Seen:
    """What is in a record: length, gaps, excitation, delays, coherence, a first guess of the order, a split.

    Args:
        files: a description (.toml), or a file for each experiment.
        record: keys of a description; roles of columns are guessed by their names where they are not given, and a
            split, orders and a window recommended.

    Returns:
        `found` is the inspection (`found.remarks` in sentences), `roles` which column was taken for what.

    Raises:
        InputError: a file cannot be read, or has no such column.

    Examples:
        >>> seen = inspect("plant.csv", inputs=["u"], outputs=["y"], Ts=0.1)
        >>> [channel.name for channel in seen.found.channels]
        ['u', 'y']
    """
    return examine_files(_names(files), _described(record))


def _prepared(data: Source, protocol: str, mirror: str | None, offline: bool, record: Mapping[str, Any]) -> Ready:
    if isinstance(data, Dataset):
        if record or protocol:
            raise InputError(
                f"{', '.join(record) or 'protocol'}: expected for a benchmark or files, found a Dataset, which has "
                "it all"
            )
        return Ready(data, ())
    return ready(_names(data), protocol, mirror, offline, _described(record))


def _whole(name: str, value: Any, least: int) -> int:
    """A whole number, NumPy's too: what is kept in a run's name and found again by it.

    Raises:
        InputError: it is none, or below `least`.
    """
    try:
        found = None if isinstance(value, bool | np.bool_) else operator.index(value)
    except TypeError:
        found = None
    if found is None or found < least:
        raise InputError(f"{name}: expected a whole number of at least {least}, found {value!r:.60}")
    return found


def _several(name: str, values: Any, of: str) -> list[Any]:
    try:
        return [*values]
    except TypeError as error:
        raise InputError(f"{name}: expected a list of {of}, found {values!r:.60}") from error


def _studied(
    prepared: Ready,
    methods: Sequence[Method],
    orders: Sequence[int],
    seeds: Sequence[int],
    settings: Mapping[str, Any] | None,
    out: str | Path,
    jobs: int,
    force: bool,
) -> Study:
    """Do the runs that are missing; the study of all that were asked for."""
    dataset, changes = prepared.dataset, _changes(methods, settings)
    store = Store(Path(out), dataset.name, dataset.protocol)
    todo = plan(store, dataset, methods, orders, seeds, prepared.settings | changes, force)
    require_writable(store.folder)
    sweep(todo.todo, dataset, store, jobs, lambda _: None, lambda _: None)
    return Study(dataset, tuple(result for result in store.results() if result.spec.label in todo.labels), store)


def _described(record: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments as keys of a description.

    Raises:
        InputError: there is no such key.
    """
    valid = [option.name for option in fields(Description) if "check" in option.metadata and option.name != "files"]
    for name in record:
        if name not in valid:
            raise InputError(f"unknown argument '{name}': what describes a record is {', '.join(valid)}")
    return dict(record)


def _changes(methods: Sequence[Method], settings: Mapping[str, Any] | None) -> dict[str, Any]:
    """Options of methods as `plan` takes them.

    Raises:
        InputError: no chosen method has such an option.
    """
    if not isinstance(settings, Mapping | None):
        raise InputError(f"settings: expected values by the name of an option, found {settings!r:.60}")
    changes = {name: tuple(value) if isinstance(value, list) else value for name, value in (settings or {}).items()}
    plain = {name: value for name, value in changes.items() if "." not in name}
    gathered(plain, [], [method.name for method in methods], {name: f"settings '{name}'" for name in plain})
    running = dict.fromkeys(name for method in methods for name in (method.name, method.members) if name)
    valid = [f"{name}.{option}" for name in running for option in options_of(METHODS[name].options)]
    for name in changes.keys() - plain.keys():
        if name not in valid:
            raise unknown("setting", name, valid)
    return changes


def _names(files: str | Path | Sequence[str | Path]) -> list[str]:
    names: list[Any] = [files]
    if isinstance(files, Iterable) and not isinstance(files, str | pd.DataFrame | np.ndarray):
        names = [*files]
    if not names:
        raise InputError("data: expected a benchmark's name or files, found none")
    if not all(isinstance(name, str | Path) for name in names):
        raise InputError(
            f"data: expected a benchmark's name or files, found {type(files).__name__}: write it to a file first, or "
            "make a Dataset of it"
        )
    return [str(name) for name in names]
