"""Units in the names of columns."""

from pathlib import Path

import numpy as np
import pytest
from nnss_cli.datasets.description import Description
from nnss_cli.datasets.experiments import load_experiments
from nnss_cli.datasets.units import is_time_name, time_unit_in, titled, unit_in

from nnss_cli.errors import nearest


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("y [V]", "V"), ("level (cm)", "cm"), ("a[m/s^2]", "m/s^2"), ("a (m/s²)", "m/s²"), ("T [°C]", "°C"),
        ("n (rpm)", "rpm"), ("valve [%]", "%"), ("torque (N m)", "N m"), ("flow (l/min)", "l/min"), ("p (kPa)", "kPa"),
        ("f (1/s)", "1/s"), ("anything [widgets]", "widgets"),
        ("y", "–"), ("tank (left)", "–"), ("y [1]", "–"), ("x (2)", "–"), ("[V]", "–"), ("u [V] raw", "–"), ("", "–"),
        ("flow (in)", "–"),
    ],
)  # fmt: skip
def test_the_unit_is_what_a_name_ends_in(name: str, unit: str) -> None:
    assert unit_in(name) == unit


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("t [ms]", "ms"), ("Time (min)", "min"), ("t(us)", "us"), ("t [µs]", "us"), ("t (μs)", "us"), ("Zeit [h]", "h"),
        ("time [D]", "d"), ("time_ms", "ms"), ("timestamp.ns", "ns"), ("t/s", "s"), ("time in minutes", "min"),
        ("Time (Seconds)", "s"), ("elapsed sec", "s"), ("ms", "ms"), ("log/t_us", "us"),
        ("timeMs", "ms"), ("timestampSec", "s"), ("log.timeUs", "us"), ("timeH", "–"),
        ("millis", "ms"), ("t (Micros)", "us"), ("nanos", "ns"), ("ms_since_start", "ms"), ("t [ms since boot]", "ms"),
        ("Time (days since 2000-01-01)", "d"), ("terms since start", "–"), ("since start", "–"),
        ("t (10 ms)", "10 ms"), ("t (10ms)", "10ms"), ("t (1/100 s)", "1/100 s"), ("t (in ms)", "in ms"),
        ("t (.1 s)", ".1 s"), ("t (x10ms)", "x10ms"), ("t (100 Hz)", "100 Hz"),
        ("t (2)", "–"), ("t (2024-01-31)", "–"), ("t (terms)", "–"), ("t (local)", "–"),
        ("TIMES", "–"), ("timeLimits", "–"),
        ("t", "–"), ("time", "–"), ("items", "–"), ("times", "–"), ("t_1", "–"), ("t [-]", "–"), ("t (UTC)", "–"),
        ("t [samples]", "samples"), ("t (samples)", "samples"), ("T [°C]", "°C"), ("t (mm)", "mm"),
    ],
)  # fmt: skip
def test_the_unit_of_a_time_is_what_its_name_ends_in(name: str, unit: str) -> None:
    assert time_unit_in(name) == unit
    if unit in ("°C", "mm"):  # named as a time, and none
        assert not is_time_name(name)


@pytest.mark.parametrize("name", ["t", "Time [s]", "date_1", "timeMs", "timestampSec"])
def test_a_name_that_is_a_times(name: str) -> None:
    assert is_time_name(name)


@pytest.mark.parametrize("name", ["tMin", "T [°C]", "timer", "times", "flowMin", "TIMER", "tAmb"])
def test_a_name_that_is_no_times(name: str) -> None:
    assert not is_time_name(name)


def test_a_title_tells_a_unit_once() -> None:
    assert titled("y", "V") == "y [V]"
    assert titled("level (cm)", "cm") == "level (cm)"
    assert titled("level (cm)", "m") == "level (cm) [m]"
    assert titled("y", "–") == "y"


def test_a_record_takes_the_units_of_its_columns_unless_it_is_told(tmp_path: Path) -> None:
    values = np.random.default_rng(0).standard_normal((300, 3))
    rows = "".join("{:.6f},{:.6f},{:.6f}\n".format(*row) for row in values)
    (tmp_path / "plant.csv").write_text(f"u [V],n,level (cm)\n{rows}")
    described = {"name": "a", "files": "plant.csv", "inputs": ["u [V]", "n"], "Ts": 1.0, "folder": tmp_path}
    channels = load_experiments(Description(**described, outputs="level (cm)")).channels
    assert (channels.inputs, channels.input_units) == (("u [V]", "n"), ("V", "–"))
    assert (channels.outputs, channels.output_units) == (("level (cm)",), ("cm",))
    told = load_experiments(Description(**described, outputs="level (cm)", output_units="mm")).channels
    assert told.output_units == ("mm",)


def test_the_same_name_in_another_case_is_nearer_than_a_similar_one() -> None:
    assert nearest("ts", ["test", "Ts"]) == "Ts"
    assert nearest("ouputs", ["inputs", "outputs"]) == "outputs"
    assert nearest("q", ["inputs"]) == ""
