"""The cascaded two-tank record: pump voltage to the level of the lower tank.

The record is MathWorks demo data (twotankdata.mat, System Identification Toolbox), itself a
simulation with output noise; 3000 samples, Ts = 0.2 s.
"""

from pathlib import Path

import numpy as np
from nnss_cli.datasets.benchmark import Benchmark, Source, check_contents, read_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Protocol, Record, Scaling

from nnss_cli.errors import InputError

CHANNELS = Channels(("pump voltage",), ("lower tank level",), ("V",), ("m",))
Ts = 0.2
SAMPLES = 3000


def load(path: Path | None, protocol: Protocol) -> Dataset:
    """Read twotankdata.mat (u, y) or TwoTanksMatlab.mat (U, Y, U_val, Y_val) and split it."""
    assert path is not None
    variables = read_matlab(path, (("u", "y"), ("U", "Y", "U_val", "Y_val")))
    if "u" in variables:
        u, y = variables["u"], variables["y"]
    else:
        u = np.concatenate([variables["U"], variables["U_val"]])
        y = np.concatenate([variables["Y"], variables["Y_val"]])
    if u.shape != (SAMPLES, 1) or y.shape != (SAMPLES, 1):
        raise InputError(f"'{path}': expected u and y of {SAMPLES} × 1, found {u.shape} and {y.shape}")
    # The whole record's statistics see damage anywhere; the training record's are those of the paper.
    check_contents(
        path,
        "y of the paper's training record",
        y[_paper_train()],
        np.array([0.26023431757]),
        np.array([0.16901727635]),
    )
    return split("twotank", u, y, protocol)


def split(name: str, u: FloatArray, y: FloatArray, protocol: Protocol) -> Dataset:
    """Split 3000 samples as the paper's code does, or without its overlap.

    paper: train 1–1499 with sample 1499 once more, validation 1500–1999, test 1500–2999
    (1-based, inclusive: validation lies inside test). strict: 1–1500, 1501–2000, 2001–3000.
    """
    record = Record(u, y, Ts)
    if protocol == "paper":
        rows = _paper_train()
        train, val, test = Record(u[rows], y[rows], Ts), record[1499:1999], record[1499:2999]
        notes: tuple[str, ...] = (
            "Validation (samples 1500–1999) lies inside test (1500–2999), as in the paper's code.",
        )
    else:
        train, val, test = record[:1500], record[1500:2000], record[2000:]
        notes = ()
    fitting = FittingData(name, protocol, (train,), (val,), Scaling.of((train,)), CHANNELS)
    return Dataset(fitting, (test,), notes)


def _paper_train() -> FloatArray:
    # The paper's script appends the last row of its 1499 once more to have 1500.
    return np.append(np.arange(1499), 1498)


BENCHMARK = Benchmark(
    name="twotank",
    title="Two-tank system (MathWorks demo data)",
    citation="MathWorks, System Identification Toolbox, twotankdata.mat",
    orders=(2, 3, 4),
    sources=(
        Source(
            "https://raw.githubusercontent.com/gsmfnc/LPV_SysId/a843d61efb1401308c932bd77b6653446bbdd351/"
            "noise_simulations/autoencoders/TwoTanksMatlab.mat",
            "7e82fb4e3c91023b6309e88e9f00a3a0b1a24a6661ed6c92762d55023f2de903",
        ),
        Source(
            "https://raw.githubusercontent.com/viccarinicola-hub/Identification-IntelligentControl/"
            "d7e60699cdca8db376ec0cf4758cd845c05572f9/twotankdata.mat"
        ),
    ),
    cached_as="twotank.mat",
    load=load,
)
