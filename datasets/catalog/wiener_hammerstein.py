"""The Wiener–Hammerstein circuit of SYSID 2009: a diode–resistor nonlinearity between two third-order filters.

188000 samples at 51.2 kHz, of which 5200 … 183999 (0-based) are the record.
"""

from pathlib import Path

from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, read_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

CHANNELS = Channels(("input voltage",), ("output voltage",), ("V",), ("mV",))
MILLIVOLTS = 1000.0  # in a volt: the file is in V, scores are published in mV
Ts = 1 / 51200
INIT_WINDOW = 50
START, TRAINED, OFFICIAL, STOP = 5200, 80_000, 100_000, 184_000

# Made from WienerHammerBenchMark.mat (its own sha256 stands in BENCHMARK.sources), by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import wiener_hammerstein as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('WienerHammerBenchMark.mat')).items()})"
CONTENTS = {
    "uBenchMark": Samples((188_000, 1), "7848e55982ab9bca10461ee42a9ddb41ff1ae2502a2f6dfb03f589bb0fcbacad"),
    "yBenchMark": Samples((188_000, 1), "dc07822b26ef4fe343438076e9bbb57f962f4a507b841678274e7e8affbaea6e"),
}


def load(path: Path | None, protocol: str) -> Dataset:
    """Read WienerHammerBenchMark.mat, check every sample of it, and split it."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    u, y = arrays.values()
    return split(u, y, protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """The arrays uBenchMark, yBenchMark [V] of WienerHammerBenchMark.mat, unchecked."""
    return read_matlab(path, (tuple(CONTENTS),))


def split(u: FloatArray, y: FloatArray, protocol: str) -> Dataset:
    """Of samples 5200 … 183999 the first 80000 train, the next 20000 validate, the other 78800 are test."""
    record = Record(u, MILLIVOLTS * y, Ts)[START:STOP]
    train, val = (record[:TRAINED],), (record[TRAINED:OFFICIAL],)
    fitting = FittingData("wiener-hammerstein", protocol, train, val, Scaling.of(train), CHANNELS, INIT_WINDOW)
    notes = (
        "The last 20000 of the official 100000 training samples validate, as in identibench 0.4; "
        "many published models were trained on all of them.",
    )
    return Dataset(fitting, {"test": (record[OFFICIAL:],)}, notes)


BENCHMARK = Benchmark(
    name="wiener-hammerstein",
    title="Wiener–Hammerstein circuit (SYSID 2009)",
    citation=(
        "Schoukens J., Suykens J., Ljung L., Wiener–Hammerstein benchmark, "
        "15th IFAC Symposium on System Identification, 2009"
    ),
    orders=(4, 6),
    sources=(
        Source("http://www.ee.kth.se/~hjalmars/ifac_tc11_benchmarks/2009_wienerhammerstein/WienerHammerBenchMark.mat"),
        Source(
            "https://raw.githubusercontent.com/gsmfnc/LPV_SysId/a843d61efb1401308c932bd77b6653446bbdd351/"
            "noise_simulations/lpvcore/wiener_hammerstein/dataset/WienerHammerBenchMark.mat",
            "096e6128687efb664d146d28fc17db4c5a94f247c4b3a2e451319be1efb25ae2",
        ),
    ),
    cached_as="wiener-hammerstein.mat",
    load=load,
    protocols=("official",),
)
