"""Atomic writes: a file is there whole or not at all."""

import contextlib
import itertools
import os
import re
import shutil
import socket
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import ContextVar
from functools import cache
from pathlib import Path

from nnss_cli.errors import InputError

_TEMPORARY = re.compile(r"\.tmp-(?:(?P<host>[A-Za-z0-9_]*)-(?P<process>\d+)-)?\w+(?:\.\w+)?")
_OLD = 24 * 3600.0  # seconds after which a temporary file of whom nobody knows is nobody's


BINARY = (".xlsx", ".xls", ".ods", ".parquet", ".mat", ".npz", ".npy", ".h5", ".hdf5", ".feather")
"""Ends of names that promise another format than text."""
_GATHERED: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("gathered", default=None)
"""Temporary neighbour and place of each file that waits for others (`together`)."""


def write_atomically(path: Path, write: Callable[[Path], None]) -> None:
    """Call `write` on a temporary neighbour of `path`, flush it to disk, rename it into place.

    The neighbour keeps the suffix, since matplotlib and others choose the format by it. The
    rename is atomic on one file system, so a reader or a crash never sees half a file.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".tmp-{_host()}-{os.getpid()}-", suffix=path.suffix)
    os.close(descriptor)
    temporary = Path(name)
    gathered = _GATHERED.get()
    try:
        write(temporary)
        if gathered is None:
            _flush(temporary)
            _into_place(temporary, path)
        else:
            gathered.append((temporary, path))
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # of a library that writes to a stream
            error.filename = str(path.parent)
        raise


@contextlib.contextmanager
def together() -> Iterator[None]:
    """Files that are written within come into place at its end, in their order; none if an error ends it.

    They are flushed side by side, for which a disk takes little more time than for one of them.
    """
    gathered: list[tuple[Path, Path]] = []
    token = _GATHERED.set(gathered)
    try:
        yield
        list(_flushers().map(_flush, [temporary for temporary, _ in gathered]))
        for temporary, path in gathered:
            _into_place(temporary, path)
    finally:
        _GATHERED.reset(token)
        for temporary, _ in gathered:
            temporary.unlink(missing_ok=True)


def _flush(path: Path) -> None:
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())


def _into_place(temporary: Path, path: Path) -> None:
    temporary.chmod(0o644)  # mkstemp makes it private; results are to be shared
    temporary.replace(path)


@cache
def _flushers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(4, "flush")


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files in `folder` whose writer was killed: no process has its number any more.

    Those of another machine, or of earlier versions, go when they are a day old.
    """
    for path in folder.glob(".tmp-*"):
        named = _TEMPORARY.fullmatch(path.name)
        if named is None:
            continue
        with contextlib.suppress(FileNotFoundError):
            known = os.name == "posix" and named["host"] == _host()
            if not _is_running(int(named["process"])) if known else time.time() - path.stat().st_mtime > _OLD:
                path.unlink()


def _host() -> str:
    return re.sub(r"\W+", "_", socket.gethostname())[:40]


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:
        pass  # another user's
    return True


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically, with the same line ends on every system."""
    write_atomically(path, lambda temporary: _write(temporary, text.encode()))


def write_bytes(path: Path, content: bytes) -> None:
    """Write bytes atomically."""
    write_atomically(path, lambda temporary: _write(temporary, content))


def _write(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def places(
    out: Path | None, usual: str, *beside: str, force: bool = False, read: Sequence[Path | None] = ()
) -> list[Path]:
    """Where a file and those beside it go, so that nothing is replaced unasked, and never what was read.

    Args:
        out: the file that is asked for; None for the usual one, which gets a number where it is there already.
        usual: its name.
        beside: suffixes of further files of the same name.
        force: replace what is there.
        read: files that the results are of.

    Raises:
        InputError: a file that is asked for is there already, is the one beside it, is among those read, or its name is
            another format's.
    """
    first = Path(usual) if out is None else out
    if first.suffix.lower() in BINARY:
        raise InputError(f"--out: expected a name for CSV text, found '{first}': end it in .csv")
    if first.suffix in beside:
        raise InputError(f"--out: expected a name for the table, '{first}' is the figure's beside it: end it in .csv")
    for number in itertools.count(1):
        named = first.with_stem(f"{first.stem}-{number}") if number > 1 else first
        found = [named, *(named.with_suffix(suffix) for suffix in beside)]
        taken = [] if force else [path for path in found if path.exists()]
        if taken and out is None:
            continue
        for path in found:
            refuse_to_replace(path, read, "--out")
        if not taken:
            break
        raise InputError(f"'{taken[0]}' exists already: name another file with --out, or --force to replace it")
    return found


def refuse_to_replace(path: Path, read: Sequence[Path | None], option: str) -> None:
    """Keep a record from the results that are made of it: a measurement is gone when it is overwritten, forced or not.

    Args:
        path: where results are to go.
        read: files that they are of; None for one that was not given.
        option: that names `path`.

    Raises:
        InputError: it is among them.
    """
    for source in read:
        if source is not None and path.exists() and source.exists() and path.samefile(source):
            raise InputError(f"{option}: '{path}' is what is read: expected another file, so that it is not lost")


def free_space(folder: Path) -> str:
    """What is left on its file system, in words; "" where that is not known."""
    with contextlib.suppress(OSError):
        return f" ({shutil.disk_usage(folder).free:,} bytes free)"
    return ""


def require_writable(folder: Path) -> None:
    """Fail before any work when results could not be kept at the end of it.

    Raises:
        InputError: `folder` cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"cannot write to '{folder}': {error.strerror or error}{free_space(folder)}; name another folder with --out"
        ) from error
