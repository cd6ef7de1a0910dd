"""Locks that end with their holder, however that ends: two commands on one folder share the work."""

from __future__ import annotations

import contextlib
import errno
import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows: two commands at once may do a run twice there
    fcntl = None  # type: ignore[assignment]

_UNSUPPORTED = {errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP}
POLL = 0.02  # seconds between tries


@contextlib.contextmanager
def lock(path: Path) -> Iterator[bool]:
    """Hold the lock of this name, if nobody does; gives whether it is held now. It never waits.

    The system frees it when the holder's process ends. The file goes with the lock; one left by a killed holder
    locks nothing. Where the file system knows no locks, it is always granted.
    """
    if fcntl is None:
        yield True
        return
    descriptor = _acquired(path)
    try:
        yield descriptor is not None
    finally:
        _release(descriptor, path)


@contextlib.contextmanager
def in_turn(path: Path) -> Iterator[None]:
    """Wait for the lock of this name and hold it; without it where the folder cannot be written."""
    descriptor = None
    if fcntl is not None:
        with contextlib.suppress(OSError):
            while (descriptor := _acquired(path)) is None:
                time.sleep(POLL)
    try:
        yield
    finally:
        _release(descriptor, path)


def compiling(kernel: Any) -> AbstractContextManager[None]:
    """Hold the right to compile what numba keeps beside this kernel, after whoever has it: all but one then read it."""
    return in_turn(Path(kernel.stats.cache_path) / "compiling.lock")


def _acquired(path: Path) -> int | None:
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(descriptor, path):
                return descriptor
        except BlockingIOError:
            os.close(descriptor)
            return None
        except OSError as error:
            if error.errno in _UNSUPPORTED:
                return descriptor
            os.close(descriptor)
            raise
        os.close(descriptor)  # its holder removed it between our two calls


def _release(descriptor: int | None, path: Path) -> None:
    if descriptor is not None:
        path.unlink(missing_ok=True)  # while it is held: whoever opened it meanwhile sees that it has gone
        os.close(descriptor)


def _is_at(descriptor: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
