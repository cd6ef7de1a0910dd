"""The compiled kernels against the torch model: the same numbers, and NaN stays NaN."""

import inspect
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from conftest import slow_but
from nnss_cli.baselines import kernels as linear_kernels
from nnss_cli.datasets.record import Channels, Scaling
from numba import njit

from nnss_cli.model import kernels
from nnss_cli.model.architecture import SCHEDULING, Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training import feedback_kernels, lure_kernels, lure_matrices
from nnss_cli.training.engine import ReferenceEngine, training_loss
from nnss_cli.training.fast import FastEngine, Weights
from nnss_cli.training.recipe import Recipe
from nnss_cli.validation import gain_kernels


def make(architecture: Architecture, saturation: float = 0.0, seed: int = 0) -> NNSS:
    """A model with random weights; `saturation` drives the sigmoids to their ends."""
    r, m = architecture.inputs, architecture.outputs
    scaling = Scaling(np.zeros(r), np.ones(r), np.zeros(m), np.ones(m))
    model = NNSS(architecture, scaling, Channels(("u",) * r, ("y",) * m, ("V",) * r, ("m",) * m), 1.0)
    random = np.random.default_rng(seed)
    model.initialise(random)
    with torch.no_grad():
        for parameter in model.parameters():  # biases too
            parameter.add_(torch.from_numpy(0.1 * random.standard_normal(tuple(parameter.shape))))
        for layer in list(model.generator)[:-1:2] if saturation else ():
            layer.bias.add_(saturation * torch.from_numpy(random.choice([-1.0, 0.0, 1.0], len(layer.bias))))
    return model


