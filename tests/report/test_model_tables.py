"""What a model's folder holds, and what differs between two folders, as rows."""

from types import SimpleNamespace
from typing import Any

import pytest

from nnss_cli.report.cells import Cell, plain, whole
from nnss_cli.report.listing import difference_rows, group_rows, run_rows
from nnss_cli.report.simulation import array_rows, channel_rows, model_rows, setting_rows

TRAINING = {
    "dataset": "tank", "protocol": "own", "data": "ab12", "method": "nnss", "version": "3", "seed": 0,
    "provenance": {"nnss": "1", "numpy": "2"}, "notes": ["n1", "n2"], "remarks": ["r1", "r2"],
    "settings": {"hidden": [8, 4], "rate": 0.00123456789, "epochs": 7, "stability": "schur"},
}  # fmt: skip
SHOWN: dict[str, Any] = {
    "kind": "nnss", "format": 2, "order": 3, "Ts": 0.1234567891, "init_window": 1, "training": TRAINING,
    "description": {"architecture": {"states": 3, "hidden": [8, 4], "gamma": 0.25, "feedthrough": False, "no": None,
                                     "nested": {"x": 1}}, "other": 9},
    "channels": {"inputs": ["u"], "outputs": ["y", "z"], "input_units": ["V"], "output_units": ["m", "–"]},
    "scaling": {"u_mean": [1.0], "u_std": [2.0], "y_mean": [3.0, 5.0], "y_std": [4.0, 6.0]},
    "arrays": {"A": {"shape": [3, 2], "dtype": "F64"}, "b": {"shape": [], "dtype": "F32"}},
}  # fmt: skip


def told(shown: dict[str, Any]) -> dict[str, str]:
    return {row[""]: row["value"] for row in model_rows(shown)}


def test_a_model_is_told_with_where_it_comes_from() -> None:
    assert told(SHOWN) == {
        "kind": "nnss (folder of format 2)", "order": "3", "sampling time": "0.123456789 s", "init window": "1",
        "states": "3", "hidden": "8 4", "gamma": "0.25", "feedthrough": "False",
        "data": "tank (own), fingerprint ab12", "method": "nnss, version 3, seed 0", "made with": "nnss 1, numpy 2",
        "notes": "n1; n2", "remarks": "r1; r2",
    }  # fmt: skip


def test_what_is_not_known_of_a_model_has_no_row() -> None:
    bare = told(SHOWN | {"training": None, "description": {"states": 3}})
    assert list(bare) == ["kind", "order", "sampling time", "init window", "states"]
    quiet = {name: value for name, value in TRAINING.items() if name not in ("notes", "remarks")}
    assert not {"notes", "remarks", "members"} & set(told(SHOWN | {"training": quiet}))


def test_an_ensemble_is_told_by_its_number_of_members() -> None:
    ensemble = told(SHOWN | {"description": {"members": [{}, {}, {}], "weights": [1, 2]}})
    assert ensemble["members"] == "3"
    assert "weights" not in ensemble


def test_channels_have_the_mean_and_deviation_of_their_own_kind() -> None:
    rows = channel_rows(SHOWN)
    assert [tuple(row.values()) for row in rows] == [
        ("input", "u", "V", "1", "2"), ("output", "y", "m", "3", "4"), ("output", "z", "–", "5", "6"),
    ]  # fmt: skip
    assert list(rows[0]) == ["", "name", "unit", "mean", "deviation"]
    assert {(row["mean"], row["deviation"]) for row in channel_rows(SHOWN | {"scaling": None})} == {("–", "–")}


def test_arrays_and_settings_are_told_by_name() -> None:
    assert array_rows(SHOWN) == [
        {"array": "A", "shape": "3 × 2", "type": "F64"}, {"array": "b", "shape": "1", "type": "F32"},
    ]  # fmt: skip
    assert setting_rows(SHOWN) == [
        {"setting": "hidden", "value": "8 4"}, {"setting": "rate", "value": "0.00123457"},
        {"setting": "epochs", "value": "7"}, {"setting": "stability", "value": "schur"},
    ]  # fmt: skip
    assert setting_rows(SHOWN | {"training": None}) == setting_rows(SHOWN | {"training": {}}) == []


