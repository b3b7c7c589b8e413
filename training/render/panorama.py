"""Equirectangular images, resampled from perspective images of the six sides of a cube."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..scenes.cameras import Camera
from .image import NO_DEPTH, RenderedImage
from .lens import LensProjection

OVERLAP = 0.1
"""Half width of the seam within which neighbouring sides of the cube blend, relative to half a side."""
OVERSAMPLING = 1.5
"""Pixels of a cube side per pixel of the panorama, at the centre of the side."""

Window = tuple[int, int, int, int]
DrawSide = Callable[[Camera, Window, Callable[[float], bool]], RenderedImage | None]
"""Function that draws a window of the image of a camera, and receives its ``progress``."""


def draw_panorama(
    draw: DrawSide,
    camera: Camera,
    projection: LensProjection,
    window: Window | None,
    image: RenderedImage,
    progress: Callable[[float], bool],
) -> RenderedImage | None:
    """Draw an equirectangular image. Depths are distances from the camera, as in Cycles.

    Args:
        draw: function that draws a side of the cube.
        camera: pose, width and height of the panorama.
        projection: angles at the edges of the panorama.
        window: left, top, width and height of the part to draw; None means all.
        image: image of that size to fill, with the passes to draw.
        progress: receives the completed share; returning False cancels.

    Returns:
        ``image``, or None if drawing was cancelled.
    """
    rays = directions(camera.width, camera.height, projection, window)
    half = _side_length(camera, projection) / 2
    reach = int(np.ceil(half * (1 + OVERLAP))) + 1
    weights = np.zeros(rays.shape[:2], np.float32)
    image.image[:], image.alpha[:], image.masks[:] = 0, 0, 0
    for number in range(6):
        rotation = _rotation(number)
        local = rays @ rotation.T.astype(np.float32)
        width = np.maximum(np.abs(local[..., 0]), np.abs(local[..., 1]))
        mask = width < (1 + OVERLAP) * local[..., 2]
        if not mask.any():
            continue
        x, y, z = local[mask].T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        cube_camera = Camera(
            camera.name, 2 * reach, 2 * reach, half, half, reach, reach, pose @ camera.world_to_camera
        )
        u, v = half * x / z + reach - 0.5, half * y / z + reach - 0.5  # from pixel centres
        left, top = int(u.min()), int(v.min())
        part = left, top, int(u.max()) + 2 - left, int(v.max()) + 2 - top
        drawn = draw(cube_camera, part, lambda share, n=number: progress((n + share) / 6))
        if drawn is None:
            return None
        weight = ((1 + OVERLAP - width[mask] / z) / (2 * OVERLAP)).clip(max=1)
        weights[mask] += weight
        _add(drawn, image, mask, weight, u - left, v - top, 1 / z)
    image.image /= weights[..., None]
    image.alpha /= weights
    image.masks /= weights
    return image


def directions(
    width: int, height: int, projection: LensProjection, window: Window | None = None
) -> np.ndarray:
    """Return the unit vectors (H, W, 3) of the pixel centres, OpenCV axes of the camera."""
    left, top, columns, rows = window or (0, 0, width, height)
    (west, east), (south, north) = projection.longitude, projection.latitude
    longitude = west + (east - west) * (left + np.arange(columns) + 0.5) / width
    latitude = (north + (south - north) * (top + np.arange(rows) + 0.5) / height)[:, None]
    rays = np.stack(
        [
            np.cos(latitude) * np.sin(longitude),
            np.broadcast_to(-np.sin(latitude), (rows, columns)),
            np.cos(latitude) * np.cos(longitude),
        ],
        axis=2,
    )
    return rays.astype(np.float32)


def _side_length(camera: Camera, projection: LensProjection) -> int:
    """Return the size of a cube side in pixels, which shows as many pixels per angle as the panorama."""
    (west, east), (south, north) = projection.longitude, projection.latitude
    density = max(camera.width / max(abs(east - west), 1e-6), camera.height / max(abs(north - south), 1e-6))
    return min(int(np.ceil(2 * OVERSAMPLING * density)), 8192)


def _rotation(number: int) -> np.ndarray:
    """Return the rotation (3, 3) from the camera to a side: -x, +x, -y, +y, -z, +z."""
    forward = np.zeros(3)
    forward[number // 2] = 1 if number % 2 else -1
    right = np.array([0.0, 0, -forward[0]]) if number < 2 else np.array([forward[2] or 1.0, 0, 0])
    return np.array([right, np.cross(forward, right), forward])


def _add(
    drawn: RenderedImage,
    image: RenderedImage,
    mask: np.ndarray,
    weight: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    stretch: np.ndarray,
) -> None:
    """Add a side's colours at pixels (u, v) to the masked pixels. Copy depths where it is the nearest side.

    Args:
        weight: weight of the side in each pixel.
        stretch: distance per depth of each pixel.
    """
    column, row = u.astype(int), v.astype(int)
    right, below = u - column, v - row

    def sample(plane: np.ndarray) -> np.ndarray:
        shape = -1, *[1] * (plane.ndim - 2)
        x, y = right.reshape(shape), below.reshape(shape)
        upper, lower = plane[row, column], plane[row + 1, column]
        upper = upper + (plane[row, column + 1] - upper) * x
        lower = lower + (plane[row + 1, column + 1] - lower) * x
        return (upper + (lower - upper) * y) * weight.reshape(shape)

    image.image[mask] += sample(drawn.image)
    image.alpha[mask] += sample(drawn.alpha)
    for target, plane in zip(image.masks, drawn.masks, strict=True):
        target[mask] += sample(plane)
    if image.depth.size:
        depth = drawn.depth[(v + 0.5).astype(int), (u + 0.5).astype(int)]
        depth = np.where(depth < NO_DEPTH, depth * stretch, NO_DEPTH)
        image.depth[mask] = np.where(weight >= 0.5, depth, image.depth[mask])
