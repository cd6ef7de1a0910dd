"""Retrieval of data files into a cache: several sources in turn, checked, atomic.

A file enters the cache only after its benchmark has read it and found the expected contents,
so whatever is in the cache under its name was whole when it came. Its hash is kept beside it
and compared at every use. A source may be a zip or a folder: what is wanted is taken out by name,
and a record of several files is kept as one zip.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path

from nnss_cli.datasets.archive import holds_files, pack, take
from nnss_cli.datasets.benchmark import Benchmark, Source, read_bytes

from nnss_cli.errors import DataUnavailable, InputError
from nnss_cli.files import write_bytes, write_text

TIMEOUT = 30  # seconds without an answer before the next source is tried


def cache_folder() -> Path:
    """NNSS_DATA_DIR, or the platform's cache folder for nnss."""
    chosen = os.environ.get("NNSS_DATA_DIR")
    if chosen:
        return Path(chosen).expanduser()
    import pooch

    return Path(pooch.os_cache("nnss"))


def is_cached(benchmark: Benchmark) -> bool:
    """Whether the file is in the cache (its contents are checked when it is read)."""
    return (cache_folder() / benchmark.cached_as).is_file()


def cached_file(benchmark: Benchmark) -> Path:
    """The path of the fetched file, its hash compared with the one kept when it came.

    Raises:
        DataUnavailable: it has not been fetched.
        InputError: it has changed since.
    """
    path = cache_folder() / benchmark.cached_as
    if not path.is_file():
        raise DataUnavailable(
            f"dataset '{benchmark.name}' is not in {cache_folder()}: run 'nnss fetch {benchmark.name}', "
            f"or 'nnss fetch {benchmark.name} --from FILE' with a file that you have"
        )
    kept = _hash_file(path)
    if kept.is_file() and kept.read_text().strip() != _sha256(read_bytes(path)):
        raise InputError(f"'{path}' has changed since it was fetched: run 'nnss fetch {benchmark.name} --force'")
    return path


def fetch(
    benchmark: Benchmark,
    *,
    mirror: str | None = None,
    offline: bool = False,
    force: bool = False,
    progress: Callable[[str], object] | None = None,
) -> Path:
    """Bring a benchmark's file into the cache and return its path.

    Args:
        benchmark: which file.
        mirror: a folder or base address that holds the files under their original names; it is
            tried before the original sources. NNSS_MIRROR is used where this is None.
        offline: touch no network: only the cache and a mirror folder.
        force: fetch again even if it is cached; the old file stays until a good new one is there.
        progress: given a source's name, returns pooch's progress bar object (or None).

    Raises:
        DataUnavailable: no source gave the expected file; each one's failure is named.
    """
    if is_cached(benchmark) and not force:
        path = cached_file(benchmark)
        benchmark.load(path, benchmark.protocols[0])
        return path
    failures = []
    for source in _places(benchmark, mirror or os.environ.get("NNSS_MIRROR")):
        if offline and "://" in source.url:
            continue
        try:
            with tempfile.TemporaryDirectory(prefix="nnss-") as folder:
                return install(benchmark, retrieve(source, Path(folder), progress))
        except (OSError, ValueError, EOFError) as error:  # requests' errors are OSErrors
            failures.append(f"{_host(source)}: {_one_line(error)}")
    if offline:
        failures.append("--offline keeps the network out")
    raise DataUnavailable(
        f"dataset '{benchmark.name}' could not be fetched ({'; '.join(failures)}). "
        f"Give a copy with 'nnss fetch {benchmark.name} --from FILE' or a folder of files with --mirror DIR"
    )


