"""Nonlinear least squares from normal equations that are summed block by block: memory does not grow with the record.

    min ‖e(p)‖²  by steps  min ‖e + J δ‖² + μ ‖S δ‖²,   S the columns' norms,

that is (S⁻¹ JᵀJ S⁻¹ + μ I) S δ = −S⁻¹ Jᵀe. Only JᵀJ, Jᵀe and ‖e‖² are kept, whose size is that of the parameters.

Of a long record JᵀJ, which costs most, may be taken from every k-th sample. It is the curvature by which a step is
chosen, while Jᵀe and ‖e‖², which say where the minimum is and whether a step is taken, are of all samples.

Sources: J. Nocedal and S. Wright, "Numerical Optimization", 2nd ed., 2006, ch. 10; H. B. Nielsen, "Damping
parameter in Marquardt's method", DTU, 1999; R. H. Byrd, G. M. Chin, W. Neveitt and J. Nocedal, "On the use of
stochastic Hessian information in optimization methods for machine learning", SIAM J. Optim. 21(3), 2011.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from nnss_cli.datasets.record import FloatArray

FIRST_DAMPING = 1e-2
FLOOR = 1e-3  # smallest scale of a column, relative to the largest
LARGEST_DAMPING = 1e12  # no step helps any more
ACCEPTED = 1e-4  # decrease found over the decrease foreseen, at least
JOINED = 500  # samples of short blocks whose JᵀJ is taken at once: each costs the memory traffic of a long one


@dataclass(frozen=True, eq=False)
class Block:
    """A stretch of one window: errors, and their derivatives by the weights and by the window's initial state."""

    errors: FloatArray
    """ŷ − y (q,), sample after sample."""
    derivatives: FloatArray
    """By the p weights, then by x(0) of the window (q, p + n)."""
    window: int
    """Number of the window."""
    x: FloatArray
    """States (k, n), without those of an integrator."""


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """What a step needs to know of errors e (q,) and their derivatives J (q, P)."""

    gram: FloatArray
    """JᵀJ (P, P), its lower triangle; from some of the samples, it is scaled up to all."""
    slope: FloatArray
    """Jᵀe (P,)."""
    squares: float
    """‖e‖²."""
    count: int
    """Number of errors q."""

    @classmethod
    def of(cls, errors: FloatArray, J: FloatArray, outputs: int = 1, every: int = 1) -> NormalEquations:
        """Of errors (q,) and derivatives (q, P).

        Args:
            errors: sample after sample, m each.
            J: their derivatives.
            outputs: m.
            every: JᵀJ takes every k-th sample.
        """
        seen = J if every == 1 else J.reshape(-1, outputs, J.shape[1])[::every].reshape(-1, J.shape[1])
        with np.errstate(over="ignore", invalid="ignore"):  # a step too far is not finite, and is not taken
            gram = np.asarray(scipy.linalg.blas.dsyrk(len(J) / len(seen), seen.T, trans=0, lower=1))
            return cls(gram, J.T @ errors, float(errors @ errors), len(errors))

    @classmethod
    def summed(
        cls, blocks: Iterable[Block], p: int, windows: int, every: int = 1
    ) -> tuple[NormalEquations, list[FloatArray]]:
        """Of all blocks, by the p weights and then x(0) of each of the windows; and the states (k, n) of each block.

        JᵀJ takes every k-th sample of a block.
        """
        gram, slope, squares, count = np.zeros((0, 0)), np.zeros(0), 0.0, 0
        states: list[FloatArray] = []
        for together in joined(blocks, JOINED if every == 1 else 0):  # where one is not finite, so is the sum
            errors, J = stacked([one.errors for one in together]), stacked([one.derivatives for one in together])
            n = J.shape[1] - p
            if not states:
                gram, slope = np.zeros((p + windows * n,) * 2), np.zeros(p + windows * n)
            part = cls.of(errors, J, len(errors) // sum(len(one.x) for one in together), every)
            gram[:p, :p] += part.gram[:p, :p]
            slope[:p] += part.slope[:p]
            squares += part.squares
            count += part.count
            at = 0
            for one in together:
                own = slice(p + one.window * n, p + (one.window + 1) * n)
                e, D = errors[at : at + len(one.errors)], J[at : at + len(one.errors)]
                alone = len(together) == 1
                by_x0, down = (part.gram[p:], part.slope[p:]) if alone else (D[:, p:].T @ D, D[:, p:].T @ e)
                gram[own, :p] += by_x0[:, :p]
                gram[own, own] += np.tril(by_x0[:, p:])
                slope[own] += down
                states.append(one.x)
                at += len(e)
        return cls(gram, slope, squares, count), states


def joined(blocks: Iterable[Block], samples: int) -> Iterator[list[Block]]:
    """One block after the other, several at once as long as they have so many samples together at most."""
    waiting: list[Block] = []
    for block in blocks:
        if waiting and sum(len(one.x) for one in (*waiting, block)) > samples:
            yield waiting
            waiting = []
        waiting.append(block)
    if waiting:
        yield waiting


def stacked(parts: Sequence[FloatArray]) -> FloatArray:
    """One below the other, in float64; not a copy where that is what there is."""
    return (parts[0] if len(parts) == 1 else np.concatenate(parts)).astype(np.float64, copy=False)


def levenberg_marquardt(
    evaluate: Callable[[FloatArray], tuple[NormalEquations, FloatArray]],
    point: FloatArray,
    iterations: int,
    accepted: Callable[[FloatArray, float, FloatArray], bool],
) -> None:
    """Minimise ‖e‖² from `point`.

    Args:
        evaluate: a point's normal equations, and the states that went with it.
        point: where to begin (P,).
        iterations: at most.
        accepted: hears of each step taken: point, mean square error, states; whether there is to be another.
    """
    damping = FIRST_DAMPING
    here, x = evaluate(point)
    for _ in range(iterations):
        norms = np.sqrt(np.diag(here.gram))
        largest = float(norms.max())
        if not largest > 0 or not np.isfinite(largest):
            accepted(point, here.squares / here.count, x)
            return
        scale = 1 / np.maximum(norms, FLOOR * largest)
        gram, slope = here.gram * scale * scale[:, None], here.slope * scale
        while True:
            damped = gram.copy(order="F")
            damped[np.diag_indices(len(gram))] += damping
            try:
                factor = scipy.linalg.cho_factor(damped, lower=True, overwrite_a=True, check_finite=False)
            except np.linalg.LinAlgError:  # rounding of a singular JᵀJ outweighs the damping
                damping = max(3 * damping, np.finfo(float).eps)
                continue
            step = scipy.linalg.cho_solve(factor, -slope, check_finite=False)
            there, states = evaluate(point + scale * step)
            foreseen = damping * float(step @ step) - float(step @ slope)
            finite = np.isfinite(there.squares)
            gain = (here.squares - there.squares) / foreseen if foreseen > 0 and finite else -1.0
            if gain > ACCEPTED:
                break
            damping *= 3
            if damping > LARGEST_DAMPING:
                return
        damping = max(damping * max(1 / 3, 1 - (2 * gain - 1) ** 3), np.finfo(float).eps)
        point, here, x = point + scale * step, there, states
        if not accepted(point, here.squares / here.count, x):
            return
