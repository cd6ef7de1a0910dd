"""Runs made up for the report."""

from collections.abc import Callable

import pytest

from nnss_cli.experiment.run import RunResult, RunSpec, Score

CHANNELS = {"inputs": ["u"], "outputs": ["level"], "input_units": ["V"], "output_units": ["m"]}


@pytest.fixture
def result() -> Callable[..., RunResult]:
    """A run that is ok, with an error of 1 unless told, in every split."""

    def made(
        method: str,
        seed: int = 0,
        order: int = 2,
        tests: tuple[str, ...] = ("test",),
        error: float = 1.0,
        **spec: object,
    ) -> RunResult:
        scores = tuple(Score(split, "y1", error, 10 * error, 100 - error) for split in ("train", "val", *tests))
        about = {"dataset": "plant", "protocol": "own", "settings": {}, "data": "0"} | spec
        return RunResult(
            RunSpec(method=method, order=order, seed=seed, **about), "ok", "", scores, 1, 1.0, {}, {}, CHANNELS
        )

    return made
