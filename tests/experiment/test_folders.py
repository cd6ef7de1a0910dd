"""Runs of results folders: which may stand in one table, what is listed, joined and compared, on made-up runs."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nnss_cli.errors import InputError
from nnss_cli.experiment import agreement
from nnss_cli.experiment.agreement import OTHER_DATA, agreeing, conflict, difference, telling, unlike
from nnss_cli.experiment.collection import entries, merge, remove
from nnss_cli.experiment.comparison import Difference, compared
from nnss_cli.experiment.run import RunResult, RunSpec, Score
from nnss_cli.experiment.store import Store
from nnss_cli.version import __version__

CHANNELS = {"inputs": ["u"], "outputs": ["y"], "input_units": ["V"], "output_units": ["m"]}


def spec(method: str = "nnss", order: int = 2, seed: int = 0, **about: Any) -> RunSpec:
    known = {"dataset": "tank", "protocol": "own", "settings": {"epochs": 3}, "data": "d1", "version": "1"} | about
    return RunSpec(method=method, order=order, seed=seed, **known)


def result(which: RunSpec, error: float = 0.5, status: str = "ok", **provenance: str) -> RunResult:
    scores = (Score("test", "y1", error, error / 2, 50.0),) if status == "ok" else ()
    made = {"nnss": __version__, "numpy": "2"} | provenance
    return RunResult(which, status, "" if scores else "why", scores, 1, 1.5, made, {}, CHANNELS)  # type: ignore[arg-type]


def keep(out: Path, one: RunResult) -> Store:
    """On disk, with signals that are off by what it scored."""
    store = Store(out, one.spec.dataset, one.spec.protocol)
    y = np.zeros((4, 1))
    signals = {"Ts": np.array([1.0])}
    for score in one.scores:
        prefix = f"{score.split}/0"
        signals |= {f"{prefix}/u": y, f"{prefix}/y": y, f"{prefix}/y_sim": y + score.rmse, f"{prefix}/x": y}
    store.write(one, signals if one.scores else {})
    return store


def damage(store: Store, which: RunSpec) -> None:
    (store.run_folder(which) / "run.json").write_text("{", encoding="utf-8")


# which runs may stand in one table


@pytest.mark.parametrize(
    ("made", "why"),
    [
        (result(spec()), ""), (result(spec(data="d2")), OTHER_DATA),
        (result(spec(data="d2", method="ssest")), OTHER_DATA),
        (result(spec(method="ssest", settings={}), nnss="0"), ""), (result(spec(order=3, settings={})), ""),
        (result(spec(), nnss="0.0"), f"nnss 0.0 instead of {__version__}"),
        (replace(result(spec()), provenance={}), f"nnss unknown instead of {__version__}"),
        (result(spec(version="2")), "version 2 of the method instead of 1"),
        (result(spec(version="")), "version unknown of the method instead of 1"),
        (result(spec(settings={"epochs": 4, "new": 1})), "epochs 4 instead of 3, new 1 instead of None"),
        (result(spec(settings={})), "epochs None instead of 3"),
        (result(spec(settings={"epochs": 3, "threads": 2})), ""),
    ],
)  # fmt: skip
def test_a_finished_run_may_be_mixed_with_one_of_the_same_data_version_and_options(made: RunResult, why: str) -> None:
    assert difference(spec(), made) == why
    told = f"{made.spec.method}, order {made.spec.order}, with {why}" if why else ""
    assert conflict(spec(), [result(spec("ssest", 9)), made]) == told


def test_the_first_run_that_must_not_be_mixed_is_named() -> None:
    found = [result(spec()), result(spec("ssest", 9, data="d9")), result(spec(version="2"))]
    assert conflict(spec(), found) == f"ssest, order 9, with {OTHER_DATA}"
    assert conflict(spec(), []) == ""


def test_tuples_and_lists_are_the_same_option() -> None:
    assert difference(spec(settings={"hidden": (3, 4)}), result(spec(settings={"hidden": [3, 4]}))) == ""
    assert difference(spec(settings={"hidden": (3,)}), result(spec(settings={"hidden": [4]}))) == (
        "hidden [4] instead of [3]"
    )
    assert telling({"threads": 2, "epochs": 1}) == {"epochs": 1}


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (spec(), ""), (spec("ssest", data="d2"), OTHER_DATA), (spec("ssest", version="9"), ""),
        (spec(order=3, version="9", settings={}), ""), (spec(version="9"), "version 9 of nnss instead of 1"),
        (spec(version=""), "version unknown of nnss instead of 1"),
        (spec(settings={"epochs": 5}), "other options of nnss: epochs 5 instead of 3"),
        (spec(settings={"epochs": 3, "threads": 4}), ""),
    ],
)  # fmt: skip
def test_whoever_made_it_a_run_of_other_data_version_or_options_is_unlike(other: RunSpec, why: str) -> None:
    assert unlike(spec(), [result(other, nnss="0")]) == why
    assert unlike(spec(), [result(spec()), result(other)]) == why
    assert unlike(replace(spec(), version=""), [result(spec())]) == "version 1 of nnss instead of unknown"


def test_the_larger_group_makes_the_table_and_what_is_left_out_is_told(tmp_path: Path) -> None:
    for seed, data in enumerate(("d1", "d1", "d2")):
        store = keep(tmp_path, result(spec(seed=seed, data=data)))
    keep(tmp_path, result(spec("ssest", settings={"a": 1}), finished="1"))
    keep(tmp_path, result(spec("ssest", seed=1, settings={"a": 2}), finished="2"))
    keep(tmp_path, result(spec("ssest", 3, seed=1, settings={"a": 3})))
    keep(tmp_path, result(spec("ssest", 3, seed=2, settings={"a": 3, "threads": 2})))
    keep(tmp_path, result(spec("ssest", 3, seed=0, version="9", settings={"a": 3}), finished="9"))
    table = agreeing(store, store.read(), {"ssest-n3-s2": "not asked for"})
    assert [r.spec.label for r in table.results] == ["nnss-n2-s0", "nnss-n2-s1", "ssest-n2-s1", "ssest-n3-s0"]
    where = f"'{store.folder}': "
    rest = "; remove them with 'nnss results rm', or run them again with --force"
    assert table.left_out == [
        "not asked for", f"{where}nnss, order 2, seed 2: {OTHER_DATA} than most runs there{rest}",
        f"{where}ssest, order 2, seed 0: another version or other options than most runs of it there{rest}",
        f"{where}ssest, order 3, seed 1: another version or other options than most runs of it there{rest}",
    ]  # fmt: skip
    assert [r.spec.seed for r in agreeing(store, store.read()).results if r.spec.order == 3] == [1, 2]
    empty = Store(tmp_path, "none", "own")
    assert agreeing(empty, empty.read()) == agreement.Table([], [])


# listing and taking away


def test_runs_are_found_by_pattern_and_status(tmp_path: Path) -> None:
    keep(tmp_path, result(spec()))
    keep(tmp_path, result(spec(seed=1), status="failed"))
    store = keep(tmp_path, result(spec("ssest", 3)))
    keep(tmp_path, result(spec("ssest", dataset="plant")))
    damage(store, spec("ssest", 3))

    def found(*patterns: str, statuses: tuple[str, ...] = ()) -> list[str]:
        return [entry.name for entry in entries(tmp_path, patterns, statuses)]

    everything = ["plant/own/ssest-n2-s0", "tank/own/nnss-n2-s0", "tank/own/nnss-n2-s1", "tank/own/ssest-n3-s0"]
    assert found() == everything
    assert found("nnss-*") == everything[1:3]
    assert found("tank/*") == everything[1:]
    assert found("plant/own/*", "*-s1") == [everything[0], everything[2]]
    assert found("NNSS-*") == []
    assert found(statuses=("ok",)) == everything[:2]
    assert found(statuses=("failed", "damaged")) == everything[2:]
    assert found("nnss-*", statuses=("ok",)) == everything[1:2]
    with pytest.raises(InputError, match="status 'foo'"):
        found(statuses=("ok", "foo"))
    *_, damaged = entries(tmp_path)
    assert damaged.result is None
    assert "run.json" in damaged.fault
    assert damaged.folder == store.run_folder(spec("ssest", 3))


def test_a_run_that_another_command_is_at_is_not_taken_away(tmp_path: Path) -> None:
    store = keep(tmp_path, result(spec()))
    keep(tmp_path, result(spec(seed=1)))
    with store.lock(spec(seed=1)) as held:
        assert held
        gone = {entry.label: taken for entry, taken in remove(entries(tmp_path))}
    assert gone == {"nnss-n2-s0": True, "nnss-n2-s1": False}
    assert [entry.label for entry in entries(tmp_path)] == ["nnss-n2-s1"]


# joining


def test_runs_of_other_folders_are_copied_where_they_agree(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    keep(here, result(spec()))
    keep(here, result(spec(seed=1)))
    keep(here, result(spec(seed=5)))
    store = keep(here, result(spec(seed=6)))
    damage(store, spec(seed=6))
    keep(there, result(spec()))  # the same
    other = keep(there, result(spec(seed=1), 0.75))  # another score
    keep(there, result(spec(seed=2)))  # new
    keep(there, result(spec(seed=6)))
    keep(there, result(spec("ssest", 3)))
    keep(there, result(spec("nnss", dataset="plant")))
    merged = merge([there], here)
    assert merged.same == ["tank/own/nnss-n2-s0"]
    assert merged.copied == ["plant/own/nnss-n2-s0", "tank/own/nnss-n2-s2", "tank/own/ssest-n3-s0"]
    first, second = merged.left_out
    assert first == f"'{other.run_folder(spec(seed=1))}': another run of this name is there, with other scores"
    assert second.startswith(f"'{other.run_folder(spec(seed=6))}': the run of this name is damaged there: ")
    kept = store.find(spec(seed=1))
    assert kept is not None
    assert kept.scores[0].rmse == 0.5  # nothing is replaced
    assert store.signals(spec(seed=2))["test/0/y_sim"].tolist() == [[0.5]] * 4
    again = merge([there], here)
    assert (again.copied, len(again.same)) == ([], 4)


@pytest.mark.parametrize(
    ("which", "status", "why"),
    [
        (spec(seed=7, data="d2"), "ok", f"runs there are of {OTHER_DATA}"),
        (spec(seed=7, settings={"epochs": 4}), "ok", "runs there are of other options of nnss: epochs 3 instead of 4"),
        (spec(version="2"), "ok", "another run of this name is there, with version 1 of nnss instead of 2"),
        (spec(), "failed", "another run of this name is there, with other scores"),
    ],
)  # fmt: skip
def test_a_run_that_does_not_go_with_those_here_is_left_out_with_the_reason(
    which: RunSpec, status: str, why: str, tmp_path: Path
) -> None:
    store = keep(tmp_path / "here", result(spec()))
    source = keep(tmp_path / "there", result(which, status=status))
    merged = merge([tmp_path / "there"], tmp_path / "here")
    assert merged.left_out == [f"'{source.run_folder(which)}': {why}"]
    assert (merged.copied, merged.same, len(store.results())) == ([], [], 1)


def test_a_run_that_is_being_written_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keep(tmp_path / "there", result(spec()))

    @contextlib.contextmanager
    def busy(*_: object) -> Iterator[bool]:
        yield False

    monkeypatch.setattr(Store, "lock", busy)
    merged = merge([tmp_path / "there"], tmp_path / "here")
    (line,) = merged.left_out
    assert line.endswith("another command is at the run of this name there")
    assert not merged.copied


def test_folders_without_runs_are_refused(tmp_path: Path) -> None:
    keep(tmp_path / "there", result(spec()))
    (tmp_path / "empty").mkdir()
    for call in (
        lambda: merge([tmp_path / "there", tmp_path / "empty"], tmp_path / "here"),
        lambda: compared(tmp_path / "there", tmp_path / "empty"),
        lambda: compared(tmp_path / "empty", tmp_path / "there"),
    ):
        with pytest.raises(InputError, match="no runs under '.*empty'"):
            call()


def test_hidden_files_and_links_are_not_copied(tmp_path: Path) -> None:
    source = keep(tmp_path / "there", result(spec()))
    folder = source.run_folder(spec())
    (folder / ".hidden").write_text("x")
    (folder / "link").symlink_to(folder / "run.json")
    (folder / "model.json").write_text("{}")
    merge([tmp_path / "there"], tmp_path / "here")
    copied = {path.name for path in Store(tmp_path / "here", "tank", "own").run_folder(spec()).iterdir()}
    assert copied == {"run.json", "signals.safetensors", "model.json"}


# comparing


def pair(tmp_path: Path, one: RunResult | None, other: RunResult | None, tolerance: float = 0.0) -> Any:
    for name, made in (("a", one), ("b", other)):
        keep(tmp_path / name, result(spec("always", settings={})))
        if made:
            keep(tmp_path / name, made)
    return compared(tmp_path / "a", tmp_path / "b", tolerance)


NAME = "tank/own/nnss-n2-s0"


@pytest.mark.parametrize(
    ("one", "other", "found"),
    [
        (result(spec()), result(spec()), []), (None, None, []),
        (result(spec()), None, [Difference(NAME, "run", "there", "missing")]),
        (None, result(spec()), [Difference(NAME, "run", "missing", "there")]),
        (result(spec()), result(spec(), 0.75), [Difference(NAME, "RMSE test y1", 0.5, 0.75)]),
        (result(spec()), result(spec(), status="failed"),
         [Difference(NAME, "status", "ok", "failed"), Difference(NAME, "RMSE test y1", 0.5, None)]),
        (result(spec(), status="failed"), result(spec()),
         [Difference(NAME, "status", "failed", "ok"), Difference(NAME, "RMSE test y1", None, 0.5)]),
        (result(spec()), result(spec(data="d2", version="2", settings={"epochs": 4, "hidden": [3, 4], "threads": 9})),
         [Difference(NAME, "data", "d1", "d2"), Difference(NAME, "method's version", "1", "2"),
          Difference(NAME, "epochs", "3", "4"), Difference(NAME, "hidden", "None", "3 4")]),
        (result(spec()), result(spec(), numpy="3", cpu="x"), [Difference(NAME, "numpy", "2", "3")]),
        (result(spec()), replace(result(spec()), provenance={"nnss": __version__}),
         [Difference(NAME, "numpy", "2", "unknown")]),
    ],
)  # fmt: skip
def test_runs_of_two_folders_differ_in_what_is_told(
    one: RunResult | None, other: RunResult | None, found: list[Difference], tmp_path: Path
) -> None:
    told = pair(tmp_path, one, other)
    assert told.differing == found
    assert told.equal == 1 + (one is not None and not found)
    assert told.faults == []


@pytest.mark.parametrize(("now", "tolerance", "same"), [(0.625, 0.25, True), (0.626, 0.25, False), (0.375, 0.25, True),
                                                         (0.374, 0.25, False), (0.5, 0.0, True)])  # fmt: skip
def test_errors_within_the_tolerance_are_the_same(now: float, tolerance: float, same: bool, tmp_path: Path) -> None:
    told = pair(tmp_path, result(spec()), result(spec(), now), tolerance)
    assert (told.differing == []) is same


def test_a_damaged_run_is_compared_with_nothing(tmp_path: Path) -> None:
    pair(tmp_path, result(spec()), result(spec(), 0.75))
    damage(Store(tmp_path / "b", "tank", "own"), spec())
    told = compared(tmp_path / "a", tmp_path / "b")
    assert (told.equal, told.differing, len(told.faults)) == (1, [], 1)
    damage(Store(tmp_path / "a", "tank", "own"), spec())
    assert len(compared(tmp_path / "a", tmp_path / "b").faults) == 2


@pytest.mark.parametrize(
    ("first", "second", "change"),
    [(2.0, 3.0, 0.5), (2.0, 1.0, -0.5), (0.0, 1.0, None), (None, 1.0, None), (1.0, None, None), ("a", 1.0, None),
     (1.0, "a", None), (2.0, 0.0, -1.0)],
)  # fmt: skip
def test_a_change_is_relative_to_the_first(first: Any, second: Any, change: float | None) -> None:
    assert Difference("x", "y", first, second).change == change
