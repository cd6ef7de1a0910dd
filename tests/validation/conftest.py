"""Models with a noise model that is known, and folders of runs on made-up plants."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Dataset, FittingData, Record, Scaling

from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import select
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.validation.stepping import Stepper

A = np.array([[1.5, -0.7], [1.0, 0.0]])
PLANT = LinearStateSpace(A, np.array([[1.0], [0.0]]), np.array([[1.0, 0.5]]), np.zeros((1, 1)), 0.5)
GAIN = np.array([[0.6], [0.35]])


def channels(r: int, m: int) -> Channels:
    return Channels(tuple(f"u{i + 1}" for i in range(r)), tuple(f"y{i + 1}" for i in range(m)), ("V",) * r, ("m",) * m)


@pytest.fixture
def linear() -> LinearModel:
    """A plant of order 2 in units that are not the normalised ones."""
    scaling = Scaling(np.array([0.5]), np.array([2.0]), np.array([3.0]), np.array([4.0]))
    return LinearModel(PLANT, scaling, channels(1, 1))


@pytest.fixture
def neural() -> Callable[..., NNSS]:
    """An NN-SS model of random weights."""

    def made(
        scheduling: str = "x", n: int = 2, r: int = 1, m: int = 1, seed: int = 0, **settings: str
    ) -> NNSS:  # fmt: skip
        random = np.random.default_rng(seed)
        scaling = Scaling(
            random.normal(size=r), random.uniform(0.5, 2, r), random.normal(size=m), random.uniform(0.5, 2, m)
        )
        settings = {"dtype": "float64"} | settings
        a = Architecture(n, r, m, (6,), (4,), scheduling, gamma=0.95, **settings)
        model = NNSS(a, scaling, channels(r, m), 0.1)
        model.initialise(random)
        return model

    return made


@pytest.fixture
def jacobians_agree() -> Callable[[Stepper, np.ndarray, np.ndarray], None]:
    """Asserts that a stepper's Jacobians at z (b, s) and u (b, r) are the central differences of its step."""

    def check(system: Stepper, z: np.ndarray, u: np.ndarray) -> None:
        F, H = system.jacobians(z, u)
        for i in range(system.size):
            d = 1e-6 * np.eye(system.size)[i]
            (ahead, y1), (behind, y0) = system.step(z + d, u), system.step(z - d, u)
            np.testing.assert_allclose(F[:, :, i], (ahead - behind) / 2e-6, rtol=1e-5, atol=1e-7)
            np.testing.assert_allclose(H[:, :, i], (y1 - y0) / 2e-6, rtol=1e-5, atol=1e-7)

    return check


def plant_dataset(K: int = 1800, noise: float = 0.5, coloured: bool = False, seed: int = 0) -> Dataset:
    """A third of the record each for train, validation and test; innovations drive the state where `coloured`."""
    random = np.random.default_rng(seed)
    u, e = random.standard_normal((K, 1)), noise * random.standard_normal((K, 1))
    x, y = np.zeros(2), np.empty((K, 1))
    for k in range(K):
        y[k] = PLANT.C @ x + e[k]
        x = PLANT.A @ x + PLANT.B @ u[k] + (GAIN @ e[k] if coloured else 0)
    record, third = Record(u, y, 0.5), K // 3
    train = (record[:third],)
    fitting = FittingData("plant", "strict", train, (record[third : 2 * third],), Scaling.of(train), channels(1, 1))
    return Dataset(fitting, {"test": (record[2 * third :],)})


@pytest.fixture
def true_gain() -> np.ndarray:
    """K (2, 1) of the coloured plant."""
    return GAIN


@pytest.fixture(scope="session")
def plant_data() -> Callable[..., Dataset]:
    """`plant_dataset`."""
    return plant_dataset


@pytest.fixture(scope="session")
def plant_run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """The folder of a run on `plant_dataset`, made once for each choice of arguments."""
    made: dict[tuple, Path] = {}

    def folder(method: str = "ssest", order: int = 2, seed: int = 0, **data: object) -> Path:
        key = (method, order, seed, *sorted(data.items()))
        if key not in made:
            dataset = plant_dataset(**data)
            store = Store(tmp_path_factory.mktemp("plant"), dataset.name, dataset.protocol)
            (spec,) = plan(store, dataset, select([method]), [order], [seed], {}, False).todo
            assert execute(spec, dataset, store).status == "ok"
            made[key] = store.run_folder(spec)
        return made[key]

    return folder
