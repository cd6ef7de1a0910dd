"""Shared fixtures: an own cache for every test, the real files where they are, the command line."""

from nnss_cli.machine import prepare

prepare()  # as the command line does: results must not depend on the number of BLAS threads

import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

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
def system() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """`linear_system`."""
    return linear_system


@pytest.fixture
def small_data() -> Callable[..., Dataset]:
    """`small_dataset`."""
    return small_dataset
