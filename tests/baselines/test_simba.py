from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from nnss_cli.baselines import simba as module
from nnss_cli.baselines.n4sid import n4sid
from nnss_cli.baselines.schur import EPSILON
from nnss_cli.baselines.simba import SimbaOptions, initial_parameters, loss_and_gradient, train_simba
from nnss_cli.baselines.statespace import LinearStateSpace, simulation_rms
from nnss_cli.datasets.record import Record

from nnss_cli.errors import InputError
from nnss_cli.iterative import named_random
from nnss_cli.model.schur import schur_matrix

QUICK = SimbaOptions(window=20, stride=5, batch=8, epochs=60, learning_rate=3e-3)


def plain_torch_loss(p: dict[str, torch.Tensor], u: torch.Tensor, y: torch.Tensor, gamma: float) -> torch.Tensor:
    """The equations one sample after the other: the second implementation."""
    A = schur_matrix(p["W"], p["V"], gamma, EPSILON)
    x = (y[:, 0] - u[:, 0] @ p["D"].T) @ torch.linalg.pinv(p["C"]).T
    total = torch.zeros((), dtype=torch.float64)
    for k in range(u.shape[1]):
        total = total + (x @ p["C"].T + u[:, k] @ p["D"].T - y[:, k]).square().sum()
        x = x @ A.T + u[:, k] @ p["B"].T
    return total / y.numel()


@pytest.mark.parametrize(("n", "r", "m", "L"), [(1, 1, 1, 5), (3, 1, 1, 80), (2, 2, 3, 10), (4, 5, 3, 70)])
@pytest.mark.parametrize("gamma", [1.0, 0.9])
def test_gradients_agree_with_autograd(n: int, r: int, m: int, L: int, gamma: float) -> None:
    random = np.random.default_rng(n)
    parameters = initial_parameters(None, n, r, m, gamma, random)
    u, y = random.standard_normal((6, L, r)), random.standard_normal((6, L, m))
    loss, gradient = loss_and_gradient(parameters, u.transpose(1, 2, 0).copy(), y.transpose(1, 2, 0).copy(), gamma)
    tensors = {name: torch.tensor(value, requires_grad=True) for name, value in parameters.items()}
    reference = plain_torch_loss(tensors, torch.tensor(u), torch.tensor(y), gamma)
    reference.backward()
    assert loss == pytest.approx(reference.item(), rel=1e-12)
    for name, tensor in tensors.items():
        scale = tensor.grad.abs().max().item()
        np.testing.assert_allclose(gradient[name], tensor.grad.numpy(), atol=1e-10 * max(scale, 1e-3), err_msg=name)


def data(system: Callable, noise: float = 0.05) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
    plant = LinearStateSpace(*system(2, 1, 1, seed=3, radius=0.8), 1.0)
    random = np.random.default_rng(0)
    records = []
    for K in (300, 150):
        u = random.standard_normal((K, 1))
        y, _ = plant.simulate(u, np.zeros(2))
        records.append(Record(u, y + noise * random.standard_normal(y.shape), 1.0))
    return (records[0],), (records[1],)


def test_it_starts_exactly_at_the_given_model(system: Callable) -> None:
    train, _ = data(system)
    start = n4sid(train, 2)
    parameters = initial_parameters(start, 2, 1, 1, 1.0, np.random.default_rng(0))
    A = schur_matrix(torch.tensor(parameters["W"]), torch.tensor(parameters["V"])).numpy()
    np.testing.assert_allclose(A, start.A, atol=1e-10)


@pytest.mark.parametrize("random_start", [False, True])
def test_training_lowers_the_loss_and_stays_stable(system: Callable, random_start: bool) -> None:
    train, val = data(system)
    start = None if random_start else n4sid(train, 2)
    fit = train_simba(train, val, 2, 0, QUICK, start)
    assert fit.history["train_loss"][-1] < fit.history["train_loss"][0]
    assert fit.system.spectral_radius() < 1
    assert simulation_rms(fit.system, val) == pytest.approx(min(fit.history["val_rmse"]), rel=1e-12)


def test_a_start_on_the_unit_circle_is_drawn_inside() -> None:
    start = LinearStateSpace(np.eye(1), np.ones((1, 1)), np.ones((1, 1)), np.zeros((1, 1)), 1.0)
    parameters = initial_parameters(start, 1, 1, 1, 1.0, np.random.default_rng(0))
    assert np.isfinite(parameters["W"]).all()


@pytest.mark.parametrize("bad", [{"start": "zero"}, {"epochs": 0}, {"learning_rate": 0.0}, {"gamma": 2.0}])
def test_bad_options_are_refused(bad: dict) -> None:
    with pytest.raises(InputError):
        SimbaOptions(**bad)


