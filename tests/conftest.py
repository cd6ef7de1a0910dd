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
from nnss_cli.datasets.record import Channels, Dataset, FittingData, Record, Scaling

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


def linear_system(
    n: int, r: int, m: int, seed: int, radius: float = 0.9
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A random stable system A, B, C, D = 0 with spectral radius `radius`."""
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    return A, random.standard_normal((n, r)), random.standard_normal((m, n)), np.zeros((m, r))


@pytest.fixture
def system() -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
    """`linear_system`."""
    return linear_system


@pytest.fixture
def small_data() -> Callable[..., Dataset]:
    """A short linear record with noise, as a dataset of its own."""

    def make(r: int = 1, m: int = 1, K: int = 150, seed: int = 0) -> Dataset:
        from nnss_cli.baselines.statespace import LinearStateSpace

        plant = LinearStateSpace(*linear_system(2, r, m, seed), 0.5)
        random = np.random.default_rng(seed)
        u = random.standard_normal((K, r))
        y = plant.simulate(u, np.ones(2))[0] + 0.01 * random.standard_normal((K, m)) + 3.0
        record = Record(u, y, 0.5)
        third = K // 3
        channels = Channels(
            tuple(f"u{i + 1}" for i in range(r)), tuple(f"y{i + 1}" for i in range(m)), ("V",) * r, ("m",) * m
        )
        train = (record[:third],)
        fitting = FittingData("small", "strict", train, (record[third : 2 * third],), Scaling.of(train), channels)
        return Dataset(fitting, {"test": (record[2 * third :],)})

    return make
