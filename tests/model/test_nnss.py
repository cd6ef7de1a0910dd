"""The NN-SS model against its equations."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.baselines.schur import schur_matrix
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.errors import InputError
from nnss_cli.methods import load_model
from nnss_cli.model.architecture import SCHEDULING, Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.modelfile import write_model


def make(n: int = 2, r: int = 1, m: int = 1, seed: int = 0, **choices: object) -> NNSS:
    architecture = replace(Architecture(n, r, m, hidden=(7, 5), encoder=(4,), dtype="float64"), **choices)
    random = np.random.default_rng(seed)
    scaling = Scaling(random.standard_normal(r), 1 + random.random(r), random.standard_normal(m), 1 + random.random(m))
    channels = Channels(("u",) * r, ("y",) * m, ("V",) * r, ("m",) * m)
    model = NNSS(architecture, scaling, channels, 0.1)
    model.initialise(random)
    return model


def simulate_by_hand(model: NNSS, u: np.ndarray, y0: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The equations in NumPy, one sample after the other: the second implementation."""
    a = model.architecture
    n, r, m = a.order, a.inputs, a.outputs
    weights = {name: value.numpy().astype(float) for name, value in model.state_dict().items()}

    def layers(prefix: str) -> list[tuple[np.ndarray, np.ndarray]]:
        indices = sorted({int(name.split(".")[1]) for name in weights if name.startswith(prefix)})
        return [(weights[f"{prefix}.{i}.weight"], weights[f"{prefix}.{i}.bias"]) for i in indices]

    y0 = (y0 - weights["y_mean"]) / weights["y_std"]
    x = y0
    for weight, bias in layers("encoder"):
        x = weight @ x + bias
    previous = y0
    ys, xs = [], []
    for sample in (u - weights["u_mean"]) / weights["u_std"]:
        rho = np.concatenate([x] + [sample] * ("u" in a.scheduling) + [previous] * ("y" in a.scheduling))
        *hidden, (last_weight, last_bias) = layers("generator")
        for weight, bias in hidden:
            rho = 1 / (1 + np.exp(-(weight @ rho + bias)))
        theta = last_weight @ rho + last_bias
        W, V, B, C = np.split(theta, np.cumsum([4 * n * n, n * n, n * r]))
        A = schur_matrix(W.reshape(2 * n, 2 * n), V.reshape(n, n), a.gamma, a.epsilon)
        previous = C.reshape(m, n) @ x
        xs.append(x)
        ys.append(previous)
        x = A @ x + B.reshape(n, r) @ sample
    return np.array(ys) * weights["y_std"] + weights["y_mean"], np.array(xs)


@pytest.mark.parametrize("scheduling", SCHEDULING)
@pytest.mark.parametrize(("n", "r", "m", "gamma"), [(2, 1, 1, 1.0), (3, 2, 1, 0.7), (1, 1, 2, 1.0), (4, 5, 3, 0.95)])
def test_simulation_follows_the_equations(n: int, r: int, m: int, gamma: float, scheduling: str) -> None:
    model = make(n, r, m, scheduling=scheduling, gamma=gamma)
    random = np.random.default_rng(1)
    u, y0 = random.standard_normal((40, r)), random.standard_normal(m)
    simulation = model.simulate(u, y0)
    y, x = simulate_by_hand(model, u, y0)
    np.testing.assert_allclose(simulation.y, y, atol=1e-10)
    np.testing.assert_allclose(simulation.x, x, atol=1e-10)


@given(
    n=st.integers(1, 6),
    gamma=st.sampled_from([1.0, 0.9, 0.5]),
    scale=st.sampled_from([0.1, 1.0, 30.0]),
    seed=st.integers(0, 10**6),
)
def test_the_state_matrix_is_schur_at_every_state(n: int, gamma: float, scale: float, seed: int) -> None:
    model = make(n, gamma=gamma, seed=seed)
    x = torch.from_numpy(scale * np.random.default_rng(seed).standard_normal((20, n)))
    W, V, *_ = model.matrices(x)
    for w, v in zip(W.detach().numpy(), V.detach().numpy(), strict=True):
        assert np.abs(np.linalg.eigvals(schur_matrix(w, v, gamma))).max() < gamma


