"""Photos of a floor and a wall from known positions. numpy only, as in Blender's tests."""

import numpy as np

from training.scenes.cameras import look_at

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CAMERA_POSITIONS = np.array([(0.45 * n - 1.2, -3.2 + 0.1 * (n % 3), 1.2 + 0.15 * (n % 2)) for n in range(6)])
FLOOR, WALL = (np.random.default_rng(number).random((640, 640)) for number in (1, 2))


def render_photo(position: np.ndarray) -> np.ndarray:
    """Render a floor at z = 0 and a wall at y = 1 with random squares, (H, W, 3) uint8."""
    pose = look_at(position, np.array([0.0, 0.6, 0.4]), (0, 0, 1))
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = (
        np.stack([(x - WIDTH / 2) / FOCAL, (y - HEIGHT / 2) / FOCAL, np.ones_like(x)], axis=-1) @ pose[:3, :3]
    )
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
