"""Fits of high orders and several inputs and outputs: seconds of processor time, and errors on a record of their own.

    python benchmarks/orders.py [--samples 1000] [--methods nnss n4sid ssest ssregest] [--most 10]

The plant: x(k+1) = A tanh(x) + B u, y = C x, of the order that is fitted, ρ(A) = 0.95, white u, 5 % noise on y; half as
many samples validate, as many test. Compilation is left out.
"""

from nnss_cli.machine import prepare

prepare()

import argparse
import time

import numpy as np
from nnss_cli.datasets.record import Channels, FittingData, FloatArray, Record, Scaling
from tabulate import tabulate

from nnss_cli.methods import METHODS

SIZES = ((2, 1), (4, 2), (6, 3), (8, 1), (10, 1), (10, 5))
"""Order n, and inputs and outputs."""
NOISE = 0.05


def records(n: int, channels: int, *lengths: int) -> list[tuple[Record, FloatArray]]:
    """Measured records, and their outputs without noise, in units of the outputs' deviations."""
    random = np.random.default_rng(0)
    A = random.standard_normal((n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    B, C = random.standard_normal((n, channels)), random.standard_normal((channels, n))
    found = []
    for K in lengths:
        u, x = random.standard_normal((K, channels)), np.zeros((K, n))
        for k in range(K - 1):
            x[k + 1] = A @ np.tanh(x[k]) + B @ u[k]
        y = x @ C.T
        y /= y.std(axis=0)
        found.append((Record(u, y + NOISE * random.standard_normal(y.shape), 1.0), y))
    return found


def fitting(train: Record, val: Record) -> FittingData:
    """Data of a fit, with channels u1, u2, …, y1, y2, … without units."""
    u = tuple(f"u{i + 1}" for i in range(train.input_count))
    y = tuple(f"y{i + 1}" for i in range(train.output_count))
    channels = Channels(u, y, ("",) * len(u), ("",) * len(y))
    return FittingData("plant", "own", (train,), (val,), Scaling.of((train,)), channels)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    methods = ("nnss", "n4sid", "ssest", "ssregest")
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--methods", nargs="+", choices=methods, default=methods)
    parser.add_argument("--most", type=int, default=SIZES[-1][0], help="orders up to this")
    given = parser.parse_args()
    rows = []
    for n, channels in (size for size in SIZES if size[0] <= given.most):
        (train, _), (val, _), (test, clean) = records(n, channels, given.samples, given.samples // 2, given.samples)
        data = fitting(train, val)
        row: dict[str, object] = {"order": n, "inputs, outputs": channels}
        for name in given.methods:
            method = METHODS[name]
            settings = method.settings(data, n, {})
            method.prepare(settings)
            began = time.process_time()
            fit = method.fit(data, n, 0, settings, None)
            row[f"{name} [s]"] = f"{time.process_time() - began:.1f}"
            error = np.nan
            if fit.model:
                error = np.sqrt(np.mean((fit.model.simulate(test.u, test.y[:1]).y - clean) ** 2))
            row[f"{name}, test/σ"] = f"{error:.3f}"
        rows.append(row)
        print(row, flush=True)
    print(f"\n{given.samples} samples, noise {NOISE:g} of a deviation, one core")
    print(tabulate(rows, headers="keys", tablefmt="pipe", disable_numparse=True))


if __name__ == "__main__":
    main()
