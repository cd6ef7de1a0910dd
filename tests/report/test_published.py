"""Our place among published errors: from validation alone, failures counted, only under protocol official."""

from dataclasses import replace

from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.report.aggregate import published_table
from nnss_cli.report.published import OTHERWISE, PAPERS, paper_places, published_comparison

CHANNELS = {"inputs": ["u"], "outputs": ["y"], "input_units": ["V"], "output_units": ["V"]}


def run(method: str, order: int, seed: int, val: float, protocol: str = "official", **tests: float) -> RunResult:
    """One with these errors; diverged where there are no test errors."""
    errors = {"val": val, **tests} if tests else {}
    scores = tuple(Score(split, "y1", error, error / 2, 0.0) for split, error in errors.items())
    spec = RunSpec("cascaded-tanks", protocol, method, order, seed, {}, "0", "1")
    return RunResult(spec, "ok" if scores else "diverged", "" if scores else "why", scores, 1, 1.0, {}, {}, CHANNELS)


def rows(text: str) -> list[list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines[2:]]


def test_a_place_is_that_of_the_median_at_the_order_that_validates_best() -> None:
    runs = [run("nnss", 2, seed, 0.3, test=error) for seed, error in enumerate((0.30, 0.35, 0.32))]
    runs += [run("nnss", 3, seed, 0.4, test=0.01) for seed in range(3)]  # better on test: no say
    found = rows(published_comparison(runs))
    errors = [float(row[2]) for row in found]
    assert errors == sorted(errors)
    (ours,) = (row for row in found if "nnss" in row[1])
    assert ours == ["3", "**nnss, order 2**", "0.32", "0.3–0.35", "3/3 runs"]  # after 0.191 and 0.306
    published = published_table()
    assert len(found) == 1 + (published["dataset"] == "cascaded-tanks").sum()


def test_failed_runs_count() -> None:
    runs = [run("nnss", 2, 0, 0.3, test=0.2), run("nnss", 2, 1, 0.3), run("nnss", 2, 2, 0.3)]
    assert "nnss" not in published_comparison(runs)  # no order validates: its median is ∞
    runs = [run("nnss", 2, seed, 0.3, test=0.2) for seed in range(3)] + [run("nnss", 2, 3, 0.3)]
    assert "3/4 runs" in published_comparison(runs)


def test_other_protocols_and_records_have_no_place() -> None:
    assert published_comparison([run("nnss", 2, 0, 0.3, "strict", test=0.2)]) == ""
    other = run("nnss", 2, 0, 0.3, test=0.2)
    assert published_comparison([replace(other, spec=replace(other.spec, dataset="plant"))]) == ""


def test_sources_are_named_with_what_differs() -> None:
    text = published_comparison([run("nnss", 2, 0, 0.3, test=0.2)])
    for source in published_table().query("dataset == 'cascaded-tanks'")["source"].unique():
        assert source in text
        assert OTHERWISE.get(source, "") in text


def papers(method: str, seed: int, error: float | None, order: int = 3) -> RunResult:
    found = run(method, order, seed, 0.3, "paper", **({} if error is None else {"test": error}))
    return replace(found, spec=replace(found.spec, dataset="twotank"))


def test_our_place_beside_the_paper_and_its_released_models() -> None:
    runs = [papers("nnss", seed, error) for seed, error in enumerate((0.015, 0.03, 0.016))]
    runs += [papers("n4sid", 0, 0.051), papers("nnss", 0, 0.02, order=7)]  # nothing is known of order 7
    text = paper_places(runs)
    found = rows(text)
    assert [row[0] for row in found] == [str(place) for place in range(1, len(found) + 1)]
    errors = [float(row[2]) for row in found]
    assert errors == sorted(errors)
    assert [row[1] for row in found][:3] == ["nnss", "**nnss**", "nnss"]  # 0.01 printed, ours 0.016, 0.0211 released
    assert [row[4] for row in found][:3] == ["[1]", "3/3 runs", "[2]"]
    assert found[2][3].count("–") == 1
    assert "**n4sid**" in [row[1] for row in found]
    assert "Order 3, y [V], test:" in text
    assert "Order 7" not in text
    for note in PAPERS.values():
        assert note in text
    lost = paper_places([*runs[:1], papers("nnss", 1, None), papers("nnss", 2, None)])
    assert rows(lost)[-1][1:3] == ["**nnss**", "∞"]
    assert paper_places([run("nnss", 2, 0, 0.3, "strict", test=0.2)]) == ""
