"""Where a number came from: code, libraries, machine, command, time and memory."""

from __future__ import annotations

import contextlib
import os
import platform
import shlex
import subprocess
import sys
import time
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np

from nnss_cli.version import __version__

LIBRARIES = ("numpy", "scipy", "torch", "numba")
"""Those whose version may change a number's last digits."""

MADE_WITH = ("nnss", "commit", "python", *LIBRARIES)
"""What of the code may differ between runs of one table."""

MADE_ON = ("machine", "cpu", "instructions")
"""What of the machine may."""

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
MEGABYTE = 1e6


class Watch:
    """From the start of a run to its end: times and peak memory."""

    def __init__(self) -> None:
        self._began, self._clock = datetime.now(UTC), time.perf_counter()
        # from here on Linux tells the peak of this run, not that of the process
        with contextlib.suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")

    def provenance(self, command: str | None = None) -> dict[str, str]:
        """What is kept with a run that ends now.

        Args:
            command: what asked for it, if not this process's own command line.
        """
        return here() | {
            "command": command_line() if command is None else command,
            "started": self._began.isoformat(timespec="milliseconds"),
            "finished": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "seconds": f"{time.perf_counter() - self._clock:.3f}",
            "peak memory [MB]": f"{peak_memory() / MEGABYTE:.0f}",
        }


@cache
def here() -> dict[str, str]:
    """Code, libraries and machine of this process."""
    own = {
        "nnss": __version__,
        "commit": _commit(Path(__file__).parents[2]),
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in (*LIBRARIES, *_dependencies())},
        "machine": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu(),
        "instructions": _instructions(),
        "threads": " ".join(f"{name}={os.environ[name]}" for name in THREADS if name in os.environ),
    }
    return {name: value for name, value in own.items() if value}


def command_line() -> str:
    """What this process was called with; a worker process has its parent's."""
    return shlex.join(["nnss", *sys.argv[1:]])


def peak_memory() -> int:
    """Bytes that this process held at most since the last `Watch` (since its start where the system is not Linux)."""
    with contextlib.suppress(OSError, IndexError, ValueError):
        status = Path("/proc/self/status").read_text(encoding="ascii", errors="replace")
        return 1024 * int(status.partition("VmHWM:")[2].split()[0])
    try:
        import resource
    except ImportError:  # Windows
        return 0
    unit = 1 if sys.platform == "darwin" else 1024
    return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def _commit(root: Path) -> str:
    """The commit of nnss's own checkout, with "-dirty" where its files were changed since; "" where there is none."""
    if not (root / ".git").exists():
        return ""
    with contextlib.suppress(OSError, subprocess.SubprocessError):
        return subprocess.run(
            ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"],
            capture_output=True, text=True, check=True, timeout=10, env=os.environ | {"GIT_OPTIONAL_LOCKS": "0"},
        ).stdout.strip()  # fmt: skip
    return ""


def _dependencies() -> list[str]:
    """The packages that nnss requires, by name."""
    with contextlib.suppress(metadata.PackageNotFoundError):
        required = [text for text in metadata.requires("nnss") or [] if "extra ==" not in text]
        return sorted({"".join(c if c.isalnum() or c in "-_." else " " for c in text).split()[0] for text in required})
    return []


def _cpu() -> str:
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


def _instructions() -> str:
    """The instruction sets that numpy's kernels use here, from its build's baseline up."""
    found = np.show_config(mode="dicts")
    sets = found.get("SIMD Extensions", {}) if isinstance(found, dict) else {}
    return " ".join([*sets.get("baseline", []), *sets.get("found", [])])
