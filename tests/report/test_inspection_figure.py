"""The figure and tables of an inspection: nothing overlaps, nothing fails, no NaN."""

from collections.abc import Iterator
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from conftest import slow_but
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.transforms import Bbox
from nnss_cli.datasets.record import FloatArray
from scipy.signal import lfilter

from nnss_cli.experiment.inspection import examine
from nnss_cli.experiment.inspection_result import Inspection
from nnss_cli.report import inspection as report
from nnss_cli.report.figures import plt, save_figure

LONG = "the_setting_of_the_main_steam_valve_of_boiler_number_2_before_the_turbine", "feed water, after the second pump"
LONG_OUTPUTS = "pressure behind the superheater at the turbine inlet (absolute)", "_level$ of drum_1$"


@cache
def record(r: int, m: int, names: bool = False, K: int = 900) -> Inspection:
    random = np.random.default_rng(0)
    u = random.standard_normal((K, r))
    y = lfilter([0, 1.0], [1, -0.8], u.sum(1))[:, None] + random.standard_normal((K, m))
    inputs = LONG if names else [f"u{i}" for i in range(r)]
    outputs = LONG_OUTPUTS if names else [f"y{i}" for i in range(m)]
    return examine(
        {inputs[i]: u[:, i] for i in range(r)}, {outputs[i]: y[:, i] for i in range(m)}, 0.1,
        units={inputs[0]: "% of full opening", outputs[0]: "kPa"} if r and m else {},
    )  # fmt: skip


def texts(figure: Figure) -> Iterator[tuple[str, Bbox]]:
    figure.canvas.draw()
    hidden = set()  # tick labels outside the view, which matplotlib keeps but does not draw
    for axis in (axis for axes in figure.findobj(Axes) for axis in (axes.xaxis, axes.yaxis)):
        low, high = sorted(axis.get_view_interval())
        for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
            if not low <= tick.get_loc() <= high:
                hidden |= {id(tick.label1), id(tick.label2)}
    for text in figure.findobj(Text):
        if text.get_visible() and text.get_text().strip() and id(text) not in hidden:
            yield text.get_text(), text.get_window_extent()


@pytest.mark.parametrize(
    ("r", "m", "names"), slow_but(range(4), [(1, 1, False), (2, 2, True), (0, 1, False), (1, 0, False), (8, 7, False)])
)
def test_no_text_overlaps_or_leaves_the_figure(r: int, m: int, names: bool) -> None:
    figure = report.draw_inspection(record(r, m, names), "a record, with a title that is not short at all")
    found = list(texts(figure))
    assert len(found) > 10
    assert any("3 more channels not shown" in text for text, _ in found) is (r + m == 15)  # six of each role
    for (one, a), (two, b) in combinations(found, 2):
        shared = Bbox.intersection(a, b)
        assert shared is None or min(shared.width, shared.height) < 1, (one, two)  # pixels
    for text, box in found:
        assert min(box.x0, box.y0) >= -1, text
        assert box.x1 <= figure.bbox.width + 1, text
        assert box.y1 <= figure.bbox.height + 1, text
    plt.close(figure)


def test_labels_carry_units_and_lines_differ_in_grey() -> None:
    found = record(2, 2, names=True)
    figure = report.draw_inspection(found, "x")
    said = " ".join(text for text, _ in texts(figure))
    for words in ("time [s]", "frequency [Hz]", "[σ²/Hz]", "[kPa]", "lag [samples]", "multiple coherence [–]"):
        assert words in said
    assert "$ of drum" in said
    assert not any(text.get_parse_math() for text in figure.findobj(Text) if "$" in text.get_text())
    (spectra,) = (axes for axes in figure.findobj(lambda a: hasattr(a, "get_ylabel")) if "density" in axes.get_ylabel())
    assert len({(line.get_linestyle(), str(line._dash_pattern)) for line in spectra.lines}) == 4
    plt.close(figure)


@pytest.mark.system
def test_twelve_channels_are_apart_in_colour_and_line() -> None:
    figure = report.draw_inspection(record(8, 7), "x")
    (spectra,) = (axes for axes in figure.findobj(lambda a: hasattr(a, "get_ylabel")) if "density" in axes.get_ylabel())
    assert len(spectra.lines) == 12
    assert len({line.get_color() for line in spectra.lines}) == 12
    assert len({(line.get_linestyle(), str(line._dash_pattern)) for line in spectra.lines}) == 12
    plt.close(figure)


@pytest.mark.parametrize("Ts", [0.1, 1228.0, 1e-5])
def test_logarithmic_axes_have_plain_numbers_that_do_not_touch(Ts: float) -> None:
    """Labels such as 3 × 10⁻⁴ and 4 × 10⁻⁴ ran into each other where a short record spans less than a decade."""
    u = np.random.default_rng(0).standard_normal(200)
    y = lfilter([0, 1.0], [1, -0.8], u)
    figure = report.draw_inspection(examine({"u [V]": u}, {"y": y}, Ts, units={"u [V]": "V"}), "x")
    found = list(texts(figure))
    assert not any("times" in text or "^{" in text for text, _ in found)
    for (one, a), (two, b) in combinations(found, 2):
        shared = Bbox.intersection(a, b)
        assert shared is None or min(shared.width, shared.height) < 1, (one, two)
    assert "u\n[V]" in [text for text, _ in found]  # the unit once
    plt.close(figure)


@pytest.mark.system
def test_equal_records_give_equal_files(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        save_figure(report.draw_inspection(record(1, 1), "x"), tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def all_rows(found: Inspection) -> list[dict[str, str]]:
    tables = (
        report.record_rows, report.channel_rows, report.grid_rows,
        report.input_rows, report.response_rows, report.output_rows,
        report.order_rows,
    )  # fmt: skip
    return [row for table in tables for row in table(found)]


def test_rows_say_what_is_known() -> None:
    found = record(1, 1)
    assert report.response_rows(found)[0]["delay [samples]"] == "1"
    assert report.response_rows(found)[0]["delay [s]"] == "0.1"
    assert report.input_rows(found)[0]["excites order"] == "≥ 50"
    assert sum("←" in row["order"] for row in report.order_rows(found)) == 1
    random = np.random.default_rng(1)
    apart = examine({"u": random.standard_normal(500)}, {"y": random.standard_normal(500)})
    assert report.response_rows(apart)[0]["delay [samples]"] == "none found"
    assert report.response_rows(apart)[0]["delay [s]"] == "–"


SIGNAL = hnp.arrays(np.float64, 40, elements=st.sampled_from([0.0, 1.0, 2.5, -1e308, 1.7e308, 5e-324, np.nan]))


@pytest.mark.system
@settings(max_examples=12)
@given(st.lists(SIGNAL, max_size=3), st.integers(0, 3), st.sampled_from([None, 1e-9]), st.sampled_from([0, 1, 3, 40]))
def test_any_record_is_drawn_and_tabled(columns: list[FloatArray], r: int, Ts: float | None, K: int) -> None:
    named = {f"c{i}": column[:K] for i, column in enumerate(columns)}
    inputs = dict(list(named.items())[:r])
    found = examine(inputs, {name: x for name, x in named.items() if name not in inputs}, Ts)
    figure = report.draw_inspection(found, "nasty")
    figure.canvas.draw()
    plt.close(figure)
    for row in all_rows(found):
        assert not {"nan", "inf", "None"} & set(row.values()), row
