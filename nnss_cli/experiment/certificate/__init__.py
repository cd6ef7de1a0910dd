"""What can be promised of a trained model, and what was seen of it."""

from nnss_cli.experiment.certificate.certify import certify
from nnss_cli.experiment.certificate.result import Certificate

__all__ = ["Certificate", "certify"]
