"""The DaISy power plant (Pont-sur-Sambre, 120 MW): five inputs, three outputs, 200 rows.

DaISy 96-003, Ts = 1228.8 s. Columns: index, 5 inputs, 3 outputs, 3 smoothed outputs.
"""

from pathlib import Path

import numpy as np
from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, read_bytes
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

from nnss_cli.errors import InputError

CHANNELS = Channels(
    ("gas flow", "turbine valves opening", "super heater spray flow", "gas dampers", "air flow"),
    ("steam pressure", "main steam temperature", "reheat steam temperature"),
    ("–",) * 5,
    ("–",) * 3,
)
Ts = 1228.8
ROWS = 200

# Made from powerplant.dat (its own sha256: f0b8fa3edf2c1aa9c18c8a9610eeaeea20a651d1bb7bd059f0fbd3e3e2b0424e), by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import powerplant as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('powerplant.dat')).items()})"
INPUTS, OUTPUTS = "input block (columns 2–6)", "output block (columns 7–9)"
CONTENTS = {
    INPUTS: Samples((ROWS, 5), "b795836fffb9e290e2d599284962d6608b00add9729469bbcf41dfd0d83caeee"),
    OUTPUTS: Samples((ROWS, 3), "c44b9836e2119fe38cef907555211d142795288df481a5ea5a2327b2343aa411"),
}

# Widths, windows and batches as found in the models that the paper's authors released: they are not all those of the
# paper's tables.
_PAPER = {"hidden": (120,) * 4, "encoder": (64,) * 4, "window": 100, "stride": 1, "batch": 1}
PRESETS = {
    "paper": {
        3: _PAPER | {"hidden": (100,) * 5},
        4: _PAPER,
        5: _PAPER | {"hidden": (180,) * 5, "encoder": (117,) * 4},
    },
}  # fmt: skip


def load(path: Path | None, protocol: str) -> Dataset:
    """Read powerplant.dat, check every sample of it, and split it."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    return split(arrays[INPUTS], arrays[OUTPUTS], protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """Inputs and outputs of powerplant.dat (columns by white space or commas, packed or not), unchecked."""
    table = _read_table(path)
    return {INPUTS: table[:, 1:6], OUTPUTS: table[:, 6:9]}


def split(u: FloatArray, y: FloatArray, protocol: str) -> Dataset:
    """Split 200 rows as the paper's code does, or without test in the statistics.

    paper: train rows 1–100, validation 101–149, test 150–199, statistics over all 200 rows.
    strict: 1–100, 101–150, 151–200, statistics over train (1-based, inclusive).
    """
    whole = Record(u, y, Ts)
    if protocol == "paper":
        train, val, test, scaled_over = whole[:100], whole[100:149], whole[149:199], whole
        notes: tuple[str, ...] = ("Statistics are taken over all 200 rows, test included, as in the paper's code.",)
    else:
        train, val, test = whole[:100], whole[100:150], whole[150:]
        scaled_over, notes = train, ()
    fitting = FittingData(
        "daisy-powerplant", protocol, (train,), (val,), Scaling.of((scaled_over,)), CHANNELS, presets=PRESETS
    )
    return Dataset(fitting, {"test": (test,)}, notes)


def _read_table(path: Path) -> FloatArray:
    rows = []
    for number, line in enumerate(read_bytes(path).decode("latin-1").splitlines(), start=1):
        fields = line.replace(",", " ").split()
        if not fields:
            continue
        try:
            rows.append([float(field) for field in fields])
        except ValueError as error:
            raise InputError(f"'{path}' line {number}: expected numbers, found '{line.strip()[:40]}'") from error
        if len(rows[-1]) < 9 or len(rows[-1]) != len(rows[0]):
            raise InputError(
                f"'{path}' line {number}: expected index, 5 inputs and 3 outputs in every row, "
                f"found {len(fields)} columns"
            )
    if len(rows) != ROWS:
        raise InputError(f"'{path}': expected {ROWS} rows, found {len(rows)}: truncated or another file")
    return np.array(rows)


BENCHMARK = Benchmark(
    name="daisy-powerplant",
    title="120 MW power plant (DaISy 96-003)",
    citation=(
        "De Moor B. (ed.), DaISy: Database for the Identification of Systems, "
        "ESAT/STADIUS, KU Leuven, Belgium; used dataset 96-003, power plant (Pont-sur-Sambre)"
    ),
    orders=(3, 4, 5),
    sources=(
        Source("https://ftp.esat.kuleuven.be/pub/SISTA/data/process_industry/powerplant.dat.gz"),
        Source("ftp://ftp.esat.kuleuven.be/pub/SISTA/data/process_industry/powerplant.dat.gz"),
        Source(
            "https://raw.githubusercontent.com/transcendent-ai-labs/DynaML/"
            "f5551a6dc09c10665ce6cee9da09798dded2aa60/data/powerplant.csv"
        ),
    ),
    cached_as="powerplant.dat",
    load=load,
    presets=PRESETS,
)
