"""Getting a dataset ready: a benchmark by its name, or files of one's own with their description."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from nnss_cli.datasets.catalog import BENCHMARKS, benchmark, load
from nnss_cli.datasets.description import Description, check_fields, read_description, record_name
from nnss_cli.datasets.download import fetch, is_cached
from nnss_cli.datasets.record import Dataset
from nnss_cli.errors import InputError


@dataclass(frozen=True)
class Ready:
    """A dataset as a comparison needs it."""

    dataset: Dataset
    """Loaded and split."""
    orders: tuple[int, ...]
    """Orders to compare unless others are asked for; empty where none are known."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Settings of methods that its description makes."""

    def orders_or(self, asked: Sequence[int] | None) -> Sequence[int]:
        """The orders asked for, else the dataset's own.

        Raises:
            InputError: there are neither.
        """
        if not asked and not self.orders:
            raise InputError(
                f"{self.dataset.name} has no usual orders: give --orders, e.g. --orders 2 3 4; "
                "'nnss order' shows what the data call for"
            )
        return asked or self.orders


def ready(
    names: Sequence[str],
    protocol: str = "",
    mirror: str | None = None,
    offline: bool = False,
    own: dict[str, Any] | None = None,
    title: Callable[[str], str] = str,
    progress: Callable[[str], Any] | None = None,
) -> Ready:
    """Load a benchmark, fetching its file when it is missing, or read files of one's own.

    Args:
        names: of a benchmark; or a description (.toml); or one file or more with an experiment each.
        protocol: of a benchmark; "" for its first.
        mirror: where to fetch from first.
        offline: touch no network.
        own: fields of a description.
        title: what messages call such a field.
        progress: makes a bar for a download, by the file's name.

    Raises:
        InputError: neither a benchmark nor a file, or whatever is wrong with it.
    """
    own = own or {}
    if len(names) == 1 and names[0] in BENCHMARKS:
        if own:
            raise InputError(
                f"{title(next(iter(own)))}: expected for files of one's own only: '{names[0]}' is a benchmark and "
                "lays this down itself"
            )
        return _benchmark(names[0], protocol, mirror, offline, progress)
    if not any(map(_looks_like_a_file, names)):
        benchmark(next(name for name in names if name not in BENCHMARKS) if len(names) == 1 else names[0])
        raise InputError(f"expected one benchmark, found {', '.join(names)}; several are compared one after the other")
    from nnss_cli.baselines.arx import scaling_at_rest
    from nnss_cli.datasets.experiments import OWN, dataset_of, load_experiments

    if protocol not in ("", OWN):
        raise InputError(f"--protocol {protocol}: a record of one's own has the protocol '{OWN}' only: leave it out")
    description = describe(names, own, title)
    settings = {} if description.horizon == "auto" else {"horizon": description.horizon}
    if description.name in BENCHMARKS:
        raise InputError(f"name '{description.name}' is a benchmark's: give another with --name, or in the description")
    return Ready(dataset_of(load_experiments(description), scaling_at_rest), description.orders, settings)


def describe(names: Sequence[str], own: Mapping[str, Any], title: Callable[[str], str] = str) -> Description:
    """A description read from its file, or made of the fields given, which go before the file's keys.

    Raises:
        InputError: no such file, or a wrong or missing field.
    """
    for name in names:
        if not Path(name).exists():
            near = f"a benchmark ({', '.join(BENCHMARKS)}) or " if len(names) == 1 else ""
            raise InputError(f"no such file: '{name}'; expected {near}a file of samples or a description (.toml)")
    described = [name for name in names if name.lower().endswith(".toml")]
    if described:
        if len(names) > 1:
            raise InputError(f"'{described[0]}' describes its files: expected it alone, found {len(names)} files")
        return described_with(Path(described[0]), own)
    for needed in ("inputs", "outputs"):
        if needed not in own:
            raise InputError(
                f"{title(needed)}: expected the columns of the {needed}; 'nnss inspect {names[0]}' shows what there is"
            )
    return Description(
        files=tuple(names), **{"name": record_name(names[0]), **own}, folder=Path.cwd(), allow_outside=True
    )


def described_with(path: Path, own: Mapping[str, Any]) -> Description:
    """The description in a file with the fields given beside it, whose files start at the working folder.

    Raises:
        InputError: no such file, or a wrong field.
    """
    own = check_fields(own)
    if "val" in own:
        own["val"] = _resolved(own["val"])
    if "test" in own:
        own["test"] = {name: _resolved(files) for name, files in own["test"].items()}
    if {"val", "test"} & set(own):
        own["allow_outside"] = True
    return replace(read_description(path), **own, folder=path.parent)


def _resolved(files: Sequence[str]) -> tuple[str, ...]:
    return tuple(str(Path(file).resolve()) for file in files)


def _looks_like_a_file(name: str) -> bool:
    return Path(name).exists() or Path(name).suffix != "" or "/" in name


def _benchmark(
    name: str, protocol: str, mirror: str | None, offline: bool, progress: Callable[[str], Any] | None
) -> Ready:
    entry = benchmark(name)
    entry.check_protocol(protocol)
    if entry.sources and not is_cached(entry):
        fetch(entry, mirror=mirror, offline=offline, progress=progress)
    return Ready(load(name, protocol), entry.orders)
