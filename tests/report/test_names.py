"""Names of channels are the user's: figures and pages show them as they are, whatever they look like."""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from nnss_cli.datasets.record import Channels

from nnss_cli.errors import FontWarning
from nnss_cli.experiment.agreement import agreeing
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.inspection import examine
from nnss_cli.experiment.store import Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import select
from nnss_cli.report import figures
from nnss_cli.report.build import write_report
from nnss_cli.report.cells import Markup, escaped
from nnss_cli.report.comparison import _boxplot, _simulations
from nnss_cli.report.figures import draw_boxplot, save_figure
from nnss_cli.report.html.looks import looks_of
from nnss_cli.report.html.record import section_of
from nnss_cli.report.inspection import draw_inspection
from nnss_cli.report.simulation import draw_simulated
from nnss_cli.report.style import Axis, axis_label, shortened, stacked_label
from nnss_cli.report.tables import markdown, rmse_markdown, terminal_title
from nnss_cli.report.timeplots import draw_simulation, draw_states
from nnss_cli.testing import small_dataset

FORMULA = r"$\foo$"
"""No formula that matplotlib knows: taken for one, it ends in an error."""
T = np.arange(60.0)
Y = np.sin(T)[:, None]


def boxplot(name: str) -> Figure:
    return draw_boxplot({"y": {"nnss": {2: [1.0, 2.0]}}}, {"y": f"RMSE [{name}]"}, f"RMSE of {name}", {"y": name})


def simulation(name: str, **more: object) -> Figure:
    axis = Axis(name, "V")
    return draw_simulation(T, Y, {"nnss": ("", Y)}, [axis], "s", name, inputs=[(axis, Y[:, 0])] * 2, **more)


def one_input(name: str) -> Figure:
    return draw_simulation(T, Y, {"nnss": ("", Y)}, [Axis(name, "V")], "s", name, inputs=[(Axis(name, "V"), Y[:, 0])])


def states(name: str) -> Figure:
    return draw_states(T, Y, Y, [Axis(name, "V")], "s", name)


def simulated(name: str) -> Figure:
    return draw_simulated(T, Y, Y, Y, Channels((name,), (name,), ("V",), ("V",)), name)


def inspection(name: str) -> Figure:
    u = np.random.default_rng(0).standard_normal(200)
    return draw_inspection(examine({f"u {name}": u}, {f"y {name}": np.roll(u, 1)}, 0.1), name)


DRAWN = (boxplot, simulation, one_input, states, simulated, inspection)


@pytest.mark.parametrize("draw", DRAWN)
def test_a_dollar_sign_of_a_name_is_no_formula(draw: Callable[[str], Figure], tmp_path: Path) -> None:
    figure = draw(FORMULA)
    shown = [text.get_text() for text in figure.findobj(Text) if text.get_visible()]
    assert sum(FORMULA in text for text in shown) >= 2
    save_figure(figure, tmp_path / "figure.png", tmp_path / "figure.svg")


def test_latent_states_are_formulas_still(tmp_path: Path) -> None:
    figure = states("level")
    (label,) = (text for text in figure.findobj(Text) if "x_{1}" in text.get_text())
    assert label.get_parse_math()
    save_figure(figure, tmp_path / "figure.svg")
    assert "x_{1}" not in (tmp_path / "figure.svg").read_text().replace("<!-- $x_{1}$ [–] -->", "")


def test_a_report_survives_a_record_whose_names_look_like_formulas(tmp_path: Path) -> None:
    kept(tmp_path, Channels((FORMULA,), (r"y $\alpha_$",), ("V",), ("m",)))
    page = write_report(tmp_path)
    assert (page.parent / "small" / "own" / "simulation.png").exists()


def test_letters_that_the_font_does_not_have_are_told_once_without_a_path(tmp_path: Path) -> None:
    figures._tell_of_the_font.cache_clear()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for number in range(2):
            save_figure(boxplot("温度 🌡"), tmp_path / f"{number}.png")
    assert [warning.category for warning in told] == [FontWarning]
    assert (tmp_path / "1.png").exists()


def test_other_warnings_of_drawing_are_passed_on(tmp_path: Path) -> None:
    figure = boxplot("y")
    draw = figure.draw
    figure.draw = lambda renderer: warnings.warn("mind this", UserWarning, stacklevel=1) or draw(renderer)  # type: ignore[method-assign]
    with pytest.warns(UserWarning, match="mind this"):
        save_figure(figure, tmp_path / "figure.png")


def test_a_long_name_is_cut_and_its_unit_is_kept() -> None:
    long = "pressure " * 30
    assert axis_label("temperature of the second tank", "K", 16) == "temperature of\nthe second tank\n[K]"
    assert axis_label(long, "bar", 16) == "pressure\npressure…\n[bar]"
    assert axis_label(f"{long}[bar]", "bar", 16).endswith("…\n[bar]")
    assert axis_label(long, "–", 16).splitlines()[-1] == "pressure…"
    assert stacked_label("u [V]", "V", 18) == "u\n[V]"
    assert (shortened("x" * 300, 20), shortened("x" * 20, 20)) == ("x" * 19 + "…", "x" * 20)


