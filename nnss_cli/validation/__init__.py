"""What a trained model is worth: a predictor with its noise model, residual tests, bands, a report with a verdict."""

from nnss_cli.validation.check import validate
from nnss_cli.validation.trained import Forecaster, forecaster

__all__ = ["Forecaster", "forecaster", "validate"]
