from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets import robotarm, simulated, twotank
from nnss_cli.datasets.record import Record
from nnss_cli.datasets.windows import sliding_windows

from nnss_cli.errors import InputError
from nnss_cli.training.recipe import paper_recipe


def test_the_papers_window_counts(mirror: Path) -> None:
    tanks = twotank.load(mirror / "TwoTanksMatlab.mat", "paper").fitting.train
    arm = robotarm.load(mirror / "RobotArm.mat", "paper").fitting.train
    recipe = paper_recipe("twotank", 3)
    assert sliding_windows(tanks, recipe.window, recipe.stride)[0].shape == (711, 80, 1)
    recipe = paper_recipe("robotarm", 5)
    assert sliding_windows(arm, recipe.window, recipe.stride)[0].shape == (377, 100, 1)


def test_the_embedded_plant_has_the_papers_count() -> None:
    assert len(sliding_windows(simulated.load(None, "paper").fitting.train, 80, 2)[0]) == 711


def test_windows_are_the_samples_and_stay_inside_a_record() -> None:
    records = tuple(Record(np.arange(K) + 100.0 * K, np.arange(K) * 2.0, 1.0) for K in (10, 3, 7))
    u, y = sliding_windows(records, L=5, stride=2)
    assert u[:, :, 0].tolist() == [
        [1000 + s + i for i in range(5)] for s in (0, 2, 4)
    ] + [[700 + s + i for i in range(5)] for s in (0, 2)]  # fmt: skip
    assert y[0, :, 0].tolist() == [0, 2, 4, 6, 8]


def test_a_window_longer_than_the_record_is_refused() -> None:
    with pytest.raises(InputError, match="at most the 4 samples"):
        sliding_windows((Record(np.zeros(4), np.zeros(4), 1.0),), L=5, stride=1)
