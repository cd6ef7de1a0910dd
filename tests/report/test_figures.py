"""The figures hold what they were given: which values, on which axes, under which name. Looks are left free."""

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch

from nnss_cli.report import figures
from nnss_cli.report.figures import (
    draw_boxplot,
    draw_orders,
    draw_ranks,
    save_figure,
)
from nnss_cli.report.style import STYLES, Axis, style_of
from nnss_cli.report.timeplots import draw_simulation, draw_states


@pytest.fixture
def kept() -> Iterator[Callable[[Figure], Figure]]:
    """Keeps a figure until the test ends."""
    opened: list[Figure] = []

    def keep(figure: Figure) -> Figure:
        opened.append(figure)
        return figure

    yield keep
    for figure in opened:
        figures.plt.close(figure)


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def colours(line: Line2D) -> str:
    return str(to_hex(line.get_color()))


def test_every_method_has_a_look_of_its_own_also_in_grey() -> None:
    for attribute in ("label", "colour", "line", "hatch", "marker"):
        assert len({getattr(style, attribute) for style in STYLES.values()}) == len(STYLES), attribute
    greys = sorted(
        sum(w * int(style.colour[i : i + 2], 16) for w, i in ((0.299, 1), (0.587, 3), (0.114, 5)))
        for style in STYLES.values()
    )
    assert greys[0] == 0
    assert greys[-1] < 200  # none vanishes on white paper
    assert style_of("a plug-in's").label == "a plug-in's"


def test_an_axis_names_its_unit_where_there_is_one() -> None:
    assert str(Axis("level", "m")) == "level [m]"
    assert str(Axis("level", "–")) == "level"


# box plots

SEEDS = {"nnss": {2: [1.0, 2.0, 3.0, 4.0, 10.0], 3: [0.5, 1.0, 1.5]}, "n4sid": {2: [2.5], 3: [0.9]}, "own": {3: [2.0]}}


def boxes(panel: Axes) -> list[PathPatch]:
    return [patch for patch in panel.patches if isinstance(patch, PathPatch)]


def extent(patch: PathPatch) -> tuple[float, float, float, float]:
    box = patch.get_path().get_extents()
    return box.x0, box.x1, box.y0, box.y1


def test_a_box_spans_the_quartiles_and_marks_the_median_of_the_seeds(kept: Callable) -> None:
    (panel,) = kept(draw_boxplot({"y": SEEDS}, {"y": "RMSE [m]"}, "x")).axes
    two, three = sorted(boxes(panel), key=lambda patch: extent(patch)[0])
    assert extent(two)[2:] == (2, 4)
    assert extent(three)[2:] == (0.75, 1.25)
    medians = [
        line.get_ydata()[0] for line in panel.lines if len(set(line.get_xdata())) == 2 and len(line.get_xdata()) == 2
    ]
    assert {3.0, 1.0} <= set(medians)
    fliers = [line for line in panel.lines if line.get_marker() == "o" and line.get_linestyle() == "None"]
    assert [list(line.get_ydata()) for line in fliers] == [[10.0], []]


def test_boxes_of_an_order_stand_side_by_side_around_its_tick_in_the_methods_order(kept: Callable) -> None:
    sample = {2: [1.0, 2.0, 4.0], 5: [1.0, 3.0, 9.0]}
    (panel,) = kept(draw_boxplot({"y": {"nnss": sample, "simba": sample, "n4sid": sample}}, {"y": "RMSE"}, "x")).axes
    spans = sorted(extent(patch)[:2] for patch in boxes(panel))
    centres = [(low + high) / 2 for low, high in spans]
    assert np.mean(centres[:3]) == pytest.approx(0)
    assert np.mean(centres[3:]) == pytest.approx(1)
    assert np.diff(centres[:3]) == pytest.approx([0.8 / 3] * 2)
    assert all(first[1] < second[0] for first, second in itertools.pairwise(spans))
    found = {round(extent(patch)[0], 6): to_hex(patch.get_facecolor()) for patch in boxes(panel)}
    expected = [style_of(name).colour.lower() for name in ("nnss", "simba", "n4sid")] * 2
    assert [found[round(low, 6)] for low, _ in spans] == expected
    assert [patch.get_hatch() or "" for patch in boxes(panel)][::2] == ["", "//", "\\\\"]
    low, high = panel.get_xlim()
    assert low < spans[0][0]
    assert high > spans[-1][1]
    assert low > -0.7
    assert high < 1.7  # nothing is lost in an empty margin
    assert [label.get_text() for label in panel.get_xticklabels()] == ["2", "5"]
    assert (panel.get_yscale(), panel.get_xlabel(), panel.get_ylabel()) == ("log", "order n", "RMSE")


