"""Certificates: what they promise holds, what is broken is said, and Schur alone is not enough."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.schur import schur_inverse
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.experiment.certify import certify, common_lyapunov
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.training.fast import Weights

UNIT = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
CHANNELS = Channels(("u",), ("y",), ("",), ("",))

# ρ is 0 for both, and 4 for their product
SWITCHED = np.array([[0.0, 2.0], [0.0, 0.0]]), np.array([[0.0, 0.0], [2.0, 0.0]])
# ρ is 0 and 0.71; the state grows by 1.74 a sample where the second rules for x1 > 0 and the first elsewhere
BY_STATE = np.array([[0.0, 2.0], [0.0, 0.0]]), np.array([[-1.0, -1.0], [1.5, 1.0]])


def switching(stability: str, gamma: float = 1.0) -> NNSS:
    """An NN-SS model whose A(x) is BY_STATE[0] for x1 ≪ 0 and BY_STATE[1] for x1 ≫ 0, if it is Schur."""
    a = Architecture(2, 1, 1, hidden=(1,), encoder=(2,), dtype="float64", stability=stability, gamma=gamma)
    model = NNSS(a, UNIT, CHANNELS, 1.0)
    ends = [np.concatenate([np.ravel(part) for part in (*schur_inverse(A), [0.1, 0.1], [1.0, 0.0])]) for A in BY_STATE]
    with torch.no_grad():
        model.generator[0].weight.copy_(torch.tensor([[1e3, 0.0]]))
        model.generator[2].weight.copy_(torch.from_numpy(ends[1] - ends[0])[:, None])
        model.generator[2].bias.copy_(torch.from_numpy(ends[0]))
        model.encoder[0].weight.copy_(torch.tensor([[1.0], [0.0]]))
        model.encoder[1].weight.copy_(torch.eye(2))
        model.encoder[1].bias.copy_(torch.tensor([0.0, 0.3]))
    return model


def record(K: int = 60) -> Record:
    random = np.random.default_rng(0)
    return Record(random.uniform(-1, 1, (K, 1)), np.ones((K, 1)) + 0.1 * random.standard_normal((K, 1)), 1.0)


def random_model(seed: int, stability: str, gamma: float, scale: float = 3.0) -> NNSS:
    a = Architecture(3, 1, 1, (8,), (4,), dtype="float64", stability=stability, gamma=gamma)
    model = NNSS(a, UNIT, CHANNELS, 1.0)
    model.initialise(np.random.default_rng(seed))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(scale)
    return model


def test_products_of_schur_matrices_can_grow() -> None:
    for A in (*SWITCHED, *BY_STATE):
        assert np.abs(np.linalg.eigvals(A)).max() < 0.75
    assert np.abs(np.linalg.eigvals(SWITCHED[0] @ SWITCHED[1])).max() == pytest.approx(4)


def test_a_schur_model_diverges_without_input_and_under_contraction_it_cannot() -> None:
    weights = Weights(switching("schur"))
    _, x = weights.free_run(np.zeros((60, 1)), np.ones(1))
    assert np.linalg.norm(x[-1]) > 1e12
    assert certify(switching("schur"), {"train": (record(),)}, steps=300, search_lyapunov=False).broken == ()  # ρ < 1

    model = switching("contraction", gamma=0.99)
    model.load_state_dict(switching("schur").state_dict())
    _, x = Weights(model).free_run(np.zeros((60, 1)), np.ones(1))
    norms = np.linalg.norm(x, axis=1)
    assert (norms[1:] <= 0.99 * norms[:-1]).all()
    found = certify(model, {"train": (record(),)}, steps=3000)
    assert found.broken == ()
    assert found.state_bound is not None
    assert max(run.state for run in found.stress) <= found.state_bound


@settings(max_examples=15)
@given(st.integers(0, 10**6), st.floats(0.5, 0.99), st.floats(0.5, 30))
def test_every_trajectory_stays_inside_the_printed_bound(seed: int, gamma: float, scale: float) -> None:
    model = random_model(seed, "contraction", gamma, scale)
    found = certify(model, {"train": (record(),)}, steps=2000)
    assert found.broken == ()
    assert found.box_norm < gamma
    assert found.state_bound is not None
    assert max(run.state for run in found.stress) <= found.state_bound
    _, x = Weights(model).free_run(np.random.default_rng(seed).uniform(-1, 1, (500, 1)) * found.input_bound, np.ones(1))
    assert np.linalg.norm(x, axis=1).max() <= found.state_bound + np.linalg.norm(x[0])


def test_a_broken_promise_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = NNSS.state_matrix
    monkeypatch.setattr(NNSS, "state_matrix", lambda self, W, V: 1.5 * sound(self, W, V))
    broken = certify(random_model(0, "contraction", 0.9), {"train": (record(),)}, steps=200).broken
    assert any("norm" in line and "0.9" in line for line in broken)


def test_an_unstable_model_is_seen_to_diverge() -> None:
    system = LinearStateSpace(np.array([[1.05]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    found = certify(LinearModel(system, UNIT, CHANNELS), {"train": (record(),)}, steps=40_000)
    assert found.lyapunov_rate is None
    assert all(np.isinf(run.state) for run in found.stress if run.input != "zero")
    assert found.broken == ()  # nothing was promised


def test_the_worst_input_of_a_linear_model_is_known() -> None:
    # one pole: the largest state under |u| ≤ 1 is b/(1 − a)
    system = LinearStateSpace(np.array([[0.9]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    found = certify(LinearModel(system, UNIT, CHANNELS), {"train": (record(),)}, steps=5000)
    (worst,) = (run.state for run in found.stress if run.input == "adversarial, held")
    assert worst == pytest.approx(10 * found.input_bound, rel=0.1)
    assert worst <= 10 * found.input_bound


def test_a_common_lyapunov_matrix_is_found_where_there_is_one() -> None:
    pytest.importorskip("cvxpy")
    text, rate = common_lyapunov(np.array(SWITCHED))
    assert rate is None
    assert "none" in text
    random = np.random.default_rng(0)
    T = random.standard_normal((3, 3))
    contracting = [0.8 * np.linalg.qr(random.standard_normal((3, 3)))[0] for _ in range(5)]
    text, rate = common_lyapunov(np.array([np.linalg.solve(T, A @ T) for A in contracting]))
    assert rate == pytest.approx(0.8, abs=2e-3)
    assert "says nothing" in text


def test_other_models_and_empty_data_are_refused() -> None:
    with pytest.raises(InputError, match="expected one NN-SS or linear model"):
        certify(object(), {"train": (record(),)})
    with pytest.raises(InputError, match="at least one record"):
        certify(random_model(0, "schur", 1.0), {"train": ()})


def test_the_command(nnss: Callable, tmp_path: Path) -> None:
    trained = nnss(
        "train", "twotank-sim", "--order", "2", "--stability", "contraction", "--gamma", "0.99", "--epochs", "2"
    )
    assert trained.code == 0, trained.err
    run = "results/twotank-sim/paper/runs/nnss-n2-s0"
    outcome = nnss("certify", run, "--steps", "500")
    assert outcome.code == 0, outcome.err
    assert "No promised bound is broken" in outcome.out
    found = json.loads(nnss("certify", run, "--steps", "500", "--json").out)
    assert found["state_bound"] > 0
    assert set(found["radius"]) == {"train", "val", "test"}

    csv = tmp_path / "mine.csv"
    names = json.loads(Path(run, "model.json").read_text())["channels"]
    columns = [*names["inputs"], *names["outputs"]]
    csv.write_text("\n".join([",".join(columns), *("1.0,2.0" for _ in range(20))]))
    assert nnss("certify", run, "--steps", "500", "--data", str(csv)).code == 0
    csv.write_text("a,b\n1,2\n")
    refused = nnss("certify", run, "--data", str(csv))
    assert refused.code == 2
    assert columns[0] in refused.err
    assert nnss("certify", "nowhere").code == 2
