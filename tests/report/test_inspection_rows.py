"""An inspection's tables, every cell; and what its figure draws, of a record made by hand."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from nnss_cli.experiment.inspection_order import OrderCandidate, OrderGuess
from nnss_cli.experiment.inspection_result import Delay, Envelope, Excitation, Inspection, Linearity, Spectrum
from nnss_cli.experiment.inspection_signals import Channel, Clock, Persistency
from nnss_cli.experiment.inspection_split import Part, Split
from nnss_cli.report import inspection as report
from nnss_cli.report.figures import plt

VALVE = Channel(
    "valve", "input", "%", 900, 3, 2, 0.0, 123456.789, 2 / 3, 1.23456, 1201, "continuous", 899,
    0.0123456, 1.0, 11.96578, 0.01234, 0.20456, 0.0, 7, 3, 0, -1.256, 0.5,
)  # fmt: skip
LEVEL = Channel(
    "level", "output", "–", 900, 0, 0, None, None, None, None, 5, "few levels", 12, 0.5, 0.1, None, 0.0, 0.0, 0.0,
    None, None, None, None, None,
)  # fmt: skip
FOUND = Inspection(
    (500, 400), Clock(0.123456789, "given", 0.1, 0.012345, 0, 0, 0, None, None, 0), (VALVE, LEVEL), (),
    (Excitation("valve", Persistency(50, 50, 1e-9, 900), (0.123456, 3.456789), 0.012345),), None,
    Spectrum((0.5, 1.0, 4.0), ("valve", "level"), ((1.0, 0.0, 2.0), (3.0, 2.0, 1.0)), 8, 3.0),
    (Delay("valve", "level", 2, 0.24691358, False, 0.08765, (0.01, -0.02, -0.8765, 0.3)),),
    (Linearity("level", 0.056789, (0.9, 0.8, 0.7), 0.012345, 0.0012345),),
    OrderGuess(2, (OrderCandidate(1, 1.0, 0.43212, 0.98764), OrderCandidate(2, 0.0123456, 0.123456, 0.234567),
                   OrderCandidate(3, None, 0.1, 0.2)), 400, 200, 1.0),
    Split("60/20/20 in time order", (Part(0, 0, 500),), (Part(1, 0, 200),), (Part(1, 200, 400),), ()), (1, 2, 3), 17,
    (), (), (Envelope("valve", (0.0, 1.0, 2.0), (1.0, 2.0, None), (1.0, 2.0, None)),
             Envelope("level", (0.0, 1.0, 2.0), (-1.0, 0.0, 1.0), (1.0, 2.0, 3.0))),
)  # fmt: skip
FITTED, UNKNOWN = replace(FOUND.linearity[0], fitted=True), replace(FOUND.linearity[0], unexplained=None)
NOTHING = replace(FOUND.excitation[0], band=None, near_nyquist=None, persistency=Persistency(3, 50, 1e-9, 9))
UNTIMED = Clock(None, "unknown", None, None, 0, 0, 0, None, None, 0)


def test_columns_are_tabled_with_their_range_and_grid() -> None:
    assert report.channel_rows(FOUND) == [
        {"channel": "valve", "role": "input", "unit": "%", "kind": "continuous", "missing": "3",
         "min": "0", "max": "123500", "mean": "0.6667", "σ": "1.235"},
        {"channel": "level", "role": "output", "unit": "–", "kind": "few levels", "missing": "0",
         "min": "–", "max": "–", "mean": "–", "σ": "–"},
    ]  # fmt: skip
    assert report.grid_rows(FOUND) == [
        {"channel": "valve", "levels": "1201", "step": "0.01235", "bits": "12", "at min": "1.2 %", "at max": "20 %",
         "spikes": "7", "trend [σ]": "-1.26"},
        {"channel": "level", "levels": "5", "step": "–", "bits": "–", "at min": "0 %", "at max": "0 %",
         "spikes": "–", "trend [σ]": "–"},
    ]  # fmt: skip
    assert report.grid_rows(replace(FOUND, channels=(replace(VALVE, bits=3.14159),)))[0]["bits"] == "3.14"


def test_inputs_are_tabled_with_what_they_excite() -> None:
    assert report.input_rows(FOUND) == [
        {"input": "valve", "excites order": "≥ 50", "95 % band [Hz]": "0.123–3.46", "above 0.8 Nyquist": "1.2 %"}
    ]
    assert report.input_rows(replace(FOUND, excitation=(NOTHING,), clock=UNTIMED)) == [
        {"input": "valve", "excites order": "3", "95 % band [1/sample]": "–", "above 0.8 Nyquist": "–"}
    ]


def test_responses_outputs_and_orders_are_tabled() -> None:
    assert report.response_rows(FOUND) == [
        {"input": "valve", "output": "level", "delay [samples]": "2", "delay [s]": "0.2469",
         "largest |correlation|": "0.88", "99 % bound": "0.088"}
    ]  # fmt: skip
    said = [replace(FOUND.delays[0], samples=None, seconds=None, smooth=smooth) for smooth in (True, False)]
    rows = report.response_rows(replace(FOUND, delays=tuple(said)))
    assert [row["delay [samples]"] for row in rows] == ["input too smooth", "none found"]
    assert report.output_rows(FOUND) == [
        {"output": "level", "linearly unexplained": "5.7 %", "by": "coherence",
         "of one-step residual, by products": "1.2 %", "p (linear)": "0.0012"}
    ]  # fmt: skip
    by = [report.output_rows(replace(FOUND, linearity=(each,)))[0]["by"] for each in (FITTED, UNKNOWN)]
    assert by == ["a fitted model", "–"]
    assert report.order_rows(FOUND) == [
        {"order": "1", "Hankel σn/σ1": "1.00e+00", "train [σ]": "0.4321", "validation [σ]": "0.9876"},
        {"order": "2 ←", "Hankel σn/σ1": "1.23e-02", "train [σ]": "0.1235", "validation [σ]": "0.2346"},
        {"order": "3", "Hankel σn/σ1": "–", "train [σ]": "0.1", "validation [σ]": "0.2"},
    ]


def test_the_record_is_tabled_as_a_whole() -> None:
    assert {row["record"]: row[""] for row in report.record_rows(FOUND)} == {
        "samples": "500 + 400", "Ts": "0.123456789 s (given)", "jitter": "1.2 % of a step at most",
        "split": "60/20/20 in time order", "orders": "1 2 3", "init window": "17 samples",
    }  # fmt: skip
    told = {row["record"]: row[""] for row in report.record_rows(replace(FOUND, given=("split", "init_window")))}
    assert (told["split"], told["orders"]) == ("60/20/20 in time order (given)", "1 2 3")
    assert told["init window"] == "17 samples (given)"
    bare = {row["record"]: row[""] for row in report.record_rows(replace(FOUND, samples=(), clock=UNTIMED, orders=()))}
    assert (bare["samples"], bare["Ts"], bare["jitter"], bare["orders"]) == ("0", "unknown", "–", "–")


def test_a_share_is_in_percent_with_three_digits() -> None:
    assert [report.percent(share) for share in (0.123456, 1.0, 0.0, None)] == ["12.3 %", "100 %", "0 %", "–"]
    assert report.percent(0.998, 2) == "100 %"


@pytest.fixture
def drawn() -> Iterator[Any]:
    figures: list[Figure] = []

    def draw(found: Inspection = FOUND, title: str = "a record") -> tuple[Figure, list[Axes]]:
        figures.append(report.draw_inspection(found, title))
        return figures[-1], figures[-1].findobj(Axes)  # type: ignore[return-value]

    yield draw
    for figure in figures:
        plt.close(figure)


def test_every_channel_is_drawn_over_time_and_experiments_are_parted(drawn: Any) -> None:
    _, (valve, level, *_) = drawn()
    curve, parting = valve.lines
    np.testing.assert_array_equal(curve.get_xdata(), [0, 1, 2])
    np.testing.assert_array_equal(curve.get_ydata(), [1, 2, np.nan])
    assert curve.get_drawstyle() == "steps-post"  # an input holds its value
    assert parting.get_xdata()[0] == pytest.approx(500 * 0.123456789)
    assert parting.get_linestyle() == "--"
    (span,) = level.collections  # from smallest to largest, where they differ
    corners = span.get_paths()[0].get_extents()
    assert (corners.x0, corners.x1, corners.y0, corners.y1) == (0, 2, -1, 3)
    assert len(level.lines) == 1
    assert (valve.get_ylabel(), level.get_ylabel()) == ("valve\n[%]", "level")
    assert (valve.get_xlabel(), level.get_xlabel()) == ("", "time [s]")


def test_without_a_clock_the_axes_are_in_samples(drawn: Any) -> None:
    _, (valve, level, left, right, response) = drawn(replace(FOUND, clock=UNTIMED))
    assert level.get_xlabel() == "time [samples]"
    assert valve.lines[1].get_xdata()[0] == 500
    assert (left.get_xlabel(), left.get_ylabel()) == ("frequency [1/sample]", "power density [σ² samples]")
    assert right.get_xlabel() == "frequency [1/sample]"
    assert response.get_xlabel() == "lag [samples]"


def test_an_output_is_drawn_between_its_samples_and_one_record_has_no_parting(drawn: Any) -> None:
    same = Envelope("level", (0.0, 1.0), (1.0, 2.0), (1.0, 2.0))
    _, (valve, level, *_) = drawn(replace(FOUND, samples=(900,), envelopes=(FOUND.envelopes[0], same)))
    assert [line.get_drawstyle() for line in (*valve.lines, *level.lines)] == ["steps-post", "default"]


def test_spectra_and_coherence_are_drawn_over_logarithmic_frequency(drawn: Any) -> None:
    _, (*_, left, right, _response) = drawn()
    assert [line.get_ydata().tolist() for line in left.lines] == [[1, 2e-12, 2], [3, 2, 1]]  # a zero has a floor
    assert all(line.get_xdata().tolist() == [0.5, 1, 4] for line in (*left.lines, *right.lines))
    assert right.lines[0].get_ydata().tolist() == [0.9, 0.8, 0.7]
    assert (left.get_xscale(), left.get_yscale(), right.get_xscale(), right.get_yscale()) == (
        "log",
        "log",
        "log",
        "linear",
    )
    low, high = right.get_ylim()
    assert -0.1 < low < 0 < 1 < high < 1.1
    assert [text.get_text() for text in left.get_legend().get_texts()] == [" valve", " level"]
    assert [text.get_text() for text in right.get_legend().get_texts()] == [" level (unexplained 5.7 %, by coherence)"]
    assert (left.get_ylabel(), right.get_ylabel()) == ("power density [σ²/Hz]", "multiple coherence [–]")
    valve, level = left.lines
    assert valve.get_color() != level.get_color()
    assert right.lines[0].get_color() == level.get_color()
    assert right.lines[0].get_linestyle() == level.get_linestyle()


def test_what_has_no_coherence_says_so(drawn: Any) -> None:
    _, (*_, left, right, _response) = drawn(replace(FOUND, linearity=(replace(FOUND.linearity[0], coherence=()),)))
    assert [text.get_text() for text in right.texts] == ["too short, or no input"]
    assert right.texts[0].get_position() == (0.5, 0.5)
    assert not left.texts
    flat = replace(FOUND.spectrum, density=((0.0, 0.0, 0.0), (3.0, 2.0, 1.0)))
    assert len(drawn(replace(FOUND, spectrum=flat))[1][2].lines) == 1
    _, axes = drawn(replace(FOUND, spectrum=None))
    assert len(axes) == 3
    assert len(drawn(replace(FOUND, delays=()))[1]) == 4


def test_a_response_is_drawn_by_lag_with_its_bound_and_delay(drawn: Any) -> None:
    _, (*_, panel) = drawn()
    stems = [segment.tolist() for segment in panel.collections[0].get_segments()]
    assert stems == [[[lag, 0], [lag, rho]] for lag, rho in enumerate(FOUND.delays[0].correlation)]
    (band,) = panel.patches
    assert (band.get_y(), band.get_height()) == (-0.08765, pytest.approx(2 * 0.08765))
    zero, delay = panel.lines
    assert list(zero.get_ydata()) == [0, 0]
    assert list(delay.get_xdata()) == [2, 2]
    assert panel.get_title() == "valve\ndelay: 2"
    assert panel.get_ylabel() == "level"
    assert len(drawn(replace(FOUND, delays=(replace(FOUND.delays[0], samples=None),)))[1][-1].lines) == 1


def test_every_output_has_a_row_of_responses_and_every_input_a_column(drawn: Any) -> None:
    pairs = tuple(replace(FOUND.delays[0], input=i, output=o, samples=k) for k, (o, i) in enumerate(
        (o, i) for o in ("y1", "y2") for i in ("a", "b", "c")))  # fmt: skip
    _, axes = drawn(replace(FOUND, delays=pairs))
    assert [axis.get_title() for axis in axes[-6:]] == [
        "a\ndelay: 0", "b\ndelay: 1", "c\ndelay: 2", "delay: 3", "delay: 4", "delay: 5",
    ]  # fmt: skip
    assert [axis.get_ylabel() for axis in axes[-6:]] == ["y1", "", "", "y2", "", ""]
    assert [axis.get_xlabel() for axis in axes[-6:]] == [""] * 3 + ["lag [samples]"] * 3


@pytest.mark.parametrize(("inputs", "shown", "said"), [(6, 6, ""), (7, 6, "(1 more channels not shown)")])
def test_six_channels_of_a_role_are_drawn(inputs: int, shown: int, said: str, drawn: Any) -> None:
    channels = tuple(replace(VALVE, name=f"u{i}") for i in range(inputs))
    envelopes = tuple(replace(FOUND.envelopes[0], channel=c.name) for c in channels)
    alone = replace(FOUND, channels=channels, envelopes=envelopes, spectrum=None, delays=(), linearity=())
    figure, axes = drawn(alone)
    assert len(axes) == shown
    assert (figure.get_suptitle()).partition("\n")[2] == said
    assert len({to_hex(axis.lines[0].get_color()) for axis in axes}) == shown


def test_values_beyond_an_axis_are_drawn_over_a_power_of_ten(drawn: Any) -> None:
    for largest, factor, label in (
        (2e30, 1e30, "valve\n[1e30 %]"),
        (1e30, 1.0, "valve\n[%]"),
        (-3.5e45, 1e45, "valve\n[1e45 %]"),
    ):
        channel = replace(VALVE, minimum=min(0.0, largest), maximum=max(0.0, largest))
        envelope = Envelope("valve", (0.0, 1.0), (0.0, largest), (0.0, largest))
        alone = replace(FOUND, channels=(channel,), envelopes=(envelope,), spectrum=None, delays=())
        _, (axis,) = drawn(alone)
        assert axis.lines[0].get_ydata()[1] == pytest.approx(largest / factor)
        assert axis.get_ylabel() == label


def test_long_names_are_wrapped_cut_and_keep_their_unit(drawn: Any) -> None:
    name = "temperature of the water behind the second pump $1"
    _, (axis, *_) = drawn(replace(FOUND, channels=(replace(VALVE, name=name), LEVEL)))
    lines = axis.get_ylabel().split("\n")
    assert len(lines) == 3
    assert (lines[0], lines[2]) == ("temperature of the", "[%]")
    assert max(map(len, lines)) <= 18
    assert lines[1].endswith("…")
    title = "word " * 40
    figure, _ = drawn(title=title)
    first, second = figure.get_suptitle().split("\n")
    assert len(first) == 89  # whole words within 90
    assert len(second) == 90
    assert second.endswith("…")
