"""What of a record has changed since its runs were made is told where they are to be gone on with."""

import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from nnss_cli.datasets.record import Dataset, Record

from nnss_cli.errors import InputError
from nnss_cli.experiment.changed import changed_data
from nnss_cli.experiment.execute import execute
from nnss_cli.experiment.store import SIGNALS, Store
from nnss_cli.experiment.sweep import plan
from nnss_cli.methods import select
from nnss_cli.testing import small_dataset


def touched(dataset: Dataset, **fitting: Any) -> Dataset:
    return replace(dataset, fitting=replace(dataset.fitting, **fitting))


def at_another_rate(dataset: Dataset) -> Dataset:
    parts = {name: tuple(Record(one.u, one.y, 0.25) for one in records) for name, records in dataset.splits().items()}
    return Dataset(replace(dataset.fitting, train=parts["train"], val=parts["val"]), {"test": parts["test"]})


CHANGES_OF_DATA: dict[str, Callable[[Dataset], Dataset]] = {
    "names ('u1' instead of 'valve')": lambda d: touched(d, channels=replace(d.fitting.channels, inputs=("valve",))),
    "units ('m' instead of 'mm')": lambda d: touched(d, channels=replace(d.fitting.channels, output_units=("mm",))),
    "Ts (0.5 s instead of 0.25 s)": at_another_rate,
    "init window (1 instead of 3)": lambda d: touched(d, init_window=3),
    "samples of val": lambda d: touched(d, val=d.fitting.train),
    "samples of test": lambda d: Dataset(d.fitting, {"test": d.fitting.val}),
    "scaling": lambda d: touched(d, scaling=replace(d.fitting.scaling, u_mean=d.fitting.scaling.u_mean + 1)),
}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Store:
    dataset = small_dataset()
    store = Store(tmp_path_factory.mktemp("finished"), dataset.name, dataset.protocol)
    (spec,) = plan(store, dataset, select(["n4sid"]), [2], [0], {}, False).todo
    assert execute(spec, dataset, store).status == "ok"
    return store


@pytest.mark.parametrize("words", CHANGES_OF_DATA)
def test_what_of_the_data_has_changed_is_told(words: str, finished: Store) -> None:
    changed = CHANGES_OF_DATA[words](small_dataset())
    with pytest.raises(InputError, match=rf"names or units\), here its {re.escape(words)}: take another folder"):
        plan(finished, changed, select(["n4sid"]), [2], [0], {}, False)


def test_without_the_samples_names_and_units_are_told_alone(finished: Store) -> None:
    (run,) = finished.results()
    dataset = touched(small_dataset(), init_window=3)
    path = finished.run_folder(run.spec) / SIGNALS
    kept = path.read_bytes()
    path.unlink()
    try:
        assert changed_data(finished, run, dataset) == ""
        renamed = CHANGES_OF_DATA["names ('u1' instead of 'valve')"](dataset)
        assert changed_data(finished, run, renamed) == "names ('u1' instead of 'valve')"
    finally:
        path.write_bytes(kept)
