"""The electro-mechanical positioning system: motor force to the position of a carriage with friction.

Two files of 24841 samples at 1 kHz, recorded in closed loop since the system integrates.
"""

from pathlib import Path

from nnss_cli.datasets.archive import take
from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, parse_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

CHANNELS = Channels(("motor force",), ("position",), ("N",), ("mm",))
MILLIMETRES = 1000.0  # in a metre: the files are in m, scores are published in mm
Ts = 0.001
INIT_WINDOW = 20
TRAINED = 18_000
FILES = ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat")

# Made from the files whose own sha256 stand in BENCHMARK.sources, by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import emps as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('.')).items()})"
CONTENTS = {
    "vir of DATA_EMPS.mat": Samples((24_841, 1), "364be0a588c64c6a7419757a97c85aae7ce89698e834628f23cef6d48bedf5e0"),
    "qm of DATA_EMPS.mat": Samples((24_841, 1), "084a75e6cf0e8e029c8445f2851e3b283e5fda3e3f55f05bdd5a7ba097de7714"),
    "vir of DATA_EMPS_PULSES.mat": Samples(
        (24_841, 1), "d29305890ddf869a60059beabe3d9c24701e0282d068b03c95dca0a01bd1e676"
    ),
    "qm of DATA_EMPS_PULSES.mat": Samples(
        (24_841, 1), "d4cbb9a5ffcec9ccda650ddefe921a15077eba4243847544d942ccb3406372ed"
    ),
}


def load(path: Path | None, protocol: str) -> Dataset:
    """Read both files, check every sample that is taken from them, and split them."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    force, position, test_force, test_position = arrays.values()
    return split(force, position, test_force, test_position, protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """Force vir [N] and position qm [m] of DATA_EMPS.mat and DATA_EMPS_PULSES.mat in a zip or a folder, unchecked."""
    contents = take(path, tuple((name,) for name in FILES))
    return {
        f"{variable} of {name}": values
        for name, content in zip(FILES, contents, strict=True)
        for variable, values in parse_matlab(path / name, content, (("vir", "qm"),)).items()
    }


def split(
    force: FloatArray, position: FloatArray, test_force: FloatArray, test_position: FloatArray, protocol: str
) -> Dataset:
    """The first 18000 samples of DATA_EMPS train, its other 6841 validate; DATA_EMPS_PULSES is test."""
    estimation = Record(force, MILLIMETRES * position, Ts)
    train, val = (estimation[:TRAINED],), (estimation[TRAINED:],)
    fitting = FittingData("emps", protocol, train, val, Scaling.of(train), CHANNELS, INIT_WINDOW)
    notes = (
        "Samples from 18000 on of the official 24841 for training validate, as in identibench 0.4; "
        "many published models were trained on all of them.",
        "The position integrates the force and was recorded in closed loop: a free simulation drifts with every "
        "error in x(0) or in the mean force.",
    )
    return Dataset(fitting, {"test": (Record(test_force, MILLIMETRES * test_position, Ts),)}, notes)


_COPY = (
    "https://raw.githubusercontent.com/forgi86/sysid-neural-continuous/956aa7ecd73061b0321c6f6098d74c9e4a7ce67a/"
    "examples/EMPS/data"
)
BENCHMARK = Benchmark(
    name="emps",
    title="Electro-mechanical positioning system",
    citation=(
        "Janot A., Gautier M., Brunot M., Data set and reference models of EMPS, "
        "Workshop on Nonlinear System Identification Benchmarks, Eindhoven, 2019"
    ),
    orders=(2, 3, 4),
    sources=(
        Source("https://docs.google.com/uc?export=download&id=1zwoXYa9-3f8NQ0ohzmjpF7UxbNgRTHkS", name="EMPS.zip"),
        Source(
            _COPY,
            parts=(
                Source(f"{_COPY}/{FILES[0]}", "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e"),
                Source(f"{_COPY}/{FILES[1]}", "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704"),
            ),
        ),
    ),
    cached_as="emps.zip",
    load=load,
    protocols=("official",),
    files=tuple((name,) for name in FILES),
)
