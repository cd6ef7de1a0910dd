from collections.abc import Callable

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.baselines.statespace import LONG, LinearStateSpace, propagate


@given(n=st.integers(1, 8), K=st.sampled_from([1, 2, 63, 64, 65, 200, 1000, 1025]), seed=st.integers(0, 10**6))
def test_blocked_propagation_equals_the_plain_recursion(n: int, K: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    A = random.standard_normal((n, n))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    w, x0 = random.standard_normal((3, K, n)), random.standard_normal((3, n))
    x = propagate(A, w, x0)
    expected = x0.copy()
    for k in range(K):
        np.testing.assert_allclose(x[:, k], expected, rtol=1e-9, atol=1e-9)
        expected = expected @ A.T + w[:, k]
    np.testing.assert_allclose(x[:, K], expected, rtol=1e-9, atol=1e-9)


def test_machine_code_propagates_as_the_plain_recursion() -> None:
    random = np.random.default_rng(0)
    A = random.standard_normal((3, 3))
    A *= 0.95 / np.abs(np.linalg.eigvals(A)).max()
    w, x0 = random.standard_normal((2, LONG // 4, 3)), random.standard_normal((2, 3))
    x = propagate(A.T, np.concatenate([w, w], axis=1), x0)  # neither is contiguous
    expected = x0
    for k in range(LONG // 2):
        np.testing.assert_allclose(x[:, k], expected, rtol=1e-9, atol=1e-9)
        expected = expected @ A + w[:, k % w.shape[1]]


def test_states_decay_to_zero_without_subnormal_numbers() -> None:
    """Which take twenty times as long, for as many samples as there are."""
    x = propagate(np.array([[0.5, 0.1], [0.0, 0.4]]), np.zeros((LONG, 2)), np.ones(2))
    assert not x[-1].any()
    assert np.abs(x[x != 0]).min() > 1e-260


def test_simulation_agrees_with_python_control(system: Callable) -> None:
    model = LinearStateSpace(*system(3, 2, 2, 1), 0.1)
    u, x0 = np.random.default_rng(0).standard_normal((300, 2)), np.array([1.0, -1, 2])
    y, x = model.simulate(u, x0)
    reference = control.forced_response(model.to_control(), inputs=u.T, initial_state=x0, T=np.arange(300) * 0.1)
    np.testing.assert_allclose(y, reference.outputs.T, atol=1e-12)
    np.testing.assert_allclose(x, reference.states.T, atol=1e-12)
    back = LinearStateSpace.from_control(model.to_control())
    np.testing.assert_array_equal(back.A, model.A)
    assert back.Ts == 0.1
    with pytest.raises(ValueError, match="continuous"):
        LinearStateSpace.from_control(control.ss(-1, 1, 1, 0))


def test_markov_parameters_do_not_depend_on_the_basis(system: Callable) -> None:
    model = LinearStateSpace(*system(4, 2, 3, 2), 1.0)
    other = model.transform(np.random.default_rng(1).standard_normal((4, 4)))
    np.testing.assert_allclose(other.markov(10), model.markov(10), atol=1e-9)
    impulse = np.zeros((10, 2))
    impulse[0, 0] = 1
    np.testing.assert_allclose(model.simulate(impulse, np.zeros(4))[0], model.markov(10)[:, :, 0], atol=1e-12)


def test_the_state_from_one_output_explains_it(system: Callable) -> None:
    model = LinearStateSpace(*system(4, 1, 2, 3), 1.0)
    y0, u0 = np.array([1.0, -2.0]), np.array([0.5])
    np.testing.assert_allclose(model.C @ model.state_from_output(y0, u0) + model.D @ u0, y0)


@pytest.mark.parametrize("K", [1000, LONG])
def test_an_unstable_system_overflows_quietly(K: int) -> None:
    model = LinearStateSpace(np.array([[10.0]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    y, _ = model.simulate(np.ones((K, 1)), np.ones(1))
    assert not np.isfinite(y[-1])


def test_shapes_are_checked() -> None:
    with pytest.raises(ValueError, match="expected shapes"):
        LinearStateSpace(np.eye(2), np.ones((3, 1)), np.ones((1, 2)), np.zeros((1, 1)), 1.0)


def test_gains_and_hankel_singular_values_agree_with_python_control(system: Callable) -> None:
    model = LinearStateSpace(*system(4, 2, 3, 7), 0.1)
    np.testing.assert_allclose(model.dc_gain(), control.dcgain(model.to_control()), rtol=1e-9)
    P, Q = model.gramians()
    np.testing.assert_allclose(model.A @ P @ model.A.T - P + model.B @ model.B.T, 0, atol=1e-8)
    expected = np.sqrt(np.sort(np.linalg.eigvals(P @ Q).real)[::-1])
    np.testing.assert_allclose(model.hankel_singular_values(), expected, rtol=1e-8)
    integrator = LinearStateSpace(np.eye(1), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    assert np.isinf(integrator.dc_gain()).all()
    with pytest.raises(ValueError, match="stable"):
        integrator.gramians()


def test_balanced_truncation_keeps_what_matters(system: Callable) -> None:
    model = LinearStateSpace(*system(6, 2, 2, 8, radius=0.7), 1.0)
    full = model.balanced_truncation(6)
    np.testing.assert_allclose(full.markov(15), model.markov(15), atol=1e-9)
    P, Q = full.gramians()
    np.testing.assert_allclose(P, Q, atol=1e-7 * P.max())
    reduced = model.balanced_truncation(3)
    omitted = model.hankel_singular_values()[3:].sum()
    for frequency in np.linspace(0, np.pi, 50):  # the error bound: twice the sum of what was left out

        def response(m: LinearStateSpace, z: complex = np.exp(1j * frequency)) -> np.ndarray:
            return m.C @ np.linalg.solve(z * np.eye(m.order) - m.A, m.B)

        assert np.linalg.norm(response(model) - response(reduced), 2) <= 2 * omitted * (1 + 1e-9)
