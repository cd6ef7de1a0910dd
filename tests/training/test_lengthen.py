"""Windows that lengthen: Gauss–Newton over short stretches first, whose states the longer ones begin from."""

from dataclasses import replace

import numpy as np
import pytest
from nnss_cli.datasets.record import Channels, FittingData, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.training import attempt
from nnss_cli.training.candidates import ALTERNATIVES
from nnss_cli.training.fit import train_nnss
from nnss_cli.training.recipe import Recipe, recipe_of

SHORT = Recipe(
    hidden=(2,), encoder=(2,), dtype="float64", window=0, stride=1, batch=1, initial="linear", optimiser="gauss-newton",
    epochs=3, patience=100, consistency=0.0, lengthen="yes",
)  # fmt: skip


def spring(K: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """ẍ = u − 0.15 ẋ − x − 3 x³ under filtered noise, 2 % of a deviation on y, every 0.5 s."""
    random = np.random.default_rng(seed)
    u = np.convolve(random.standard_normal(K), np.ones(4) / 4, "same")
    x = v = 0.0
    y = np.empty(K)
    for k in range(K):
        y[k] = x
        for _ in range(10):
            v += 0.05 * (u[k] - 0.15 * v - x - 3 * x**3)
            x += 0.05 * v
    return u[:, None], (y + 0.02 * y.std() * random.standard_normal(K))[:, None]


def ringing(*lengths: int, val: int = 100, seed: int = 4003) -> FittingData:
    u, y = spring(sum(lengths) + val, seed)
    ends = np.cumsum((*lengths, val))
    *train, held = (Record(a, b, 0.5) for a, b in zip(np.split(u, ends[:-1]), np.split(y, ends[:-1]), strict=True))
    channels = Channels(("u",), ("y",), ("",), ("",))
    return FittingData("spring", "own", tuple(train), (held,), Scaling.of(tuple(train)), channels, 20)


@pytest.mark.system
def test_of_a_spring_that_rings_it_finds_the_optimum_that_a_whole_record_hides() -> None:
    """Of two seeds neither gets below 0.35 of a deviation without; with the windows both reach the noise of 0.02."""
    data, stuck = ringing(700, val=300), []
    best = recipe_of("best", {}, 2).replace(
        stability="schur", feedthrough="no", integrator="no", initial="feedback", epochs=60
    )
    for seed in (0, 1):
        without, found = (train_nnss(data, 2, seed, best.replace(lengthen=each)).train_loss for each in ("no", "yes"))
        stuck.append(min(without) ** 0.5 > 0.2)
        assert found[0] ** 0.5 < 0.05  # from its first step over the whole record on
        assert min(found) ** 0.5 < 0.03
    assert any(stuck)  # what it is about; which of them are is decided by rounding, too


@pytest.mark.system
def test_where_validation_decides_it_is_a_candidate_and_taken() -> None:
    data = ringing(700, val=300)
    best = recipe_of("best", {}, 2).replace(stability="schur", initial="feedback", lengthen="auto", epochs=60)
    found = train_nnss(data, 2, 0, best)
    plain, windows = (found.candidates[name] for name in ("as it is", ALTERNATIVES["lengthen"]))
    assert windows < 0.8 * plain
    assert "windows that lengthen taken: it lowers the validation error by more than 20%" in found.remarks


@pytest.mark.system
@pytest.mark.parametrize("changes", [{}, {"integrator": "yes"}, {"stability": "incremental"}])
def test_engines_agree(changes: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """On two records of uneven lengths, of which the windows leave out the ends."""
    monkeypatch.setattr(attempt, "LENGTHS", ((8, 1), (13, 1)))
    data, order = ringing(33, 27, val=30), 3 if "integrator" in changes else 2
    both = [
        train_nnss(data, order, 0, SHORT.replace(**changes, epochs=1, engine=engine))
        for engine in ("fast", "reference")
    ]
    fast, reference = (each.train_loss for each in both)
    np.testing.assert_allclose(fast, reference, rtol=1e-5)
    plain = train_nnss(data, order, 0, SHORT.replace(**changes, epochs=1, lengthen="no")).train_loss
    assert fast[0] != pytest.approx(plain[0], rel=1e-3)  # what it is about


def test_a_longer_window_begins_from_the_states_of_the_shorter(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each record its own, at the samples where it begins; and a whole record from its first."""
    seen: list[tuple[list[int], np.ndarray | None, list[np.ndarray]]] = []
    plain = attempt.gauss_newton

    def noting(engine: object, u: list, y: list, *rest: object) -> list[np.ndarray]:
        begin = rest[-1]
        states = plain(engine, u, y, *rest)
        seen.append(([len(window) for window in y], begin, [state.copy() for state in states]))
        return states

    monkeypatch.setattr(attempt, "gauss_newton", noting)
    train_nnss(ringing(131, 127), 2, 0, SHORT)
    (short, none, found), (longer, begin, later), (whole, first, _) = seen
    assert none is None
    assert (short, longer, whole) == ([20] * 12, [60] * 4, [131, 127])
    np.testing.assert_array_equal(begin, [found[0][0], found[3][0], found[6][0], found[9][0]])
    np.testing.assert_array_equal(first, [later[0][0], later[2][0]])


def test_records_too_short_for_two_windows_train_as_they_are() -> None:
    data = ringing(39, 60)
    with_windows, plain = (train_nnss(data, 2, 0, SHORT.replace(lengthen=each)) for each in ("yes", "no"))
    assert with_windows.train_loss == plain.train_loss


@pytest.mark.parametrize(
    "changes", [{"optimiser": "adam"}, {"optimiser": "lbfgs"}, {"window": 40}, {"scheduling": "x+y"}]
)
def test_where_nothing_can_lengthen_it_is_refused_and_no_candidate(changes: dict) -> None:
    with pytest.raises(InputError, match="lengthen: expected gauss-newton on whole records") as error:
        SHORT.replace(**changes)
    assert "\n" not in str(error.value)
    assert "lengthen" not in SHORT.replace(**changes, lengthen="auto").alternatives(500)
    assert "lengthen" in SHORT.replace(lengthen="auto").alternatives(500)


def test_a_choice_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="lengthen"):
        replace(SHORT, lengthen="maybe")


def test_a_cold_candidate_does_not_lengthen() -> None:
    recipe = recipe_of("best", {}, 4).replace(lengthen="auto")
    assert recipe.alternatives(100)["initial"]["lengthen"] == "no"
    lengthening = recipe.replace(lengthen="yes")
    assert lengthening.replace(**lengthening.alternatives(100)["initial"]).optimiser == "adam"
