"""A million-row CSV of four columns: read, described and split, and inspected, against plain pandas.read_csv.

Each in a process of its own.

    python benchmarks/reading.py [ROWS]

Prints seconds after the imports, their ratio, and the peak memory of each process.
"""

from nnss_cli.machine import prepare

prepare()

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
from nnss_cli.datasets.description import Description
from nnss_cli.datasets.experiments import load_experiments
from tabulate import tabulate

from nnss_cli.experiment.inspection_files import examine_files


def by_pandas(path: Path) -> None:
    assert pd.read_csv(path).shape[1] == 4


def by_nnss(path: Path) -> None:
    description = Description(
        name="plant", files=path.name, time="t", inputs=["u1", "u2"], outputs="y", folder=path.parent, orders=[2, 3]
    )
    found = load_experiments(description)
    assert found.train[0].Ts == 0.01
    assert len(found.train[0]) == 3 * len(found.val[0])


def by_inspect(path: Path) -> None:
    seen = examine_files([str(path)], {"time": "t", "outputs": ["y"]})
    assert seen.found.split is not None


WAYS = {"pandas.read_csv": by_pandas, "read, described, split": by_nnss, "read, inspected, split proposed": by_inspect}


def measure(way: str, path: Path) -> None:
    """In a process of its own: seconds and peak MiB."""
    best = np.inf
    for _ in range(3):
        started = time.perf_counter()
        WAYS[way](path)
        best = min(best, time.perf_counter() - started)
    print(best, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10)


def main() -> None:
    rows = int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plant.csv"
        values = np.random.default_rng(0).standard_normal((rows, 4))
        values[:, 0] = np.arange(rows) * 0.01
        pd.DataFrame(values, columns=["t", "u1", "u2", "y"]).to_csv(path, index=False)
        print(f"{rows} rows, 4 columns, {path.stat().st_size / 2**20:.0f} MiB of text, one core, best of 3")
        table, first = [], 0.0
        for way in WAYS:
            done = subprocess.run(
                [sys.executable, __file__, way, str(path)], capture_output=True, text=True, check=True
            )
            seconds, peak = (float(part) for part in done.stdout.split())
            first = first or seconds
            table.append({"": way, "seconds": seconds, "ratio": seconds / first, "peak MiB": peak})
        print(tabulate(table, headers="keys", tablefmt="pipe", floatfmt=("", ".2f", ".1f", ".0f")))


if __name__ == "__main__":
    if len(sys.argv) == 3:
        measure(sys.argv[1], Path(sys.argv[2]))
    else:
        main()
