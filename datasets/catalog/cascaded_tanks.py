"""Cascaded tanks with overflow: pump voltage to the voltage of the lower tank's level sensor.

Two records of 1024 samples, Ts = 4 s, from two multisine inputs; water runs over at high levels.
"""

from pathlib import Path

from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, read_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

CHANNELS = Channels(("pump voltage",), ("lower tank level",), ("V",), ("V",))
Ts = 4.0
INIT_WINDOW = 50
VALIDATION = 160  # the first samples of the estimation record, as in the package identibench 0.4

# Made from dataBenchmark.mat (its own sha256: cb2f88d4388be4d3f2a24c6402fba804976aac5f2e1f26cda59ea0a38d016eab), by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import cascaded_tanks as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('dataBenchmark.mat')).items()})"
CONTENTS = {
    "uEst": Samples((1024, 1), "a823410a8b8c3c7c5b842515b216cd9def1b9d78f2e68b81b59167e611595a8a"),
    "yEst": Samples((1024, 1), "5746c34cc33cb73751e010913f3d5ec7e042fb7ccc2d7d47f3575dcd08cadc7e"),
    "uVal": Samples((1024, 1), "fe29a3f63b53a12c03bd7dd43db3d6a5c71f579f606c90117c60b921f97c4035"),
    "yVal": Samples((1024, 1), "87caef7d6ae29aa0e07cee36b7e1e795c0be2ec1092e1c1d239981634116cd21"),
}


def load(path: Path | None, protocol: str) -> Dataset:
    """Read dataBenchmark.mat, check every sample of it, and split it."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    u_est, y_est, u_val, y_val = arrays.values()
    return split(u_est, y_est, u_val, y_val, protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """The arrays uEst, yEst, uVal, yVal of dataBenchmark.mat, unchecked."""
    return read_matlab(path, (tuple(CONTENTS),))


def split(u_est: FloatArray, y_est: FloatArray, u_val: FloatArray, y_val: FloatArray, protocol: str) -> Dataset:
    """Validation is the first 160 samples of the estimation record, train the other 864, test the second record."""
    estimation = Record(u_est, y_est, Ts)
    train, val = (estimation[VALIDATION:],), (estimation[:VALIDATION],)
    fitting = FittingData("cascaded-tanks", protocol, train, val, Scaling.of(train), CHANNELS, INIT_WINDOW)
    notes = (
        "The first 160 of the official 1024 training samples validate, as in identibench 0.4; "
        "many published models were trained on all of them.",
    )
    return Dataset(fitting, {"test": (Record(u_val, y_val, Ts),)}, notes)


BENCHMARK = Benchmark(
    name="cascaded-tanks",
    title="Cascaded tanks with overflow",
    citation=(
        "Schoukens M., Noël J.P., Three benchmarks addressing open challenges in nonlinear system identification, "
        "20th IFAC World Congress, 2017"
    ),
    orders=(2, 3, 4),
    sources=(
        Source(
            "https://data.4tu.nl/file/d4810b78-6cdd-48fe-8950-9bd601e5f47f/3b697e42-01a4-4979-a370-813a456c36f5",
            name="CascadedTanksFiles.zip",
        ),
        Source(
            "https://docs.google.com/uc?export=download&id=1HnQf_gu0g_UlggoBqy2s34l9YJiFdN01",
            name="CascadedTanksFiles.zip",
        ),
    ),
    cached_as="cascaded-tanks.mat",
    load=load,
    protocols=("official",),
    files=(("dataBenchmark.mat",),),
)
