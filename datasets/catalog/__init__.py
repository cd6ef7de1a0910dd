"""The benchmarks by name: one module each, found by themselves, and those of plug-ins."""

import importlib
import pkgutil
from pathlib import Path
from typing import Any

from nnss_cli.datasets.benchmark import Benchmark
from nnss_cli.datasets.download import cached_file
from nnss_cli.datasets.record import Dataset

from nnss_cli.errors import unknown
from nnss_cli.plugins import Registry


def sound_benchmark(thing: Any) -> Benchmark:
    """A benchmark that a plug-in offers.

    Raises:
        ValueError: it is none, or lacks what commands need; the message says what.
    """
    if not isinstance(thing, Benchmark):
        raise ValueError(f"expected a Benchmark (nnss_cli.datasets.benchmark), found {thing!r:.80}")
    if not thing.orders or not thing.protocols:
        raise ValueError("orders and protocols: expected at least one each")
    if thing.sources and thing.cached_as != Path(thing.cached_as).name:
        raise ValueError(f"cached_as: expected a file name without a folder, found '{thing.cached_as}'")
    if thing.sources and not thing.cached_as:
        raise ValueError("cached_as: expected a file name, since it has sources")
    if not callable(thing.load):
        raise ValueError(f"load: expected a function, found {thing.load!r:.80}")
    return thing


BENCHMARKS: Registry[Benchmark] = Registry(
    "dataset",
    "nnss.datasets",
    ("BENCHMARK", "BENCHMARKS"),
    [
        importlib.import_module(f"{__name__}.{module}").BENCHMARK
        for module in sorted(found.name for found in pkgutil.iter_modules(__path__))
    ],
    sound_benchmark,
)


def benchmark(name: str) -> Benchmark:
    """The benchmark of that name.

    Raises:
        InputError: there is none (the message lists them), or that of a plug-in cannot be used.
    """
    try:
        return BENCHMARKS[name]
    except KeyError:
        raise unknown("dataset", name, BENCHMARKS) from None


def load(name: str, protocol: str = "") -> Dataset:
    """Read a benchmark from the cache, or simulate it, and split it by a protocol of its own ("" for its first).

    Raises:
        InputError: unknown name or protocol, or the file is not what it should be.
        DataUnavailable: the file has not been fetched.
    """
    entry = benchmark(name)
    chosen = entry.check_protocol(protocol)
    return entry.load(cached_file(entry) if entry.sources else None, chosen)
