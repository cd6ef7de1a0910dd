"""The NN-SS model and its stable parametrisation, in torch."""
