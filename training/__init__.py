"""Gaussian splats with levels of detail: files, rules, scenes and the trainer. Never imports bpy.

Blender loads ``splats``, ``lod``, ``editing``, ``scenes`` and the file handling of ``runs``, which need only
numpy. ``rasterize``, ``methods`` and ``evaluate`` need the trainer's environment (torch, numba).
"""

VERSION = "0.1.0"
