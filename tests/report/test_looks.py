"""What figures must show: ticks to read, methods apart from the measured line in grey, dense records whole."""

from collections.abc import Callable
from pathlib import Path

import matplotlib.colors
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.datasets.record import Channels

from nnss_cli.errors import InputError
from nnss_cli.report import figures
from nnss_cli.report.comparison import _boxplot, transient
from nnss_cli.report.dense import BINS, PIXELS, envelope, is_dense, thinned
from nnss_cli.report.simulation import draw_simulated
from nnss_cli.report.style import MEASURED, MORE, STYLES, Axis, Look, legend_columns, log_ticks, styles_of
from nnss_cli.report.timeplots import draw_simulation, draw_states


@given(st.floats(1e-9, 1e6), st.floats(1.001, 1e9))
def test_a_logarithmic_axis_has_two_numbers_at_least(low: float, factor: float) -> None:
    ticks = log_ticks(low, low * factor)
    assert 2 <= len(ticks) <= 8
    assert len({f"{tick:g}" for tick in ticks}) == len(ticks) or factor < 1.0001
    assert ticks == sorted(ticks)
    assert all(low * (1 - 1e-9) <= tick <= low * factor * (1 + 1e-9) for tick in ticks)


def test_the_range_that_had_one_tick() -> None:
    assert log_ticks(95, 195) == [100, 120, 140, 160, 180]
    figure = figures.draw_boxplot({"test": {"nnss": {2: [95.0, 120.0, 195.0]}}}, {"test": "RMSE"}, "x")
    figure.canvas.draw()
    assert len([text for text in figure.axes[0].get_yticklabels() if text.get_text()]) >= 2
    figures.plt.close(figure)


def grey(colour: str) -> float:
    r, g, b = matplotlib.colors.to_rgb(colour)
    return 0.299 * r + 0.587 * g + 0.114 * b


def test_methods_differ_from_the_measured_line_and_from_each_other_in_grey() -> None:
    looks = [*STYLES.values(), *MORE]
    for name in ("line", "hatch", "marker"):  # each alone tells them apart
        assert len({getattr(look, name) for look in looks}) == len(looks), name
    for look in looks:
        assert grey(MEASURED["color"]) - grey(look.colour) > 0.1, look
    assert MEASURED["linewidth"] > 2 * 1.1


def test_plugins_have_looks_of_their_own() -> None:
    names = ["nnss", "mine", "theirs", "third", "fourth"]
    looks = styles_of(names)
    assert len({look.marker for look in looks.values()}) == 5
    assert [look.label for look in looks.values()][1:] == names[1:]
    assert styles_of(["mine"])["mine"] == styles_of(["mine", "nnss"])["mine"]


def test_no_row_of_a_legend_holds_a_single_entry() -> None:
    for entries in range(2, 12):
        for most in range(2, 7):
            columns = legend_columns(entries, most)
            assert columns <= most
            assert entries % columns != 1 or (entries, columns) == (7, 2) or most <= 3, (entries, most, columns)


def test_an_envelope_keeps_every_extreme() -> None:
    t = np.arange(20_000.0)
    y = np.sin(t / 3) * (1 + np.sin(t / 4000))
    y[7777], y[12_345] = 9.0, -9.0
    assert is_dense(np.sin(t / 3))
    assert not is_dense(np.sin(t / 3000))
    assert not is_dense(np.sin(t[:500] / 3))
    found = envelope(t, y)
    assert found.time.shape == found.low.shape == found.high.shape == (BINS,)
    assert (found.low.min(), found.high.max()) == (-9.0, 9.0)
    for k in range(0, len(t), 97):
        piece = np.searchsorted(found.time, t[k], side="right") - 1
        assert found.low[piece] <= y[k] <= found.high[piece]
    time, line = thinned(t, y)
    assert len(line) <= PIXELS + 2
    assert {9.0, -9.0} <= set(line)
    assert (np.diff(time) > 0).all()
    assert thinned(t[:100], y[:100])[1] is not None
    np.testing.assert_array_equal(thinned(t[:100], y[:100])[1], y[:100])


def test_a_simulation_shows_residuals_and_inputs_and_names_the_zooms_axis() -> None:
    t = np.arange(400.0)
    y, u = np.sin(t / 20)[:, None], np.cos(t / 20)
    figure = draw_simulation(
        t, y, {"nnss": ("", y + 0.25)}, [Axis("level", "m")], "s", "x", slice(100, 150), (),
        [(Axis("pump", "V"), u)], True,
    )  # fmt: skip
    panels = np.array(figure.axes).reshape(3, 2)
    assert [[panel.get_ylabel() for panel in row] for row in panels] == [
        ["level [m]"] * 2, ["residual\n[m]"] * 2, ["pump [V]"] * 2
    ]  # fmt: skip
    for panel, K in zip(panels[1], (400, 50), strict=True):
        np.testing.assert_allclose(panel.lines[0].get_ydata(), np.full(K, -0.25))
    np.testing.assert_array_equal(panels[2, 0].lines[0].get_ydata(), u)
    figures.plt.close(figure)


