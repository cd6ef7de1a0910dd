"""A trained model, opened from its folder: what commands and Python use alike.

Physical units in and out. States are the model's own: those in which it was trained, with normalised signals.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray, Record, Scaling, Simulation
from nnss_cli.errors import InputError
from nnss_cli.experiment.origin import Origin, read_origin
from nnss_cli.experiment.store import records_of
from nnss_cli.methods import Model, load_model
from nnss_cli.trained.signals import as_samples


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """x(k+1) = f(x(k), u(k)), y(k) = h(x(k), u(k)): any model that a method gave, and what is known of it."""

    model: Model
    """As its method made it."""
    folder: Path | None = field(default=None)
    """Where it lies; None for one that was never kept."""
    origin: Origin | None = field(default=None)
    """What it was trained on and how; None where the folder does not tell."""

    @property
    def channels(self) -> Channels:
        """Names and units of inputs and outputs."""
        return self.model.channels

    @property
    def Ts(self) -> float:
        """Sampling time [s]."""
        return self.model.Ts

    @property
    def init_window(self) -> int:
        """Output samples w from which x(0) is found: those of its training; 1 where the folder does not tell."""
        return (self.origin and self.origin.init_window) or 1

    @property
    def fingerprint(self) -> str | None:
        """Of the data that it was trained and scored on (`Dataset.fingerprint`); None where that is not known."""
        return self.origin.data if self.origin else None

    @cached_property
    def order(self) -> int:
        """Number of states n."""
        if self.origin:
            return self.origin.order
        r, m = len(self.channels.inputs), len(self.channels.outputs)
        return self.model.simulate(np.zeros((1, r)), np.zeros((1, m))).x.shape[1]

    @property
    def scaling(self) -> Scaling | None:
        """Means and deviations between physical and normalised units; None for a plug-in's model without."""
        return getattr(self.model, "scaling", None)

    @property
    def label(self) -> str:
        """One line for titles."""
        if self.origin is None:
            return str(self.folder or "model")
        o = self.origin
        return f"{o.method}, order {o.order}, seed {o.seed}, trained on {o.dataset} ({o.protocol})"

    def simulate(self, u: Any, y_init: Any) -> Simulation:
        """Free simulation from the x(0) that explains the first output samples best.

        Args:
            u: inputs (K, r), physical units; (K,) for one input; lists and pandas objects, too.
            y_init: first output samples (w, m), physical units, w ≤ K. For one output (w,) or a number, for several
                outputs (m,) for one sample.

        Returns:
            y (K, m) in physical units and x (K, n).

        Raises:
            InputError: other channels, values that are not finite, no samples, or more first outputs than inputs.
        """
        inputs = as_samples("u", u, self.channels.inputs)
        return self.model.simulate(inputs, self.first_outputs(y_init))

    def first_outputs(self, y_init: Any) -> FloatArray:
        """First output samples (w, m) of what a user may give for them; see `simulate`."""
        outputs = self.channels.outputs
        if len(outputs) > 1 and not hasattr(y_init, "columns") and np.ndim(y_init) == 1:
            y_init = [y_init]
        return as_samples("y_init", y_init, outputs)

    def records(self) -> dict[str, tuple[Record, ...]]:
        """The records of its run by split ("train", "val", test sets), as kept beside the model; {} where none are.

        Raises:
            InputError: they are damaged.
        """
        if self.folder is None or not (self.folder / "signals.safetensors").exists():
            return {}
        return records_of(self.folder, self.Ts)


def load(path: str | Path) -> TrainedModel:
    """Open a trained model.

    Args:
        path: folder of a run, as `nnss train` prints it, or of a model alone (model.json and model.safetensors); or a
            folder of results (`nnss train --out`) with one model in it.

    Raises:
        InputError: there is none, there are several (they are listed), it is damaged, of a later version of nnss, or
            of a kind that needs a plug-in.
    """
    folder = _folder_of_model(Path(path))
    return TrainedModel(load_model(folder), folder, read_origin(folder))


def _folder_of_model(path: Path) -> Path:
    if path.name in ("model.json", "model.safetensors", "run.json"):
        path = path.parent
    if (path / "model.json").exists():
        return path
    if not path.is_dir():
        raise InputError(f"no such folder: '{path}'; expected a trained model's, as 'nnss train' prints it")
    below = (
        "*/model.json",  # a folder runs/, or one of several models
        "runs/*/model.json",
        "*/runs/*/model.json",
        "*/*/runs/*/model.json",
    )
    found = sorted({file.parent for pattern in below for file in path.glob(pattern)})
    if not found:
        raise InputError(
            f"'{path}' holds no trained model (model.json): expected a run's folder, as 'nnss train' prints it"
        )
    if len(found) > 1:
        shown = ", ".join(f"'{folder}'" for folder in found[:8]) + ", …" * (len(found) > 8)
        raise InputError(f"'{path}' holds {len(found)} trained models: name one of {shown}")
    return found[0]
