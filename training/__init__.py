"""Gaussian splats with levels of detail: files, rules, scenes and the trainer. Never imports bpy.

Blender loads ``splats``, ``lod``, ``editing``, ``scenes`` and the file handling of ``runs``, which need only
numpy. ``rasterize``, ``methods`` and ``evaluate`` need the trainer's environment (torch, numba).

The functions of ``api`` are available here and are imported on first use.
"""

from importlib import import_module

__all__ = ["VERSION", "load_bundle", "load_scene", "render_image", "select", "train"]  # pyright: ignore

VERSION = "0.1.0"


def __getattr__(name: str):
    if name in __all__:
        return getattr(import_module(".api", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
