"""What fits cost on records of 1e3 to 1e6 samples: seconds of processor time and peak memory, a process each.

    python benchmarks/length.py [--methods nnss n4sid ssest ssregest] [--longest 1e6] [--order 6] [--channels 1]
        [--plot docs/length.png]

NN-SS: an iteration of recipe `best`, the normal equations of all samples and the solution of one damped step, for a
generator with one hidden layer of 2 (one input and output, order 6: some 500 weights). The linear methods: the whole
fit as `nnss compare` makes it, on a linear plant of that order whose outputs saturate, with 5 % noise; as many
samples again, at most 20,000, validate. Compilation is left out. Prints the slopes of time and memory in doubly
logarithmic coordinates: 1 is proportional to the length, 0 independent of it.
"""

from nnss_cli.machine import prepare

prepare()

import argparse
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from nnss_cli.baselines.n4sid import n4sid_auto
from nnss_cli.baselines.ssest import ssest_by_validation
from nnss_cli.baselines.ssregest import ssregest
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Record, Scaling
from tabulate import tabulate

HIDDEN = 2
LENGTHS = (1_000, 10_000, 100_000, 1_000_000)
METHODS: dict[str, Callable[[tuple[Record, ...], tuple[Record, ...], int], object]] = {
    "n4sid": n4sid_auto,
    "ssest": ssest_by_validation,
    "ssregest": lambda train, _, order: ssregest(train, order),
}


def iteration(samples: int, n: int, channels: int) -> float:
    """Seconds of an iteration of recipe `best`."""
    # here, so that the linear methods' memory is without torch
    from nnss_cli.model.architecture import Architecture
    from nnss_cli.model.nnss import NNSS
    from nnss_cli.training.fast import FastEngine
    from nnss_cli.training.gauss_newton import gauss_newton
    from nnss_cli.training.recipe import Recipe

    random, one = np.random.default_rng(0), np.ones(channels)
    architecture = Architecture(n, channels, channels, hidden=(HIDDEN,), encoder=(8,), dtype="float64")
    names = tuple(str(i) for i in range(channels))
    model = NNSS(architecture, Scaling(one, one, one, one), Channels(names, names, names, names), 1.0)
    model.initialise(random)
    u, y = random.standard_normal((2, 1, samples, channels))
    engine = FastEngine(model, list(u), list(y), Recipe(dtype="float64"))
    list(FastEngine(model, [u[0, :9]], [y[0, :9]], Recipe(dtype="float64")).sensitivities(np.zeros((1, n))))  # compile
    evaluations: list[float] = []
    plain = engine.sensitivities

    def timed(x0):
        evaluations.append(time.process_time())
        return plain(x0)

    engine.sensitivities = timed
    gauss_newton(engine, list(u), list(y), 3, lambda _: True)
    return (time.process_time() - evaluations[0]) / len(evaluations)


def whole_fit(method: str, samples: int, n: int, channels: int) -> float:
    """Seconds of a fit by one of the linear methods."""
    random = np.random.default_rng(0)
    A = random.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    B, C = random.standard_normal((n, channels)), random.standard_normal((channels, n))
    plant = LinearStateSpace(A, B, C, np.zeros((channels, channels)), 1.0)

    def record(K: int) -> tuple[Record, ...]:
        u = random.standard_normal((K, channels))
        y = plant.simulate(u, np.zeros(n))[0]
        y = np.tanh(0.5 * y / y.std(axis=0))
        y /= y.std(axis=0)
        return (Record(u, y + 0.05 * random.standard_normal(y.shape), 1.0),)

    train, val, short = record(samples), record(min(samples, 20_000)), record(10_000)
    METHODS[method](short, short, 1)  # compile
    started = time.process_time()
    METHODS[method](train, val, n)
    return time.process_time() - started


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--methods", nargs="+", choices=("nnss", *METHODS), default=("nnss", *METHODS))
    parser.add_argument("--longest", type=float, default=LENGTHS[-1])
    parser.add_argument("--order", type=int, default=6)
    parser.add_argument("--channels", type=int, default=1, help="inputs, and outputs")
    parser.add_argument("--plot", type=Path, help="draw it, as a PNG")
    parser.add_argument("--at", type=int, help="measure the first method at this length, in this process")
    given = parser.parse_args()
    if given.at:
        seconds = (
            iteration(given.at, given.order, given.channels)
            if given.methods[0] == "nnss"
            else whole_fit(given.methods[0], given.at, given.order, given.channels)
        )
        print(seconds, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10)
        return
    measured = {}
    for method in given.methods:
        rows = []
        for samples in (K for K in LENGTHS if given.longest >= K):
            line = [sys.executable, __file__, "--methods", method, "--at", str(samples)]
            line += ["--order", str(given.order), "--channels", str(given.channels)]
            done = subprocess.run(line, capture_output=True, text=True, check=True)
            seconds, peak = (float(part) for part in done.stdout.split())
            rows.append({"samples": samples, "s": seconds, "µs a sample": 1e6 * seconds / samples, "peak MiB": peak})
        measured[method] = rows
        print(f"\n{method}, n = {given.order}, {given.channels} input(s) and output(s), float64, one core")
        print(tabulate(rows, headers="keys", tablefmt="pipe", floatfmt=("", ".3f", ".1f", ".0f"), intfmt=","))
        if len(rows) > 1:
            lengths = np.log([row["samples"] for row in rows])
            time_slope, memory_slope = (
                np.polyfit(lengths, np.log([row[name] for row in rows]), 1)[0] for name in ("s", "peak MiB")
            )
            print(f"slopes: time {time_slope:.2f}, peak memory {memory_slope:.2f}", flush=True)
    if given.plot:
        draw(measured, given.plot)


def draw(measured: Mapping[str, Sequence[Mapping[str, float]]], path: Path) -> None:
    """Time a sample and peak memory over the record's length, a line each method."""
    from nnss_cli.report.figures import plt, save_figure
    from nnss_cli.report.style import STYLE, styles_of

    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 2, figsize=(8.4, 3.2), layout="constrained")
        titles = {"µs a sample": "processor time a sample [µs]", "peak MiB": "peak memory of the process [MiB]"}
        for panel, (name, title) in zip(panels, titles.items(), strict=True):
            for method, look in styles_of(measured).items():
                rows, what = measured[method], "an iteration" if method == "nnss" else "the whole fit"
                panel.plot(
                    [row["samples"] for row in rows], [row[name] for row in rows], label=f"{look.label}, {what}",
                    color=look.colour, linestyle=look.line, marker=look.marker, markersize=4,
                )  # fmt: skip
            panel.set(xlabel="samples of the record", ylabel=title, xscale="log")
        panels[0].set_yscale("log")
        panels[1].set_ylim(bottom=0)
        figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    save_figure(figure, path)


if __name__ == "__main__":
    main()
