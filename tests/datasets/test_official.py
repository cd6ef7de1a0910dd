"""The benchmarks of nonlinearbenchmark.org: split, window and unit, against made-up signals and the official loader."""

import hashlib
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import scipy.io
from nnss_cli.datasets.catalog import BENCHMARKS, cascaded_tanks, ced, emps, load, silverbox, wiener_hammerstein
from nnss_cli.datasets.download import fetch, install
from nnss_cli.datasets.record import Dataset, FloatArray
from real_files import OFFICIAL

from nnss_cli.report.aggregate import published_table

HASHES = {
    "dataBenchmark.mat": "cb2f88d4388be4d3f2a24c6402fba804976aac5f2e1f26cda59ea0a38d016eab",
    "DATAUNIF.MAT": "102c8d8012d6e850d50c13227b8c2280fe69f8bc4a845177f8bc3d761d152c89",
    "DATA_EMPS.mat": "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e",
    "DATA_EMPS_PULSES.mat": "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704",
    "SNLS80mV.csv": "ae62d5a91230c10f76e6dd02c8a4fac3c9d4d8a95fbf50e87cb0c4885003e0f1",
    "WienerHammerBenchMark.mat": "096e6128687efb664d146d28fc17db4c5a94f247c4b3a2e451319be1efb25ae2",
}

Rows = tuple[int, range]
"""Which of the file's records, and its samples (0-based)."""


@dataclass(frozen=True)
class Published:
    """What the official loader and identibench 0.4 lay down for a benchmark."""

    module: ModuleType
    samples: tuple[int, ...]
    """Length of each record in the file."""
    splits: dict[str, tuple[Rows, ...]]
    window: int
    factor: float
    """From the file's unit of the output to that of published scores."""
    unit: str
    Ts: float
    loader: str
    """Name in `nonlinear_benchmarks`."""
    folder: str = ""
    """Folder in the official zip."""


PUBLISHED = {
    "cascaded-tanks": Published(
        cascaded_tanks, (1024, 1024),
        {"train": ((0, range(160, 1024)),), "val": ((0, range(160)),), "test": ((1, range(1024)),)},
        50, 1, "V", 4.0, "Cascaded_Tanks", "CascadedTanksFiles/",
    ),
    "silverbox": Published(
        silverbox, (131072,),
        {
            "train": ((0, range(40650, 90650)),),
            "val": ((0, range(90650, 105712)),),
            "multisine": ((0, range(105712, 127400)),),
            "arrow_full": ((0, range(100, 40575)),),
            "arrow_no_extrapolation": ((0, range(100, 32100)),),
        },
        50, 1000, "mV", 1 / 610.35, "Silverbox", "SilverboxFiles/",
    ),
    "wiener-hammerstein": Published(
        wiener_hammerstein, (188000,),
        {
            "train": ((0, range(5200, 85200)),),
            "val": ((0, range(85200, 105200)),),
            "test": ((0, range(105200, 184000)),),
        },
        50, 1000, "mV", 1 / 51200, "WienerHammerBenchMark",
    ),
    "emps": Published(
        emps, (24841, 24841),
        {"train": ((0, range(18000)),), "val": ((0, range(18000, 24841)),), "test": ((1, range(24841)),)},
        20, 1000, "mm", 0.001, "EMPS",
    ),
    "ced": Published(
        ced, (500, 500),
        {
            "train": ((0, range(300)), (1, range(300))),
            "val": ((0, range(300, 400)), (1, range(300, 400))),
            "test_1": ((0, range(400, 500)),),
            "test_2": ((1, range(400, 500)),),
        },
        10, 1, "ticks/s", 0.02, "CED",
    ),
}  # fmt: skip


def made_up(case: Published) -> list[tuple[FloatArray, FloatArray]]:
    """Samples that are all different."""
    random = np.random.default_rng(5)
    return [(random.standard_normal((K, 1)), random.standard_normal((K, 1))) for K in case.samples]


