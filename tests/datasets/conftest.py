"""The official benchmarks' files, where they are, and a server on the loopback."""

import functools
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from real_files import OFFICIAL, folder_of_files


@pytest.fixture
def official() -> Callable[[str], Path]:
    """The folder that holds a benchmark's files; the test is skipped where none does."""

    def folder(name: str) -> Path:
        found = folder_of_files(OFFICIAL[name])
        if found is None:
            pytest.skip(f"{', '.join(OFFICIAL[name])} not here: set NNSS_TEST_MIRROR to a folder that has them")
        return found

    return folder


class QuietHandler(SimpleHTTPRequestHandler):
    """Files of a folder, without a line for each."""

    def log_message(self, *_: object) -> None:
        """Say nothing."""


@pytest.fixture
def serve() -> Callable[[Path], AbstractContextManager[str]]:
    """A folder behind http://127.0.0.1: `with serve(folder) as address`."""

    @contextmanager
    def running(folder: Path) -> Iterator[str]:
        handler = functools.partial(QuietHandler, directory=str(folder))
        with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
            yield f"http://127.0.0.1:{server.server_port}"
            server.shutdown()

    return running
