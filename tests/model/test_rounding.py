"""ρ(A(ρ)) < γ in the precision that runs, for weights made to break it.

A computed step is x⁺ = S12 z + r2, M z = x − r1, so it is the exact step of an S moved by ‖r1‖/‖z‖ and ‖r2‖/‖z‖ in the
spectral norm (rank one each). While that leaves S positive definite, the matrix that moved x has ρ < γ.
"""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nnss_cli.baselines.schur import EPSILON, MARGIN, schur_inverse, schur_margin, schur_matrix
from nnss_cli.datasets.record import FloatArray
from numba import njit

from nnss_cli.errors import InputError
from nnss_cli.model import kernels, schur
from nnss_cli.model.architecture import Architecture
from nnss_cli.training.warm import free_matrices

KINDS = ("any", "rank one", "equal halves", "near equal columns", "near equal rows", "equal halves of rank one")
DTYPES = ("float32", "float64")
Product = Callable[[FloatArray, FloatArray, FloatArray, float], tuple[FloatArray, FloatArray]]


def draw(random: np.random.Generator, n: int, N: int, dtype: str) -> tuple[FloatArray, FloatArray]:
    """W (N, 2n, 2n) with entries up to 10⁴ and V (N, n, n), none of them or up to 10⁶, a kind in turn."""
    W = random.standard_normal((N, 2 * n, 2 * n))
    near = 10 ** random.uniform(-7, -1, (N, 1, 1)) * random.standard_normal(W.shape)
    for i, kind in enumerate(np.resize(KINDS, N)):
        if "rank one" in kind:
            W[i] = np.outer(W[i, :, 0], W[i, 0])
        if "columns" in kind:
            W[i] = W[i, :, :1] + near[i]
        if "rows" in kind:
            W[i] = W[i, :1] + near[i]
        if "halves" in kind:
            W[i, :, n:] = W[i, :, :n]
    W *= 10 ** random.uniform(-3, 4, (N, 1, 1)) / np.abs(W).max(axis=(1, 2), keepdims=True)
    V = random.standard_normal((N, n, n)) * 10 ** random.uniform(-3, 6, (N, 1, 1))
    V[random.random(N) < 0.4] = 0
    return W.astype(dtype), V.astype(dtype)


@njit
def _compiled(theta, x, gamma, epsilon, LU, z, q, x_next):
    kernels._schur(theta, x, gamma, epsilon, LU, z, q, x_next)


def by_kernel(W: FloatArray, V: FloatArray, x: FloatArray, gamma: float) -> tuple[FloatArray, FloatArray]:
    """z and x⁺ (N, n) of the compiled step without input."""
    N, n = x.shape
    K = (V - V.swapaxes(1, 2))[:, *np.triu_indices(n, 1)]
    theta = np.ascontiguousarray(np.concatenate([W.reshape(N, -1), K], axis=1).T)
    LU, z, q, x_next = (np.empty((rows, N), W.dtype) for rows in (2 * n * n, n, 2 * n, n))
    _compiled(theta, np.ascontiguousarray(x.T), gamma, EPSILON, LU, z, q, x_next)
    return z.T, x_next.T


def by_torch(W: FloatArray, V: FloatArray, x: FloatArray, gamma: float) -> tuple[FloatArray, FloatArray]:
    """z and x⁺ (N, n) as `NNSS.step` computes them."""
    S12, M = schur.schur_terms(torch.from_numpy(W), torch.from_numpy(V), gamma)
    z = torch.linalg.solve(M, torch.from_numpy(x)[..., None])
    return z[..., 0].numpy(), (S12 @ z)[..., 0].numpy()


