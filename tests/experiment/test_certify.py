"""Certificates: what they promise holds, what is broken is said, and Schur alone is not enough."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from nnss_cli.baselines.linear_model import LinearModel
from nnss_cli.baselines.schur import schur_inverse
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.experiment.certificate import certify
from nnss_cli.experiment.certificate.lyapunov import common_lyapunov
from nnss_cli.experiment.certificate.systems import Neural
from nnss_cli.model.architecture import DTYPES, SCHEDULING, Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.report.certificates import certificate_rows
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


def random_model(
    seed: int, stability: str, gamma: float, scale: float = 3.0, scheduling: str = "x", dtype: str = "float64"
) -> NNSS:
    a = Architecture(3, 1, 1, (8,), (4,), scheduling, dtype=dtype, stability=stability, gamma=gamma)
    model = NNSS(a, UNIT, CHANNELS, 1.0)
    random = np.random.default_rng(seed)
    model.initialise(random)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.from_numpy(0.3 * random.standard_normal(tuple(parameter.shape)))).mul_(scale)
    return model


def from_output(y0: float, K: int = 60, low: float = -1.0, high: float = 1.0) -> Record:
    """A record that begins at this output."""
    random = np.random.default_rng(1)
    return Record(random.uniform(low, high, (K, 1)), np.full((K, 1), y0), 1.0)


def test_products_of_schur_matrices_can_grow() -> None:
    for A in (*SWITCHED, *BY_STATE):
        assert np.abs(np.linalg.eigvals(A)).max() < 0.75
    assert np.abs(np.linalg.eigvals(SWITCHED[0] @ SWITCHED[1])).max() == pytest.approx(4)


@pytest.mark.system
def test_a_schur_model_diverges_without_input_and_under_quadratic_it_cannot() -> None:
    weights = Weights(switching("schur"))
    _, x = weights.free_run(np.zeros((60, 1)), np.ones(1))
    assert np.linalg.norm(x[-1]) > 1e12
    assert certify(switching("schur"), {"train": (record(),)}, steps=0, search_lyapunov=False).broken == ()  # ρ < 1

    model = switching("quadratic", gamma=0.99)
    model.load_state_dict(switching("schur").state_dict())
    _, x = Weights(model).free_run(np.zeros((60, 1)), np.ones(1))
    norms = np.linalg.norm(x, axis=1)
    assert (norms[1:] <= 0.99 * norms[:-1]).all()
    found = certify(model, {"train": (record(),)}, steps=3000)
    assert found.broken == ()
    assert found.state_bound is not None
    assert max(run.state for run in found.stress) <= found.state_bound


BOUNDED = (
    st.integers(0, 10**6),
    st.floats(0.5, 0.99),
    st.floats(0.5, 30),
    st.sampled_from(SCHEDULING),
    st.sampled_from(DTYPES),
    st.lists(st.floats(-100, 100), min_size=1, max_size=4),
)


def check_bound(seed: int, gamma: float, scale: float, scheduling: str, dtype: str, starts: list[float]) -> None:
    model = random_model(seed, "quadratic", gamma, scale, scheduling, dtype)
    own = [from_output(y0) for y0 in starts]
    found = certify(model, {"train": tuple(own[:1]), "test": tuple(own[1:])}, steps=2000)
    assert found.broken == ()
    assert found.box_norm < gamma
    assert found.records == len(starts)
    assert found.state_bound is not None
    limit = found.state_bound * (1 + 1e-3 * (dtype == "float32"))
    assert max(run.state for run in found.stress) <= limit
    for each in own:
        u = np.random.default_rng(seed).uniform(-1, 1, (500, 1)) * found.input_bound
        _, x = Weights(model).free_run(u, each.y[0])
        assert np.linalg.norm(x, axis=1).max() <= limit


@pytest.mark.slow
@pytest.mark.usefixtures("weak_adversary")
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])  # the patch stays the same
@given(*BOUNDED)
def test_every_trajectory_stays_inside_the_printed_bound(
    seed: int, gamma: float, scale: float, scheduling: str, dtype: str, starts: list[float]
) -> None:
    check_bound(seed, gamma, scale, scheduling, dtype, starts)


@pytest.mark.slow
@given(*BOUNDED)
def test_forty_models_stay_inside_the_printed_bound_under_the_whole_adversary(
    seed: int, gamma: float, scale: float, scheduling: str, dtype: str, starts: list[float]
) -> None:
    check_bound(seed, gamma, scale, scheduling, dtype, starts)


@pytest.mark.system
@pytest.mark.usefixtures("weak_adversary")
@pytest.mark.parametrize("splits", [("train", "train"), ("train", "test")])
def test_the_bound_covers_the_initial_state_of_every_record(splits: tuple[str, str]) -> None:
    model = random_model(0, "quadratic", 0.5)
    near, far = from_output(0.0), from_output(1e4)
    given_records: dict[str, tuple[Record, ...]] = {}
    for name, own in zip(splits, (near, far), strict=True):
        given_records[name] = (*given_records.get(name, ()), own)
    alone, found = certify(model, {"train": (near,)}, steps=100), certify(model, given_records, steps=100)
    _, x = Weights(model).free_run(far.u, far.y[0])
    largest = float(np.linalg.norm(x, axis=1).max())
    assert alone.state_bound is not None
    assert found.state_bound is not None
    assert alone.state_bound < largest <= found.state_bound
    assert found.state[splits[1]] == pytest.approx(largest)
    assert found.initial_state == pytest.approx(float(np.linalg.norm(x[0])))
    assert all(run.state >= found.initial_state * (1 - 1e-9) for run in found.stress)  # they start from the worst
    assert found.holds_for == "x(0) = g(y(0)) of the 2 records given, inputs within their range"
    rows = {row[""]: row["found"] for row in certificate_rows(found)}
    assert found.holds_for in rows["certified sup‖x‖"]
    assert rows["invariant ball ‖x‖ ≤"] == f"{found.invariant_radius:.6g}"


def test_a_record_beyond_the_bound_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Neural, "output_bounds", lambda _: (0.0, 0.0, 0.0))
    model = random_model(1, "quadratic", 0.9)
    broken = certify(model, {"train": (from_output(0.0),), "test": (record(),)}, steps=0).broken
    assert any("along a record of 'train'" in line and "promised at most" in line for line in broken)


def test_the_bounds_of_B_and_C_count_biases_and_the_input_bound_is_the_corner() -> None:
    a = Architecture(2, 2, 1, (3,), (2,), dtype="float64", stability="quadratic", gamma=0.9)
    two = Scaling(np.zeros(2), np.ones(2), np.zeros(1), np.ones(1))
    model = NNSS(a, two, Channels(("u", "v"), ("y",), ("", ""), ("",)), 1.0)
    B, C = np.array([[3.0, -1.0], [0.5, 2.0]]), np.array([[1.0, -4.0]])
    with torch.no_grad():
        model.generator[2].bias[20:].copy_(torch.from_numpy(np.concatenate([B.ravel(), C.ravel()])))
    u = np.array([[-1.0, 0.5], [2.0, -3.0], [1.0, -1.0]])
    found = certify(model, {"train": (Record(u, np.ones((3, 1)), 1.0),)}, steps=0)
    assert found.B_bound == pytest.approx(np.linalg.norm(np.abs(B), 2))
    assert found.C_bound == pytest.approx(np.linalg.norm(C, 2))
    assert found.input_bound == pytest.approx(np.hypot(2, 3))
    assert found.invariant_radius == pytest.approx(found.B_bound * found.input_bound / 0.1)
    with torch.no_grad():
        model.generator[2].weight[20:24].copy_(torch.tensor(B.ravel())[:, None] * torch.tensor([1.0, -0.25, 0.5]))
    largest = np.abs(B) * 2.5  # 1 from the bias, 1 + ½ from the first and the third sigmoid at 1, the second at 0
    found = certify(model, {"train": (Record(u, np.ones((3, 1)), 1.0),)}, steps=0)
    assert found.B_bound == pytest.approx(np.linalg.norm(largest, 2))


def test_one_matrix_is_judged_exactly() -> None:
    # not a contraction in the Euclidean norm; D ≠ 0 moves x(0) = C⁺(y(0) − D u(0))
    A = np.array([[0.9, 5.0], [0.0, 0.5]])
    system = LinearStateSpace(A, np.ones((2, 1)), np.array([[1.0, 0.0]]), np.array([[2.0]]), 1.0)
    model = LinearModel(system, UNIT, CHANNELS)
    found = certify(model, {"train": (record(),)}, steps=200, search_lyapunov=False)
    assert found.lyapunov_rate == pytest.approx(0.9)
    assert "only one" in found.lyapunov
    assert "sampled" not in found.lyapunov
    simulated = model.simulate(record().u, record().y[0]).x
    assert found.initial_state == pytest.approx(float(np.linalg.norm(simulated[0])))
    assert found.state["train"] == pytest.approx(float(np.linalg.norm(simulated, axis=1).max()))
    assert not any("sampled" in row[""] for row in certificate_rows(found))


def test_a_broken_promise_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = NNSS.state_matrix
    monkeypatch.setattr(NNSS, "state_matrix", lambda self, W, V: 1.5 * sound(self, W, V))
    found = certify(random_model(0, "quadratic", 0.9), {"train": (record(),)}, steps=0)
    assert any("norm" in line and "0.9" in line for line in found.broken)
    assert found.statement("quadratic").status == "unknown"  # a norm alone refutes no Lyapunov function


def test_an_unstable_model_is_seen_to_diverge() -> None:
    system = LinearStateSpace(np.array([[1.05]]), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    found = certify(LinearModel(system, UNIT, CHANNELS), {"train": (record(),)}, steps=40_000)
    assert found.lyapunov_rate is None
    assert found.lyapunov.startswith("none: ρ(A) = 1.05")
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


@pytest.mark.system
@pytest.mark.usefixtures("weak_adversary")
def test_the_command(nnss: Callable, tmp_path: Path) -> None:
    trained = nnss(
        "train", "twotank-sim", "--order", "2", "--stability", "quadratic", "--gamma", "0.99", "--epochs", "2"
    )
    assert trained.code == 0, trained.err
    run = "results/twotank-sim/paper/runs/nnss-n2-s0"
    outcome = nnss("certify", run, "--steps", "500", "--budget", "0")
    assert outcome.code == 0, outcome.err
    assert "No promised bound is broken" in outcome.out
    found = json.loads(nnss("certify", run, "--steps", "500", "--budget", "0", "--json").out)
    assert found["state_bound"] > 0
    assert set(found["radius"]) == {"train", "val", "test"}

    csv = tmp_path / "mine.csv"
    names = json.loads(Path(run, "model.json").read_text())["channels"]
    columns = [*names["inputs"], *names["outputs"]]
    csv.write_text("\n".join([",".join(columns), *("1.0,2.0" for _ in range(20))]))
    assert nnss("certify", run, "--steps", "500", "--budget", "0", "--data", str(csv)).code == 0
    csv.write_text("a,b\n1,2\n")
    refused = nnss("certify", run, "--data", str(csv))
    assert refused.code == 2
    assert columns[0] in refused.err
    assert nnss("certify", "nowhere").code == 2


@pytest.mark.system
@pytest.mark.usefixtures("weak_adversary")
def test_of_an_integrators_model_the_lpv_part_is_promised_and_the_rest_is_not() -> None:
    plain = random_model(0, "quadratic", 0.9, scale=1.0)
    a = Architecture(3, 1, 1, (8,), (4,), dtype="float64", stability="quadratic", gamma=0.9, integrator=True)
    model = NNSS(a, UNIT, CHANNELS, 1.0)
    model.load_state_dict(
        plain.state_dict()
        | {n: v for n, v in model.state_dict().items() if any(own in n for own in ("drift", "step", "spread"))}
    )
    found, known = (certify(each, {"test": (record(),)}, steps=2000) for each in (model, plain))
    assert found.state_bound == known.state_bound
    assert not found.broken
    assert "outputs integrate" in certificate_rows(found)[0]["found"]
    assert "examined" not in [row[""] for row in certificate_rows(known)]
    held = model.simulate(np.ones((4000, 1)), np.ones(1)).y  # what no certificate speaks of: the output drifts for ever
    assert abs(held[-1, 0]) > 1.5 * abs(held[1000, 0]) > 0
