"""Photos of a floor and a wall from known positions. numpy only, as in Blender's tests."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from training.scenes.cameras import look_at
from training.scenes.images import write_png
from training.scenes.lenses import make_intrinsics
from training.scenes.write_colmap import write_model

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CAMERA_POSITIONS = np.array([(0.45 * n - 1.2, -3.2 + 0.1 * (n % 3), 1.2 + 0.15 * (n % 2)) for n in range(6)])
FLOOR, WALL = (np.random.default_rng(number).random((640, 640)) for number in (1, 2))


def wall_pose(position: np.ndarray) -> np.ndarray:
    """World to camera (4, 4) of a photo."""
    return look_at(position, np.array([0.0, 0.6, 0.4]), (0, 0, 1))


def render_photo(position: np.ndarray, rays: np.ndarray | None = None) -> np.ndarray:
    """Render a floor at z = 0 and a wall at y = 1 with random squares, (H, W, 3) uint8.

    ``rays`` (H, W, 2) are those of a lens with distortion, on the plane z = 1 of the camera.
    """
    pose = wall_pose(position)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    if rays is None:
        rays = np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL], axis=-1)
    rays = np.concatenate([rays, np.ones((HEIGHT, WIDTH, 1))], axis=-1) @ pose[:3, :3]
    with np.errstate(divide="ignore"):
        to_floor, to_wall = -position[2] / rays[..., 2], (1 - position[1]) / rays[..., 1]
    floor = (to_floor > 0) & (to_floor < to_wall)
    points = position + np.where(floor, to_floor, to_wall)[..., None] * rays
    light = np.zeros((HEIGHT, WIDTH))
    for side in (8, 23, 64):  # squares of three sizes
        u, v = (np.floor((points[..., axis] + 8) * side).astype(int) % 640 for axis in (0, 1))
        w = np.floor((points[..., 2] + 8) * side).astype(int) % 640
        light += np.where(floor, FLOOR[u, v], WALL[u, w]) / 3
    return np.repeat((255 * light).astype(np.uint8)[..., None], 3, axis=2)


def write_walls(folder: Path, photos: Sequence[np.ndarray] | None = None, distortion: float = 0.0) -> Path:
    """Write a model without points and its photos, by default of the walls, with a SIMPLE_RADIAL lens."""
    photos = [render_photo(position) for position in CAMERA_POSITIONS] if photos is None else photos
    parameters = np.array([FOCAL, WIDTH / 2, HEIGHT / 2, distortion])
    lens = make_intrinsics("SIMPLE_RADIAL", WIDTH, HEIGHT, parameters)
    names = [f"{number}.png" for number in range(len(photos))]
    (folder / "images").mkdir(parents=True)
    for name, photo in zip(names, photos, strict=True):
        write_png(folder / "images" / name, photo)
    poses = [(name, wall_pose(position)) for name, position in zip(names, CAMERA_POSITIONS, strict=True)]
    write_model(folder / "sparse" / "0", [lens] * len(names), poses, np.zeros((0, 3)), np.zeros((0, 3)))
    return folder
