"""The real records for the tests: where they are, and fetching them where they are not.

    python tests/real_files.py FOLDER

brings what the original sources give into FOLDER and says what it could not get. `make test` calls it with .testdata.
"""

import os
import shutil
import sys
import tempfile
from pathlib import Path

NEEDED = ("powerplant.dat", "TwoTanksMatlab.mat", "RobotArm.mat")
FETCHED = Path(__file__).parents[1] / ".testdata"


def folder_of_files() -> Path | None:
    """The first that has them of NNSS_TEST_MIRROR, NNSS_MIRROR, what `make test` fetched, a checkout's neighbour."""
    named = [Path(os.environ[name]) for name in ("NNSS_TEST_MIRROR", "NNSS_MIRROR") if os.environ.get(name)]
    for folder in (*named, FETCHED, Path(__file__).parents[2] / "shared" / "datasets"):
        if all((folder / name).is_file() for name in NEEDED):
            return folder
    return None


def fetch_files(folder: Path) -> list[str]:
    """Download what is missing, each file checked as `nnss fetch` checks it; a line for each that could not be had."""
    from nnss_cli.datasets import download
    from nnss_cli.datasets.catalog import BENCHMARKS

    from nnss_cli.errors import InputError

    download.TIMEOUT = 10
    lost = []
    folder.mkdir(parents=True, exist_ok=True)
    for entry in BENCHMARKS.values():
        # the tests read one form of each file: the one whose bytes are known, else what the cache keeps
        names = [source.filename for source in entry.sources if source.sha256] or [entry.cached_as]
        if not entry.sources or (folder / names[0]).is_file():
            continue
        with tempfile.TemporaryDirectory() as cache:
            os.environ["NNSS_DATA_DIR"] = cache
            try:
                if names[0] == entry.cached_as:
                    got = download.fetch(entry)
                else:
                    (source,) = [source for source in entry.sources if source.sha256]
                    got = download._retrieve(source, Path(cache), None)
                    download.install(entry, got)
                shutil.copy(got, folder / names[0])
            except (InputError, OSError, ValueError) as error:
                lost.append(f"{names[0]}: {' '.join(str(error).split())[:120]}")
    return lost


if __name__ == "__main__":
    if folder_of_files() is None:
        for line in fetch_files(Path(sys.argv[1])):
            print(f"not fetched for the tests: {line}")
        if folder_of_files() is None:
            print("tests of the real records will be skipped: NNSS_TEST_MIRROR=FOLDER names a folder that has them")
