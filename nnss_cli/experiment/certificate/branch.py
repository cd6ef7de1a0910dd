"""Branch and bound: an inequality proved at every point of a set by covering it with boxes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from nnss_cli.datasets.record import FloatArray

BATCH = 2048  # boxes enclosed side by side
SMALLEST = 1e-5  # half a box's width, relative to all: below it nothing is decided
COUNTEREXAMPLES = 24

Check: TypeAlias = Callable[[FloatArray, FloatArray], tuple[FloatArray, FloatArray, FloatArray]]
"""From centres (N, d) and half widths (N, d) of boxes: an upper bound over each box of what must not be positive (N,),
its value in the centre (N,), and how much each dimension contributes to the bound (N, d)."""

Depth: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]
"""From centres and half widths: a lower bound over each box of what is at most 1 in the set (N,)."""


@dataclass(frozen=True, eq=False)
class Proof:
    """What came of a branch and bound."""

    proved: bool
    """Whether the inequality holds at every point, rounding included."""
    boxes: int
    """Boxes enclosed."""
    against: FloatArray
    """Points (c, d) where it was seen not to hold, or so nearly that nothing was decided; empty where it was proved or
    given up."""


def prove(check: Check, depth: Depth, d: int, limit: int, deadline: float) -> Proof:
    """Prove check ≤ 0 on {z ∈ [−1, 1]^d: depth(z) ≤ 1}.

    Boxes are halved where they contribute most until each is decided; those outside the set are dropped. Ends at the
    first batch in which a centre in the set breaks the inequality.

    Args:
        check: see above; what is not a number counts as not proved.
        depth: tells the set.
        d: number of dimensions.
        limit: most boxes.
        deadline: on `time.perf_counter`.
    """
    waiting = [(np.zeros((1, d)), np.ones((1, d)))]
    boxes, none = 0, np.zeros((0, d))
    while waiting:
        centre, half = waiting.pop()
        while waiting and len(centre) < BATCH:
            more = waiting.pop()
            centre, half = np.concatenate([centre, more[0]]), np.concatenate([half, more[1]])
        if len(centre) > BATCH:
            waiting.append((centre[BATCH:], half[BATCH:]))
            centre, half = centre[:BATCH], half[:BATCH]
        if boxes + len(centre) > limit or time.perf_counter() > deadline:
            return Proof(False, boxes, none)
        boxes += len(centre)
        bound, value, effect = check(centre, half)
        broken = (value > 0) & (depth(centre, 0 * half) <= 1)
        if broken.any():
            worst = np.argsort(-np.where(broken, value, -np.inf))[: min(COUNTEREXAMPLES, int(broken.sum()))]
            return Proof(False, boxes, centre[worst])
        left = ~(bound <= 0)
        if not left.any():
            continue
        centre, half, effect = centre[left], half[left], effect[left]
        if (small := half.max(axis=1) < SMALLEST).any():
            return Proof(False, boxes, centre[small][:COUNTEREXAMPLES])
        known = np.isfinite(effect).all(axis=1, keepdims=True)
        at = np.arange(len(centre)), np.argmax(np.where(known, effect, half), axis=1)
        smaller = half.copy()
        smaller[at] /= 2
        moved = np.zeros_like(half)
        moved[at] = smaller[at]
        centre, half = np.concatenate([centre - moved, centre + moved]), np.concatenate([smaller, smaller])
        inside = depth(centre, half) <= 1
        if inside.any():
            waiting.append((centre[inside], half[inside]))
    return Proof(True, boxes, none)
