"""`nnss fetch` on the catalogue as a whole."""

from collections.abc import Callable
from pathlib import Path

from nnss_cli.datasets.catalog import BENCHMARKS


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
