"""The page and tables of a validated model, from one made by hand."""

from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from nnss_cli.datasets.record import Channels

from nnss_cli.report import validation as report
from nnss_cli.report.cells import plain
from nnss_cli.report.figures import plt
from nnss_cli.validation.gain import ALONE
from nnss_cli.validation.linearisation import Linearisations, OperatingPoint
from nnss_cli.validation.predictor import StepTable
from nnss_cli.validation.residuals import Dependence, Profile, Whiteness
from nnss_cli.validation.result import OutputCheck, Stated, Validation

TIME = np.arange(4) * 0.5
Y = np.arange(8.0).reshape(4, 2)
PROFILE = Profile(np.array([0.0, 1.0]), np.array([0.2, -0.1]), np.array([0.05, 0.07]), 0.1234, 0.001)
STATE = replace(PROFILE, centres=np.array([5.0, 6.0]), share=0.3)


def output(name: str, unit: str, rmse: float, lowest: int) -> OutputCheck:
    """An output whose residuals depend most on the input of index `lowest`."""
    ties = tuple(
        Dependence(np.array([0.01, -0.3, 0.02]) * (i + 1), 0.123456, 5.0, 3, 0.001 if i == lowest else 0.5)
        for i in range(2)
    )
    return OutputCheck(
        name, unit, rmse, 2.0, 87.654, None if unit == "–" else 93.21, None, 0.954, (0.1, 0.2), 0.0123456,
        Whiteness(np.array([0.256, -0.4, 0.1]), 0.0876, 9.0, 3, 0.0123), ties, (None, PROFILE), (None, PROFILE, STATE),
    )  # fmt: skip


def point(u: tuple[float, ...], at: float) -> OperatingPoint:
    step = at + np.arange(3 * 2 * 2.0).reshape(3, 2, 2)
    return OperatingPoint(
        np.array(u), np.array([0.123456, 7.0]), np.array([0.5 + 0.25j, 0.5 - 0.25j]), np.array([[1.23456, 2], [3, 4]]),
        step, 1 + step,
    )  # fmt: skip


FOUND = Validation(
    "nnss, n = 3", "test of tank", 4, 1, 1, Channels(("a", "b"), ("x", "y"), ("V", "–"), ("m", "–")),
    (output("x", "m", 0.2, 0), output("y", "–", 0.5, 1)),
    StepTable((1, 5), np.array([[0.1, 0.2], [0.3, 0.4]]), np.array([[0.5, 0.6], [0.7, 0.8]]), np.array([0.9, 1.23456])),
    (Stated("white", True, "p = 0.3"), Stated("free", False, "p = 0")), ("it fits", "it does not"), ("K",), (0.5,),
    np.array([[0.9 + 0.1j, 0.2]]), 0.90554,
    Linearisations((point((1, 2), 0), point((3, 4), 10)), (), np.array([0.1, 0.2, 1.0]), 0.5),
    TIME, Y, Y - 0.5, Y - 0.1, None,
)  # fmt: skip


def test_errors_ahead_are_tabled_by_output_and_horizon_and_end_with_the_simulation() -> None:
    rows = report.step_rows(FOUND.steps, FOUND.channels)
    assert [tuple(row.values()) for row in rows] == [
        ("x [m]", "1", "0.1", "0.5"), ("x [m]", "5", "0.3", "0.7"), ("x [m]", "∞", "0.9", "–"),
        ("y", "1", "0.2", "0.6"), ("y", "5", "0.4", "0.8"), ("y", "∞", "1.235", "–"),
    ]  # fmt: skip
    assert list(rows[0]) == ["output", "steps ahead", "RMSE", "persistence"]
    guarded = replace(FOUND.steps, guarded=np.array([[0.11, 0.21], [0.31, 0.41]]))
    with_guard = report.step_rows(guarded, FOUND.channels)
    assert list(with_guard[0]) == ["output", "steps ahead", "RMSE", "guarded", "persistence"]
    assert [row["guarded"] for row in with_guard] == ["0.11", "0.31", "–", "0.21", "0.41", "–"]
    assert [{key: row[key] for key in rows[0]} for row in with_guard] == rows


def test_the_factor_of_an_axis_is_clear_of_the_legend_above_it() -> None:
    large = {name: getattr(FOUND, name) * 1e9 for name in ("measured", "simulated", "one_ahead")}
    figure = report.draw_validation(replace(FOUND, **large))
    figure.canvas.draw()
    for panel in figure.axes[1:3]:
        factor, legend = panel.yaxis.get_offset_text(), panel.get_legend()
        assert factor.get_text().startswith("1e")
        assert not factor.get_window_extent().overlaps(legend.get_window_extent())
    plt.close(figure)


