"""What names on a command line stand for: a benchmark, a description, or files of one's own. Nothing is fetched."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.catalog import BENCHMARKS

from nnss_cli.errors import InputError
from nnss_cli.experiment import source
from nnss_cli.experiment.source import Ready, describe, ready

TOML = 'files = ["a.csv"]\ninputs = ["u"]\noutputs = ["y"]\nTs = 0.5\n'


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    u, y = np.random.default_rng(0).standard_normal((2, 300))
    rows = "\n".join(f"{a},{b}" for a, b in zip(u, y, strict=True))
    Path("a.csv").write_text(f"u,y\n{rows}\n", encoding="utf-8")
    return tmp_path


def refused(*names: str, **more: Any) -> str:
    with pytest.raises(InputError) as error:
        ready(names, **more)
    return str(error.value)


def test_files_of_ones_own_are_read_with_the_fields_given() -> None:
    own = {"inputs": ("u",), "outputs": ("y",), "Ts": 0.5, "orders": (2, 3)}
    found = ready(["a.csv"], own=own)
    assert (found.dataset.name, found.dataset.protocol, found.orders, found.settings) == ("a", "own", (2, 3), {})
    assert found.dataset.fitting.Ts == 0.5
    assert ready(["a.csv"], "own", own=own | {"horizon": "matlab"}).settings == {"horizon": "matlab"}
    assert ready(["a.csv"], own=own | {"name": "mine"}).dataset.name == "mine"


def test_orders_asked_for_go_before_the_usual_ones() -> None:
    dataset: Any = SimpleNamespace(name="mine")
    assert Ready(dataset, (2, 3)).orders_or([4]) == [4]
    assert Ready(dataset, (2, 3)).orders_or(None) == Ready(dataset, (2, 3)).orders_or([]) == (2, 3)
    assert Ready(dataset, ()).orders_or([4]) == [4]
    with pytest.raises(InputError, match="mine has no usual orders: give --orders"):
        Ready(dataset, ()).orders_or(None)


def test_a_benchmark_comes_with_its_orders_and_is_fetched_when_it_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(source, "load", lambda name, protocol: SimpleNamespace(name=name, protocol=protocol))
    monkeypatch.setattr(source, "fetch", lambda entry, **more: asked.append((entry.name, more)))
    monkeypatch.setattr(source, "is_cached", lambda _: len(asked) > 0)
    for _ in range(2):  # once it is there it is not fetched
        found = ready(["twotank"], "strict", "http://mirror", True)
        assert (found.dataset.name, found.dataset.protocol) == ("twotank", "strict")
        assert found.orders == BENCHMARKS["twotank"].orders
    assert asked == [("twotank", {"mirror": "http://mirror", "offline": True, "progress": None})]
    assert ready(["twotank"]).dataset.protocol == ""
    asked.clear()
    ready(["twotank-sim"])  # is simulated: has no source
    assert asked == []
    assert "strictt" in refused("twotank", protocol="strictt")


def test_a_benchmark_lays_down_itself_what_files_of_ones_own_are_told() -> None:
    assert refused("twotank", own={"Ts": 1.0}, title=lambda name: f"--{name}") == (
        "--Ts: expected for files of one's own only: 'twotank' is a benchmark and lays this down itself"
    )


def test_names_that_are_neither_are_refused() -> None:
    assert "twotenk" in refused("twotenk")
    assert refused("twotank", "robotarm") == (
        "expected one benchmark, found twotank, robotarm; several are compared one after the other"
    )
    assert "'nothing'" in refused("nothing", "twotank")
    assert refused("none.csv").startswith("no such file: 'none.csv'; expected a benchmark (")
    assert refused("a.csv", "none.csv", own={}) == (
        "no such file: 'none.csv'; expected a file of samples or a description (.toml)"
    )
    assert refused("some/thing").startswith("no such file: 'some/thing'")
    assert refused("a.csv", protocol="strict") == (
        "--protocol strict: a record of one's own has the protocol 'own' only: leave it out"
    )
    own = {"inputs": ("u",), "outputs": ("y",), "Ts": 0.5}
    assert refused("a.csv", own=own | {"name": "twotank"}).startswith("name 'twotank' is a benchmark's")


@pytest.mark.parametrize(("given", "needed"), [({}, "inputs"), ({"inputs": ("u",)}, "outputs")])
def test_columns_must_be_told(given: dict[str, Any], needed: str) -> None:
    assert refused("a.csv", own=given, title=lambda name: f"--{name}") == (
        f"--{needed}: expected the columns of the {needed}; 'nnss inspect a.csv' shows what there is"
    )


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("a b.csv", "a-b"), ("x.tar.gz", "x"), ("-x-.csv", "x"), ("水.csv", "record"),
        ("v1.2_3-4.csv.gz", "v1.2_3-4"), ("Öl Tank.csv", "Ol-Tank"), ("O\u0308l.csv", "Ol"),
        ("Straße ²-Łódź.csv", "Strasse-2-Lodz"), ("Ångström.CSV", "Angstrom"),
    ],
)  # fmt: skip
def test_a_record_is_named_after_its_file(file: str, name: str) -> None:
    Path(file).write_text("")
    found = describe([file], {"inputs": ("u",), "outputs": ("y",), "Ts": 1.0})
    assert (found.name, found.files, found.folder, found.allow_outside) == (name, (file,), Path.cwd(), True)


def test_a_description_stands_alone_and_fields_given_go_before_its_own(here: Path) -> None:
    folder = here / "deep"
    folder.mkdir()
    (folder / "x.TOML").write_text(TOML, encoding="utf-8")
    (here / "late.csv").write_text("")
    found = describe(["deep/x.TOML"], {})
    assert (found.files, found.Ts, found.folder, found.allow_outside) == (("a.csv",), 0.5, Path("deep"), False)
    found = describe(["deep/x.TOML"], {"Ts": 2.0, "test": ("late.csv",)})
    assert (found.Ts, found.allow_outside, found.val) == (2.0, True, describe(["deep/x.TOML"], {}).val)
    assert found.test == {"test": (str(here / "late.csv"),)}
    with pytest.raises(InputError, match=r"'deep/x.TOML' describes its files: expected it alone, found 2 files"):
        describe(["a.csv", "deep/x.TOML"], {})
