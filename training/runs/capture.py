"""Splats without photographs become a COLMAP scene: their own pictures are the photographs."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import LodgsError
from ..rasterize import Gaussians, rasterize, why_cpu
from ..scenes.cameras import Camera, read_views
from ..scenes.viewpoints import dome
from ..scenes.write_colmap import write_seen
from ..splats.dialects import Warn, silent
from ..splats.gaussians import Splats
from .base import read_base
from .job import DOME

POINTS = 60_000
"""About so many points a scene gets, those that only one view sees among them."""

Tell = Callable[[int, int], object]
"""Is told before each view which one it is, from 1 on, and of how many."""


def capture(
    base: str | Path,
    scene: Path,
    where: str | Path,
    views: int,
    width: int,
    *,
    backend: str = "auto",
    tell: Tell = lambda number, count: None,
    warn: Warn = silent,
) -> tuple[int, int]:
    """Draws splats as a COLMAP scene to train from.

    Args:
        base: what ``read_base`` reads.
        scene: a folder that is not there yet.
        where: DOME, or a folder of camera files.
        views, width: how many views a dome has, and the pixels that their pictures are wide.
        tell, warn: as for :func:`write_scene` and ``read_base``.

    Returns:
        How many views and points the scene has.

    Raises:
        LodgsError: the base or the camera files cannot be read, or as :func:`write_scene`.
    """
    if problem := why_cpu(backend):
        warn(problem)
    splats, antialias = read_base(base, warn)
    if where == DOME:
        cameras, near = dome(splats, views, width, round(width * 2 / 3))
    else:
        cameras, near = read_views(Path(where))
    return len(cameras), write_scene(
        scene, splats, cameras, near, backend=backend, antialias=antialias, tell=tell
    )


def write_scene(
    scene: Path,
    splats: Splats,
    cameras: Sequence[Camera],
    near: float,
    points: int = POINTS,
    backend: str = "auto",
    antialias: bool = False,
    tell: Tell = lambda number, count: None,
) -> int:
    """Writes scene/images/*.jpg and scene/sparse/0/*.bin; nothing is left of it when something goes wrong.

    Points are where rays through random pixels meet the splats (median depth), as far as two views agree.
    One view is in memory at a time; the depths of the others wait on the disk.

    Args:
        scene: a folder that is not there yet.
        cameras: the views, in the splats' world.
        near: depth at which drawing begins, in world units.
        points: how many to look for.
        antialias: how the splats are drawn, see ``Bundle.antialias``.
        tell: is told before each view which one it is and how many there are.

    Returns:
        How many points there are.

    Raises:
        LodgsError: the folder exists or cannot be written, or no two views see the same.
    """
    scene = Path(scene)
    if scene.exists():
        raise LodgsError(f"{scene} exists already.", "Choose a new folder.")
    beside = scene.with_name(f".{scene.name}.tmp")
    try:
        shutil.rmtree(beside, ignore_errors=True)
        for folder in ("images", "depths"):
            (beside / folder).mkdir(parents=True)
        count = _write(beside, splats, cameras, near, points, backend, antialias, tell)
        shutil.rmtree(beside / "depths")
        beside.rename(scene)
    except OSError as error:
        raise LodgsError(
            f"The scene {scene} could not be written: {error.strerror or error}.",
            "Free some space there or choose another folder.",
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return count


def _write(
    scene: Path,
    splats: Splats,
    cameras: Sequence[Camera],
    near: float,
    points: int,
    backend: str,
    antialias: bool,
    tell: Tell,
) -> int:
    gaussians, rng = Gaussians.of(splats), np.random.default_rng(0)
    views = [replace(camera, name=f"{camera.name}.jpg") for camera in cameras]
    found, colors = [], []
    for number, view in enumerate(views):
        tell(number + 1, len(views))
        drawn = rasterize(
            gaussians, view, near=near, antialias=antialias, outputs=("median_depth",), backend=backend
        )
        assert drawn.median_depth is not None  # as asked for
        picture = (drawn.image.cpu().numpy().clip(0, 1) * 255).round().astype(np.uint8)
        depth = drawn.median_depth.cpu().numpy()
        Image.fromarray(picture).save(scene / "images" / view.name, quality=95, subsampling=0)
        np.save(scene / "depths" / f"{number}.npy", depth)
        x, y = rng.integers([view.width, view.height], size=(points // len(views) + 1, 2)).T
        x, y = x[depth[y, x] > 0], y[depth[y, x] > 0]
        found.append(view.unproject(np.column_stack([x, y]) + 0.5, depth[y, x]))
        colors.append(picture[y, x])
    return write_seen(
        scene, views, lambda number: np.load(scene / "depths" / f"{number}.npy"),
        np.concatenate(found), np.concatenate(colors),
    )  # fmt: skip
