"""`fit`, `compare` and `inspect` from Python: the runs and folders of the commands, and the same one-line errors."""

import inspect as signatures
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import nnss_cli
from nnss_cli.errors import InputError
from nnss_cli.testing import small_dataset

QUICK = {"epochs": 1, "hidden": [3], "encoder": [2]}


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """A file of one's own in an empty working folder."""
    monkeypatch.chdir(tmp_path)
    data = small_dataset(K=300)
    records = [*data.fitting.train, *data.fitting.val, *data.tests["test"]]
    u, y = (np.concatenate([getattr(record, name)[:, 0] for record in records]) for name in "uy")
    pd.DataFrame({"u": u, "y": y}).to_csv("plant.csv", index=False)
    return str(tmp_path / "plant.csv")


@pytest.mark.system
def test_compare_gives_tables_and_models(plant: str, nnss: Callable) -> None:
    study = nnss_cli.compare(
        plant, inputs=["u"], outputs=["y"], Ts=0.1, orders=[1, 2], seeds=2, methods=["nnss", "n4sid"], settings=QUICK
    )
    assert isinstance(study.table, pd.DataFrame)
    assert set(study.table["method"]) == {"nnss", "n4sid"}
    assert len(study.results) == 6
    assert len(study.runs) == 18  # train, validation and test of each
    best = study.best()
    errors = study.runs[study.runs["split"] == "val"].set_index(["method", "order", "seed"])["nrmse"]
    assert best.origin is not None
    assert (best.origin.method, best.origin.order, best.origin.seed) == errors.idxmin()
    assert study.best("n4sid", 1).order == 1
    with pytest.raises(InputError, match="of method simba and order any: found n4sid of order 1"):
        study.best("simba")
    before = {path: path.stat().st_mtime_ns for path in Path("results").rglob("run.json")}
    again = nnss_cli.compare(
        [Path(plant)], inputs="u", outputs="y", Ts=0.1, orders=[1, 2], seeds=2, methods=["n4sid"], settings={}
    )
    assert {result.spec.method for result in again.results} == {"n4sid"}
    assert {path: path.stat().st_mtime_ns for path in before} == before  # reused, and by the command too
    done = nnss(
        "compare", plant, "--inputs", "u", "--outputs", "y", "--ts", "0.1", "--orders", "2", "--seeds", "1",
        "--methods", "n4sid",
    )  # fmt: skip
    assert "0 runs to do, 1 done already" in done.out


def test_fit_opens_what_it_trained(plant: str) -> None:
    model = nnss_cli.fit(plant, 2, method="n4sid", inputs=["u"], outputs=["y"], Ts=0.1)
    assert model.folder == Path("results/plant/own/runs/n4sid-n2-s0")
    record = model.records()["test"][0]
    assert np.abs(model.simulate(record.u, record.y[0]).y - record.y)[-20:].max() < 0.1
    dataset = small_dataset()
    own = nnss_cli.fit(dataset, 2, method="n4sid", seed=3, out="elsewhere", settings={"horizon": "auto"})
    assert own.fingerprint == dataset.fingerprint()
    assert nnss_cli.load("elsewhere").folder == own.folder


def test_a_fit_without_a_model_says_why(plant: str) -> None:
    from nnss_cli.api import NoModelError

    wild = QUICK | {"recipe": "paper", "learning_rate": 1e38, "window": 20, "epochs": 5}
    with pytest.raises(NoModelError, match="nnss-n1-s0 diverged: "):
        nnss_cli.fit(
            plant,
            1,
            inputs=["u"],
            outputs=["y"],
            Ts=0.1,
            settings=wild,
        )


