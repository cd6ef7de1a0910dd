"""Which gain a predictor takes, by scripted errors: good on the liveliest parts is not enough."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from nnss_cli.datasets.record import Record

from nnss_cli.validation import gain
from nnss_cli.validation.gain import SAMPLES

ON_PARTS = {0.0: 1.0, 1.0: 0.1, 2.0: 0.3}  # one-step error by K


def record(length: int) -> Record:
    u = np.random.default_rng(0).standard_normal((length, 1))
    return Record(u, u, 1.0)


@pytest.mark.parametrize(
    ("lost", "taken"), [((), "lively"), ((1.0,), "steady"), ((1.0, 2.0), "none")], ids=["none lost", "one", "both"]
)
@pytest.mark.parametrize("long", ["train", "val"])
def test_a_gain_that_is_lost_along_a_whole_record_is_not_taken(
    monkeypatch: pytest.MonkeyPatch, lost: tuple[float, ...], taken: str, long: str
) -> None:
    def judge(_: Any, K: np.ndarray, records: list[Record], w: int) -> tuple[np.ndarray, list[Any]]:
        del w
        whole = sum(map(len, records)) > SAMPLES
        return np.array([1e9 if whole and k in lost else ON_PARTS[float(k)] for k in K.ravel()]), []

    monkeypatch.setattr(gain, "_judge", judge)
    monkeypatch.setattr(gain, "_contraction", lambda *_: (0.5, 0.5))
    candidates = {name: np.full((1, 1), K) for name, K in (("none", 0.0), ("lively", 1.0), ("steady", 2.0))}
    lengths = {"train": 50, "val": 50} | {long: SAMPLES + 1}
    records = {name: [record(length)] for name, length in lengths.items()}
    data = records["train"], records["val"], 1
    found = gain._chosen(gain._judged(SimpleNamespace(), [(None, candidates)], *data), *data)  # type: ignore[arg-type]
    assert found.origin == taken


def test_an_observer_that_grows_along_training_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its errors on validation alone would have made it the first."""

    def judge(_: Any, K: np.ndarray, records: list[Record], w: int) -> tuple[np.ndarray, list[Any]]:
        del w
        path = np.zeros((len(records[0]), len(K), 1)), records[0].u
        return np.array([ON_PARTS[float(k)] for k in K.ravel()]), [path]

    monkeypatch.setattr(gain, "_judge", judge)
    F = {40: 0.5, 60: 2.5}  # growth by the length of the path: validation, training

    def jacobians(z: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.full((len(u), 1, 1), F[len(u)]), np.zeros((len(u), 1, 1))

    system = SimpleNamespace(size=1, jacobians=jacobians)
    candidates = {"none": np.zeros((1, 1)), "lively": np.ones((1, 1))}
    data = [record(60)], [record(40)], 1
    found = gain._chosen(gain._judged(system, [(None, candidates)], *data), *data)  # type: ignore[arg-type]
    assert found.origin == "none"
    assert found.rate == pytest.approx(2.5)
