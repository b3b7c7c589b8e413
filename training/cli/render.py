"""``lodgs render``: render one view as an image file."""

from __future__ import annotations

import argparse
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import LodgsError
from .options import (
    BACKEND_HELP,
    SOURCE_HELP,
    add_controls,
    control_values,
    parse_color,
    parse_size,
    require_effect,
    warn,
)

if TYPE_CHECKING:
    from ..render.command import RenderSource


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.add_argument("source", type=Path, help=SOURCE_HELP)
    camera = parser.add_mutually_exclusive_group(required=True)
    camera.add_argument("--camera", type=Path, help="JSON file of a camera, as Blender's LODGS tab writes it")
    camera.add_argument("--view", metavar="IMAGE", help="file name of a training photo")
    parser.add_argument("--scene", type=Path, help="COLMAP folder of the photos, if no run names it")
    parser.add_argument("--out", type=Path, required=True, help="image to write: .png or .exr")
    parser.add_argument(
        "--size", type=parse_size, metavar="WxH", help="image size in pixels (default: the camera's)"
    )
    parser.add_argument("--level", type=int, default=0, help="level to render (default: the finest)")
    parser.add_argument(
        "--by-distance", action="store_true",
        help="select levels by camera distance; implied by any option of that group",
    )  # fmt: skip
    add_controls(parser)
    parser.add_argument(
        "--background", type=parse_color, default=(0.0, 0.0, 0.0), metavar="COLOUR",
        help="display-coded R,G,B from 0 to 1 behind the splats, or transparent (default: black)",
    )  # fmt: skip
    parser.add_argument(
        "--holdout", type=Path, metavar="DEPTH.exr", help="hide splats behind this Depth pass of meshes"
    )
    parser.add_argument("--backend", default="auto", help=BACKEND_HELP)


def run(options: argparse.Namespace) -> int:
    """Run the command and return its exit code."""
    from ..render.command import RenderSource
    from ..scenes.cameras import check_render_size
    from ..splats.formats import open_as_ply

    if options.size:
        check_render_size(*options.size)
    if options.camera:
        require_effect({"--scene": options.scene}, "--view")
    controls = control_values(options)
    if (controls or options.by_distance) and options.level:
        raise LodgsError(
            "Cannot combine --level with selection of levels by distance.", "Use only one of them."
        )
    with open_as_ply(options.source) if options.source.exists() else nullcontext(options.source) as path:
        return _render(options, RenderSource.read(path, warn), controls)


def _render(options: argparse.Namespace, source: RenderSource, controls: dict[str, float]) -> int:
    """Render a source, whose file may be temporary."""
    from ..lod.rule import find_rule
    from ..lod.selection import unknown_rule_error
    from ..render.command import render
    from ..scenes.cameras import read_camera

    if options.camera:
        camera, near = read_camera(options.camera)
        camera = camera.moved(-source.origin)
    else:
        camera, near = source.view(options.view, options.scene)
    if options.size:
        camera = camera.resized(*options.size)
    selected = controls if controls or options.by_distance else None
    if source.rule and find_rule(source.rule) is None and selected is None and not options.level:
        warn(" ".join(unknown_rule_error(source.rule)))
    rendered = render(
        source, camera, near, options.out, level=options.level, controls=selected,
        background=options.background, holdout=options.holdout, backend=options.backend, warn=warn,
    )  # fmt: skip
    megabytes = f" of {rendered.bytes_read / 1e6:.1f} MB" if rendered.bytes_read else ""
    print(f"{options.out}: {rendered.loaded:,} splats loaded{megabytes}")
    return 0
