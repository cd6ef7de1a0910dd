"""What every export tells of its model: names, units, sampling time and scaling, read back from the files."""

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from nnss_cli.datasets.record import Channels, Scaling

from nnss_cli.export import TARGETS, export, parity
from nnss_cli.model.architecture import Architecture
from nnss_cli.model.nnss import NNSS
from nnss_cli.trained import TrainedModel

INPUTS, OUTPUTS = ("valve", "pump"), ("level", "flow", "heat")
INPUT_UNITS, OUTPUT_UNITS = ("%", "V"), ("cm", "l/s", "K")
TS = 0.2
SCALING = Scaling(np.array([1.0, 2.0]), np.array([3.0, 4.0]), np.array([5.0, 6.0, 7.0]), np.array([8.0, 9.0, 10.0]))


@pytest.fixture(scope="module")
def model() -> TrainedModel:
    channels = Channels(INPUTS, OUTPUTS, INPUT_UNITS, OUTPUT_UNITS)
    found = NNSS(Architecture(2, 2, 3, hidden=(4,), encoder=(4,), dtype="float64"), SCALING, channels, TS)
    found.initialise(np.random.default_rng(0))
    return TrainedModel(found)


@pytest.fixture
def written(model: TrainedModel, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: Any) -> Path:
    monkeypatch.setattr(parity, "SAMPLES", 40)
    export(model, request.param, tmp_path / "out", "plant")
    return tmp_path / "out"


@pytest.mark.parametrize("written", TARGETS, indirect=True)
def test_the_facts_beside_each_export(written: Path) -> None:
    facts = json.loads((written / "plant.json").read_text())
    assert (facts["Ts"], facts["states"]) == (TS, ["x1", "x2"])
    assert (facts["inputs"], facts["outputs"]) == ([*INPUTS], [*OUTPUTS])
    assert (facts["input_units"], facts["output_units"]) == ([*INPUT_UNITS], [*OUTPUT_UNITS])
    assert facts["scaling"] == {
        "u_mean": [1, 2], "u_std": [3, 4], "y_mean": [5, 6, 7], "y_std": [8, 9, 10],
    }  # fmt: skip


@pytest.mark.parametrize("written", ["control", "c", "mat"], indirect=True)
def test_the_head_of_a_source_file_has_each_signal_with_its_unit(written: Path) -> None:
    for path in (path for path in written.iterdir() if path.suffix in (".py", ".c", ".h", ".m")):
        text = " ".join(re.sub(r"(?m)^[#%*/ ]+", "", path.read_text()).split())
        if "Made by nnss" in text:
            assert (
                "Inputs u: valve [%], pump [V]. Outputs y: level [cm], flow [l/s], heat [K]. Sampling time 0.2 s."
                in text
            )
    heads = [
        "Made by nnss" in path.read_text() for path in written.iterdir() if path.suffix in (".py", ".c", ".h", ".m")
    ]
    assert any(heads)


def module_of(written: Path) -> Any:
    spec = importlib.util.spec_from_file_location("plant", written / "plant.py")
    module = importlib.util.module_from_spec(spec)  # type: ignore[arg-type]
    spec.loader.exec_module(module)  # type: ignore[union-attr]
    return module


@pytest.mark.parametrize("written", ["control"], indirect=True)
def test_the_system_of_control_has_names_and_sampling_time(written: Path) -> None:
    system = module_of(written).system()
    assert (system.dt, system.input_labels, system.output_labels) == (TS, [*INPUTS], [*OUTPUTS])
    assert system.state_labels == ["x1", "x2"]


def test_names_that_control_refuses_are_changed_in_its_system_alone(
    model: TrainedModel, tmp_path: Path, monkeypatch: Any
) -> None:
    monkeypatch.setattr(parity, "SAMPLES", 40)
    dotted = ("pump.speed", "pump_speed")
    monkeypatch.setattr(model.model, "channels", Channels(dotted, ("u.1", "y", "z"), INPUT_UNITS, OUTPUT_UNITS))
    export(model, "control", tmp_path / "out", "plant")
    system = module_of(tmp_path / "out").system()
    assert (system.input_labels, system.output_labels) == (["pump_speed_2", "pump_speed"], ["u_1", "y", "z"])
    assert json.loads((tmp_path / "out" / "plant.json").read_text())["inputs"] == [*dotted]


@pytest.mark.parametrize("written", ["c"], indirect=True)
def test_the_header_of_c_has_sizes_and_sampling_time(written: Path) -> None:
    defined = dict(re.findall(r"#define PLANT_(\w+) (\S+)", (written / "plant.h").read_text()))
    assert defined == {"STATES": "2", "INPUTS": "2", "OUTPUTS": "3", "TS": "0.2"}


@pytest.mark.parametrize("written", ["mat"], indirect=True)
def test_the_mat_file_has_names_units_scaling_and_sampling_time(written: Path) -> None:
    about = scipy.io.loadmat(written / "plant.mat", simplify_cells=True)["model"]
    assert about["Ts"] == TS
    assert ([*about["inputs"]], [*about["outputs"]]) == ([*INPUTS], [*OUTPUTS])
    assert ([*about["input_units"]], [*about["output_units"]]) == ([*INPUT_UNITS], [*OUTPUT_UNITS])
    for name in ("u_mean", "u_std", "y_mean", "y_std"):
        np.testing.assert_array_equal(about[f"scaling_{name}"], getattr(SCALING, name))


@pytest.mark.parametrize("written", ["onnx"], indirect=True)
def test_the_graphs_of_onnx_have_names_and_sampling_time(written: Path) -> None:
    import onnx

    for path in written.glob("*.onnx"):
        about = {entry.key: entry.value for entry in onnx.load(path).metadata_props}
        assert (float(about["Ts"]), about["states"]) == (TS, "x1, x2")
        assert (about["inputs"], about["outputs"]) == ("valve, pump", "level, flow, heat")
    assert len(list(written.glob("*.onnx"))) == 4


@pytest.mark.parametrize("target", ["control", "c", "mat"])
def test_a_unit_in_a_name_stands_once_and_every_source_file_ends_its_last_line(target: str, tmp_path: Path) -> None:
    channels = Channels(("valve [%]",), ("level (cm)", "pressure"), ("%",), ("cm", "–"))
    scaling = Scaling(np.zeros(1), np.ones(1), np.zeros(2), np.ones(2))
    found = NNSS(Architecture(1, 1, 2, hidden=(4,), encoder=(4,), dtype="float64"), scaling, channels, TS)
    found.initialise(np.random.default_rng(0))
    export(TrainedModel(found), target, tmp_path, "plant")
    sources = {path.name: path.read_text() for path in tmp_path.iterdir() if path.suffix in (".py", ".c", ".h", ".m")}
    assert any("Inputs u: valve [%]. Outputs y: level (cm), pressure." in text for text in sources.values())
    assert [name for name, text in sources.items() if not text.endswith("\n") or text.endswith("\n\n")] == []
