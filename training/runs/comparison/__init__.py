"""Comparison of runs of one scene: measures, images and the page of ``lodgs compare``."""
