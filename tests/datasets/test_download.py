"""Fetching: through a real server on the loopback, mirrors, damage, no network."""

import functools
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from nnss_cli.datasets.catalog import BENCHMARKS, load
from nnss_cli.datasets.download import cached_file, fetch, install

from nnss_cli.errors import DataUnavailable, InputError

PLANT = BENCHMARKS["daisy-powerplant"]


class QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def server(mirror: Path) -> Iterator[str]:
    """The real files behind http://127.0.0.1."""
    handler = functools.partial(QuietHandler, directory=str(mirror))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()


@pytest.mark.parametrize("name", ["twotank", "robotarm", "daisy-powerplant"])
def test_fetch_over_http(name: str, server: str, own_cache: Path) -> None:
    path = fetch(BENCHMARKS[name], mirror=server)
    assert path.parent == own_cache
    assert load(name, "paper").fitting.train
    assert sorted(p.name for p in own_cache.iterdir()) == [path.name, path.name + ".sha256"]


def test_progress_sees_the_whole_file(server: str, mirror: Path) -> None:
    class Bar:
        total = 0.0
        seen = 0.0

        def update(self, count: float) -> None:
            self.seen += count

        def reset(self) -> None:
            self.seen = 0

        def close(self) -> None:
            pass

    bars: list[Bar] = []

    def progress(_: str) -> Bar:
        bars.append(Bar())
        return bars[-1]

    fetch(PLANT, mirror=server, progress=progress)
    assert bars[-1].total == bars[-1].seen == (mirror / "powerplant.dat").stat().st_size


def test_the_environment_names_a_mirror(mirror: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NNSS_MIRROR", str(mirror))
    assert fetch(PLANT, offline=True).is_file()


def test_a_bad_mirror_is_passed_over_for_the_next_source(server: str, tmp_path: Path, mirror: Path) -> None:
    bad = tmp_path / "bad"
    bad.mkdir()
    (bad / "robotarmdata.mat").write_bytes(b"broken")
    (bad / "RobotArm.mat").write_bytes((mirror / "RobotArm.mat").read_bytes())
    assert fetch(BENCHMARKS["robotarm"], mirror=str(bad), offline=True).is_file()


def test_offline_says_how(own_cache: Path) -> None:
    with pytest.raises(DataUnavailable, match=r"--offline.*--from FILE.*--mirror DIR"):
        fetch(PLANT, offline=True)
    assert not own_cache.exists()


def test_no_network_names_every_source(monkeypatch: pytest.MonkeyPatch, own_cache: Path) -> None:
    import socket

    def refuse(*_: object, **__: object) -> None:
        raise OSError("no network in this test")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    with pytest.raises(DataUnavailable) as caught:
        fetch(PLANT)
    message = str(caught.value)
    assert "\n" not in message
    for source in PLANT.sources:
        assert source.url.split("/")[2] in message
    assert not list(own_cache.glob("*")) if own_cache.exists() else True


def test_a_truncated_answer_leaves_the_cache_empty(server: str, mirror: Path, tmp_path: Path, own_cache: Path) -> None:
    half = tmp_path / "half"
    half.mkdir()
    (half / "powerplant.dat").write_bytes((mirror / "powerplant.dat").read_bytes()[:20000])
    with pytest.raises(InputError):
        fetch(PLANT, mirror=str(half), offline=True)
    assert not own_cache.exists()


def test_a_changed_cache_is_noticed_and_mended_by_force(mirror: Path) -> None:
    path = fetch(PLANT, mirror=str(mirror), offline=True)
    path.write_bytes(path.read_bytes().replace(b"-8.1100000e+02", b"-8.1200000e+02"))
    with pytest.raises(InputError, match="--force"):
        cached_file(PLANT)
    fetch(PLANT, mirror=str(mirror), offline=True, force=True)
    load("daisy-powerplant")


def test_force_keeps_the_old_file_until_there_is_a_new_one(mirror: Path) -> None:
    path = fetch(PLANT, mirror=str(mirror), offline=True)
    before = path.read_bytes()
    with pytest.raises(DataUnavailable):
        fetch(PLANT, offline=True, force=True)
    assert path.read_bytes() == before
    load("daisy-powerplant")


def test_from_refuses_another_benchmarks_file(mirror: Path, own_cache: Path) -> None:
    with pytest.raises(InputError):
        install(BENCHMARKS["twotank"], mirror / "RobotArm.mat")
    assert not own_cache.exists()