def test_a_method_without_spread_is_a_marker_at_its_median_over_its_range(kept: Callable) -> None:
    flat = {"nnss": {2: [1.0, 5.0, 20.0]}, "n4sid": {2: [3.0, 3.001, 3.01]}}
    figure = kept(draw_boxplot({"y": flat}, {"y": "RMSE"}, "the title"))
    (panel,) = figure.axes
    assert len(boxes(panel)) == 1
    (marker,) = (line for line in panel.lines if line.get_marker() == style_of("n4sid").marker)
    assert list(marker.get_ydata()) == [3.001]
    assert colours(marker) == style_of("n4sid").colour.lower()
    (around,) = (line for line in panel.lines if list(line.get_ydata()) == [3.0, 3.01])
    assert [*around.get_xdata(), *marker.get_xdata()] == pytest.approx([0.2] * 3)
    assert legend(figure) == ["NN-SS", "N4SID"]
    assert figure.get_suptitle() == "the title"
    first, second = figure.legends[0].legend_handles
    assert isinstance(first, Patch)
    assert isinstance(second, Line2D)
    assert second.get_marker() == style_of("n4sid").marker


@pytest.mark.parametrize(("quartiles", "boxed"), [(1.045, False), (1.05, True)])
def test_a_box_is_drawn_when_it_is_a_fiftieth_of_the_panel_high(quartiles: float, boxed: bool, kept: Callable) -> None:
    # a panel of one decade: 2 % of it are a ratio of 1.0471
    by_method = {"nnss": {2: [1.0, 10.0]}, "simba": {2: [2.0, 2.0, 2 * quartiles, 2 * quartiles]}}
    (panel,) = kept(draw_boxplot({"y": by_method}, {"y": "RMSE"}, "x")).axes
    assert len(boxes(panel)) == 1 + boxed


def test_each_output_has_a_panel_and_one_legend_serves_all(kept: Callable) -> None:
    values = {"y1": SEEDS, "y2": {"nnss": {4: [1.0, 2.0]}, "ssest": {4: []}}}
    figure = kept(draw_boxplot(values, {"y1": "RMSE [m]", "y2": "RMSE [V]"}, "x"))
    assert [panel.get_ylabel() for panel in figure.axes] == ["RMSE [m]", "RMSE [V]"]
    assert [[t.get_text() for t in panel.get_xticklabels()] for panel in figure.axes] == [["2", "3"], ["4"]]
    assert legend(figure) == ["NN-SS", "N4SID", "own", "SSEST"]
    assert figure.get_figwidth() > kept(draw_boxplot({"y1": SEEDS}, {"y1": "RMSE"}, "x")).get_figwidth()


