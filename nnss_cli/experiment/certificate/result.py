"""What `certify` found, as data."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from typing import Any


@dataclass(frozen=True)
class Stress:
    """The largest values of a long run."""

    input: str
    """Which input."""
    steps: int
    """Samples simulated; fewer than asked for where the state left the range of numbers."""
    state: float
    """Largest ‖x‖."""
    output: float
    """Largest |y|, any output; of an integrator's model, what it sums up."""


@dataclass(frozen=True)
class Certificate:
    """What `certify` found."""

    kind: str
    """nnss or linear."""
    stability: str
    """schur, contraction, none, or linear."""
    covers: str
    """The model, or its LPV part alone where an integrator follows."""
    gamma: float
    """The promised bound: on ρ(A) for schur, on ‖A‖₂ for contraction; inf where nothing is promised."""
    records: int
    """Number N of records given."""
    holds_for: str
    """The initial states and inputs for which `state_bound` holds; "" where there is none."""
    radius: dict[str, float]
    """Largest ρ(A) along each split's trajectories."""
    state: dict[str, float]
    """Largest ‖x‖ along each split's trajectories."""
    initial_state: float
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
    lyapunov: str
    """What the search for a common P gave."""
    lyapunov_rate: float | None
    """Smallest rate for which P was found, for the sampled set only; ρ(A) < 1 of a linear model; else None."""
    stress: tuple[Stress, ...]
    """Long runs."""
    stress_seconds: float
    """Wall time of the long runs [s]."""
    broken: tuple[str, ...] = field(default=())
    """Promised bounds that do not hold; empty for a sound model."""

    def to_json(self) -> dict[str, Any]:
        """As plain data; numbers that are not finite as null."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(part) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
