"""Exact derivatives of simulated outputs, Gauss–Newton, the encoder by regression, warm starts."""

import itertools
import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
from nnss_cli.baselines.ssest import ssest
from nnss_cli.datasets.catalog import load
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.iterative import named_random
from nnss_cli.model.architecture import SCHEDULING, STABILITIES, Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training import fast as fast_module
from nnss_cli.training import gauss_newton as gauss_newton_module
from nnss_cli.training.encoder import encoder_map, regress_encoder, set_encoder
from nnss_cli.training.engine import ReferenceEngine, free_run_rmse
from nnss_cli.training.fast import FastEngine
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.gauss_newton import ahead, gauss_newton
from nnss_cli.training.least_squares import Block, NormalEquations
from nnss_cli.training.recipe import Recipe
from nnss_cli.training.warm import linear_start, warm_start

NETWORKS = tuple(each for each in STABILITIES if each != "incremental")
"""Those with a generator network; test_incremental.py has the other."""


def make(architecture: Architecture, seed: int = 0) -> NNSS:
    r, m = architecture.inputs, architecture.outputs
    scaling = Scaling(np.zeros(r), np.ones(r), np.zeros(m), np.ones(m))
    model = NNSS(architecture, scaling, Channels(("u",) * r, ("y",) * m, ("",) * r, ("",) * m), 1.0)
    model.initialise(np.random.default_rng(seed))
    return model


def signals(a: Architecture, N: int, L: int) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(1)
    return random.standard_normal((N, L, a.inputs)), random.standard_normal((N, L, a.outputs))


@pytest.mark.parametrize("feedthrough", [False, True])
@pytest.mark.parametrize("stability", NETWORKS)
@pytest.mark.parametrize("scheduling", SCHEDULING)
@pytest.mark.parametrize(
    ("n", "r", "m", "hidden", "encoder", "N", "L"),
    [(3, 1, 1, (12, 9), (4, 4), 3, 12), (5, 2, 4, (7,), (), 1, 9), (8, 1, 2, (3, 3, 3), (2,), 2, 7)],
)
def test_derivatives_agree_with_automatic_ones(
    n: int, r: int, m: int, hidden: tuple, encoder: tuple, N: int, L: int, scheduling: str, stability: str,
    feedthrough: bool, whole: Callable, monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(fast_module, "STRETCH", 4)  # several stretches a window, the last one ragged
    a = Architecture(
        n, r, m, hidden, encoder, scheduling, gamma=0.9, dtype="float64", stability=stability, feedthrough=feedthrough
    )
    model = make(a)
    u, y = signals(a, N, L)
    x0 = np.random.default_rng(2).standard_normal((N, n))
    fast, reference = (
        whole(engine(model, u, y, Recipe()).sensitivities(x0), x0) for engine in (FastEngine, ReferenceEngine)
    )
    for ours, theirs in zip(fast, reference, strict=True):
        assert ours.shape == theirs.shape
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-12 * max(1.0, np.abs(theirs).max()))


@pytest.mark.system
@pytest.mark.parametrize("hidden", [(3,), (40,)], ids=["fewer weights than errors", "more"])
def test_gauss_newton_finds_a_model_of_its_own_kind(hidden: tuple) -> None:
    a = Architecture(2, 1, 1, hidden, (4,), dtype="float64")
    random = np.random.default_rng(3)
    plant = make(a, seed=5)
    u = random.standard_normal((2, 150, 1))
    with torch.no_grad():
        y = plant(torch.tensor(u), torch.tensor(random.standard_normal((2, 1))))[0].numpy()
    errors: list[float] = []

    def goes_on(error: float) -> bool:
        errors.append(error)
        return True

    engine = FastEngine(make(a, seed=6), u, y, Recipe())
    gauss_newton(engine, u, y, 60, goes_on)
    assert all(later < earlier for earlier, later in itertools.pairwise(errors))
    assert errors[-1] < 1e-3 * y.var()


def test_an_encoder_is_set_and_regressed() -> None:
    random = np.random.default_rng(0)
    layers = [
        (random.standard_normal((6, 2)), random.standard_normal(6)),
        (random.standard_normal((3, 6)), np.zeros(3)),
    ]
    E, e = random.standard_normal((3, 2)), random.standard_normal(3)
    set_encoder(layers, E, e)
    for ours, expected in zip(encoder_map(layers, 2)[-1], (E, e), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-12)
    y = random.standard_normal((50, 2))
    for ours, expected in zip(regress_encoder(y, y @ E.T + e), (E, e), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-12)


@pytest.mark.parametrize("stability", NETWORKS)
@pytest.mark.parametrize("gamma", [1.0, 0.99])
def test_a_warm_start_simulates_like_ssest(gamma: float, stability: str) -> None:
    data = load("twotank-sim").fitting
    train, val = data.normalised()
    train, val = (train[0][:400],), (val[0][:200],)
    model = make(Architecture(2, 1, 1, (9,), (3,), gamma=gamma, dtype="float64", stability=stability))
    warm_start(model, linear_start(train, val, 2, gamma))
    linear = ssest(train, val, 2)
    assert linear.spectral_radius() < gamma
    engine = FastEngine(model, np.zeros((1, 3, 1)), np.zeros((1, 3, 1)), Recipe())
    record: Record = val[0]
    ours = engine.free_run(record.u, record.y[0])
    theirs, _ = linear.simulate(record.u, linear.state_from_output(record.y[0], record.u[0]))
    np.testing.assert_allclose(ours, theirs, atol=1e-8)