def test_equal_errors_and_no_run_at_all_are_drawn(kept: Callable) -> None:
    figure = kept(draw_boxplot({"y": {"nnss": {2: [1.0, 1.0]}, "simba": {2: []}}}, {"y": "RMSE"}, "x"))
    figure.canvas.draw()
    assert len(figure.axes[0].lines) == 2


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (1.0, 100.0, [1, 3, 10, 30, 100]),
        (1.0, 21.0, [1, 2, 5, 10, 20]),
        (1.0, 19.0, [1, 2, 5, 10]),
        (1.0, 3.1, [1, 1.5, 2, 2.5, 3]),
        (1.0, 2.9, [1, 1.5, 2, 2.5]),
        (2.0, 3.1, [2, 2.5, 3]),
        (5.0, 9.0, [5, 6, 7, 8, 9]),
    ],
)
def test_a_logarithmic_axis_has_a_few_plain_numbers(
    low: float, high: float, ticks: list[float], kept: Callable
) -> None:
    figure = kept(figures.plt.figure())
    panel = figure.subplots()
    panel.set_yscale("log")
    panel.set_ylim(low, high)
    figures.few_log_ticks(panel.yaxis)
    figure.canvas.draw()
    shown = [tick for tick in panel.get_yticks() if low <= tick <= high]
    assert shown == pytest.approx(ticks)
    assert [label.get_text() for label in panel.get_yticklabels() if low <= label.get_position()[1] <= high] == [
        f"{tick:g}" for tick in ticks
    ]
    assert not any(label.get_text() for label in panel.get_yticklabels(minor=True))


# curves over time

TIME = np.arange(6) * 0.5
MEASURED = np.arange(12.0).reshape(6, 2)
AXES = (Axis("level", "m"), Axis("flow", "–"))


def test_measured_and_simulated_outputs_stand_over_each_other_by_output(kept: Callable) -> None:
    simulated = {"nnss": ("(n = 2)", MEASURED + 0.1), "own": ("(n = 3)", MEASURED - 1)}
    figure = kept(draw_simulation(TIME, MEASURED, simulated, AXES, "s", "a title", breaks=(2, 4)))
    top, low = figure.axes
    for i, panel in enumerate((top, low)):
        measured, nnss, own, *parted = panel.lines
        for line, y in ((measured, MEASURED), (nnss, MEASURED + 0.1), (own, MEASURED - 1)):
            np.testing.assert_array_equal(line.get_xdata(), TIME)
            np.testing.assert_array_equal(line.get_ydata(), y[:, i])
        assert [line.get_xdata()[0] for line in parted] == [1.0, 2.0]  # another record begins
        assert colours(nnss) == style_of("nnss").colour.lower()
        assert len({colours(line) for line in (measured, nnss, own)}) == 3
    assert [panel.get_ylabel() for panel in (top, low)] == ["level [m]", "flow"]
    assert [panel.get_xlabel() for panel in (top, low)] == ["", "time [s]"]
    assert legend(figure) == ["measured", "NN-SS (n = 2)", "own (n = 3)"]
    assert figure.get_suptitle() == "a title"
    assert not top.patches


def test_a_zoom_shows_its_part_and_where_it_is(kept: Callable) -> None:
    figure = kept(draw_simulation(TIME, MEASURED, {"nnss": ("", MEASURED)}, AXES, "h", "x", zoom=slice(1, 4)))
    whole, part, _, low_part = figure.axes
    assert [line.get_xdata().tolist() for line in part.lines] == [[0.5, 1.0, 1.5]] * 2
    assert [line.get_ydata().tolist() for line in low_part.lines] == [[3, 5, 7]] * 2
    assert whole.lines[0].get_xdata().tolist() == TIME.tolist()
    (marked,) = whole.patches
    assert (marked.get_x(), marked.get_width()) == (0.5, 1.0)
    assert not part.patches
    assert [axis.get_xlabel() for axis in figure.axes] == ["", "", "time [h]", "time [h]"]
    # the part has a range of its own, so its axis says of what
    assert [axis.get_ylabel() for axis in figure.axes] == ["level [m]", "level [m]", "flow", "flow"]
    one = kept(draw_simulation(TIME, MEASURED, {"nnss": ("", MEASURED)}, AXES, "h", "x"))
    assert figure.get_figwidth() > one.get_figwidth()


