"""Coupled electric drives: motor voltage to the speed of a pulley that a flexible belt drives.

Two records of 500 samples, Ts = 0.02 s, of a low and a high amplitude. The speed is counted in pulses, so its sign is
not measured.
"""

from pathlib import Path

from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, read_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

CHANNELS = Channels(("drive voltage",), ("pulley speed",), ("V",), ("ticks/s",))
Ts = 0.02
INIT_WINDOW = 10
TRAINED, OFFICIAL = 300, 400

# Made from DATAUNIF.MAT (its own sha256: 102c8d8012d6e850d50c13227b8c2280fe69f8bc4a845177f8bc3d761d152c89), by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import ced as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('DATAUNIF.MAT')).items()})"
CONTENTS = {
    "u11": Samples((500, 1), "0f209395cf6cc34300c0a5c0c54d0c1e7a7383259607dc4f28227640c90920ef"),
    "z11": Samples((500, 1), "e958e8c2959cea36135ab70eb25ca703ac1fd6aca6b919a24df26ac6a37b4ddf"),
    "u12": Samples((500, 1), "a7679a50fd314d6e81ac65d76d5ea1e55e5ff2730934d2f21140b76ac2863834"),
    "z12": Samples((500, 1), "99243f05f35e4545aaa93f2c4935e7f3b01c9a853cac699a54be2ddf33c746b9"),
}


def load(path: Path | None, protocol: str) -> Dataset:
    """Read DATAUNIF.MAT, check every sample that is taken from it, and split it."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    u_low, y_low, u_high, y_high = arrays.values()
    return split(u_low, y_low, u_high, y_high, protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """The arrays u11, z11 (low amplitude) and u12, z12 (high) of DATAUNIF.MAT, unchecked."""
    return read_matlab(path, (tuple(CONTENTS),))


def split(u_low: FloatArray, y_low: FloatArray, u_high: FloatArray, y_high: FloatArray, protocol: str) -> Dataset:
    """Of each record the first 300 samples train, the next 100 validate, the last 100 are a test set of their own.

    The file's outputs are the published ones, in ticks/s.
    """
    records = Record(u_low, y_low, Ts), Record(u_high, y_high, Ts)
    train = tuple(record[:TRAINED] for record in records)
    val = tuple(record[TRAINED:OFFICIAL] for record in records)
    low, high = (record[OFFICIAL:] for record in records)
    fitting = FittingData("ced", protocol, train, val, Scaling.of(train), CHANNELS, INIT_WINDOW)
    notes = (
        "test_1 is the record of low amplitude, test_2 that of high; one model is trained on both.",
        "Samples 300–399 of each record's official 400 for training validate, as in identibench 0.4; "
        "many published models were trained on all of them.",
    )
    return Dataset(fitting, {"test_1": (low,), "test_2": (high,)}, notes)


BENCHMARK = Benchmark(
    name="ced",
    title="Coupled electric drives",
    citation=(
        "Wigren T., Schoukens M., Coupled electric drives data set and reference models, "
        "Technical Report 2017-024, Department of Information Technology, Uppsala University, 2017"
    ),
    orders=(3, 4, 5),
    sources=(Source("https://uu.diva-portal.org/smash/get/diva2:1165531/FULLTEXT01.zip"),),
    cached_as="ced.mat",
    load=load,
    protocols=("official",),
    files=(("DATAUNIF.MAT",),),
)
