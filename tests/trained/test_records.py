"""Files opened for a model: columns by name, its sampling time, its window; one line that names both sides else."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from nnss_cli.datasets.record import Channels

from nnss_cli.errors import InputError
from nnss_cli.trained import TrainedModel, load, read_record, read_start


@pytest.fixture
def model(trained_folder: Callable[..., Path]) -> TrainedModel:
    """Of channels u1, y1 and Ts = 0.5 s."""
    return load(trained_folder())


def windowed(model: TrainedModel, window: int) -> TrainedModel:
    from dataclasses import replace

    assert model.origin is not None
    return replace(model, origin=replace(model.origin, init_window=window))


def table(**columns: object) -> pd.DataFrame:
    k = np.arange(8)
    return pd.DataFrame({"t": 0.5 * k, "y1": np.cos(k), "note": "a", "u1": np.sin(k)} | columns)


def test_columns_by_name_in_any_format(model: TrainedModel, tmp_path: Path) -> None:
    content = table()
    content.to_csv(tmp_path / "new.csv", index=False)
    content.to_excel(tmp_path / "new.xlsx", index=False)
    np.savez(tmp_path / "new.npz", u1=content["u1"], y1=content["y1"])
    for name in ("new.csv", "new.xlsx", "new.npz"):
        record = read_record(model, tmp_path / name)
        np.testing.assert_allclose(record.u[:, 0], content["u1"], rtol=1e-15)
        np.testing.assert_allclose(record.y[:, 0], content["y1"], rtol=1e-15)
        assert record.Ts == 0.5
    assert len(read_record(model, str(tmp_path / "new.csv"), time="t", Ts=0.5)) == 8


def test_a_start_needs_outputs_in_the_window_only(model: TrainedModel, tmp_path: Path) -> None:
    y = np.cos(np.arange(8.0))
    y[3:] = np.nan
    table(y1=y).to_csv(tmp_path / "new.csv", index=False)
    start = read_start(windowed(model, 3), tmp_path / "new.csv")
    assert start.y is None
    np.testing.assert_array_equal(start.y_init, y[:3, None])
    assert len(start.u) == 8
    with pytest.raises(InputError, match="row 5, column 'y1'"):
        read_start(windowed(model, 4), tmp_path / "new.csv")
    table().drop(columns="y1").to_csv(tmp_path / "new.csv", index=False)
    assert read_start(model, tmp_path / "new.csv", outputs=False).y_init is None
    with pytest.raises(InputError, match="expected the columns u1, y1, the model's channels, found t, note, u1"):
        read_start(model, tmp_path / "new.csv")
    table().to_csv(tmp_path / "new.csv", index=False)
    start = read_start(model, tmp_path / "new.csv")
    assert start.y is not None
    assert len(start.y) == 8
    table(y1=nan_at_three(np.cos(np.arange(8.0)))).to_csv(tmp_path / "new.csv", index=False)
    start = read_start(model, tmp_path / "new.csv")
    assert start.y is not None
    assert np.flatnonzero(np.isnan(start.y)).tolist() == [3]


def test_messages_name_what_a_model_can_do_with_a_file(model: TrainedModel, tmp_path: Path) -> None:
    """Nothing is interpolated or resampled for it; a simulation may start from rest."""
    new = tmp_path / "new.csv"

    def told(read: Callable, content: pd.DataFrame, **options: object) -> str:
        content.to_csv(new, index=False)
        with pytest.raises(InputError) as error:
            read(model, new, **options)
        return str(error.value).split(": ", 1)[1]

    y = np.cos(np.arange(8.0))
    fill = "1 of 8 samples are missing, the longest gap is 1: fill them in in the file, or cut these rows"
    assert told(read_record, table(y1=nan_at_three(y))) == fill
    assert told(read_start, table(u1=nan_at_three(y))) == fill
    y[0] = np.nan
    assert told(read_start, table(y1=y)).endswith("cut these rows, or give --start rest, which needs no outputs")
    named = "rename what stands for y1"
    assert told(read_record, table().drop(columns="y1")).endswith(named)
    assert told(read_start, table().drop(columns="y1")).endswith(
        f"{named}, or give --start rest, which needs no outputs"
    )
    assert told(read_start, table().drop(columns=["y1", "u1"])).endswith("rename what stands for u1, y1")
    alone = "expected 0.5 s: a model runs at its own sampling time alone: bring the file to 0.5 s"
    assert told(read_start, table(), Ts=0.2).endswith(alone)
    assert told(read_start, table(t=0.4 * np.arange(8)), time="t").endswith(alone)
    uneven = told(read_record, table(t=np.arange(8) ** 2.0), time="t")
    assert uneven.endswith("steps are off): repair the file, or leave --time out where the times are only rounded")


@pytest.mark.parametrize("clock", ["t", "Time (s)", "time_ms", "when"])
def test_a_time_that_nobody_named_is_checked(clock: str, model: TrainedModel, tmp_path: Path) -> None:
    """By the rule by which `inspect` guesses it; --ts passes over it, and so does one that is no regular time."""

    def written(step: float) -> Path:
        seconds = step * np.arange(8) + 3
        dates = pd.Timestamp("2024-05-01") + pd.to_timedelta(seconds, unit="s")
        clocks = {"time_ms": 1000 * seconds, "when": dates}
        table().rename(columns={"t": "index"}).assign(**{clock: clocks.get(clock, seconds)}).to_csv(
            tmp_path / "new.csv", index=False
        )
        return tmp_path / "new.csv"

    assert len(read_record(model, written(0.5))) == 8
    for read in (read_record, read_start):
        with pytest.raises(InputError) as error:
            read(model, written(0.4))
        assert str(error.value) == (
            f"'new.csv', column '{clock}', against the model: sampling time 0.4 s, expected 0.5 s: a model runs at its "
            "own sampling time alone: bring the file to 0.5 s, or pass over the column (--ts 0.5) where it is no time "
            "of these samples"
        )
        read(model, written(0.4), Ts=0.5)


def test_a_time_that_rises_at_most_steps_alone_is_refused(model: TrainedModel, tmp_path: Path) -> None:
    """Two records end to end, a missing stamp, a clock set back: `train` refuses them, and they were passed over."""
    stamps = pd.Timestamp("2024-10-27 02:56") + pd.to_timedelta(np.arange(16) / 2 * 60, unit="s")
    back = stamps - pd.to_timedelta(np.where(np.arange(16) < 8, 0, 3600), unit="s")
    for clock, why in (
        (0.5 * np.r_[np.arange(10), np.arange(6)], "row 12, column 't': time goes from 4.5 to 0:"),
        (0.4 * nan_at_three(np.arange(16)), "row 5, column 't': the time is missing"),
        (0.5 * nan_at_three(np.arange(16)), "row 5, column 't': the time is missing"),
        (back, "time goes from 2024-10-27T02:59:30 to 2024-10-27T02:00:00 amid steps of 30 s"),
    ):
        pd.concat([table()] * 2).assign(t=clock).to_csv(tmp_path / "new.csv", index=False)
        with pytest.raises(InputError) as error:
            read_record(model, tmp_path / "new.csv")
        assert why in str(error.value)
        assert str(error.value).endswith("pass over the column (--ts 0.5) where it is no time of these samples")
        assert len(read_record(model, tmp_path / "new.csv", Ts=0.5)) == 16


def test_a_channel_named_by_digits_is_found_by_its_name(tmp_path: Path) -> None:
    """It was told before, and is the number of no other column."""
    content = pd.DataFrame(np.arange(24.0).reshape(8, 3), columns=["0", "1", "2"])
    content.to_parquet(tmp_path / "new.parquet")
    numbered: Any = SimpleNamespace(channels=Channels(("1",), ("2",), ("–",), ("–",)), Ts=0.5, init_window=1)
    for Ts in (None, 0.5):
        record = read_record(numbered, tmp_path / "new.parquet", Ts=Ts)
        assert (record.u[0, 0], record.y[0, 0]) == (1, 2)


def test_elapsed_times_are_the_time_of_the_file(model: TrainedModel, tmp_path: Path) -> None:
    clock = pd.to_timedelta(0.5 * np.arange(8) + 3, unit="s")
    table().rename(columns={"t": "index"}).assign(run=clock).to_parquet(tmp_path / "new.parquet")
    for time in ("run", None):
        t = read_start(model, tmp_path / "new.parquet", time=time).t
        assert t is not None
        np.testing.assert_allclose(t, 0.5 * np.arange(8) + 3)


def test_what_is_no_rising_time_or_a_channel_is_passed_over(model: TrainedModel, tmp_path: Path) -> None:
    new = tmp_path / "new.csv"
    for column in (
        5.0 - np.arange(8),
        ["on"] * 8,
        [0, 1, 0, 1, 0, 1, 0, 0],
        1e12 + np.arange(8),
    ):
        table(t=column).to_csv(new, index=False)
        assert len(read_record(model, new)) == 8
    table().rename(columns={"t": "t [samples]"}).to_csv(new, index=False)
    assert len(read_record(model, new)) == 8
    table(t=0.4 * np.arange(8)).to_csv(new, index=False)
    driven: Any = SimpleNamespace(channels=Channels(("t",), ("y1",), ("°C",), ("m",)), Ts=0.5, init_window=1)
    assert len(read_record(driven, new)) == 8


def nan_at_three(values: np.ndarray) -> np.ndarray:
    values = values.astype(float).copy()
    values[3] = np.nan
    return values


@pytest.mark.parametrize(
    ("columns", "options", "told"),
    [
        ({"y1": None}, {}, "expected the columns u1, y1, the model's channels, found t, note, u1: .*y1"),
        ({"t": 0.4 * np.arange(8)}, {"time": "t"}, "column 't', .* 0.4 s, expected 0.5 s"),
        ({}, {"Ts": 0.1}, "0.1 s, expected 0.5 s"),
        ({}, {"time": "clock"}, "no column 'clock'"),
        ({"u1": nan_at_three(np.arange(8))}, {}, "row 5, column 'u1': 1 of 8 samples are missing"),
        ({"y1": nan_at_three(np.arange(8))}, {}, "row 5, column 'y1': 1 of 8 samples are missing"),
        ({"u1": ["1"] * 7 + ["off"]}, {}, "row 9, column 'u1': expected a number, found 'off'"),
    ],
)
def test_what_does_not_fit_is_named(
    columns: dict, options: dict, told: str, model: TrainedModel, tmp_path: Path
) -> None:
    content = table(**{name: values for name, values in columns.items() if values is not None})
    content.drop(columns=[name for name, values in columns.items() if values is None]).to_csv(
        tmp_path / "new.csv", index=False
    )
    with pytest.raises(InputError, match=told) as error:
        read_record(model, tmp_path / "new.csv", **options)
    assert "\n" not in str(error.value)
    assert "new.csv" in str(error.value)


def test_the_other_sheets_are_told(model: TrainedModel, tmp_path: Path) -> None:
    with pd.ExcelWriter(tmp_path / "new.xlsx") as book:
        pd.DataFrame({"note": ["x"]}).to_excel(book, sheet_name="Cover", index=False)
        table().to_excel(book, sheet_name="Run", index=False)
    with pytest.raises(InputError, match="; this is its sheet 'Cover', give --sheet for another: Run$"):
        read_record(model, tmp_path / "new.xlsx")
    assert len(read_record(model, tmp_path / "new.xlsx", sheet="Run")) == 8


def test_too_short_for_the_window(model: TrainedModel, tmp_path: Path) -> None:
    table().to_csv(tmp_path / "new.csv", index=False)
    assert len(read_start(windowed(model, 8), tmp_path / "new.csv").u) == 8
    for window, read in ((9, read_start), (8, read_record)):
        with pytest.raises(InputError, match="'new.csv': 8 samples are too few: the model needs 9 or more"):
            read(windowed(model, window), tmp_path / "new.csv")
