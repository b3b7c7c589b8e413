"""``lodgs edit``: write a copy of splats that is cleaned up, recoloured or moved."""

from __future__ import annotations

import argparse
from pathlib import Path

from ..editing.cleaning import LIMITS, Cleaning
from ..editing.export import EXPORT_OPTIONS
from ..editing.look import LOOK_SETTINGS, Look
from ..errors import LodgsError
from ..lod.crop import Crop
from ..splats.formats import FORMATS, LEVEL_FORMATS, READABLE
from .options import SOURCE_HELP, add_placement, add_setting, placement_of, setting_values, warn


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Edits every level in the same way; levels can still be selected by distance. Positions and "
        "lengths of crops and limits are in the splats' units before the edit (lodgs info prints the "
        "bounds). Remaining splats are rotated, then scaled, then translated. Write negative numbers with "
        "=, as in --translate=-1,0,2."
    )
    parser.add_argument(
        "source", type=Path,
        help=f"{SOURCE_HELP}; also {', '.join(READABLE[1:])} (see docs/reference/formats.md)",
    )  # fmt: skip
    _add_outputs(parser)
    _add_cleaning(parser)
    placement = parser.add_argument_group("placement of the remaining splats")
    add_placement(placement)
    placement.add_argument(
        "--ground", action="store_true", help="first detect the ground, and put it upright at z = 0"
    )
    _add_look(parser)


def _add_outputs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--appearance", nargs="+", default=[], metavar="PHOTO",
        help="bake the networks of a run of octree_neural again, with the mean appearance of these photos",
    )  # fmt: skip
    parser.add_argument("--out", type=Path, help="file or folder to write, in the format of the source")
    parser.add_argument(
        "--plain", type=Path, action="append", default=[], metavar="FILE",
        help="file for the finest level only: " + ", ".join(kind.suffix for kind in FORMATS),
    )  # fmt: skip
    parser.add_argument(
        "--levels", type=Path, action="append", default=[], metavar="FILE",
        help="file for all levels, selected by distance: " + ", ".join(kind.suffix for kind in LEVEL_FORMATS),
    )  # fmt: skip
    parser.add_argument("--folder", type=Path, metavar="DIR", help="folder of levels to write")
    parser.add_argument(
        "--streamed", type=Path, metavar="DIR", help="folder of levels to write for streaming in browsers"
    )
    parser.add_argument(
        "--tiles", type=Path, metavar="DIR", help="folder of 3D Tiles to write, for Cesium and other globes"
    )
    for name in ("antialiased", "original_place"):
        add_setting(parser, EXPORT_OPTIONS[name], value=False)


def _add_cleaning(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--crop-box", type=float, nargs=6, action="append", default=[], metavar="N",
        help="two opposite corners of a box, X Y Z X Y Z; repeatable. Crops are combined by union",
    )  # fmt: skip
    parser.add_argument(
        "--crop-sphere", type=float, nargs=4, action="append", default=[], metavar="N",
        help="centre and radius of a sphere, X Y Z R; repeatable",
    )  # fmt: skip
    parser.add_argument(
        "--keep", choices=("inside", "outside", "all"), default="inside",
        help="side of the crops to keep (default: inside); all: keep everything, and apply the look only "
        "inside them",
    )  # fmt: skip
    tests = parser.add_argument_group("clean-up, which removes matching splats")
    for f in LIMITS.values():
        add_setting(tests, f)
    tests.add_argument(
        "--scene", type=Path, metavar="DIR",
        help="COLMAP folder of the photos, for --max-distance, --min-views and --ground",
    )  # fmt: skip


def _add_look(parser: argparse.ArgumentParser) -> None:
    look = parser.add_argument_group("look, of all splats or with --keep all of those inside the crops")
    for f in LOOK_SETTINGS.values():
        add_setting(look, f)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..editing.edit import edit
    from ..runs.finished import bake_again
    from ..runs.folder import find_splats
    from ..splats.formats import open_as_ply
    from ..splats.level_folder import read_origin

    limits = setting_values(options, Cleaning)
    crops = _crops(options)
    look = _look(options)
    look_crops: list[Crop | None] = [None]
    if options.keep == "all":
        if crops and look is None:
            raise LodgsError("--keep all removes nothing inside the crops.", "Add a look to apply there.")
        look_crops = [*crops] or [None]
        crops = []
    if limits.keys() & {"max_distance", "min_views"} and options.scene is None:
        raise LodgsError(
            "Cannot test splats against photos: their scene is missing.", "Add its folder with --scene."
        )
    folders = (options.folder, options.streamed, options.tiles)
    if not (options.out or options.plain or options.levels or any(folders)):
        raise LodgsError(
            "Cannot write the edited splats: no output.",
            "Add --out, --plain, --levels, --folder, --streamed or --tiles.",
        )
    points = None
    opened = (
        bake_again(options.source, options.appearance, warn)
        if options.appearance
        else open_as_ply(find_splats(options.source))
    )
    with opened as source:
        if options.scene is not None:
            from ..scenes.colmap import read_scene

            scene = read_scene(options.scene, origin=read_origin(source))
            limits["cameras"] = tuple(scene.cameras)
            points = scene.points
        print(
            edit(
                source, options.out, Cleaning(tuple(crops), **limits), warn,
                placement=placement_of(options), upright=options.upright, ground=options.ground,
                points=points, looks=[(crop, look) for crop in look_crops] if look else (),
                plain=options.plain, levels=options.levels, folder=options.folder,
                streamed=options.streamed, tiles=options.tiles,
                antialiased=options.antialiased, original_place=options.original_place,
            )
        )  # fmt: skip
    return 0


def _crops(options: argparse.Namespace) -> list[Crop]:
    outside = options.keep == "outside"
    boxes = [Crop.box(box[:3], box[3:], outside) for box in options.crop_box]
    return boxes + [Crop.sphere(sphere[:3], sphere[3], outside) for sphere in options.crop_sphere]


def _look(options: argparse.Namespace) -> Look | None:
    """Return the look that the user set; None without any option of it."""
    values = setting_values(options, Look)
    return Look(**values) if values else None
