"""nnss: a bench for system identification around the stable-by-design NN-SS model.

    import nnss_cli as nnss

    model = nnss.load("results/twotank/paper/runs/nnss-n3-s0")
    y = model.simulate(u, y_init).y

Nothing heavy is loaded before it is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nnss_cli.version import __version__

if TYPE_CHECKING:
    from nnss_cli.api import Study, compare, fit, inspect
    from nnss_cli.datasets.record import Dataset, Record
    from nnss_cli.errors import InputError
    from nnss_cli.trained import TrainedModel, load

_HOME = {
    "compare": "nnss_cli.api",
    "fit": "nnss_cli.api",
    "inspect": "nnss_cli.api",
    "Study": "nnss_cli.api",
    "Dataset": "nnss_cli.datasets.record",
    "Record": "nnss_cli.datasets.record",
    "InputError": "nnss_cli.errors",
    "TrainedModel": "nnss_cli.trained",
    "load": "nnss_cli.trained",
}
"""Where a public name is, which is imported when it is asked for."""

__all__ = [
    "Dataset",
    "InputError",
    "Record",
    "Study",
    "TrainedModel",
    "__version__",
    "compare",
    "fit",
    "inspect",
    "load",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'nnss_cli' has no attribute '{name}'")
    from nnss_cli.machine import prepare

    prepare()  # before anything loads numpy
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
