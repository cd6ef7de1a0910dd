"""Shared fixtures: an own cache for every test, the real files where they are, the command line."""

from nnss_cli.machine import prepare

prepare()  # as the command line does: results must not depend on the number of BLAS threads

import os
import sys
from collections.abc import Callable, Collection, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from nnss_cli.datasets.record import Dataset

pytest.register_assert_rewrite("nnss_cli.testing")
from nnss_cli.testing import linear_system, small_dataset

sys.path.insert(0, str(Path(__file__).parent))  # tests are imported without being a package
from real_files import folder_of_files

settings.register_profile("nnss", deadline=None, derandomize=True, max_examples=40)
settings.load_profile("nnss")

REAL_FILES = folder_of_files()
if named := os.environ.get("NNSS_MIRROR"):  # no test sees it (`own_cache`); fixtures that look for files are to, still
    os.environ.setdefault("NNSS_TEST_MIRROR", named)


def slow_but(kept: Collection[int], cases: Iterable[Any]) -> list[Any]:
    """These cases of `parametrize`, of which all but those of these numbers are slow: more of the same."""
    return [
        pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=[pytest.mark.slow] * (i not in kept))
        for i, case in enumerate(cases)
    ]


def marks_of(method: str) -> list[Any]:
    """Combinations differ in a rule alone and fit their member: the laws of one are system tests, of others slow."""
    from nnss_cli.methods import METHODS

    combinations = [name for name, each in METHODS.built_in.items() if each.members]
    if method not in combinations:
        return []
    return [pytest.mark.system if method == combinations[0] else pytest.mark.slow]


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test sees the user's cache or mirror, or leaves anything in them."""
    folder = tmp_path / "cache"
    monkeypatch.setenv("NNSS_DATA_DIR", str(folder))
    monkeypatch.delenv("NNSS_MIRROR", raising=False)
    return folder


@pytest.fixture
def mirror() -> Path:
    """A folder with the real files."""
    if REAL_FILES is None:
        pytest.skip("the real data files are not here: set NNSS_TEST_MIRROR to a folder that has them")
    return REAL_FILES


@pytest.fixture
def ensemble_of() -> Callable[..., Any]:
    """An ensemble of NN-SS models, which get the scaling of the first."""
    from nnss_cli.model.ensemble import Ensemble
    from nnss_cli.trained import TrainedModel

    def made(members: Iterable[Any], rule: Any = "clipped") -> TrainedModel:
        first, *others = members
        for other in others:
            for name in asdict(first.scaling):
                getattr(other, name).copy_(getattr(first, name))
        return TrainedModel(Ensemble((first, *others), rule))

    return made


@pytest.fixture
def whole() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Blocks of sensitivities at x0 (N, n) as one: errors (q,), derivatives (q, p + N n) by weights and x0, states."""

    def joined(blocks: Iterable[Any], x0: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        found = list(blocks)
        n = x0.shape[1]
        p = found[0].derivatives.shape[1] - n
        J = np.zeros((sum(len(block.errors) for block in found), p + x0.size))
        row = 0
        for block in found:
            rows = slice(row, row := row + len(block.errors))
            J[rows, :p] = block.derivatives[:, :p]
            J[rows, p + block.window * n : p + (block.window + 1) * n] = block.derivatives[:, p:]
        return np.concatenate([block.errors for block in found]), J, np.concatenate([block.x for block in found])

    return joined


@dataclass(frozen=True)
class Outcome:
    """What a command gave."""

    code: int
    out: str
    err: str


@pytest.fixture
def nnss(capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Outcome]:
    """Run a command line in this process, from an empty folder."""
    from nnss_cli.app import main

    work = tmp_path / "work"
    work.mkdir(exist_ok=True)
    monkeypatch.chdir(work)

    def run(*args: str) -> Outcome:
        with pytest.raises(SystemExit) as ended:
            main([str(arg) for arg in args])
        captured = capsys.readouterr()
        return Outcome(int(ended.value.code or 0), captured.out, captured.err)

    return run


@pytest.fixture
def weak_adversary(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two ascents for the worst input of a certificate's stress runs: for tests that are not about how bad it is."""
    monkeypatch.setattr("nnss_cli.experiment.certificate.systems.ASCENTS", 2)


@pytest.fixture
def system() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """`linear_system`."""
    return linear_system


@pytest.fixture
def small_data() -> Callable[..., Dataset]:
    """`small_dataset`."""
    return small_dataset
