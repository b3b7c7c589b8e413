"""Capture splats that have no photographs: render views of them as a COLMAP scene to train from."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import LodgsError, system_reason
from ..rasterize import Gaussians, Rendering, cpu_fallback_reason, rasterize
from ..scenes.cameras import Camera, pick_evenly, read_camera_folder
from ..scenes.colmap import read_scene
from ..scenes.images import check_image
from ..scenes.viewpoints import opaque_means, surrounding_views
from ..scenes.write_colmap import write_visible_points
from ..splats.dialects import Warn, ignore
from ..splats.gaussians import Splats
from ..splats.origin import NO_ORIGIN
from .base import read_base, read_base_cameras, read_base_origin
from .job import AUTO, DOME, MIN_VIEWS

POINTS = 60_000
"""Approximate number of points in a captured scene, including those that only one view sees."""

_MAX_NAME = 60
"""Maximum length of a view's name in an image's name, which file systems limit to 255 bytes."""

ReportView = Callable[[int, int], object]
"""Called before each view with its number, from 1, and the number of views."""


def capture(
    base: str | Path,
    scene: Path,
    source: str | Path,
    views: int,
    width: int,
    *,
    backend: str = "auto",
    report: ReportView = lambda number, count: None,
    warn: Warn = ignore,
) -> tuple[int, int]:
    """Render splats as a COLMAP scene to train from.

    Args:
        base: splats that ``read_base`` reads.
        scene: new folder.
        source: AUTO (the base's own cameras, else as DOME), DOME, or a folder of camera files.
        views, width: maximum number of views without camera files, and their image width in pixels.
        backend: rasterizer.
        report, warn: as for :func:`write_scene` and ``read_base``.

    Returns:
        The number of views and of points in the scene.

    Raises:
        LodgsError: the base or the camera files cannot be read, or as :func:`write_scene`.
    """
    if problem := cpu_fallback_reason(backend):
        warn(problem)
    splats, antialias = read_base(base, warn)
    origin = read_base_origin(base)
    cameras, near = _own_cameras(base, views, width) if source == AUTO else ([], 0.0)
    if len(cameras) < MIN_VIEWS and source in (AUTO, DOME):
        cameras, near = surrounding_views(opaque_means(splats), views, width, round(width * 2 / 3))
    elif source != AUTO:
        cameras, near = read_camera_folder(Path(source))
        cameras = [camera.moved(-origin) for camera in cameras]
    return len(cameras), write_scene(
        scene, splats, cameras, near, backend=backend, antialias=antialias, report=report, origin=origin
    )


def _own_cameras(base: str | Path, count: int, width: int) -> tuple[list[Camera], float]:
    """Return at most ``count`` evenly spaced cameras that a base has in its tables, and their near depth."""
    cameras, near = read_base_cameras(base)
    return [camera.scaled(width / camera.width) for camera in pick_evenly(cameras, count)], near


def write_scene(
    scene: Path,
    splats: Splats,
    cameras: Sequence[Camera],
    near: float,
    points: int = POINTS,
    backend: str = "auto",
    antialias: bool = False,
    report: ReportView = lambda number, count: None,
    origin: np.ndarray = NO_ORIGIN,
) -> int:
    """Write scene/images/*.jpg and scene/sparse/0/*.bin, or nothing if an error occurs.

    Points lie where rays through random pixels hit the splats (median depth), if a second view agrees.
    One view is in memory at a time; depth maps wait on disk.

    Args:
        scene: new folder.
        splats: splats to render.
        cameras: views, in the splats' world.
        near: near clipping depth in world units.
        points: number of rays.
        backend: rasterizer.
        antialias: rendering mode of the splats, see ``Bundle.antialias``.
        report: called before each view with its number and the number of views.
        origin: (3,) local origin of the splats, which the written scene adds.

    Returns:
        The number of points.

    Raises:
        LodgsError: the folder exists or cannot be written, or no two views see the same surface.
    """
    scene = Path(scene)
    if scene.exists():
        raise LodgsError(f"Cannot write scene: {scene} already exists.", "Choose a new folder.")
    temporary = scene.with_name(f".{scene.name}.tmp")
    try:
        shutil.rmtree(temporary, ignore_errors=True)
        for folder in ("images", "depths"):
            (temporary / folder).mkdir(parents=True)
        render = partial(
            rasterize, Gaussians.of(splats), near=near, antialias=antialias, outputs=("median_depth",),
            backend=backend,
        )  # fmt: skip
        count = _write(temporary, cameras, render, points, report, origin)
        shutil.rmtree(temporary / "depths")
        temporary.rename(scene)
    except OSError as error:
        raise LodgsError(
            f"Cannot write scene {scene}: {system_reason(error)}.",
            "Free some disk space or choose another folder.",
        ) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return count


def is_complete(scene: Path) -> bool:
    """Return whether a captured scene has all its files, undamaged."""
    try:
        captured = read_scene(scene)
        for camera in captured.cameras:
            assert camera.image is not None
            check_image(camera.image)
    except LodgsError:
        return False
    return len(captured.cameras) == len(captured.names) and len(captured.points) > 0


def _write(
    scene: Path,
    cameras: Sequence[Camera],
    render: Callable[[Camera], Rendering],
    points: int,
    report: ReportView,
    origin: np.ndarray,
) -> int:
    """Write images, depth maps and a COLMAP model into existing folders; return the number of points.

    Args:
        render: function that renders a view with median depths.
        points, report, origin: see :func:`write_scene`.
    """
    rng = np.random.default_rng(0)
    names = _image_names([camera.name for camera in cameras])
    views = [replace(camera, name=name) for camera, name in zip(cameras, names, strict=True)]
    positions = []
    colors = []
    for number, view in enumerate(views):
        report(number + 1, len(views))
        rendering = render(view)
        assert rendering.median_depth is not None  # requested in outputs
        image = (rendering.image.cpu().numpy().clip(0, 1) * 255).round().astype(np.uint8)
        depth = rendering.median_depth.cpu().numpy()
        Image.fromarray(image).save(scene / "images" / view.name, quality=95, subsampling=0)
        content = io.BytesIO()  # np.save reports a full disk without its name
        np.save(content, depth)
        (scene / "depths" / f"{number}.npy").write_bytes(content.getbuffer())
        x, y = rng.integers([view.width, view.height], size=(points // len(views) + 1, 2)).T
        x, y = x[depth[y, x] > 0], y[depth[y, x] > 0]
        positions.append(view.unproject(np.column_stack([x, y]) + 0.5, depth[y, x]))
        colors.append(image[y, x])
    return write_visible_points(
        scene, views, lambda number: np.load(scene / "depths" / f"{number}.npy"),
        np.concatenate(positions), np.concatenate(colors), origin,
    )  # fmt: skip


def _image_names(views: Sequence[str]) -> list[str]:
    """Return a different file name without folders for the image of each view.

    A bundle may name its views like photos in subfolders, or, from another program, like files elsewhere.
    """
    names: dict[str, str] = {}
    for number, view in enumerate(views):
        name = re.sub(r'[\x00-\x1f\\/:*?"<>|\ud800-\udfff]', "_", view).lstrip(". ")[-_MAX_NAME:]
        while not name or name.casefold() in names:
            name = f"{number}_{name}"
        names[name.casefold()] = f"{name}.jpg"
    return list(names.values())
