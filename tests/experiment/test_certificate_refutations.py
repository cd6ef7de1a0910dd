"""A refutation is a proof: what is refuted is false, whatever rounding and ill-conditioned eigenvalues do."""

import re
from typing import Any

import numpy as np
import pytest
import torch
from nnss_cli.baselines.statespace import LinearStateSpace
from nnss_cli.datasets.record import Channels, Record, Scaling

from nnss_cli.experiment.certificate import certify, lti
from nnss_cli.experiment.certificate import statements as say
from nnss_cli.experiment.certificate.systems import PROMISES, Neural
from nnss_cli.model.architecture import SCHEDULING, Architecture
from nnss_cli.model.nnss import NNSS

UNIT = Scaling(np.zeros(1), np.ones(1), np.zeros(1), np.ones(1))
CHANNELS = Channels(("u",), ("y",), ("",), ("",))


def jordan(n: int, pole: float, above: float, corner: float) -> np.ndarray:
    """T J T⁻¹, exact in float64: T of small whole numbers, J with powers of two; eigenvalues are pole + its n-th
    roots of above^(n − 1) corner."""
    J = pole * np.eye(n) + above * np.diag(np.ones(n - 1), 1)
    J[-1, 0] += corner
    T, back = np.eye(n), np.eye(n)
    for i in range(n - 1):
        shear = np.eye(n)
        shear[i + 1, i] = 1 + i % 2
        T, back = T @ shear.T @ shear, (2 * np.eye(n) - shear) @ (2 * np.eye(n) - shear).T @ back
    np.testing.assert_array_equal(T @ back, np.eye(n))
    return T @ J @ back


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_a_spectral_radius_lies_within_its_margin(n: int) -> None:
    """Of one block whose eigenvalues are as sensitive as any of its size, and of what lies around it."""
    for pole in (1.25, 0.5):
        for above in (2.0**-10, 1.0, 64.0):
            A = jordan(n, pole, above, 0.0)
            for corner in (0.0, 2.0**-30, 2.0**-15):
                off = np.abs(jordan(n, pole, above, corner) - A)
                exact = pole + (above ** (n - 1) * corner) ** (1 / n)
                radius, margin = lti.spectral_radius(A, off)
                assert radius - margin <= min(pole, exact) <= max(pole, exact) <= radius + margin
    for share in (1.0, 1e-3):  # eigenvalues that are far apart are known nearly as well as the entries
        A = np.diag(share * np.arange(1.0, n + 1)) + np.triu(np.ones((n, n)), 1) * share
        radius, margin = lti.spectral_radius(A, share * 1e-9)
        assert share * n == pytest.approx(radius, abs=1e-11)
        assert 1e-9 * share <= margin <= 1e-6 * share


def test_where_discs_overlap_no_eigenvalue_need_lie_in_the_outermost() -> None:
    nilpotent = np.array([[0.25, 0.25], [-0.25, -0.25]])
    off = np.abs(np.diag([1.0, 0.0]) - nilpotent)
    assert np.linalg.norm(off) < 1  # the disc about 1 does not reach 0
    radius, margin = lti.spectral_radius(np.diag([1.0, 0.0]), off)
    assert radius - margin <= 0


def test_an_inverse_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    inverse = np.linalg.inv
    monkeypatch.setattr(np.linalg, "inv", lambda T: 0.9 * inverse(T))
    radius, margin = lti.spectral_radius(np.diag([1.0, 0.5]))
    assert 0.1 <= radius - 1 + margin <= 0.3  # discs about 0.9
    monkeypatch.setattr(np.linalg, "inv", lambda T: -inverse(T))
    assert lti.spectral_radius(np.diag([1.0, 0.5])) == (1.0, np.inf)


def constant_model(A: np.ndarray, dtype: str = "float32") -> NNSS:
    """`--stability none` with three equal units, whose weights for A21 are no zeros, but sum to 0 exactly."""
    a = Architecture(2, 1, 1, (3,), (4,), dtype=dtype, stability="none")
    model = NNSS(a, UNIT, CHANNELS, 1.0)
    model.initialise(np.random.default_rng(0))
    one, other = (round(share * 2**23) / 2**23 for share in (0.1, 0.7))
    W = np.zeros((4, 4))
    W[:2, :2] = A
    with torch.no_grad():
        model.generator[0].weight.fill_(0.0)
        model.generator[0].weight[:, 0] = 0.37
        model.generator[2].weight.fill_(0.0)
        model.generator[2].weight[4] = torch.tensor([one, other, -one - other])
        model.generator[2].bias[:16] = torch.tensor(W.ravel())
        model.generator[2].bias[20:] = torch.tensor([0.0, 1e-9, 1.0, 0.0])
    return model