def test_a_dense_record_is_an_envelope_and_its_zoom_shows_single_oscillations() -> None:
    t = np.arange(20_000.0)
    y = np.sin(t / 2)[:, None]
    part = transient(y)
    assert part.stop - part.start == 160
    figure = draw_simulation(t, y, {"nnss": ("", y + 0.5)}, [Axis("y", "–")], "s", "x", part, residuals=True)
    (whole, zoom), (residual, differences) = np.array(figure.axes).reshape(2, 2)
    np.testing.assert_allclose(residual.lines[0].get_ydata(), np.full(BINS // 3, 0.5))  # root mean squares
    assert residual.get_ylabel() == "residual, rms"
    np.testing.assert_allclose(differences.lines[0].get_ydata(), np.full(160, -0.5))
    assert differences.get_ylabel() == "residual"
    assert (len(whole.collections), len(whole.patches)) == (1, 1)  # the envelope, and where the zoom is
    assert all(len(line.get_ydata()) == BINS for line in whole.lines[:2])
    assert [len(line.get_ydata()) for line in zoom.lines] == [160, 160]
    figures.plt.close(figure)


@pytest.mark.system
@pytest.mark.parametrize("outputs", [1, 3])
def test_in_one_column_the_zoom_stands_below_with_all_its_panels(outputs: int) -> None:
    t = np.arange(400.0)
    y = np.stack([np.sin(t / 20 + i) for i in range(outputs)], axis=1)
    axes, part = [Axis(f"y{i}", "m") for i in range(outputs)], slice(100, 150)
    figure = draw_simulation(
        t, y, {"nnss": ("", y + 0.25)}, axes, "s", "x", part, (), [(Axis("pump", "V"), t)], True, Look((), 1)
    )  # fmt: skip
    rows = 2 * outputs + 1
    whole, zoom = np.array(figure.axes).reshape(2, rows)
    for i in range(outputs):
        for panel, shown in ((whole[2 * i], t), (zoom[2 * i], t[part])):
            np.testing.assert_array_equal(panel.lines[0].get_xdata(), shown)
            assert panel.get_ylabel() == f"y{i} [m]"
        np.testing.assert_allclose(zoom[2 * i + 1].lines[0].get_ydata(), np.full(50, -0.25))
        (marked,) = whole[2 * i].patches  # where the part is
        assert (marked.get_x(), marked.get_width()) == (100, 49)
    assert [panel.get_xlabel() for panel in figure.axes] == ([""] * (rows - 1) + ["time [s]"]) * 2
    assert (whole[0].get_title(loc="left"), zoom[0].get_title(loc="left")) == ("", "a part of it")
    figure.canvas.draw()
    lengths = [{tuple(panel.get_xlim()) for panel in block} for block in (whole, zoom)]
    assert [len(block) for block in lengths] == [1, 1]
    assert lengths[0] != lengths[1]
    tops = [panel.get_position().y0 for panel in figure.axes]
    assert tops == sorted(tops, reverse=True)
    width, height = figure.get_size_inches()
    assert width == 3.5
    assert height <= 9.2  # of a page's text
    figures.plt.close(figure)


def test_a_simulation_that_goes_far_away_does_not_hide_the_others() -> None:
    t = np.arange(400.0)
    y = np.sin(t / 20)[:, None]  # from −1 to 1: three more on either side are shown
    simulated = {"nnss": ("", y + 2.5), "n4sid": ("", y - t[:, None]), "ssest": ("", y + 4.5)}
    figure = draw_simulation(t, y, simulated, [Axis("level", "m")], "s", "x", residuals=True)
    panel, residual = figure.axes
    assert panel.get_title(loc="right") == "leaving the panel: N4SID, SSEST"
    assert panel.get_ylim() == pytest.approx((-4.4, 4.4), abs=0.01)
    low, high = residual.get_ylim()
    assert -5.5 < low < -4  # of what stays in view
    assert 4 < high < 5.6
    figures.plt.close(figure)
    del simulated["n4sid"], simulated["ssest"]
    figure = draw_simulation(t, y, simulated, [Axis("level", "m")], "s", "x", residuals=True)
    assert figure.axes[0].get_title(loc="right") == ""
    figures.plt.close(figure)


def test_a_dense_signal_alone_is_one_filled_band_and_said_to_be_an_envelope() -> None:
    """Two edges of one colour looked like two signals."""
    t = np.arange(20_000.0)
    y, x = np.sin(t / 2)[:, None], np.stack([np.sin(t / 2), t], axis=1)
    figure = draw_states(t, x, y, [Axis("y", "–")], "s", "x")
    assert [(len(panel.collections), len(panel.lines)) for panel in figure.axes] == [(1, 0), (1, 0), (0, 1)]
    assert [panel.get_title(loc="left") for panel in figure.axes] == ["envelope: least and largest values", "", ""]
    figures.plt.close(figure)


def test_what_is_simulated_of_a_dense_file_is_said_to_be_an_envelope() -> None:
    t = np.arange(8000.0)
    dense, plain = np.sin(t / 2)[:, None], np.zeros((8000, 1))
    channels = Channels(("u",), ("y",), ("V",), ("m",))
    for u, y, said in ((plain, dense, "envelope: least and largest values"), (plain, plain, "")):
        figure = draw_simulated(t, u, 1.1 * y, y, channels, "a model")
        assert figure.axes[0].get_title(loc="left") == said
        assert len(figure.axes[1].collections) == bool(said)  # the residual: one band
        figures.plt.close(figure)


def test_linear_axes_have_round_numbers() -> None:
    t = np.arange(300.0) * 0.1 + 30
    figure = draw_simulation(
        t, 6.4 * np.sin(t)[:, None], {}, [Axis("y", "–")], "s", "x", slice(0, 100), look=Look((), 1)
    )
    figure.canvas.draw()
    assert {"30", "35"} <= {label.get_text() for label in figure.axes[1].get_xticklabels()}
    assert {"−5", "0", "5"} <= {label.get_text() for label in figure.axes[0].get_yticklabels()}
    figures.plt.close(figure)


@pytest.mark.parametrize("columns", [1, 2])
def test_no_figure_for_a_paper_is_higher_than_its_page(columns: int) -> None:
    t, y = np.arange(50.0), np.zeros((50, 4))
    panels = {f"y{i}": {"nnss": {2: [1.0, 2.0]}} for i in range(16)}
    for drawn in (
        figures.draw_boxplot(panels, dict.fromkeys(panels, "RMSE"), "x", look=Look((), columns)),
        draw_states(t, np.zeros((50, 9)), y, [Axis(f"y{i}", "–") for i in range(4)], "s", "x", look=Look((), columns)),
    ):
        assert drawn.get_figheight() == 9.2
        figures.plt.close(drawn)


def test_an_input_that_alone_is_dense_is_said_to_be_an_envelope_and_a_zoom_has_few_instants() -> None:
    t = np.arange(20_000.0) / 50_000 + 1.3675
    y, u = np.linspace(0, 1, len(t))[:, None], np.sin(np.arange(len(t)) / 2)
    part = slice(9000, 9160)
    figure = draw_simulation(
        t, y, {"nnss": ("", y)}, [Axis("y", "–")], "s", "x", part, (), [(Axis("u", "–"), u)], residuals=True
    )
    panels = np.array(figure.axes).reshape(3, 2)
    titles = [[panel.get_title(loc="left") for panel in row] for row in panels]
    assert titles == [["", "a part of it"], ["", ""], ["envelope: least and largest values", ""]]
    low, high = panels[2, 1].get_xlim()
    assert 2 <= sum(low <= tick <= high for tick in panels[2, 1].get_xticks()) <= 5
    figures.plt.close(figure)


def test_seeds_are_told_of_methods_that_have_some(result: Callable) -> None:
    def title(*methods: str) -> str:
        figure = _boxplot([result(name, seed) for name in methods for seed in range(3 if name == "nnss" else 1)])
        text = " ".join(figure.get_suptitle().split())  # it may be in lines
        figures.plt.close(figure)
        return text.partition("RMSE")[2]

    assert title("n4sid", "ssest") == " of level"
    assert title("nnss") == " of level over 3 seeds"
    assert title("nnss", "n4sid") == " of level over 3 seeds; of methods without seeds one run"


def test_a_test_set_is_called_test_once(result: Callable) -> None:
    figure = _boxplot([result("n4sid", 0, tests=("test_1", "multisine"))])
    assert [panel.get_title() for panel in figure.axes] == ["test_1", "test multisine"]
    assert [panel.get_ylabel() for panel in figure.axes] == ["RMSE [m]"] * 2
    figures.plt.close(figure)


@pytest.mark.system
def test_figures_come_in_formats_and_widths(nnss: Callable) -> None:
    compare = ("compare", "twotank-sim", "--methods", "n4sid", "--orders", "1", "--jobs", "1")
    done = nnss(*compare, "--format", "pdf", "svg", "--columns", "1")
    assert done.code == 0, done.err
    folder = Path("results/twotank-sim/paper")
    made = {path.name for path in folder.iterdir() if path.stem in ("boxplot", "simulation")}
    assert made == {"boxplot.pdf", "boxplot.svg", "simulation.pdf", "simulation.svg"}
    assert 'width="252pt"' in (folder / "simulation.svg").read_text()  # 3.5 inches
    before = (folder / "boxplot.pdf").read_bytes()
    assert nnss("report", "--format", "pdf", "--columns", "1").code == 0
    assert (folder / "boxplot.pdf").read_bytes() == before
    assert "boxplot.pdf" in Path("results/report.md").read_text()
    assert nnss(*compare).code == 0
    made = {path.name for path in folder.iterdir() if path.stem in ("boxplot", "simulation")}
    assert made == {"boxplot.png", "boxplot.svg", "simulation.png"}
    told = nnss("report", "--format", "gif")
    assert (told.code, len(told.err.splitlines())) == (2, 1)
    assert "gif" in told.err
    assert "--columns: expected 1 or 2, found 3" in nnss("report", "--columns", "3").err
    with pytest.raises(InputError):
        Look(("png",), 0)