def test_a_guard_says_how_much_persistence_had() -> None:
    weight = np.array([[0.0, 0.2], [0.5, 0.6]])
    assert report.guard_lines(weight, FOUND.channels) == [
        "guard, x: persistence had 25.0 % of the weight, 50.0 % at the end",
        "guard, y: persistence had 40.0 % of the weight, 60.0 % at the end",
    ]


def test_a_gain_says_where_it_comes_from() -> None:
    none = SimpleNamespace(K=np.zeros((2, 1)), origin="none", val={"none": 1.0, "Kalman": 1.01})
    some, alone = (SimpleNamespace(K=np.ones((2, 1)), origin=each, rate=0.56789) for each in ("Kalman", ALONE))
    zero = "K = 0: no gain predicts the validation record better than the simulation does"
    kalman = "gain: Kalman; the observer's errors change by a factor of 0.568 a sample"
    assert report.gain_lines([none]) == [zero]
    assert report.gain_lines([none, some]) == [f"member 1: {zero}", f"member 2: {kalman}"]
    (told,) = report.gain_lines([alone])
    assert told.startswith("the model has no part in this: increments of inputs and outputs alone validate better; ")
    assert told.endswith("by a factor of 0.568 a sample")


def test_outputs_residuals_points_and_tests_are_tabled() -> None:
    first, second = report.output_rows(FOUND)
    for row, each in zip(plain([first, second]), FOUND.outputs, strict=True):  # in full, for machines
        assert (row["fit [%]"], row["linear limit [%]"]) == (each.fit_percent, each.limit)
    assert first == {
        "output": "x [m]", "fit [%]": "87.7", "linear limit [%]": "93.2", "RMSE": "0.2", "RMSE/σ": "0.1",
        "σ (training)": "2",
    }  # fmt: skip
    assert (second["output"], second["linear limit [%]"]) == ("y", "–")
    rows = report.residual_rows(FOUND)
    assert [tuple(row.values()) for row in rows[:3]] == [
        ("x", "with themselves", "0.01235", "0.4", "0.088", "0.012"), ("x", "with a", "", "0.3", "0.12", "0.001"),
        ("x", "with b", "", "0.6", "0.12", "0.5"),
    ]  # fmt: skip
    assert len(rows) == 6
    rows = report.point_rows(FOUND)
    assert rows[:2] == [
        {"point": "1", "output": "x [m]", "at a": "1", "at b": "2", "at rest": "0.1235", "largest |pole|": "0.559",
         "gain from a": "1.235", "gain from b": "2"},
        {"point": "1", "output": "y", "at a": "1", "at b": "2", "at rest": "7", "largest |pole|": "0.559",
         "gain from a": "3", "gain from b": "4"},
    ]  # fmt: skip
    assert [(row["point"], row["output"], row["at b"]) for row in rows[2:]] == [("2", "x [m]", "4"), ("2", "y", "4")]
    assert report.test_rows(FOUND) == [
        {"test": "white", "": "passes", "found": "p = 0.3"},
        {"test": "free", "": "FAILS", "found": "p = 0"},
    ]


@pytest.fixture(scope="module")
def page() -> Iterator[Any]:
    """Draws the page; that of `FOUND` once."""
    drawn: dict[int, tuple[Validation, Figure]] = {}

    def draw(found: Validation = FOUND) -> list[Axes]:
        if id(found) not in drawn:
            drawn[id(found)] = found, report.draw_validation(found)
        return drawn[id(found)][1].findobj(Axes)  # type: ignore[return-value]

    yield draw
    for _, figure in drawn.values():
        plt.close(figure)


def entries(panel: Axes) -> list[str]:
    return [text.get_text() for text in panel.get_legend().get_texts()]


def test_the_page_shows_the_output_with_the_largest_relative_error(page: Any) -> None:
    head, record, errors, *_ = page()
    assert head.get_title() == "nnss, n = 3\non test of tank, 4 samples\ndrawn: output y, input b"
    assert head.texts[0].get_text() == "– it fits\n– it does not"
    assert head.texts[0].get_position() == (0, 1)
    assert [line.get_ydata().tolist() for line in record.lines] == [Y[:, 1].tolist(), (Y - 0.5)[:, 1].tolist()]
    assert record.get_ylabel() == "y"
    assert entries(record) == ["measured", "simulated"]
    assert [line.get_ydata().tolist() for line in errors.lines] == [
        pytest.approx([0.5] * 4),
        pytest.approx([0.1] * 4),
    ]
    assert entries(errors) == ["simulation, r1 = 0.95", "one step ahead, r1 = 0.26"]
    assert (errors.get_ylabel(), errors.get_xlabel()) == ("error", "time [s]")
    worse = replace(FOUND, outputs=(replace(FOUND.outputs[0], rmse=1.01), FOUND.outputs[1]))
    head, record, errors, *_ = page(worse)
    assert head.get_title().endswith("drawn: output x, input a")
    assert (record.get_ylabel(), errors.get_ylabel()) == ("x [m]", "error [m]")
    assert record.lines[0].get_ydata().tolist() == Y[:, 0].tolist()