def moved(product: Product, W: FloatArray, V: FloatArray, x: FloatArray, gamma: float) -> FloatArray:
    """How far S moved in a step, over its smallest eigenvalue at least: below 1 the matrix applied has ρ < γ."""
    z, x_next = (part.astype(np.longdouble) for part in product(W, V, x, gamma))
    n, dtype = x.shape[1], W.dtype
    W, V, x = (part.astype(np.longdouble) for part in (W, V, x))
    K = V - V.swapaxes(1, 2)
    S = np.einsum("bki,bkj->bij", W, W)
    added = EPSILON + schur_margin(n, dtype) * (
        np.trace(S, axis1=1, axis2=2) / (2 * n) + np.sqrt((K**2).sum(axis=(1, 2)) / 2)
    )
    S += added[:, None, None] * np.eye(2 * n)
    M = (S[:, :n, :n] / gamma**2 + S[:, n:, n:]) / 2 + K
    r1 = x - np.einsum("bij,bj->bi", M, z)
    r2 = x_next - np.einsum("bij,bj->bi", S[:, :n, n:], z)
    first, second = (np.sqrt((r**2).sum(axis=1) / (z**2).sum(axis=1)) for r in (r1, r2))
    # M's change is one of γ² r1 in S11 and r1 in S22, or one of 2γ² r1 in S11 alone
    share = (min(1, 2 * gamma**2) * first + second) / added
    return np.where(np.isfinite(share), share, np.inf).astype(np.float64)


def states(random: np.random.Generator, W: FloatArray, V: FloatArray, gamma: float) -> FloatArray:
    """x (N, n): any, and M z for any z, in turn."""
    N, n, dtype = len(W), V.shape[1], W.dtype
    x = random.standard_normal((N, n))
    W, V = W.astype(float), V.astype(float)
    S = W.swapaxes(1, 2) @ W
    M = (S[:, :n, :n] / gamma**2 + S[:, n:, n:]) / 2 + V - V.swapaxes(1, 2)
    x[::2] = np.einsum("bij,bj->bi", M[::2], x[::2]) / np.maximum(np.abs(M[::2]).max(axis=(1, 2)), 1e-3)[:, None]
    return x.astype(dtype)


@pytest.mark.system
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("product", [by_kernel, by_torch])
def test_each_step_is_one_of_a_matrix_below_gamma(product: Product, dtype: str) -> None:
    for n in (1, 2, 3, 5, 10):
        for gamma in (1.0, 0.5):
            random = np.random.default_rng(n)
            W, V = draw(random, n, 240, dtype)
            assert moved(product, W, V, states(random, W, V, gamma), gamma).max() < 1, (n, gamma)


@settings(max_examples=150)
@given(st.integers(1, 10), st.floats(0.5, 1.0), st.integers(0, 2**32 - 1), st.sampled_from(DTYPES))
def test_the_matrix_formed_is_below_gamma(n: int, gamma: float, seed: int, dtype: str) -> None:
    W, V = draw(np.random.default_rng(seed), n, len(KINDS), dtype)
    A = schur.schur_matrix(torch.from_numpy(W), torch.from_numpy(V), gamma).numpy().astype(np.float64)
    assert np.abs(np.linalg.eigvals(A)).max() < gamma


@pytest.mark.system
def test_states_do_not_grow_at_a_frozen_scheduling_point() -> None:
    # equal halves and V = 0: A is symmetric and its ρ as near to γ = 1 as it gets, so every growth counts
    random = np.random.default_rng(3)
    for n in (2, 5):
        W, _ = draw(random, n, 120, "float32")
        W = np.concatenate([W[kind :: len(KINDS)] for kind in (2, 5)])
        V, x = np.zeros((len(W), n, n), np.float32), random.standard_normal((len(W), n)).astype(np.float32)
        for product in (by_kernel, by_torch):
            now = x
            for k in range(400):
                now = product(W, V, now, 1.0)[1]
                if k == 20:  # what lies outside the slow directions is gone
                    first = np.linalg.norm(now.astype(float), axis=1)
            assert (np.linalg.norm(now.astype(float), axis=1) <= first).all(), (n, product)


def test_the_margins_of_numpy_torch_and_the_kernels_are_one() -> None:
    assert kernels.MARGIN == MARGIN
    for dtype in DTYPES:
        assert kernels._margin.py_func(np.zeros(1, dtype), 3) == schur_margin(3, dtype)
    W, V = draw(np.random.default_rng(0), 3, 12, "float64")
    for w, v in zip(W, V, strict=True):
        ours = schur_matrix(w, v, 0.9, margin=schur_margin(3, "float64"))
        other = schur.schur_matrix(torch.from_numpy(w), torch.from_numpy(v), 0.9).numpy()
        np.testing.assert_allclose(other, ours, atol=1e-6)


