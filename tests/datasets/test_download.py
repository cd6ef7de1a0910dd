"""Fetching: through a real server on the loopback, mirrors, zips, damage, no network."""

import hashlib
import zipfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from nnss_cli.datasets import archive
from nnss_cli.datasets.benchmark import Samples, Source, samples_hash
from nnss_cli.datasets.catalog import BENCHMARKS, cascaded_tanks, emps, load
from nnss_cli.datasets.download import cached_file, fetch, install

from nnss_cli.errors import DataUnavailable, InputError

PLANT = BENCHMARKS["daisy-powerplant"]


@pytest.fixture
def server(mirror: Path, serve: Callable[[Path], AbstractContextManager[str]]) -> Iterator[str]:
    """The real files behind http://127.0.0.1."""
    with serve(mirror) as address:
        yield address


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


# Zips and records of several files, on made-up ones

TANKS, EMPS = cascaded_tanks.BENCHMARK, emps.BENCHMARK
Serve = Callable[[Path], AbstractContextManager[str]]


@pytest.fixture
def tanks_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> bytes:
    """dataBenchmark.mat with made-up samples, which from now on are the published ones."""
    random = np.random.default_rng(1)
    arrays = {name: random.standard_normal(samples.shape) for name, samples in cascaded_tanks.CONTENTS.items()}
    published = {name: Samples(values.shape, samples_hash(values)) for name, values in arrays.items()}
    monkeypatch.setattr(cascaded_tanks, "CONTENTS", published)
    scipy.io.savemat(tmp_path / "tanks.mat", arrays)
    return (tmp_path / "tanks.mat").read_bytes()


@pytest.fixture
def emps_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    """Both files of EMPS with made-up samples, which from now on are the published ones."""
    random = np.random.default_rng(2)
    files, published = {}, {}
    for name in emps.FILES:
        arrays = {variable: random.standard_normal((24841, 1)) for variable in ("vir", "qm")}
        scipy.io.savemat(tmp_path / name, arrays)
        files[name] = (tmp_path / name).read_bytes()
        (tmp_path / name).unlink()
        for variable, values in arrays.items():
            published[f"{variable} of {name}"] = Samples(values.shape, samples_hash(values))
    monkeypatch.setattr(emps, "CONTENTS", published)
    return files


def write_zip(path: Path, members: dict[str, bytes]) -> Path:
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for name, content in members.items():
            target.writestr(name, content)
    return path


def cached(own_cache: Path, name: str) -> bytes:
    """The only file in the cache, beside its hash."""
    content = (own_cache / name).read_bytes()
    assert sorted(p.name for p in own_cache.iterdir()) == [name, name + ".sha256"]
    assert (own_cache / (name + ".sha256")).read_text().strip() == hashlib.sha256(content).hexdigest()
    return content


@pytest.mark.parametrize("folder", ["", "CascadedTanksFiles/", "a/b/"])
def test_a_zip_is_a_source_a_mirrors_file_and_what_from_takes(
    folder: str, tanks_file: bytes, serve: Serve, tmp_path: Path, own_cache: Path
) -> None:
    members = {f"{folder}dataBenchmark.mat": tanks_file, f"{folder}description.pdf": b"%PDF"}
    path = write_zip(tmp_path / "files" / "CascadedTanksFiles.zip", members)
    with serve(path.parent) as address:
        source = replace(TANKS, sources=(Source(f"{address}/CascadedTanksFiles.zip"),))
        for bring in (
            lambda: fetch(source),
            lambda: fetch(TANKS, mirror=address, force=True),
            lambda: fetch(TANKS, mirror=str(path.parent), offline=True, force=True),
            lambda: install(TANKS, path),
            lambda: install(TANKS, write_zip(tmp_path / "mine", members)),  # told by its bytes, not by its name
        ):
            bring()
            assert cached(own_cache, "cascaded-tanks.mat") == tanks_file
            assert load("cascaded-tanks").fitting.train
            for kept in own_cache.iterdir():
                kept.unlink()


