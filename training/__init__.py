"""Gaussian splats with levels of detail: files, rules, scenes and the trainer. Never imports bpy.

Blender loads ``splats``, ``lod``, ``editing``, ``scenes`` and the file handling of ``runs``, which need only
numpy. ``rasterize``, ``methods`` and ``evaluate`` need the trainer's environment (torch, numba).

The functions of ``api`` are available here and are imported on first use.
"""

import re
from importlib import import_module, metadata
from pathlib import Path

__all__ = ["VERSION", "LodgsError", "load_bundle", "load_scene", "render_image", "select", "train"]  # pyrefly: ignore

_MANIFEST = Path(__file__).resolve().parent.parent / "blender_manifest.toml"


def _read_version() -> str:
    """Return the version of the manifest beside the package, or of the installed package ``lodgs``."""
    if _MANIFEST.exists():
        match = re.search(r'^version = "([^"]+)"', _MANIFEST.read_text(encoding="utf-8"), re.MULTILINE)
        if match:
            return match[1]
    return metadata.version("lodgs")


VERSION = _read_version()


def __getattr__(name: str):
    if name in __all__:
        return getattr(import_module(".api", __name__), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
