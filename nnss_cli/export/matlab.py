"""A MAT file with the arrays, and functions of MATLAB and Octave that step and simulate the model by them."""

from __future__ import annotations

import io
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from nnss_cli.elementary import Program
from nnss_cli.export.facts import certificate_lines, header
from nnss_cli.export.parity import Parity, ParityError, Trial, check
from nnss_cli.export.source import MATLAB, Constants, statements
from nnss_cli.files import write_bytes, write_text
from nnss_cli.trained import TrainedModel

TOLERANCE = 1e-12
PATIENCE = 300.0  # seconds


def write_mat(model: TrainedModel, facts: dict[str, Any], trial: Trial, folder: Path, name: str) -> list[Parity]:
    """<name>.mat, <name>_step.m, <name>_initial.m, <name>_simulate.m and <name>_check.m.

    Where there is Octave they are run and compared; elsewhere the arrays are read back and compared, and <name>_check
    repeats the comparison in MATLAB.
    """
    constants = Constants("c.")
    system = model.system
    head = [f"% {line}".rstrip() for line in header(facts)]
    step = _function(f"[z_next, y] = {name}_step(z, u)", system.step, constants, ("z_next", "y"), name)
    initial = _function(f"z = {name}_initial(y0, u0)", system.initial, constants, ("z",), name)
    of_step = "% z(k+1) (N x 1) and y(k) (m x 1) from z(k) and u(k) (r x 1), physical units."
    of_initial = f"% z(0) from {system.starts_from}, as columns."
    files = {
        f"{name}_step": [step[0], of_step, *head, *step[1:]],
        f"{name}_initial": [initial[0], of_initial, *head, *initial[1:]],
        f"{name}_simulate": [
            f"function [y, z] = {name}_simulate(u, z)",
            "% Outputs (K x m) and states (K x N) of inputs u (K x r) from z(0) (N x 1), physical units.",
            "K = size(u, 1);",
            f"y = zeros(K, {system.outputs}); states = zeros(K, {system.size});",
            "for k = 1:K",
            "  states(k, :) = z.';",
            f"  [z, now] = {name}_step(z, u(k, :).');",
            "  y(k, :) = now.';",
            "end",
            "z = states;",
            "end",
        ],
        f"{name}_check": [
            f"function [z_next, y, simulated, started] = {name}_check()",
            f"% Repeat the trial that is kept in {name}.mat; an error where the functions do not give its outputs.",
            f"data = load(fullfile(fileparts(mfilename('fullpath')), '{name}.mat')); t = data.trial;",
            "z_next = zeros(size(t.z)); y = zeros(size(t.y));",
            "for k = 1:size(t.u, 1)",
            f"  [next, now] = {name}_step(t.z(k, :).', t.u(k, :).');",
            "  z_next(k, :) = next.'; y(k, :) = now.';",
            "end",
            f"simulated = {name}_simulate(t.u, t.z(1, :).');",
            f"started = {name}_initial(t.y0(:), t.u0(:));",
            "error_of_z = max(abs(started - t.z0(:)) ./ (1 + abs(t.z0(:))));",
            "if ~(error_of_z <= t.step_tolerance)",
            "  error('z(0) is %g off the model''s, expected at most %g', error_of_z, t.step_tolerance);",
            "end",
            "error_of_y = max(max(abs((simulated - t.y) ./ t.unit)));",
            "if ~(error_of_y <= t.tolerance)",
            "  error('the functions are %g deviations off the model, expected at most %g', error_of_y, t.tolerance);",
            "end",
            "end",
        ],
    }  # fmt: skip
    for file, lines in files.items():
        write_text(folder / f"{file}.m", "\n".join([*lines, ""]))
    content = {
        "constants": constants.arrays,
        "model": {
            "Ts": model.Ts, "inputs": _cells(facts["inputs"]), "outputs": _cells(facts["outputs"]),
            "input_units": _cells(facts["input_units"]), "output_units": _cells(facts["output_units"]),
            "states": _cells(facts["states"]), "coordinates": facts["coordinates"],
            "certificate": " ".join(certificate_lines(facts)), "fingerprint": facts["fingerprint"] or "",
            **{f"scaling_{key}": np.array(values) for key, values in (facts["scaling"] or {}).items()},
        },
        "trial": {
            "u": trial.u, "y": trial.y, "z": trial.z, "unit": trial.unit,
            "y0": trial.y0, "u0": trial.u0, "z0": trial.z0, "step_tolerance": trial.tolerance(TOLERANCE),
            "tolerance": trial.tolerance(TOLERANCE) * min(trial.accumulation, 1e9),
        },
    }  # fmt: skip
    packed = io.BytesIO()
    scipy.io.savemat(packed, content, long_field_names=True, do_compression=True)
    write_bytes(folder / f"{name}.mat", packed.getvalue())
    read = scipy.io.loadmat(folder / f"{name}.mat", simplify_cells=True)
    for key, array in constants.arrays.items():
        if not np.array_equal(np.ravel(read["constants"][key]), array.ravel()):
            raise ParityError(f"{name}.mat: array {key} is not the model's; no file was written")
    octave = shutil.which("octave-cli") or shutil.which("octave")
    return [_check(folder, name, octave, trial)] if octave else []


def _function(signature: str, program: Program, constants: Constants, results: tuple[str, ...], name: str) -> list[str]:
    lines, found = statements(program, MATLAB, constants, ";")
    return [
        f"function {signature}",
        "persistent c",
        "if isempty(c)",
        f"  data = load(fullfile(fileparts(mfilename('fullpath')), '{name}.mat')); c = data.constants;",
        "end",
        *lines,
        *(f"{result} = {found[result]};" for result in results),
        "end",
    ]


def _cells(names: list[str] | tuple[str, ...]) -> Any:
    cells = np.empty(len(names), dtype=object)
    cells[:] = list(names)
    return cells


def _check(folder: Path, name: str, octave: str, trial: Trial) -> Parity:
    with tempfile.TemporaryDirectory(prefix="nnss-octave-") as aside:
        result = Path(aside) / "result.mat"
        script = (
            f"addpath('{folder}'); [z_next, y, simulated, started] = {name}_check(); "
            f"save('-v6', '{result}', 'z_next', 'y', 'simulated', 'started');"
        )
        done = subprocess.run(
            [octave, "--no-gui", "--quiet", "--no-init-file", "--eval", script],
            capture_output=True, text=True, check=False, timeout=PATIENCE,
        )  # fmt: skip
        if done.returncode or not result.exists():
            raise ParityError(f"Octave: {' '.join(done.stderr.split())[:300]}; no file was written")
        found = scipy.io.loadmat(result)
    steps = found["z_next"], found["y"]
    return check("Octave", trial, steps, found["simulated"], TOLERANCE, found["started"][:, 0])
