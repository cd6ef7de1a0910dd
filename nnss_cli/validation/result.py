"""What a validated model is known by: plain numbers, texts and arrays."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from nnss_cli.datasets.record import Channels, FloatArray
from nnss_cli.validation.limits import Limits
from nnss_cli.validation.linearisation import Linearisations
from nnss_cli.validation.predictor import StepTable
from nnss_cli.validation.residuals import Dependence, Profile, Whiteness


@dataclass(frozen=True, eq=False)
class OutputCheck:
    """What is known of one output. Units are physical."""

    name: str
    """Name."""
    unit: str
    """Unit, "–" where none is stated."""
    rmse: float
    """RMSE of the free simulation."""
    sigma: float
    """σ: standard deviation of the output over the training data."""
    fit_percent: float
    """100 (1 − ‖y − ŷ‖/‖y − mean(y)‖) of the free simulation, each record about its own mean (`Score.fit_percent`)."""
    limit: float | None
    """Fit [%] that linear relations would give, an estimate (`nnss_cli.validation.limit`); None for a short record."""
    reached: float | None
    """Fit [%] that a linear model reaches which is fitted to this very record; None where none could be fitted."""
    simulation_r1: float
    """Autocorrelation of the simulation's errors at lag 1."""
    simulation_depends: tuple[float, ...]
    """p-value of the simulation's errors being independent of each input."""
    residual_rmse: float
    """RMSE one step ahead, after the observer has forgotten its start."""
    white: Whiteness
    """Of the residuals."""
    depends: tuple[Dependence, ...]
    """Of the residuals on each input."""
    by_input: tuple[Profile | None, ...]
    """Mean residual by the value of each input; None where it does not vary."""
    by_state: tuple[Profile | None, ...]
    """Mean residual by the value of each state."""


@dataclass(frozen=True)
class Stated:
    """A test that a model passes or fails."""

    name: str
    """What is tested, in words."""
    passed: bool
    """Whether it passed."""
    found: str
    """The figures."""


@dataclass(frozen=True, eq=False)
class Validation:
    """All that is known of a model on a record."""

    label: str
    """Of the model."""
    record: str
    """Which record."""
    samples: int
    """Samples, of all experiments."""
    experiments: int
    """How many they are."""
    left_out: int
    """First samples of each experiment that residuals do without, while the observer forgets its start."""
    channels: Channels
    """Names and units."""
    outputs: tuple[OutputCheck, ...]
    """One an output."""
    steps: StepTable
    """Errors k steps ahead."""
    tests: tuple[Stated, ...]
    """The stated tests, each at the level of 1 % for all outputs and inputs together."""
    verdict: tuple[str, ...]
    """In plain words."""
    gains: tuple[str, ...]
    """Where the gain of each member comes from."""
    rates: tuple[float, ...]
    """Growth a sample of each member's observer error, over training, validation and this record at most."""
    poles: FloatArray
    """Eigenvalues of A(x) at points along the simulated trajectory (points, n), complex."""
    radius: float
    """Largest modulus of them."""
    linear: Linearisations
    """Step and frequency responses about several operating points."""
    time: FloatArray
    """Instants of the first experiment (K,) [s]."""
    measured: FloatArray
    """Its outputs (K, m)."""
    simulated: FloatArray
    """Their simulation (K, m)."""
    one_ahead: FloatArray
    """Predicted one step ahead (K, m)."""
    limits: Limits | None
    """Band of 90 % around the first experiment's simulation, with the share that it holds of all of them; None where
    validation is too short."""

    @property
    def passed(self) -> bool:
        """Whether every stated test passed."""
        return all(test.passed for test in self.tests)


def as_dict(found: Validation) -> dict[str, object]:
    """The numbers as JSON can hold them, without the signals."""

    def plain(value: object) -> object:
        if isinstance(value, np.ndarray):
            return [plain(part) for part in value.tolist()]
        if isinstance(value, Mapping):
            return {str(key): plain(part) for key, part in value.items()}
        if isinstance(value, list | tuple):
            return [plain(part) for part in value]
        if isinstance(value, complex):
            return [value.real, value.imag]
        if isinstance(value, float | np.floating):
            return float(value) if math.isfinite(value) else None
        if hasattr(value, "__dataclass_fields__"):
            return {key: plain(getattr(value, key)) for key in value.__dataclass_fields__}
        return value

    outputs = [plain(output) for output in found.outputs]
    band = found.limits
    return {
        "model": found.label, "record": found.record, "samples": found.samples, "experiments": found.experiments,
        "left_out": found.left_out,
        "passed": found.passed, "tests": plain(found.tests), "verdict": list(found.verdict), "outputs": outputs,
        "steps": plain(found.steps), "gains": list(found.gains), "observer_rates": plain(found.rates),
        "largest_pole": plain(found.radius), "poles": plain(found.poles),
        "operating_points": plain(found.linear.points),
        "without_equilibrium": list(found.linear.without),
        "band": None if band is None else plain({
            "level": band.band.level, "half_width": band.band.half_width, "held": band.held,
            "blocks": band.band.blocks, "block_samples": band.band.length,
            "error_memory": band.band.memory,
        }),
    }  # fmt: skip