def test_states_stand_below_the_outputs_that_they_follow(kept: Callable) -> None:
    states = np.arange(18.0).reshape(6, 3)
    figure = kept(draw_states(TIME, states, MEASURED, AXES, "s", "a title", breaks=(3,)))
    assert [axis.get_ylabel() for axis in figure.axes] == [
        "level [m]",
        "flow",
        "$x_{1}$ [–]",
        "$x_{2}$ [–]",
        "$x_{3}$ [–]",
    ]
    for axis, column in zip(figure.axes, (*MEASURED.T, *states.T), strict=True):
        curve, parted = axis.lines
        np.testing.assert_array_equal(curve.get_xdata(), TIME)
        np.testing.assert_array_equal(curve.get_ydata(), column)
        assert parted.get_xdata()[0] == 1.5
        assert len(axis.get_yticks()) <= 6
    assert [axis.get_xlabel() for axis in figure.axes] == [""] * 4 + ["time [s]"]
    assert colours(figure.axes[0].lines[0]) != colours(figure.axes[2].lines[0])
    assert figure.get_suptitle() == "a title"
    long = kept(draw_states(TIME, states, MEASURED[:, :1], (Axis("temperature of the second tank", "K"),), "s", "x"))
    assert max(map(len, long.axes[0].get_ylabel().split("\n"))) <= 16


# orders


def test_orders_show_singular_values_and_errors_and_the_suggestion(kept: Callable) -> None:
    figure = kept(draw_orders([1, 2, 3], [1.0, 0.1, 0.01], [0.5, None, 0.2], [0.6, 0.3, None], 2, "RMSE/σ", "a title"))
    left, right = figure.axes
    assert [(bar.get_x() + bar.get_width() / 2, bar.get_height()) for bar in left.patches] == [
        (1, 1.0), (2, 0.1), (3, pytest.approx(0.01)),
    ]  # fmt: skip
    assert all(bar.get_width() < 1 for bar in left.patches)  # they do not touch
    assert left.get_yscale() == "log"
    train, val, chosen = right.lines
    assert (list(train.get_xdata()), list(train.get_ydata())) == ([1, 3], [0.5, 0.2])
    assert (list(val.get_xdata()), list(val.get_ydata())) == ([1, 2], [0.6, 0.3])
    assert (train.get_marker(), val.get_marker()) == ("s", "o")
    assert train.get_linestyle() != val.get_linestyle()
    assert list(chosen.get_xdata()) == [2, 2]
    assert [text.get_text() for text in right.get_legend().get_texts()] == ["training", "validation", "suggested: 2"]
    assert right.get_ylim() == pytest.approx((0, 1.08 * 0.6))  # the largest does not touch the frame
    assert (left.get_ylabel(), right.get_ylabel()) == (
        "Hankel singular value, relative [–]",
        "RMSE/σ [–]",
    )
    for panel in (left, right):
        assert panel.get_xlabel() == "order n"
        assert all(float(tick).is_integer() for tick in panel.get_xticks())
    assert figure.get_suptitle() == "a title"


# ranks


def ranks(kept: Callable, level: list[tuple[str, str]]) -> tuple[Figure, Axes]:
    mean = pd.Series({"nnss": 1.25, "ssest": 2.0, "n4sid": 3.0, "simba": 3.75, "own": 5.0})
    figure = kept(draw_ranks(mean, level, "a title"))
    (panel,) = figure.axes
    return figure, panel