def test_training_is_adam_with_the_bias_corrected_by_the_epoch(system: Callable) -> None:
    """Against torch, mini-batch after mini-batch: moments by the step, their correction by the epoch's number."""
    train, val = data(system)
    options = replace(QUICK, epochs=4, start="random")
    fit = train_simba(train, val, 2, 3, options, None)
    starts = range(0, len(train[0]) - options.window + 1, options.stride)
    u, y = (
        torch.tensor(np.array([signal[s : s + options.window] for s in starts])) for signal in (train[0].u, train[0].y)
    )
    initial = initial_parameters(None, 2, 1, 1, options.gamma, named_random(3, "weights"))
    p = {name: torch.tensor(value, requires_grad=True) for name, value in initial.items()}
    moments = {name: (torch.zeros_like(value), torch.zeros_like(value)) for name, value in p.items()}
    shuffling = named_random(3, "shuffling")
    for epoch in range(1, options.epochs + 1):
        order, losses = shuffling.permutation(len(u)), []
        for chosen in (order[b : b + options.batch] for b in range(0, len(u) - options.batch + 1, options.batch)):
            loss = plain_torch_loss(p, u[chosen], y[chosen], options.gamma)
            gradients = torch.autograd.grad(loss, list(p.values()))
            losses.append(loss.item())
            for (name, value), g in zip(list(p.items()), gradients, strict=True):
                first, second = moments[name]
                first, second = first + 0.1 * (g - first), second + 0.001 * (g**2 - second)
                moments[name] = first, second
                corrected = (second / (1 - 0.999**epoch)).sqrt() + 1e-8
                moved = value - options.learning_rate * first / (1 - 0.9**epoch) / corrected
                p[name] = moved.detach().requires_grad_()
        assert fit.history["train_loss"][epoch - 1] == pytest.approx(np.mean(losses), rel=1e-8)


def test_the_best_validation_epoch_is_kept(system: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    train, val = data(system)
    for errors, best in (([3.0, 1.0, 2.0, 4.0], 2), ([3.0, 1.0], 2), ([4.0, 3.0, 2.0, 1.0], 4)):
        following = iter(errors)
        monkeypatch.setattr(module, "simulation_rms", lambda *_, following=following: next(following))
        fit = train_simba(train, val, 2, 0, replace(QUICK, epochs=len(errors)), None)
        assert (fit.best_epoch, fit.epochs) == (best, len(errors))
        if errors == [3.0, 1.0, 2.0, 4.0]:
            kept = fit.system
        elif best == 2:
            np.testing.assert_array_equal(fit.system.A, kept.A)
        else:
            assert (fit.system.A != kept.A).any()


def test_patience_counts_epochs_or_mini_batches(system: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    train, val = data(system)
    batches = ((300 - 20) // 5 + 1) // 8
    options = replace(QUICK, patience=20)
    for unit, waited in (("epochs", 20), ("steps", -(-20 // batches))):
        following = iter([1.0] + [2.0] * 100)  # the first epoch is the best
        monkeypatch.setattr(module, "simulation_rms", lambda *_, following=following: next(following))
        assert train_simba(train, val, 2, 0, replace(options, patience_unit=unit), None).epochs == 1 + waited
    with pytest.raises(InputError, match="unit of patience"):
        SimbaOptions(patience_unit="hours")


def test_its_patience_is_its_own_and_not_that_of_the_papers_nnss(small_data: Callable) -> None:
    from nnss_cli.methods import METHODS

    fitting = small_data().fitting
    assert METHODS["simba"].settings(fitting, 2, {"window": 20})["patience_unit"] == "epochs"
    assert METHODS["simba"].settings(fitting, 2, {"window": 20, "patience_unit": "steps"})["patience_unit"] == "steps"


def test_windows_of_two_lengths_weigh_by_their_samples(system: Callable) -> None:
    """One step from whole records of 100 and 200 samples: the loss is the mean over all 300."""
    train, val = data(system)
    records = train[0][:100], train[0][100:]
    options = replace(QUICK, window=0, epochs=1)
    fit = train_simba(records, val, 2, 0, options, None)
    parameters = initial_parameters(None, 2, 1, 1, options.gamma, named_random(0, "weights"))
    losses = [loss_and_gradient(parameters, r.u[:, :, None], r.y[:, :, None])[0] for r in records]
    assert fit.history["train_loss"][0] == pytest.approx((losses[0] + 2 * losses[1]) / 3, rel=1e-12)
