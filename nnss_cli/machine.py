"""Settings of the numerical libraries that must be made before they are loaded."""

import os
from collections.abc import Iterator
from contextlib import contextmanager


def prepare() -> None:
    """One BLAS thread a process.

    The matrices are tiny: more threads only slow a process down, and workers would fight over the
    cores. Settings that the user has made are kept; worker processes inherit them.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")


@contextmanager
def few_threads() -> Iterator[None]:
    """As many BLAS threads as `prepare` asks for, where NumPy was loaded before it and has taken all cores."""
    from threadpoolctl import threadpool_limits

    wanted = os.environ.get("OPENBLAS_NUM_THREADS", "1")
    with threadpool_limits(int(wanted) if wanted.isdecimal() and int(wanted) > 0 else None, "blas"):
        yield
