"""The flexible robot arm: applied torque to the motor's angular velocity.

MathWorks demo data (robotarmdata.mat, System Identification Toolbox): estimation record ue, ye
and validation records uv1, yv1 … uv3, yv3, each 19838 samples at 0.5 ms.
"""

from pathlib import Path

import numpy as np
from nnss_cli.datasets.benchmark import Benchmark, Source, check_contents, read_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, Protocol, Record, Scaling

from nnss_cli.errors import InputError

CHANNELS = Channels(("torque",), ("angular velocity",), ("N m",), ("rad/s",))
RAW_SAMPLES = 19838
RAW_Ts = 0.0005
DECIMATION = 10


def load(path: Path | None, protocol: Protocol) -> Dataset:
    """Read robotarmdata.mat (ue, ye, uv1, yv1 and perhaps uv3, yv3) or RobotArm.mat (U, Y, U_val, Y_val).

    paper: train ye, validation yv1, test yv3. strict: train ye, validation the first half of yv1,
    test yv3 where the file has it, else the second half of yv1.
    """
    assert path is not None
    variables = read_matlab(path, (("ue", "ye", "uv1", "yv1"), ("U", "Y", "U_val", "Y_val")))
    names = [("ue", "ye"), ("uv1", "yv1"), ("uv3", "yv3")] if "ue" in variables else [("U", "Y"), ("U_val", "Y_val")]
    records = []
    for u_name, y_name in names:
        if u_name not in variables or y_name not in variables:
            continue
        u, y = variables[u_name], variables[y_name]
        if u.shape != (RAW_SAMPLES, 1) or y.shape != (RAW_SAMPLES, 1):
            raise InputError(
                f"'{path}': expected {u_name} and {y_name} of {RAW_SAMPLES} × 1, found {u.shape} and {y.shape}"
            )
        records.append(decimate(Record(u, y, RAW_Ts)))
    train, val, *rest = records
    check_contents(path, "ye after decimation", train.y, np.array([0.0474385245]), np.array([20.8438684339]))

    notes: tuple[str, ...] = ()
    if protocol == "paper":
        test = tuple(rest)
        if not rest:
            notes = (
                "The file at hand lacks the paper's test record (uv3, yv3): only train and validation are scored.",
            )
    else:
        half = len(val) // 2
        test = tuple(rest) or (val[half:],)
        val = val[:half]
        if not rest:
            notes = ("Test is the second half of yv1, since the file at hand lacks uv3, yv3.",)
    fitting = FittingData("robotarm", protocol, (train,), (val,), Scaling.of((train,)), CHANNELS)
    return Dataset(fitting, test, notes)


def decimate(record: Record) -> Record:
    """Drop the last sample, keep every 10th, drop the last 4, as the paper's code does: 1980 samples.

    There is no anti-alias filter in it.
    """
    kept = slice(0, -1, DECIMATION)
    return Record(record.u[kept][:-4], record.y[kept][:-4], record.Ts * DECIMATION)


BENCHMARK = Benchmark(
    name="robotarm",
    title="Flexible robot arm (MathWorks demo data)",
    citation="MathWorks, System Identification Toolbox, robotarmdata.mat",
    orders=(4, 5, 6),
    sources=(
        # The complete file first: only it holds the paper's test record.
        Source(
            "https://raw.githubusercontent.com/viccarinicola-hub/Identification-IntelligentControl/"
            "33e5de63e15c2f4d5ab8f8673ffd2b960ec9db9c/robotarmdata.mat"
        ),
        Source(
            "https://raw.githubusercontent.com/gsmfnc/LPV_SysId/a843d61efb1401308c932bd77b6653446bbdd351/"
            "noise_simulations/autoencoders/RobotArm.mat",
            "e1b3699b2ecf8dec54b33badb3a63160a6ce7c8cbf84e1616575b7901d688421",
        ),
    ),
    cached_as="robotarm.mat",
    load=load,
)
