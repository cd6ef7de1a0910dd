"""Windows that lengthen: Gauss–Newton over short stretches first, whose states the longer ones begin from."""

from dataclasses import replace

import numpy as np
import pytest
from nnss_cli.datasets.record import Channels, FittingData, Record, Scaling

from nnss_cli.errors import InputError
from nnss_cli.training import attempt, fit
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


@pytest.mark.parametrize(
    ("lengths", "share"), [((131, 127), 0.01), ((39,) * 7, 0.5)], ids=["no window is better by so much", "too short"]
)
def test_windows_that_no_record_needs_change_nothing_and_are_not_told(
    lengths: tuple[int, ...], share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempt, "HIDDEN", share)
    tried, plain = (train_nnss(ringing(*lengths), 2, 0, SHORT.replace(lengthen=each)) for each in ("auto", "no"))
    assert tried == replace(plain, model=tried.model)
    for name, weights in plain.model.state_dict().items():
        assert tried.model.state_dict()[name].equal(weights)


def test_one_is_taken_only_where_the_whole_records_fit_far_better_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """The windows found nothing, and the records are trained as its rival was: no less than its error."""
    data, auto = ringing(131, 127), SHORT.replace(lengthen="auto")
    monkeypatch.setattr(attempt.Attempt, "lengthen", lambda _: None)
    for share, validation, taken in ((0.5, 0.1, False), (9.0, 0.1, True), (9.0, 1.0, False)):
        monkeypatch.setattr(attempt, "HIDDEN", share)
        monkeypatch.setattr(fit, "pays", lambda *_, won=validation, **__: won < 0.8)
        assert (" taken: " in "".join(train_nnss(data, 2, 0, auto).remarks)) == taken


def test_a_recipe_that_lengthens_anyway_has_nothing_to_come_below(monkeypatch: pytest.MonkeyPatch) -> None:
    """A further candidate of it keeps its windows, however well the one before fits."""
    monkeypatch.setattr(attempt, "HIDDEN", 0.0)
    found = train_nnss(ringing(131, 127), 2, 0, SHORT.replace(scheduling="auto"))
    assert list(found.candidates) == ["as it is", "scheduling on u"]


@pytest.mark.parametrize(
    ("errors", "left", "bar", "within"),
    [
        ([1, 0.9, 0.8, 0.7, 0.6], 0, 0.1, True),  # too few to tell
        ([1, 0.9, 0.8, 0.7, 0.6, 0.5], 5, 0.26, True),
        ([1, 0.9, 0.8, 0.7, 0.6, 0.5], 5, 0.24, False),
        ([9, 1, 0.9, 0.8, 0.7, 0.6, 0.5], 5, 0.24, False),  # it is the last ones' pace that counts
        ([1, 0.9, 0.8, 0.7, 0.6, 0.5], 10, 0.126, True),
        ([1, 0.9, 0.8, 0.7, 0.6, 0.5], 10, 0.124, False),
        ([0.5] * 6, 99, 0.5, False),
        ([0.5] * 6, 0, 0.51, True),
        ([0.5] * 6, 0, np.inf, True),
    ],
)
def test_by_the_pace_of_five_iterations_an_error_is_in_reach(
    errors: list[float], left: int, bar: float, within: bool
) -> None:
    assert attempt.in_reach(np.square(errors).tolist(), left, bar) == within


def test_windows_that_will_not_come_so_low_end_early(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    plain = attempt.in_reach
    monkeypatch.setattr(attempt, "HIDDEN", 1e-5)
    monkeypatch.setattr(attempt, "in_reach", lambda losses, left, bar: seen.append(left) or plain(losses, left, bar))
    for rival in (1e3, 1e-3):  # below a rival's error; above it the windows may stand still for a while
        seen.clear()
        monkeypatch.setattr(attempt.Attempt, "fitted", property(lambda _, error=rival: error))
        train_nnss(ringing(131, 127), 2, 0, SHORT.replace(lengthen="auto", epochs=30))
        assert seen == list(range(29, 29 - len(seen), -1))
        assert (0 < len(seen) < 20) if rival > 1 else not seen


@pytest.mark.parametrize(("rival", "lengths"), [(0.10, [131, 20]), (0.16, [131, 20, 60]), (0.3, [131, 20, 60, 131])])
def test_each_length_must_end_below_half_of_a_rivals_error(
    rival: float, lengths: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of 20 samples begin at 0.59 and end at 0.070, those of 60 at 0.084; each length's own pace counts."""
    seen: list[int] = []
    plain, in_reach, heard = attempt.gauss_newton, attempt.in_reach, [0]

    def noting(engine: object, u: list, y: list, *rest: object) -> list[np.ndarray]:
        seen.append(len(y[0]))
        return plain(engine, u, y, *rest)

    def reached(losses: list[float], left: int, bar: float) -> bool:
        heard.append(len(losses))
        return in_reach(losses, left, bar)

    monkeypatch.setattr(attempt, "gauss_newton", noting)
    monkeypatch.setattr(attempt, "in_reach", reached)
    monkeypatch.setattr(attempt.Attempt, "fitted", property(lambda _: rival))
    found = train_nnss(ringing(131, 127), 2, 0, SHORT.replace(lengthen="auto", epochs=30))
    assert seen == lengths
    assert max(heard) <= 30
    assert (ALTERNATIVES["lengthen"] in found.candidates) == (len(lengths) == 4)


def test_windows_have_no_more_iterations_than_epochs_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []
    plain = attempt.gauss_newton

    def noting(engine: object, u: list, y: list, iterations: int, *rest: object) -> list[np.ndarray]:
        seen.append(iterations)
        return plain(engine, u, y, 1, *rest)

    monkeypatch.setattr(attempt, "gauss_newton", noting)
    for epochs in (3, 35):
        train_nnss(ringing(131, 127), 2, 0, SHORT.replace(epochs=epochs))
    assert seen == [3, 3, 3, 35, 30, 35]


def test_of_long_records_windows_are_of_their_beginnings(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[list[int]] = []
    plain = attempt.gauss_newton

    def noting(engine: object, u: list, y: list, iterations: int, *rest: object) -> list[np.ndarray]:
        seen.append([len(window) for window in y])
        return plain(engine, u, y, 1, *rest)

    monkeypatch.setattr(attempt, "gauss_newton", noting)
    monkeypatch.setattr(attempt, "WINDOWED", 150)
    train_nnss(ringing(200, 100), 2, 0, SHORT)
    train_nnss(ringing(100, 50), 2, 0, SHORT)
    assert seen == [[20] * 7, [200, 100], [20] * 7, [100, 50]]


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


def test_best_tries_it_and_the_papers_recipe_has_none() -> None:
    assert [recipe_of(name, {}, 2).lengthen for name in ("best", "paper")] == ["auto", "no"]


def test_a_choice_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match="lengthen"):
        replace(SHORT, lengthen="maybe")


def test_a_cold_candidate_does_not_lengthen() -> None:
    recipe = recipe_of("best", {}, 4).replace(lengthen="auto")
    assert recipe.alternatives(100)["initial"]["lengthen"] == "no"
    lengthening = recipe.replace(lengthen="yes")
    assert lengthening.replace(**lengthening.alternatives(100)["initial"]).optimiser == "adam"
