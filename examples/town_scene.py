"""Photographs of the town and a COLMAP model of them: exact cameras, points with tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from training.rasterize import Gaussians, rasterize
from training.scenes.cameras import Camera
from training.splats.gaussians import Splats

from .colmap_model import thinned, visible_in, write_colmap

SHORTEST_TRACK, LONGEST_TRACK = 2, 4  # views


def write_scene(scene: Path, splats: Splats, cameras: Sequence[Camera], near: float, points: int) -> None:
    """Writes scene/images/*.jpg and scene/sparse/0/*.bin.

    Points are where rays through random pixels meet the splats (median depth), as far as two views agree.

    Args:
        cameras: the views, of one lens.
        near: depth at which drawing begins, in metres.
        points: how many to look for; some are seen by one view only, and left out.
    """
    gaussians, rng = Gaussians.of(splats), np.random.default_rng(0)
    (scene / "images").mkdir(parents=True, exist_ok=True)
    views, pictures, depths, found = [], [], [], []
    each = points // len(cameras) + 1
    for camera in cameras:
        drawn = rasterize(gaussians, camera, near=near, outputs=("median_depth",), backend="cpu")
        pictures.append((drawn.image.numpy().clip(0, 1) * 255).round().astype(np.uint8))
        views.append(replace(camera, name=f"{camera.name}.jpg"))
        Image.fromarray(pictures[-1]).save(scene / "images" / views[-1].name, quality=93, subsampling=0)
        assert drawn.median_depth is not None  # as asked for
        depths.append(drawn.median_depth.numpy())
        x, y = rng.integers([camera.width, camera.height], size=(each, 2)).T
        deep = depths[-1][y, x]
        rays = np.stack(
            [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 0 * x + 1], axis=1
        )
        there = (rays * deep[:, None] - camera.world_to_camera[:3, 3]) @ camera.world_to_camera[:3, :3]
        found.append(there[deep > 0])
    found = np.concatenate(found)
    seen = [visible_in(depth, view, found) for depth, view in zip(depths, views, strict=True)]
    visible = np.stack([sees for _, sees in seen])
    kept = visible.sum(axis=0) >= SHORTEST_TRACK
    pixels = np.stack([places[kept] for places, _ in seen])
    visible = thinned(visible[:, kept], LONGEST_TRACK)
    colors = np.zeros((kept.sum(), 3))
    for picture, places, sees in zip(pictures, pixels, visible, strict=True):
        x, y = np.floor(places[sees].T).astype(int)
        colors[sees] += picture[y, x]
    write_colmap(scene, views, found[kept], pixels, visible, colors / visible.sum(axis=0)[:, None])
