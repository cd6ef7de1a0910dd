"""Which files a comparison and a report are made of, and what each figure is given. Drawing itself is left out."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from nnss_cli.errors import InputError
from nnss_cli.experiment.ablation import variant_store
from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.experiment.store import Store
from nnss_cli.report import build, figures, timeplots
from nnss_cli.report.build import write_report
from nnss_cli.report.comparison import write_comparison
from nnss_cli.report.style import Look

CHANNELS = {"inputs": ["u"], "outputs": ["level"], "input_units": ["V"], "output_units": ["m"]}


class Drawn:
    """What figures would have been drawn with, by function; a figure is a namespace."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.calls: dict[str, list[Any]] = {}
        self.closed = 0
        places = {figures: ("draw_boxplot", "draw_ranks"), timeplots: ("draw_simulation", "draw_states")}
        for module, names in places.items():
            for name in names:
                monkeypatch.setattr(module, name, self.recorder(name))
        monkeypatch.setattr(figures, "save_figure", self.save)

    def recorder(self, name: str) -> Callable[..., Any]:
        def draw(*args: Any) -> Any:
            self.calls.setdefault(name, []).append(args)
            return SimpleNamespace(name=name)

        return draw

    def save(self, figure: Any, *paths: Path) -> None:
        for path in paths:
            path.write_text(figure.name)
        self.closed += 1


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    return Drawn(monkeypatch)


def keep(
    store: Store, method: str, seed: int = 0, order: int = 2, lengths: tuple[int, ...] = (4,), error: float = 0.5,
    splits: tuple[str, ...] = ("train", "val", "test"), **about: Any,
) -> RunResult:  # fmt: skip
    """A run on disk whose simulation is off by `error`; without splits, one that diverged."""
    scores = tuple(Score(split, "y1", error, error / 2, 50.0) for split in splits)
    spec = RunSpec(store.dataset, store.protocol, method, order, seed, about.pop("settings", {}), "0", "1")
    known = {"nnss": "1", "python": "3", "machine": "m", "cpu": "c"}
    result = RunResult(
        spec, "ok" if scores else "diverged", "" if scores else "why", scores, 1, 1.5,
        known | about.pop("provenance", {}), {}, CHANNELS, **about,
    )  # fmt: skip
    signals: dict[str, Any] = {"Ts": np.array([0.5])} if splits else {}
    for split in splits:
        for index, K in enumerate(lengths):
            y = np.arange(K, dtype=float)[:, None] + 100 * index
            signals |= {
                f"{split}/{index}/y": y, f"{split}/{index}/y_sim": y + error, f"{split}/{index}/u": -y,
                f"{split}/{index}/x": np.hstack([y, 2 * y]),
            }  # fmt: skip
    store.write(result, signals)
    return result


def names(paths: list[Path]) -> list[str]:
    return [path.name for path in paths]


USUAL = ["rmse.csv", "rmse.md", "boxplot.png", "boxplot.svg", "states.png", "simulation.png"]


def test_a_comparison_has_tables_and_figures_and_drops_those_of_earlier_calls(tmp_path: Path, drawn: Drawn) -> None:
    store = Store(tmp_path, "plant", "own")
    keep(store, "nnss")
    keep(store, "n4sid")
    assert names(write_comparison(store)) == USUAL
    assert sorted(path.name for path in store.folder.iterdir() if path.is_file()) == sorted(USUAL)
    assert drawn.closed == 3
    assert names(write_comparison(store, look=Look(("pdf", "svg")))) == [
        "rmse.csv", "rmse.md", "boxplot.svg", "boxplot.pdf", "states.svg", "states.pdf", "simulation.svg",
        "simulation.pdf",
    ]  # fmt: skip
    assert not list(store.folder.glob("*.png"))
    store.clear(RunSpec("plant", "own", "nnss", 2, 0, {}, "0"))
    assert names(write_comparison(store)) == [name for name in USUAL if not name.startswith("states")]
    assert not list(store.folder.glob("states*"))
    keep(store, "nnss")
    assert names(write_comparison(store)) == USUAL
    store.clear(RunSpec("plant", "own", "nnss", 2, 0, {}, "0"))
    write_comparison(store)  # what is no longer drawn is no longer there, in a format that is wanted, too
    assert not list(store.folder.glob("states*"))


