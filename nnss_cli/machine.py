"""Settings of the numerical libraries that must be made before they are loaded."""

import os


def prepare() -> None:
    """One BLAS thread a process.

    The matrices are tiny: more threads only slow a process down, and workers would fight over the
    cores. Settings that the user has made are kept; worker processes inherit them.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
