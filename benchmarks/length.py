"""What an iteration of recipe `best` costs on records of 1e3 to 1e6 samples: seconds and peak memory, a process each.

    python benchmarks/length.py [LONGEST]

An iteration is the normal equations of all samples and the solution of one damped step: n = 6, a generator with one
hidden layer of 2, some 500 weights. Prints the slopes of time and memory in doubly logarithmic coordinates: 1 is
proportional to the length, 0 independent of it.
"""

from nnss_cli.machine import prepare

prepare()

import resource
import subprocess
import sys
import time

import numpy as np
from nnss_cli.datasets.record import Channels, Scaling
from tabulate import tabulate

from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import FastEngine
from nnss_cli.training.gauss_newton import gauss_newton
from nnss_cli.training.recipe import Recipe

ORDER, HIDDEN = 6, 2


def measure(samples: int) -> None:
    """In a process of its own: seconds of an iteration, peak MiB, and how many weights there are."""
    random, one = np.random.default_rng(0), np.ones(1)
    architecture = Architecture(ORDER, 1, 1, hidden=(HIDDEN,), encoder=(8,), dtype="float64")
    model = NNSS(architecture, Scaling(one, one, one, one), Channels(("u",), ("y",), ("",), ("",)), 1.0)
    model.initialise(random)
    u, y = random.standard_normal((2, 1, samples, 1))
    engine = FastEngine(model, list(u), list(y), Recipe(dtype="float64"))
    list(
        FastEngine(model, [u[0, :9]], [y[0, :9]], Recipe(dtype="float64")).sensitivities(np.zeros((1, ORDER)))
    )  # compile
    evaluations: list[float] = []
    plain = engine.sensitivities

    def timed(x0):
        evaluations.append(time.process_time())
        return plain(x0)

    engine.sensitivities = timed
    gauss_newton(engine, list(y), 3, lambda _: True)
    ended = time.process_time()
    seconds = (ended - evaluations[0]) / len(evaluations)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    print(seconds, peak, engine.model_weights.generator_size)


def main() -> None:
    longest = int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_000_000
    lengths = [K for K in (1_000, 10_000, 100_000, 1_000_000) if longest >= K]
    table = []
    for samples in lengths:
        done = subprocess.run(
            [sys.executable, __file__, "at", str(samples)], capture_output=True, text=True, check=True
        )
        seconds, peak, weights = (float(part) for part in done.stdout.split())
        table.append(
            {"samples": samples, "s an iteration": seconds, "µs a sample": 1e6 * seconds / samples, "peak MiB": peak}
        )
    print(f"n = {ORDER}, {weights:.0f} weights, float64, one core")
    print(tabulate(table, headers="keys", tablefmt="pipe", floatfmt=("", ".3f", ".1f", ".0f"), intfmt=","))
    slopes = [
        np.polyfit(np.log(lengths), np.log([row[name] for row in table]), 1)[0]
        for name in ("s an iteration", "peak MiB")
    ]
    print(f"slopes: time {slopes[0]:.2f}, peak memory {slopes[1]:.2f}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["at"]:
        measure(int(sys.argv[2]))
    else:
        main()
