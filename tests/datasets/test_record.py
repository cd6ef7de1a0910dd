"""Records, their scaling, and what a dataset of several experiments must have in common."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from nnss_cli.datasets.record import Channels, Dataset, FittingData, Record, Scaling

from nnss_cli.errors import InputError


def test_a_record_is_read_only_and_owns_its_samples() -> None:
    u = np.zeros((4, 1))
    record = Record(u, np.ones(4), 0.1)
    u[0] = 7
    assert record.u[0, 0] == 0
    assert record.y.shape == (4, 1)
    with pytest.raises(ValueError, match="read-only"):
        record.y[0] = 2


@pytest.mark.parametrize(
    ("u", "y", "Ts", "message"),
    [
        (np.zeros(3), np.zeros(4), 1.0, "3 and 4 samples"),
        (np.array([0.0, np.nan]), np.zeros(2), 1.0, "u: sample 1 of channel 0 is nan"),
        (np.zeros(2), np.array([0.0, np.inf]), 1.0, "y: sample 1"),
        (np.zeros(2), np.zeros(2), 0.0, "positive sampling time"),
        (np.zeros((0, 1)), np.zeros((0, 1)), 1.0, "samples × channels"),
    ],
)
def test_bad_signals_are_refused_by_name(u: np.ndarray, y: np.ndarray, Ts: float, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Record(u, y, Ts)


@pytest.mark.parametrize(
    ("y", "told"),
    [
        (np.ma.masked_equal([1.0, 9.0], 9.0), "y: sample 1 of channel 0 is nan"),
        (np.zeros(2, complex), "y: expected real numbers, found complex ones"),
        (np.zeros(2, "M8[s]"), "y: expected real numbers, found dates"),
        (np.zeros(2, "m8[s]"), "y: expected real numbers, found durations"),
        (["a", "b"], "y: expected numbers"),
    ],
)
def test_what_is_no_measurement_is_no_signal(y: object, told: str) -> None:
    """NumPy makes floats of them without a word: what a mask hides, real parts, ticks of a clock."""
    with pytest.raises(InputError, match=told):
        Record(np.zeros(2), y, 0.1)


def test_scaling_is_a_z_score_with_ddof_1_and_leaves_constant_channels_finite() -> None:
    random = np.random.default_rng(0)
    record = Record(
        np.column_stack([random.standard_normal(50), np.full(50, 3.0)]), random.standard_normal(50) * 9, 1.0
    )
    scaling = Scaling.of((record,))
    scaled = scaling.apply(record)
    np.testing.assert_allclose(scaled.y.std(axis=0, ddof=1), 1)
    np.testing.assert_allclose(scaled.u.mean(axis=0), 0, atol=1e-15)
    assert not scaled.u[:, 1].any()
    np.testing.assert_allclose(scaling.restore_y(scaled.y), record.y)


@pytest.mark.parametrize("K", [1, 2, 10, 37, 1000, 100_000])
@pytest.mark.parametrize("constant", [0.0, 0.1, 293.15, 1e5, -7e-9])
def test_a_constant_channel_is_centred_and_not_magnified(constant: float, K: int) -> None:
    still = np.full(K, constant)
    moving = np.sin(np.arange(K))
    # alone, beside others (numpy adds in another order) and over several records
    for records, channel in (
        ((Record(still, moving, 1.0),), 0),
        ((Record(np.column_stack([moving, still, moving]), moving, 1.0),), 1),
        ((Record(still[: K // 2 + 1], moving[: K // 2 + 1], 1.0), Record(still, moving, 1.0)), 0),
    ):
        scaling = Scaling.of(records)
        assert scaling.u_std[channel] == 1.0
        assert scaling.u_mean[channel] == constant
        assert not scaling.apply(records[0]).u[:, channel].any()
        changed = scaling.normalise_u(1.01 * records[0].u)[:, channel]
        assert np.abs(changed).max() <= 0.0101 * abs(constant)
        outputs = Scaling.of(tuple(Record(record.y, record.u, 1.0) for record in records))
        assert (outputs.y_mean[channel], outputs.y_std[channel]) == (constant, 1.0)


@given(st.floats(-1e9, 1e9), st.integers(2, 200), st.randoms(use_true_random=False))
def test_rounding_is_no_variation(constant: float, K: int, random: object) -> None:
    """One step of the floating-point grid either way."""
    near = [constant, np.nextafter(constant, np.inf), np.nextafter(constant, -np.inf)]
    u = np.array([random.choice(near) for _ in range(K)])  # type: ignore[attr-defined]
    scaling = Scaling.of((Record(u, u, 1.0),))
    assert scaling.u_std == 1.0
    assert scaling.u_mean == pytest.approx(constant, rel=1e-15)


@pytest.mark.parametrize("K", [10, 1000, 100_000])
@pytest.mark.parametrize(
    ("offset", "amplitude"), [(1e5, 1e-4), (293.15, 1e-9), (0.1, 1e-12), (0.0, 1e-200), (-7e-9, 1e-20)]
)
def test_a_small_signal_on_a_large_offset_keeps_its_deviation(offset: float, amplitude: float, K: int) -> None:
    sine = np.sin(np.arange(1.0, K + 1))
    u = offset + amplitude * sine
    (deviation,) = Scaling.of((Record(u, u, 1.0),)).u_std
    assert deviation == pytest.approx(
        amplitude * sine.std(ddof=1), rel=2e-3, abs=0
    )  # the offset's grid takes up to 1e-3 of it


def test_two_levels_in_two_records_are_no_constant() -> None:
    scaling = Scaling.of(
        (Record(np.full(4, 1.0), np.arange(4), 1.0), Record(np.full(4, 1.0 + 1e-9), np.arange(4), 1.0))
    )
    assert scaling.u_std == pytest.approx(1e-9 * np.sqrt(2 / 7), rel=1e-6)


def fitting(train: tuple[Record, ...], val: tuple[Record, ...], **changed: object) -> FittingData:
    r, m = train[0].input_count if train else 1, train[0].output_count if train else 1
    scaling = Scaling(np.zeros(r), np.ones(r), np.zeros(m), np.ones(m))
    channels = Channels(("u",) * r, ("y",) * m, ("V",) * r, ("m",) * m)
    return replace(FittingData("rig", "strict", train, val, scaling, channels), **changed)  # type: ignore[arg-type]


def experiment(r: int = 1, m: int = 1, Ts: float = 0.5, K: int = 4) -> Record:
    return Record(np.zeros((K, r)), np.zeros((K, m)), Ts)


KINDS = st.sampled_from([(1, 1, 0.5)] * 8 + [(2, 1, 0.5), (1, 3, 0.5), (1, 1, 0.25), (1, 1, 0.50001)])


@given(
    st.lists(KINDS, min_size=1, max_size=3), st.lists(KINDS, min_size=1, max_size=3), st.lists(KINDS, max_size=3),
    st.lists(st.integers(1, 9), min_size=9, max_size=9),
)  # fmt: skip
def test_experiments_of_any_length_and_one_kind_make_a_dataset_and_no_others(
    train: list, val: list, test: list, lengths: list[int]
) -> None:
    K = iter(lengths)
    records = {
        split: tuple(experiment(*kind, next(K)) for kind in kinds)
        for split, kinds in (("train", train), ("validation", val), ("test", test))
    }
    odd = [
        (f"dataset rig: {split} record {number}: ", kind)
        for split, kinds in (("train", train), ("validation", val), ("test", test))
        for number, kind in enumerate(kinds, start=1)
        if kind != train[0]
    ]

    def make() -> Dataset:
        return Dataset(fitting(records["train"], records["validation"]), {"test": records["test"]} if test else {})

    if not odd:
        assert make().splits()["train"] == records["train"]
        return
    with pytest.raises(InputError) as caught:
        make()
    message = str(caught.value)
    assert message.startswith(odd[0][0] + "expected ")
    assert "\n" not in message
    expected, found = message.split("found ")
    for (r, m, Ts), part in ((train[0], expected), (odd[0][1], found)):
        assert f"{r} input" in part
        assert f"{m} output" in part
        assert f"Ts = {Ts} s" in part


ONE = (experiment(),)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: fitting((), ONE), "dataset rig: expected a train record, found none"),
        (lambda: fitting(ONE, ()), "dataset rig: expected a validation record, found none"),
        (
            lambda: fitting(ONE, (*ONE, experiment(Ts=0.1))),
            "dataset rig: validation record 2: expected 1 input, 1 output and Ts = 0.5 s as in the first training "
            "record, found 1 input, 1 output and Ts = 0.1 s; one model needs records of one kind",
        ),
        (
            lambda: Dataset(fitting(ONE, ONE), {"test": (*ONE, *ONE, experiment(r=2))}),
            "dataset rig: test record 3: expected 1 input, 1 output and Ts = 0.5 s as in the first training "
            "record, found 2 inputs, 1 output and Ts = 0.5 s; one model needs records of one kind",
        ),
    ],
)
def test_what_does_not_fit_together_is_one_line(make: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError) as caught:
        make()
    assert str(caught.value) == message


def test_a_sampling_time_may_differ_by_rounding() -> None:
    assert fitting((experiment(Ts=0.1 * 3),), (experiment(Ts=0.3),)).Ts == 0.1 * 3


@pytest.mark.parametrize("name", ["inputs", "input_units", "outputs", "output_units"])
@pytest.mark.parametrize("count", [0, 1, 3])
def test_names_and_units_are_as_many_as_the_channels(name: str, count: int) -> None:
    records = (experiment(2, 2),)
    right = fitting(records, records).channels
    with pytest.raises(InputError, match=rf"rig: Channels.{name}: expected shape \(2,\).*found \({count},\)"):
        fitting(records, records, channels=replace(right, **{name: ("x",) * count}))


@pytest.mark.parametrize("name", ["u_mean", "u_std", "y_mean", "y_std"])
@pytest.mark.parametrize("shape", [(), (1,), (3,), (2, 1), (1, 2)])
def test_statistics_are_one_for_each_channel(name: str, shape: tuple[int, ...]) -> None:
    records = (experiment(2, 2),)
    right = fitting(records, records).scaling
    with pytest.raises(InputError, match=rf"rig: Scaling.{name}: expected shape \(2,\)"):
        fitting(records, records, scaling=replace(right, **{name: np.ones(shape)}))


def test_the_fingerprint_knows_every_sample_statistic_and_split() -> None:
    """And the channels' names and units; notes and the dataset's name have no part in it."""
    random = np.random.default_rng(0)
    a, b, c = (Record(random.standard_normal((5, 2)), random.standard_normal((5, 1)), 0.5) for _ in range(3))
    plain = Dataset(fitting((a,), (b,)), {"test": (c,)})

    def touched(record: Record, name: str) -> Record:
        signal = getattr(record, name).copy()
        signal[-1, -1] = np.nextafter(signal[-1, -1], np.inf)
        return replace(record, **{name: signal})

    others = [Dataset(fitting((touched(a, name),), (b,)), {"test": (c,)}) for name in "uy"]
    others += [Dataset(fitting((a,), (touched(b, name),)), {"test": (c,)}) for name in "uy"]
    others += [Dataset(fitting((a,), (b,)), {"test": (touched(c, name),)}) for name in "uy"]
    others += [
        Dataset(fitting((b,), (a,)), {"test": (c,)}), Dataset(fitting((a, b), (c,)), {}),
        Dataset(fitting((a,), (b,)), {"other": (c,)}), Dataset(fitting((a,), (b,), init_window=2), {"test": (c,)}),
        Dataset(fitting(*((replace(record, Ts=0.25),) for record in (a, b))), {"test": (replace(c, Ts=0.25),)}),
    ]  # fmt: skip
    for field in ("u_mean", "u_std", "y_mean", "y_std"):
        scaling = replace(plain.fitting.scaling, **{field: getattr(plain.fitting.scaling, field) + 0.5})
        others.append(Dataset(fitting((a,), (b,), scaling=scaling), {"test": (c,)}))
    for field in ("inputs", "outputs", "input_units", "output_units"):
        renamed = tuple(f"{text}_" for text in getattr(plain.fitting.channels, field))
        channels = replace(plain.fitting.channels, **{field: renamed})
        others.append(replace(plain, fitting=replace(plain.fitting, channels=channels)))
    prints = [plain.fingerprint(), *(dataset.fingerprint() for dataset in others)]
    assert len(set(prints)) == len(prints)
    again = replace(plain, notes=("seen",), fitting=replace(plain.fitting, dataset="another name"))
    assert again.fingerprint() == plain.fingerprint()
