"""`nnss fetch` on the catalogue as a whole."""

import shutil
from collections.abc import Callable
from pathlib import Path

from nnss_cli.datasets.catalog import BENCHMARKS, load
from real_files import NEEDED, OFFICIAL


def test_the_list_is_whole_at_80_columns(nnss: Callable, own_cache: Path) -> None:
    own_cache.mkdir()
    outcome = nnss("fetch", "--list")
    assert outcome.code == 0
    table = outcome.out.split("Cite for")[0].splitlines()
    assert max(map(len, table)) <= 80
    for entry in BENCHMARKS.values():
        here = "no" if entry.sources else "built in"
        row = [entry.name, *entry.title.split(), *here.split(), *map(str, entry.orders)]
        assert row in [line.split() for line in table]
    assert ["dataset", "what", "here", "orders"] in [line.split() for line in table]
    for entry in BENCHMARKS.values():
        assert f"Cite for {entry.name}: {entry.citation}" in outcome.out


def test_from_takes_a_zip_or_a_folder(nnss: Callable, official: Callable[[str], Path], own_cache: Path) -> None:
    outcome = nnss("fetch", "emps", "--from", official("emps"))
    assert outcome.code == 0, outcome.err
    assert (own_cache / "emps.zip").is_file()
    outcome = nnss("fetch", "emps", "--from", own_cache / "emps.zip")
    assert outcome.code == 0, outcome.err
    outcome = nnss("fetch", "ced", "--from", own_cache / "emps.zip")
    assert outcome.code == 2
    assert "expected DATAUNIF.MAT in it" in outcome.err
    assert len(outcome.err.strip().splitlines()) == 1


def test_all_brings_every_dataset_and_names_what_it_could_not(
    nnss: Callable, mirror: Path, official: Callable[[str], Path], tmp_path: Path, own_cache: Path
) -> None:
    files = tmp_path / "files"
    files.mkdir()
    for folder, names in ((mirror, NEEDED), *((official(name), OFFICIAL[name]) for name in OFFICIAL)):
        for name in names:
            shutil.copy(folder / name, files)
    assert nnss("fetch", "--all", "--mirror", files, "--offline").code == 0
    for name in BENCHMARKS:
        assert load(name).fitting.train
    shutil.rmtree(own_cache)
    (files / "DATA_EMPS.mat").unlink()
    outcome = nnss("fetch", "--all", "--mirror", files, "--offline")
    assert outcome.code == 2
    assert len(outcome.err.strip().splitlines()) == 1
    assert "dataset 'emps' could not be fetched" in outcome.err
    assert outcome.err.count("could not be fetched") == 1
    assert len(list(own_cache.glob("*.sha256"))) == len(BENCHMARKS) - 2  # nor has the simulation a file
