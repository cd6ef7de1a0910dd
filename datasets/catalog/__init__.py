"""The benchmarks by name: one module each, found by themselves."""

import importlib
import pkgutil

from nnss_cli.datasets.benchmark import Benchmark
from nnss_cli.datasets.download import cached_file
from nnss_cli.datasets.record import Dataset

from nnss_cli.errors import unknown

BENCHMARKS: dict[str, Benchmark] = {
    entry.name: entry
    for module in sorted(found.name for found in pkgutil.iter_modules(__path__))
    for entry in [importlib.import_module(f"{__name__}.{module}").BENCHMARK]
}


def benchmark(name: str) -> Benchmark:
    """The benchmark of that name.

    Raises:
        InputError: there is none; the message lists them.
    """
    if name not in BENCHMARKS:
        raise unknown("dataset", name, BENCHMARKS)
    return BENCHMARKS[name]


def load(name: str, protocol: str = "") -> Dataset:
    """Read a benchmark from the cache, or simulate it, and split it by a protocol of its own ("" for its first).

    Raises:
        InputError: unknown name or protocol, or the file is not what it should be.
        DataUnavailable: the file has not been fetched.
    """
    entry = benchmark(name)
    chosen = entry.check_protocol(protocol)
    return entry.load(cached_file(entry) if entry.sources else None, chosen)
