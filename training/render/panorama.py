"""Equirectangular images, resampled from perspective images in 26 directions.

A perspective image of splats is the less exact, the farther a large splat is from its axis, and images with
different axes then differ. Images of the six sides of a cube would show edges where they meet.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np

from ..scenes.cameras import Camera
from .image import NO_DEPTH, RenderedImage
from .lens import LensProjection

DIRECTIONS = np.array([axis for axis in product((-1, 0, 1), repeat=3) if any(axis)], np.float64)
"""Axes of the perspective images, in the camera's space: sides, edges and corners of a cube."""
REACH = np.radians(40.0)
"""Angle from its axis up to which an image contributes. Every direction is within 28 degrees of an axis."""
OVERSAMPLING = 1.5
"""Pixels of an image per pixel of the panorama, at the centre of the image."""
_MAX_FOCAL = 4096

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
        draw: function that draws a perspective image.
        camera: pose, width and height of the panorama.
        projection: angles at the edges of the panorama.
        window: left, top, width and height of the part to draw; None means all.
        image: image of that size to fill, with the passes to draw.
        progress: receives the completed share; returning False cancels.

    Returns:
        ``image``, or None if drawing was cancelled.
    """
    rays = directions(camera.width, camera.height, projection, window)
    focal = _focal_length(camera, projection)
    reach = int(np.ceil(focal * np.tan(REACH))) + 1
    weights, largest = np.zeros((2, *rays.shape[:2]), np.float32)
    image.image[:], image.alpha[:], image.masks[:] = 0, 0, 0
    for number, axis in enumerate(DIRECTIONS):
        rotation = _rotation(axis)
        local = rays @ rotation.T.astype(np.float32)
        mask = local[..., 2] > np.cos(REACH)
        if not mask.any():
            continue
        x, y, z = local[mask].T
        pose = np.eye(4)
        pose[:3, :3] = rotation
        side = Camera(
            camera.name, 2 * reach, 2 * reach, focal, focal, reach, reach, pose @ camera.world_to_camera
        )
        u, v = focal * x / z + reach - 0.5, focal * y / z + reach - 0.5  # from pixel centres
        left, top = int(u.min()), int(v.min())
        part = left, top, int(u.max()) + 2 - left, int(v.max()) + 2 - top
        drawn = draw(side, part, lambda share, n=number: progress((n + share) / len(DIRECTIONS)))
        if drawn is None:
            return None
        weight = ((z - np.cos(REACH)) / (1 - np.cos(REACH))) ** 2  # smooth at the edge of the image
        weights[mask] += weight
        nearest = weight > largest[mask]
        largest[mask] = np.maximum(largest[mask], weight)
        _add(drawn, image, mask, weight, nearest, u - left, v - top, 1 / z)
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


def _focal_length(camera: Camera, projection: LensProjection) -> int:
    """Return the focal length in pixels at which images show as many pixels per angle as the panorama."""
    (west, east), (south, north) = projection.longitude, projection.latitude
    density = max(camera.width / max(abs(east - west), 1e-6), camera.height / max(abs(north - south), 1e-6))
    return min(int(np.ceil(OVERSAMPLING * density)), _MAX_FOCAL)


def _rotation(axis: np.ndarray) -> np.ndarray:
    """Return a rotation (3, 3) from the camera to an image that looks along an axis (3,)."""
    forward = axis / np.linalg.norm(axis)
    right = np.cross((0.0, 1.0, 0.0) if forward[[0, 2]].any() else (0.0, 0.0, 1.0), forward)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(forward, right), forward])


def _add(
    drawn: RenderedImage,
    image: RenderedImage,
    mask: np.ndarray,
    weight: np.ndarray,
    nearest: np.ndarray,
    u: np.ndarray,
    v: np.ndarray,
    stretch: np.ndarray,
) -> None:
    """Add an image's colours at pixels (u, v) to the masked pixels, and copy depths.

    Args:
        weight: weight of the image in each pixel.
        nearest: pixels whose depth is copied, as this axis is the nearest one so far.
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
        image.depth[mask] = np.where(nearest, depth, image.depth[mask])
