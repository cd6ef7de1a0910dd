"""The shape of the code: who may import whom, what is loaded when, what is installed."""

import ast
import importlib
import pkgutil
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {"datasets": ROOT / "datasets", "baselines": ROOT / "baselines"}
# Each may import what stands before it, and itself.
LAYERS = [
    "version", "machine", "errors", "files", "lock", "modelfile", "iterative", "plugins", "elementary", "system",
    "datasets", "baselines", "model", "training", "methods", "experiment", "trained", "export", "validation", "testing",
    "report", "api", "commands", "app", "__main__",
]  # fmt: skip


def layer_of(module: str) -> str:
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "version"


def sources() -> list[tuple[str, Path]]:
    found = [
        (path.relative_to(ROOT / "nnss_cli").parts[0].removesuffix(".py"), path)
        for path in (ROOT / "nnss_cli").rglob("*.py")
    ]
    found += [(name, path) for name, folder in FOLDERS.items() for path in folder.rglob("*.py")]
    return [(layer, path) for layer, path in found if layer != "__init__"]


def imports(path: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            names += [f"{node.module}.{alias.name}" for alias in node.names]
    return names


@pytest.mark.parametrize(("layer", "path"), sources(), ids=lambda value: getattr(value, "name", value))
def test_imports_run_one_way(layer: str, path: Path) -> None:
    for name in imports(path):
        if name.split(".")[0] == "nnss_cli":
            used = layer_of(name)
            assert LAYERS.index(used) <= LAYERS.index(layer), f"{path} ({layer}) imports {name} ({used})"


def test_modules_of_a_layer_do_not_import_each_other_in_a_circle() -> None:
    def module_name(layer: str, path: Path) -> str:
        base = FOLDERS.get(layer, ROOT / "nnss_cli")
        inner = ".".join(path.relative_to(base).with_suffix("").parts)
        return f"nnss_cli.{layer}.{inner}" if layer in FOLDERS else f"nnss_cli.{inner}"

    graph = {module_name(layer, path): set(imports(path)) for layer, path in sources()}
    graph = {name: {m for m in graph for i in used if i == m or i.startswith(f"{m}.")} for name, used in graph.items()}
    done: set[str] = set()

    def visit(name: str, trail: tuple[str, ...]) -> None:
        assert name not in trail, f"circle: {' -> '.join((*trail, name))}"
        if name not in done:
            for used in graph[name] - {name}:
                visit(used, (*trail, name))
            done.add(name)

    for name in graph:
        visit(name, ())


def test_commands_hold_no_numerics_and_report_no_torch() -> None:
    for layer, path in sources():
        roots = {name.split(".")[0] for name in imports(path)}
        if layer == "commands":
            assert not roots & {"numpy", "scipy", "torch", "pandas", "control"}, path
        if layer == "report":
            assert "torch" not in roots, path
        assert not roots & {"pickle", "joblib", "dill", "shelve"}, f"{path}: files are data, never code"


def test_experiments_know_no_concrete_method() -> None:
    """Neither by import nor by `isinstance`: what they need to know of a method, the protocol says."""
    from nnss_cli.methods import METHODS

    concrete = {type(method).__module__ for method in METHODS.built_in.values()}
    assert len(concrete) == 6
    for layer, path in sources():
        if layer != "experiment":
            continue
        assert not [name for name in imports(path) if any(name.startswith(f"{module}.") for module in concrete)], path
        of_methods = {
            alias.asname or alias.name
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.ImportFrom) and str(node.module).startswith("nnss_cli.methods")
            for alias in node.names
        }
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
                asked = {name.id for name in ast.walk(node.args[1]) if isinstance(name, ast.Name)}
                assert not asked & of_methods, f"{path}:{node.lineno}"


def loaded_by(*args: str) -> set[str]:
    code = (
        f"import sys; sys.argv[1:] = {list(args)!r}\n"
        "try:\n    from nnss_cli.app import main; main()\nexcept SystemExit: pass\n"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT.parent)
    return set(done.stdout.splitlines()[-1].split())


