"""Write photos and COLMAP models of the lantern garden, with exact cameras and points on visible surfaces.

    python -m examples.write_model build/example examples/lantern_garden
    python -m examples.write_model build/example examples/lantern_garden --cameras aside
    python -m examples.write_model build/example examples/lantern_walk --cameras walk

Points are surface positions under random pixels. A point's track contains a few of the views that see it
unoccluded; its colour is the mean over the track. Views off the path are not in the model: each has an image
and a camera file in the scene's folder ``aside``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import OpenEXR
from PIL import Image

from training.scenes.cameras import Camera, write_camera
from training.scenes.visibility import visible_points
from training.scenes.write_colmap import thin_tracks, write_colmap

from . import rig

SAMPLES = 15_360  # points before dropping those that too few views see
SHORTEST_TRACK, LONGEST_TRACK = 3, 4  # views; longer tracks are thinned to limit the file size


def read_positions(path: Path) -> np.ndarray:
    """Read the world positions of visible surfaces, (H, W, 3) float64, in metres."""
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return np.stack([channels[axis].pixels for axis in "XYZ"], axis=-1).astype(np.float64)


def depths_of(positions: np.ndarray, camera: Camera) -> np.ndarray:
    """Return depths (H, W) along a camera's z axis of positions (H, W, 3)."""
    return camera.view_space(positions.reshape(-1, 3))[:, 2].reshape(positions.shape[:2])


def sample_points(positions: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """Return surface positions under random pixels of every view, (N, 3)."""
    rng = np.random.default_rng(seed)
    count = SAMPLES // len(positions)
    return np.concatenate([rng.choice(p.reshape(-1, 3), count, replace=False) for p in positions])


def write_photo(rendered: Path, photo: Path, quality: int) -> np.ndarray:
    """Write a JPEG of the rendered image with the same name; return its pixels (H, W, 3)."""
    photo.parent.mkdir(parents=True, exist_ok=True)
    with Image.open(rendered / "images" / f"{photo.stem}.png") as image:
        pixels = np.asarray(image.convert("RGB"))
    Image.fromarray(pixels).save(photo, quality=quality, subsampling=0, optimize=True)
    return pixels


def write_offset_views(rendered: Path, scene: Path, quality: int) -> None:
    """Write scene/aside/*.jpg and *.json, the views off the path, from rendered images."""
    for index, pose in enumerate(rig.world_to_cameras("aside")):
        photo = scene / "aside" / f"{rig.view_name('aside', index)}.jpg"
        height, width = write_photo(rendered, photo, quality).shape[:2]
        focal = rig.FOCAL * width / rig.WIDTH
        camera = Camera(photo.name, width, height, focal, focal, width / 2, height / 2, pose)
        write_camera(photo.with_suffix(".json"), camera, near=0.01)


def write_model(rendered: Path, scene: Path, cameras: str, quality: int) -> int:
    """Write scene/images/*.jpg and the model scene/sparse/0/*.bin of a set of cameras.

    Returns:
        The number of points.
    """
    poses = rig.world_to_cameras(cameras)
    names = [rig.view_name(cameras, view) for view in range(len(poses))]
    positions = [read_positions(rendered / "positions" / f"{name}.exr") for name in names]
    height, width = positions[0].shape[:2]
    images = [write_photo(rendered, scene / "images" / f"{name}.jpg", quality) for name in names]
    focal = rig.FOCAL * width / rig.WIDTH
    views = [
        Camera(f"{name}.jpg", width, height, focal, focal, width / 2, height / 2, pose)
        for name, pose in zip(names, poses, strict=True)
    ]

    points = sample_points(positions)
    projections = [
        visible_points(depths_of(p, view), view, points) for p, view in zip(positions, views, strict=True)
    ]
    pixels, visible = map(np.stack, zip(*projections, strict=True))  # (V, N, 2), (V, N)
    tracked = visible.sum(axis=0) >= SHORTEST_TRACK
    points, pixels = points[tracked], pixels[:, tracked]
    visible = thin_tracks(visible[:, tracked], LONGEST_TRACK)
    colors = np.zeros((len(points), 3))
    for image, positions_2d, rows in zip(images, pixels, visible, strict=True):
        x, y = np.floor(positions_2d[rows].T).astype(int)
        colors[rows] += image[y, x]
    colors /= visible.sum(axis=0)[:, None]
    write_colmap(scene, views, points, visible, colors)
    return len(points)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("rendered", type=Path, help="output folder of build_scene")
    parser.add_argument("scene", type=Path, help="folder for images/ and sparse/0/, or aside/")
    parser.add_argument("--cameras", choices=list(rig.SETS), default="view", help="set of cameras")
    parser.add_argument("--quality", type=int, default=92, help="JPEG quality")
    options = parser.parse_args()
    if options.cameras == "aside":
        write_offset_views(options.rendered, options.scene, options.quality)
    else:
        points = write_model(options.rendered, options.scene, options.cameras, options.quality)
        print(f"{options.scene}: {points:,} points")


if __name__ == "__main__":
    main()