@pytest.mark.parametrize(
    ("n", "gamma", "skew", "margin"),
    [(1, 0.8, 1.0, 0.3), (3, 1.0, 0.0, 0.3), (3, 0.8, 1.0, 0.3), (4, 0.6, 100.0, 1e-3)],  # the last exchanges rows
)
def test_the_adjoint_follows_a_margin_of_any_size(
    n: int, gamma: float, skew: float, margin: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a large δ its part of the gradient is not lost in rounding. The kernels' source runs as Python here."""
    monkeypatch.setattr(schur, "schur_margin", lambda *_: margin)
    monkeypatch.setattr(kernels, "_margin", lambda *_: margin)
    for name in ("_squares", "_pivot"):
        monkeypatch.setattr(kernels, name, getattr(kernels, name).py_func)
    random = np.random.default_rng(n)
    b, (i, j) = 2, np.triu_indices(n, 1)
    W, V = random.standard_normal((b, 2 * n, 2 * n)), skew * random.standard_normal((b, n, n))
    x, mu = random.standard_normal((2, n, b))
    theta = np.concatenate([W.reshape(b, -1), (V - V.swapaxes(1, 2))[:, i, j]], axis=1).T
    LU, z, q, x_next = (np.zeros((rows, b)) for rows in (2 * n * n, n, 2 * n, n))
    kernels._schur.py_func(theta, x, gamma, EPSILON, LU, z, q, x_next)
    d_theta, d_x = np.zeros_like(theta), np.zeros((n, b))
    work = np.empty((2 * n * (n + 1) + 3, b))
    kernels._schur_adjoint.py_func(theta, x, x_next, gamma, EPSILON, LU, z, q, mu, d_theta, d_x, work)

    leaves = [torch.tensor(part, requires_grad=True) for part in (W, V, x.T.copy())]
    Ax = schur.schur_matrix(*leaves[:2], gamma) @ leaves[2][..., None]
    np.testing.assert_allclose(x_next.T, Ax[..., 0].detach(), atol=1e-12)
    (Ax[..., 0] * torch.tensor(mu.T.copy())).sum().backward()
    d_W, d_V, expected = (leaf.grad.numpy() for leaf in leaves)
    np.testing.assert_allclose(d_theta[: 4 * n * n].T, d_W.reshape(b, -1), atol=1e-11)
    np.testing.assert_allclose(d_theta[4 * n * n :].T, d_V[:, i, j], atol=1e-11)
    np.testing.assert_allclose(d_x.T, expected, atol=1e-11)


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_inverse_with_a_margin_round_trips(dtype: str) -> None:
    random = np.random.default_rng(0)
    for n in (1, 3, 6):
        margin = schur_margin(n, dtype)
        A = random.standard_normal((n, n))
        A *= 0.99 * 0.9 / np.abs(np.linalg.eigvals(A)).max()
        W, V = schur_inverse(A, 0.9, margin=margin)
        np.testing.assert_allclose(schur_matrix(W, V, 0.9, margin=margin), A, atol=1e-9)


def test_a_start_that_the_precision_has_no_room_for_is_drawn_in() -> None:
    A = np.array([[1 - 1e-4, 3.0], [0.0, 0.5]])
    with pytest.raises(InputError, match="float64"):
        schur_inverse(A, margin=schur_margin(2, "float32"))
    for dtype, tolerance in (("float64", 1e-7), ("float32", 0.01)):
        W, V = free_matrices(Architecture(2, 1, 1, dtype=dtype), A)
        back = schur_matrix(W.reshape(4, 4), V.reshape(2, 2), margin=schur_margin(2, dtype))
        np.testing.assert_allclose(back, A, rtol=tolerance, atol=1e-6)
    with pytest.raises(InputError, match="spectral radius 1"):
        free_matrices(Architecture(2, 1, 1), np.eye(2))
