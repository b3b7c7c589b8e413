"""``lodgs scene``: make a COLMAP scene from photos or from another program's export."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from ..errors import LodgsError
from ..scenes.formats import FORMAT_NAMES
from ..scenes.reconstruct import LENSES, PRESETS
from .options import require_effect, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Repeat the command to resume an interrupted reconstruction."
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument(
        "--photos", type=Path, metavar="DIR", help="folder of photos whose cameras to reconstruct"
    )
    source.add_argument(
        "--from", dest="source", type=Path, metavar="DIR",
        help=f"folder of an export, recognised by its files: {FORMAT_NAMES}; or of a COLMAP scene that has "
        "no points",
    )  # fmt: skip
    parser.add_argument(
        "--out", type=Path, metavar="DIR",
        help="folder of the new scene (default for --from: the export's folder)",
    )  # fmt: skip
    parser.add_argument(
        "--preset", choices=list(PRESETS), default="draft",
        help="draft: features of photos scaled to 1000 pixels (default); standard: twice as many features, "
        "at 1600 pixels",
    )  # fmt: skip
    parser.add_argument(
        "--ordered", action="store_true",
        help="match only neighbouring photos, because their names follow the camera path",
    )  # fmt: skip
    parser.add_argument(
        "--lens", choices=LENSES, default="",
        help="photos that share a lens: all (one), those of a folder, or none (each). Default: one if all "
        "photos have the same size",
    )  # fmt: skip
    parser.add_argument(
        "--masks", type=Path, metavar="DIR",
        help="images that are black where a photo has no features to use; for a.jpg: a.jpg.png or a.png",
    )  # fmt: skip


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    if options.source:
        unused = {
            "--preset": options.preset != "draft", "--ordered": options.ordered, "--lens": options.lens,
            "--masks": options.masks,
        }  # fmt: skip
        require_effect(unused, "--photos")
    return _reconstruct(options) if options.photos else _convert(options)


def _convert(options: argparse.Namespace) -> int:
    from ..scenes.colmap import read_scene
    from ..scenes.formats import convert_export
    from ..scenes.triangulate import triangulate_scene, write_points

    export = convert_export(
        options.source, options.out, lambda scene, model: write_points(scene, model, _print_progress)
    )
    warnings, points = export.warnings, export.points
    if export.is_source:
        scene = read_scene(export.folder)
        if any(camera.depth is None for camera in scene.cameras):
            scene = triangulate_scene(scene, export.folder, _print_progress)
        warnings, points = [*warnings, *scene.warnings], len(scene.points)
    for message in warnings:
        warn(message)
    print(f"{export.folder}: {export.views} views, {points:,} points, from {export.source}")
    return 0


def _print_progress(stage: str, done: int, total: int) -> None:
    print(f"{stage} {done} of {total}" if total > 1 else stage, file=sys.stderr, flush=True)


def _reconstruct(options: argparse.Namespace) -> int:
    from ..scenes.reconstruct import reconstruct

    if options.out is None:
        raise LodgsError("Cannot reconstruct the photos: no output folder.", "Add --out DIR.")

    scene = reconstruct(
        options.photos, options.out, preset=options.preset, ordered=options.ordered, lens=options.lens,
        masks=options.masks, report=_print_progress,
    )  # fmt: skip
    for message in scene.excluded:
        warn(message)
    print(
        f"{scene.folder}: {scene.points:,} points, mean reprojection error {scene.error:.2f} pixels. "
        f"{scene.summary}"
    )
    return 0
