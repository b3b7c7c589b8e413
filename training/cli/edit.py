"""``lodgs edit``: write a copy of splats that is cleaned up, recoloured or moved."""

from __future__ import annotations

import argparse
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..editing.cleaning import LIMITS, Cleaning
from ..editing.export import FileOptions
from ..editing.look import LOOK_SETTINGS, Look
from ..errors import LodgsError
from ..lod.crop import Crop, CropUnion
from ..settings import settings_of
from ..splats.formats import FORMATS, LEVEL_FORMATS, READABLE
from .options import SOURCE_HELP, add_placement, add_setting, placement_of, setting_values, warn

if TYPE_CHECKING:
    from ..editing.edit import Outputs


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
    parser.add_argument(
        "--folder", type=Path, metavar="DIR", help="folder to write, with a PLY for each level"
    )
    parser.add_argument(
        "--streamed", type=Path, metavar="DIR", help="folder to write, with levels that web viewers stream"
    )
    parser.add_argument(
        "--tiles", type=Path, metavar="DIR", help="folder to write, with 3D Tiles for Cesium and other globes"
    )
    parser.add_argument(
        "--preview", type=Path, metavar="PNG",
        help="image to write with the splats that the clean-up removes, in one colour for each test; needs "
        "no other output",
    )  # fmt: skip
    for f in settings_of(FileOptions).values():
        add_setting(parser, f)


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
    from ..editing.edit import check_paths
    from ..runs.folder import find_splats
    from ..splats.formats import open_as_ply

    limits = setting_values(options, Cleaning)
    _check_effects(options)
    if options.keep == "all" and (options.crop_box or options.crop_sphere) and _look(options) is None:
        raise LodgsError(
            "Cannot edit with --keep all: the crops have no effect without a look.",
            "Add a look to apply in the crops, such as --exposure 1, or omit --keep.",
        )
    if limits.keys() & {"max_distance", "min_views"} and options.scene is None:
        raise LodgsError(
            "Cannot test splats against photos: their scene is missing.", "Add its folder with --scene."
        )
    outputs = _outputs(options)
    check_paths(options.source, outputs)  # before the source is converted to a temporary file
    if not (options.preview or outputs.paths):
        raise LodgsError(
            "Cannot write the edited splats: no output.",
            "Add --out, --plain, --levels, --folder, --streamed, --tiles or --preview.",
        )
    if options.appearance:
        from ..runs.finished import bake_again  # imports torch, which takes seconds

        opened = bake_again(options.source, options.appearance, warn)
    else:
        opened = open_as_ply(find_splats(options.source))
    with opened as source:
        _edit(options, source, outputs, limits)
    return 0


def _check_effects(options: argparse.Namespace) -> None:
    """Check that each option has something to affect.

    Raises:
        LodgsError: one has not.
    """
    files = [*options.plain, *options.levels]
    others = [folder for folder in (options.streamed, options.tiles) if folder is not None]
    chosen, limits = setting_values(options, FileOptions), setting_values(options, Cleaning)
    floaters = limits.get("drop_floaters") or limits.get("clutter")
    uses_scene = limits.keys() & {"max_distance", "min_views"} or options.ground or options.preview
    crops = [*options.crop_box, *options.crop_sphere]
    checks = [
        ("--halo-opacity 0", limits.get("halo_opacity") == 0, False, "a value above 0"),
        ("--gap", "gap" in limits, floaters, "--drop-floaters or --clutter"),
        ("--share", "share" in limits, floaters, "--drop-floaters or --clutter"),
        ("--scene", options.scene, uses_scene, "--max-distance, --min-views, --ground or --preview"),
        ("--keep outside", options.keep == "outside", crops, "--crop-box or --crop-sphere"),
        ("--antialiased", chosen.get("antialiased"), [*files, *others], "--plain, --levels or --streamed"),
        ("--original-place", chosen.get("original_place"), files, "--plain or --levels"),
        ("--lod-errors", chosen.get("lod_errors"), options.streamed, "--streamed"),
    ]
    for option, is_set, affected, remedy in checks:
        if is_set and not affected:
            raise LodgsError(f"Cannot edit with {option}: it has no effect.", f"Add {remedy}, or omit it.")


def _outputs(options: argparse.Namespace) -> Outputs:
    """Return the outputs other than the preview."""
    from ..editing.edit import Outputs

    return Outputs(**{f.name: getattr(options, f.name) for f in fields(Outputs)})


def _edit(options: argparse.Namespace, source: Path, outputs: Outputs, limits: dict[str, Any]) -> None:
    """Write the preview and the edited splats of a source, whose file may be temporary."""
    from ..editing.edit import edit
    from ..scenes.colmap import read_scene
    from ..splats.level_folder import read_origin

    crops, look, scene = _crops(options), _look(options), None
    limit = None
    if options.keep == "all":
        limit, crops = CropUnion(tuple(crops)) if crops else None, []
    if options.scene is not None:
        scene = read_scene(options.scene, origin=read_origin(source))
        limits["cameras"] = tuple(scene.cameras)
    cleaning = Cleaning(tuple(crops), **limits)
    if options.preview:
        from ..render.preview import preview

        views = None if scene is None else (scene.cameras, scene.near())
        print(preview(source, cleaning, options.preview, warn, views=views))
    if not outputs.paths:
        return
    file_options = FileOptions(**setting_values(options, FileOptions))
    measure = None
    if file_options.lod_errors:
        from ..evaluate.level_errors import measure_level_errors as measure
    print(
        edit(
            source, outputs, cleaning, warn,
            placement=placement_of(options), upright=options.upright, ground=options.ground,
            points=None if scene is None else scene.points,
            looks=[(limit, look)] if look else (),
            options=file_options, measure=measure,
        )
    )  # fmt: skip


def _crops(options: argparse.Namespace) -> list[Crop]:
    outside = options.keep == "outside"
    boxes = [Crop.box(box[:3], box[3:], outside) for box in options.crop_box]
    return boxes + [Crop.sphere(sphere[:3], sphere[3], outside) for sphere in options.crop_sphere]


def _look(options: argparse.Namespace) -> Look | None:
    """Return the look that the user set; None without any option of it."""
    values = setting_values(options, Look)
    return Look(**values) if values else None
