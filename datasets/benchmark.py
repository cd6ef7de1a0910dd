"""What a benchmark file must provide, and the helpers that several of them share."""

from __future__ import annotations

import gzip
import hashlib
import io
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from nnss_cli.datasets.record import Dataset, FloatArray, Presets

from nnss_cli.errors import InputError, unknown


@dataclass(frozen=True)
class Source:
    """One place that a file can be had from."""

    url: str
    """http, https or ftp address of a file or of a zip with it; of a folder where there are `parts`."""
    sha256: str | None = None
    """Hash of the bytes, where they are known; the contents are checked in any case."""
    name: str = ""
    """Name that a mirror keeps the file under, where it is not the address's last part."""
    parts: tuple[Source, ...] = ()
    """The files that make up the record together, where they do not come in one."""

    @property
    def filename(self) -> str:
        """Name of the file at the source."""
        return self.name or self.url.rsplit("/", 1)[-1]


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
    """Model orders that are compared unless others are asked for."""
    sources: tuple[Source, ...]
    """Places to fetch from, tried in turn; none for an embedded simulation."""
    cached_as: str
    """File name in the cache ("" for an embedded simulation); a zip where the record is several files."""
    load: Callable[[Path | None, str], Dataset]
    """Read the file (None for an embedded simulation), check its contents, split it by a protocol.
    Raises InputError when the file is not what it should be."""
    protocols: tuple[str, ...] = ("paper", "strict")
    """Ways to split and scale it, the usual one first; `paper` where there is a paper to repeat."""
    presets: Presets = field(default_factory=dict)
    """Settings of recipes for this benchmark: recipe → order → what differs from the recipe's own."""
    files: tuple[tuple[str, ...], ...] = ()
    """What is taken from a zip or a folder: for each file of the record the names that it may go by, the usual one
    first; empty for one file under the name that it has at a source."""

    @property
    def wanted(self) -> tuple[tuple[str, ...], ...]:
        """`files`, or what they follow from."""
        return self.files or ((*(source.filename for source in self.sources), self.cached_as),)

    def check_protocol(self, name: str) -> str:
        """The protocol of that name; the first where it is "".

        Raises:
            InputError: the dataset has none of that name; the message lists those that it has.
        """
        if name and name not in self.protocols:
            raise unknown(f"protocol of {self.name}", name, self.protocols)
        return name or self.protocols[0]


@dataclass(frozen=True)
class Samples:
    """What an array of a file must be, in whatever format it comes: bytes may differ, samples may not."""

    shape: tuple[int, int]
    """Samples × channels."""
    sha256: str | None
    """`samples_hash` of the published array; None where it is not known, so that the array cannot be verified."""


def read_bytes(path: Path) -> bytes:
    """The file's contents, unpacked when gzip has packed them.

    Raises:
        InputError: missing, unreadable or damaged.
    """
    try:
        content = path.read_bytes()
        return gzip.decompress(content) if content[:2] == b"\x1f\x8b" else content
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"cannot read '{path}': {getattr(error, 'strerror', None) or error}") from error


def read_matlab(path: Path, variable_sets: tuple[tuple[str, ...], ...]) -> dict[str, FloatArray]:
    """The first of `variable_sets` that a MATLAB v5 file holds in full, as real matrices.

    Raises:
        InputError: not a MATLAB file, or none of the sets is in it.
    """
    return parse_matlab(path, read_bytes(path), variable_sets)


def parse_matlab(path: Path, content: bytes, variable_sets: tuple[tuple[str, ...], ...]) -> dict[str, FloatArray]:
    """`read_matlab` of bytes that are here already; `path` is for the message.

    Raises:
        InputError: not a MATLAB file, or none of the sets is in it.
    """
    import scipy.io

    try:
        variables = scipy.io.loadmat(io.BytesIO(content), chars_as_strings=False)
    except Exception as error:  # scipy raises whatever the damaged bytes lead it to
        raise InputError(
            f"'{path}' is not a readable MATLAB file: truncated, corrupt or another format: take the original"
        ) from error
    matrices = {
        name: np.asarray(values, dtype=np.float64)
        for name, values in variables.items()
        if isinstance(values, np.ndarray) and values.dtype.kind in "iuf" and values.ndim == 2
    }
    for names in variable_sets:
        if all(name in matrices for name in names):
            return {name: matrices[name] for name in names}
    expected = " or ".join("(" + ", ".join(names) + ")" for names in variable_sets)
    found = ", ".join(name for name in variables if not name.startswith("__")) or "nothing"
    raise InputError(f"'{path}': expected the real matrices {expected}, found {found}")


def samples_hash(values: FloatArray) -> str:
    """sha256 of an array's shape and its samples as little-endian float64 in C order, with −0 as 0.

    Storage does not matter to it (integers or floats, text or binary, byte order, layout); every sample does.
    """
    canonical = (np.asarray(values, dtype=np.float64) + 0.0).astype("<f8")
    return hashlib.sha256(repr(canonical.shape).encode() + canonical.tobytes()).hexdigest()


def check_contents(path: Path, found: Mapping[str, FloatArray], expected: Mapping[str, Samples]) -> None:
    """Compare a file's arrays, as it holds them, with the published ones.

    Args:
        path: the file, for the message.
        found: every array that the benchmark takes from the file, by its name there.
        expected: what each of these is to be; it may name others.

    Raises:
        InputError: a shape or a sample differs, or is not finite in an array of unknown hash; the array is named.
    """
    for name, values in found.items():
        if values.shape != expected[name].shape:
            raise InputError(f"'{path}': expected {name} of shape {expected[name].shape}, found {values.shape}")
        if not np.isfinite(values).all():
            raise InputError(f"'{path}': expected finite numbers in {name}, found NaN or infinity")
    differing = [
        f"{name} differs (sha256 of its samples {digest[:8]}…, expected {reference[:8]}…)"
        for name, values in found.items()
        if (reference := expected[name].sha256) and (digest := samples_hash(values)) != reference
    ]
    if differing:
        raise InputError(
            f"'{path}' is not the expected record: {', '.join(differing)}; "
            "fetch it again with --force, or give the original file with --from"
        )
