"""Embedded plants: an ODE, a seeded input and output noise. Nothing is downloaded."""

import math
from pathlib import Path

import numpy as np
from nnss_cli.datasets.benchmark import Benchmark
from nnss_cli.datasets.catalog import twotank
from nnss_cli.datasets.record import Dataset, FloatArray

# Parameters that reproduce the two-tank record (areas in m²): DESIGN.md of this project.
A1, A2, K_PUMP, OUTLET1, OUTLET2, GRAVITY = 0.5, 0.25, 0.005, 0.02, 0.015, 9.81
NOISE = 0.005  # standard deviation of the output noise [m]
SUBSTEPS = 10


def simulate_two_tank(u: FloatArray, h0: FloatArray) -> FloatArray:
    """Levels of two cascaded tanks under a zero-order-held pump voltage.

        A1 ḣ1 = k u − a1 √(2 g h1),   A2 ḣ2 = a1 √(2 g h1) − a2 √(2 g h2)

    Args:
        u: pump voltage (K,) [V], one sample each 0.2 s.
        h0: levels at the first sample (2,) [m].

    Returns:
        Levels at the sampling instants (K, 2) [m], by Runge–Kutta of order 4 with 20 ms steps.
    """

    def slopes(h1: float, h2: float, voltage: float) -> tuple[float, float]:
        flow1 = OUTLET1 * math.sqrt(2 * GRAVITY * max(h1, 0.0))
        flow2 = OUTLET2 * math.sqrt(2 * GRAVITY * max(h2, 0.0))
        return (K_PUMP * voltage - flow1) / A1, (flow1 - flow2) / A2

    step = twotank.Ts / SUBSTEPS
    # Python's numbers: several times quicker than arrays of two, and the same to the bit.
    h1, h2 = (float(h) for h in h0)
    levels = np.empty((len(u), 2))
    for k, voltage in enumerate(u.tolist()):
        levels[k] = h1, h2
        for _ in range(SUBSTEPS):
            p1, q1 = slopes(h1, h2, voltage)
            p2, q2 = slopes(h1 + step / 2 * p1, h2 + step / 2 * q1, voltage)
            p3, q3 = slopes(h1 + step / 2 * p2, h2 + step / 2 * q2, voltage)
            p4, q4 = slopes(h1 + step * p3, h2 + step * q3, voltage)
            h1 += step / 6 * (p1 + 2 * p2 + 2 * p3 + p4)
            h2 += step / 6 * (q1 + 2 * q2 + 2 * q3 + q4)
    return levels


def draw(random: np.random.Generator, samples: int) -> tuple[FloatArray, FloatArray]:
    """An input (K,) [V] like the recorded one, whole volts from 1 to 10 for 100 to 250 samples, and h2 (K,) [m]."""
    levels: list[float] = []
    while len(levels) < samples:
        levels += [float(random.integers(1, 11))] * int(random.choice([100, 150, 200, 250]))
    u = np.array(levels[:samples])
    return u, simulate_two_tank(u, np.array([0.05, 0.09]))[:, 1]


def load(path: Path | None, protocol: str) -> Dataset:
    """Simulate and split as the recorded two-tank benchmark. `path` is not used: there is no file."""
    del path
    random = np.random.default_rng(20251)
    u, level = draw(random, twotank.SAMPLES)
    y = level + NOISE * random.standard_normal(len(u))
    return twotank.split("twotank-sim", u[:, None], y[:, None], protocol)


BENCHMARK = Benchmark(
    name="twotank-sim",
    title="Two-tank system, embedded simulation",
    citation="nnss, datasets/catalog/simulated.py",
    orders=(2, 3, 4),
    sources=(),
    cached_as="",
    load=load,
    presets=twotank.PRESETS,
)
