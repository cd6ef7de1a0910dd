"""Sentences of the verdict, from checks made by hand."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.record import Channels

from nnss_cli.trained.simulate import Beyond
from nnss_cli.validation.linearisation import Linearisations, integrators
from nnss_cli.validation.verdict import _dynamics, _limit, verdict

FITTED = "90.0 % that a linear model reaches which is fitted to this very record"
COHERENT = "90.0 % that coherence leaves for linear relations, which need not be a model's ({})"
BEST = COHERENT.format("the best that was fitted reaches 1.4 %")
ELSEWHERE = "Those fitted to training data may be far below it: 'nnss compare' shows it."


@pytest.mark.parametrize(
    ("fit", "reached", "said"),
    [
        (95.0, 90.0, f"more than the {FITTED}: the nonlinearity pays."),
        (91.0, 88.5, f"near the {FITTED}. {ELSEWHERE}"),
        (80.0, 90.0, f"below the {FITTED}: there is something left to be had."),
        (80.0, 1.4, f"below the {BEST}: there may be something left to be had."),
        (91.0, 1.4, f"near the {BEST}. {ELSEWHERE}"),
        (80.0, None, f"below the {COHERENT.format('none was fitted')}: there may be something left to be had."),
    ],
)  # fmt: skip
def test_the_linear_limit_is_said_to_be_of_the_record_itself(fit: float, reached: float | None, said: str) -> None:
    """It is no result of a model that was fitted to training data, so that a fit near it is no sign of no gain; and
    what coherence alone tells is proved by no model."""
    each: Any = SimpleNamespace(name="y", fit_percent=fit, limit=90.0, reached=reached)
    assert list(_limit(each)) == [f"'y': the simulation fits {fit:.1f} %, {said}"]


def test_a_record_beyond_the_range_of_training_is_told_and_no_order_is_advised() -> None:
    beyond = Beyond("valve", "%", 6, 100, (40.0, 60.0), (10.0, 50.0))
    said = (
        "'valve' leaves the range of the records fitted to, 10 to 50, at 6 of 100 samples (40 to 60): no data speak "
        "for the model there."
    )
    coloured: Any = SimpleNamespace(
        name="y", depends=(SimpleNamespace(p_value=1e-9),), white=SimpleNamespace(p_value=0.5), simulation_depends=(),
        simulation_r1=0.0, limit=None, by_input=(None,), by_state=(),
    )  # fmt: skip
    steps: Any = SimpleNamespace(predicted=np.zeros((1, 1)), persistence=np.ones((1, 1)))
    named, linear = Channels(("valve",), ("y",), ("%",), ("",)), Linearisations((), (), np.ones(1), 1.0)
    for found, advice in (
        (beyond, "or it is the range that none was fitted to"),
        (replace(beyond, samples=5), "try order 4"),
    ):
        lines = verdict((coloured,), steps, (), 3, np.zeros((1, 3)), named, linear, 0, (found,))[1:]
        assert lines[0] == said.replace("at 6", f"at {found.samples}")
        assert lines[1] == f"'y': residuals are dependent on 'valve': dynamics are missing; {advice}."
        assert len(lines) == 2


@pytest.mark.parametrize(("r1", "worth"), [(0.19, False), (0.21, True), (-0.21, True)])
def test_errors_of_a_simulation_that_the_predictor_makes_up_for_are_told_from_a_fifth_on(
    r1: float, worth: bool
) -> None:
    white: Any = SimpleNamespace(
        name="y", depends=(SimpleNamespace(p_value=0.5),), white=SimpleNamespace(p_value=0.5), simulation_depends=(),
        simulation_r1=r1,
    )  # fmt: skip
    said = list(_dynamics(white, 1, "", Channels(("u",), ("y",), ("",), ("",))))
    assert [line.split(":")[1] for line in said] == [
        f" residuals are white, while the simulation's errors are coloured (r1 = {r1:.2f})"
    ] * worth


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
