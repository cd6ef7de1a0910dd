"""A Python module of its own, with NumPy and python-control only: the model as a control.nlsys."""

from __future__ import annotations

import importlib.util
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nnss_cli.datasets.record import FloatArray
from nnss_cli.elementary import Program
from nnss_cli.export.facts import header
from nnss_cli.export.parity import Parity, Trial, check
from nnss_cli.export.source import PYTHON, Constants, statements
from nnss_cli.files import write_bytes, write_text
from nnss_cli.trained import TrainedModel
from nnss_cli.trained.linear import control_names

TOLERANCE = 1e-12


def write_control(model: TrainedModel, facts: dict[str, Any], trial: Trial, folder: Path, name: str) -> list[Parity]:
    """<name>.py and <name>.npz, checked."""
    constants = Constants("_C.")
    inputs, outputs = control_names(model.channels)
    text = [
        *(f"# {line}".rstrip() for line in header(facts)),
        "#",
        "#     import control, numpy as np",
        f"#     import {name}",
        f"#     system = {name}.system()",
        f"#     z0 = {name}.initial(y0, u0)",
        "#     response = control.input_output_response(system, np.arange(K) * system.dt, u.T, z0)",
        "",
        "from pathlib import Path",
        "from types import SimpleNamespace",
        "",
        "import numpy as np",
        "",
        f'_FILE = Path(__file__).with_name("{name}.npz")',
        "_C = SimpleNamespace(**np.load(_FILE, allow_pickle=False))",
        f"INPUTS = {inputs!r}",
        f"OUTPUTS = {outputs!r}",
        f"STATES = {facts['states']!r}",
        f"TS = {model.Ts!r}",
        *_function(
            "step", model.system.step, constants, ("z", "u"), ("z_next", "y"),
            "z(k+1) (N,) and y(k) (m,) from z(k) (N,) and u(k) (r,), physical units.",
        ),
        *_function(
            "initial", model.system.initial, constants, ("y0", "u0"), ("z",),
            f"z(0) (N,) from {model.system.starts_from}.",
        ),
        "",
        "",
        "def system():",
        '    """The model as a control.NonlinearIOSystem in discrete time."""',
        "    import control",
        "",
        "    return control.nlsys(",
        "        lambda t, z, u, parameters: step(z, u)[0],",
        "        lambda t, z, u, parameters: step(z, u)[1],",
        f'        inputs=INPUTS, outputs=OUTPUTS, states=STATES, dt=TS, name="{name}",',
        "    )",
        "",
    ]  # fmt: skip
    write_text(folder / f"{name}.py", "\n".join(text))
    packed = io.BytesIO()
    np.savez(packed, **constants.arrays)  # type: ignore[arg-type]  # a name of an array is no option
    write_bytes(folder / f"{name}.npz", packed.getvalue())
    return [_check(folder / f"{name}.py", trial)]


def _function(
    name: str, program: Program, constants: Constants, arguments: Sequence[str], results: Sequence[str], text: str
) -> list[str]:
    lines, found = statements(program, PYTHON, constants, "")
    columns = [f"{a} = np.asarray({a}, dtype=np.float64).reshape({program.nodes[program.inputs[a]].shape[0]}, 1)"
               for a in arguments]  # fmt: skip
    returned = ", ".join(f"{found[result]}[:, 0]" for result in results)
    return ["", "", f"def {name}({', '.join(arguments)}):", f'    """{text}"""',
            *(f"    {line}" for line in (*columns, *lines)), f"    return {returned}"]  # fmt: skip


def _check(path: Path, trial: Trial) -> Parity:
    import control

    spec = importlib.util.spec_from_file_location("nnss_export_under_test", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    stepped = [module.step(z, u) for z, u in zip(trial.z, trial.u, strict=True)]
    system = module.system()
    u: FloatArray = np.concatenate([trial.u, trial.u[-1:]])  # it wants two instants or more
    response = control.input_output_response(system, np.arange(len(u)) * system.dt, u.T, trial.z[0])
    return check(
        "control.nlsys", trial, (np.array([z for z, _ in stepped]), np.array([y for _, y in stepped])),
        response.y.T[: len(trial.u)], TOLERANCE, module.initial(trial.y0, trial.u0),
    )  # fmt: skip
