"""What a second process is worth: one sweep with --jobs 1 and with --jobs 2, by turns, as a ratio of wall times.

python benchmarks/jobs.py

Wall time counts, so it needs a machine with as many idle cores; the time on processors stands beside it. Where two jobs
take more of that than one, they hinder each other; where wall time falls behind it, something else had the cores.
The numbers must be the same; that is checked.
"""

import argparse
import csv
import os
import statistics
import sys
import tempfile
from pathlib import Path

from scale import Cost, cost


def table(out: Path) -> list[list[str]]:
    """rmse.csv without the times."""
    (path,) = out.rglob("rmse.csv")
    with path.open(newline="") as stream:
        rows = list(csv.reader(stream))
    times = rows[0].index("fit_seconds")
    return [row[:times] + row[times + 1 :] for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--times", type=int, default=1, help="each; the median counts")
    parser.add_argument("--seeds", type=int, default=40, help="runs of a sweep: a multiple of the jobs")
    parser.add_argument("--epochs", type=int, default=300, help="of a run, by Adam, none of them stopped early")
    given = parser.parse_args()
    found: dict[int, list[Cost]] = {1: [], given.jobs: []}
    numbers = []
    with tempfile.TemporaryDirectory() as name:

        def sweep(jobs: int, seeds: int, out: Path) -> Cost:
            return cost(
                "compare", "twotank-sim", "--methods", "nnss", "--recipe", "paper", "--orders", "3", "--seeds",
                str(seeds), "--epochs", str(given.epochs), "--patience", "1000000", "--jobs", str(jobs),
                "--out", str(out),
            )  # fmt: skip

        few = {jobs: sweep(jobs, 1, Path(name, f"warm-{jobs}")) for jobs in found}  # kernels are compiled then
        for turn in range(given.times):
            for jobs, costs in found.items():
                out = Path(name, f"{jobs}-{turn}")
                costs.append(sweep(jobs, given.seeds, out))
                numbers.append(table(out))
    if any(other != numbers[0] for other in numbers):
        sys.exit("the numbers depend on the number of jobs")
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    print(f"{given.seeds} runs of {given.epochs} epochs, {os.cpu_count()} cores, load {load:.1f} at the end")
    for jobs, costs in found.items():
        wall, busy = (statistics.median(getattr(one, what) for one in costs) for what in ("seconds", "processor"))
        print(f"--jobs {jobs}: {wall:7.1f} s, {busy:7.1f} s on processors; one run alone {few[jobs].seconds:.1f} s")
    one, more = (statistics.median(one.seconds for one in costs) for costs in found.values())
    start = min(each.seconds for each in few.values())
    apart = (one - start) / max(more - start, 1e-9)
    print(f"--jobs {given.jobs} is {one / more:.2f} times as fast; without start, tables and one run, {apart:.2f}")


if __name__ == "__main__":
    main()
