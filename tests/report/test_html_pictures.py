"""Pictures of the page: what is thinned keeps its envelope, axes have ticks, values are escaped."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from markupsafe import Markup

from nnss_cli.report.html.looks import looks_of
from nnss_cli.report.html.pictures import HEIGHT, TOP, draw_boxes, draw_curves
from nnss_cli.report.html.svg import Axis, axis_of, few, path, tag
from nnss_cli.report.html.trace import KEPT, STEPS, Panel, Series, draw_trace
from nnss_cli.report.style import log_ticks

LOOKS = looks_of(["nnss", "n4sid"])


def test_children_and_attributes_are_escaped_unless_they_are_markup() -> None:
    made = tag("text", "<b>&", Markup("<i/>"), class_='"><script>', data_x=None)
    assert made == '<text class="&#34;&gt;&lt;script&gt;">&lt;b&gt;&amp;<i/></text>'


@given(st.integers(1, 900), st.integers(1, 60), st.integers(0, 99))
def test_a_thinned_line_has_the_extremes_of_every_bin(K: int, bins: int, seed: int) -> None:
    values = np.random.default_rng(seed).normal(size=K)
    at, shown = few(values, bins)
    assert (values[at.astype(int)] == shown).all()
    assert (np.diff(at) > 0).all()
    if 2 * bins >= K:
        assert len(shown) == K
    else:
        assert len(shown) <= 2 * bins + 2
        for part in np.split(np.arange(K), np.linspace(0, K, bins + 1).astype(int)[1:-1]):
            kept = shown[(at >= part[0]) & (at <= part[-1])]
            assert (kept.min(), kept.max()) == (values[part].min(), values[part].max())


@given(st.floats(-300, 300).map(lambda e: 10.0 ** (e / 30)), st.floats(0.001, 9), st.booleans())
def test_every_axis_has_two_ticks_or_more(low: float, decades: float, logarithmic: bool) -> None:
    ticks = axis_of([low, low * 10.0**decades], logarithmic).ticks()
    assert 2 <= len(ticks) <= 12
    assert all(0 <= tick.at <= 100 for tick in ticks)
    assert len({tick.label for tick in ticks}) == len(ticks)


def test_the_axis_that_had_one_tick_has_more() -> None:
    assert [tick.label for tick in axis_of([95.0, 195.0], True).ticks()] == ["100", "150", "200"]


@given(st.floats(1e-9, 1e6), st.floats(1.06, 1e9))
def test_page_and_figures_have_one_rule_for_logarithmic_ticks(low: float, factor: float) -> None:
    high = low * factor
    assert [tick.label for tick in Axis(low, high, True).ticks()] == [
        f"{value:.6g}" for value in log_ticks(low, high) if low <= value <= high
    ]


def test_axes_of_nothing_of_one_value_and_of_what_is_not_finite() -> None:
    assert axis_of([], True).logarithmic
    assert len(axis_of([3.0, 3.0]).ticks()) >= 2
    assert axis_of([np.inf, np.nan, 0.0, 2.0, 4.0], True).low > 1.9


def test_a_line_breaks_where_it_is_not_finite() -> None:
    x = np.array([0.0, 0.25, 0.5, 0.75, 1.0])
    assert path(x, np.array([0.0, 1.0, np.nan, 0.5, 0.5])) == "M0 1000L250 0M750 500L1000 500"
    assert Axis(1.0, 100.0, True)(10.0) == pytest.approx(0.5)


@pytest.mark.parametrize("K", [2, 500, 2 * KEPT, 40_000])
def test_samples_for_the_script_are_those_of_the_signal(K: int) -> None:
    values = np.random.default_rng(0).normal(size=K).cumsum()
    trace = draw_trace("t", "", "", [Panel("y", [Series("measured", values)])], 0.1, "s", [])
    ((packed,),) = trace.data["panels"]
    found = packed["low"] + np.array(packed["values"]) * (packed["high"] - packed["low"]) / STEPS
    if K <= 2 * KEPT:
        expected = values
        assert trace.shown == ""
    else:
        parts = np.split(values, np.linspace(0, K, KEPT + 1).astype(int)[1:-1])
        expected = np.array([end for part in parts for end in (part.min(), part.max())])
        assert str(K) in trace.shown
    assert np.abs(found - expected).max() <= 0.5001 * np.ptp(values) / STEPS
    assert len(trace.panels[0].lines[0].d) < 11 * 2 * 400


def test_a_box_counts_runs_without_a_result_at_the_top() -> None:
    drawn = draw_boxes("b", "errors", "RMSE", {LOOKS["nnss"]: {2: [0.1, 0.2, np.inf]}, LOOKS["n4sid"]: {2: [0.4]}}).svg
    assert "NN-SS, n = 2: median 0.2, quartiles 0.15 to ∞, range 0.1 to ∞, 2 of 3 runs" in drawn
    assert "N4SID, n = 2: median 0.4, 1 of 1 runs" in drawn
    (rect,) = re.findall(r'<rect [^>]*y="([\d.]+)" height="([\d.]+)"', drawn)
    assert float(rect[0]) == TOP
    assert TOP < float(rect[0]) + float(rect[1]) < HEIGHT


def test_a_curve_tells_its_lowest_and_survives_what_is_not_finite() -> None:
    drawn = draw_curves("c", "loss", "loss", LOOKS["nnss"], 2, {0: [3.0, 1.0, 2.0], 1: [np.nan, np.inf, 2.0]}).svg
    assert "seed 0: 3 epochs, lowest 1 at epoch 2" in drawn
    assert "seed 1: 3 epochs, lowest 2 at epoch 3" in drawn
    assert "nan" not in drawn