def install(benchmark: Benchmark, file: Path) -> Path:
    """Put what is already here into the cache, once its contents have been checked.

    Args:
        benchmark: whose file it is.
        file: the file itself, or a zip or a folder that has it under its name.

    Raises:
        InputError: the file is not the benchmark's.
    """
    if not benchmark.sources:
        raise InputError(f"dataset '{benchmark.name}' is simulated: expected no file, found '{file}': leave --from out")
    with tempfile.TemporaryDirectory(prefix="nnss-") as folder:
        single = _single_file(benchmark, file, Path(folder))
        content = read_bytes(single)
        try:
            benchmark.load(single, benchmark.protocols[0])
        except InputError as error:  # about the file that was given, not the one taken from it
            raise InputError(str(error).replace(str(single), str(file))) from error
    target = cache_folder() / benchmark.cached_as
    try:
        # The hash goes first: a crash in between leaves a mismatch that is reported, not a silent one.
        write_text(_hash_file(target), _sha256(content) + "\n")
        write_bytes(target, content)
    except OSError as error:
        raise InputError(
            f"cannot write to the cache '{target.parent}': {error.strerror or error}; "
            "set NNSS_DATA_DIR to a folder that can be written"
        ) from error
    return target


def retrieve(source: Source, folder: Path, progress: Callable[[str], object] | None = None) -> Path:
    """Download a source's file into `folder`, or each of its parts, and return the path of the file or the folder.

    A source that is a path is returned as it is.

    Raises:
        OSError, ValueError: it cannot be had, or its hash is another.
    """
    if "://" not in source.url:
        return Path(source.url)
    if source.parts:
        for part in source.parts:
            retrieve(part, folder, progress)
        return folder
    import logging

    import pooch

    pooch.get_logger().setLevel(logging.ERROR)
    bar = progress(source.filename) if progress else None
    downloader = pooch.core.choose_downloader(source.url, progressbar=bar or False)
    if hasattr(downloader, "kwargs"):
        downloader.kwargs["timeout"] = TIMEOUT
    else:
        downloader.timeout = TIMEOUT
    known = f"sha256:{source.sha256}" if source.sha256 else None
    return Path(pooch.retrieve(source.url, known, fname=source.filename, path=folder, downloader=downloader))


def _single_file(benchmark: Benchmark, given: Path, folder: Path) -> Path:
    """`given`, or one file made in `folder` of what a zip or a folder holds: the loader's form of the record."""
    wanted = benchmark.wanted
    if not holds_files(given):
        if len(wanted) > 1 and given.is_file():
            names = " and ".join(names[0] for names in wanted)
            raise InputError(f"'{given}': expected a folder or a zip with {names}, found a single file")
        return given
    contents = take(given, wanted)
    single = folder / benchmark.cached_as
    if len(wanted) == 1:
        single.write_bytes(contents[0])
    else:
        single.write_bytes(pack({names[0]: content for names, content in zip(wanted, contents, strict=True)}))
    return single


def _places(benchmark: Benchmark, mirror: str | None) -> list[Source]:
    original = list(benchmark.sources)
    if not mirror:
        return original
    base = mirror.rstrip("/") if "://" in mirror else str(Path(mirror).expanduser().resolve())
    names = [source.filename for source in original if not source.parts]
    places = []
    if len(benchmark.wanted) == 1:
        names += benchmark.wanted[0]
    else:
        places.append(Source(base, parts=tuple(Source(f"{base}/{names[0]}") for names in benchmark.wanted)))
    names.append(benchmark.cached_as)
    return [*places, *(Source(f"{base}/{name}") for name in dict.fromkeys(names)), *original]


def _host(source: Source) -> str:
    return source.url.split("/")[2] if "://" in source.url else source.url


def _one_line(error: BaseException) -> str:
    reason = error
    while reason.__cause__ or reason.__context__:
        reason = reason.__cause__ or reason.__context__  # type: ignore[assignment]
    text = " ".join(str(error).split()) if isinstance(error, InputError) else " ".join(str(reason).split())
    return text[:160] or type(error).__name__


def _hash_file(path: Path) -> Path:
    return path.with_name(path.name + ".sha256")


def _sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()
