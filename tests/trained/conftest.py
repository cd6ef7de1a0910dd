"""Folders of trained models for these tests."""

from collections.abc import Callable
from pathlib import Path

import pytest

from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import select
from nnss_cli.testing import small_dataset


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
