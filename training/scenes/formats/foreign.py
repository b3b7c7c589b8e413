"""Files of other programs that LODGS does not read, with the export to choose instead."""

from __future__ import annotations

import os
from pathlib import Path

from ..colmap import subfolders
from ..images import IMAGE_SUFFIXES
from .exported import visible_files

FIND_CAMERAS = "find the cameras again: lodgs scene --photos DIR --out SCENE"
_FRAMES = "blender --command lodgs frames VIDEO --out SCENE/images"
_REGISTRATION = "registration as Internal/External Camera Parameters (CSV)"
_FILES = {
    ".r3d": ("a packed Record3D file", "Unpack it as a ZIP archive and choose its folder"),
    ".zip": ("an archive", "Unpack it and choose its folder"),
    ".psx": ("a Metashape project", "Export its cameras with File > Export > Export Cameras (XML)"),
    ".psz": ("a Metashape project", "Export its cameras with File > Export > Export Cameras (XML)"),
    ".rcproj": ("a RealityCapture project", f"Export its {_REGISTRATION}"),
    ".rsproj": ("a RealityScan project", f"Export its {_REGISTRATION}"),
    ".csv": ("a table without lenses", f"Export the {_REGISTRATION}"),
    ".xmp": ("data of a photo without a camera", f"Export the {_REGISTRATION}"),
    ".nvm": ("a VisualSFM file", "Save the model for Bundler (bundle.out)"),
    ".sfm": ("a Meshroom file", "Export the cameras for COLMAP"),
    "poses_bounds.npy": ("a file of LLFF", "Choose the folder of its COLMAP model"),
    "cameras_sphere.npz": ("a file of NeuS", "Choose the data set's COLMAP model or transforms.json"),
    ".heic": ("a HEIC photo, which is not supported", "Convert the photos to JPEG"),
    ".mp4": ("a video", f"Extract its frames with {_FRAMES}"),
    ".mov": ("a video", f"Extract its frames with {_FRAMES}"),
    "database.db": ("a COLMAP database without a model", "Choose the folder of the model"),
}
"""Descriptions and remedies by suffix or name."""
_SPLAT_CAMERAS = "cfg_args", "point_cloud", "input.ply"
"""Files and folders of a 3DGS program's output."""


def describe_foreign(folder: Path) -> tuple[str, str] | None:
    """Return the reason why a folder is no export, and a remedy; None for unknown contents.

    Only names are inspected.
    """
    try:
        files = visible_files(folder)
    except OSError:
        return None
    if any((folder / name).exists() for name in _SPLAT_CAMERAS):
        return "it is the output of a 3DGS program", "Choose the scene that it was trained from."
    for path in files:
        name = path.name.lower()
        kind, remedy = _FILES.get(name) or _FILES.get(path.suffix.lower()) or ("", "")
        if kind:
            return f"{path.name} is {kind}", f"{remedy}, or {FIND_CAMERAS}."
    if any(map(_holds_photos, (folder, *subfolders(folder)))):
        return "it has photos, but no cameras", f"{FIND_CAMERAS[0].upper()}{FIND_CAMERAS[1:]}."
    return None


def _holds_photos(folder: Path) -> bool:
    try:
        return any(name.lower().endswith(IMAGE_SUFFIXES) for name in os.listdir(folder))
    except OSError:
        return False
