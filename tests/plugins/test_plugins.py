"""Methods and datasets from files and packages: what works, and what each mistake says on its one line."""

import json
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from nnss_cli.datasets.catalog import BENCHMARKS

from nnss_cli.errors import InputError
from nnss_cli.methods import METHODS, load_model, sound_method
from nnss_cli.plugins import PluginWarning, Registry, Source, in_use, read_source, use

STATIC = '''
"""A gain without memory, and the mean of several: a kind of model of its own, a seed, a combination."""

from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
from nnss_cli.datasets.record import Channels, Simulation
from nnss_cli.methods import Fit, Method
from nnss_cli.modelfile import write_model


@dataclass(frozen=True)
class Gain:
    D: np.ndarray
    channels: Channels
    Ts: float

    def simulate(self, u, y_init):
        return Simulation(u @ self.D, np.zeros((len(u), 1)))

    def save(self, folder):
        write_model(folder, {"kind": "gain", "channels": asdict(self.channels), "Ts": self.Ts}, {"D": self.D})


def read(description, tensors):
    return Gain(tensors["D"], Channels(**description["channels"]), description["Ts"])


@dataclass(frozen=True)
class Options:
    sign: Literal[1, -1] = 1
    """Which way it goes."""
    noise: float = 0.1
    """Deviation of what the seed adds."""


class Static(Method):
    name = "static"
    seeded = True
    options = Options
    models = {"gain": read}

    def fit(self, data, order, seed, settings, on_epoch):
        D = np.linalg.lstsq(data.train[0].u, data.train[0].y, rcond=None)[0] * settings["sign"]
        drawn = np.random.default_rng(seed).standard_normal(D.shape)
        return Fit(Gain(D + settings["noise"] * drawn, data.channels, data.Ts))


class Mean(Static):
    name = "static-mean"
    seeded = False
    members = "static"

    def combine(self, members, data):
        return Fit(Gain(np.mean([member.D for member in members], axis=0), data.channels, data.Ts))


METHODS = [Static, Mean()]
'''
DATASET = """
from dataclasses import replace

from nnss_cli.datasets.benchmark import Benchmark
from nnss_cli.datasets.record import Dataset
from nnss_cli.testing import small_dataset


def load(path, protocol):
    small = small_dataset(K=300)
    return Dataset(replace(small.fitting, dataset="plant", protocol=protocol), small.tests)


BENCHMARK = Benchmark("plant", "A plant", "nobody", (2,), (), "", load, protocols=("usual",))
"""


@pytest.fixture(autouse=True)
def nothing_stays_in_use() -> Iterator[None]:
    yield
    use(())


def write(path: Path, text: str) -> Path:
    path.write_text(textwrap.dedent(text), encoding="utf-8")
    return path


def use_text(text: str, path: Path) -> None:
    use([read_source(write(path, text))])


@pytest.mark.slow
def test_a_file_brings_methods_with_seeds_a_combination_and_a_kind_of_model(nnss: Callable, tmp_path: Path) -> None:
    """In worker processes too, which are started afresh."""
    path = write(tmp_path / "static.py", STATIC)
    call = (
        "compare", "twotank-sim", "--orders", "2", "--seeds", "3", "--jobs", "2", "--plugin", path,
        "--methods", "n4sid", "static-mean", "--set", "static.noise=0.5", "n4sid.horizon=auto",
    )  # fmt: skip
    outcome = nnss(*call)
    assert outcome.code == 0, outcome.err
    runs = {r.parent.name: json.loads(r.read_text()) for r in Path("results").rglob("run.json")}
    assert set(runs) == {"n4sid-n2-s0", "static-mean-n2-s0", *(f"static-n2-s{seed}" for seed in range(3))}
    assert {run["status"] for run in runs.values()} == {"ok"}
    assert runs["static-n2-s1"]["spec"]["settings"] == {"sign": 1, "noise": 0.5}
    assert runs["n4sid-n2-s0"]["spec"]["settings"] == {"horizon": "auto"}
    assert runs["n4sid-n2-s0"]["spec"]["version"] == "1"
    assert runs["static-n2-s1"]["spec"]["version"] == f"file {read_source(path).digest}; 1"
    assert "0 runs to do, 5 done already" in nnss(*call).out
    D = load_model(Path("results/twotank-sim/paper/runs/static-mean-n2-s0")).D
    members = [load_model(Path(f"results/twotank-sim/paper/runs/static-n2-s{seed}")).D for seed in range(3)]
    assert pytest.approx(sum(members) / 3) == D
    assert members[0] != members[1]
    # another file, another version
    path.write_text(STATIC + "\n", encoding="utf-8")
    refused = nnss(*call)
    assert refused.code == 2
    assert "of the method instead of file" in refused.err
    # without the file its runs are still reported, and its models are named
    assert nnss("report").code == 0
    with pytest.raises(InputError, match=r"unknown kind of model 'gain'.*--plugin FILE\.py"):
        load_model(Path("results/twotank-sim/paper/runs/static-n2-s0"))
    assert "unknown method 'static-mean'" in nnss(*(part for part in call if part not in ("--plugin", path))).err


