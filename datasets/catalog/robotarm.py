"""The flexible robot arm: applied torque to the motor's angular velocity.

MathWorks demo data (robotarmdata.mat, System Identification Toolbox): estimation record ue, ye
and validation records uv1, yv1 … uv3, yv3, each 19838 samples at 0.5 ms.
"""

from pathlib import Path

from nnss_cli.datasets.benchmark import Benchmark, Samples, Source, check_contents, read_matlab
from nnss_cli.datasets.record import Channels, Dataset, FittingData, FloatArray, Record, Scaling

CHANNELS = Channels(("torque",), ("angular velocity",), ("N m",), ("rad/s",))
RAW_SHAPE = (19838, 1)
RAW_Ts = 0.0005
DECIMATION = 10

# Made from the file whose own sha256 stands in BENCHMARK.sources, by
#   python -c "from pathlib import Path; from nnss_cli.datasets import benchmark as b;
#   from nnss_cli.datasets.catalog import robotarm as d;
#   print({name: b.samples_hash(a) for name, a in d.read(Path('RobotArm.mat')).items()})"
# That file lacks uv3 and yv3, and no published hash of them is known.
_UE = Samples(RAW_SHAPE, "84e0f66ff4262a324cae452347ec0675ae5c855753ba44c72e7cad8502554fa6")
_YE = Samples(RAW_SHAPE, "e7f6408be9e06a387a5f72ba6bab869571f3733ff9cf1e437215e97cbac50aa2")
_UV1 = Samples(RAW_SHAPE, "3d4c8f44215399fbaa55676ff16f9ceedcdcc8ac994eaae328e9221e7157d8f2")
_YV1 = Samples(RAW_SHAPE, "039bc7ef773a8f1841047288ee065476ffa0793195713e79851e437a4ace5b38")
_UNKNOWN = Samples(RAW_SHAPE, None)
CONTENTS = {"ue": _UE, "ye": _YE, "uv1": _UV1, "yv1": _YV1, "uv3": _UNKNOWN, "yv3": _UNKNOWN} | {
    "U": _UE, "Y": _YE, "U_val": _UV1, "Y_val": _YV1
}  # fmt: skip

# Widths, windows and batches as found in the models that the paper's authors released: they are not all those of the
# paper's tables.
_PAPER = {"hidden": (150,) * 4, "encoder": (64,) * 4, "window": 100, "stride": 5, "batch": 32}
PRESETS = {
    "paper": {4: _PAPER, 5: _PAPER, 6: _PAPER | {"hidden": (200,) * 4}},
}


def load(path: Path | None, protocol: str) -> Dataset:
    """Read the file, check every sample whose published value is known, and split it."""
    assert path is not None
    arrays = read(path)
    check_contents(path, arrays, CONTENTS)
    names = [("U", "Y"), ("U_val", "Y_val")] if "U" in arrays else [("ue", "ye"), ("uv1", "yv1"), ("uv3", "yv3")]
    return split(tuple(Record(arrays[u], arrays[y], RAW_Ts) for u, y in names if u in arrays), protocol)


def read(path: Path) -> dict[str, FloatArray]:
    """The arrays of robotarmdata.mat (ue, ye, uv1, yv1 and perhaps uv3, yv3) or RobotArm.mat, unchecked."""
    short = ("ue", "ye", "uv1", "yv1")
    return read_matlab(path, ((*short, "uv3", "yv3"), short, ("U", "Y", "U_val", "Y_val")))


def split(recorded: tuple[Record, ...], protocol: str) -> Dataset:
    """Decimate and split the records as the paper's code does, or without a use of test for a choice.

    paper: train ye, validation yv1, test yv3. strict: train ye, validation the first half of yv1,
    test yv3 where there is one, else the second half of yv1. Statistics are taken over train.

    Args:
        recorded: estimation (ue, ye), validation (uv1, yv1) and, where the file has it, (uv3, yv3),
            each as recorded.
        protocol: which split.
    """
    train, val, *rest = (decimate(record) for record in recorded)
    test, notes = tuple(rest), []
    half = len(val) // 2
    if rest:
        notes.append("Test (uv3, yv3) is as the file gives it: no published hash is known to verify it with.")
    elif protocol == "paper":
        notes.append("The file at hand lacks the paper's test record (uv3, yv3): only train and validation are scored.")
    else:
        test = (val[half:],)
        notes.append(
            "Test is the second half of yv1, since the file at hand lacks uv3, yv3; it is not strict for "
            "`--recipe best`, which was found on all of yv1 (validation of protocol paper)."
        )
    if protocol == "strict":
        val = val[:half]
    fitting = FittingData("robotarm", protocol, (train,), (val,), Scaling.of((train,)), CHANNELS, presets=PRESETS)
    return Dataset(fitting, {"test": test} if test else {}, tuple(notes))


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
    presets=PRESETS,
)
