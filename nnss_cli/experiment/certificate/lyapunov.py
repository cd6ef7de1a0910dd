"""A common Lyapunov matrix: exact for one A, by an LMI for a set of them."""

from __future__ import annotations

import math
import time

import numpy as np

from nnss_cli.baselines.statespace import spectral_radius
from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.certificate import lmi
from nnss_cli.experiment.certificate.systems import radii


def only_lyapunov(A: FloatArray) -> tuple[str, float | None]:
    """Whether P ≻ 0 with AᵀPA ≺ P exists for one A, which is exact: where ρ(A) < 1, for any rate above ρ(A)."""
    radius = spectral_radius(A)
    if radius >= 1:
        return f"none: ρ(A) = {radius:.6g}, and A is the only one", None
    return "exists: ρ(A) < 1, and A is the only one", radius


def common_lyapunov(matrices: FloatArray, deadline: float = math.inf) -> tuple[str, float | None]:
    """Search P ≻ 0 and the smallest rate r with AᵀPA ≼ r²P for all matrices (N, n, n), by bisection on r up to 1.

    Args:
        matrices: A (N, n, n).
        deadline: on `time.perf_counter`; the rate is the smallest that was found by then.

    Returns:
        What was found, in words, and the rate (None where there is none below 1). It says nothing about
        matrices that are not among them.
    """
    if not lmi.available():
        return lmi.MISSING, None
    import cvxpy as cp

    n = matrices.shape[1]
    floor = float(radii(matrices).max())
    if floor >= 1:
        return f"none: ρ(A) = {floor:.6g} somewhere in the sampled set", None

    def solution(rate: float) -> FloatArray | None:
        P = cp.Variable((n, n), symmetric=True)
        t = cp.Variable()
        constraints = [P >> np.eye(n), P << t * np.eye(n)]
        constraints += [rate**2 * P - A.T @ P @ A >> 1e-9 * np.eye(n) for A in matrices]
        problem = cp.Problem(cp.Minimize(t), constraints)
        if not lmi.solved(problem, deadline):
            return None
        # trusted only as far as the eigenvalues, computed here, bear it out
        L = np.linalg.cholesky((lmi.value(P) + lmi.value(P).T) / 2)
        moved = np.linalg.solve(L, np.swapaxes(matrices, 1, 2) @ L)  # L⁻¹ AᵀL has the norm of A in the metric P
        worst = float(np.linalg.norm(moved, 2, axis=(1, 2)).max())
        return lmi.value(P) if worst <= rate * (1 + 1e-7) else None

    if solution(1.0) is None:
        if time.perf_counter() >= deadline:
            return f"not decided for the {len(matrices)} sampled A(ρ): the time was over", None
        return f"none found for the {len(matrices)} sampled A(ρ)", None
    low, high = floor, 1.0
    while high - low > 1e-3 and time.perf_counter() < deadline:
        middle = (low + high) / 2
        low, high = (low, middle) if solution(middle) is not None else (middle, high)
    return f"found for the {len(matrices)} sampled A(ρ); says nothing about others", high
