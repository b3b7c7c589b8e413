"""Splats in memory and in files: PLY, and bundles with every level of detail."""