def windows(a: Architecture, N: int, L: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return random.standard_normal((N, L, a.inputs)), random.standard_normal((N, L, a.outputs))


CASES = [
    # n, r, m, hidden, encoder, batch, L
    (1, 1, 1, (5,), (3,), 7, 10),
    (3, 1, 1, (12, 9), (4, 4), 64, 12),
    (5, 1, 1, (20,) * 4, (6,) * 4, 32, 15),
    (4, 5, 3, (12,) * 5, (6,) * 4, 1, 150),  # several blocks of ROWS samples, the last one ragged
    (10, 2, 2, (11,) * 6, (), 3, 8),
    (2, 3, 4, (9,), (2, 2), 2, 2),
]


def worst_difference(model: NNSS, u: np.ndarray, y: np.ndarray, consistency: float) -> tuple[float, float]:
    """Of the loss, and of any gradient tensor relative to its largest entry."""
    engine = FastEngine(model, u, y, Recipe(consistency=consistency))
    loss = engine.evaluate(np.arange(len(u)))
    gradient = engine.model_weights.views(engine.gradient)
    reference = training_loss(
        model, torch.tensor(u, dtype=model.dtype), torch.tensor(y, dtype=model.dtype), consistency
    )
    model.zero_grad()
    reference.backward()
    worst = 0.0
    for name, parameter in model.named_parameters():
        expected = np.zeros(parameter.shape) if parameter.grad is None else parameter.grad.numpy()
        scale = max(np.abs(expected).max(), 1e-12)
        worst = max(worst, float(np.abs(gradient[name] - expected).max() / scale))
    return abs(loss - reference.item()) / reference.item(), worst


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("stability", ["schur", "quadratic", "none"])
@pytest.mark.parametrize("scheduling", SCHEDULING)
@pytest.mark.parametrize(("n", "r", "m", "hidden", "encoder", "batch", "L"), CASES)
def test_gradients_agree_in_float64(
    n: int, r: int, m: int, hidden: tuple, encoder: tuple, batch: int, L: int, scheduling: str, stability: str,
    feedthrough: bool,
) -> None:  # fmt: skip
    if scheduling != "x" and L == 2 and "y" in scheduling:
        pytest.skip("one sample is left of such a window")
    for gamma, saturation in ((1.0, 0.0), (0.8, 0.0), (1.0, 30.0)):
        if stability == "none" and L > 100:
            L = 20  # such a model leaves the range of numbers that can be compared
        a = Architecture(
            n, r, m, hidden, encoder, scheduling, gamma, dtype="float64", stability=stability, feedthrough=feedthrough
        )
        loss, gradient = worst_difference(make(a, saturation), *windows(a, batch, L), consistency=0.3)
        assert loss < 1e-12, (gamma, saturation)
        assert gradient < 1e-12, (gamma, saturation)


@pytest.mark.parametrize("stability", ["schur", "quadratic"])
@pytest.mark.parametrize(("n", "r", "m", "hidden", "encoder", "batch", "L"), CASES[:4])
def test_gradients_agree_in_float32(
    n: int, r: int, m: int, hidden: tuple, encoder: tuple, batch: int, L: int, stability: str
) -> None:
    a = Architecture(n, r, m, hidden, encoder, dtype="float32", stability=stability)
    loss, gradient = worst_difference(make(a), *windows(a, batch, L), consistency=0.01)
    assert loss < 1e-4
    assert gradient < 1e-4


@pytest.mark.system
@pytest.mark.parametrize(
    ("scheduling", "stability"),
    slow_but((0, 4), [*((each, "schur") for each in SCHEDULING), ("x", "quadratic"), ("x", "none")]),
)
def test_a_hundred_steps_agree(scheduling: str, stability: str) -> None:
    a = Architecture(3, 2, 1, (8, 8), (4,), scheduling, dtype="float64", stability=stability)
    recipe = Recipe(consistency=0.01, learning_rate=1e-3)
    u, y = windows(a, 12, 15)
    plain, fast = ReferenceEngine(make(a), u, y, recipe), FastEngine(make(a), u, y, recipe)
    random = np.random.default_rng(0)
    for step in range(100):
        chosen = random.permutation(12)[:4]
        expected, found = plain.train_batch(chosen, 1 + step // 3), fast.train_batch(chosen, 1 + step // 3)
        assert found == pytest.approx(expected, rel=1e-10)
    np.testing.assert_allclose(fast.free_run(u[0], y[0, 0]), plain.free_run(u[0], y[0, 0]), atol=1e-9)


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("scheduling", SCHEDULING)
@pytest.mark.parametrize(
    ("dtype", "stability"),
    [("float32", "schur"), ("float64", "schur"), ("float32", "quadratic"), ("float64", "none")],
)
def test_free_runs_agree(scheduling: str, dtype: str, stability: str, feedthrough: bool) -> None:
    a = Architecture(
        4, 2, 3, (20, 10), (5, 5), scheduling, 0.95, dtype=dtype, stability=stability, feedthrough=feedthrough
    )
    model = make(a)
    random = np.random.default_rng(2)
    u, y0 = random.standard_normal((200, 2)), random.standard_normal(3)
    expected = model.simulate(u, y0)
    y, x = Weights(model).free_run(u, y0)
    tolerance = 1e-10 if dtype == "float64" else 2e-4
    np.testing.assert_allclose(y, expected.y, atol=tolerance)
    np.testing.assert_allclose(x, expected.x, atol=tolerance)


def test_weights_come_back_by_name() -> None:
    model = make(Architecture(2, 1, 1, (4,), (3,)))
    u, y = windows(model.architecture, 2, 5)
    for name, array in FastEngine(model, u, y, Recipe()).weights().items():
        np.testing.assert_array_equal(array, model.state_dict()[name].numpy())


@pytest.mark.parametrize("where", ["u", "y", "weights"])
def test_a_nan_reaches_the_loss(where: str) -> None:
    a = Architecture(3, 1, 1, (9, 9), (4,))
    u, y = windows(a, 4, 10)
    model = make(a)
    if where == "weights":
        with torch.no_grad():
            next(model.parameters())[0, 0] = torch.nan
    else:
        (u if where == "u" else y)[2, 5] = np.nan
    assert np.isnan(FastEngine(model, u, y, Recipe()).train_batch(np.arange(4), 1))


@pytest.fixture(scope="module")
def exponential() -> Callable[[np.ndarray], np.ndarray]:
    @njit
    def over(x: np.ndarray) -> np.ndarray:
        out = np.empty_like(x)
        for i in range(x.size):
            out[i] = kernels._exp(x[i])
        return out

    return over


@pytest.mark.parametrize(("dtype", "tolerance"), [("float32", 4e-7), ("float64", 4e-15)])
def test_the_exponential(dtype: str, tolerance: float, exponential: Callable[[np.ndarray], np.ndarray]) -> None:
    x = np.linspace(-80, 80, 20001).astype(dtype)
    expected = np.exp(x.astype(np.longdouble))
    assert np.max(np.abs(exponential(x) - expected) / expected) < tolerance
    ends = exponential(np.array([-1e4, 1e4, np.nan, np.inf, -np.inf], dtype))
    assert ends[0] < 1e-37
    assert ends[1] > 1e38
    assert np.isnan(ends[2])


@pytest.mark.parametrize("module", [kernels, linear_kernels])
def test_kernels_are_whole_in_one_file(module: ModuleType) -> None:
    """numba's cache looks at the entry point's file alone: a part kept elsewhere would go stale unseen."""
    for name, thing in vars(module).items():
        if hasattr(thing, "py_func"):
            assert thing.py_func.__module__ == module.__name__, name


@pytest.mark.parametrize(
    "module", [kernels, linear_kernels, feedback_kernels, lure_kernels, lure_matrices, gain_kernels]
)
def test_what_is_kept_of_a_kernel_is_all_of_it(module: ModuleType) -> None:
    """A part that is no entry point is inlined: else last bits depend on who compiled it, as the slow test shows."""
    found = [thing for thing in vars(module).values() if hasattr(thing, "targetoptions")]
    assert found
    for thing in found:
        cached = thing.stats.cache_path is not None
        assert cached != bool(thing.targetoptions.get("forceinline") or thing is kernels._gemm), thing
    source = inspect.getsource(module)
    assert source.count("@overload(") == len(re.findall(r"@overload\(.*jit_options=.*INLINE", source))


RUN = """
import sys, hashlib
import numpy as np
from nnss_cli.model.architecture import Architecture
from test_kernels import make, windows
from nnss_cli.training.fast import FastEngine
from nnss_cli.training.recipe import Recipe
a = Architecture(3, 1, 1, (8,), (8,), stability=sys.argv[1], dtype=sys.argv[2])
engine = FastEngine(make(a), *windows(a, 5, 90), Recipe(dtype=a.dtype))
blocks = list(engine.sensitivities(np.zeros((5, 3)))) if a.dtype == "float64" else []
for found in (*(block.derivatives for block in blocks), engine.free_run(np.ones((90, 1)), np.ones(1))):
    print(hashlib.sha256(found.tobytes()).hexdigest())
for epoch in (1, 2):
    print(engine.train_batch(np.arange(5), epoch))
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("stability", "dtype"),
    [("schur", "float64"), ("quadratic", "float64"), ("incremental", "float64"), ("schur", "float32")],
)
def test_a_result_does_not_depend_on_who_compiled_the_kernels(stability: str, dtype: str, tmp_path: Path) -> None:
    cache = {"NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", RUN, stability, dtype],
            cwd=Path(__file__).parent, env=os.environ | cache, check=True, capture_output=True, text=True,
        ).stdout
        for _ in range(2)
    )  # fmt: skip
    assert len(first.splitlines()) == (8 if dtype == "float64" else 3)
    assert first == second
