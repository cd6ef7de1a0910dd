"""An incrementally stable layer's compiled matrices and their adjoint, with torch as the oracle."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.model.architecture import Architecture
from nnss_cli.model.incremental import Lure, PlainArrays, whole
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import FastEngine
from nnss_cli.training.lure import CompiledLure
from nnss_cli.training.lure_matrices import Layout
from nnss_cli.training.recipe import Recipe

KINDS = [
    # scheduling, feedthrough, gain
    ("x", False, 0.0), ("x+u", False, 0.0), ("x+u", True, 0.0), ("x", True, 0.0),
    ("x", False, 2.0), ("x+u", False, 0.5), ("x+u", True, 1e-3), ("x", True, 30.0),
]  # fmt: skip
SIZES = [(1, 1, 1, 1), (2, 2, 1, 2), (3, 1, 2, 8), (4, 5, 3, 7), (5, 1, 1, 100)]  # n, r, m, q


def architecture(kind: tuple, n: int, r: int, m: int, q: int, dtype: str = "float64") -> Architecture:
    scheduling, feedthrough, gain = kind
    return Architecture(
        n, r, m, (q,), (1,), scheduling, 0.95, dtype=dtype, stability="incremental", feedthrough=feedthrough, gain=gain
    )


def drawn(a: Architecture, seed: int, size: float, shape: str = "free") -> dict[str, np.ndarray]:
    """Free weights up to `size` by name; X and Y of rank one, or many zeros, by `shape`."""
    random, found = np.random.default_rng(seed), {}
    for name, extent in Lure(a).sizes.items():
        values = random.uniform(-size, size, extent)
        if shape == "rank one" and name in "XY":
            values = np.outer(random.uniform(-1, 1, len(values)), random.uniform(-size, size, values.shape[1]))
        if shape == "sparse":
            values *= random.uniform(size=extent) < 0.3
        found[name] = values.astype(a.dtype).astype(np.float64)
    return found


def joined(parts: object) -> np.ndarray:
    return np.concatenate([np.asarray(part).ravel() for part in parts])  # type: ignore[attr-defined]


def torchs(a: Architecture, free: dict[str, np.ndarray], towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The matrices' entries (P,) and derivatives (k, p) from those (k, P) towards them, by autograd in float64."""
    given = {name: torch.from_numpy(part).requires_grad_() for name, part in free.items()}
    flat = torch.cat([part.ravel() for part in Lure(a).plain(given)])
    rows = [
        torch.autograd.grad(flat, list(given.values()), torch.from_numpy(row), retain_graph=True) for row in towards
    ]
    return flat.detach().numpy(), np.stack([joined(row) for row in rows])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sizes", SIZES)
def test_values_and_derivatives_are_those_of_torch(sizes: tuple[int, int, int, int], kind: tuple) -> None:
    for dtype in ("float64", "float32"):  # whose margins differ
        a = architecture(kind, *sizes, dtype)
        free, layout = drawn(a, 3, 1.0), Layout(a)
        towards = np.random.default_rng(4).standard_normal((3, len(layout.plain)))
        flat, slopes = torchs(a, free, towards)
        np.testing.assert_allclose(layout.matrices(joined(free.values())), flat, rtol=0, atol=2e-14 * abs(flat).max())
        found = layout.pulled_back(joined(free.values()), towards)
        np.testing.assert_allclose(found, slopes, rtol=0, atol=2e-14 * abs(slopes).max())


@given(
    st.integers(0, 2**31 - 1), st.sampled_from(KINDS), st.sampled_from(SIZES[:4]), st.floats(-3, 4),
    st.sampled_from(["free", "rank one", "sparse"]),
)  # fmt: skip
def test_they_are_for_weights_of_any_size(seed: int, kind: tuple, sizes: tuple, size: float, shape: str) -> None:
    a = architecture(kind, *sizes)
    free, layout = drawn(a, seed, 10**size, shape), Layout(a)
    towards = np.random.default_rng(seed).standard_normal((1, len(layout.plain)))
    flat, slopes = torchs(a, free, towards)
    given_weights = joined(free.values())
    # Gram matrices of weights of 10⁴ have a condition number of 10⁶, their factors' rounding as much
    np.testing.assert_allclose(layout.matrices(given_weights), flat, rtol=0, atol=1e-9 * (1e-3 + abs(flat).max()))
    found = layout.pulled_back(given_weights, towards)
    np.testing.assert_allclose(found, slopes, rtol=0, atol=1e-8 * (1e-3 + abs(slopes).max()))


def violations(draws: int, dtype: str, seed: int) -> list[str]:
    """Draws of sizes, kinds and weights up to 10⁴ for which the matrices that a step has give ‖K‖₂ ≥ 1."""
    random, found = np.random.default_rng(seed), []
    for _ in range(draws):
        n, r, m, q = (int(random.integers(1, high)) for high in (7, 4, 4, 13))
        a = architecture(KINDS[random.integers(len(KINDS))], n, r, m, q, dtype)
        shape, size = str(random.choice(["free", "rank one", "sparse"])), float(10 ** random.uniform(-3, 4))
        free = drawn(a, int(random.integers(2**31)), size, shape)
        views = {name: part.astype(dtype) for name, part in free.items()}
        plain = PlainArrays(*(part.astype(np.float64) for part in CompiledLure(a, views).plain()))
        K1, K21 = whole(plain, np.exp(np.arcsinh(free["scale"] / 2)), a.gamma, a.gain)
        norm = np.linalg.norm(np.block([[K1], [K21, np.zeros((q, q))]]), 2)
        if not norm < 1:
            found.append(f"{a}, {shape}, {size:g}: ‖K‖ = 1 + {norm - 1:.3g}")
    return found


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_no_weights_break_the_bound(dtype: str) -> None:
    assert not violations(400, dtype, 0)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_forty_thousand_draws_keep_the_bound(dtype: str) -> None:
    assert not violations(40_000, dtype, 1)


def test_weights_that_are_no_numbers_give_none() -> None:
    a = architecture(KINDS[0], 2, 1, 1, 3)
    layout = Layout(a)
    for broken in (np.nan, 1e200):
        weights = np.full(len(layout.free), broken)
        assert np.isnan(layout.matrices(weights)).any()
        assert np.isnan(layout.pulled_back(weights, np.ones((1, len(layout.plain))))).any()


def test_a_step_asks_torch_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """What made a small step four times as long as Schur's; how long it takes now is `make bench`'s."""
    random, one = np.random.default_rng(1), np.ones(1)
    a = architecture(KINDS[0], 2, 1, 1, 3)
    model = NNSS(a, Scaling(0 * one, one, 0 * one, one), Channels(("u",), ("y",), ("",), ("",)), 1.0)
    model.initialise(random)
    engine = FastEngine(
        model, random.standard_normal((1, 9, 1)), random.standard_normal((1, 9, 1)), Recipe(dtype="float64")
    )
    monkeypatch.setattr(Lure, "plain", None)
    monkeypatch.setattr(torch.autograd, "grad", None)
    before = engine.model_weights.vector.copy()
    assert np.isfinite(engine.train_batch(np.arange(1), 1))
    assert (engine.model_weights.vector != before).any()
