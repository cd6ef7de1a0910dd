"""Sentences of the verdict, from checks made by hand."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.record import Channels

from nnss_cli.validation.linearisation import integrators
from nnss_cli.validation.verdict import _limit, verdict


@pytest.mark.parametrize(
    ("fit", "said"),
    [
        (95.0, "more than any linear model that was fitted to this very record (90.0 %): the nonlinearity pays."),
        (
            91.0,
            "near the 90.0 % that a linear model could reach if it were fitted to this very record. Those fitted to "
            "training data may be far below it: 'nnss compare' shows it.",
        ),
        (
            80.0,
            "below the 90.0 % that a linear model could reach if it were fitted to this very record: there is "
            "something left to be had.",
        ),
    ],
)
def test_the_linear_limit_is_said_to_be_of_the_record_itself(fit: float, said: str) -> None:
    """It is no result of a model that was fitted to training data, so that a fit near it is no sign of no gain."""
    each: Any = SimpleNamespace(name="y", fit_percent=fit, limit=90.0)
    assert list(_limit(each)) == [f"'y': the simulation fits {fit:.1f} %, {said}"]


def told(poles: list[list[complex]], integrating: int, without: tuple[str, ...] = ()) -> list[str]:
    linear: Any = SimpleNamespace(points=(), without=without)
    none: Any = SimpleNamespace(outputs=(), inputs=())
    return list(verdict((), none, (), 3, np.array(poles), none, linear, integrating)[1:])


def test_an_integrators_eigenvalues_are_its_choice_and_no_fault() -> None:
    chosen = (
        "The outputs integrate: 1 of 3 eigenvalues of A(x) are exactly 1, by choice (--integrator). What is promised "
        "of stability is of the LPV part before the sum."
    )
    poles: list[list[complex]] = [[0.5, 1.0, 0.9j], [1 + 1e-15, 0.5, 0.95]]
    lost = ("u = 1: expected an equilibrium", "u = 2: expected an equilibrium")
    drift = "No linearisation at equilibria: under a constant input the outputs drift, as an integrator's do."
    assert told(poles, 1, lost) == [chosen, drift]
    assert told(poles, 1) == [chosen]
    schur = "A(x) has an eigenvalue of modulus {} on the trajectory: the model is not Schur there."
    assert told([[0.5, 1.0, 1.25j]], 1) == [chosen, schur.format(1.25)]  # the LPV part's
    assert told(poles, 0, lost) == [schur.format(1), *(f"No linearisation: {each}." for each in lost)]


def test_integrators_are_the_outputs_of_a_model_that_has_them() -> None:
    known = Channels(("u",), ("a", "b"), ("",), ("", ""))
    for integrates in (True, False):
        model = SimpleNamespace(architecture=SimpleNamespace(integrator=integrates))
        for whole in (model, SimpleNamespace(members=(model,))):
            trained: Any = SimpleNamespace(model=whole, channels=known)
            assert integrators(trained) == 2 * integrates
    linear: Any = SimpleNamespace(model=object(), channels=known)
    assert integrators(linear) == 0