def test_wall_times_are_left_out_where_they_are_not_wanted(tmp_path: Path, drawn: Drawn) -> None:
    store = Store(tmp_path, "plant", "own")
    keep(store, "nnss")
    for times, found in ((True, 1.5), (False, None)):
        write_comparison(store, times)
        column = pd.read_csv(store.folder / "rmse.csv")["fit_seconds"]
        assert set(column.dropna()) == ({found} if found else set())
    write_comparison(store)
    assert pd.read_csv(store.folder / "rmse.csv")["fit_seconds"].notna().all()
    write_report(tmp_path)
    assert pd.read_csv(store.folder / "rmse.csv")["fit_seconds"].notna().all()
    write_report(tmp_path, times=False)
    assert pd.read_csv(store.folder / "rmse.csv")["fit_seconds"].isna().all()


def test_without_runs_there_is_no_comparison_and_no_report(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no finished runs in .*plant.*run 'nnss compare plant' first"):
        write_comparison(Store(tmp_path, "plant", "own"))
    with pytest.raises(InputError, match="no finished runs under"):
        write_report(tmp_path)
    assert not list(tmp_path.iterdir())


def test_runs_that_all_diverged_have_tables_alone(tmp_path: Path, drawn: Drawn) -> None:
    store = Store(tmp_path, "plant", "own")
    keep(store, "nnss", splits=())
    assert names(write_comparison(store)) == ["rmse.csv", "rmse.md"]
    assert drawn.calls == {}


def test_a_simulation_shows_each_methods_best_run_by_validation_over_what_was_measured(
    tmp_path: Path, drawn: Drawn
) -> None:
    store = Store(tmp_path, "plant", "own")
    keep(store, "nnss", 0, error=0.75)
    keep(store, "nnss", 1, 3, error=0.25)
    keep(store, "ssest", error=1.0)
    look = Look(columns=1)
    write_comparison(store, look=look)
    ((time, measured, simulated, outputs, unit, title, zoom, breaks, inputs, residuals, given),) = drawn.calls[
        "draw_simulation"
    ]
    assert (time.tolist(), measured.ravel().tolist()) == ([0.0, 0.5, 1.0, 1.5], [0.0, 1.0, 2.0, 3.0])
    assert {name: (told, (y - measured).ravel().tolist()) for name, (told, y) in simulated.items()} == {
        "nnss": ("(n = 3)", [0.25] * 4), "ssest": ("(n = 2)", [1.0] * 4),
    }  # fmt: skip
    assert [str(axis) for axis in outputs] == ["level [m]"]
    assert (unit, zoom, breaks, residuals, given) == ("s", None, [], True, look)
    assert title == "plant (protocol own): test record, each method's best run by validation"
    ((axis, u),) = inputs
    assert (str(axis), u.tolist()) == ("u [V]", [0.0, -1.0, -2.0, -3.0])
    ((time, states, measured, outputs, unit, title, breaks, given),) = drawn.calls["draw_states"]
    assert states.tolist() == [[0.0, 0.0], [1.0, 2.0], [2.0, 4.0], [3.0, 6.0]]
    assert (measured.ravel().tolist(), unit, breaks, given) == ([0.0, 1.0, 2.0, 3.0], "s", [], look)
    assert title == (
        "plant (protocol own): latent states of the best NN-SS run by validation\n"
        "(n = 3, seed 1; test record, measured outputs on top)"
    )
    ((*_, given),) = drawn.calls["draw_boxplot"]
    assert given == look


def test_several_records_are_drawn_one_after_the_other_and_each_test_set_apart(tmp_path: Path, drawn: Drawn) -> None:
    store = Store(tmp_path, "plant", "own")
    keep(store, "nnss", lengths=(240, 4), splits=("val", "calm", "rough"))
    files = names(write_comparison(store))
    assert files[-2:] == ["simulation-calm.png", "simulation-rough.png"]
    for call, split in zip(drawn.calls["draw_simulation"], ("calm", "rough"), strict=True):
        time, measured, _, _, unit, title, zoom, breaks, *_ = call
        assert title.startswith(f"plant (protocol own): 2 test {split} records, one after the other, each")
        assert (len(time), len(measured), breaks, unit) == (244, 244, [240], "s")
        assert zoom.stop - zoom.start == 60
        assert zoom.stop <= 240  # of the first record, not where the second one jumps
    ((_, states, _, _, _, title, breaks, _),) = drawn.calls["draw_states"]
    assert "2 test calm records" in title
    assert (len(states), breaks) == (244, [240])


def test_validation_is_drawn_where_there_is_no_test(tmp_path: Path, drawn: Drawn) -> None:
    store = Store(tmp_path, "plant", "own")
    keep(store, "nnss", splits=("train", "val"))
    assert names(write_comparison(store))[-1] == "simulation.png"
    assert "validation record" in drawn.calls["draw_simulation"][0][5]
    ((values, labels, title, titles, _),) = drawn.calls["draw_boxplot"]
    assert (values, labels, titles) == ({"val/y1": {"nnss": {2: [0.5]}}}, {"val/y1": "RMSE [m]"}, {"val/y1": ""})
    assert title == "plant (protocol own): validation RMSE of level over 1 seed"


def test_a_report_has_a_section_for_each_comparison_and_one_over_all_of_a_protocol(
    tmp_path: Path, drawn: Drawn
) -> None:
    for dataset, protocol in (("plant", "own"), ("tank", "own"), ("plant", "paper")):
        store = Store(tmp_path, dataset, protocol)
        for seed in (0, 1):
            keep(store, "nnss", seed, error=0.25 + seed / 4)
        keep(store, "ssest", error=0.75)
    keep(Store(tmp_path, "tank", "own"), "nnss", 2, splits=())
    for study in ("class", "recipe"):
        keep(variant_store(Store(tmp_path, "plant", "own"), study, "the recipe as it is"), "nnss")
    path = write_report(tmp_path)
    assert path == tmp_path / "report.md"
    text = path.read_text(encoding="utf-8")
    heads = [line for line in text.splitlines() if line.startswith(("# ", "## "))]
    assert heads == [
        "# Comparison of identification methods", "## All datasets, protocol `own`",
        "## All datasets, protocol `paper`",
        "## plant, protocol `own`", "## plant, protocol `paper`", "## tank, protocol `own`",
    ]  # fmt: skip
    assert text.count("What a reader of protocol `paper` must know") == 1
    plant = text.partition("## plant, protocol `own`")[2].partition("\n## ")[0]
    assert [line for line in plant.splitlines() if line.startswith("###")] == [
        "### Train", "### Validation", "### Test", "### Medians over seeds", "### Optimism of choosing on test",
        "### Study: recipe", "### Study: class", "### Figures",
    ]  # fmt: skip
    assert plant.index("Runs under `") < plant.index("/ablation/recipe/`") < plant.index("/ablation/class/`")
    assert [line for line in plant.splitlines() if line.startswith("![")] == [
        f"![{name} of plant, protocol own](plant/own/{name}.png)" for name in ("boxplot", "states", "simulation")
    ]
    made = "nnss 1, commit unknown, python 3, " + "".join(
        f"{name} unknown, " for name in ("numpy", "scipy", "torch", "numba")
    )
    assert f"3 runs, 0 without a result. Made with {made}machine m, cpu c." in plant
    tank = text.partition("## tank, protocol `own`")[2]
    assert "4 runs, 1 without a result." in tank
    assert "### Runs without a result\n\n- nnss, order 2, seed 2: diverged: why" in tank
    over = text.partition("## All datasets, protocol `own`")[2].partition("\n## ")[0]
    assert [line for line in over.splitlines() if line.startswith("### ")] == [
        "### Test", "### Validation: what methods were stopped and chosen on, so no evidence of how they stand",
        "### Ranks over records",
    ]  # fmt: skip
    assert "2 records with a test: too few" in over
    assert "draw_ranks" not in drawn.calls
    assert text.endswith("\n")


def test_a_method_alone_is_compared_with_nothing(tmp_path: Path, drawn: Drawn) -> None:
    keep(Store(tmp_path, "plant", "paper"), "nnss")
    text = write_report(tmp_path).read_text(encoding="utf-8")
    assert "All datasets" not in text
    assert "What a reader of protocol `paper`" in text


def test_what_is_left_out_is_heard_and_told(tmp_path: Path, drawn: Drawn) -> None:
    store = Store(tmp_path, "plant", "own")
    for seed in (0, 1):
        keep(store, "nnss", seed)
    keep(store, "nnss", 2, settings={"epochs": 3})
    heard: list[str] = []
    text = write_report(tmp_path, tell=heard.append).read_text(encoding="utf-8")
    (line,) = heard
    assert "nnss, order 2, seed 2: another version or other options" in line
    assert f"### Left out\n\n- {line}" in text
    assert "2 runs, 0 without" in text


def test_benchmarks_of_the_package_have_their_source_and_versions_all_stand(tmp_path: Path, drawn: Drawn) -> None:
    store = Store(tmp_path, "twotank", "strict")
    for seed, version in enumerate(("2", "1", "2")):
        keep(store, "n4sid", seed, order=2 + seed, provenance={"numpy": version})
    section = write_report(tmp_path).read_text(encoding="utf-8").partition("## twotank")[2]
    entry = build.BENCHMARKS.usable("twotank")
    assert entry is not None
    assert f"\n\n{entry.title}. Source: {entry.citation}.\n\n" in section
    assert section.index("numpy 1, ") < section.index("; nnss 1, ") < section.index("numpy 2, ")


def ranked(records: int, methods: tuple[str, ...] = ("nnss", "ssest", "n4sid")) -> list[RunResult]:
    errors = {"nnss": 1.0, "ssest": 4.0, "n4sid": 4.0}
    return [
        RunResult(
            RunSpec(f"r{i}", "own", method, 2, 0, {}, "0"), "ok", "",
            (Score("test", "y1", 1.0, errors[method] + 0.01 * i * (1 if method == "ssest" else -1), 0.0),), 1, 1.0, {},
            {}, CHANNELS,
        )
        for i in range(records) for method in methods
    ]  # fmt: skip


@pytest.mark.parametrize(("records", "there"), [(5, False), (6, True)])
def test_ranks_are_drawn_from_six_records_on(records: int, there: bool, tmp_path: Path, drawn: Drawn) -> None:
    text = "\n\n".join(build._overall(ranked(records), "own", tmp_path))
    assert ("draw_ranks" in drawn.calls) is there
    assert ("![critical-difference diagram, protocol own](ranks-own.png)" in text) is there
    assert (tmp_path / "ranks-own.png").exists() is there
    assert drawn.closed == there
    if there:
        ((ranks, level, title),) = drawn.calls["draw_ranks"]
        assert ranks["nnss"] == 1.0
        assert {frozenset(pair) for pair in level} == {
            frozenset(pair) for pair in (("nnss", "ssest"), ("nnss", "n4sid"), ("ssest", "n4sid"))
        }  # three pairs of six records: Holm leaves no chance
        assert title == "Mean ranks over 6 records, protocol own; a bar joins methods not shown to differ at 5 %"


def test_a_bar_joins_only_what_is_not_shown_to_differ(tmp_path: Path, drawn: Drawn) -> None:
    build._overall(ranked(9), "own", tmp_path)
    ((_, level, _),) = drawn.calls["draw_ranks"]
    assert {frozenset(pair) for pair in level} <= {frozenset(("ssest", "n4sid"))}
