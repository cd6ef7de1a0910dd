"""A headless Chromium and axe-core, from the npm registry, for the tests of the page.

    python tests/browser/fetch.py .browser

brings them into a folder, or does nothing where they are. Linux on x86-64 only; elsewhere, or to use another browser,
name the program of a Chromium with NNSS_BROWSER.
"""

import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).parent
UNPACK = """
const fs = require("fs"), zlib = require("zlib"), [, from, to] = process.argv;
fs.writeFileSync(to, zlib.brotliDecompressSync(fs.readFileSync(from)), { mode: 0o755 });
"""


def fetch(folder: Path) -> None:
    """Bring what is pinned in package-lock.json, and unpack the browser last: where it is, all is."""
    chromium = folder / "chromium"
    if chromium.exists() and (folder / "package-lock.json").read_bytes() == (HERE / "package-lock.json").read_bytes():
        return
    missing = [name for name in ("npm", "node") if shutil.which(name) is None]
    if missing:
        sys.exit(f"{' and '.join(missing)}: not found; install Node.js, which brings the browser of these tests")
    folder.mkdir(parents=True, exist_ok=True)
    for name in ("package.json", "package-lock.json"):
        shutil.copy(HERE / name, folder)
    subprocess.run(["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--silent"], cwd=folder, check=True)
    packed = folder / "node_modules" / "@sparticuz" / "chromium" / "bin" / "chromium.br"
    unpacked = folder / "chromium.part"
    subprocess.run(["node", "-e", UNPACK, packed, unpacked], check=True)
    unpacked.replace(chromium)


if __name__ == "__main__":
    fetch(Path(sys.argv[1]))