def test_a_batch_is_its_records_one_by_one() -> None:
    model = make(3, 2, 2)
    random = np.random.default_rng(0)
    u, y0 = torch.from_numpy(random.standard_normal((5, 30, 2))), torch.from_numpy(random.standard_normal((5, 2)))
    y, x = model(u, y0)
    for i in range(5):
        y_one, x_one = model(u[i : i + 1], y0[i : i + 1])
        torch.testing.assert_close(y_one[0], y[i], rtol=0, atol=1e-12)
        torch.testing.assert_close(x_one[0], x[i], rtol=0, atol=1e-12)


def test_gradcheck_through_a_simulation() -> None:
    model = make(2, 1, 1)
    u = torch.randn(2, 4, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    y0 = torch.randn(2, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    names, values = zip(*model.named_parameters(), strict=True)

    def run(*parameters: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(model, dict(zip(names, parameters, strict=True)), (u, y0))[0]

    assert torch.autograd.gradcheck(run, tuple(value.detach().clone().requires_grad_() for value in values))


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_saved_and_loaded_it_simulates_bit_identically(dtype: str, tmp_path: Path) -> None:
    model = make(3, 2, 1, dtype=dtype, scheduling="x+u")
    model.save(tmp_path)
    again = load_model(tmp_path)
    u, y0 = np.random.default_rng(0).standard_normal((100, 2)), np.array([0.3])
    np.testing.assert_array_equal(again.simulate(u, y0).y, model.simulate(u, y0).y)
    np.testing.assert_array_equal(again.simulate(u, y0).x, model.simulate(u, y0).x)
    assert again.channels == model.channels
    assert again.Ts == model.Ts


def test_initial_weights_do_not_depend_on_the_precision() -> None:
    single, double = make(dtype="float32"), make(dtype="float64")
    for (name, a), (_, b) in zip(single.named_parameters(), double.named_parameters(), strict=True):
        torch.testing.assert_close(a, b.float(), rtol=0, atol=0, msg=name)


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"gamma": 1.5}, "gamma"),
        ({"gamma": 0.0}, "gamma"),
        ({"epsilon": 0.0}, "epsilon"),
        ({"scheduling": "z"}, r"unknown scheduling 'z': choose from x, x\+u"),
        ({"dtype": "float16"}, "float32, float64"),
        ({"hidden": ()}, "hidden"),
        ({"encoder": (0,)}, "at least 1"),
    ],
)
def test_bad_choices_are_refused(choices: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(Architecture(2, 1, 1), **choices)


def test_damaged_model_files_are_refused(tmp_path: Path) -> None:
    model = make()
    model.save(tmp_path)
    tensors = tmp_path / "model.safetensors"
    tensors.write_bytes(tensors.read_bytes()[:-10])
    with pytest.raises(InputError, match="model.safetensors"):
        load_model(tmp_path)
    write_model(tmp_path, {"kind": "nnss"}, {})
    with pytest.raises(InputError, match="incomplete"):
        load_model(tmp_path)
    write_model(tmp_path, {"kind": "other"}, {})
    with pytest.raises(InputError, match="unknown kind"):
        load_model(tmp_path)
    (tmp_path / "model.json").write_text("{")
    with pytest.raises(InputError, match="model.json"):
        load_model(tmp_path)
    description, arrays = model.to_file()
    for name in ("u_std", "y_std"):
        write_model(tmp_path, description, arrays | {name: 0 * arrays[name]})
        with pytest.raises(InputError, match=f"{name}: expected deviations above 0, found 0"):
            load_model(tmp_path)
