"""Photographs and COLMAP models of the lantern garden: exact cameras, points from the surfaces seen.

    python -m examples.write_model build/example examples/lantern_garden
    python -m examples.write_model build/example examples/lantern_garden --cameras aside
    python -m examples.write_model build/example examples/lantern_walk --cameras walk

Points are surface positions under random pixels; a point's track holds a few of the views in which
nothing stands before it, its colour is the mean over that track. Views off the path belong to no model: each
is a picture and a camera file in the scene's folder ``aside``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import OpenEXR
import pycolmap
from PIL import Image

from training.scenes.cameras import Camera, write_camera

from . import rig

SAMPLES = 15_360  # points before those that too few views see are left out
DEPTH_TOLERANCE = 0.01  # relative: a point this much behind the surface that a view sees is hidden there
SHORTEST_TRACK, LONGEST_TRACK = 3, 4  # views; longer ones are thinned to keep the model small


def read_positions(path: Path) -> np.ndarray:
    """World positions of the surfaces that the pixels see, (H, W, 3) float64, metres."""
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return np.stack([channels[axis].pixels for axis in "XYZ"], axis=-1).astype(np.float64)


def sample_points(positions: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """The surface positions under random pixels of every view, (N, 3)."""
    rng, each = np.random.default_rng(seed), SAMPLES // len(positions)
    return np.concatenate([rng.choice(p.reshape(-1, 3), each, replace=False) for p in positions])


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


def write_photograph(rendered: Path, photograph: Path, quality: int) -> np.ndarray:
    """Writes a JPEG from what build_scene rendered under the same name, and gives its pixels (H, W, 3)."""
    photograph.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(rendered / "images" / f"{photograph.stem}.png") as picture:
        pixels = np.asarray(picture.convert("RGB"))
    Image.fromarray(pixels).save(photograph, quality=quality, subsampling=0, optimize=True)
    return pixels


def write_aside(rendered: Path, scene: Path, quality: int) -> None:
    """Writes scene/aside/*.jpg and *.json, the views off the path, from what build_scene rendered."""
    for index, pose in enumerate(rig.world_to_cameras("aside")):
        photograph = scene / "aside" / f"{rig.view_name('aside', index)}.jpg"
        height, width = write_photograph(rendered, photograph, quality).shape[:2]
        focal = rig.FOCAL * width / rig.WIDTH
        camera = Camera(photograph.name, width, height, focal, focal, width / 2, height / 2, pose)
        write_camera(photograph.with_suffix(".json"), camera, near=0.01)


def write_model(rendered: Path, scene: Path, cameras: str, quality: int) -> pycolmap.Reconstruction:
    """Writes scene/images/*.jpg and the model scene/sparse/0/*.bin of a set of cameras."""
    poses = rig.world_to_cameras(cameras)
    names = [rig.view_name(cameras, view) for view in range(len(poses))]
    positions = [read_positions(rendered / "positions" / f"{name}.exr") for name in names]
    height, width = positions[0].shape[:2]
    pictures = [write_photograph(rendered, scene / "images" / f"{name}.jpg", quality) for name in names]

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
    parser.add_argument("scene", type=Path, help="the folder that gets images/ and sparse/0/, or aside/")
    parser.add_argument("--cameras", choices=list(rig.SETS), default="view", help="of which set")
    parser.add_argument("--quality", type=int, default=92, help="of the JPEGs")
    options = parser.parse_args()
    if options.cameras == "aside":
        write_aside(options.rendered, options.scene, options.quality)
    else:
        print(write_model(options.rendered, options.scene, options.cameras, options.quality).summary())


if __name__ == "__main__":
    main()
