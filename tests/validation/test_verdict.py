"""Sentences of the verdict, from checks made by hand."""

from types import SimpleNamespace
from typing import Any

import pytest

from nnss_cli.validation.verdict import _limit


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