@pytest.mark.system
def test_a_file_brings_a_dataset(nnss: Callable, tmp_path: Path) -> None:
    path = write(tmp_path / "plant.py", DATASET)
    outcome = nnss("compare", "plant", "--plugin", path, "--methods", "n4sid")
    assert outcome.code == 0, outcome.err
    assert list(Path("results/plant/usual/runs").iterdir())
    assert nnss("order", "plant", "--max-order", "2", "--plugin", path).code == 0
    assert "plant" in nnss("fetch", "--list", "--plugin", path).out
    assert "unknown dataset 'plant'" in nnss("order", "plant").err


def test_plugin_files_are_methods_to_compare_by_default_and_are_listed(nnss: Callable, tmp_path: Path) -> None:
    from nnss_cli.methods import DEFAULT, select

    use_text(STATIC, tmp_path / "static.py")
    assert [method.name for method in select([])] == [*DEFAULT, "static", "static-mean"]
    listed = nnss("methods", "--plugin", tmp_path / "static.py").out
    assert "--set static.sign=…  Which way it goes." in listed
    assert "static-mean" in listed
    assert "static" not in nnss("methods").out


def test_the_bytes_that_were_read_are_executed_elsewhere(tmp_path: Path) -> None:
    """A worker gets them by pickle: a file that has changed meanwhile does not matter."""
    path = write(tmp_path / "static.py", STATIC)
    use([read_source(path)])
    path.write_text("METHODS = 1/0", encoding="utf-8")
    (source,) = in_use()
    assert source == Source(path, STATIC.encode())
    use([source])
    assert METHODS["static"].seeded


METHOD_TEXT = "from nnss_cli.methods import Fit, Method\nclass M(Method):\n    name = 'mine'\n    seeded = False\n"
FIT_TEXT = "    def fit(self, *_):\n        return Fit(None)\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("import nothing_of_the_sort", ["fails", "ModuleNotFoundError", "nothing_of_the_sort", "(line 1)"]),
        ("def f(:", ["fails", "SyntaxError"]),
        ("import sys\nsys.exit(0)", ["fails", "SystemExit"]),
        ("x = 1", ["METHOD", "BENCHMARK", "found none"]),
        ("METHOD = 3", ["is no method", "nnss_cli.methods.Method", "found 3"]),
        ("METHODS = 3", ["METHODS", "expected a tuple"]),
        ("BENCHMARK = 3", ["is no dataset", "Benchmark", "found 3"]),
        (METHOD_TEXT + "METHOD = M", ["is no method", "M lacks fit"]),
        (METHOD_TEXT.replace("    seeded = False\n", FIT_TEXT) + "METHOD = M", ["M lacks seeded"]),
        (METHOD_TEXT.replace("False", "'no'") + FIT_TEXT + "METHOD = M", ["seeded", "expected bool", "'no'"]),
        (METHOD_TEXT.replace("mine", "../x") + FIT_TEXT + "METHOD = M()", ["name", "small letters", "'../x'"]),
        (METHOD_TEXT.replace("mine", "n4sid") + FIT_TEXT + "METHOD = M", ["'n4sid'", "claimed by nnss and file"]),
        (METHOD_TEXT + FIT_TEXT + "METHODS = M(), M()", ["'mine'", "claimed by file", "and file"]),
        (METHOD_TEXT + FIT_TEXT + "    options = dict\nMETHOD = M", ["options", "frozen dataclass", "dict"]),
        (METHOD_TEXT + FIT_TEXT + "    version = ''\nMETHOD = M", ["version", "expected a word"]),
        (METHOD_TEXT + FIT_TEXT.replace("*_", "data") + "METHOD = M", ["expected fit(data, order, seed"]),
        (METHOD_TEXT + FIT_TEXT + "    members = 'n4sid'\nMETHOD = M", ["has members and lacks combine"]),
        (METHOD_TEXT + FIT_TEXT + "    models = {'linear': print}\nMETHOD = M", ["'linear'", "nnss itself"]),
        (METHOD_TEXT + FIT_TEXT + "    models = {'mine': 3}\nMETHOD = M", ["reads kind 'mine'"]),
        (METHOD_TEXT + FIT_TEXT + "    def __init__(self): 1 / 0\nMETHOD = M", ["is no method", "ZeroDivisionError"]),
    ],
)  # fmt: skip
def test_a_bad_file_is_one_line(text: str, words: list[str], nnss: Callable, tmp_path: Path) -> None:
    outcome = nnss("compare", "twotank-sim", "--methods", "n4sid", "--plugin", write(tmp_path / "mine.py", text))
    assert outcome.code == 2
    (line,) = outcome.err.strip().splitlines()
    for word in ("mine.py", *words):
        assert word in line
    assert not list(Path().rglob("*")), "nothing half-written"


