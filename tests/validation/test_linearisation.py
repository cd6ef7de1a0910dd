"""Operating points, responses and poles against second computations: several inputs and outputs, feedthrough."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import scipy.signal
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.model.nnss import NNSS
from nnss_cli.trained import TrainedModel
from nnss_cli.validation.linearisation import linearisations, pole_map

A = np.array([[0.8, 0.3, 0.0], [-0.3, 0.8, 0.2], [0.0, 0.0, 0.4]])
B = np.array([[1.0, 0.0], [0.3, -0.5], [0.0, 1.0]])
C = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -1.0]])
D = np.array([[0.4, 0.0], [-0.3, 0.8]])
Ts = 0.25


def test_responses_are_those_of_the_physical_system() -> None:
    """By SciPy's simulation and the Fourier transform of its impulse response; one point stands for all."""
    scaling = Scaling(np.array([1.0, -2.0]), np.array([2.0, 0.5]), np.array([3.0, 0.0]), np.array([4.0, 0.1]))
    named = Channels(("u1", "u2"), ("y1", "y2"), ("–", "–"), ("–", "–"))
    trained = TrainedModel(LinearModel(LinearStateSpace(A, B, C, D, Ts), scaling, named))
    u = np.random.default_rng(0).standard_normal((200, 2))
    found = linearisations(trained, [Record(u, u, Ts)])
    (point,) = found.points
    S, V = scaling.y_std[:, None], scaling.u_std
    system = (A, B / V, S * C, S * D / V, Ts)
    _, steps = scipy.signal.dstep(system, n=len(point.step))
    np.testing.assert_allclose(point.step, np.stack(steps, axis=2), rtol=1e-9, atol=1e-12)
    _, impulses = scipy.signal.dimpulse(system, n=500)
    turns = np.outer(found.frequency * Ts, np.arange(500))
    G = np.einsum("fk,kmr->fmr", np.exp(-2j * np.pi * turns), np.stack(impulses, axis=2))
    np.testing.assert_allclose(point.magnitude, np.abs(G), rtol=1e-9)
    assert found.frequency[-1] == pytest.approx(0.5 / Ts)
    np.testing.assert_allclose(point.dc_gain, np.sum(impulses, axis=1).T, rtol=1e-9)
    np.testing.assert_allclose(point.step[-1], point.dc_gain, rtol=0.03)  # 1 % of the slowest mode is left
    np.testing.assert_allclose(np.sort_complex(point.poles), np.sort_complex(np.linalg.eigvals(A)))


def test_points_are_at_the_quantiles_of_all_records() -> None:
    """u1 takes each of 0 … 100 once, u2 = 10 u1, over two records; where there is no equilibrium it is said."""

    def linearise(u: Any) -> Any:
        if u[0] > 80:
            raise InputError("none at 90")
        return LinearStateSpace(A * (1 - u[0] / 100), B, C, D, Ts).to_control()

    trained: Any = SimpleNamespace(linearise=linearise, equilibrium=lambda u: SimpleNamespace(y=u + 1), Ts=Ts)
    values = np.random.default_rng(0).permutation(np.arange(101.0))[:, None]
    records = [Record(part, part, Ts) for part in np.split(values * [1.0, 10.0], [70])]
    found = linearisations(trained, records)
    np.testing.assert_allclose([point.u for point in found.points], [[10, 100], [50, 500]])
    np.testing.assert_allclose([point.y for point in found.points], [[11, 101], [51, 501]])
    assert found.without == ("none at 90",)


@pytest.mark.parametrize("scheduling", ["x", "x+u", "x+y", "x+u+y"])
def test_poles_are_those_of_the_frozen_matrix_along_each_record(neural: Callable[..., NNSS], scheduling: str) -> None:
    """At the state, the input and the output before of each sample, as the elementary system goes through them."""
    model = neural(scheduling, n=3, r=2, m=2)
    trained, random = TrainedModel(model), np.random.default_rng(1)
    records = [Record(*random.standard_normal((2, K, 2)), 0.1) for K in (40, 25)]
    found = pole_map(trained, records, [model.simulate(each.u, each.y[:1]) for each in records])
    expected = []
    for each in records:
        y, z = trained.system.simulate(each.u, trained.initial_state(each.u[:1], each.y[:1]))
        for k in range(len(each)):
            frozen = trained.matrices(z[k, :3], each.u[k], y[k - 1] if k else each.y[0])
            expected.append(np.linalg.eigvals(frozen.A))
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(np.stack(expected)), rtol=1e-6, atol=1e-9)
