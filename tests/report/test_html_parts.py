"""Parts of the HTML page by hand: its verdict, what its pictures are drawn from, and its table of stability."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nnss_cli.experiment.run import RunResult
from nnss_cli.report.html import certificate, signals
from nnss_cli.report.html.looks import looks_of
from nnss_cli.report.html.overview import standings

MIMO = {
    "inputs": ["valve", "pump"], "outputs": ["level", "flow"], "input_units": ["%", "V"], "output_units": ["cm", "l/s"],
}  # fmt: skip
RECORDS = {"train": (6,), "val": (5,), "warm": (4, 3), "cold": (2,)}


@pytest.mark.parametrize(("seeds", "settled"), [(4, False), (8, True)])
def test_the_first_is_settled_where_its_intervals_hold_at_95_percent(
    seeds: int, settled: bool, result: Callable[..., RunResult]
) -> None:
    """Four seeds hold at 88 %, however far apart the methods are."""
    runs = [result(method, seed, error=error) for seed in range(seeds) for method, error in (("nnss", 1), ("simba", 4))]
    (found,) = standings(runs, "test", looks_of(["nnss", "simba"]))
    assert found.ratio == 0.25  # of the first over the next
    assert found.first.look.method == "nnss"
    assert (found.settled, len(found.beaten), len(found.undecided)) == (settled, settled, not settled)
    assert (found.bounds.coverage >= 0.95) == settled


@pytest.fixture
def store() -> Any:
    """Signals of a run by split, record and channel, no two alike; those of ssest are twice those of nnss."""

    def kept(spec: Any) -> dict[str, np.ndarray]:
        scale, found = 2.0 if spec.method == "ssest" else 1.0, {"Ts": np.array([0.5])}
        for split, lengths in RECORDS.items():
            for index, K in enumerate(lengths):
                random = np.random.default_rng([ord(split[0]), index])
                names = {"u": 2, "y": 2, "y_sim": 2, "x": 3}
                parts = {name: random.standard_normal((K, c)) for name, c in names.items()}
                parts["y_sim"] *= scale
                found |= {f"{split}/{index}/{name}": values for name, values in parts.items()}
        return found

    return SimpleNamespace(signals=kept)


def whole(store: Any, spec: Any, split: str, name: str) -> np.ndarray:
    return np.concatenate([store.signals(spec)[f"{split}/{i}/{name}"] for i in range(len(RECORDS[split]))])


def test_traces_are_of_each_test_set_by_channel(
    store: Any, result: Callable[..., RunResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "draw_trace", lambda *drawn: drawn)
    runs = [replace(result(m, tests=("warm", "cold")), channels=MIMO) for m in ("nnss", "ssest")]
    found = signals.simulation_traces(store, runs, looks_of(["nnss", "ssest"]), "plant")
    assert [len(drawn[3][0].series[0].values) for drawn in found] == [7, 2]
    for split, (_, _, _, panels, step, unit, starts) in zip(("warm", "cold"), found, strict=True):
        assert (step, unit, starts) == (0.5, "s", [4] if split == "warm" else [])
        u, y = (whole(store, runs[0].spec, split, name) for name in ("u", "y"))
        titles = [panel.title for panel in panels]
        assert titles == [
            "level [cm]", "residual of level [cm]", "flow [l/s]", "residual of flow [l/s]", "valve [%]", "pump [V]",
        ]  # fmt: skip
        for i in range(2):
            measured, *simulated = panels[2 * i].series
            np.testing.assert_array_equal(measured.values, y[:, i])
            for run, line, residual in zip(runs, simulated, panels[2 * i + 1].series, strict=True):
                own = whole(store, run.spec, split, "y_sim")[:, i]
                np.testing.assert_array_equal(line.values, own)
                np.testing.assert_array_equal(residual.values, y[:, i] - own)
                assert line.look.method == residual.look.method == run.spec.method
            np.testing.assert_array_equal(panels[4 + i].series[0].values, u[:, i])
            assert panels[4 + i].series[0].held


def test_states_are_those_of_the_first_test_set(
    store: Any, result: Callable[..., RunResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(signals, "draw_trace", lambda *drawn: drawn)
    runs = [replace(result(m, tests=("warm", "cold")), channels=MIMO) for m in ("nnss", "ssest")]
    _, title, _, panels, *_ = signals.state_trace(store, runs, looks_of(["nnss", "ssest"]), "plant")
    assert "(n = 2, seed 0)" in title
    x = whole(store, runs[0].spec, "warm", "x")
    for i, panel in enumerate(panels):
        assert panel.title == f"state x{i + 1} [–]"
        np.testing.assert_array_equal(panel.series[0].values, x[:, i])
    assert signals.state_trace(store, runs[1:], looks_of(["ssest"]), "plant") is None


def test_the_table_of_stability_has_the_largest_of_all_runs(
    result: Callable[..., RunResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Wherever it stands: the first of three has the largest state, the second the largest radius."""
    kept = {0: (0.5, 9.0), 1: (0.9, 2.0), 2: (0.7, 3.0)}
    monkeypatch.setattr(
        certificate, "_model", lambda _, run: ({"kind": "linear"}, {"A": np.diag([kept[run.spec.seed][0], 0.1])})
    )
    store = SimpleNamespace(signals=lambda spec: {"test/0/x": np.array([[0.0, 1.0], [kept[spec.seed][1], 0.0]])})
    (row,) = certificate.certificate_table(store, [result("simba", seed) for seed in kept])  # type: ignore[arg-type]
    assert (row["order"], row["method"], row["runs"]) == ("2", "simba", "3")
    assert (row["ρ(A) of a linear model, largest"], row["‖x‖ on the records, largest"]) == ("0.9", "9")
    assert row["promised"] == "nothing; its A is fixed, so ρ(A) decides"