def certified(model: NNSS) -> Any:
    u = np.random.default_rng(0).uniform(-1, 1, (60, 1))
    return certify(
        model, {"train": (Record(u, model.simulate(u, np.zeros(1)).y, 1.0),)}, steps=0, search_lyapunov=False
    )


def test_what_rounding_brings_over_the_circle_is_not_refuted() -> None:
    """A = [p 2·10⁴; 0 0.999] at every x. In float32 A21 is not 0, and ρ(A) = 1.015 for p = 0.999."""
    pole = float(np.float32(0.999))
    model = constant_model(np.array([[pole, 2e4], [0.0, pole]]))
    with torch.no_grad():
        W, *_ = model.matrices(torch.linspace(-1, 1, 200)[:, None] * torch.ones(2))
    assert np.abs(np.linalg.eigvals(W[:, :2, :2].numpy())).max() > 1.01
    found = certified(model)
    frozen, quadratic = found.statement("frozen"), found.statement("quadratic")
    assert frozen.status == "sampled"
    assert frozen.value == found.box_radius == pytest.approx(pole, abs=1e-4)
    assert quadratic.status != "refuted"

    exact = float(np.float32(1.001))
    found = certified(constant_model(np.array([[exact, 2e4], [0.0, pole]])))
    for name in ("frozen", "quadratic"):
        refuted = found.statement(name)
        assert refuted.status == "refuted"
        radius, margin = map(float, re.findall(r"ρ\(A\) = (\S+) .* ± ([^,]+),", refuted.how)[0])
        assert abs(radius - exact) <= margin + 1e-8  # as printed
        assert 1e-12 < margin < 1e-4
    assert found.broken == ()  # nothing was promised


def test_one_on_the_circle_is_unknown() -> None:
    found = certified(constant_model(np.eye(2), "float64"))
    assert found.box_radius >= 1
    assert {found.statement(name).status for name in ("frozen", "quadratic")} == {"unknown"}


def test_a_linear_model_is_refuted_by_no_more_than_its_margin() -> None:
    """Four equal eigenvalues just inside the circle, which rounding spreads over it by a thousandth."""
    for pole, status in ((1 - 2.0**-24, "unknown"), (1.25, "refuted")):
        A = jordan(4, pole, 1.0, 0.0)
        assert lti.spectral_radius(A)[0] > 1
        found = say.of_one_matrix(LinearStateSpace(A, np.ones((4, 1)), np.ones((1, 4)), np.zeros((1, 1)), 1.0), 1.0)
        assert {statement.status for statement in found} == {status}
        assert len(found) == 4


@pytest.mark.parametrize("scheduling", SCHEDULING)
def test_the_matrix_that_is_enclosed_is_that_of_the_point(scheduling: str) -> None:
    for n, r, m in ((2, 1, 1), (3, 2, 2)):
        a = Architecture(n, r, m, (5,), (3,), scheduling, dtype="float64", stability="none")
        scaling = Scaling(np.zeros(r), np.ones(r), np.zeros(m), np.ones(m))
        channels = Channels(("u",) * r, ("y",) * m, ("",) * r, ("",) * m)
        model = NNSS(a, scaling, channels, 1.0)
        random = np.random.default_rng(n)
        model.initialise(random)
        neural = Neural(model)
        for rho in 3 * random.standard_normal((5, a.scheduling_size)):
            radius, margin = neural.proved_radius(rho)
            expected = np.abs(np.linalg.eigvals(neural.matrices(rho[None])[0])).max()
            assert margin < 1e-9
            assert radius == pytest.approx(expected, rel=1e-9)


def test_a_broken_promise_refutes_only_what_is_proved() -> None:
    """ρ(A) ≥ γ says nothing of 1, a norm nothing of Lyapunov functions; nor does either without a proof."""
    for name, proved, expected in (
        ("schur", (0.95, 1e-3), ("refuted", "unknown")),
        ("quadratic", (0.95, 1e-3), ("refuted", "unknown")),
        ("quadratic", (1.2, 0.1), ("refuted", "refuted")),
        ("quadratic", None, ("unknown", "unknown")),
        ("incremental", None, ("unknown", "unknown")),
        ("none", (1.2, 0.1), ("refuted", "refuted")),
    ):
        seen = say.Sampled(1.3, 1.4, None, "none found", proved)
        gamma, broken = 0.9, ("promised, and not kept",) * PROMISES[name].radius
        found = tuple(of(PROMISES[name], gamma, seen, broken) for of in (say.frozen, say.quadratic))
        assert tuple(each.status for each in found) == expected
        if proved is None:
            assert found[0].how == broken[0]
