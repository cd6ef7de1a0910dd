"""The Schur parametrisation: bound, inverse, and the torch twin."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.baselines.schur import EPSILON, schur_inverse, schur_matrix

from nnss_cli.errors import InputError
from nnss_cli.model import schur as in_torch

sizes = st.integers(1, 10)
gammas = st.sampled_from([1.0, 0.99, 0.7, 0.3, 0.1])
scales = st.sampled_from([1e-3, 0.1, 1.0, 10.0, 100.0])


@given(
    n=sizes, gamma=gammas, scale=scales, epsilon=st.sampled_from([EPSILON, 1e-8, 1e-2]), seed=st.integers(0, 2**32 - 1)
)
def test_the_spectral_radius_is_below_gamma(n: int, gamma: float, scale: float, epsilon: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    W, V = scale * random.standard_normal((2 * n, 2 * n)), scale * random.standard_normal((n, n))
    A = schur_matrix(W, V, gamma, epsilon)
    assert np.abs(np.linalg.eigvals(A)).max() < gamma
    twin = in_torch.schur_matrix(torch.from_numpy(W), torch.from_numpy(V), gamma, epsilon).numpy()
    np.testing.assert_allclose(twin, A, rtol=1e-6, atol=1e-9)


@given(n=sizes, gamma=gammas, fraction=st.sampled_from([0.0, 0.5, 0.99, 0.999]), seed=st.integers(0, 2**32 - 1))
def test_the_closed_form_inverse_round_trips(n: int, gamma: float, fraction: float, seed: int) -> None:
    A = np.random.default_rng(seed).standard_normal((n, n))
    A *= fraction * gamma / np.abs(np.linalg.eigvals(A)).max()
    W, V = schur_inverse(A, gamma)
    np.testing.assert_allclose(schur_matrix(W, V, gamma), A, atol=1e-10, rtol=1e-10)


@given(n=sizes, gamma=gammas, seed=st.integers(0, 2**32 - 1))
def test_any_lyapunov_matrix_serves_the_inverse(n: int, gamma: float, seed: int) -> None:
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= 0.9 * gamma / np.linalg.norm(A, 2)
    W, V = schur_inverse(A, gamma, P=np.eye(n))
    np.testing.assert_allclose(schur_matrix(W, V, gamma), A, atol=1e-10, rtol=1e-10)


def test_the_inverse_refuses_what_the_map_cannot_reach() -> None:
    with pytest.raises(InputError, match="spectral radius 0.9"):
        schur_inverse(np.array([[0.9]]), gamma=0.9)


@pytest.mark.parametrize(("n", "gamma"), [(1, 1.0), (3, 0.8), (5, 1.0)])
def test_gradcheck(n: int, gamma: float) -> None:
    random = torch.Generator().manual_seed(n)
    W = torch.randn(2, 2 * n, 2 * n, dtype=torch.float64, generator=random, requires_grad=True)
    V = torch.randn(2, n, n, dtype=torch.float64, generator=random, requires_grad=True)
    assert torch.autograd.gradcheck(lambda W, V: in_torch.schur_matrix(W, V, gamma), (W, V))


def test_a_batch_is_its_matrices_one_by_one() -> None:
    random = torch.Generator().manual_seed(0)
    W = torch.randn(4, 3, 6, 6, dtype=torch.float64, generator=random)
    V = torch.randn(4, 3, 3, 3, dtype=torch.float64, generator=random)
    batch = in_torch.schur_matrix(W, V)
    for i in range(4):
        for j in range(3):
            np.testing.assert_allclose(batch[i, j].numpy(), schur_matrix(W[i, j].numpy(), V[i, j].numpy()), atol=1e-12)
