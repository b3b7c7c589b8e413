"""Write the page of a bundle: its levels for streaming or in one file, cameras and a poster. Needs torch."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping
from dataclasses import replace
from math import atan, degrees
from pathlib import Path
from string import Template

import numpy as np

from ...editing.bake_filter import bake_filter
from ...editing.edit import open_levels
from ...editing.placement import transform_bundle, upright_placement
from ...editing.portable import portable_levels
from ...errors import LodgsError, printable
from ...files import CLUTTER, atomic_folder, atomic_write, check_name, temporary_folder
from ...rasterize.resident import ResidentBundle
from ...scenes.cameras import Camera, pick_evenly
from ...scenes.images import write_png
from ...scenes.overview import central_ball, overview_camera
from ...scenes.view_tables import make_view_tables, read_view_tables
from ...splats.dialects import Warn, ignore
from ...splats.levels import Bundle, Level
from ...splats.similarity import Similarity
from ...splats.sog import write_sog
from ...splats.streamed_levels import STREAMED_FILE, write_streamed_levels
from ..folder import find_splats

VIEWER = Path(__file__).resolve().parents[2] / "viewer"
PAGE, LEVELS, POSTER = "index.html", "levels", "poster.png"
"""Parts of a page in a folder, in addition to the viewer."""
MAX_CAMERAS = 12
"""Maximum number of cameras in the list; views are selected evenly."""
MAX_SINGLE = 200_000
"""Maximum number of splats of a page in one file."""
POSTER_WIDTH = 960
WINDOW = 16 / 9
"""Assumed width of a browser's window, relative to its height."""
SAMPLE = 100_000
"""Approximate number of splats that determine the center of a scene."""
BUDGETS = 0.1, 0.25, 0.5, 1.0
"""Offered splat budgets, as fractions of the finest level."""
_DOWN = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""From z up to y down, the axes of 3DGS files that the viewer expects."""
_VIEWER = np.array([-1.0, -1, 1])
"""From the axes of the file to those of the viewer, which turns files by half a turn."""


def write_page(
    source: Path, out: Path, single: bool = False, title: str = "", backend: str = "auto", warn: Warn = ignore
) -> str:
    """Write a folder with a page that shows levels, or one file with the splats of one level.

    Args:
        source: run, bundle, folder of levels or 3DGS PLY.
        out: folder, which must be empty, new or an earlier page; with ``single``, an HTML file.
        single: put the finest level with at most MAX_SINGLE splats, the viewer and the poster into one file,
            which opens without a server.
        title: title of the page; the name of the run or file if empty.
        backend: rasterizer of the poster, one of ``runs.job.BACKENDS``.
        warn: called with warnings about the splats.

    Returns:
        A report.

    Raises:
        LodgsError: the viewer is missing, the source cannot be read, or the page cannot be written.
    """
    viewer = _read_viewer()
    _check_place(out, single)
    path = find_splats(source)
    title = printable(title or (path.resolve().parent.name if path.stem == "bundle" else path.stem))
    bundle = open_levels(path, warn)
    levels, _ = portable_levels(bake_filter(bundle))
    cameras, near, _ = read_view_tables(bundle.tables)
    if not cameras:
        finest = bundle.levels[-1]
        loaded = Level(finest.number, finest.rows.select(slice(0, len(finest.rows))))
        camera, near = overview_camera(replace(bundle, levels=[loaded]), POSTER_WIDTH)  # completes the meta
        cameras = [replace(camera, name="Overview")]
    placement = Similarity(_DOWN, 1.0, np.zeros(3)).compose(upright_placement(bundle, upright=True))
    viewed = replace(levels.bundle, tables=make_view_tables(pick_evenly(cameras, MAX_CAMERAS), near))
    placed = transform_bundle(viewed, placement)
    page = _describe(placed)
    if single:
        with atomic_write(out) as temporary, temporary_folder(out.parent) as work:
            _write_poster(work / POSTER, bundle, cameras[0], near, backend)
            _write_single(work, placed, page, viewer, title)
            (work / PAGE).replace(temporary)
    else:
        with atomic_folder(out) as target:
            _write_poster(target / POSTER, bundle, cameras[0], near, backend)
            _write_folder(target, placed, page, viewer, title)
    remedy = "" if single else f" Browsers need a server: python -m http.server --directory {out}"
    return f"{out}: written.{remedy}"


def _check_place(out: Path, single: bool) -> None:
    """Raise a LodgsError if the page would replace anything but an earlier page."""
    check_name(out)
    if single:
        if out.suffix.lower() != ".html":
            raise LodgsError(f"Cannot write {out}: a page in one file is HTML.", "End its name with .html.")
        if out.is_dir():
            raise LodgsError(f"Cannot write {out}: it is a folder.", "Choose another name.")
        return
    if out.exists() and not out.is_dir():
        raise LodgsError(f"Cannot write a page to {out}: it is not a folder.", "Choose an empty folder.")
    names = {path.name for path in out.iterdir()} - CLUTTER if out.is_dir() else set()
    if names and not ({PAGE, LEVELS} <= names <= {PAGE, LEVELS, VIEWER.name, POSTER}):
        raise LodgsError(f"Cannot write a page to {out}: it contains other files.", "Choose an empty folder.")


def _read_viewer() -> dict[str, str]:
    """Return the viewer's files by name.

    Raises:
        LodgsError: this copy of LODGS lacks them.
    """
    try:
        names = "index.js", "index.css", "LICENSE"
        return {name: (VIEWER / name).read_text("utf-8") for name in names}
    except OSError as error:
        raise LodgsError(
            "Cannot write a page: this copy of LODGS has no viewer.",
            "Run python tools/viewer.py with a network, or use a release.",
        ) from error


def _describe(bundle: Bundle) -> dict:
    """Return the page's settings: budgets, cameras and the background."""
    rows = bundle.levels[-1].rows
    means = rows.select(np.arange(0, len(rows), max(1, len(rows) // SAMPLE))).means
    center, radius = central_ball(means)
    cameras, _, _ = read_view_tables(bundle.tables)
    poses = [(camera.name, _pose(camera, center, radius)) for camera in cameras]
    count = len(rows)
    settings = {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": [0, 0, 0]},
        "postEffectSettings": {
            "sharpness": {"enabled": False, "amount": 0},
            "bloom": {"enabled": False, "intensity": 1, "blurLevel": 2},
            "grading": {
                "enabled": False, "brightness": 0, "contrast": 1, "saturation": 1, "tint": [1, 1, 1],
            },
            "vignette": {"enabled": False, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {"enabled": False, "intensity": 0.5},
        },
        "animTracks": [],
        "cameras": [{"initial": poses[0][1]}],
        "annotations": [
            {"position": pose["target"], "title": name, "text": "", "camera": {"initial": pose}}
            for name, pose in poses
        ],
        "startMode": "default",
    }  # fmt: skip
    return {
        "settings": settings,
        "budgets": sorted({max(1, round(share * count)) for share in BUDGETS}),
        "levels": [len(level.rows) for level in bundle.levels],
    }


def _pose(camera: Camera, center: np.ndarray, radius: float) -> dict:
    """Return a camera's position, target and field of view in degrees, in the viewer's axes.

    The viewer applies the field of view to the larger side of its window, contrary to its documentation. In a
    window of the proportions WINDOW, the whole image is visible.
    """
    half_width, half_height = camera.width / camera.fx / 2, camera.height / camera.fy / 2
    forward = camera.world_to_camera[2, :3]
    distance = max(float((center - camera.center) @ forward), 0.2 * radius)
    return {
        "position": (camera.center * _VIEWER).tolist(),
        "target": ((camera.center + distance * forward) * _VIEWER).tolist(),
        "fov": degrees(2 * atan(max(half_width, WINDOW * half_height))),
    }


def _write_poster(path: Path, bundle: Bundle, camera: Camera, near: float, backend: str) -> None:
    camera = camera.scaled(min(1.0, POSTER_WIDTH / camera.width))
    rendering = ResidentBundle(bundle, backend).draw_level(bundle.levels[-1].number, camera, near=near)
    image = np.nan_to_num(rendering.image.detach().cpu().numpy())  # extreme coefficients give NaN
    write_png(path, np.rint(image.clip(0, 1) * 255).astype(np.uint8))


def _write_folder(folder: Path, bundle: Bundle, page: dict, viewer: Mapping[str, str], title: str) -> None:
    write_streamed_levels(folder / LEVELS, bundle)
    (folder / VIEWER.name).mkdir()
    for name, text in viewer.items():
        (folder / VIEWER.name / name).write_text(text, "utf-8")
    page |= {"streamed": True, "content": f"./{LEVELS}/{STREAMED_FILE}"}
    page["poster"] = f"./{POSTER}"
    style = '<link rel="stylesheet" href="./viewer/index.css">'
    script = 'import { createViewer } from "./viewer/index.js";'
    _write_html(folder / PAGE, page, title, style, script)


def _write_single(folder: Path, bundle: Bundle, page: dict, viewer: Mapping[str, str], title: str) -> None:
    small = [level for level in bundle.levels if len(level.rows) <= MAX_SINGLE]
    if not small:
        raise LodgsError(
            f"Cannot write a page in one file: every level has more than {MAX_SINGLE:,} splats.",
            "Write a folder without --single.",
        )
    write_sog(folder / "splats.sog", small[-1].rows, {})
    page |= {"streamed": False, "name": "splats.sog", "levels": [len(small[-1].rows)]}
    page["content"] = _data_address(folder / "splats.sog", "application/zip")
    page["poster"] = _data_address(folder / POSTER, "image/png")
    script = viewer["index.js"].replace("export { createViewer };", "").rsplit("//# sourceMappingURL", 1)[0]
    notice = viewer["LICENSE"].replace("*/", "")
    _write_html(
        folder / PAGE, page, title, f"<style>{viewer['index.css']}</style>", f"/*\n{notice}*/\n{script}"
    )


def _data_address(path: Path, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(path.read_bytes()).decode()}"


def _write_html(path: Path, page: dict, title: str, style: str, script: str) -> None:
    counts = page.pop("levels")
    levels = f"{len(counts)} levels, " if len(counts) > 1 else ""
    values = {
        "title": html.escape(title),
        "summary": f"{levels}{counts[-1]:,} splats",
        "style": style,
        "script": script,
        "page": json.dumps(page).replace("<", "\\u003c"),
    }
    template = (Path(__file__).parent / "page.html").read_text("utf-8")
    path.write_text(Template(template).substitute(values), "utf-8")
