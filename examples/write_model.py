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
from training.scenes.visibility import visible_points
from training.scenes.write_colmap import thin_tracks, write_colmap

from . import rig

SAMPLES = 15_360  # points before those that too few views see are left out
SHORTEST_TRACK, LONGEST_TRACK = 3, 4  # views; longer ones are thinned to keep the model small


def read_positions(path: Path) -> np.ndarray:
    """World positions of the surfaces that the pixels see, (H, W, 3) float64, metres."""
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return np.stack([channels[axis].pixels for axis in "XYZ"], axis=-1).astype(np.float64)


def depths_of(positions: np.ndarray, camera: Camera) -> np.ndarray:
    """Depths (H, W) along a camera's z axis of positions (H, W, 3)."""
    return camera.view_space(positions.reshape(-1, 3))[:, 2].reshape(positions.shape[:2])


def sample_points(positions: list[np.ndarray], seed: int = 0) -> np.ndarray:
    """The surface positions under random pixels of every view, (N, 3)."""
    rng, each = np.random.default_rng(seed), SAMPLES // len(positions)
    return np.concatenate([rng.choice(p.reshape(-1, 3), each, replace=False) for p in positions])


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
    focal = rig.FOCAL * width / rig.WIDTH
    views = [
        Camera(f"{name}.jpg", width, height, focal, focal, width / 2, height / 2, pose)
        for name, pose in zip(names, poses, strict=True)
    ]

    points = sample_points(positions)
    seen = [
        visible_points(depths_of(p, view), view, points) for p, view in zip(positions, views, strict=True)
    ]
    pixels, visible = map(np.stack, zip(*seen, strict=True))  # (V, N, 2), (V, N)
    kept = visible.sum(axis=0) >= SHORTEST_TRACK
    points, pixels = points[kept], pixels[:, kept]
    visible = thin_tracks(visible[:, kept], LONGEST_TRACK)
    colors = np.zeros((len(points), 3))
    for picture, place, sees in zip(pictures, pixels, visible, strict=True):
        x, y = np.floor(place[sees].T).astype(int)
        colors[sees] += picture[y, x]
    colors /= visible.sum(axis=0)[:, None]
    return write_colmap(scene, views, points, visible, colors)


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
