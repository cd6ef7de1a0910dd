"""What `certify` found, as data."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any, Literal, TypeAlias

Status: TypeAlias = Literal["proved", "sampled", "refuted", "unknown"]
"""proved: holds for all that `holds_for` names; sampled: holds wherever it was looked; refuted: a counterexample is
proved; unknown: neither."""
Number: TypeAlias = float | None
"""Infinite in Python, null in JSON, where there is no bound or the numbers ran away."""


@dataclass(frozen=True)
class Stress:
    """The largest values of a long run."""

    input: str
    """Which input."""
    steps: int
    """Samples simulated; fewer than asked for where the state left the range of numbers."""
    state: Number
    """Largest ‖x‖."""
    output: Number
    """Largest |y|, any output; of an integrator's model, what it sums up."""


@dataclass(frozen=True)
class Statement:
    """One thing said of a model."""

    name: str
    """frozen, quadratic, state or incremental."""
    status: Status
    """How far it is known."""
    claim: str
    """What is said."""
    value: float | None
    """The number in it: a radius, a rate, a bound, a distance; None without."""
    holds_for: str
    """For which states and inputs; "" where nothing holds."""
    how: str
    """How it is known, or what was tried; rounding included."""


@dataclass(frozen=True)
class Gain:
    """A bound on how much larger an output can be than its input, and what was reached; ‖·‖₂ over all samples."""

    status: Status
    """proved where there is a bound, else unknown."""
    bound: float | None
    """Smallest bound that was proved, normalised units; None without."""
    bound_physical: float | None
    """The same of deviations from the means, in physical units; None without, and for an integrator's part."""
    attack: float | None
    """Largest ratio found, normalised units: the gain is no smaller; None where none was sought."""
    attack_physical: float | None
    """The same in physical units."""
    tightness: float | None
    """attack/bound, 1 at best; None where either is missing, or the bound is of weaker inputs than the attack's."""
    holds_for: str
    """For which initial states and inputs the bound holds, or, without one, among which the attack was made."""
    how: str
    """How the bound was proved, or why there is none."""


@dataclass(frozen=True)
class Certificate:
    """What `certify` found."""

    kind: str
    """nnss or linear."""
    stability: str
    """How A follows from the generator, as `--stability` names it; linear for a linear model."""
    covers: str
    """The model, or its LPV part alone where an integrator follows."""
    gamma: Number
    """The promised bound: on ρ(A) for schur, on ‖A‖₂ for quadratic and incremental; none where nothing is promised."""
    records: int
    """Number N of records given."""
    holds_for: str
    """The initial states and inputs for which `state_bound` holds; "" where there is none."""
    radius: dict[str, float]
    """Largest ρ(A) along each split's trajectories."""
    state: dict[str, Number]
    """Largest ‖x‖ along each split's trajectories."""
    initial_state: Number
    """Largest ‖x(0)‖ of the records."""
    box_radius: float
    """Largest ρ(A) found over the box: sampled, then by gradient ascent."""
    box_norm: float
    """Largest ‖A‖₂ found likewise."""
    state_bound: float | None
    """Certified sup‖x‖ for what `holds_for` says, in exact arithmetic; None where there is none."""
    invariant_radius: float | None
    """R: the ball ‖x‖ ≤ R is never left under such inputs, and every state tends to it; None where there is none."""
    B_bound: float
    """sup‖B(ρ)‖₂ from the weights."""
    C_bound: float
    """sup‖C(ρ)‖₂ from the weights."""
    D_bound: float
    """sup‖D(ρ)‖₂ from the weights; 0 without feedthrough."""
    input_bound: float
    """sup‖u‖ of the box of the records' inputs, at its outermost corner; any u of this norm is covered, 0 too."""
    input_low: tuple[float, ...]
    """Least inputs of the records, normalised units."""
    input_high: tuple[float, ...]
    """Largest inputs of the records."""
    lyapunov: str
    """What the search for a common P gave."""
    lyapunov_rate: float | None
    """Smallest rate for which P was found, for the sampled set only; ρ(A) < 1 of a linear model; else None."""
    statements: tuple[Statement, ...]
    """All that is said of stability, each with how far it is known."""
    gain: Gain
    """ℓ2 gain from u to y, x(0) = 0."""
    incremental_gain: Gain
    """The same of differences: ‖y1 − y2‖₂ ≤ γ‖u1 − u2‖₂ from one initial state."""
    stress: tuple[Stress, ...]
    """Long runs."""
    stress_seconds: float
    """Wall time of the long runs [s]."""
    search_seconds: float
    """Wall time of attacks and proofs [s]."""
    broken: tuple[str, ...] = field(default=())
    """Promised bounds that do not hold; empty for a sound model."""

    @property
    def promised(self) -> bool:
        """Whether anything is promised by construction."""
        return self.gamma is not None and self.gamma < math.inf

    def statement(self, name: str) -> Statement:
        """The statement of this name."""
        return next(statement for statement in self.statements if statement.name == name)

    def to_json(self) -> dict[str, Any]:
        """As plain data; numbers that are not finite as null. docs/stability.md has the schema."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
