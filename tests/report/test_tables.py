"""Tables of a comparison: outputs and test sets apart, digits, notes."""

from collections.abc import Callable
from dataclasses import replace

from nnss_cli.experiment.run import Score
from nnss_cli.report.tables import error_tables, options_apart, rmse_markdown


def test_quartiles_have_three_digits_and_fit_its_column(result: Callable) -> None:
    runs = [result("nnss", seed, error=error) for seed, error in enumerate((251.34, 333.3, 412.7))]
    (table,) = error_tables(runs)
    assert (table.rows[0]["q1–q3"], table.rows[0]["fit"]) == ("292–373", "-233.3")
    assert table.heads["test"] == "test\n[m]"
    assert "RMSE of level [m], test" in table.title
    assert "fit [%]" in rmse_markdown(runs)
    assert "s is the output's standard deviation within the split itself" in rmse_markdown(runs)


def test_outputs_stand_apart_by_their_names(result: Callable) -> None:
    channels = {"inputs": ["u"], "outputs": ["hot", "cold"], "input_units": ["V"], "output_units": ["K", "–"]}
    scores = tuple(Score(s, f"y{i}", float(i), i / 10, 0.0) for s in ("train", "val", "test") for i in (1, 2))
    run = replace(result("nnss", 0), channels=channels, scores=scores)
    tables = error_tables([run])
    assert [table.about["output"] for table in tables] == ["mean of RMSE/σ", "hot [K]", "cold"]
    assert [table.rows[0]["test"] for table in tables] == ["0.15", "1", "2"]
    assert "mean over outputs of RMSE/σ" in tables[0].title
    assert "RMSE of hot [K], test" in tables[1].title
    assert tables[1].heads["test"] == "test\n[K]"
    assert "test" not in tables[2].heads


def test_a_table_says_when_a_method_has_other_options_at_other_orders(result: Callable) -> None:
    runs = [result("nnss", 0, order, settings={"hidden": [order * 10], "epochs": 7}) for order in (2, 3, 4)]
    runs[2] = result("nnss", 0, 4, settings={"hidden": [20], "epochs": 7})
    (line,) = options_apart(runs)
    assert line == "nnss has other options at different orders: hidden 20 at order 2, 4; 30 at order 3."
    assert f"Note: {line}" in rmse_markdown(runs)
    assert options_apart([runs[0], runs[2], result("ssest", 0, settings={"epochs": 8})]) == []