@pytest.mark.system
def test_a_warm_start_is_never_worse_on_validation_than_it_began() -> None:
    data = load("twotank-sim").fitting
    train, val = data.normalised()
    recipe = Recipe(
        hidden=(4,), encoder=(3,), initial="linear", window=0, dtype="float64", optimiser="gauss-newton", epochs=8
    )
    training = train_nnss(data, 2, 0, recipe)
    started = make(recipe.architecture(2, 1, 1))
    started.initialise(named_random(0, "weights"))
    warm_start(started, linear_start(train, val, 2, 1.0))
    zero = np.zeros((1, 3, 1))
    begun, ended = (free_run_rmse(FastEngine(model, zero, zero, recipe), val) for model in (started, training.model))
    assert ended <= begun
    assert ended < 0.7 * begun  # the plant is not linear


@pytest.mark.parametrize("engine", [FastEngine, ReferenceEngine])
def test_a_fixed_encoder_stays(engine: type) -> None:
    a = Architecture(2, 1, 1, (4,), (3,), dtype="float64")
    u, y = signals(a, 4, 9)
    started = engine(make(a), u, y, Recipe(fixed_encoder=True))
    before = started.weights()
    started.train_batch(np.arange(4), 1)
    for name, array in started.weights().items():
        assert (array == before[name]).all() == name.startswith("encoder")


@pytest.mark.parametrize("every", [1, 3])
def test_normal_equations_are_those_of_the_blocks_together(every: int, whole: Callable) -> None:
    """Of two windows in ragged stretches; with every third sample, the gradient and the cost are of all."""
    random = np.random.default_rng(0)
    p, n, m = 5, 2, 2
    lengths = ((0, 7), (0, 4), (1, 9))
    blocks = [
        Block(*(random.standard_normal(shape) for shape in ((k * m,), (k * m, p + n))), window, np.zeros((k, n)))
        for window, k in lengths
    ]
    errors, J, _ = whole(blocks, np.zeros((2, n)))
    found, states = NormalEquations.summed(blocks, p, 2, every)
    assert [len(x) for x in states] == [7, 4, 9]
    assert (found.squares, found.count) == (pytest.approx(errors @ errors), len(errors))
    np.testing.assert_allclose(found.slope, J.T @ errors, atol=1e-12)
    expected = np.zeros_like(found.gram)
    row = 0
    for _, k in lengths:
        part = J[row : row + k * m].reshape(k, m, -1)
        seen = part[::every].reshape(-1, J.shape[1])
        expected += seen.T @ seen * (k / len(part[::every]))
        row += k * m
    np.testing.assert_allclose(np.tril(found.gram), np.tril(expected), atol=1e-12)


@pytest.mark.system
@pytest.mark.parametrize("most", [8, 10**6], ids=["of some samples", "of all"])
def test_a_long_record_is_trained_with_the_curvature_of_some_samples(
    most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both descend to the optimum of a plant without noise; the short way takes a fraction of the samples."""
    a = Architecture(1, 1, 1, (2,), (2,), dtype="float64")
    u = np.random.default_rng(0).standard_normal((1, 3000, 1))
    with torch.no_grad():
        y = make(a, seed=5)(torch.tensor(u), torch.tensor(np.zeros((1, 1))))[0].numpy()
    taken, errors = set(), []
    plain = NormalEquations.summed

    def noting(blocks: object, p: int, windows: int, every: int) -> object:
        taken.add(every)
        return plain(blocks, p, windows, every)

    def goes_on(error: float) -> bool:
        errors.append(error)
        return True

    monkeypatch.setattr(NormalEquations, "summed", noting)
    monkeypatch.setattr(gauss_newton_module, "ERRORS_A_PARAMETER", most)
    engine = FastEngine(make(a, seed=6), u, y, Recipe(dtype="float64"))
    gauss_newton(engine, u, y, 40, goes_on)
    assert errors[-1] < 1e-5 * y.var()
    assert taken == {max(1, 3000 // (most * (engine.model_weights.generator_size + 1)))}


@pytest.mark.parametrize("integrator", [False, True])
def test_two_threads_give_the_same_numbers(integrator: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fast_module, "STRETCH", 16)
    seen: set[int] = set()
    exact = FastEngine.sensitivities

    def watched(self: FastEngine, x0: np.ndarray) -> Iterator[Block]:
        for block in exact(self, x0):
            seen.add(threading.get_ident())
            yield block

    monkeypatch.setattr(FastEngine, "sensitivities", watched)
    a = Architecture(2, 1, 1, (5,), (3,), dtype="float64", integrator=integrator)
    u, y = signals(a, 2, 100)
    trained, before = [], threading.active_count()
    for threads in (1, 2):
        seen.clear()
        model = make(a)
        tried, losses = FastEngine(model, list(u), list(y), Recipe(dtype="float64")), []

        def goes_on(loss: float, losses: list[float] = losses) -> bool:
            losses.append(loss)
            return True

        gauss_newton(tried, list(u), list(y), 5, goes_on, integrator=integrator, threads=threads)
        assert (seen == {threading.get_ident()}) == (threads == 1)
        assert threading.active_count() == before
        trained.append((losses, tried.model_weights.vector.copy()))
    assert len(trained[0][0]) == 5
    assert trained[0][0] == trained[1][0]
    assert np.array_equal(trained[0][1], trained[1][1])


def test_what_goes_wrong_ahead_is_raised_where_the_item_is_asked_for() -> None:
    def items() -> Iterator[int]:
        yield 1
        raise ArithmeticError("singular")

    found = ahead(items())
    assert next(found) == 1
    with pytest.raises(ArithmeticError, match="singular"):
        next(found)