def test_the_unpacked_file_serves_as_well(tanks_file: bytes, tmp_path: Path, own_cache: Path) -> None:
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "dataBenchmark.mat").write_bytes(tanks_file)
    for bring in (
        lambda: fetch(TANKS, mirror=str(tmp_path / "files"), offline=True, force=True),
        lambda: install(TANKS, tmp_path / "files"),
        lambda: install(TANKS, tmp_path / "files" / "dataBenchmark.mat"),
    ):
        bring()
        assert cached(own_cache, "cascaded-tanks.mat") == tanks_file


def test_a_source_goes_by_its_own_name_at_a_mirror_and_by_its_address_at_home(
    tanks_file: bytes, serve: Serve, tmp_path: Path
) -> None:
    write_zip(tmp_path / "files" / "3b697e42", {"dataBenchmark.mat": tanks_file})
    with serve(tmp_path / "files") as address:
        source = Source(f"{address}/3b697e42", name="CascadedTanksFiles.zip")
        assert source.filename == "CascadedTanksFiles.zip"
        assert fetch(replace(TANKS, sources=(source,))).is_file()


def test_a_record_of_two_files_comes_as_a_zip_or_as_both_files(
    emps_files: dict[str, bytes], serve: Serve, tmp_path: Path, own_cache: Path
) -> None:
    zipped = write_zip(tmp_path / "zipped" / "EMPS.zip", {f"EMPS/{name}": emps_files[name] for name in emps_files})
    plain = tmp_path / "plain"
    plain.mkdir()
    for name, content in emps_files.items():
        (plain / name).write_bytes(content)
    found = set()
    with serve(plain) as files, serve(zipped.parent) as archives:
        parts = tuple(Source(f"{files}/{n}", hashlib.sha256(c).hexdigest()) for n, c in emps_files.items())
        for bring in (
            lambda: fetch(replace(EMPS, sources=(Source(files, parts=parts),))),
            lambda: fetch(replace(EMPS, sources=(Source(f"{archives}/EMPS.zip"),)), force=True),
            lambda: fetch(EMPS, mirror=files, force=True),
            lambda: fetch(EMPS, mirror=archives, force=True),
            lambda: fetch(EMPS, mirror=str(plain), offline=True, force=True),
            lambda: fetch(EMPS, mirror=str(zipped.parent), offline=True, force=True),
            lambda: install(EMPS, plain),
            lambda: install(EMPS, zipped),
            lambda: install(EMPS, own_cache / "emps.zip"),  # a cache is a mirror too
        ):
            bring()
            found.add(cached(own_cache, "emps.zip"))
            load("emps")
    assert len(found) == 1  # the same bytes, wherever they came from
    with zipfile.ZipFile(own_cache / "emps.zip") as kept:
        assert {name: kept.read(name) for name in kept.namelist()} == emps_files


def test_the_hash_of_each_part_is_checked(
    emps_files: dict[str, bytes], serve: Serve, tmp_path: Path, own_cache: Path
) -> None:
    for name, content in emps_files.items():
        (tmp_path / name).write_bytes(content)
    with serve(tmp_path) as address:
        parts = (Source(f"{address}/{emps.FILES[0]}"), Source(f"{address}/{emps.FILES[1]}", "0" * 64))
        with pytest.raises(DataUnavailable, match="does not match"):
            fetch(replace(EMPS, sources=(Source(address, parts=parts),)))
    assert not own_cache.exists()


