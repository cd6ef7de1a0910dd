"""nnss: a bench for system identification around the stable-by-design NN-SS model."""

from nnss_cli.version import __version__

__all__ = ["__version__"]
