"""What iterative fits share: seeded streams by name, early stopping, and a word on what they are waiting for."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from dataclasses import dataclass

import numpy as np

PATIENCE_UNITS = ("epochs", "steps")

EpochCallback = Callable[[int, float, float], None]
"""Called after each epoch with its number, training loss and validation error."""


_TELL: ContextVar[Callable[[str], None] | None] = ContextVar("tell", default=None)


@contextlib.contextmanager
def waits_told(tell: Callable[[str], None]) -> Iterator[None]:
    """Within it `tell` hears what a fit is at while it has no epochs to show."""
    token = _TELL.set(tell)
    try:
        yield
    finally:
        _TELL.reset(token)


def waiting_for(what: str) -> None:
    """Say what a fit is at, before something that takes seconds and shows nothing."""
    if (tell := _TELL.get()) is not None:
        tell(what)


@dataclass
class EarlyStopping:
    """Keep the best epoch; give up after a `patience` of epochs or steps without a marked improvement.

    An improvement resets the patience only if it is `improvement` (relative) below the error at
    the last reset, as in the released code; the best epoch needs no such margin.
    """

    patience: int
    improvement: float
    best: float = math.inf
    reference: float = math.inf
    waited: int = 0

    def is_best(self, error: float, waited: int = 1) -> bool:
        """Take in an epoch's error and what it adds to the wait; whether the error is the lowest so far."""
        if error <= (1 - self.improvement) * self.reference:
            self.reference, self.waited = error, 0
        else:
            self.waited += waited
        if error < self.best:
            self.best = error
            return True
        return False

    @property
    def stop(self) -> bool:
        """Whether patience has run out."""
        return self.waited >= self.patience


def named_random(seed: int, purpose: str) -> np.random.Generator:
    """A generator that depends on the seed and the purpose's name, never on the order of use."""
    return np.random.default_rng([seed, *purpose.encode()])
