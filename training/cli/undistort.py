"""``lodgs undistort``: remove a scene's lens distortion."""

from __future__ import annotations

import argparse
from pathlib import Path

from .options import warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("scene", type=Path, help="COLMAP folder")
    parser.add_argument("--model", type=Path, metavar="DIR", help="folder of its model")
    parser.add_argument("--images", type=Path, metavar="DIR", help="folder of its photos")


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..scenes.colmap import read_scene
    from ..scenes.undistort import CACHE_FOLDER, undistort_scene

    scene = read_scene(options.scene, options.model, options.images)
    result = undistort_scene(scene, scene.folder / CACHE_FOLDER)
    for message in result.warnings:
        warn(message)
    print(f"{result.images_folder}: {len(result.cameras)} photos, {len(scene.distorted)} undistorted")
    return 0