@pytest.mark.parametrize(("name", "words"), [("no.py", "No such file"), ("mine.txt", "FILE.py"), ("folder.py", "read")])
def test_no_file(name: str, words: str, nnss: Callable, tmp_path: Path) -> None:
    (tmp_path / "folder.py").mkdir()
    outcome = nnss("report", "--plugin", tmp_path / name)
    assert outcome.code == 2
    assert name in outcome.err
    assert words in outcome.err


def test_two_files_of_one_name_and_members_that_are_missing(nnss: Callable, tmp_path: Path) -> None:
    one, two = (write(tmp_path / f"{name}.py", STATIC) for name in ("one", "two"))
    outcome = nnss("methods", "--plugin", one, two)
    assert outcome.code == 2
    assert "one.py" in outcome.err
    assert "two.py" in outcome.err
    path = write(tmp_path / "alone.py", STATIC.replace('members = "static"', 'members = "nothing"'))
    outcome = nnss("compare", "twotank-sim", "--methods", "static-mean", "--plugin", path)
    assert "static-mean combines runs of 'nothing', which is no method here" in outcome.err


# ---- packages ----


def install(folder: Path, package: str, version: str, code: str, group: str = "nnss.methods", **points: str) -> None:
    """Put a package with entry points on disk, as pip would."""
    module = package.replace("-", "_")
    write(folder / f"{module}.py", code)
    info = folder / f"{module}-{version}.dist-info"
    info.mkdir()
    write(info / "METADATA", f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n")
    lines = "\n".join(f"{name.replace('_', '-')} = {module}:{thing}" for name, thing in points.items())
    write(info / "entry_points.txt", f"[{group}]\n{lines}\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path whose packages' plug-ins are found; forgotten afterwards."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    before = set(sys.modules)
    for registry in (METHODS, BENCHMARKS):
        vars(registry).pop("_installed", None)
    yield folder
    for registry in (METHODS, BENCHMARKS):
        vars(registry).pop("_installed", None)
    for name in set(sys.modules) - before:
        if getattr(sys.modules[name], "__file__", None) and str(folder) in str(sys.modules[name].__file__):
            del sys.modules[name]


def test_a_package_is_imported_when_its_name_is_asked_for(site: Path, nnss: Callable) -> None:
    install(site, "good-package", "1.2", STATIC, static="Static")
    assert "static" in list(METHODS)
    assert nnss("order", "twotank-sim", "--max-order", "1").code == 0
    assert "good_package" not in sys.modules
    outcome = nnss("train", "twotank-sim", "--order", "2", "--method", "static", "--set", "static.sign=-1")
    assert outcome.code == 0, outcome.err
    run = json.loads(Path("results/twotank-sim/paper/runs/static-n2-s0/run.json").read_text())
    assert run["spec"]["version"] == "good-package 1.2; 1"
    assert run["spec"]["settings"]["sign"] == -1
    assert load_model(Path("results/twotank-sim/paper/runs/static-n2-s0")).channels.outputs


@pytest.mark.parametrize(
    ("code", "thing", "words"),
    [
        ("import nothing_of_the_sort", "M", ["cannot be imported", "nothing_of_the_sort"]),
        ("", "M", ["cannot be imported", "M"]),
        ("raise SystemExit", "M", ["cannot be imported", "SystemExit"]),
        (METHOD_TEXT, "M", ["is no method", "M lacks fit"]),
        (METHOD_TEXT.replace("mine", "other") + FIT_TEXT, "M", ["called 'mine'", "'other'"]),
    ],
)
def test_a_broken_package_costs_only_itself(
    code: str, thing: str, words: list[str], site: Path, nnss: Callable
) -> None:
    install(site, "bad-package", "0.3", code, mine=thing)
    install(site, "good-package", "1.2", STATIC, static="Static")
    outcome = nnss("compare", "twotank-sim", "--methods", "mine", "--orders", "2")
    assert outcome.code == 2
    (line,) = outcome.err.strip().splitlines()
    for word in ("'mine'", "bad-package 0.3", *words):
        assert word in line
    assert nnss("--help").code == 0
    listed = nnss("methods")
    assert listed.code == 0
    assert "good-package 1.2" in listed.out
    (line,) = listed.err.strip().splitlines()
    assert "passed over" in line
    assert "bad-package 0.3" in line
    outcome = nnss("train", "twotank-sim", "--order", "2", "--method", "static")
    assert outcome.code == 0, outcome.err


@pytest.mark.system
def test_a_package_brings_a_dataset_and_a_broken_one_is_passed_over(site: Path, nnss: Callable) -> None:
    install(site, "plant-package", "1", DATASET, "nnss.datasets", plant="BENCHMARK")
    climbing = DATASET.replace('"plant", "A plant"', '"climbing", "A plant"').replace('(), ""', '(1,), "../out"')
    install(site, "bad-package", "2", climbing, "nnss.datasets", climbing="BENCHMARK")
    outcome = nnss("compare", "plant", "--methods", "n4sid")
    assert outcome.code == 0, outcome.err
    listed = nnss("fetch", "--list")
    assert listed.code == 0
    assert "A plant" in listed.out
    assert "passed over" in listed.err
    assert nnss("report").code == 0
    outcome = nnss("compare", "climbing", "--methods", "n4sid")
    assert outcome.code == 2
    assert "bad-package 2 is no dataset: cached_as" in outcome.err
    assert "'../out'" in outcome.err


@pytest.mark.system
def test_one_name_from_two_packages_and_that_of_a_built_in_method(site: Path, nnss: Callable) -> None:
    install(site, "first-package", "1", STATIC, static="Static", ssest="Static")
    install(site, "second-package", "2", STATIC, static="Static")
    for name, words in (
        ("static", "first-package 1 and package second-package 2"),
        ("ssest", "nnss and package first"),
    ):
        outcome = nnss("compare", "twotank-sim", "--methods", name, "--orders", "2")
        assert outcome.code == 2
        (line,) = outcome.err.strip().splitlines()
        assert f"the name '{name}'" in line
        assert words in line
    assert nnss("compare", "twotank-sim", "--methods", "n4sid", "--orders", "2").code == 0


def test_in_is_false_with_a_warning_for_what_cannot_be_used(site: Path) -> None:
    install(site, "bad-package", "0.3", "1 / 0", mine="M")
    registry = Registry("method", "nnss.methods", ("METHOD", "METHODS"), [METHODS["n4sid"]], sound_method)
    assert list(registry) == ["n4sid", "mine"]
    assert len(registry) == 2
    with pytest.warns(PluginWarning, match="ZeroDivisionError"):
        assert "mine" not in registry
    assert "n4sid" in registry
    assert "nothing" not in registry
    with pytest.warns(PluginWarning):
        assert list(registry.all_usable()) == ["n4sid"]


def test_two_packages_with_one_kind_of_model(site: Path, tmp_path: Path) -> None:
    install(site, "first-package", "1", STATIC, static="Static")
    install(site, "second-package", "2", STATIC.replace('"static"', '"static2"'), static2="Static")
    from nnss_cli.testing import small_dataset

    data = small_dataset().fitting
    method = METHODS["static"]
    method.fit(data, 2, 0, method.settings(data, 2, {}), None).model.save(tmp_path / "model")
    with pytest.raises(InputError, match="'gain' are claimed by package first-package 1 and package second-package 2"):
        load_model(tmp_path / "model")


def test_completion_knows_methods_and_their_options(site: Path) -> None:
    from nnss_cli.commands.options import _assignments, _method_names

    install(site, "good-package", "1.2", STATIC, static="Static")
    assert _method_names("st") == ["static"]
    assert _assignments("sta") == ["static."]
    assert _assignments("static.") == ["static.sign=", "static.noise="]
    assert "simba.epochs=" in _assignments("simba.e")
