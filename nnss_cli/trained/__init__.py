"""A trained model in use: opened from its folder, simulated, linearised, exported; records opened for it."""

from nnss_cli.trained.model import TrainedModel, load
from nnss_cli.trained.records import read_record, read_start, read_timed

__all__ = ["TrainedModel", "load", "read_record", "read_start", "read_timed"]
