"""Methods behind one protocol: a file each, and those of plug-ins. `nnss_cli.testing` has the laws that they obey."""

from nnss_cli.methods.linear import chosen_horizon
from nnss_cli.methods.protocol import Fit, Method, Model, ModelReader, Settings
from nnss_cli.methods.registry import DEFAULT, METHODS, load_model, select, sound_method, version_of

__all__ = [
    "DEFAULT", "METHODS", "Fit", "Method", "Model", "ModelReader", "Settings",
    "chosen_horizon", "load_model", "select", "sound_method", "version_of",
]  # fmt: skip
