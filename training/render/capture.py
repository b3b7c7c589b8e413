"""Splats without photographs become a COLMAP scene: their own pictures are the photographs."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import LodgsError
from ..rasterize import Gaussians, rasterize
from ..scenes.cameras import Camera, look_at
from ..scenes.write_colmap import thinned, visible_in, write_colmap
from ..splats.gaussians import Splats

POINTS = 60_000
"""About so many points a scene gets, those that only one view sees among them."""
SHORTEST_TRACK, LONGEST_TRACK = 2, 4
"""Views that see a point: it is left out below the first, and no more than the last are recorded."""
INSIDE = 0.9
"""The share of opaque splats that a dome is to show whole."""
OPAQUE = 0.5
DOMES = (1.1, 2.2)
"""Radii of a dome's two shells, in multiples of the distance from which the splats fill the picture."""
UP = (0.0, -1.0, 0.0)
"""As in most COLMAP worlds."""
NEAR = 0.01
"""Depth at which drawing begins, as a share of the distance to the splats' middle."""


def dome(splats: Splats, count: int, width: int = 960, height: int = 640) -> tuple[list[Camera], float]:
    """Views of splats from all around, on two shells, and the depth at which drawing begins.

    Which way is up, and whether splats are to be seen from inside, they do not say: for a room or a street
    give cameras of your own.

    Raises:
        LodgsError: there is no opaque splat to look at.
    """
    opaque = splats.means[splats.opacity_logits > np.log(OPAQUE / (1 - OPAQUE))].astype(np.float64)
    if not len(opaque):
        raise LodgsError("There is no opaque splat to look at.", "Give cameras with --cameras.")
    middle = np.median(opaque, axis=0)
    radius = max(float(np.quantile(np.linalg.norm(opaque - middle, axis=1), INSIDE)), 1e-6)
    focal = 1.2 * height
    fills = radius * np.hypot(1, 2 * focal / height)  # a ball of that radius meets the upper and lower edge
    number = np.arange(count)
    z, turn = 1 - (2 * number + 1) / count, number * 2.399963  # evenly, along a spiral
    ring = np.sqrt(1 - z**2)
    away = np.stack([ring * np.cos(turn), z, ring * np.sin(turn)], axis=1)
    eyes = middle + fills * np.where(number % 2, *DOMES)[:, None] * away
    lens = (width, height, focal, focal, width / 2, height / 2)
    views = [Camera(f"dome_{n:03d}", *lens, look_at(eye, middle, UP)) for n, eye in enumerate(eyes)]
    return views, NEAR * fills


def write_scene(
    scene: Path,
    splats: Splats,
    cameras: Sequence[Camera],
    near: float,
    points: int = POINTS,
    backend: str = "auto",
    antialias: bool = False,
) -> int:
    """Writes scene/images/*.jpg and scene/sparse/0/*.bin; nothing is left of it when something goes wrong.

    Points are where rays through random pixels meet the splats (median depth), as far as two views agree.

    Args:
        scene: a folder that is not there yet.
        cameras: the views, of one lens, in the splats' world.
        near: depth at which drawing begins, in world units.
        points: how many to look for.
        antialias: how the splats are drawn, see ``Bundle.antialias``.

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
        (beside / "images").mkdir(parents=True)
        count = _write(beside, splats, cameras, near, points, backend, antialias)
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
) -> int:
    gaussians, rng = Gaussians.of(splats), np.random.default_rng(0)
    views, pictures, depths, found = [], [], [], []
    for camera in cameras:
        drawn = rasterize(
            gaussians, camera, near=near, antialias=antialias, outputs=("median_depth",), backend=backend
        )
        assert drawn.median_depth is not None  # as asked for
        pictures.append((drawn.image.cpu().numpy().clip(0, 1) * 255).round().astype(np.uint8))
        depths.append(drawn.median_depth.cpu().numpy())
        views.append(replace(camera, name=f"{camera.name}.jpg"))
        Image.fromarray(pictures[-1]).save(scene / "images" / views[-1].name, quality=95, subsampling=0)
        x, y = rng.integers([camera.width, camera.height], size=(points // len(cameras) + 1, 2)).T
        found.append(_behind(camera, x, y, depths[-1][y, x]))
    candidates = np.concatenate(found)
    seen = [visible_in(depth, view, candidates) for depth, view in zip(depths, views, strict=True)]
    visible = np.stack([sees for _, sees in seen])
    kept = visible.sum(axis=0) >= SHORTEST_TRACK
    if not kept.any():
        raise LodgsError("No two views see the same splats.", "Give more views, or nearer ones.")
    pixels = np.stack([places[kept] for places, _ in seen])
    visible = thinned(visible[:, kept], LONGEST_TRACK)
    colors = np.zeros((kept.sum(), 3))
    for picture, places, sees in zip(pictures, pixels, visible, strict=True):
        x, y = np.floor(places[sees].T).astype(int)
        colors[sees] += picture[y, x]
    write_colmap(scene, views, candidates[kept], pixels, visible, colors / visible.sum(axis=0)[:, None])
    return int(kept.sum())


def _behind(camera: Camera, x: np.ndarray, y: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """World points (M, 3) at depths behind pixels; those of no depth are left out."""
    x, y, depth = (each[depth > 0] for each in (x, y, depth))
    rays = np.stack([(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy], axis=1)
    local = np.column_stack([rays, np.ones(len(rays))]) * depth[:, None]
    return (local - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
