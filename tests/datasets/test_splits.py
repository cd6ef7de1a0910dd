"""Every split sample by sample, on made-up signals of the records' shapes: no file is needed.

The paper's splits are 1-based and inclusive in its code; here they stand as 0-based rows.
"""

from collections.abc import Callable

import numpy as np
import pytest
from nnss_cli.datasets.catalog import powerplant, robotarm, twotank
from nnss_cli.datasets.record import Dataset, FloatArray, Record

Rows = np.ndarray


def made_up(K: int, channels: int, seed: int) -> FloatArray:
    """Samples that are all different, with another mean and deviation in every part of the record."""
    random = np.random.default_rng(seed)
    k = np.arange(K)[:, None]
    return k * (1 + np.arange(channels)) + 0.1 * random.random((K, channels)) * (1 + k) + 1e6 * seed


TANKS = (made_up(3000, 1, 1), made_up(3000, 1, 2))
PLANT = (made_up(200, 5, 3), made_up(200, 3, 4))
ARM = tuple((made_up(19838, 1, 5 + 2 * i), made_up(19838, 1, 6 + 2 * i)) for i in range(3))


def arm(protocol: str, records: int) -> Dataset:
    return robotarm.split(tuple(Record(u, y, 0.0005) for u, y in ARM[:records]), protocol)


def rows(*ranges: tuple[int, int]) -> Rows:
    return np.concatenate([np.arange(start, stop) for start, stop in ranges])


KEPT = np.array([10 * k for k in range(1980)])  # the robot arm's samples that the paper's code keeps

