"""What a trained model is worth: a predictor with its noise model, residual tests, bands, a report with a verdict."""
