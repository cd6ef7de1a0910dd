"""A trained model for other tools: control, CasADi, ONNX, C99, MATLAB and Octave, each checked before it is kept."""

from nnss_cli.export.parity import ParityError
from nnss_cli.export.write import TARGETS, Exported, export

__all__ = ["TARGETS", "Exported", "ParityError", "export"]