def test_inspect_says_what_the_command_says(plant: str) -> None:
    seen = nnss_cli.inspect(plant, inputs=["u"], outputs=["y"], Ts=0.1)
    assert seen.roles.inputs == ("u",)
    assert sum(seen.found.samples) == 300
    assert not seen.guesses


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"inputs": ["v"]}, "has no column 'v'"),
        ({"seeds": 0}, "seeds: expected a whole number of at least 1, found 0"),
        ({"seeds": [3]}, r"seeds: expected a whole number of at least 1, found \[3\]"),
        ({"seeds": 2.0}, "seeds: expected a whole number of at least 1, found 2.0"),
        ({"jobs": 0}, "jobs: expected a whole number of at least 1, found 0"),
        ({"orders": 2}, "orders: expected a list of whole numbers, found 2"),
        ({"orders": [2.0]}, "orders: expected a whole number of at least 1, found 2.0"),
        ({"orders": [True]}, "orders: expected a whole number of at least 1, found True"),
        ({"orders": [0]}, "orders: expected a whole number of at least 1, found 0"),
        ({"orders": ["2"]}, "orders: expected a whole number of at least 1, found '2'"),
        ({"methods": ["magic"]}, "unknown method 'magic'"),
        ({"methods": "n4sid"}, r"methods: expected a list of names, found 'n4sid': write \['n4sid'\]"),
        ({"methods": 5}, "methods: expected a list of names, found 5"),
        ({"settings": ["widths"]}, r"settings: expected values by the name of an option, found \['widths'\]"),
        (
            {"settings": {"widths": 3}},
            r"settings 'widths': no chosen method \(n4sid\) has .*, nor has any other: choose from horizon",
        ),
        ({"settings": {"horizons": 3}}, "nor has any other: did you mean 'horizon'?"),
        ({"settings": {"n4sid.widths": 3}}, "unknown setting 'n4sid.widths': choose from n4sid.horizon"),
        ({"columns": ["u"]}, "unknown argument 'columns': what describes a record is name"),
        ({"orders": None}, "plant has no usual orders"),
        ({"outputs": None}, "outputs: expected"),
    ],
)
def test_wrong_arguments_are_one_line(arguments: dict, told: str, plant: str) -> None:
    given = {"inputs": ["u"], "outputs": ["y"], "Ts": 0.1, "orders": [2], "seeds": 1, "methods": ["n4sid"]} | arguments
    with pytest.raises(InputError, match=told) as error:
        nnss_cli.compare(plant, **given)
    assert "\n" not in str(error.value)
    assert not Path("results/plant/own/runs").exists()


@pytest.mark.parametrize("arguments", [
    {"order": 2.0}, {"order": [2]}, {"order": True}, {"order": "2"}, {"seed": -1}, {"seed": 1.0},
])  # fmt: skip
def test_an_order_or_seed_that_is_no_whole_number_leaves_nothing_behind(arguments: dict, plant: str) -> None:
    """Its run would have had a name under which no later call finds it, and which spoils the folder."""
    given = {"order": 2, "method": "n4sid", "inputs": ["u"], "outputs": ["y"], "Ts": 0.1} | arguments
    with pytest.raises(InputError, match=f"{next(iter(arguments))}: expected a whole number of at least"):
        nnss_cli.fit(plant, **given)
    assert not Path("results/plant/own/runs").exists()


def test_numpys_whole_numbers_are_some(plant: str) -> None:
    record = {"inputs": ["u"], "outputs": ["y"], "Ts": 0.1}
    study = nnss_cli.compare(plant, orders=np.arange(1, 3), seeds=np.int64(1), methods=["n4sid"], **record)
    assert [result.spec.order for result in study.results] == [1, 2]
    assert nnss_cli.fit(plant, np.int64(2), seed=np.int64(0), method="n4sid", **record).order == 2


def test_a_table_is_no_file() -> None:
    for data in (pd.DataFrame({"u": [1.0]}), np.ones((3, 2)), [1, 2], 5, None):
        told = f"data: expected a benchmark's name or files, found {type(data).__name__}"
        with pytest.raises(InputError, match=told):
            nnss_cli.fit(data, 2)


@pytest.mark.parametrize("none", [[], ()])
def test_no_files_are_one_line(none: object) -> None:
    for call in (nnss_cli.inspect, lambda files: nnss_cli.fit(files, 2, inputs="u", outputs="y", Ts=0.1)):
        with pytest.raises(InputError, match="^data: expected a benchmark's name or files, found none$"):
            call(none)


def test_a_dataset_has_it_all() -> None:
    with pytest.raises(InputError, match="Ts: expected for a benchmark or files"):
        nnss_cli.fit(small_dataset(), 2, Ts=0.1)


def test_public_functions_are_typed() -> None:
    for name in ("compare", "fit", "inspect", "load"):
        function = getattr(nnss_cli, name)
        found = signatures.signature(function)
        assert all(parameter.annotation is not signatures.Parameter.empty for parameter in found.parameters.values())
        assert found.return_annotation is not signatures.Signature.empty
        assert "Raises:" in function.__doc__
