"""Whether an export computes what the model does, on a record.

An export is held to a tolerance a step. How far the errors of single steps may add up over a simulation is the model's
own affair (a slow pole sums many, an unstable one enlarges them), so it is measured: the reference is run once more
with a known disturbance at each step, and what that does to the outputs, per unit of it, multiplies the tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import FITTED_ON, FloatArray
from nnss_cli.iterative import named_random
from nnss_cli.system import System
from nnss_cli.trained import TrainedModel

SAMPLES = 500  # of a random input, where no record is kept with the model
LONGEST = 20_000  # samples of a record that are tried
DISTURBANCE = 1e-9  # relative, of each state at each step
SAME_MODEL = {"float64": 1e-10, "float32": 1e-4}  # of the model's own simulation, in its precision


class ParityError(ArithmeticError):
    """An export that does not compute what the model does."""


@dataclass(frozen=True, eq=False)
class Trial:
    """Inputs, and what the model makes of them, in float64."""

    source: str
    """Where the inputs are from."""
    u: FloatArray
    """Inputs (K, r), physical units."""
    z: FloatArray
    """States z(k) (K, N)."""
    z_next: FloatArray
    """z(k + 1) (K, N)."""
    y: FloatArray
    """Outputs (K, m), physical units."""
    y0: FloatArray
    """First W measured outputs (W m,), one below the other, from which `initial` starts."""
    u0: FloatArray
    """Their inputs (W r,)."""
    z0: FloatArray
    """z(0) (N,) that `initial` makes of them; that of the simulation is z[0], which may be found from a window."""
    unit: FloatArray
    """The unit of errors (K, m): the output's deviation, or how far it is from its mean where that is more."""
    accumulation: float
    """Error of the outputs over a simulation, in `unit`, per relative error of each step's states; at least 1."""


@dataclass(frozen=True)
class Parity:
    """What a check found."""

    what: str
    """Which part of the export."""
    step: float
    """Largest error of one step from the reference's states: of outputs in their deviations, of states relative."""
    start: float | None
    """Largest error of z(0), relative; None where the export has no start."""
    simulation: float
    """Largest error of the outputs over the whole simulation, in their deviations."""
    tolerance: float
    """A step's."""
    samples: int
    """Number of samples."""
    source: str
    """Where the inputs are from."""

    def __str__(self) -> str:
        return (
            f"{self.what}: largest error {self.simulation:.1e} deviations over {self.samples} samples of "
            f"{self.source}, {self.step:.1e} a step"
        )


def trial_of(model: TrainedModel) -> Trial:
    """A record kept with the model, of a test set where there is one; a random input where there is none.

    Raises:
        ParityError: the elementary step does not compute what the model itself does.
        InputError: the model has no elementary step.
    """
    system = model.system
    records = model.records()
    split = next((name for name in records if name not in FITTED_ON), next(iter(records), None))
    if split is not None:
        record = records[split][0]
        source, u, y_init = f"its {split} record", record.u[:LONGEST], record.y[: model.init_window]
        y_first = record.y[: system.first]
    else:
        s = model.scaling
        assert s is not None  # as whatever has an elementary step
        random = named_random(0, "parity")
        source, u = "a random input", s.u_mean + s.u_std * random.standard_normal((SAMPLES, system.inputs))
        y_first = y_init = s.y_mean[None] + s.y_std * random.standard_normal((system.first, system.outputs))
    u_first, z0 = u[: system.first], model.initial_state(u, y_init)
    y, z = system.simulate(u, z0)
    finite = np.isfinite(y).all(axis=1) & np.isfinite(z).all(axis=1)
    K = len(u) if finite.all() else int(finite.argmin())
    u, y, z = u[:K], y[:K], z[:K]
    deviation = model.scaling.y_std if model.scaling else np.ones(system.outputs)
    unit = np.maximum(deviation, np.abs(y - system.y_mean))
    own = model.model.simulate(u, y_init).y[:K]
    members = getattr(model.model, "members", (model.model,))
    single = any(getattr(getattr(member, "architecture", None), "dtype", "") == "float32" for member in members)
    precision = "float32" if single else "float64"
    accumulation = _accumulation(system, u, z0, y, unit)
    error = float(np.abs((own - y) / unit).max())
    if not error <= SAME_MODEL[precision] * accumulation:
        raise ParityError(
            f"the elementary step leaves the model's own simulation by {error:.1e} deviations on {source}: expected at "
            f"most {SAME_MODEL[precision] * accumulation:.1e}"
        )
    begun = y_first.ravel(), u_first.ravel(), system.start(y_first, u_first)
    return Trial(source, u, z, system.advance(z, u)[0], y, *begun, unit, accumulation)


def _accumulation(system: System, u: FloatArray, z0: FloatArray, y: FloatArray, unit: FloatArray) -> float:
    random = named_random(1, "parity")
    z, worst = z0, 0.0
    for k in range(len(u)):
        z = z + DISTURBANCE * (1 + np.abs(z)) * random.uniform(-1, 1, len(z))
        z, moved = system.advance(z, u[k])
        worst = max(worst, float(np.abs((moved - y[k]) / unit[k]).max()))
    return max(1.0, worst / DISTURBANCE) if np.isfinite(worst) else np.inf


def check(
    what: str,
    trial: Trial,
    steps: tuple[FloatArray, FloatArray],
    simulated: FloatArray,
    tolerance: float,
    started: FloatArray | None = None,
) -> Parity:
    """Compare an export with the reference.

    Args:
        what: which part of it, for the message.
        trial: the reference.
        steps: its z(k+1) (K, N) and y(k) (K, m), from the reference's z(k).
        simulated: its y (K, m) of a simulation from z(0).
        tolerance: of a step, and of the start.
        started: its z(0) (N,) from the first samples; None where it has no start.

    Raises:
        ParityError: one step, the start or the simulation is off.
    """
    z_next, y = steps
    step = max(_relative(z_next, trial.z_next), float(np.abs((y - trial.y) / trial.unit).max()))
    start = None if started is None else _relative(started, trial.z0)
    if start is not None and not start <= tolerance:
        raise ParityError(
            f"{what}: z(0) from the first output is {start:.1e} off the model's: expected at most {tolerance:.1e}; no "
            "file was written"
        )
    simulation = float(np.abs((simulated - trial.y) / trial.unit).max())
    if not (step <= tolerance and simulation <= tolerance * trial.accumulation):
        raise ParityError(
            f"{what}: {step:.1e} a step and {simulation:.1e} over {len(trial.u)} samples of {trial.source} off the "
            f"model: expected at most {tolerance:.1e} and {tolerance * trial.accumulation:.1e}; no file was written"
        )
    return Parity(what, step, start, simulation, tolerance, len(trial.u), trial.source)


def _relative(z: FloatArray, expected: FloatArray) -> float:
    return float((np.abs(z - expected) / (1 + np.abs(expected))).max())