@pytest.mark.parametrize("name", PUBLISHED)
def test_every_split_is_these_samples_in_the_unit_of_published_scores(name: str) -> None:
    case = PUBLISHED[name]
    records = made_up(case)
    dataset: Dataset = case.module.split(*(signal for record in records for signal in record), "official")
    assert (dataset.name, dataset.protocol) == (name, "official")
    splits = dataset.splits()
    assert list(splits) == list(case.splits)
    for split, parts in case.splits.items():
        assert len(splits[split]) == len(parts)
        for record, (number, rows) in zip(splits[split], parts, strict=True):
            u, y = records[number]
            np.testing.assert_array_equal(record.u, u[list(rows)], err_msg=split)
            np.testing.assert_array_equal(record.y, case.factor * y[list(rows)], err_msg=split)
            assert record.Ts == pytest.approx(case.Ts, rel=1e-12)
    fitting = dataset.fitting
    assert fitting.init_window == case.window
    assert fitting.channels.output_units == (case.unit,)
    trained = np.concatenate([case.factor * records[number][1][list(rows)] for number, rows in case.splits["train"]])
    np.testing.assert_allclose(fitting.scaling.y_mean, trained.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(fitting.scaling.y_std, trained.std(axis=0, ddof=1), rtol=1e-9)


@pytest.mark.parametrize("name", PUBLISHED)
def test_what_is_tested_on_is_in_no_part_that_is_fitted_on(name: str) -> None:
    splits = PUBLISHED[name].splits
    seen = {(number, k) for split in ("train", "val") for number, rows in splits[split] for k in rows}
    dataset = PUBLISHED[name].module.split(*(s for record in made_up(PUBLISHED[name]) for s in record), "official")
    fitted = np.concatenate([record.y for split in ("train", "val") for record in dataset.splits()[split]])
    assert len(np.unique(fitted)) == len(seen)
    for records in dataset.tests.values():
        for record in records:
            assert not np.isin(record.y, fitted).any()


@pytest.mark.parametrize("name", PUBLISHED)
def test_an_official_benchmark_says_what_a_reader_must_know(name: str) -> None:
    entry = BENCHMARKS[name]
    assert entry.protocols == ("official",)
    assert not entry.presets
    dataset = PUBLISHED[name].module.split(*(s for record in made_up(PUBLISHED[name]) for s in record), "official")
    assert any("identibench 0.4" in note and "published models were trained on" in note for note in dataset.notes)
    assert not any("\n" in note for note in dataset.notes)
    year = {"cascaded-tanks": 2017, "silverbox": 2013, "wiener-hammerstein": 2009, "emps": 2019, "ced": 2017}[name]
    assert str(year) in entry.citation


# The real files, where they are


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_files_are_those_whose_hashes_are_known(name: str, official: Callable[[str], Path]) -> None:
    folder = official(name)
    for file in OFFICIAL[name]:
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == HASHES[file]
    stated = [part for source in BENCHMARKS[name].sources for part in (source.parts or (source,)) if part.sha256]
    assert {part.filename: part.sha256 for part in stated}.items() <= HASHES.items()


@pytest.mark.parametrize("name", PUBLISHED)
def test_fetch_from_a_mirror_then_load(name: str, official: Callable[[str], Path], own_cache: Path) -> None:
    path = fetch(BENCHMARKS[name], mirror=str(official(name)), offline=True)
    assert sorted(p.name for p in own_cache.iterdir()) == [path.name, path.name + ".sha256"]
    dataset = load(name)
    expected = {split: [len(rows) for _, rows in parts] for split, parts in PUBLISHED[name].splits.items()}
    assert {split: [len(record) for record in records] for split, records in dataset.splits().items()} == expected


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """A download would fail at once."""
    import socket

    def refuse(*_: object, **__: object) -> None:
        raise OSError("no network in this test")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)


ZIPS = {
    "cascaded-tanks": "Cascaded_Tanks/CascadedTanksFiles.zip",
    "silverbox": "Silverbox/SilverboxFiles.zip",
    "wiener-hammerstein": "WienerHammerBenchMark/WienerHammerBenchMark.mat",
    "emps": "EMPS/EMPS.zip",
    "ced": "CED/FULLTEXT01.zip",
}


def as_downloaded(name: str, files: Path, base: Path) -> Path:
    """The cache of `nonlinear_benchmarks` as it is after a download, and in it the file that was downloaded."""
    target = base / ZIPS[name]
    target.parent.mkdir()
    if target.suffix != ".zip":
        target.write_bytes((files / target.name).read_bytes())
        return target
    if name == "silverbox":  # its zip has the samples as MATLAB's rows too, and that is what the official loader reads
        V1, V2 = np.loadtxt(files / "SNLS80mV.csv", delimiter=",", skiprows=1, usecols=(0, 1)).T
        contents = target.parent / "SNLS80mV.mat"
        scipy.io.savemat(contents, {"V1": V1[None], "V2": V2[None]})
        members = {contents.name: contents.read_bytes()}
    else:
        members = {file: (files / file).read_bytes() for file in OFFICIAL[name]}
    with zipfile.ZipFile(target, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(f"{PUBLISHED[name].folder}read me.txt", "of no use")
        for member, content in members.items():
            archive.writestr(PUBLISHED[name].folder + member, content)
    with zipfile.ZipFile(target) as archive:
        archive.extractall(target.parent)
    return target


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_official_loader_splits_likewise(
    name: str, official: Callable[[str], Path], tmp_path: Path, no_network: None
) -> None:
    """Samples, lengths, window and Ts against `nonlinear-benchmarks`, given the same file."""
    reference = pytest.importorskip("nonlinear_benchmarks")
    case = PUBLISHED[name]
    base = tmp_path / "theirs"
    base.mkdir()
    downloaded = as_downloaded(name, official(name), base)
    train, tests = getattr(reference, case.loader)(
        dir_placement=str(base), atleast_2d=True, always_return_tuples_of_datasets=True
    )
    train, tests = (tuple(side) if isinstance(side, list | tuple) else (side,) for side in (train, tests))

    install(BENCHMARKS[name], downloaded)
    dataset = load(name)
    splits = dataset.splits()
    for number, theirs in enumerate(train):
        ours = [splits["train"][number], splits["val"][number]]
        if name == "cascaded-tanks":
            ours.reverse()  # there the first samples validate
        np.testing.assert_array_equal(np.concatenate([record.u for record in ours]), theirs.u)
        np.testing.assert_array_equal(np.concatenate([record.y for record in ours]), case.factor * theirs.y)
    assert len(splits["train"]) == len(splits["val"]) == len(train)
    assert len(dataset.tests) == len(tests)
    for (record,), theirs in zip(dataset.tests.values(), tests, strict=True):
        np.testing.assert_array_equal(record.u, theirs.u)
        np.testing.assert_array_equal(record.y, case.factor * theirs.y)
        assert dataset.fitting.init_window == theirs.state_initialization_window_length
        # the file's time axis of EMPS is rounded to 24 bits
        assert record.Ts == pytest.approx(float(theirs.sampling_time), rel=1e-4 if name == "emps" else 1e-12)


def test_published_errors_are_of_these_test_sets_and_units() -> None:
    for name, published in PUBLISHED.items():
        rows = published_table().query(f"dataset == '{name}'")
        assert set(rows["test_set"]) == set(published.splits) - {"train", "val"}
        assert set(rows["unit"]) == {published.unit}
