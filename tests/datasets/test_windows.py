import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.datasets.catalog import BENCHMARKS, robotarm, simulated, twotank
from nnss_cli.datasets.record import Record
from nnss_cli.datasets.windows import Windows, check_window, chosen_window, shortened, sliding_windows

from nnss_cli.errors import InputError
from nnss_cli.training.recipe import recipe_of


def counting(lengths: tuple[int, ...]) -> tuple[Record, ...]:
    """Records in which every sample has a number of its own."""
    starts = np.cumsum((0, *lengths))
    return tuple(Record(s + np.arange(K), -(s + np.arange(K)), 1.0) for s, K in zip(starts[:-1], lengths, strict=True))


def test_the_papers_window_counts(mirror: Path) -> None:
    tanks = twotank.load(mirror / "TwoTanksMatlab.mat", "paper").fitting.train
    arm = robotarm.load(mirror / "RobotArm.mat", "paper").fitting.train
    recipe = recipe_of("paper", BENCHMARKS["twotank"].presets, 3)
    u, _ = sliding_windows(tanks, recipe.window, recipe.stride)
    assert (len(u), u[0].shape) == (711, (80, 1))
    recipe = recipe_of("paper", BENCHMARKS["robotarm"].presets, 5)
    u, _ = sliding_windows(arm, recipe.window, recipe.stride)
    assert (len(u), u[0].shape) == (377, (100, 1))


def test_the_embedded_plant_has_the_papers_count() -> None:
    assert len(sliding_windows(simulated.load(None, "paper").fitting.train, 80, 2)[0]) == 711


def test_windows_are_the_samples_and_stay_inside_a_record() -> None:
    u, y = sliding_windows(counting((10, 5, 7)), L=5, stride=2)
    assert [window[:, 0].tolist() for window in u] == [list(range(s, s + 5)) for s in (0, 2, 4, 10, 15, 17)]
    for inputs, outputs in zip(u, y, strict=True):
        np.testing.assert_array_equal(outputs, -inputs)


@given(st.lists(st.integers(3, 40), min_size=1, max_size=5), st.integers(1, 9))
def test_whole_records_hold_every_sample_once(lengths: list[int], stride: int) -> None:
    u, y = sliding_windows(counting(tuple(lengths)), 0, stride)
    assert [len(window) for window in u] == lengths
    np.testing.assert_array_equal(np.concatenate(u)[:, 0], np.arange(sum(lengths)))
    np.testing.assert_array_equal(np.concatenate(y)[:, 0], -np.arange(sum(lengths)))


@pytest.mark.parametrize("refuse", [check_window, lambda records, L: sliding_windows(records, L, 1)])
def test_a_record_that_cannot_fill_a_window_is_refused_by_number(refuse: object) -> None:
    with pytest.raises(InputError, match=r"at most the 79 samples of training record 2 of 3, found 100; use --window"):
        refuse(counting((200, 79, 80)), 100)
    with pytest.raises(InputError, match="training record 1 of 2: expected at least 3 samples, found 2; leave it out"):
        refuse(counting((2, 9)), 0)
    refuse(counting((200, 79, 80)), 79)
    refuse(counting((200, 79, 80)), 0)


def test_a_usual_window_is_shortened_to_the_shortest_record_and_one_that_is_asked_for_is_not() -> None:
    records = counting((200, 79, 80))
    assert [chosen_window(records, usual, None, "simba") for usual in (0, 78, 79, 80)] == [0, 78, 79, 79]
    assert [chosen_window(records, 80, asked, "simba") for asked in (0, 3, 79)] == [0, 3, 79]
    told = (
        "simba: window: expected at most the 79 samples of training record 2 of 3, found 80; "
        "use --window 79 or less for all methods, --set simba.window=79 for it alone, or 0 for whole records"
    )
    with pytest.raises(InputError, match=f"^{re.escape(told)}$"):
        chosen_window(records, 80, 80, "simba")
    with pytest.raises(InputError, match="training record 1 of 1: expected at least 3 samples, found 2; leave it out"):
        chosen_window(counting((2,)), 80, None, "simba")


def test_only_a_window_that_had_to_be_shortened_is_remarked() -> None:
    records = counting((200, 79, 80))
    assert shortened(records, 79, 80) == ("windows of 79 samples, the shortest training record, where 80 are usual",)
    assert [shortened(records, *of) for of in ((79, 79), (40, 80), (0, 80), (0, 0))] == [(), (), (), ()]


@given(
    st.lists(st.integers(3, 6), min_size=1, max_size=12),
    st.sampled_from([np.float32, np.float64]),
    st.integers(0, 1),
    st.randoms(use_true_random=False),
)
def test_batches_are_the_chosen_windows_and_their_shares_of_the_samples(
    lengths: list[int], dtype: type, unscored: int, random: object
) -> None:
    u, y = sliding_windows(counting(tuple(lengths)), 0, 1)
    windows = Windows(u, y, dtype, unscored)
    assert len(windows) == len(lengths)
    chosen = np.array(random.sample(range(len(u)), random.randint(1, len(u))))
    batches = windows.batches(chosen)
    found = sorted(batch.u[:, 0, b].tolist() for batch in batches for b in range(batch.u.shape[2]))
    assert found == sorted(u[i][:, 0].tolist() for i in chosen)
    assert len({len(batch.u) for batch in batches}) == len(batches)
    scored = sum(lengths[i] - unscored for i in chosen)
    for batch in batches:
        np.testing.assert_array_equal(batch.y, -batch.u)
        assert batch.u.dtype == dtype
        assert batch.share == pytest.approx((len(batch.u) - unscored) * batch.u.shape[2] / scored)
    for i, window in enumerate(u):
        np.testing.assert_array_equal(windows.window(i)[0], window)


def test_windows_of_one_length_keep_their_order_and_count_fully() -> None:
    u, y = sliding_windows(counting((30,)), 10, 4)
    (batch,) = Windows(u, y).batches(np.array([4, 0, 2]))
    assert batch.share == 1.0
    np.testing.assert_array_equal(batch.u[0, 0], [16, 0, 8])