def test_one_output_and_input_need_not_be_named(page: Any) -> None:
    each = replace(FOUND.outputs[0], depends=FOUND.outputs[0].depends[:1], by_input=FOUND.outputs[0].by_input[:1])
    alone = replace(FOUND, outputs=(each,), channels=Channels(("a",), ("x",), ("V",), ("m",)))
    assert "drawn" not in page(alone)[0].get_title()
    assert page(replace(alone, experiments=2))[0].get_title().endswith("\ndrawn: signals of record 1 of 2")


def test_of_several_experiments_the_one_that_is_drawn_is_named(page: Any) -> None:
    title = page(replace(FOUND, experiments=3))[0].get_title()
    assert title.endswith("4 samples\ndrawn: signals of record 1 of 3, output y, input b")


def test_a_band_is_filled_between_its_limits(page: Any) -> None:
    limits: Any = SimpleNamespace(pair=(Y - 1, Y + 2), name="90 % band")
    record = page(replace(FOUND, limits=limits))[1]
    (band,) = record.collections
    assert band.get_linewidth()[0] > 0.5  # its limits are lines, seen in grey and where it is narrow, too
    box = band.get_paths()[0].get_extents()
    assert (box.y0, box.y1) == (0, 9)
    assert entries(record) == ["measured", "simulated", "90 % band"]


def test_residuals_are_drawn_by_lag_with_their_band(page: Any) -> None:
    _, _, _, left, middle, right, *_ = page()
    for panel, first, correlation, band in (
        (left, 1, [0.256, -0.4, 0.1], 0.0876),
        (middle, 0, [0.02, -0.6, 0.04], 0.123456),
    ):
        stems = panel.collections[0].get_segments()
        assert [tuple(segment[1]) for segment in stems] == [
            (first + i, pytest.approx(r)) for i, r in enumerate(correlation)
        ]
        assert all(segment[0][1] == 0 for segment in stems)
        (shade,) = panel.patches
        assert (shade.get_y(), shade.get_height()) == (-band, pytest.approx(2 * band))
        low, high = panel.get_ylim()
        assert low == -high
        assert high == pytest.approx(1.15 * max(map(abs, correlation)))
        assert (panel.get_xlabel(), panel.get_ylabel()) == ("lag [samples]", "correlation")
    assert left.get_title() == "residuals with themselves, p = 0.012"
    assert middle.get_title() == "residuals with b, p = 0.001"
    assert entries(left) == ["99 % band of one lag"]
    predictor, persistence, simulation = right.lines
    assert (predictor.get_xdata().tolist(), predictor.get_ydata().tolist()) == ([1, 5], [0.2, 0.4])
    assert persistence.get_ydata().tolist() == [0.6, 0.8]
    assert simulation.get_ydata()[0] == 1.23456
    assert (right.get_xscale(), right.get_yscale(), right.get_xlabel(), right.get_ylabel()) == (
        "log", "log", "steps ahead", "RMSE",
    )  # fmt: skip
    assert [tick.get_text() for tick in right.get_xticklabels()] == ["1", "5"]
    assert entries(right) == ["predictor", "persistence", "simulation"]


def test_small_correlations_leave_room_for_the_band(page: Any) -> None:
    white = replace(FOUND.outputs[1].white, correlation=np.array([0.01, 0.02]))
    left = page(replace(FOUND, outputs=(FOUND.outputs[0], replace(FOUND.outputs[1], white=white))))[3]
    assert left.get_ylim()[1] == pytest.approx(1.6 * 0.0876)