def test_a_method_stands_at_its_mean_rank_with_its_name(kept: Callable) -> None:
    figure, panel = ranks(kept, [])
    markers = {line.get_xdata()[0]: line for line in panel.lines if len(line.get_xdata()) == 1}
    assert sorted(markers) == [1.25, 2.0, 3.0, 3.75, 5.0]
    assert all(line.get_ydata()[0] == 0 for line in markers.values())
    assert markers[2.0].get_marker() == style_of("ssest").marker
    labels = {text.get_text(): text for text in panel.texts if "(" in text.get_text()}
    assert list(labels) == ["NN-SS (1.25)", "SSEST (2.00)", "N4SID (3.00)", "SIMBa (3.75)", "own (5.00)"]
    left, right = (
        [text.get_position() for text in labels.values() if text.get_ha() == side] for side in ("right", "left")
    )
    assert [len(left), len(right)] == [3, 2]
    assert all(0.5 < x < 1 for x, _ in left)  # beside the ends of the line
    assert all(5 < x < 5.5 for x, _ in right)
    # the better, the higher on the left; the worse, the higher on the right: no two lines cross
    assert [y for _, y in left] == sorted((y for _, y in left), reverse=True)
    assert [y for _, y in right] == sorted(y for _, y in right)
    for rank, (x, y) in zip(
        (1.25, 2.0, 3.0, 3.75, 5.0), (text.get_position() for text in labels.values()), strict=True
    ):
        (lead,) = (line for line in panel.lines if len(line.get_xdata()) == 3 and line.get_xdata()[0] == rank)
        assert list(lead.get_xdata()[:2]) == [rank, rank]
        assert list(lead.get_ydata()) == [0, y, y]
        assert abs(lead.get_xdata()[2] - x) < 0.15
    assert panel.get_title() == "a title"
    figure.canvas.draw()
    width, height = figure.bbox.width, figure.bbox.height
    for text in panel.texts:
        box = text.get_window_extent()
        assert 0 <= box.x0 < box.x1 <= width, text.get_text()
        assert 0 <= box.y0 < box.y1 <= height, text.get_text()


def test_the_line_of_ranks_has_a_tick_for_each(kept: Callable) -> None:
    _, panel = ranks(kept, [])
    line = panel.lines[0]
    assert (list(line.get_xdata()), list(line.get_ydata())) == ([1, 5], [0, 0])
    ticks = [text for text in panel.texts if "(" not in text.get_text()]
    assert [(text.get_text(), text.get_position()[0]) for text in ticks] == [(str(i), i) for i in range(1, 6)]
    strokes = [list(line.get_xdata()) for line in panel.lines if len(line.get_xdata()) == 2 and line.get_ydata()[1] > 0]
    assert strokes == [[i, i] for i in range(1, 6)]
    assert all(text.get_position()[1] > line.get_ydata()[0] for text in ticks)


def test_a_bar_joins_those_that_are_not_shown_to_differ(kept: Callable) -> None:
    _, panel = ranks(kept, [("nnss", "ssest"), ("ssest", "n4sid"), ("own", "simba")])
    bars = [line for line in panel.lines if len(line.get_xdata()) == 2 and line.get_ydata()[0] < 0]
    assert [(line.get_xdata()[0], line.get_xdata()[1]) for line in bars] == [
        pytest.approx((1.25, 2.0), abs=0.06), pytest.approx((2.0, 3.0), abs=0.06), pytest.approx((3.75, 5.0), abs=0.06),
    ]  # fmt: skip
    for line in bars:
        assert line.get_ydata()[0] == line.get_ydata()[1]
    heights = [line.get_ydata()[0] for line in bars]
    assert len(set(heights)) == 3
    labels = [text.get_position()[1] for text in panel.texts if "(" in text.get_text()]
    assert max(labels) < min(heights)
    low, high = panel.get_ylim()
    assert low < min(labels)
    assert high > 0.28


def test_a_saved_figure_has_its_size_and_no_date(tmp_path: Path, kept: Callable) -> None:
    for suffix in ("png", "svg"):
        contents = []
        for name in ("one", "two"):
            figure = kept(draw_orders([1, 2], [1.0, 0.1], [0.5, 0.4], [0.6, 0.5], 2, "RMSE/σ", "x"))
            save_figure(figure, tmp_path / f"{name}.{suffix}")
            contents.append((tmp_path / f"{name}.{suffix}").read_bytes())
        assert contents[0] == contents[1]
    width, height = (int.from_bytes((tmp_path / "one.png").read_bytes()[i : i + 4], "big") for i in (16, 20))
    assert (width, height) == (1440, 640)  # 7.2 by 3.2 inches at 200 dots an inch
    assert b"<dc:date>" not in (tmp_path / "one.svg").read_bytes()
    assert b"Software" not in (tmp_path / "one.png").read_bytes()
