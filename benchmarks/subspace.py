"""N4SID against nfoursid and SLICOT on the same record, in one run, and its memory on a long one.

    make bench        (or: python benchmarks/subspace.py)

Prints seconds, ratios to ours, and the largest error of the first Markov parameters.
"""

from nnss_cli.machine import prepare

prepare()

import resource
import time
from collections.abc import Callable

import ctrlsys
import numpy as np
import pandas as pd
from nfoursid.nfoursid import NFourSID
from nnss_cli.baselines.n4sid import n4sid
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.baselines.subspace import Horizon
from nnss_cli.datasets.record import Record
from tabulate import tabulate


def record_of(plant: LinearStateSpace, K: int) -> Record:
    random = np.random.default_rng(1)
    u = random.standard_normal((K, plant.B.shape[1]))
    y, _ = plant.simulate(u, np.zeros(plant.order))
    return Record(u, y + 0.01 * random.standard_normal(y.shape), 1.0)


def plant_of(n: int, r: int, m: int) -> LinearStateSpace:
    random = np.random.default_rng(0)
    A = random.standard_normal((n, n))
    A *= 0.9 / np.abs(np.linalg.eigvals(A)).max()
    return LinearStateSpace(A, random.standard_normal((n, r)), random.standard_normal((m, n)), np.zeros((m, r)), 1.0)


def by_nfoursid(record: Record, n: int, blocks: int) -> LinearStateSpace:
    names = [f"u{i}" for i in range(record.input_count)], [f"y{i}" for i in range(record.output_count)]
    frame = pd.DataFrame(np.concatenate([record.u, record.y], axis=1), columns=names[0] + names[1])
    method = NFourSID(frame, output_columns=names[1], input_columns=names[0], num_block_rows=blocks)
    method.subspace_identification()
    found, _ = method.system_identification(rank=n)
    return LinearStateSpace(found.a, found.b, found.c, found.d, 1.0)


def by_slicot(record: Record, n: int, blocks: int) -> LinearStateSpace:
    r, m = record.input_count, record.output_count
    u, y = np.array(record.u, order="F"), np.array(record.y, order="F")
    _, R, *_ = ctrlsys.ib01ad("M", "Q", "N", "O", "N", "N", blocks, r, m, u, y, 0.0, -1.0)
    A, C, *_ = ctrlsys.ib01bd("M", "C", "N", blocks, n, r, m, len(record), R, 0.0)
    u, y = np.array(record.u, order="F"), np.array(record.y, order="F")
    B, D = np.zeros((n, r), order="F"), np.zeros((m, r), order="F")
    _, B, D, *_ = ctrlsys.ib01cd("X", "C", "D", n, r, m, A.copy("F"), B, C.copy("F"), D, u, y, 0.0)
    return LinearStateSpace(np.array(A), np.array(B), np.array(C), np.array(D), 1.0)


def timed(fit: Callable[[], LinearStateSpace], repeats: int) -> tuple[float, LinearStateSpace]:
    best, model = np.inf, None
    for _ in range(repeats):
        started = time.perf_counter()
        model = fit()
        best = min(best, time.perf_counter() - started)
    assert model is not None
    return best, model


def compare(K: int, n: int, blocks: int) -> None:
    """All three methods on one record of K samples."""
    plant = plant_of(n, 1, 1)
    record = record_of(plant, K)
    fits = {
        "nnss n4sid": lambda: n4sid((record,), n, Horizon(blocks, blocks, True, "moesp")),
        "SLICOT (ctrlsys)": lambda: by_slicot(record, n, blocks),
        "nfoursid": lambda: by_nfoursid(record, n, blocks),
    }
    rows = []
    ours = np.nan
    for name, fit in fits.items():
        try:
            seconds, model = timed(fit, 2)
        except MemoryError as error:  # nfoursid takes a full SVD of the samples
            rows.append({"method": name, "seconds": f"none: {error}"})
            continue
        ours = seconds if name.startswith("nnss") else ours
        error_found = np.abs(model.markov(30) - plant.markov(30)).max()
        rows.append({
            "method": name, "seconds": f"{seconds:.2f}", "ratio to ours": f"{seconds / ours:.1f}",
            "error of Markov parameters": f"{error_found:.1e}",
        })  # fmt: skip
    print(f"\nN4SID, {K} samples, order {n}, {blocks} block rows, one core")
    print(tabulate(rows, headers="keys", tablefmt="pipe"))


def main() -> None:
    compare(5_000, 10, 20)
    compare(100_000, 10, 20)

    plant = plant_of(10, 2, 2)
    long = record_of(plant, 1_000_000)
    started = time.perf_counter()
    n4sid((long,), 10, Horizon(15, 20, False, "cva"))
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"\n1e6 samples, 2 inputs, 2 outputs, order 10: {seconds:.1f} s, peak memory of the process {peak:.2f} GiB")


if __name__ == "__main__":
    main()
