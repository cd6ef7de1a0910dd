"""Quadratic stability does not bring trajectories together: a model of which both are shown."""

import numpy as np
import pytest
import torch
from nnss_cli.datasets.record import Record
from parting import parting_model, parting_pair

from nnss_cli.experiment.certificate import certify
from nnss_cli.training.fast import Weights


def test_trajectories_of_a_quadratically_stable_model_part() -> None:
    model = parting_model()
    points = torch.linspace(-50, 50, 20_001, dtype=torch.float64)[:, None]
    with torch.no_grad():
        W, V, *_ = model.matrices(points)
        assert model.state_matrix(W, V).abs().max() < 0.5 + 1e-9
    u, *pair = parting_pair(model)
    _, x = Weights(model).free_runs(np.repeat(u[:, :, None], 2, axis=2), np.zeros((1, 2)), np.stack(pair, axis=1))
    distance = np.abs(x[:, 0, 0] - x[:, 0, 1])
    assert distance[0] < 1.1e-3
    assert distance[-1] > 0.7


@pytest.mark.usefixtures("weak_adversary")
def test_its_certificate_promises_a_ball_and_nothing_more() -> None:
    record = Record(np.random.default_rng(0).uniform(-1, 1, (50, 1)), np.zeros((50, 1)), 1.0)
    found = certify(parting_model(), {"train": (record,)}, steps=500)
    assert found.broken == ()
    assert found.stability == "quadratic"
    assert found.invariant_radius is not None
