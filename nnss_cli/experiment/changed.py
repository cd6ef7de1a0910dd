"""What of a record has changed since a run was made of it, as far as what is kept with the run tells."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from nnss_cli.datasets.record import Dataset, Record
from nnss_cli.errors import InputError
from nnss_cli.experiment.origin import read_origin
from nnss_cli.experiment.run import RunResult
from nnss_cli.experiment.store import Store
from nnss_cli.modelfile import Tensors


def changed_data(store: Store, result: RunResult, dataset: Dataset) -> str:
    """In what the data of a finished run differ from those at hand, in words; "" where what is kept does not tell."""
    fitting, told = dataset.fitting, []
    names = {"inputs": "names", "outputs": "names", "input_units": "units", "output_units": "units"}
    for key, now in asdict(fitting.channels).items():
        pairs = list(zip(result.channels[key], now, strict=False))
        told += [f"{names[key]} ('{old}' instead of '{new}')" for old, new in pairs if old != new]
    try:
        signals, origin = store.signals(result.spec), read_origin(store.run_folder(result.spec))
    except InputError:
        return ", ".join(told)
    Ts = float(signals["Ts"][0])
    if Ts != fitting.Ts:
        told.append(f"Ts ({Ts:g} s instead of {fitting.Ts:g} s)")
    if origin is not None and origin.init_window != fitting.init_window:
        told.append(f"init window ({origin.init_window} instead of {fitting.init_window})")
    splits = [name for name, records in dataset.splits().items() if not _are_kept(signals, name, records)]
    if splits:
        told.append(f"samples of {', '.join(splits)}")
    # of what decides, the scaling alone is not compared
    return ", ".join(told) or ("scaling" if origin is not None else "")


def _are_kept(signals: Tensors, split: str, records: tuple[Record, ...]) -> bool:
    """Whether the kept signals of a split are these records."""
    kept = sum(name.startswith(f"{split}/") and name.endswith("/y") for name in signals)
    return kept == len(records) and all(
        np.array_equal(signals[f"{split}/{i}/{name}"], getattr(record, name))
        for i, record in enumerate(records)
        for name in ("u", "y")
    )
