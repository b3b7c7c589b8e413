"""Photographs and a COLMAP model of the lantern garden: exact cameras, points from the surfaces seen.

    python -m examples.write_model build/example examples/lantern_garden

Points are surface positions under random pixels; a point's track holds a few of the views in which
nothing stands before it, its colour is the mean over that track.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import OpenEXR
import pycolmap
from PIL import Image

from . import rig

POINTS_PER_VIEW = 320
DEPTH_TOLERANCE = 0.01  # relative: a point this much behind the surface that a view sees is hidden there
SHORTEST_TRACK, LONGEST_TRACK = 3, 4  # views; longer ones are thinned to keep the model small


def read_positions(path: Path) -> np.ndarray:
    """World positions of the surfaces that the pixels see, (H, W, 3) float64, metres."""
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return np.stack([channels[axis].pixels for axis in "XYZ"], axis=-1).astype(np.float64)


def sample_points(positions: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """The surface positions under random pixels of every view, (N, 3)."""
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.choice(p.reshape(-1, 3), POINTS_PER_VIEW, replace=False) for p in positions])


def observe(points: np.ndarray, pose: np.ndarray, seen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where a view sees points (N, 3): pixels (N, 2) in its own grid and whether it does (N,).

    seen (H, W, 3) are the positions of the surfaces in that view. The pixel that a point falls on must lie at
    its depth, and none of the pixels about it before it: at an outline they show a mixture.
    """
    height, width = seen.shape[:2]
    pixels, depth = rig.project(points, pose)
    pixels = pixels * (width / rig.WIDTH)
    x, y = np.floor(pixels.T).astype(int)
    inside = (depth > 0.1) & (x >= 1) & (y >= 1) & (x < width - 1) & (y < height - 1)
    x, y = np.where(inside, x, 1), np.where(inside, y, 1)
    surface = rig.project(seen.reshape(-1, 3), pose)[1].reshape(height, width)
    around = np.stack([surface[y + dy, x + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    clear = around.min(axis=0) > depth * (1 - DEPTH_TOLERANCE)
    there = np.abs(around[4] - depth) < depth * DEPTH_TOLERANCE
    return pixels, inside & clear & there


def write_model(rendered: Path, scene: Path, quality: int) -> pycolmap.Reconstruction:
    """Writes scene/images/*.jpg and the model scene/sparse/0/*.bin from what build_scene rendered."""
    poses = rig.world_to_cameras()
    names = [rig.view_name(view) for view in range(len(poses))]
    positions = [read_positions(rendered / "positions" / f"{name}.exr") for name in names]
    height, width = positions[0].shape[:2]

    (scene / "images").mkdir(parents=True, exist_ok=True)
    pictures = []
    for name in names:
        with Image.open(rendered / "images" / f"{name}.png") as picture:
            pictures.append(np.asarray(picture.convert("RGB")))
        Image.fromarray(pictures[-1]).save(
            scene / "images" / f"{name}.jpg", quality=quality, subsampling=0, optimize=True
        )

    points = sample_points(positions)
    pixels, visible = map(
        np.stack,
        zip(*(observe(points, pose, seen) for pose, seen in zip(poses, positions, strict=True)), strict=True),
    )  # (V, N, 2), (V, N)
    kept = visible.sum(axis=0) >= SHORTEST_TRACK
    points, pixels, visible = points[kept], pixels[:, kept], visible[:, kept]
    lottery = np.where(visible, np.random.default_rng(1).random(visible.shape), np.inf)
    visible &= lottery.argsort(axis=0).argsort(axis=0) < LONGEST_TRACK
    colors = np.zeros((len(points), 3))
    for picture, place, sees in zip(pictures, pixels, visible, strict=True):
        x, y = np.floor(place[sees].T).astype(int)
        colors[sees] += picture[y, x]
    colors = np.round(colors / visible.sum(axis=0)[:, None]).astype(np.uint8)

    model = pycolmap.Reconstruction()
    scale = width / rig.WIDTH
    camera = pycolmap.Camera(
        model="PINHOLE",
        width=width,
        height=height,
        params=[rig.FOCAL * scale, rig.FOCAL * scale, width / 2, height / 2],
        camera_id=1,
    )
    model.add_camera_with_trivial_rig(camera)
    for view, name in enumerate(names):
        image = pycolmap.Image(
            name=f"{name}.jpg", keypoints=pixels[view, visible[view]], camera_id=1, image_id=view + 1
        )
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(poses[view][:3]))
    rows = np.cumsum(visible, axis=1) - 1  # number of each observation within its image
    for index, point in enumerate(points):
        track = pycolmap.Track()
        for view in np.flatnonzero(visible[:, index]):
            track.add_element(int(view) + 1, int(rows[view, index]))
        model.add_point3D(point, track, colors[index])
    model.update_point_3d_errors()

    folder = scene / "sparse" / "0"
    folder.mkdir(parents=True, exist_ok=True)
    model.write_binary(folder)
    for extra in ("rigs.bin", "frames.bin"):  # one camera without a rig: readers make these themselves
        (folder / extra).unlink(missing_ok=True)
    return model


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rendered", type=Path, help="the folder that build_scene filled")
    parser.add_argument("scene", type=Path, help="the folder that gets images/ and sparse/0/")
    parser.add_argument("--quality", type=int, default=92, help="of the JPEGs")
    options = parser.parse_args()
    print(write_model(options.rendered, options.scene, options.quality).summary())


if __name__ == "__main__":
    main()
