"""What is kept and what follows: the best validation epoch, its weights before a refinement, shuffled mini-batches."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
import torch
from nnss_cli.datasets.windows import sliding_windows

from nnss_cli.iterative import named_random
from nnss_cli.modelfile import Tensors
from nnss_cli.training import attempt as module
from nnss_cli.training.attempt import Training
from nnss_cli.training.engine import Engine
from nnss_cli.training.fast import FastEngine
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.recipe import ENGINES, Recipe

QUICK = Recipe(hidden=(6,), encoder=(3,), window=10, stride=3, batch=4, epochs=5, dtype="float64")


def scripted(monkeypatch: pytest.MonkeyPatch, *errors: float) -> None:
    """Let validation give these errors, epoch after epoch."""
    following = iter(errors)
    monkeypatch.setattr(module, "free_run_rmse", lambda *_: next(following))


def weights(training: Training) -> np.ndarray:
    return torch.cat([p.detach().ravel() for p in training.model.parameters()]).numpy()


@pytest.mark.system
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("optimiser", ["adam", "lbfgs", "gauss-newton"])
def test_the_weights_of_the_best_epoch_are_returned(
    optimiser: str, engine: str, small_data: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = small_data().fitting
    recipe = QUICK.replace(optimiser=optimiser, engine=engine, window=10, stride=30, batch=1)
    scripted(monkeypatch, 3.0, 1.0, 2.0, 4.0)
    longer = train_nnss(data, 2, 0, recipe.replace(epochs=4))
    assert (longer.epochs, longer.best_epoch) == (4, 2)
    scripted(monkeypatch, 3.0, 1.0)
    ended_there = train_nnss(data, 2, 0, recipe.replace(epochs=2))
    np.testing.assert_array_equal(weights(longer), weights(ended_there))
    scripted(monkeypatch, 4.0, 3.0, 2.0, 1.0)
    assert (weights(train_nnss(data, 2, 0, recipe.replace(epochs=4))) != weights(longer)).any()


def test_a_refinement_begins_at_the_best_epoch(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    data = small_data().fitting
    begun: list[Tensors] = []
    plain = module.gauss_newton

    def noting(engine: Engine, *args: object) -> None:
        begun.append(engine.weights())
        plain(engine, *args)

    monkeypatch.setattr(module, "gauss_newton", noting)
    scripted(monkeypatch, 1.0, 2.0, 3.0, 0.5, 0.4)
    refined = train_nnss(data, 2, 0, QUICK.replace(epochs=3, patience=2, refine=2))
    assert refined.epochs == 5  # with fresh patience, although Adam's had run out
    scripted(monkeypatch, 1.0)
    first = train_nnss(data, 2, 0, QUICK.replace(epochs=1))
    np.testing.assert_array_equal(np.concatenate([w.ravel() for w in begun[0].values()]), weights(first))


def test_mini_batches_are_shuffled_anew_each_epoch(small_data: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    data = small_data().fitting
    seen: dict[int, list[int]] = {}
    plain = FastEngine.train_batch

    def noting(self: FastEngine, windows: np.ndarray, epoch: int) -> float:
        assert len(windows) == QUICK.batch
        seen.setdefault(epoch, []).extend(windows.tolist())
        return plain(self, windows, epoch)

    monkeypatch.setattr(FastEngine, "train_batch", noting)
    train_nnss(data, 2, 7, QUICK)
    count = len(sliding_windows(data.train, QUICK.window, QUICK.stride)[0])
    used = count // QUICK.batch * QUICK.batch
    assert used > QUICK.batch
    random = named_random(7, "shuffling")
    for epoch in range(1, QUICK.epochs + 1):
        assert seen[epoch] == random.permutation(count)[:used].tolist()
    assert all(first != second for first, second in pairwise(seen.values()))
