"""SIGINT, SIGTERM and SIGHUP end a command within seconds, wherever they find it."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from typing import Any

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
GRACE = 5.0
"""Seconds from a signal until the command ends itself, however far its cleaning up has come."""
EXIT_CODE = 130


class _State:
    """Of this process: signals come one at a time, so do those who defer them."""

    deferrals = 0
    pending = False
    raised = False


@contextlib.contextmanager
def interruptible() -> Iterator[None]:
    """Within it, the first of `SIGNALS` raises KeyboardInterrupt; further ones do not disturb the cleaning up.

    An exception may get lost in foreign code, and code that is not Python may not return: after `GRACE`
    seconds a thread, which hears of the signal by itself, kills the worker processes and ends this one. Signals
    that were ignored stay so (nohup).
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread may set handlers, and only it gets them
        return
    before = {number: signal.getsignal(number) for number in SIGNALS}
    _State.deferrals, _State.pending, _State.raised = 0, False, False
    heard, wake = os.pipe()
    os.set_blocking(wake, False)
    over = threading.Event()
    watchdog = threading.Thread(target=_watch, args=(heard, over), daemon=True)
    woken = signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, _on_signal)
    watchdog.start()
    try:
        yield
    finally:
        over.set()
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(woken)
        os.close(wake)  # the watchdog reads the end
        watchdog.join()
        os.close(heard)


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Within it no KeyboardInterrupt of `interruptible` is raised; at its end, one that was due is."""
    _State.deferrals += 1
    try:
        yield
    finally:
        _State.deferrals -= 1
        if _State.pending and not _State.deferrals:
            _raise()


def _on_signal(*_: Any) -> None:
    if not _State.raised:
        _State.pending = True
        if not _State.deferrals:
            _raise()


def _raise() -> None:
    _State.pending, _State.raised = False, True
    raise KeyboardInterrupt


def _watch(heard: int, over: threading.Event) -> None:
    """Wait for a signal's number in the pipe, then for the end of the cleaning up."""
    while number := os.read(heard, 1):
        if number[0] in SIGNALS and signal.getsignal(number[0]) is _on_signal and not over.wait(GRACE):
            for child in multiprocessing.active_children():
                child.kill()
            os.write(2, b"nnss: interrupted\n")
            os._exit(EXIT_CODE)