# name: (how it is split, Ts, {split: (u, y) and its rows}, rows of the statistics)
CASES: dict[str, tuple[Callable[[], Dataset], float, dict[str, tuple[tuple, Rows]], tuple[tuple, Rows]]] = {
    "twotank paper": (
        lambda: twotank.split("tanks", *TANKS, "paper"),
        0.2,
        {
            "train": (TANKS, rows((0, 1499), (1498, 1499))),
            "val": (TANKS, rows((1499, 1999))),
            "test": (TANKS, rows((1499, 2999))),
        },
        (TANKS, rows((0, 1499), (1498, 1499))),
    ),
    "twotank strict": (
        lambda: twotank.split("tanks", *TANKS, "strict"),
        0.2,
        {
            "train": (TANKS, rows((0, 1500))),
            "val": (TANKS, rows((1500, 2000))),
            "test": (TANKS, rows((2000, 3000))),
        },
        (TANKS, rows((0, 1500))),
    ),
    "powerplant paper": (
        lambda: powerplant.split(*PLANT, "paper"),
        1228.8,
        {"train": (PLANT, rows((0, 100))), "val": (PLANT, rows((100, 149))), "test": (PLANT, rows((149, 199)))},
        (PLANT, rows((0, 200))),
    ),
    "powerplant strict": (
        lambda: powerplant.split(*PLANT, "strict"),
        1228.8,
        {"train": (PLANT, rows((0, 100))), "val": (PLANT, rows((100, 150))), "test": (PLANT, rows((150, 200)))},
        (PLANT, rows((0, 100))),
    ),
    "robotarm paper": (
        lambda: arm("paper", 2),
        0.005,
        {"train": (ARM[0], KEPT), "val": (ARM[1], KEPT)},
        (ARM[0], KEPT),
    ),
    "robotarm paper, complete": (
        lambda: arm("paper", 3),
        0.005,
        {"train": (ARM[0], KEPT), "val": (ARM[1], KEPT), "test": (ARM[2], KEPT)},
        (ARM[0], KEPT),
    ),
    "robotarm strict": (
        lambda: arm("strict", 2),
        0.005,
        {"train": (ARM[0], KEPT), "val": (ARM[1], KEPT[:990]), "test": (ARM[1], KEPT[990:])},
        (ARM[0], KEPT),
    ),
    "robotarm strict, complete": (
        lambda: arm("strict", 3),
        0.005,
        {"train": (ARM[0], KEPT), "val": (ARM[1], KEPT[:990]), "test": (ARM[2], KEPT)},
        (ARM[0], KEPT),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_every_split_is_these_samples(case: str) -> None:
    make, Ts, expected, _ = CASES[case]
    dataset = make()
    splits = dataset.splits()
    assert list(splits) == list(expected)
    for split, ((u, y), chosen) in expected.items():
        (record,) = splits[split]
        np.testing.assert_array_equal(record.u, u[chosen], err_msg=split)
        np.testing.assert_array_equal(record.y, y[chosen], err_msg=split)
        assert record.Ts == pytest.approx(Ts, rel=1e-12)


@pytest.mark.parametrize("case", CASES)
def test_the_statistics_are_of_these_samples(case: str) -> None:
    make, _, _, ((u, y), chosen) = CASES[case]
    scaling = make().fitting.scaling
    for mean, std, samples in (
        (scaling.u_mean, scaling.u_std, u[chosen]),
        (scaling.y_mean, scaling.y_std, y[chosen]),
    ):
        K = len(samples)
        np.testing.assert_allclose(mean, samples.sum(axis=0) / K, rtol=1e-12)
        # the other formula of a deviation with ddof = 1: by pairs of samples
        pairs = samples[:, None, :] - samples[None, :, :]
        np.testing.assert_allclose(std, np.sqrt((pairs**2).sum(axis=(0, 1)) / (2 * K * (K - 1))), rtol=1e-9)


NOTES = {
    "twotank paper": ("Validation (samples 1500–1999) lies inside test (1500–2999)",),
    "twotank strict": (),
    "powerplant paper": ("over all 200 rows, test included",),
    "powerplant strict": (),
    "robotarm paper": ("lacks the paper's test record (uv3, yv3)",),
    "robotarm paper, complete": ("no published hash is known to verify it with",),
    "robotarm strict": ("not strict for `--recipe best`, which was found on all of yv1",),
    "robotarm strict, complete": ("no published hash is known to verify it with",),
}


@pytest.mark.parametrize("case", CASES)
def test_the_notes_say_what_a_reader_must_know(case: str) -> None:
    notes = CASES[case][0]().notes
    assert len(notes) == len(NOTES[case])
    for note, part in zip(notes, NOTES[case], strict=True):
        assert part in note
        assert "\n" not in note


@pytest.mark.parametrize(
    ("strict", "paper", "with_train", "with_val"),
    [
        ("twotank strict", "twotank paper", 0, 0),
        ("powerplant strict", "powerplant paper", 0, 0),
        ("robotarm strict", "robotarm paper", 0, 990),  # all of its test: the note says so
        ("robotarm strict, complete", "robotarm paper, complete", 0, 0),
    ],
)
def test_what_strict_test_shares_with_what_recipes_were_found_on(
    strict: str, paper: str, with_train: int, with_val: int
) -> None:
    """Recipes were found on protocol paper's train and validation: samples of these in strict's test."""
    (test,) = CASES[strict][0]().tests["test"]
    fitting = CASES[paper][0]().fitting
    for (record,), shared in ((fitting.train, with_train), (fitting.val, with_val)):
        for signal, other in ((test.u, record.u), (test.y, record.y)):
            assert np.isin(signal[:, 0], other[:, 0]).sum() == shared


@pytest.mark.parametrize("case", [case for case in CASES if "strict" in case])
def test_strict_splits_share_no_sample(case: str) -> None:
    samples = np.concatenate([record.y[:, 0] for records in CASES[case][0]().splits().values() for record in records])
    assert len(np.unique(samples)) == len(samples)


def test_decimation_keeps_every_tenth_of_all_but_the_last_and_drops_four() -> None:
    for K in (19838, 19831, 19830, 101):
        k = np.arange(K)
        kept = [i for i in range(K - 1) if i % 10 == 0][:-4]
        record = robotarm.decimate(Record(k, -k, 0.0005))
        assert record.u[:, 0].tolist() == kept
        assert record.y[:, 0].tolist() == [-i for i in kept]
        assert record.Ts == pytest.approx(0.005)
