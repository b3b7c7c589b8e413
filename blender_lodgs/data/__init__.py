"""Splat-scene data in .blend files: properties, levels, cameras and the displayed splats."""
