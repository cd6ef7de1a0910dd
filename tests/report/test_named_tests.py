"""Several named test sets: each is scored, tabled, drawn and weighed by itself."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.record import Dataset

from nnss_cli.errors import InputError
from nnss_cli.experiment.execute import execute, simulate_splits
from nnss_cli.experiment.run import RunSpec
from nnss_cli.experiment.store import Store
from nnss_cli.methods import METHODS
from nnss_cli.report.build import write_report
from nnss_cli.report.cells import plain
from nnss_cli.report.comparison import write_comparison
from nnss_cli.report.standing import effects
from nnss_cli.report.tables import error_tables


@pytest.fixture
def named(small_data) -> Dataset:
    dataset = small_data(K=300)
    (record,) = dataset.tests["test"]
    return replace(dataset, tests={"calm": (record[:50],), "rough": (record[50:], record[:40])})


def run_all(dataset: Dataset, out: Path, methods: tuple[str, ...] = ("n4sid", "ssregest")) -> Store:
    store = Store(out, dataset.name, dataset.protocol)
    for method in methods:
        settings = METHODS[method].settings(dataset.fitting, 2, {})
        execute(
            RunSpec(dataset.name, dataset.protocol, method, 2, 0, settings, dataset.fingerprint(), "1"), dataset, store
        )
    return store


@pytest.mark.system
def test_each_set_is_scored_tabled_and_drawn(named: Dataset, tmp_path: Path) -> None:
    store = run_all(named, tmp_path)
    results = store.results()
    assert [s.split for s in results[0].scores] == ["train", "val", "calm", "rough"]
    tables = error_tables(results)
    assert [table.about["split"] for table in tables] == ["calm", "rough"]
    for table in tables:
        assert list(table.rows[0])[3:7] == ["train", "val", "test", "fit"]
        assert f"test {table.about['split']}" in table.title
        (score,) = (s for s in results[0].scores if s.split == table.about["split"])
        assert plain(table.rows)[0]["test"] == score.rmse
    names = {path.name for path in write_comparison(store)}
    assert {"simulation-calm.png", "simulation-rough.png"} <= names
    text = (store.folder / "rmse.md").read_text()
    assert "## Test calm" in text
    assert "## Test rough" in text
    rows = effects(
        [replace(r, spec=replace(r.spec, method="nnss")) if r.spec.method == "ssregest" else r for r in results], "test"
    )
    assert "| small: calm " in rows
    assert "| small: rough " in rows
    assert "small/strict/simulation-rough.png" in write_report(tmp_path).read_text()


def test_a_set_may_not_take_the_name_of_what_is_fitted_on(named: Dataset) -> None:
    for tests in ({"val": named.tests["calm"]}, {"calm": ()}):
        with pytest.raises(InputError, match="test set"):
            replace(named, tests=tests)


def test_samples_of_the_init_window_are_not_scored(named: Dataset) -> None:
    model = METHODS["n4sid"].fit(named.fitting, 2, 0, {"horizon": "matlab"}, None).model
    windowed = replace(named, fitting=replace(named.fitting, init_window=7))
    scores, signals = simulate_splits(model, windowed)
    for split in ("train", "rough"):
        count = len(windowed.splits()[split])
        e = np.concatenate([(signals[f"{split}/{i}/y_sim"] - signals[f"{split}/{i}/y"])[7:] for i in range(count)])
        (score,) = (s for s in scores if s.split == split)
        assert score.rmse == pytest.approx(np.sqrt(np.mean(e**2)), rel=1e-12)
    record = windowed.fitting.train[0]
    np.testing.assert_array_equal(signals["train/0/y_sim"], model.simulate(record.u, record.y[:7]).y)


def test_the_init_window_is_part_of_the_identity_and_must_fit(named: Dataset) -> None:
    windowed = replace(named, fitting=replace(named.fitting, init_window=7))
    assert windowed.fingerprint() != named.fingerprint()
    with pytest.raises(InputError, match="record 2: expected more than the 45 samples of the init window, found 40"):
        replace(named, fitting=replace(named.fitting, init_window=45))
