"""The DaISy power plant (Pont-sur-Sambre, 120 MW): five inputs, three outputs, 200 rows.

DaISy 96-003, Ts = 1228.8 s. Columns: index, 5 inputs, 3 outputs, 3 smoothed outputs.
"""

from pathlib import Path

import numpy as np
from nnss_cli.datasets.benchmark import Benchmark, Source, check_contents, read_bytes
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Protocol, Record, Scaling

from nnss_cli.errors import InputError

CHANNELS = Channels(
    ("gas flow", "turbine valves opening", "super heater spray flow", "gas dampers", "air flow"),
    ("steam pressure", "main steam temperature", "reheat steam temperature"),
    ("–",) * 5,
    ("–",) * 3,
)
Ts = 1228.8
ROWS = 200


def load(path: Path | None, protocol: Protocol) -> Dataset:
    """Read powerplant.dat (columns by white space or commas, packed or not) and split it.

    paper: train rows 1–100, validation 101–149, test 150–199, statistics over all 200 rows.
    strict: 1–100, 101–150, 151–200, statistics over train.
    """
    assert path is not None
    table = _read_table(path)
    whole = Record(table[:, 1:6], table[:, 6:9], Ts)
    check_contents(
        path,
        "the three outputs",
        whole.y,
        np.array([-192.04, 217.42, 73.515]),
        np.array([479.62284009804904, 170.4344540155479, 214.4057107893712]),
    )
    if protocol == "paper":
        train, val, test, scaled_over = whole[:100], whole[100:149], whole[149:199], whole
        notes: tuple[str, ...] = ("Statistics are taken over all 200 rows, test included, as in the paper's code.",)
    else:
        train, val, test = whole[:100], whole[100:150], whole[150:]
        scaled_over, notes = train, ()
    fitting = FittingData("daisy-powerplant", protocol, (train,), (val,), Scaling.of((scaled_over,)), CHANNELS)
    return Dataset(fitting, (test,), notes)


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
)
