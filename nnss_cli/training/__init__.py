"""How an NN-SS model is trained."""
