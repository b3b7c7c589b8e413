"""The optimiser that methods share: model, density control, training data, losses, regularisation."""
