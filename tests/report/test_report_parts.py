"""Parts of the report that are made without runs on disk: which files are shown, what a title and an axis say."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnss_cli.experiment.ablation import Variant
from nnss_cli.experiment.order import OrderRow
from nnss_cli.experiment.store import Store
from nnss_cli.report import build, comparison
from nnss_cli.report.aggregate import axes
from nnss_cli.report.dense import BINS, envelope, is_dense, rms, thinned
from nnss_cli.report.studies import write_study

HOUR = 3600


def test_a_page_shows_one_file_of_each_figure_a_png_where_there_is_one() -> None:
    files = [Path(f"a/{name}") for name in ("rmse.csv", "two.pdf", "one.svg", "two.svg", "one.png", "one.pdf")]
    assert [path.name for path in build._pictures(files)] == ["two.svg", "one.png"]
    assert build._pictures(files[:1]) == []


@pytest.mark.parametrize(("K", "Ts", "last", "unit"), [
    (3 * HOUR, 1.0, 3 * HOUR - 1, "s"), (3 * HOUR + 1, 1.0, 3.0, "h"), (4, 0.5, 1.5, "s"), (5, HOUR, 4.0, "h"),
])  # fmt: skip
def test_a_record_of_more_than_three_hours_is_told_in_hours(K: int, Ts: float, last: float, unit: str) -> None:
    time, found = comparison._time(K, Ts)
    assert (len(time), time[0], time[-1], found) == (K, 0.0, pytest.approx(last), unit)


def test_records_are_joined_and_their_beginnings_known() -> None:
    signals = {f"val/{i}/{name}": np.full((K, 1), i) for i, K in enumerate((3, 4, 5)) for name in ("y", "u")}
    signals |= {"valid/0/y": np.zeros((9, 1)), "val/9/y_sim": np.zeros((9, 1))}
    assert comparison.record_lengths(signals, "val") == [3, 4, 5]
    assert comparison.starts([3, 4, 5]) == [3, 7]
    assert comparison.starts([3]) == []
    assert comparison._records("val", [3]) == "validation record"
    assert comparison._records("a", [3, 4]) == "2 test a records, one after the other"


def test_seeds_are_counted_of_what_has_seeds_alone(result: Callable) -> None:
    def over(*runs: tuple[str, int]) -> str:
        return comparison._over_seeds([result(name, seed) for name, seed in runs])

    assert over(("nnss", 0), ("nnss", 1), ("nnss", 4)) == " over 3 seeds"
    assert over(("nnss", 5)) == " over 1 seed"
    assert over(("ssest", 0)) == ""
    assert over(("nnss", 0), ("ssest", 0)) == " over 1 seed; of methods without seeds one run"
    # a method that is not installed here has seeds when any but 0 was run
    assert over(("mine", 0), ("mine", 3)) == " over 2 seeds"
    assert over(("mine", 0)) == ""
    assert over(("mine", 0), ("mine", 1), ("theirs", 0)) == " over 2 seeds; of methods without seeds one run"


def test_a_list_is_told_only_where_it_has_lines() -> None:
    assert build._listed("Missing", ["a", "b"]) == ["Missing:\n\n- a\n- b"]
    assert build._listed("Missing", []) == []


def test_a_study_names_its_switch_unit_and_seeds(result: Callable, tmp_path: Path) -> None:
    store = Store(tmp_path / "out", "plant", "own")
    store.folder.mkdir(parents=True)
    several = [
        Variant("plain", (result("nnss", 0), result("nnss", 3)), None),
        Variant("none", (result("nnss", 3),), None),
    ]
    text = write_study(store, "recipe", several).read_text(encoding="utf-8")
    assert (store.folder / "study-recipe.md").is_file()
    assert text.startswith(
        "# NN-SS on plant, protocol `own`: recipe\n\nRMSE, median over 2 seeds with its interval by order statistics: "
        "50.0% of such intervals hold. One switch at a time. Runs under `out/ablation/recipe/`.\n\n|"
    )
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line.startswith("|")]
    assert rows[0] == ["order", "variant", "runs", "train", "val", "test"]
    assert rows[2:] == [["2", "plain", "2/2", *["1 (1–1)"] * 3], ["2", "none", "1/1", "1", "1", "1"]]
    assert text.endswith("- none: nothing: the recipe has it so\n")
    (one,) = [replace(result("nnss", 0), channels={"outputs": ["a", "b"]})]
    text = write_study(store, "recipe", [Variant("plain", (one,), None)]).read_text(encoding="utf-8")
    assert "\n\nMean over outputs of RMSE/σ, of one seed. One switch" in text


def test_orders_are_written_with_the_suggested_one_marked(tmp_path: Path) -> None:
    rows = [OrderRow(1, 1.0, 0.5, 0.6), OrderRow(2, 0.25, 0.4, None)]
    files = build.write_orders(rows, 2, tmp_path, "RMSE/σ", "orders of plant")
    assert files == [tmp_path / "order.csv", tmp_path / "order.png"]
    assert all(path.stat().st_size for path in files)
    table = pd.read_csv(tmp_path / "order.csv")
    assert list(table.columns) == ["order", "hankel", "train", "val", "suggested"]
    assert list(table["suggested"]) == [False, True]
    assert list(table["order"]) == [1, 2]
    assert list(table["hankel"]) == [1.0, 0.25]
    assert table["val"].isna().tolist() == [False, True]


def test_channels_have_the_names_and_units_of_their_kind(result: Callable) -> None:
    channels = {"inputs": ["u", "v"], "outputs": ["y"], "input_units": ["V", "–"], "output_units": ["m"]}
    one = replace(result("nnss"), channels=channels)
    assert [str(axis) for axis in axes(one, "input")] == ["u [V]", "v"]
    assert [str(axis) for axis in axes(one, "output")] == ["y [m]"]
    assert comparison._title([one]) == "plant (protocol own)"


# the part of a record that a zoom shows


@pytest.mark.parametrize("at", [40, 500, 1100])
def test_a_zoom_holds_the_largest_range(at: int) -> None:
    y = np.zeros((1200, 1))
    y[at : at + 3, 0] = (1.0, -1.0, 1.0)
    part = comparison.transient(y)
    assert part is not None
    assert part.start <= at
    assert at + 1 < part.stop
    assert part.stop - part.start == 100
    assert part.start >= 0


@pytest.mark.parametrize(("K", "length"), [(1920, 160), (1932, 160), (6000, 160), (1800, 150)])
def test_a_zoom_of_a_dense_record_shows_single_oscillations(K: int, length: int) -> None:
    part = comparison.transient(np.sin(np.arange(K) / 2)[:, None])
    assert part is not None
    assert part.stop - part.start == length


# long records on paper


@pytest.mark.parametrize(("K", "dense"), [(4 * BINS - 1, False), (4 * BINS, True)])
def test_a_signal_is_dense_from_four_samples_a_piece(K: int, dense: bool) -> None:
    assert is_dense(np.sin(np.arange(K) * 2.0)) is dense


@pytest.mark.parametrize(("ripple", "dense"), [(0.09, False), (0.13, True)])
def test_a_signal_is_dense_when_it_swings_by_a_tenth_of_its_range_in_most_pieces(ripple: float, dense: bool) -> None:
    K = 10 * BINS
    sawtooth = ripple * (np.arange(K) % 2)  # each piece swings by the ripple
    sawtooth[K // 2] = 1.0  # the range is one
    assert is_dense(sawtooth) is dense


def test_an_envelope_has_the_extremes_and_first_instant_of_each_piece() -> None:
    found = envelope(np.arange(10.0, 17.0), np.array([3.0, 1.0, 2.0, 9.0, 7.0, 5.0, 6.0]), bins=3)
    assert found.time.tolist() == [10.0, 12.0, 14.0]
    assert found.low.tolist() == [1.0, 2.0, 5.0]
    assert found.high.tolist() == [3.0, 9.0, 7.0]


def test_missing_samples_hide_no_others_and_leave_a_gap() -> None:
    y = np.array([3.0, np.nan, 2.0, np.nan, np.nan, 5.0, 6.0])
    found = envelope(np.arange(7.0), y, bins=3)
    np.testing.assert_array_equal(found.low, [3.0, 2.0, 5.0])
    t, y = np.arange(12.0), np.array([0.0, 1, np.nan, np.nan, 9, 2, 3, 4, -7, 5, 6, 7])
    time, line = thinned(t, y, bins=3)
    assert time.tolist() == [0, 1, 2, 4, 5, 8, 11]
    np.testing.assert_array_equal(line, y[time.astype(int)])


def test_a_thinned_line_keeps_ends_and_extremes_in_order() -> None:
    t, y = np.arange(12.0), np.array([5.0, 4, 3, 9, 2, 1, 7, 8, 0, 6, 6, 5])
    time, line = thinned(t, y, bins=3)
    assert time.tolist() == [0.0, 2.0, 3.0, 5.0, 7.0, 8.0, 9.0, 11.0]
    assert line.tolist() == [5.0, 3.0, 9.0, 1.0, 8.0, 0.0, 6.0, 5.0]
    assert thinned(t, y, bins=6)[0] is t  # twice as many samples as pieces
    assert len(thinned(t, y, bins=5)[0]) < len(t)
    assert np.diff(thinned(t, np.zeros(12), bins=3)[0]).min() > 0  # a flat piece has one sample, once


def test_root_mean_squares_are_by_pieces() -> None:
    time, values = rms(np.arange(5.0), np.array([3.0, 4.0, 1.0, 1.0, 1.0]), bins=2)
    assert time.tolist() == [0.0, 2.0]
    assert values == pytest.approx([np.sqrt(12.5), 1.0])
    time, values = rms(np.arange(400.0), np.full(400, -2.0))
    assert (len(time), time[-1]) == (BINS // 3, 395.0)
    assert values == pytest.approx(np.full(BINS // 3, 2.0))


def test_a_box_plot_is_given_each_splits_own_errors(result: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []
    monkeypatch.setattr(comparison.figures, "draw_boxplot", lambda *args: given.append(args))
    one = result("nnss", tests=("a", "b", "c"))
    scores = tuple(replace(score, rmse=float(i)) for i, score in enumerate(one.scores))
    comparison._boxplot([replace(one, scores=scores), result("ssest", order=3, tests=("b",), error=9.0)])
    ((values, labels, _, titles, _),) = given
    assert values == {
        "a/y1": {"nnss": {2: [2.0]}}, "b/y1": {"nnss": {2: [3.0]}, "ssest": {3: [9.0]}}, "c/y1": {"nnss": {2: [4.0]}},
    }  # fmt: skip
    assert labels == dict.fromkeys(values, "RMSE [m]")
    assert titles == {"a/y1": "test a", "b/y1": "test b", "c/y1": "test c"}
