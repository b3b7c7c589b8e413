"""Splats with levels of detail: files, rules, scenes and the trainer. Never imports bpy.

``splats``, ``lod``, ``scenes`` and the folder side of ``runs`` are numpy only, so that Blender can load
them; ``rasterize``, ``methods`` and ``evaluate`` need the trainer's environment (torch, numba).
"""

VERSION = "0.1.0"