def test_profiles_show_the_driving_input_and_the_state_that_explains_most(page: Any) -> None:
    axes = page()
    left, middle, poles = axes[6:9]
    assert (left.get_xlabel(), middle.get_xlabel()) == ("b", "state x3")
    assert (left.get_title(), middle.get_title()) == (
        "12.3 % of the variance beyond a line, 99 % bands", "30.0 % of the variance beyond a line, 99 % bands",
    )  # fmt: skip
    assert left.lines[0].get_xdata().tolist() == [0, 1]
    assert left.lines[0].get_ydata().tolist() == [0.2, -0.1]
    bars = left.collections[0].get_segments()
    assert [(bar[0][1], bar[1][1]) for bar in bars] == [pytest.approx((0.15, 0.25)), pytest.approx((-0.17, -0.03))]
    assert left.get_ylabel() == "mean residual"
    circle, cloud, *points = poles.lines
    assert np.hypot(circle.get_xdata(), circle.get_ydata()) == pytest.approx(np.ones(len(circle.get_xdata())))
    angle = np.unwrap(np.arctan2(circle.get_ydata(), circle.get_xdata()))
    assert abs(angle[-1] - angle[0]) == pytest.approx(2 * np.pi)
    assert list(zip(cloud.get_xdata(), cloud.get_ydata(), strict=True)) == [(0.9, 0.1), (0.2, 0.0)]
    assert [line.get_ydata().tolist() for line in points] == [[0.25, -0.25]] * 2
    assert entries(poles) == ["A(x) on the trajectory", "linearisations"]
    assert poles.get_title() == "poles, largest modulus 0.9055"
    (x0, x1), (y0, y1) = poles.get_xlim(), poles.get_ylim()
    assert x0 < 0.2 < 1.0 < x1  # the unit circle's edge, too
    assert x1 - x0 == pytest.approx(1.15 * 0.8)
    assert (y0, y1) == (pytest.approx(-y1), pytest.approx((x1 - x0) / 2))
    empty = replace(FOUND.outputs[1], by_input=(None, None))
    assert page(replace(FOUND, outputs=(FOUND.outputs[0], empty)))[6].get_title() == "it does not vary"


def test_the_pages_logarithmic_axes_have_plain_numbers(page: Any) -> None:
    panels = page()
    for axis in (panels[5].yaxis, panels[10].xaxis, panels[10].yaxis):
        assert axis.axes.get_figure() is not None
        labels = [label.get_text() for label in axis.get_ticklabels()]
        assert len(labels) >= 2
        assert all(float(label) > 0 for label in labels)


def test_linearisations_are_of_the_drawn_output_and_input(page: Any) -> None:
    step, magnitude = page()[9:]
    for i, at in enumerate((0, 10)):
        assert step.lines[i].get_ydata().tolist() == [at + 3, at + 7, at + 11]
        assert step.lines[i].get_xdata().tolist() == [0, 0.5, 1]
        assert magnitude.lines[i].get_ydata().tolist() == [at + 4, at + 8, at + 12]
        assert magnitude.lines[i].get_xdata().tolist() == [0.1, 0.2, 1.0]
    assert entries(step) == ["u = 1, 2", "u = 3, 4"]
    assert len({line.get_color() for line in step.lines}) == 2
    assert (step.get_xlabel(), step.get_ylabel()) == ("time [s]", "unit step response")
    assert (magnitude.get_xlabel(), magnitude.get_xscale(), magnitude.get_yscale()) == ("frequency [Hz]", "log", "log")
    one = replace(FOUND.outputs[0], rmse=1.01)  # of x [m], which depends most on a [V]
    step, magnitude = page(replace(FOUND, outputs=(one, FOUND.outputs[1])))[9:]
    assert (step.get_ylabel(), magnitude.get_ylabel()) == ("response to a step of 1 V [m]", "magnitude [m/V]")
    flow = replace(FOUND, channels=replace(FOUND.channels, output_units=("m³/s", "–")))
    assert page(replace(flow, outputs=(one, FOUND.outputs[1])))[10].get_ylabel() == "magnitude [(m³/s)/V]"
    many = replace(FOUND.linear, points=(point((1.23456, 2, 3, 4), 0), point((1, 2, 3), 0)))
    assert entries(page(replace(FOUND, linear=many))[9]) == ["u = 1.23, 2, 3, …", "u = 1, 2, 3"]
    assert len(page(replace(FOUND, linear=replace(FOUND.linear, points=())))) == len(page()) - 2  # no empty panels


def test_a_p_value_that_is_no_number_any_more_is_not_said_to_be_zero(page: Any) -> None:
    white = replace(FOUND.outputs[1].white, p_value=0.0)
    left = page(replace(FOUND, outputs=(FOUND.outputs[0], replace(FOUND.outputs[1], white=white))))[3]
    assert left.get_title() == "residuals with themselves, p < 1e-16"


def test_names_of_channels_are_no_formulas_and_are_cut_where_they_are_long() -> None:
    names = (r"$\foo$", "x" * 300)
    outputs = tuple(replace(each, name=name) for each, name in zip(FOUND.outputs, names, strict=True))
    figure = report.draw_validation(
        replace(FOUND, outputs=outputs, channels=replace(FOUND.channels, inputs=names[::-1], outputs=names))
    )
    figure.canvas.draw()  # an error if they were
    texts = [text.get_text() for text in figure.findobj(Text)]
    assert sum(names[0] in text for text in texts) >= 2
    assert max(len(line) for text in texts for line in text.splitlines()) < 200
    plt.close(figure)
