"""Getting a dataset ready for a command: fetched if need be, loaded, split."""

from __future__ import annotations

from nnss_cli.datasets.catalog import benchmark, load
from nnss_cli.datasets.download import fetch, is_cached
from nnss_cli.datasets.record import Dataset


def ready_dataset(name: str, protocol: str, mirror: str | None, offline: bool) -> Dataset:
    """Load a dataset, fetching its file when it is missing."""
    entry = benchmark(name)
    entry.check_protocol(protocol)
    if entry.sources and not is_cached(entry):
        from nnss_cli.commands.display import DownloadProgress

        fetch(entry, mirror=mirror, offline=offline, progress=DownloadProgress)
    return load(name, protocol)
