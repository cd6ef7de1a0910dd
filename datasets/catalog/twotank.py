"""The cascaded two-tank record: pump voltage to the level of the lower tank.

The record is MathWorks demo data (twotankdata.mat, System Identification Toolbox), itself a
simulation with output noise; 3000 samples, Ts = 0.2 s.
"""

from pathlib import Path

import numpy as np
from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, read_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

CHANNELS = Channels(("pump voltage",), ("lower tank level",), ("V",), ("m",))
Ts = 0.2
SAMPLES = 3000

# Made from the file whose own sha256 stands in BENCHMARK.sources, by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import twotank as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('TwoTanksMatlab.mat')).items()})"
# u and y are U, U_val and Y, Y_val one after the other.
CONTENTS = {
    "u": Samples((SAMPLES, 1), "dfc3cb3ae9707b6b1ae0f7767852276bc06e014f5782220a8ef2fbee6bb4bda4"),
    "y": Samples((SAMPLES, 1), "d895ef8d1730b6f83112a202c54870fec8328a3d9fccd9255ca9726b47f83324"),
    "U": Samples((2000, 1), "d959c026bd4502aec63ed6bef6cc8aa6919c2d8dd38c4990ef36a259661b1358"),
    "Y": Samples((2000, 1), "545bd1d8d0bb47c9eeae30dd79625b2092a8f9d2ee4fedad38f3394225397093"),
    "U_val": Samples((1000, 1), "6b963db286cae1c8d89e6bb8841ac2b0244139f7fdb8df2cf0a8ccf292995711"),
    "Y_val": Samples((1000, 1), "d7ae8d61e62d12a27dc8793df3733e65b92344681b898ccfa4b98f506d96f8bf"),
}

# Widths, windows and batches as found in the models that the paper's authors released: they are not all those of the
# paper's tables.
PRESETS = {
    "paper": {
        2: {"hidden": (100, 100), "window": 100, "stride": 5, "batch": 32},
        3: {},
        4: {"hidden": (150,) * 3, "encoder": (20, 20), "window": 100, "stride": 5, "batch": 32},
    }
}


def load(path: Path | None, protocol: str) -> Dataset:
    """Read the file, check every sample of it, and split it."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    if "u" in arrays:
        return split("twotank", arrays["u"], arrays["y"], protocol)
    u = np.concatenate([arrays["U"], arrays["U_val"]])
    y = np.concatenate([arrays["Y"], arrays["Y_val"]])
    return split("twotank", u, y, protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """The arrays of twotankdata.mat (u, y) or of TwoTanksMatlab.mat (U, Y, U_val, Y_val), unchecked."""
    return read_matlab(path, (("u", "y"), ("U", "Y", "U_val", "Y_val")))


def split(name: str, u: FloatArray, y: FloatArray, protocol: str) -> Dataset:
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
    fitting = FittingData(name, protocol, (train,), (val,), Scaling.of((train,)), CHANNELS, presets=PRESETS)
    return Dataset(fitting, {"test": (test,)}, notes)


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
    presets=PRESETS,
)
