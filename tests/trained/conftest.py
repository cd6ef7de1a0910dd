"""Folders of trained models for these tests."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import select
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.testing import small_dataset
from nnss_cli.trained import TrainedModel


@pytest.fixture(scope="session")
def trained_folder(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The folder of a run on `small_dataset`, made once for each choice of arguments."""
    made: dict[tuple, Path] = {}

    def folder(method: str = "n4sid", order: int = 2, r: int = 1, m: int = 1, **settings: object) -> Path:
        key = (method, order, r, m, *settings.items())
        if key not in made:
            dataset = small_dataset(r, m)
            store = Store(tmp_path_factory.mktemp("trained"), dataset.name, dataset.protocol)
            (spec,) = plan(store, dataset, select([method]), [order], [0], settings, False).todo
            assert execute(spec, dataset, store).status == "ok"
            made[key] = store.run_folder(spec)
        return made[key]

    return folder


@pytest.fixture(scope="session")
def untrained() -> Callable[..., TrainedModel]:
    """An NN-SS model of random weights and scaling."""

    def made(
        stability: str = "schur",
        scheduling: str = "x",
        n: int = 2,
        r: int = 1,
        m: int = 1,
        seed: int = 0,
        **more: object,
    ) -> TrainedModel:
        random = np.random.default_rng(seed)
        scaling = Scaling(
            random.normal(size=r), random.uniform(0.5, 2, r), random.normal(size=m), random.uniform(0.5, 2, m)
        )
        inputs, outputs = tuple(f"u{i + 1}" for i in range(r)), tuple(f"y{i + 1}" for i in range(m))
        choices = {"hidden": (6,), "encoder": (4,), "dtype": "float64", "gamma": 0.97} | more
        a = Architecture(n, r, m, scheduling=scheduling, stability=stability, **choices)
        model = NNSS(a, scaling, Channels(inputs, outputs, ("V",) * r, ("m",) * m), 0.1)
        model.initialise(random)
        return TrainedModel(model)

    return made
