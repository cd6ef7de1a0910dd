"""The real records for the tests: where they are, and fetching them where they are not.

    python tests/real_files.py FOLDER

brings what the original sources give into FOLDER and says what it could not get. `make test` calls it with .testdata.
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

NEEDED = ("powerplant.dat", "TwoTanksMatlab.mat", "RobotArm.mat")
"""The paper's records: most tests of real files want all three."""
OFFICIAL = {
    "cascaded-tanks": ("dataBenchmark.mat",),
    "ced": ("DATAUNIF.MAT",),
    "emps": ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"),
    "silverbox": ("SNLS80mV.csv",),
    "wiener-hammerstein": ("WienerHammerBenchMark.mat",),
}
"""The official benchmarks' files: each used where it is."""
FETCHED = Path(__file__).parents[1] / ".testdata"


def folder_of_files(names: Sequence[str] = NEEDED) -> Path | None:
    """The first that has them of NNSS_TEST_MIRROR, NNSS_MIRROR, what `make test` fetched, a checkout's neighbour."""
    named = [Path(os.environ[name]) for name in ("NNSS_TEST_MIRROR", "NNSS_MIRROR") if os.environ.get(name)]
    for folder in (*named, FETCHED, Path(__file__).parents[2] / "shared" / "datasets"):
        if all((folder / name).is_file() for name in names):
            return folder
    return None


def fetch_files(folder: Path, wanted: Sequence[str]) -> list[str]:
    """Download those of the wanted files that are missing, checked; a line for each that could not be had."""
    from nnss_cli.datasets import archive, download
    from nnss_cli.datasets.benchmark import Benchmark
    from nnss_cli.datasets.catalog import BENCHMARKS

    from nnss_cli.errors import InputError

    def bring(entry: Benchmark, name: str) -> None:
        # the tests read one form of each file: the one whose bytes are known, else what the cache keeps
        known = [part for source in entry.sources for part in (source.parts or (source,)) if part.sha256]
        with tempfile.TemporaryDirectory() as cache:
            for source in known:
                if source.filename == name:
                    shutil.copy(download.retrieve(source, Path(cache)), folder / name)
                    return
            os.environ["NNSS_DATA_DIR"] = cache
            got = download.fetch(entry)
            if archive.holds_files(got):
                (folder / name).write_bytes(*archive.take(got, ((name,),)))
            else:
                shutil.copy(got, folder / name)

    download.TIMEOUT = 10
    lost = []
    folder.mkdir(parents=True, exist_ok=True)
    for entry in BENCHMARKS.values():
        forms = {source.filename for source in entry.sources} | {name for names in entry.wanted for name in names}
        for name in wanted:
            if name in forms and not (folder / name).is_file():
                try:
                    bring(entry, name)
                except (InputError, OSError, ValueError) as error:
                    lost.append(f"{name}: {' '.join(str(error).split())[:120]}")
    return lost


def missing() -> list[str]:
    """The files that no folder has."""
    groups = (NEEDED, *OFFICIAL.values())
    return [name for names in groups if folder_of_files(names) is None for name in names]


if __name__ == "__main__":
    if missing():
        for line in fetch_files(Path(sys.argv[1]), missing()):
            print(f"not fetched for the tests: {line}")
        if missing():
            print(
                f"tests of {', '.join(missing())} will be skipped: NNSS_TEST_MIRROR=FOLDER names a folder that has them"
            )
