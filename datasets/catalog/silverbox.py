"""The Silverbox: an electronic Duffing oscillator, m ÿ + d ẏ + k y + k₃ y³ = u.

131072 samples at 610.35 Hz: a filtered Gaussian input of growing amplitude (the arrow), then multisines.
"""

from pathlib import Path

import numpy as np
from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, parse_matlab, read_bytes
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

from nnss_cli.errors import InputError

CHANNELS = Channels(("input voltage",), ("output voltage",), ("V",), ("mV",))
MILLIVOLTS = 1000.0  # in a volt: the file is in V, scores are published in mV
Ts = 1 / 610.35
INIT_WINDOW = 50
TRAINED, OFFICIAL = 50_000, 65_062  # of the multisines; the official part is 75 % of 86750, rounded down
WITHIN = 32_000  # samples of the arrow whose amplitude the multisines reach

# Made from the file whose own sha256 stands in BENCHMARK.sources, by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import silverbox as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('SNLS80mV.csv')).items()})"
CONTENTS = {
    "V1": Samples((131_072, 1), "b151c0e1605f2788279aacc4834e79b479f4933e45448fc63e852af9b6d765e3"),
    "V2": Samples((131_072, 1), "dc5bbc86b0b69bfd6e3c1e805e2632084b269f55017c3c31403f63c8651cccca"),
}


def load(path: Path | None, protocol: str) -> Dataset:
    """Read SNLS80mV.mat or SNLS80mV.csv, check every sample of it, and split it."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    u, y = arrays.values()
    return split(u, y, protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """Input V1 and output V2 [V] of SNLS80mV.mat (where they are rows) or SNLS80mV.csv, unchecked."""
    content = read_bytes(path)
    if content.startswith(b"MATLAB"):
        arrays = parse_matlab(path, content, (tuple(CONTENTS),))
        return {name: values.T if len(values) == 1 else values for name, values in arrays.items()}
    return _read_table(path, content)


def split(u: FloatArray, y: FloatArray, protocol: str) -> Dataset:
    """Of the multisines, samples 40650 … 127399, the first 50000 train, the next 15062 validate, 21688 are test.

    The arrow, samples 100 … 40574, is a test set as a whole and by its first 32000 samples.
    """
    record = Record(u, MILLIVOLTS * y, Ts)
    multisines, arrow = record[40_650:127_400], record[100:40_575]
    train, val = (multisines[:TRAINED],), (multisines[TRAINED:OFFICIAL],)
    fitting = FittingData("silverbox", protocol, train, val, Scaling.of(train), CHANNELS, INIT_WINDOW)
    tests = {
        "multisine": (multisines[OFFICIAL:],),
        "arrow_full": (arrow,),
        "arrow_no_extrapolation": (arrow[:WITHIN],),
    }
    notes = (
        "arrow_no_extrapolation is the first 32000 samples of arrow_full, where the amplitude stays within that of "
        "the training data.",
        "Samples 50000–65061 of the official training data validate, as in identibench 0.4; many published models "
        "were trained on all of them, and older ones on other parts of the multisines.",
    )
    return Dataset(fitting, tests, notes)


def _read_table(path: Path, content: bytes) -> dict[str, FloatArray]:
    header, *lines = content.decode("latin-1").splitlines() or [""]
    names = [name.strip(' "') for name in header.split(",")[:2]]
    if names != list(CONTENTS):
        raise InputError(
            f"'{path}': expected MATLAB's form or a table of columns V1, V2, found '{header.strip()[:40]}'"
        )
    rows = []
    for number, line in enumerate(lines, start=2):
        if line:
            try:
                u, y = line.split(",")[:2]
                rows.append((float(u), float(y)))
            except ValueError as error:
                raise InputError(f"'{path}' line {number}: expected V1, V2, found '{line.strip()[:40]}'") from error
    table = np.array(rows).reshape(-1, 2)
    return {name: table[:, [column]] for column, name in enumerate(names)}


BENCHMARK = Benchmark(
    name="silverbox",
    title="Silverbox (electronic oscillator)",
    citation=(
        "Wigren T., Schoukens J., Three free data sets for development and benchmarking in nonlinear system "
        "identification, European Control Conference, Zürich, 2013, pp. 2933–2938"
    ),
    orders=(2, 3, 4),
    sources=(
        Source(
            "https://docs.google.com/uc?export=download&id=17iS-6oBUUgrmiAcrZoG9S5sOaljZnDSy", name="SilverboxFiles.zip"
        ),
        Source(
            "https://raw.githubusercontent.com/Rafa7046/Non_Linear_Identification/"
            "e5c9b006b0a2ec1650bc018a5fb38d2f4363d4c7/src/data/SNLS80mV.csv",
            "ae62d5a91230c10f76e6dd02c8a4fac3c9d4d8a95fbf50e87cb0c4885003e0f1",
        ),
    ),
    cached_as="silverbox.dat",
    load=load,
    protocols=("official",),
    files=(("SNLS80mV.csv", "SNLS80mV.mat"),),  # the zip has both; the hashes were made from the first
)