@pytest.mark.parametrize("missing", emps.FILES)
def test_a_file_that_is_missing_is_named(
    missing: str, emps_files: dict[str, bytes], tmp_path: Path, own_cache: Path
) -> None:
    del emps_files[missing]
    (rest,) = emps_files
    path = write_zip(tmp_path / "files" / "EMPS.zip", emps_files)
    (path.parent / rest).write_bytes(emps_files[rest])
    for given in (path, path.parent):
        with pytest.raises(InputError, match=f"expected {missing} in it, found no file of that name"):
            install(EMPS, given)
    with pytest.raises(InputError, match=f"{rest}': expected a folder or a zip with .* and .*, found a single file"):
        install(EMPS, path.parent / rest)
    with pytest.raises(DataUnavailable, match=missing):
        fetch(EMPS, mirror=str(path.parent), offline=True)
    assert not own_cache.exists()


@pytest.mark.parametrize("name", emps.FILES)
def test_a_change_in_a_zip_is_refused_under_the_name_of_what_was_given(
    name: str, emps_files: dict[str, bytes], tmp_path: Path, own_cache: Path
) -> None:
    changed = {"vir": np.zeros((24841, 1)), "qm": np.zeros((24841, 1))}
    scipy.io.savemat(tmp_path / "x.mat", changed)
    path = write_zip(tmp_path / "files" / "EMPS.zip", emps_files | {name: (tmp_path / "x.mat").read_bytes()})
    with pytest.raises(InputError) as caught:
        install(EMPS, path)
    assert str(caught.value).startswith(f"'{path}' is not the expected record: vir of {name} differs (sha256")
    with pytest.raises(DataUnavailable, match=r"EMPS\.zip' is not the expected record"):
        fetch(EMPS, mirror=str(path.parent), offline=True)
    assert not own_cache.exists()


def test_a_bomb_and_a_path_out_of_the_zip_stay_out(
    tanks_file: bytes, serve: Serve, tmp_path: Path, own_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(archive, "LIMIT", 2**20)
    bad = tmp_path / "bad"
    for members, message in (
        ({"dataBenchmark.mat": bytes(2**20 + 1)}, "of at most 1048576 bytes, found 1048577"),
        ({"../../../dataBenchmark.mat": tanks_file}, "found no file of that name"),
    ):
        path = write_zip(bad / "CascadedTanksFiles.zip", members)
        with pytest.raises(InputError, match=message):
            install(TANKS, path)
        with serve(bad) as address, pytest.raises(DataUnavailable, match=message):
            fetch(replace(TANKS, sources=(Source(f"{address}/CascadedTanksFiles.zip"),)))
    assert not own_cache.exists()
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["CascadedTanksFiles.zip", "bad", "tanks.mat"]


def test_a_bad_zip_is_passed_over_for_the_next_source(tanks_file: bytes, serve: Serve, tmp_path: Path) -> None:
    files = tmp_path / "files"
    write_zip(files / "bad.zip", {"other.mat": tanks_file})
    (files / "half.zip").write_bytes(write_zip(files / "good.zip", {"dataBenchmark.mat": tanks_file}).read_bytes()[:-9])
    with serve(files) as address:
        sources = tuple(Source(f"{address}/{name}.zip") for name in ("bad", "half", "good"))
        assert fetch(replace(TANKS, sources=sources)).read_bytes() == tanks_file


def test_a_changed_zip_in_the_cache_is_noticed(emps_files: dict[str, bytes], tmp_path: Path) -> None:
    path = install(EMPS, write_zip(tmp_path / "EMPS.zip", emps_files))
    content = bytearray(path.read_bytes())
    content[2000] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"has changed.*nnss fetch emps --force"):
        load("emps")


def test_a_zip_or_a_folder_serves_the_older_benchmarks_too(mirror: Path, tmp_path: Path, own_cache: Path) -> None:
    packed = write_zip(tmp_path / "x.zip", {"d/TwoTanksMatlab.mat": (mirror / "TwoTanksMatlab.mat").read_bytes()})
    for given in (packed, mirror):
        install(BENCHMARKS["twotank"], given)
        assert cached(own_cache, "twotank.mat") == (mirror / "TwoTanksMatlab.mat").read_bytes()