@pytest.mark.parametrize("args", [("--help",), ("compare", "--help"), ("--version",)])
def test_help_loads_nothing_heavy(args: tuple[str, ...]) -> None:
    assert not loaded_by(*args) & {"torch", "matplotlib", "scipy", "pandas"}


@pytest.mark.system
def test_report_loads_no_torch(tmp_path: Path, nnss: Callable) -> None:
    """With runs of every kind of model to report on."""
    out = str(tmp_path / "results")
    quick = (
        "--epochs", "1", "--window", "40", "--stride", "100", "--hidden", "5", "--encoder", "3", "--recipe", "paper",
    )  # fmt: skip
    done = nnss("compare", "twotank-sim", "--orders", "2", "--seeds", "1", "--jobs", "1", "--out", out, *quick)
    assert done.code == 0, done.err
    loaded = loaded_by("report", "--out", out)
    assert "matplotlib" in loaded  # it did report
    assert Path(out, "report.md").exists()
    assert "torch" not in loaded


@pytest.mark.system
def test_wheel_installs_only_the_package(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", tmp_path, ROOT],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {"nnss_cli", wheel.name.rsplit("-py3", 1)[0] + ".dist-info"}
    built = {name for name in names if name.endswith(".py")}
    for layer, path in sources():
        inside = (
            f"nnss_cli/{layer}/{path.relative_to(FOLDERS[layer])}" if layer in FOLDERS else str(path.relative_to(ROOT))
        )
        assert inside in built, inside
    assert "nnss_cli/report/paper_tables.csv" in names
    assert "nnss_cli/py.typed" in names
    templates = {path.name for path in (ROOT / "nnss_cli" / "report" / "html" / "templates").iterdir()}
    assert {f"nnss_cli/report/html/templates/{name}" for name in templates} <= set(names)


def test_dataclasses_are_frozen() -> None:
    """What is checked where it is made stays so; the two that are not frozen are working memory of a search."""
    thawed = set()
    for package in ("nnss_cli", *(f"nnss_cli.{name}" for name in FOLDERS)):
        for found in pkgutil.walk_packages(importlib.import_module(package).__path__, f"{package}."):
            if not found.name.endswith("__main__"):
                values = vars(importlib.import_module(found.name)).values()
                own = [v for v in values if isinstance(v, type) and is_dataclass(v) and v.__module__ == found.name]
                thawed |= {value.__name__ for value in own if not value.__dataclass_params__.frozen}
    assert thawed == {"EarlyStopping", "_Problem"}


def test_no_code_outside_a_datasets_own_file_knows_its_name() -> None:
    """No string of the code is one; help texts may show a name in an example."""
    from nnss_cli.datasets.catalog import BENCHMARKS

    root = Path(__file__).parents[1]
    known = {
        (path.relative_to(root).as_posix(), name)
        for folder in ("nnss_cli", "datasets", "baselines")
        for path in (root / folder).rglob("*.py")
        if path.parent != root / "datasets" / "catalog"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
        for name in BENCHMARKS.built_in
        if node.value == name
    }
    assert known == set()


def test_the_faults_that_reviews_made_by_hand_are_still_to_be_made() -> None:
    """`make mutants` puts each where its text stands once, and asks its test."""
    for entry in tomllib.loads((ROOT / "tests/mutants.toml").read_text(encoding="utf-8"))["mutant"]:
        found = (ROOT / entry["file"]).read_text(encoding="utf-8").count(entry["old"])
        assert found == 1, f"{entry['name']}: {found} times in {entry['file']}"
        file, _, name = entry["test"].partition("::")
        assert f"def {name.partition('[')[0]}(" in (ROOT / file).read_text(encoding="utf-8"), entry["test"]


@pytest.mark.parametrize("folder", ["datasets", "nnss_cli/commands"])
def test_a_message_of_bad_input_says_what_was_found(folder: str) -> None:
    """A text that names no value of this call, nor says "found", is the same whatever the user gave."""
    silent = [
        f"{path.name}:{node.lineno}: {ast.unparse(node.args[0])}"
        for path in sorted((ROOT / folder).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "InputError"
        if isinstance(node.args[0], ast.Constant) and "found" not in node.args[0].value
    ]
    assert silent == []
