"""Which real files the tests use, and how `make test` brings them: each benchmark by itself."""

import hashlib
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path

import pytest
import real_files
from nnss_cli.datasets import download
from nnss_cli.datasets.benchmark import Source
from nnss_cli.datasets.catalog import BENCHMARKS
from real_files import NEEDED, OFFICIAL, fetch_files, folder_of_files, missing


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that is the only one looked into."""
    monkeypatch.delenv("NNSS_TEST_MIRROR", raising=False)
    monkeypatch.setattr(real_files, "FETCHED", tmp_path / "fetched")
    monkeypatch.setattr(real_files, "__file__", str(tmp_path / "checkout" / "tests" / "real_files.py"))
    return tmp_path / "fetched"


def test_a_folder_is_used_for_what_it_has(nowhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert folder_of_files() is None
    assert missing() == [*NEEDED, *(name for names in OFFICIAL.values() for name in names)]
    nowhere.mkdir()
    for name in NEEDED:
        (nowhere / name).touch()
    assert folder_of_files() == nowhere
    assert missing() == [name for names in OFFICIAL.values() for name in names]
    named = tmp_path / "named"
    named.mkdir()
    for name in (NEEDED[0], "DATAUNIF.MAT", "DATA_EMPS.mat"):
        (named / name).touch()
    monkeypatch.setenv("NNSS_TEST_MIRROR", str(named))
    assert folder_of_files() == nowhere  # two of the three are of no use
    assert folder_of_files(OFFICIAL["ced"]) == named
    assert folder_of_files(OFFICIAL["emps"]) is None
    assert missing() == [name for key in OFFICIAL if key != "ced" for name in OFFICIAL[key]]


def test_the_official_files_are_those_that_the_catalogue_takes() -> None:
    for name, files in OFFICIAL.items():
        wanted = BENCHMARKS[name].wanted
        assert len(files) == len(wanted)
        assert all(file in names for file, names in zip(files, wanted, strict=True))


@pytest.fixture
def emps_folder(official: Callable[[str], Path]) -> Path:
    """Found before `nowhere` hides it."""
    return official("emps")


def test_files_are_brought_one_by_one_from_the_sources(
    emps_folder: Path,
    nowhere: Path,
    serve: Callable[[Path], AbstractContextManager[str]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Files of known bytes as they are, others out of what the cache keeps; what cannot be had is one line."""
    monkeypatch.setattr(download, "TIMEOUT", 1)
    train, test = OFFICIAL["emps"]
    with serve(emps_folder) as address:
        known = hashlib.sha256((emps_folder / train).read_bytes()).hexdigest()
        parts = (Source(f"{address}/{train}", known), Source(f"{address}/{test}"))
        monkeypatch.setitem(
            BENCHMARKS.built_in, "emps", replace(BENCHMARKS["emps"], sources=(Source(address, parts=parts),))
        )
        gone = replace(BENCHMARKS["ced"], sources=(Source(f"{address}/gone.zip"),))
        monkeypatch.setitem(BENCHMARKS.built_in, "ced", gone)
        (line,) = fetch_files(nowhere, (train, test, "DATAUNIF.MAT"))
    assert line.startswith("DATAUNIF.MAT: dataset 'ced' could not be fetched")
    assert sorted(path.name for path in nowhere.iterdir()) == sorted((train, test))
    for name in (train, test):
        assert (nowhere / name).read_bytes() == (emps_folder / name).read_bytes()
