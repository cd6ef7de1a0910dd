"""The benchmarks by name."""

from nnss_cli.datasets import powerplant, robotarm, simulated, twotank
from nnss_cli.datasets.benchmark import Benchmark
from nnss_cli.datasets.download import cached_file
from nnss_cli.datasets.record import Dataset, check_protocol

from nnss_cli.errors import unknown

BENCHMARKS: dict[str, Benchmark] = {
    module.BENCHMARK.name: module.BENCHMARK for module in (twotank, robotarm, powerplant, simulated)
}


def benchmark(name: str) -> Benchmark:
    """The benchmark of that name.

    Raises:
        InputError: there is none; the message lists them.
    """
    if name not in BENCHMARKS:
        raise unknown("dataset", name, BENCHMARKS)
    return BENCHMARKS[name]


def load(name: str, protocol: str = "paper") -> Dataset:
    """Read a benchmark from the cache, or simulate it, and split it.

    Raises:
        InputError: unknown name or protocol, or the file is not what it should be.
        DataUnavailable: the file has not been fetched.
    """
    entry = benchmark(name)
    chosen = check_protocol(protocol)
    return entry.load(cached_file(entry) if entry.sources else None, chosen)
