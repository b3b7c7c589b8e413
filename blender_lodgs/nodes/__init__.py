"""Geometry-nodes groups, built in code; each states a rule of ``training.lod.rules``."""
