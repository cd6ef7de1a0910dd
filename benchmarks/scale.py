"""What many runs cost beside their fits: the sweep, taking it up again, and the report; wall time and peak memory.

python benchmarks/scale.py --runs 10000 --jobs 2
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

# one state that takes no time to find
METHOD = """
import numpy as np
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.methods import Fit, Method

class Trivial(Method):
    name = "trivial"
    seeded = True
    def fit(self, data, order, seed, settings, on_epoch):
        system = LinearStateSpace(
            0.5 * np.eye(order), np.full((order, data.input_count), (1 + seed % 97) / 100),
            np.ones((data.output_count, order)), np.zeros((data.output_count, data.input_count)), data.Ts,
        )
        return Fit(LinearModel.of(system, data))

METHOD = Trivial()
"""


@dataclass(frozen=True)
class Cost:
    """What a command took."""

    seconds: float
    """Wall time."""
    processor: float
    """Time of all its processes on processors: what the wall time would be, but for waiting, on one that is idle."""
    megabytes: float
    """Peak memory of its largest process."""


def cost(*arguments: str) -> Cost:
    """Call nnss; an error of it ends the benchmark."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [sys.executable, "-m", "nnss_cli", *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    assert process.stderr is not None
    said = process.stderr.read().decode()
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        sys.exit(f"nnss {' '.join(arguments)} ended with {os.waitstatus_to_exitcode(status)}: {said}")
    return Cost(time.perf_counter() - began, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--keep", type=Path, help="folder for the results, kept")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = given.keep or Path(name)
        folder.mkdir(exist_ok=True)
        method = folder / "trivial.py"
        method.write_text(METHOD, encoding="utf-8")

        def compare(runs: int, out: str, *more: str) -> Cost:
            return cost(
                "compare", "twotank-sim", "--plugin", str(method), "--methods", "trivial", "--orders", "1",
                "--seeds", str(runs), "--jobs", str(given.jobs), "--out", str(folder / out), *more,
            )  # fmt: skip

        few = compare(2 * given.jobs, "few")  # starting, and the table and figures of a few
        first = compare(given.runs, "many")
        again = compare(given.runs, "many")
        report = cost("report", "--out", str(folder / "many"))
        wall = (first.seconds - again.seconds) * given.jobs / given.runs
        processor = (first.processor - again.processor) / given.runs
    print(f"{given.runs} runs of a trivial method, {given.jobs} processes")
    for what, one in (("a few runs", few), ("all of them", first), ("called again", again), ("report", report)):
        print(f"{what:<14}{one.seconds:8.1f} s {one.processor:8.1f} s on processors {one.megabytes:6.0f} MB")
    print(f"a run, its simulation included: {1000 * wall:.1f} ms a core, {1000 * processor:.1f} of it busy")


if __name__ == "__main__":
    main()
