"""Files of other programs that LODGS does not read, with the export to choose instead."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ..colmap import subfolders
from ..image_files import UNREADABLE_SUFFIXES
from ..images import IMAGE_SUFFIXES
from .exported import visible_files

FIND_CAMERAS = "find the cameras again: lodgs scene --photos DIR --out SCENE"
_FRAMES = "blender --command lodgs frames VIDEO --out SCENE/images"
_REGISTRATION = "registration as Internal/External Camera Parameters (CSV)"
_OTHER_FORMAT = "Export the cameras for COLMAP or Bundler"
_POINTS = "a point cloud without cameras", "Choose the photos"
_FILES = {
    ".r3d": ("a packed Record3D file", "Unpack it as a ZIP archive and choose its folder"),
    ".zip": ("an archive", "Unpack it and choose its folder"),
    ".psx": ("a Metashape project", "Export its cameras with File > Export > Export Cameras (XML)"),
    ".psz": ("a Metashape project", "Export its cameras with File > Export > Export Cameras (XML)"),
    ".rcproj": ("a RealityCapture project", f"Export its {_REGISTRATION}"),
    ".rsproj": ("a RealityScan project", f"Export its {_REGISTRATION}"),
    ".csv": ("a table without lenses", f"Export the {_REGISTRATION}"),
    ".xmp": ("data of a photo without a camera", f"Export the {_REGISTRATION}"),
    ".psht": ("a Postshot project", "Choose the photos or the COLMAP scene that it was trained from"),
    ".p4d": ("a Pix4D project", _OTHER_FORMAT),
    "sfm_data.bin": (
        "a binary file of OpenMVG",
        "Convert it to sfm_data.json (openMVG_main_ConvertSfM_DataFormat)",
    ),
    "bundle.out": ("a Bundler file without a list of photos", "Add list.txt next to it"),
    ".nvm": ("a VisualSFM file", "Save the model for Bundler (bundle.out)"),
    ".sfm": ("a Meshroom file", "Export the cameras for COLMAP"),
    "poses_bounds.npy": ("a file of LLFF", "Choose the folder of its COLMAP model"),
    "cameras_sphere.npz": ("a file of NeuS", "Choose the data set's COLMAP model or transforms.json"),
    ".heic": ("a HEIC photo, which is not supported", "Convert the photos to JPEG"),
    ".xml": ("an XML file of another program than Metashape", _OTHER_FORMAT),
    ".abc": ("an animation", _OTHER_FORMAT),
    ".fbx": ("an animation", _OTHER_FORMAT),
    ".las": _POINTS,
    ".laz": _POINTS,
    ".e57": _POINTS,
    ".mp4": ("a video", f"Extract its frames with {_FRAMES}"),
    ".mov": ("a video", f"Extract its frames with {_FRAMES}"),
    "database.db": ("a COLMAP database without a model", "Choose the folder of the model"),
}
"""Descriptions and remedies by suffix or name."""
_SPLAT_CAMERAS = "cfg_args", "point_cloud", "input.ply", "dataparser_transforms.json"
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
    folders = folder, *subfolders(folder)
    if _hold_files(folders, IMAGE_SUFFIXES):
        return "it has photos, but no cameras", f"{FIND_CAMERAS[0].upper()}{FIND_CAMERAS[1:]}."
    if _hold_files(folders, UNREADABLE_SUFFIXES):
        return "its photos have an unsupported format", f"Convert the photos to JPEG, and {FIND_CAMERAS}."
    return None


def _hold_files(folders: Sequence[Path], suffixes: tuple[str, ...]) -> bool:
    """Return whether any of the folders has a file with one of the suffixes."""
    names: list[str] = []
    for folder in folders:
        with suppress(OSError):
            names += os.listdir(folder)
    return any(name.lower().endswith(suffixes) for name in names)
