"""Semidefinite programs with a deadline, by Clarabel; nothing of what they give is believed but what is proved."""

from __future__ import annotations

import importlib.util
import math
import time
import warnings
from typing import TYPE_CHECKING

import numpy as np

from nnss_cli.datasets.record import FloatArray

if TYPE_CHECKING:
    import cvxpy as cp

MISSING = "not searched: pip install 'nnss[certify]'"


def available() -> bool:
    """Whether the solver is installed."""
    return importlib.util.find_spec("cvxpy") is not None


def solved(problem: cp.Problem, deadline: float = math.inf) -> bool:
    """Solve a problem in place; whether there is a solution.

    Args:
        problem: all its variables have values if True is returned.
        deadline: on `time.perf_counter`. The solver ends with the iteration in which it passes; setting the problem up
            for the solver is not interrupted, and only begun before.
    """
    import cvxpy as cp

    if time.perf_counter() >= deadline:
        return False
    try:
        with warnings.catch_warnings():  # of a solution that is inaccurate, or none in time: the caller tests it
            warnings.simplefilter("ignore", UserWarning)
            return _solved(problem, deadline)
    except (cp.SolverError, ValueError):
        return False


def value(variable: cp.Variable) -> FloatArray:
    """A variable's value, of a problem that was solved."""
    return np.asarray(variable.value, dtype=np.float64)


def factor(P: cp.Variable) -> FloatArray:
    """S (n, n) with S⁻ᵀS⁻¹ = P, so that xᵀPx = ‖S⁻¹x‖²; of a P that is not definite, that of one nearby."""
    values, vectors = np.linalg.eigh((value(P) + value(P).T) / 2)
    return np.asarray(vectors / np.sqrt(np.maximum(values, 1e-12 * max(values[-1], 1e-300))))


def _solved(problem: cp.Problem, deadline: float) -> bool:
    import cvxpy as cp

    data, chain, back = problem.get_problem_data(cp.CLARABEL, solver_opts={})
    left = deadline - time.perf_counter()
    if left <= 0:
        return False
    options = {"time_limit": left} if math.isfinite(left) else {}
    problem.unpack_results(chain.solve_via_data(problem, data, solver_opts=options), chain, back)
    return problem.status in (cp.OPTIMAL, cp.OPTIMAL_INACCURATE)
