"""The contraction parametrisation: its bound for any weights, its inverse, and the theorem that it stands for."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.baselines.schur import contracting_basis, contraction_inverse, contraction_matrix
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.errors import InputError
from nnss_cli.model import schur
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights


def free_matrix(n: int, seed: int, scale: float, kind: str) -> np.ndarray:
    random = np.random.default_rng(seed)
    W = scale * random.standard_normal((2 * n, 2 * n))
    if kind == "rank one":
        return np.outer(W[:, 0], W[0])
    if kind == "equal halves":  # S12 comes as close to the factors as it can
        W[:, n:] = W[:, :n]
    return W


WEIGHTS = st.builds(
    free_matrix, st.integers(1, 10), st.integers(0, 10**6), st.floats(1e-3, 1e4),
    st.sampled_from(["any", "rank one", "equal halves"]),
)  # fmt: skip


@given(WEIGHTS, st.floats(0.05, 1.0), st.sampled_from([np.float64, np.float32]))
def test_the_norm_stays_below_gamma_for_any_weights(W: np.ndarray, gamma: float, dtype: type) -> None:
    # margin: 1 − ‖A‖/γ ≥ ε/(4n) in exact numbers, and 1e-7 was the smallest seen in either precision
    tensor = torch.from_numpy(W.astype(dtype))[None]
    A = schur.contraction_matrix(tensor, gamma)[0].numpy().astype(np.float64)
    assert np.linalg.norm(A, 2) < gamma


@given(WEIGHTS, st.floats(0.05, 1.0))
def test_torch_and_numpy_agree(W: np.ndarray, gamma: float) -> None:
    ours = schur.contraction_matrix(torch.from_numpy(W)[None], gamma)[0].numpy()
    np.testing.assert_allclose(ours, contraction_matrix(W, gamma), atol=1e-8)


@given(st.integers(1, 8), st.integers(0, 10**6), st.floats(0.3, 1.0))
def test_any_stable_matrix_has_a_contracting_basis_and_weights(n: int, seed: int, gamma: float) -> None:
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= 0.97 * gamma / np.abs(np.linalg.eigvals(A)).max()
    T = contracting_basis(A, gamma)
    moved = T @ A @ np.linalg.inv(T)
    assert np.linalg.norm(moved, 2) < gamma
    if np.linalg.norm(moved, 2) < gamma * (1 - 1e-3):
        np.testing.assert_allclose(contraction_matrix(contraction_inverse(moved, gamma), gamma), moved, atol=1e-9)


def test_what_does_not_contract_is_refused() -> None:
    with pytest.raises(InputError, match="norm"):
        contraction_inverse(np.array([[0.5, 2.0], [0.0, 0.5]]))
    with pytest.raises(InputError, match="spectral radius"):
        contracting_basis(np.array([[1.1]]))


def test_gradcheck() -> None:
    W = torch.randn(3, 6, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda W: schur.contraction_matrix(W, 0.9, 0.1), W)


def contracting(seed: int, gamma: float, dtype: str = "float64") -> NNSS:
    a = Architecture(3, 2, 1, (9, 7), (4,), gamma=gamma, dtype=dtype, stability="quadratic")
    model = NNSS(
        a, Scaling(np.zeros(2), np.ones(2), np.zeros(1), np.ones(1)), Channels(("a", "b"), ("y",), ("", ""), ("",)), 1.0
    )
    random = np.random.default_rng(seed)
    model.initialise(random)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(float(10 ** random.uniform(-1, 1.5)))
    return model


@given(st.integers(0, 10**6), st.floats(0.3, 1.0), st.sampled_from(["float32", "float64"]))
def test_without_input_every_state_shrinks_at_the_certified_rate(seed: int, gamma: float, dtype: str) -> None:
    model = contracting(seed, gamma, dtype)
    _, x = Weights(model).free_run(np.zeros((40, 2)), np.ones(1))
    norms = np.linalg.norm(x.astype(np.float64), axis=1)
    assert (norms[1:] <= gamma * norms[:-1] * (1 + 1e-6)).all()


@given(st.integers(0, 10**6), st.floats(0.3, 0.99))
def test_two_states_under_one_scheduling_approach_each_other(seed: int, gamma: float) -> None:
    model = contracting(seed, gamma)
    random = np.random.default_rng(seed)
    first, second = torch.tensor(random.standard_normal((2, 1, 3)))
    with torch.no_grad():
        for _ in range(20):
            W, V, *_ = model.matrices(torch.tensor(random.standard_normal((1, 3))))
            A = model.state_matrix(W, V)[0]
            before = torch.linalg.norm(first - second)
            first, second = first @ A.T, second @ A.T
            assert torch.linalg.norm(first - second) <= gamma * before