def difference(first: Any, second: Any, change: float | None) -> Any:
    return SimpleNamespace(name="tank/own/nnss-n2-s0", what="RMSE test y1", first=first, second=second, change=change)


@pytest.mark.parametrize(
    ("first", "second", "change", "cells"),
    [
        (2.0, 3.0, 0.5, ("2", "3", "+50 %")), (2.0, 1.0, -0.5, ("2", "1", "-50 %")),
        (1.0, 1.0123, 0.0123, ("1", "1.012", "+1.2 %")), (0.0, 1.0, None, ("0", "1", "–")),
        (None, 1.0, None, ("–", "1", "–")), ("ok", "failed", None, ("ok", "failed", "–")),
    ],
)  # fmt: skip
def test_a_difference_stands_with_both_sides_and_its_change(
    first: Any, second: Any, change: float | None, cells: tuple[str, ...]
) -> None:
    (row,) = difference_rows([difference(first, second, change)])
    assert (row["run"], row["what"]) == ("tank/own/nnss-n2-s0", "RMSE test y1")
    assert (row["A"], row["B"], row["change"]) == cells
    (machine,) = plain([row])
    assert (machine["A"], machine["B"], machine["change"]) == (first, second, change)


def test_cells_for_machines_keep_their_value() -> None:
    rows = [{"a": whole(3), "b": "–", "c": "text", "d": Cell("1–2", {"low": 1.0, "high": 2.0}), "e": Cell("1", 1.234)}]
    assert plain(rows) == [{"a": 3, "b": None, "c": "text", "low": 1.0, "high": 2.0, "e": 1.234}]


def entry(dataset: str, protocol: str, method: str, order: int, status: str = "ok", **more: Any) -> Any:
    scores = (SimpleNamespace(split="test", output="y1", rmse=1.0, nrmse=2.0),) if status == "ok" else ()
    spec = SimpleNamespace(method=method, order=order, data="d", version="", settings={"hidden": [3], "x": ""})
    result = SimpleNamespace(
        spec=spec, status=status, reason="" if status == "ok" else "why", scores=scores, fit_seconds=0.5, epochs=0,
        provenance={}, notes=("a", "b"), remarks=("c", "d"), channels={"outputs": ["y"]},
    )  # fmt: skip
    return SimpleNamespace(
        store=SimpleNamespace(dataset=dataset, protocol=protocol), result=result, label="", fault="", folder="f", **more
    )


def test_groups_are_in_order_and_count_what_has_no_result_by_its_status() -> None:
    rows = group_rows([
        entry("b", "own", "nnss", 2), entry("a", "strict", "nnss", 2), entry("a", "own", "nnss", 10),
        entry("a", "own", "nnss", 9, "failed"), entry("a", "own", "nnss", 9, "diverged"),
        entry("a", "own", "nnss", 9, "failed"), entry("a", "own", "nnss", 9),
    ])  # fmt: skip
    assert [(row["dataset"], row["protocol"], row["n"]) for row in rows] == [
        ("a", "own", "9"), ("a", "own", "10"), ("a", "strict", "2"), ("b", "own", "2"),
    ]  # fmt: skip
    assert (rows[0]["ok"], rows[0]["else"], rows[0]["test"]) == ("1/4", "2 failed 1 diverged", "∞")
    (machine, *_) = plain(rows)
    assert (machine["ok"], machine["runs"], machine["n"], machine["test"]) == (1, 4, 9, float("inf"))


def test_a_run_is_told_without_what_is_empty() -> None:
    assert {row[""]: row["found"] for row in run_rows(entry("a", "own", "nnss", 2, "failed"))} == {
        "status": "failed", "reason": "why", "fit [s]": "0.5", "epochs": "0", "data": "d", "hidden": "[3]",
        "notes": "a b", "remarks": "c d", "folder": "f",
    }  # fmt: skip


def test_the_error_of_a_group_is_on_its_first_test_set_with_three_digits() -> None:
    one = entry("a", "own", "nnss", 2)
    one.result.scores = tuple(
        SimpleNamespace(split=split, output="y1", rmse=rmse, nrmse=9.0)
        for split, rmse in (("train", 7.0), ("calm", 1.23456), ("rough", 5.0))
    )
    (row,) = group_rows([one])
    assert row["test"] == "1.23"
