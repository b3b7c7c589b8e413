"""Optimiser shared by all methods: model, density control, training data, losses and regularisation."""
