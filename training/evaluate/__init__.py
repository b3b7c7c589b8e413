"""Measures of the quality and speed of trained splats."""
