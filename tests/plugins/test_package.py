"""The example of docs/extending.md, as another package that is really installed."""

import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pandas as pd
import pytest
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace

from nnss_cli.methods import METHODS
from nnss_cli.testing import MethodLaws, linear_system, small_dataset

ROOT = Path(__file__).parents[2]


def readme_blocks() -> dict[str, str]:
    """File name → contents, of the section about plug-ins."""
    section = (ROOT / "docs/extending.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```(python|toml)\n(.*?)```", section, re.DOTALL)
    return {
        "pyproject.toml" if language == "toml" else re.match(r'"""(\S+)"""', text)[1]: text for language, text in blocks
    }


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package installed by pip, to be put on the path."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("site")
    for name in ("pyproject.toml", "their_package.py"):
        (source / name).write_text(readme_blocks()[name], encoding="utf-8")
    pip = (sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-build-isolation", "--no-index")
    subprocess.run([*pip, "--target", target, source], check=True, capture_output=True)
    assert list(target.glob("their_package-1.2.dist-info"))
    return target


def run(installed: Path, work: Path, *args: str, code: int = 0) -> subprocess.CompletedProcess[str]:
    """A Python with the package on its path."""
    environment = os.environ | {"PYTHONPATH": str(installed)}
    done = subprocess.run([sys.executable, *args], cwd=work, env=environment, capture_output=True, text=True)
    assert done.returncode == code, done.stdout + done.stderr
    return done


@pytest.mark.system
def test_the_readmes_method_from_another_package(installed: Path, tmp_path: Path) -> None:
    compare = ("-m", "nnss_cli", "compare", "twotank-sim", "--methods", "n4sid", "their-method", "--orders", "2")
    run(installed, tmp_path, *compare, "--set", "their-method.past=12", "--jobs", "2")
    table = pd.read_csv(tmp_path / "results/twotank-sim/paper/rmse.csv")
    errors = table[table["split"] == "test"].set_index("method")["rmse"]
    assert set(errors.index) == {"n4sid", "their-method"}
    assert errors["their-method"] < 2 * errors["n4sid"]
    kept = (tmp_path / "results/twotank-sim/paper/runs/their-method-n2-s0/run.json").read_text()
    assert '"version": "their-package 1.2; 1"' in kept
    assert '"past": 12' in kept
    listed = run(installed, tmp_path, "-m", "nnss_cli", "methods").stdout
    assert "package their-package 1.2" in listed
    assert "--set their-method.past=…  Samples before k" in listed


@pytest.mark.system
def test_the_readmes_method_obeys_the_laws(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "test_their_package.py").write_text(readme_blocks()["test_their_package.py"], encoding="utf-8")
    done = run(installed, tmp_path, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", str(tmp_path))
    assert re.search(r"\b2[0-9] passed", done.stdout), done.stdout


def readme_module() -> Any:
    """That method, executed here: no package, not registered."""
    module = ModuleType("readme_method")
    sys.modules[module.__name__] = module
    exec(readme_blocks()["their_package.py"], vars(module))
    return module


TheirMethod = readme_module().TheirMethod


class OwnKind(LinearModel):
    """A linear model that nnss has no reader for."""

    KIND = "their-kind"


class Unregistered(TheirMethod):
    """As an author has it before there is an entry point, with a kind of model of its own."""

    models = {"their-kind": OwnKind.from_file}  # noqa: RUF012 - never changed

    def fit(self, *args: Any) -> Any:
        fit = super().fit(*args)
        return replace(fit, model=OwnKind(**vars(fit.model)))


class TestUnregistered(MethodLaws):
    """The laws need no registration."""

    method = Unregistered()

    def test_it_is_not_registered(self) -> None:
        assert "their-method" not in METHODS


def test_the_readmes_method_finds_the_poles_of_a_linear_system() -> None:
    data = small_dataset(2, 2, K=9000, seed=3).fitting
    method = TheirMethod()
    found = method.fit(data, 2, 0, method.settings(data, 2, {}), None).model.system
    assert isinstance(found, LinearStateSpace)
    poles = np.linalg.eigvals(linear_system(2, 2, 2, 3)[0])
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(found.A)), np.sort_complex(poles), atol=0.01)