@pytest.mark.parametrize("draw", [simulation, one_input, states, simulated])
def test_labels_of_a_long_name_stay_within_the_figure(draw: Callable[[str], Figure], tmp_path: Path) -> None:
    figure = draw("x" * 300)
    figure.suptitle("a title")
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # matplotlib: "constrained_layout not applied"
        figure.canvas.draw()
    labels = [label for axes in figure.axes for label in (axes.yaxis.label, *axes.get_yticklabels())]
    for box in (label.get_window_extent() for label in labels if "x" * 9 in label.get_text()):
        assert box.y0 >= -1
        assert box.y1 <= figure.bbox.height + 1
        assert box.x0 >= -1
    figures.plt.close(figure)


# pages in Markdown

MARKUP = {
    "snake_case_name": "snake_case_name", "a__b": "a__b", "y [V]": "y [V]", "1 < 2 & 3": "1 < 2 & 3",
    "C:\\new": "C:\\new",
    "_x_": r"\_x\_", "x_ y": r"x\_ y", "a*b*": r"a\*b\*", "`x`": r"\`x\`", "a|b": r"a\|b", r"a\|b": r"a\\\|b",
    "[link](http://x)": r"[link\](http://x)", "[a][b]": r"[a\][b]", "<script>": r"\<script>", "</in>": r"\</in>",
    "&amp;": r"\&amp;", "&#65;": r"\&#65;", "~~x~~": r"\~\~x\~\~", "$x$ [$]": r"\$x\$ [\$]",
}  # fmt: skip


@pytest.mark.parametrize(("name", "written"), MARKUP.items())
def test_what_markdown_would_take_for_markup_is_escaped_and_nothing_else(name: str, written: str) -> None:
    assert escaped(name) == written
    head, _, row = markdown([{name: name, "of ours": Markup("**1**")}]).splitlines()
    assert f"| {written} " in head
    assert f"| {written} " in row
    assert "| **1** " in row


def test_names_reach_every_part_of_the_pages_as_text(tmp_path: Path) -> None:
    name, written = "<b>_y_</b> [link](x)", r"\<b>\_y\_\</b> [link\](x)"
    store = kept(tmp_path, Channels(("u",), (name,), ("V",), ("m",)), notes=(f"'{name}' drifts",))
    (run,) = store.results()
    page = write_report(tmp_path).read_text()
    table = (store.folder / "rmse.md").read_text()
    lost = replace(run, status="failed", reason=name, scores=(), spec=replace(run.spec, seed=1))
    rest = rmse_markdown([replace(run, remarks=(name,)), lost], [f"'{name}'"])
    for text in (page, table, rest):
        assert written in text
        assert name not in text
        assert f"Note: '{written}' drifts" in text
    assert rest.count(written) == table.count(written) + 3


# the title of a description


def test_the_title_of_a_dataset_heads_tables_pages_and_figures(tmp_path: Path) -> None:
    channels = Channels(("u",), ("y",), ("V",), ("m",))
    store = kept(tmp_path, channels, title="A *small* plant")
    runs = store.results()
    assert terminal_title(runs).startswith("A *small* plant (small), protocol own: RMSE of y [m], test;")
    page = write_report(tmp_path).read_text()
    assert r"## A \*small\* plant (small), protocol `own`" in page.splitlines()
    assert rmse_markdown(runs).startswith(r"# RMSE of A \*small\* plant (small), protocol `own`")
    drawn = _boxplot(runs)
    assert drawn is not None
    assert drawn.get_suptitle().startswith("A *small* plant (small, protocol own): test RMSE of y")
    (simulation,) = _simulations(store, runs).values()
    assert simulation is not None
    assert simulation.get_suptitle().startswith("A *small* plant (small, protocol own): test record")
    assert section_of(store, agreeing(store, store.read()), looks_of(["n4sid"]), "plant").about == "A *small* plant"
    untitled = [replace(run, title="") for run in runs]
    assert terminal_title(untitled).startswith("small, protocol own: ")
    later = replace(runs[0], title="Renamed", provenance={"finished": "9999"})
    assert terminal_title([*runs, later]).startswith("Renamed (small), ")
    for figure in (drawn, simulation):
        figures.plt.close(figure)


def kept(out: Path, channels: Channels, **more: Any) -> Store:
    """The folder of one run on a small record whose channels have these names."""
    dataset = small_dataset()
    dataset = replace(
        dataset, fitting=replace(dataset.fitting, channels=channels, dataset="small", protocol="own"), **more
    )
    store = Store(out, dataset.name, dataset.protocol)
    (spec,) = plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).todo
    assert execute(spec, dataset, store).status == "ok"
    return store
