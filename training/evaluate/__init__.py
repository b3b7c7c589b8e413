"""How good a trained model is on views that it has not seen."""
