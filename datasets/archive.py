"""Files out of a zip or a folder: by name, of limited size, never written under a name from outside."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from nnss_cli.errors import InputError

LIMIT = 256 * 2**20
"""Bytes that a file may have, unpacked: a hundred times the largest benchmark's."""

MAGIC = (b"PK\x03\x04", b"PK\x05\x06")  # a zip with files in it, one without


def holds_files(path: Path) -> bool:
    """Whether it is a folder or a zip, told by its first bytes."""
    if path.is_dir():
        return True
    try:
        with path.open("rb") as stream:
            return stream.read(4) in MAGIC
    except OSError:
        return False  # whoever reads it says why it cannot be read


def take(path: Path, wanted: tuple[tuple[str, ...], ...]) -> tuple[bytes, ...]:
    """Files of a folder, or of a zip in whatever folder of it they lie.

    Args:
        path: the folder or zip.
        wanted: for each file the names that it may go by; the first that is there is taken. In a zip, upper and
            lower case are one, and of several of a name the one that lies least deep counts.

    Returns:
        Their contents, in the order of `wanted`.

    Raises:
        InputError: one is not there or larger than `LIMIT`, or the zip is damaged, encrypted or of a rare kind.
    """
    if path.is_dir():
        return tuple(_from_folder(path, names) for names in wanted)
    try:
        with zipfile.ZipFile(path) as archive:
            return tuple(_from_zip(path, archive, names) for names in wanted)
    except InputError:
        raise
    except Exception as error:  # zipfile raises whatever the damaged bytes lead it to
        raise InputError(
            f"'{path}' is not a readable zip: truncated, corrupt, encrypted or another format: take the original"
        ) from error


def pack(files: Mapping[str, bytes]) -> bytes:
    """A zip whose bytes follow from the files alone: not compressed, dated 1980, the same on every system."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in files.items():
            entry = zipfile.ZipInfo(name)
            entry.create_system = 3
            archive.writestr(entry, content)
    return buffer.getvalue()


def _from_folder(path: Path, names: tuple[str, ...]) -> bytes:
    for name in names:
        file = path / name
        if file.is_file():
            _check_size(path, name, file.stat().st_size)
            try:
                return file.read_bytes()
            except OSError as error:
                raise InputError(f"cannot read '{file}': {error.strerror or error}") from error
    raise _missing(path, names)


def _from_zip(path: Path, archive: zipfile.ZipFile, names: tuple[str, ...]) -> bytes:
    entries = [(_parts(entry.filename), entry) for entry in archive.infolist() if not entry.is_dir()]
    for name in names:
        found = [(parts, entry) for parts, entry in entries if parts and parts[-1].casefold() == name.casefold()]
        if not found:
            continue
        _, entry = min(found, key=lambda item: len(item[0]))
        _check_size(path, name, entry.file_size)
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            # zipfile unpacks the others by the block, however much comes out of one
            raise InputError(f"'{path}': expected {name} stored or deflated, found compression {entry.compress_type}")
        with archive.open(entry) as stream:
            # By the size that was checked: read() alone unpacks all there is before it compares.
            return stream.read(entry.file_size + 1)
    raise _missing(path, names)


def _parts(filename: str) -> tuple[str, ...]:
    """The folders and name of an entry; none where it points out of the zip."""
    name = PurePosixPath(filename.replace("\\", "/"))
    return () if name.is_absolute() or ".." in name.parts else name.parts


def _check_size(path: Path, name: str, size: int) -> None:
    if size > LIMIT:
        raise InputError(f"'{path}': expected {name} of at most {LIMIT} bytes, found {size}: another file, or a bomb")


def _missing(path: Path, names: tuple[str, ...]) -> InputError:
    return InputError(f"'{path}': expected {' or '.join(names)} in it, found no file of that name")
