"""What a benchmark file must provide, and the helpers that several of them share."""

from __future__ import annotations

import gzip
import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from nnss_cli.datasets.record import Dataset, FloatArray, Protocol

from nnss_cli.errors import InputError


@dataclass(frozen=True)
class Source:
    """One place that a file can be had from."""

    url: str
    """http, https or ftp address; its last part is the name that a mirror keeps the file under."""
    sha256: str | None = None
    """Hash of the bytes, where they are known; the contents are checked in any case."""

    @property
    def filename(self) -> str:
        """Name of the file at the source."""
        return self.url.rsplit("/", 1)[-1]


@dataclass(frozen=True)
class Benchmark:
    """A named dataset: where it is, how it is read and split, who is to be cited."""

    name: str
    """Name on the command line."""
    title: str
    """One line for tables."""
    citation: str
    """Reference to give when results are published."""
    orders: tuple[int, ...]
    """Model orders of the paper."""
    sources: tuple[Source, ...]
    """Places to fetch from, tried in turn; none for an embedded simulation."""
    cached_as: str
    """File name in the cache ("" for an embedded simulation)."""
    load: Callable[[Path | None, Protocol], Dataset]
    """Read the file (None for an embedded simulation), check its contents, split it.
    Raises InputError when the file is not what it should be."""


def read_bytes(path: Path) -> bytes:
    """The file's contents, unpacked when gzip has packed them.

    Raises:
        InputError: missing, unreadable or damaged.
    """
    try:
        content = path.read_bytes()
        return gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    except (OSError, EOFError) as error:
        raise InputError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from error


def read_matlab(path: Path, variable_sets: tuple[tuple[str, ...], ...]) -> dict[str, FloatArray]:
    """The first of `variable_sets` that a MATLAB v5 file holds in full, as column arrays.

    Raises:
        InputError: not a MATLAB file, or none of the sets is in it.
    """
    import scipy.io

    content = read_bytes(path)
    try:
        variables = scipy.io.loadmat(io.BytesIO(content), chars_as_strings=False)
    except Exception as error:  # scipy raises whatever the damaged bytes lead it to
        raise InputError(f"'{path}' is not a readable MATLAB file: truncated, corrupt or another format") from error
    for names in variable_sets:
        if all(name in variables for name in names):
            return {
                name: np.asarray(values, dtype=np.float64).reshape(len(values), -1)
                for name, values in variables.items()
                if isinstance(values, np.ndarray) and values.dtype.kind in "iuf" and values.ndim == 2
            }
    expected = " or ".join("(" + ", ".join(names) + ")" for names in variable_sets)
    found = ", ".join(name for name in variables if not name.startswith("__")) or "nothing"
    raise InputError(f"'{path}': expected the variables {expected}, found {found}")


def check_contents(path: Path | None, what: str, y: FloatArray, mean: FloatArray, std: FloatArray) -> None:
    """Compare a record's statistics with the published file's: bytes may differ, samples may not.

    Args:
        path: the file, for the message.
        what: the name of the signal, for the message.
        y: samples (K, m).
        mean: expected mean (m,).
        std: expected standard deviation, ddof = 1 (m,).

    Raises:
        InputError: mean or deviation is off by more than 1e-8 of the deviation.
    """
    found_mean, found_std = y.mean(axis=0), y.std(axis=0, ddof=1)
    if np.abs(found_mean - mean).max(initial=0) > 1e-8 * np.max(std) or not np.allclose(found_std, std, rtol=1e-8):
        raise InputError(
            f"'{path}' is not the expected record: {what} should have mean {_short(mean)} and deviation "
            f"{_short(std)}, found {_short(found_mean)} and {_short(found_std)}; "
            "fetch it again with --force, or give the original file with --from"
        )


def _short(values: FloatArray) -> str:
    return ", ".join(f"{value:.6g}" for value in np.atleast_1d(values))
