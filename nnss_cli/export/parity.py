"""Whether an export computes what the model does, on a record.

An export is held to a tolerance a step. How far the errors of single steps may add up over a simulation is the model's
own affair (a slow pole sums many, an unstable one enlarges them), so it is measured: the reference is run once more
with a known disturbance at each step, and what that does to the outputs, per unit of it, multiplies the tolerance.
Nor is it the export's fault what its numbers cannot hold: a float of 101325 Pa is 0.004 Pa off. What the rounding of
signals in physical units does to a step and to the start is found from the slopes of the reference.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from nnss_cli.datasets.record import FITTED_ON, FloatArray
from nnss_cli.datasets.units import titled
from nnss_cli.iterative import named_random
from nnss_cli.system import STEP_SIZE, Array, System
from nnss_cli.trained import TrainedModel

SAMPLES = 500  # of a random input, where no record is kept with the model
LONGEST = 20_000  # samples of a record that are tried
DISTURBANCE = 1e-9  # relative, of each state at each step
ROUNDING = 2.0  # times what rounding of the signals makes: the sums inside are rounded, too
FINE = 1e-5  # tolerance: the largest that is stated of any export; more is told with what was found
COARSEST = 0.01  # tolerance: where rounding makes more, a check tells little, and what is checked is of little use
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
    rounding: float
    """Error of a step or of the start per relative error of all signals and of their means, to first order."""

    def tolerance(self, stated: float, precision: str = "float64") -> float:
        """Of a step and of the start in a precision: as stated, or more where signals are rounded to it coarsely."""
        return min(COARSEST, max(stated, self._rounded(precision)))

    def holds(self, precision: str) -> bool:
        """Whether a precision holds the signals well enough for a check to tell something."""
        return self._rounded(precision) <= COARSEST

    def _rounded(self, precision: str) -> float:
        return ROUNDING * float(np.finfo(precision).eps) * self.rounding


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
    """A step's, and the start's."""
    samples: int
    """Number of samples."""
    source: str
    """Where the inputs are from."""

    def __str__(self) -> str:
        rounded = f"; rounding of the signals makes up to {self.tolerance:.1e}" if self.tolerance > FINE else ""
        return (
            f"{self.what}: largest error {self.simulation:.1e} deviations over {self.samples} samples of "
            f"{self.source}, {self.step:.1e} a step{rounded}"
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
    begun = y_first.ravel(), u_first.ravel(), system.start(y_first, u_first)
    trial = Trial(source, u, z, system.advance(z, u)[0], y, *begun, unit, accumulation, 0.0)
    trial = replace(trial, rounding=_rounding(system, trial))
    error, most = float(np.abs((own - y) / unit).max()), trial.tolerance(SAME_MODEL[precision]) * accumulation
    if not error <= most:
        raise ParityError(
            f"the elementary step leaves the model's own simulation by {error:.1e} deviations on {source}: expected at "
            f"most {most:.1e}"
        )
    return trial


def _rounding(system: System, trial: Trial) -> float:
    """`Trial.rounding`. A signal and its mean are each rounded by half of a precision's relative spacing."""

    def halves(signal: FloatArray, mean: FloatArray) -> FloatArray:
        return (np.abs(signal) + np.abs(np.tile(mean, signal.shape[-1] // len(mean)))) / 2

    def step(values: Array) -> Array:
        return np.concatenate(system.advance(values[:, : system.size], values[:, system.size :]), axis=1)

    def start(values: Array) -> Array:
        y0, u0 = values[..., : len(trial.y0), None], values[..., len(trial.y0) :, None]
        return np.asarray(system.initial(y0=y0, u0=u0)["z"][..., 0])

    x, kept = np.zeros((len(trial.u), system.n)), trial.z[:, system.n :]
    sizes = np.concatenate([x, halves(kept, system.y_mean), halves(trial.u, system.u_mean)], axis=1)
    moved = _moved(step, np.concatenate([trial.z, trial.u], axis=1), sizes)
    of_y = (moved[:, system.size :] + halves(trial.y, system.y_mean)) / trial.unit
    of_z = moved[:, : system.size] / (1 + np.abs(trial.z_next))
    begun = np.concatenate([halves(trial.y0, system.y_mean), halves(trial.u0, system.u_mean)])
    of_start = _moved(start, np.concatenate([trial.y0, trial.u0]), begun) / (1 + np.abs(trial.z0))
    return float(max(of_y.max(), of_z.max(), of_start.max()))


def _moved(function: Callable[[Array], Array], at: Array, sizes: Array) -> Array:
    """How far a function moves at most, to first order, where each of its arguments (…, N) does by its size.

    By the complex step, as `System.jacobians`.
    """
    moved = np.zeros(np.shape(function(at)))
    for i in np.flatnonzero(sizes.any(axis=tuple(range(sizes.ndim - 1)))):
        direction = np.where(np.arange(at.shape[-1]) == i, sizes, 0.0)
        moved = moved + np.abs(function(at + STEP_SIZE * 1j * direction).imag) / STEP_SIZE
    return moved


def single_left_out(model: TrainedModel, trial: Trial) -> str:
    """Why a model has no export in single precision, of the targets that would have one; "" where it has."""
    if trial.holds("float32"):
        return ""
    system, scaling, c = model.system, model.scaling, model.channels
    assert scaling is not None  # as whatever has an elementary step
    offsets, deviations = np.concatenate([system.u_mean, system.y_mean]), np.concatenate([scaling.u_std, scaling.y_std])
    worst = int(np.argmax(np.abs(offsets) / deviations))
    name = titled((*c.inputs, *c.outputs)[worst], (*c.input_units, *c.output_units)[worst])
    return (
        "Single precision is not written: its rounding of the signals makes errors of more than "
        f"{COARSEST:g} deviations; the largest offset is that of {name}, {offsets[worst]:.3g} beside a deviation of "
        f"{deviations[worst]:.3g}."
    )


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
        tolerance: of a step and of the start, as stated; more is allowed where the precision of `simulated` holds
            the signals less well (`Trial.tolerance`).
        started: its z(0) (N,) from the first samples; None where it has no start.

    Raises:
        ParityError: one step, the start or the simulation is off.
    """
    tolerance = trial.tolerance(tolerance, str(simulated.dtype))
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
