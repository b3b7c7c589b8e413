"""Depth of field and motion blur: averages of images over the opening of the lens and the shutter time.

The average is taken in linear light, as in Cycles. Every sample is a sharp image of its own, so the average
converges to the exact image with more samples.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import polar
from scipy.spatial.transform import Rotation, Slerp

from ..color import linear_from_srgb, srgb_from_linear
from ..scenes.cameras import Camera
from . import scene
from .image import RenderedImage
from .lens import EQUIRECTANGULAR, ORTHOGRAPHIC, PLASTIC, SHARP, Aperture, LensProjection
from .panorama import draw_panorama
from .scene import Instance

Progress = Callable[[float], bool]


@dataclass(frozen=True)
class Blur:
    """Samples of one image.

    Attributes:
        samples: number of averaged images, if something is blurred.
        aperture: opening of the lens; None for a pinhole.
        cameras: the camera at equal intervals of the shutter time; empty for a camera that does not move.
    """

    samples: int = 1
    aperture: Aperture | None = None
    cameras: tuple[Camera, ...] = ()


def draw_blurred(
    instances: Sequence[Instance],
    camera: Camera,
    projection: LensProjection = SHARP,
    blur: Blur = Blur(),
    *,
    depth: bool = False,
    progress: Progress = lambda share: True,
    **options: Any,
) -> RenderedImage | None:
    """Draw an image with depth of field and motion blur.

    The depth pass is sharp: that of the lens centre at the time of the frame.

    Args:
        instances: sets of splats. Those with ``motion`` move while the shutter is open.
        camera: camera at the time of the frame.
        options: other arguments of :func:`scene.draw`.

    Returns:
        The image, or None if drawing was cancelled.
    """
    moves = any(instance.motion for instance in instances) or blur.cameras
    if blur.aperture is None and not moves:
        return _draw_sharp(instances, camera, projection, depth=depth, progress=progress, **options)
    total: RenderedImage | None = None
    samples = list(_samples(instances, camera, projection, blur))
    steps = len(samples) + depth
    for number, (moved, view) in enumerate(samples):
        image = _draw_sharp(
            moved, view, projection, progress=lambda share, n=number: progress((n + share) / steps), **options
        )
        if image is None:
            return None
        total = _add(total, image)
    assert total is not None
    result = _mean(total, len(samples))
    if depth:
        last = len(samples)
        sharp = _draw_sharp(
            instances, camera, projection, depth=True,
            progress=lambda share: progress((last + share) / steps), **options,
        )  # fmt: skip
        return None if sharp is None else replace(result, depth=sharp.depth)
    return result


def _samples(
    instances: Sequence[Instance], camera: Camera, projection: LensProjection, blur: Blur
) -> Iterator[tuple[list[Instance], Camera]]:
    """Yield the sets and the camera of each sample, evenly spread over shutter time and lens."""
    count, aperture = blur.samples, blur.aperture
    points = np.zeros((count, 2)) if aperture is None else aperture.points(count)
    times = (np.argsort(np.argsort(PLASTIC * np.arange(count) % 1)) + 0.5) / count  # not in order of points
    for time, point in zip(times.tolist(), points, strict=True):
        view = _camera_at(blur.cameras, time) if blur.cameras else camera
        if aperture is not None:
            view = aperture.camera_at(point, view, projection)
        yield (
            [
                replace(item, matrix=_matrix_at(item.motion, time), motion=()) if item.motion else item
                for item in instances
            ],
            view,
        )


def _interval(count: int, time: float) -> tuple[int, float]:
    """Return the number of the interval between keys that contains a time in [0, 1], and the share of it."""
    position = time * (count - 1)
    index = min(int(position), max(count - 2, 0))
    return index, position - index


def _matrix_at(keys: Sequence[np.ndarray], time: float) -> np.ndarray:
    """Return the transform at a time in [0, 1]. Between keys, it turns, moves and scales evenly."""
    index, share = _interval(len(keys), time)
    if not share:
        return keys[index]
    first, second = keys[index : index + 2]
    turn, size = map(np.asarray, polar(first[:3, :3]))
    next_turn, next_size = map(np.asarray, polar(second[:3, :3]))
    if np.linalg.det(turn) * np.linalg.det(next_turn) < 0:  # mirrored on the way
        return first if share < 0.5 else second
    matrix = (1 - share) * first + share * second
    sign = np.sign(np.linalg.det(turn))
    turn = _turn(sign * turn, sign * next_turn, share) * sign
    matrix[:3, :3] = turn @ ((1 - share) * size + share * next_size)
    return matrix


def _turn(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    """Return the rotation (3, 3) between two others."""
    return Slerp([0, 1], Rotation.from_matrix([first, second]))(share).as_matrix()


def _camera_at(keys: Sequence[Camera], time: float) -> Camera:
    """Return the camera at a time in [0, 1]. Between keys it turns and moves evenly."""
    index, share = _interval(len(keys), time)
    if not share:
        return keys[index]
    first, second = keys[index : index + 2]
    pose = np.eye(4)
    pose[:3, :3] = _turn(first.world_to_camera[:3, :3], second.world_to_camera[:3, :3], share)
    pose[:3, 3] = -pose[:3, :3] @ ((1 - share) * first.center + share * second.center)
    lens = {
        name: (1 - share) * getattr(first, name) + share * getattr(second, name)
        for name in ("fx", "fy", "cx", "cy")
    }
    return replace(first, world_to_camera=pose, **lens)


def _draw_sharp(
    instances: Sequence[Instance],
    camera: Camera,
    projection: LensProjection,
    *,
    depth: bool = False,
    progress: Progress,
    window: tuple[int, int, int, int] | None = None,
    **options: Any,
) -> RenderedImage | None:
    """Draw an image without blur, by any projection."""
    options["depth"] = depth
    if projection.kind != EQUIRECTANGULAR:
        distance = projection.distance if projection.kind == ORTHOGRAPHIC else None
        return scene.draw(
            instances, camera, orthographic=distance, window=window, progress=progress, **options
        )
    numbers = sorted({item.level for item in instances}) if options.get("levels") else []
    width, height = window[2:] if window else (camera.width, camera.height)
    scene.check_render_size(width, height)
    image = RenderedImage.empty(width, height, options.get("background"), depth, numbers)

    def draw_side(side: Camera, part: tuple[int, int, int, int], progress: Progress) -> RenderedImage | None:
        return scene.draw(instances, side, window=part, progress=progress, **options)

    return draw_panorama(draw_side, camera, projection, window, image, progress)


def _add(total: RenderedImage | None, image: RenderedImage) -> RenderedImage:
    """Add an image to a sum of linear colours multiplied by alpha."""
    image.image[:] = linear_from_srgb(image.straight().clip(0)) * image.alpha[..., None]
    if total is None:
        return image
    total.image += image.image
    total.alpha += image.alpha
    total.masks += image.masks
    return total


def _mean(total: RenderedImage, count: int) -> RenderedImage:
    """Divide a sum of images, and encode it for the display."""
    total.alpha /= count
    total.masks /= count
    total.image /= count
    total.image[:] = srgb_from_linear(total.straight()) * total.alpha[..., None]
    return total
