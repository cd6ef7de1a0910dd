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
from nnss_cli.methods.compiled import free_run, free_run_from
from nnss_cli.system import System
from nnss_cli.trained.linear import Equilibrium, Frozen, equilibrium, frozen, linearised, to_control
from nnss_cli.trained.signals import as_samples, as_values


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

    @cached_property
    def system(self) -> System:
        """The model in elementary operations: what is linearised and exported.

        Raises:
            InputError: it has no such form, as models of plug-ins may not.
        """
        elementary = getattr(self.model, "elementary", None)
        if elementary is None:
            raise InputError(
                f"{type(self.model).__name__}: expected a model with `elementary()` (nnss_cli.system), found one "
                "without: it can be simulated from first outputs, not linearised or exported"
            )
        system: System = elementary()
        return system

    def simulate(self, u: Any, y_init: Any = None, x0: Any = None) -> Simulation:
        """Free simulation: from first outputs, from a state, or at rest.

        An NN-SS model runs along 100 samples and more in compiled code, equal up to rounding; so does an ensemble from
        first outputs.

        Args:
            u: inputs (K, r), physical units; (K,) for one input; lists and pandas objects, too.
            y_init: first output samples (w, m), physical units, w ≤ K, which x(0) explains best. For one output (w,) or
                a number, for several outputs (m,) for one sample.
            x0: x(0) (n,) instead, or z(0) as `initial_state` gives it. With neither, the model is at rest under u(0).

        Returns:
            y (K, m) in physical units and x (K, n). Of an ensemble x is the first member's, from which it cannot go on;
            `initial_state` has the states of all.

        Raises:
            InputError: other channels, values that are not finite, no samples, more first outputs than inputs, or no
                equilibrium under u(0).
        """
        inputs = as_samples("u", u, self.channels.inputs)
        if y_init is not None and x0 is not None:
            raise InputError("expected first outputs y_init or a state x0, found both: leave one out")
        if y_init is not None:
            return free_run(self.model, inputs, self._first_outputs(y_init))
        z0 = equilibrium(self.system, inputs[0]).z if x0 is None else self._state("x0", x0)
        fast = free_run_from(self.model, inputs, z0)
        if fast is not None:
            return fast
        y, z = self.system.simulate(inputs, z0)
        return Simulation(y, z[:, : self.order])

    def initial_state(self, u: Any, y_init: Any) -> FloatArray:
        """z(0) (N,) from which `simulate` starts: x(0) of every member, and the output before (see `nnss_cli.system`).

        Args:
            u: inputs (K, r), K ≥ w.
            y_init: first output samples, as in `simulate`.
        """
        first = self._first_outputs(y_init)
        inputs = as_samples("u", u, self.channels.inputs)[: len(first)]
        members = getattr(self.model, "members", (self.model,))
        x = np.concatenate([member.simulate(inputs, first).x[0] for member in members])
        return self.system.state(x, first[0])

    def matrices(self, x: Any, u: Any = None, y_previous: Any = None) -> Frozen:
        """A(x), B(x), C(x), D(x) frozen at a state. They are no linearisation: see `linearise`.

        Args:
            x: the model's own state (n,), as `simulate` gives it; of an ensemble, those of all members, one after the
                other, as `initial_state` has them.
            u: input (r,), where the matrices are scheduled on it; else the mean input.
            y_previous: output before (m,), physical units, likewise; else the mean output.

        Raises:
            InputError: x is of another length, or a value is no finite number.
        """
        s = self.system
        at = as_values("x", x, s.state_names[: s.n])
        y = s.y_mean if y_previous is None else as_values("y_previous", y_previous, self.channels.outputs)
        return frozen(s, s.state(at, y), s.u_mean if u is None else as_values("u", u, self.channels.inputs))

    def equilibrium(self, u: Any) -> Equilibrium:
        """Where a constant input (r,), physical units, holds the model.

        Raises:
            InputError: there is no equilibrium.
        """
        return equilibrium(self.system, as_values("u", u, self.channels.inputs))

    def linearise(self, u: Any) -> Any:
        """The Jacobians at the equilibrium under a constant input, as a control.StateSpace.

        Args:
            u: input (r,), physical units; a number for one.

        Returns:
            Discrete time, with the channels' names ('_' for '.'); inputs, outputs and states are deviations from the
            equilibrium.

        Raises:
            InputError: there is no equilibrium.
        """
        return linearised(self.system, self.channels, self.Ts, as_values("u", u, self.channels.inputs))

    def to_control(self) -> Any:
        """The whole model as a control.NonlinearIOSystem in discrete time and physical units.

        Its response from `initial_state` is that of `simulate`. Signals have the channels' names, '_' for '.'.
        """
        return to_control(self.system, self.channels, self.Ts)

    def _state(self, what: str, values: Any) -> FloatArray:
        s = self.system
        if s.outputs_kept and np.size(values) == s.n:
            raise InputError(
                f"{what}: expected {s.size} values, {', '.join(s.state_names)}, since the model is scheduled on the "
                f"previous output, found {s.n}"
            )
        return as_values(what, values, s.state_names)

    def _first_outputs(self, y_init: Any) -> FloatArray:
        """First output samples (w, m) of what a user may give for them; see `simulate`."""
        outputs = self.channels.outputs
        if len(outputs) > 1 and not hasattr(y_init, "columns") and np.ndim(y_init) == 1:
            y_init = [as_values("y_init", y_init, outputs)]
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
            of a kind that needs a plug-in; or the path is none.
    """
    if not isinstance(path, str | Path):
        raise InputError(f"model: expected the path of a folder, found {path!r:.60}")
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
