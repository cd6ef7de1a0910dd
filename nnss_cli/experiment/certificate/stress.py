"""Long runs under eight inputs, from the largest x(0) of the records."""

from __future__ import annotations

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.experiment.certificate.result import Stress
from nnss_cli.experiment.certificate.systems import Linear, Neural
from nnss_cli.iterative import named_random

STRESS_STEPS, CHUNK = 1_000_000, 20_000
INPUTS = ("zero", "highest", "lowest", "white", "sweep", "square", "adversarial", "adversarial, held")


def stress_runs(
    system: Neural | Linear,
    worst: FloatArray,
    low: FloatArray,
    high: FloatArray,
    y0: FloatArray,
    x0: FloatArray,
    steps: int,
) -> tuple[Stress, ...]:
    """Long runs under all inputs side by side, in pieces, from x(0) with y(0) before it."""
    random = named_random(0, "stress")
    middle, half = (high + low) / 2, (high - low) / 2
    b = len(INPUTS)
    previous = np.repeat(np.asarray(y0, dtype=float)[:, None], b, axis=1)
    state = np.repeat(x0[:, None], b, axis=1)
    largest_x, largest_y, reached = np.zeros(b), np.zeros(b), np.zeros(b, dtype=int)
    for begin in range(0, steps, CHUNK):
        k = np.arange(begin, min(begin + CHUNK, steps))
        unit = np.zeros((len(k), len(low), b))
        unit[:, :, 1], unit[:, :, 2] = 1.0, -1.0
        unit[:, :, 3] = random.uniform(-1, 1, (len(k), len(low)))
        phase = k % 10_000  # a sweep from 0 to half the sampling rate
        unit[:, :, 4] = np.sin(np.pi * phase**2 / 20_000)[:, None]
        unit[:, :, 5] = np.where(k // 50 % 2 == 0, 1.0, -1.0)[:, None]
        u = middle[:, None] + half[:, None] * unit
        u[:, :, 0] = 0.0
        u[:, :, 6] = worst[k % len(worst)]
        u[:, :, 7] = worst[np.minimum(k, len(worst) - 1)]
        with np.errstate(over="ignore", invalid="ignore"):
            y, x = system.run(u, previous, state)
            norms, outputs = np.linalg.norm(x, axis=1), np.abs(y).max(axis=1)
        finite = np.isfinite(norms) & np.isfinite(outputs)
        alive = finite.cumprod(axis=0).astype(bool)
        reached += alive.sum(axis=0)
        largest_x = np.maximum(largest_x, np.where(alive, norms, 0).max(axis=0))
        largest_y = np.maximum(largest_y, np.where(alive, outputs, 0).max(axis=0))
        largest_x, largest_y = (np.where(finite.all(axis=0), largest, np.inf) for largest in (largest_x, largest_y))
        state = system.next_state(x[-1], u[-1], y[-2] if len(y) > 1 else previous)
        previous = y[-1]
    return tuple(Stress(INPUTS[i], int(reached[i]), float(largest_x[i]), float(largest_y[i])) for i in range(b))
