"""What is said of one matrix A, and of a model by its construction, its samples and its proofs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.certificate import lti
from nnss_cli.experiment.certificate.result import Gain, Statement
from nnss_cli.experiment.certificate.systems import Promise

ROUNDED = "with the rounding of its own computation counted in"
EVERY = "every x(0) and every input"


@dataclass(frozen=True)
class Sampled:
    """What was seen of A(ρ)."""

    radius: float
    """Largest ρ(A)."""
    norm: float
    """Largest ‖A‖₂."""
    lyapunov_rate: float | None
    """Of a common Lyapunov matrix for sampled A(ρ); None where none was found."""
    lyapunov: str
    """What the search gave, in words."""
    proved: tuple[float, float] | None = None
    """ρ(A) at a ρ where it is proved to reach γ, or 1 where that is not promised, and its margin; None without."""


def falls(what: str, rate: float, power: str = "") -> str:
    """That it is at most `rate` (to a power, as text) times what it was, a sample later."""
    return f"{what} does not grow" if rate == 1 else f"{what} falls to {rate:.8g}{power} times or less a sample"


def of_one_matrix(system: LinearStateSpace, input_bound: float) -> tuple[Statement, ...]:
    """Of a system whose A, B, C, D are constant: all follows from a Lyapunov matrix of A."""
    radius = system.spectral_radius()
    found = lti.lyapunov(system.A)
    claim, same = f"ρ(A) = {radius:.8g} < 1", "A, B, C, D are constant; "
    if found is None:
        radius, margin = lti.spectral_radius(system.A)
        how = f"{same}ρ(A) = {radius:.8g}, ± {margin:.1e}"
        status = "refuted" if radius - margin > 1 else "unknown"
        return tuple(
            Statement(name, status, what, radius if name == "frozen" else None, "", how)  # type: ignore[arg-type]
            for name, what in (
                ("frozen", "ρ(A) < 1"), ("quadratic", "one Lyapunov function for all A(ρ)"),
                ("state", "the state stays bounded"), ("incremental", "trajectories under one input tend together"),
            )
        )  # fmt: skip
    rate, S = found
    how = f"{same}a Lyapunov matrix was found and checked, {ROUNDED}"
    reach = lti.weighted_norm(np.hstack([np.zeros_like(system.A), system.B]), S)
    bound = float(np.linalg.norm(S, 2)) * reach * input_bound / (1 - rate) * (1 + 1e-9)
    return (
        Statement("frozen", "proved", claim, radius, "every x", how),
        Statement("quadratic", "proved", falls("V(x) = ‖S⁻¹x‖²", rate, "²") + " for u = 0", rate, "every x(0)", how),
        Statement("state", "proved", f"‖x(k)‖ ≤ {bound:.6g}", bound, "x(0) = 0 and inputs within their range", how),
        Statement(
            "incremental", "proved", falls("‖S⁻¹(x1 − x2)‖", rate), rate, EVERY,
            how + "; differences obey the same A",
        ),
    )  # fmt: skip


def frozen(promise: Promise, gamma: float, seen: Sampled, broken: tuple[str, ...]) -> Statement:
    """Of ρ(A(ρ)) at every ρ."""
    level = gamma if promise.radius else 1.0
    claim, looked = f"ρ(A(ρ)) < {level:g}", f"largest seen {seen.radius:.6g}"
    if seen.proved is not None:
        return Statement("frozen", "refuted", claim, seen.proved[0], "", _somewhere(*seen.proved))
    if promise.radius and broken:
        return Statement("frozen", "unknown", claim, seen.radius, "", "; ".join(broken))
    if promise.radius:
        how = f"by construction, in exact arithmetic; {looked}"
        return Statement("frozen", "proved", claim, gamma, "every ρ", how)
    if seen.radius >= 1:
        return Statement("frozen", "unknown", claim, seen.radius, "", f"{looked}: rounding decides")
    return Statement("frozen", "sampled", claim, seen.radius, "a box around the ρ of the records", looked)


def quadratic(promise: Promise, gamma: float, seen: Sampled, broken: tuple[str, ...]) -> Statement:
    """Of one quadratic Lyapunov function for every A(ρ), u = 0, before any proof over a region."""
    claim = "one quadratic Lyapunov function for all A(ρ)"
    if seen.proved is not None and seen.proved[0] - seen.proved[1] >= 1:
        return Statement("quadratic", "refuted", claim, None, "", _somewhere(*seen.proved))
    if promise.norm and broken:
        return Statement("quadratic", "unknown", claim, seen.norm, "", "; ".join(broken))
    if promise.norm:
        how = f"by construction, in exact arithmetic: ‖A(ρ)‖₂ < {gamma:g}; largest seen {seen.norm:.6g}"
        return Statement("quadratic", "proved", falls("‖x‖", gamma) + " for u = 0", gamma, "every ρ", how)
    if seen.lyapunov_rate is not None:
        return Statement("quadratic", "sampled", claim, seen.lyapunov_rate, "sampled ρ only", seen.lyapunov)
    return Statement("quadratic", "unknown", claim, None, "", seen.lyapunov)


def _somewhere(radius: float, margin: float) -> str:
    return f"ρ(A) = {radius:.8g} at one ρ, ± {margin:.1e}, {ROUNDED}: of the weights as they are stored"


def gain_of_one_matrix(
    system: LinearStateSpace, u_std: FloatArray, y_std: FloatArray, integrates: bool = False
) -> Gain:
    """The H∞ norm, in normalised and in physical units; that of differences is the same."""
    found = lti.norm(system)
    physical = lti.Norm(0.0, None, 0.0)
    if not integrates:
        B, C = system.B / u_std, y_std[:, None] * system.C
        physical = lti.norm(LinearStateSpace(system.A, B, C, y_std[:, None] * system.D / u_std, system.Ts))
    if found.high is None:
        return Gain(
            "unknown", None, None, None, None, None, "", "A, B, C, D are constant; no bound was proved: "
            f"ρ(A) = {system.spectral_radius():.8g}",
        )  # fmt: skip
    how = (
        f"A, B, C, D are constant: H∞ norm, between the response at {found.frequency:.6g} rad/sample and a storage "
        f"function checked {ROUNDED}"
    )
    return Gain(
        "proved", found.high, physical.high, found.low, None if integrates else physical.low,
        1.0 if found.high == 0 else found.low / found.high, "x(0) = 0, every input", how,
    )  # fmt: skip


def small_gain(gamma: float, B: float, C: float, D: float) -> float:
    """Bound on the ℓ2 gain where ‖A(ρ)‖ < γ < 1: of the convolution of what is left of each sample's input."""
    return (C * B / (1 - gamma) + D) * (1 + 1e-12)
