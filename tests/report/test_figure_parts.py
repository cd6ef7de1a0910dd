"""What figures are made of: how panels, legends and titles are laid out, and what several inputs share a panel as."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

from nnss_cli.report import figures
from nnss_cli.report.figures import _has_boxes, _span, draw_boxplot, wrapped
from nnss_cli.report.style import Axis, Look
from nnss_cli.report.timeplots import _draw_inputs, _unit, draw_simulation


@pytest.fixture
def panel() -> Iterator[Axes]:
    figure = figures.plt.figure()
    yield figure.subplots()
    figures.plt.close(figure)


def test_a_title_is_broken_where_its_figure_ends_and_where_it_says() -> None:
    assert wrapped("one two\nthree", 9.0) == "one two\nthree"
    assert wrapped("x" * 20 + " " + "y" * 4, 2.0) == "x" * 20 + " yyyy"  # 25 letters in two inches
    assert wrapped("x" * 20 + " " + "y" * 5, 2.0) == "x" * 20 + "\nyyyyy"
    assert wrapped("a few words that are of one line and one", 3.0) == "a few words that are\nof one line and one"
    assert wrapped("x" * 60, 2.0).count("\n") == 2


def test_a_unit_is_told_where_there_is_one() -> None:
    assert [_unit(Axis("y", unit)) for unit in ("m", "–", "")] == ["\n[m]", "", ""]


@pytest.mark.parametrize(
    ("values", "span"), [([1.0, np.e], 1.0), ([], 0.0), ([2.0, 2.0], 0.0), ([0.0, 0.0], 0.0), ([-1.0, 0.0], 0.0)]
)
def test_a_span_is_logarithmic_and_that_of_nothing_is_none(values: list[float], span: float) -> None:
    assert _span(values) == pytest.approx(span)
    assert _span([0.0, 1.0]) > 700  # zero is as low as numbers go


def test_a_method_has_boxes_where_some_order_has_a_spread() -> None:
    by_method: dict[str, Any] = {"nnss": {2: [1.0, 1.0], 3: [1.0, 2.0]}, "simba": {2: [5.0], 3: []}}
    assert _has_boxes(by_method, "nnss")
    assert not _has_boxes(by_method, "simba")
    assert not _has_boxes(by_method, "n4sid")


SAMPLE = {"nnss": {2: [1.0, 2.0, 4.0]}, "n4sid": {2: [2.0, 3.0, 5.0]}}


def arrangement(panels: int, columns: int | None) -> list[int]:
    """Panels in each row of a box plot of so many."""
    values = {f"p{i}": SAMPLE for i in range(panels)}
    figure = draw_boxplot(values, dict.fromkeys(values, "RMSE"), "x", None, Look(columns=columns))
    rows = [panel.get_subplotspec().rowspan.start for panel in figure.axes]
    figures.plt.close(figure)
    return [rows.count(row) for row in sorted(set(rows))]


@pytest.mark.parametrize(
    ("panels", "columns", "rows"),
    [
        (1, None, [1]),
        (3, None, [3]),
        (4, None, [3, 1]),
        (7, None, [3, 3, 1]),
        (3, 1, [1, 1, 1]),
        (3, 2, [3]),
        (4, 2, [3, 1]),
    ],
)
def test_panels_stand_beside_each_other_while_there_is_room(panels: int, columns: int | None, rows: list[int]) -> None:
    assert arrangement(panels, columns) == rows


@pytest.mark.parametrize(("panels", "columns"), [(1, 3), (2, 4), (3, 6)])
def test_a_legend_is_as_wide_as_its_panels_allow(panels: int, columns: int) -> None:
    methods = {f"m{i}": {2: [1.0, 2.0, 4.0]} for i in range(12)}
    values = {f"p{i}": methods for i in range(panels)}
    figure = draw_boxplot(values, dict.fromkeys(values, "RMSE"), "x")
    assert figure.legends[0]._ncols == columns
    figures.plt.close(figure)


def test_a_box_has_the_looks_of_its_method_and_a_title_only_where_one_is_told() -> None:
    figure = draw_boxplot({"a": SAMPLE}, {"a": "RMSE"}, "x", {"a": "first"})
    assert figure.axes[0].get_title() == "first"
    figures.plt.close(figure)
    figure = draw_boxplot({"a": SAMPLE}, {"a": "RMSE"}, "x")
    assert figure.axes[0].get_title() == ""
    figures.plt.close(figure)


# inputs


def test_one_input_is_drawn_in_its_unit_and_holds_its_value(panel: Axes) -> None:
    t, u = np.arange(4.0), np.array([1.0, 3.0, 2.0, 5.0])
    _draw_inputs(panel, t, [(Axis("pump", "V"), u)])
    (line,) = panel.lines
    assert (list(line.get_xdata()), list(line.get_ydata())) == ([0, 1, 2, 3], [1, 3, 2, 5])
    assert line.get_drawstyle() == "steps-post"
    assert panel.get_ylabel() == "pump [V]"
    assert panel.get_label() != "inputs"


def test_several_inputs_stand_above_each_other_each_over_its_range(panel: Axes) -> None:
    t = np.arange(3.0)
    inputs = [("a", [1.0, 3.0, 2.0]), ("b", [7.0, 7.0, 7.0]), ("c", [-10.0, 0.0, -5.0])]
    _draw_inputs(panel, t, [(Axis(name, "V"), np.array(u)) for name, u in inputs])
    assert [line.get_ydata() for line in panel.lines] == [
        pytest.approx([0, 0.8, 0.4]), pytest.approx([1.4] * 3), pytest.approx([2, 2.8, 2.4]),
    ]  # fmt: skip
    assert [text.get_text() for text in panel.get_yticklabels()] == ["a", "b", "c"]
    assert list(panel.get_yticks()) == pytest.approx([0.4, 1.4, 2.4])
    assert panel.get_ylabel() == "inputs, each\nover its range"


# a simulation


def simulation(**more: Any) -> Any:
    t = np.arange(30.0)
    y = np.stack([np.sin(t / 5), np.cos(t / 5)], axis=1)
    simulated = {"nnss": ("a", y + 0.5), "n4sid": ("b", y - 0.25)}
    axes = [Axis("one", "m"), Axis("two", "–")]
    return draw_simulation(t, y, simulated, axes, "s", "x", **more)


def test_each_output_has_its_residuals_below_and_inputs_come_last() -> None:
    u = np.arange(30.0)
    figure = simulation(residuals=True, inputs=[(Axis("a", "V"), u), (Axis("b", "V"), -u)], breaks=(10,))
    labels = [panel.get_ylabel() for panel in figure.axes]
    assert labels == ["one [m]", "residual\n[m]", "two", "residual", "inputs, each\nover its range"]
    for row, output in ((1, 0), (3, 1)):
        nnss, n4sid, zero, parted = figure.axes[row].lines
        assert nnss.get_ydata() == pytest.approx([-0.5] * 30)
        assert n4sid.get_ydata() == pytest.approx([0.25] * 30)
        assert list(zero.get_ydata()) == [0, 0]
        assert parted.get_xdata()[0] == 10
        assert len(figure.axes[2 * output].lines) == 4
    assert [panel.get_xlabel() for panel in figure.axes] == [""] * 4 + ["time [s]"]
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["measured", "NN-SS a", "N4SID b"]
    figures.plt.close(figure)


def test_a_zoom_has_panels_of_its_own_at_every_width() -> None:
    for columns, panels in ((1, 4), (2, 4), (None, 4)):
        figure = simulation(zoom=slice(5, 9), look=Look(columns=columns))
        assert len(figure.axes) == panels, columns
        if columns:
            assert figure.get_figwidth() == Look(columns=columns).width
        figures.plt.close(figure)


def test_a_part_is_said_to_be_one_above_its_first_panel_alone() -> None:
    figure = simulation(zoom=slice(5, 9))
    assert [panel.get_title(loc="left") for panel in figure.axes] == ["", "a part of it", "", ""]
    whole, part, low, low_part = figure.axes
    assert [len(panel.patches) for panel in (whole, part, low, low_part)] == [1, 0, 1, 0]
    (marked,) = low.patches
    assert (marked.get_x(), marked.get_width()) == (5.0, 3.0)
    figures.plt.close(figure)


def test_curves_begin_at_the_left_end_and_values_have_a_few_ticks() -> None:
    figure = simulation(residuals=True)
    for panel in figure.axes:
        low, high = panel.get_xlim()
        assert (low, high) == (pytest.approx(-0.29), pytest.approx(29.29))  # a hundredth on either side
        assert (
            2 <= len([tick for tick in panel.get_yticks() if panel.get_ylim()[0] <= tick <= panel.get_ylim()[1]]) <= 5
        )
    figures.plt.close(figure)
