"""Views that a renderer drew with exact cameras and depths become a COLMAP scene.

folder/  images/view_0001.png   the picture, as photographs are
         depths/view_0001.exr   depth along the camera's z axis, in a channel Depth.Z, as Blender writes it
         cameras/view_0001.json the camera, as ``write_camera`` writes it
         sparse/0/*.bin         the model: what is made here
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .cameras import MAX_COORDINATE, Camera, read_camera_folder
from .colmap import DEPTHS
from .exr import read_parts
from .images import load_image
from .visibility import visible_points

IMAGES, CAMERAS = "images", "cameras"
"""The folders of what was drawn."""
MAX_POINTS = 100_000
"""At most so many points a model gets."""
SKY_DEPTH = 1e9
"""Depths from here on are of nothing: renderers put 1e10 there."""
SKY_SHARE = 0.1
"""At most so many of all points are of the sky."""
SKY_FACTOR, MIN_SKY_DISTANCE = 2, 20
"""How many times as far the sky is as the farthest surface, and at least, as the cameras are apart."""
_LOOKS = 10
"""Pixels that are looked at for each point, about."""
_PRIMES = np.array([73856093, 19349663, 83492791, 15485863])

Tell = Callable[[int, int], object]
"""Is told before each view which one it is, from 1 on, and of how many."""


@dataclass(frozen=True)
class Sky:
    """A sphere around all that views show, for what they show of no surface.

    Attributes:
        center: (3,) in the world.
    """

    center: np.ndarray
    radius: float

    def behind(self, view: Camera, depth: np.ndarray) -> np.ndarray:
        """A view's depths (H, W), where there is nothing the sphere's."""
        y, x = np.nonzero(depth >= SKY_DEPTH)
        eye = view.center - self.center
        rays = view.unproject(np.column_stack([x, y]) + 0.5, np.ones(len(x))) - view.center
        a, b, c = (rays**2).sum(1), rays @ eye, eye @ eye - self.radius**2
        filled = depth.copy()
        filled[y, x] = (np.sqrt(b**2 - a * c) - b) / a
        return filled


def write_rendered_model(
    folder: Path, most: int = MAX_POINTS, tell: Tell = lambda number, count: None
) -> tuple[int, int]:
    """Writes folder/sparse/0/*.bin: the cameras, and points at random pixels, as close as pixels are.

    Each has its pixel's colour, and a track of views that see it. Those of a sky that pictures show (not
    where they are transparent) lie on a :class:`Sky`. Depths are read again for the tracks: one view is in
    memory at a time.

    Returns:
        How many views and points there are.

    Raises:
        LodgsError: a view lacks a file or a depth, or no two views see the same.
    """
    from .write_colmap import write_visible_points  # pycolmap, which reading lacks

    drawn, _ = read_camera_folder(folder / CAMERAS)
    views = [replace(view, name=f"{view.name}.png") for view in drawn]
    files = [folder / DEPTHS / f"{view.name}.exr" for view in drawn]

    def shown() -> Iterator[tuple[Camera, np.ndarray, np.ndarray]]:
        for number, (view, file) in enumerate(zip(views, files, strict=True)):
            tell(number + 1, len(views))
            picture = load_image(folder / IMAGES / view.name, view.width, view.height, alpha=True)
            depth = read_exr_depth(file)
            if depth.shape != picture.shape[:2]:
                raise LodgsError(
                    f"{file} is not of its camera's size of {view.width}x{view.height}.",
                    "Render the view again.",
                )
            yield view, depth, picture

    points, colors, sky = sample_surfaces(shown(), len(views), most, np.random.default_rng(0))

    def depth_of(number: int) -> np.ndarray:
        depth = read_exr_depth(files[number])
        return depth if sky is None else sky.behind(views[number], depth)

    beside = folder / ".model.tmp"
    try:
        shutil.rmtree(beside, ignore_errors=True)
        count = write_visible_points(beside, views, depth_of, points, 255 * colors)
        shutil.rmtree(folder / "sparse", ignore_errors=True)
        (beside / "sparse").rename(folder / "sparse")
    except OSError as error:
        raise LodgsError(
            f"The model in {folder} could not be written: {error.strerror or error}.",
            "Free some space there.",
        ) from error
    finally:
        shutil.rmtree(beside, ignore_errors=True)
    return len(views), count


def sample_surfaces(
    views: Iterable[tuple[Camera, np.ndarray, np.ndarray]], count: int, most: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Sky | None]:
    """Places (P, 3), at most so many, at random pixels, as close as these are, see :func:`thin_by_grid`; and the
    colours (P, 3) there.

    Args:
        views: each with its depths (H, W), from SKY on where there is nothing, and its picture (H, W, 3); or
            (H, W, 4) over black, with alpha, where the sky is wanted.
        count: how many views there are.

    Returns:
        The places, surfaces before sky; the colours; and where the sky is, if there is any.
    """
    found, sizes, colors, eyes = [], [], [], []
    for view, depth, picture in views:
        there = depth < SKY_DEPTH
        if picture.shape[2] == 4:
            there |= picture[..., 3] > 0.99
        y, x = np.nonzero(there)
        some = rng.permutation(len(x))[: most * _LOOKS // count + 1]
        y, x = y[some], x[some]
        color = picture[y, x]
        if picture.shape[2] == 4:
            color = color[:, :3] / np.maximum(color[:, 3:], 1e-3)
        found.append(view.unproject(np.column_stack([x, y]) + 0.5, depth[y, x]))
        sizes.append(depth[y, x] / view.focal)
        colors.append(color)
        eyes.append(view.center)
    points, size, color = map(np.concatenate, (found, sizes, colors))
    away = np.linalg.norm(points - (center := np.mean(eyes, axis=0)), axis=1)
    above = away >= SKY_DEPTH
    room = round(SKY_SHARE * most)
    kept = np.flatnonzero(~above)
    kept = kept[thin_by_grid(points[kept], size[kept], most - room if above.any() else most, rng)]
    if not above.any() or not len(kept):
        return points[kept], color[kept], None
    apart = np.linalg.norm(eyes - center, axis=1).max()
    sky = Sky(center, max(SKY_FACTOR * float(away[~above].max()), MIN_SKY_DISTANCE * float(apart)))
    high = np.flatnonzero(above)
    points[high] = center + sky.radius * (points[high] - center) / away[high, None]
    high = high[thin_by_grid(points[high], size[high], min(room, round(SKY_SHARE * len(kept))), rng)]
    kept = np.concatenate([kept, high])
    return points[kept], color[kept], sky


def sample_coverage(
    views: Sequence[Camera], depths: Sequence[np.ndarray], most: int
) -> tuple[np.ndarray, np.ndarray]:
    """Places (N, 3) on what V views show, at most so many, and how many views see each, (N,) from 1 on.

    Args:
        depths: (H, W) of each view along its z axis; its grid may be another one than the camera's.
            0 where there is nothing.
    """
    found, away = [np.zeros((0, 3))], [np.zeros(0)]
    for view, depth in zip(views, depths, strict=True):
        y, x = np.nonzero(depth)
        pixels = (np.column_stack([x, y]) + 0.5) * (view.width / depth.shape[1])
        found.append(view.unproject(pixels, depth[y, x]))
        away.append(depth[y, x])
    points, distances = np.concatenate(found), np.concatenate(away)
    points = points[thin_evenly(points, distances, most, np.random.default_rng(0))]
    counts = np.zeros(len(points), np.int64)
    for view, depth in zip(views, depths, strict=True):
        counts += visible_points(depth, view, points)[1]
    return points[counts > 0], counts[counts > 0]


def read_exr_depth(file: Path) -> np.ndarray:
    """Depths (H, W) float64 of an EXR, the nearest of its layers' Depth.Z; FARTHEST where there is nothing.

    Where there is none of that name: of channels that are called Z, depth or V.

    Raises:
        LodgsError: it cannot be read, or holds none.
    """
    try:
        channels = [each for _, _, part in read_parts(file) for each in part.items()]
    except (RuntimeError, OSError, ValueError) as error:
        raise LodgsError(f"{file} cannot be read: {error}.", "Render the view again.") from error
    layers = [pixels for name, pixels in channels if name.endswith("Depth.Z")]
    if not layers:
        layers = [pixels for name, pixels in channels if name.lower() in ("z", "depth", "v")]
    if not layers:
        raise LodgsError(f"{file} holds no depth.", "Render with an engine that has the pass Depth.")
    nearest = np.min(layers, axis=0).astype(np.float64)
    return np.where((nearest > 0) & (nearest < SKY_DEPTH), nearest, MAX_COORDINATE)


def thin_evenly(points: np.ndarray, depths: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    """Which of some points (N, 3) to keep, at most so many: even in space up to the median of their depths
    (N,), and beyond farther apart as they are deeper."""
    return thin_by_grid(points, np.maximum(depths, np.median(depths)) if len(depths) else depths, most, rng)


def thin_by_grid(points: np.ndarray, sizes: np.ndarray, most: int, rng: np.random.Generator) -> np.ndarray:
    """Which of some points (N, 3) to keep, at most so many: one in each cube of a grid, at random.

    The cubes are the smallest that are few enough. They are as large as sizes (N,) are, those of the pixels
    that show the points, but in powers of two.
    """
    order = rng.permutation(len(points))
    if len(points) <= most:
        return order
    middle = float(np.median(sizes))
    octave = np.floor(np.log2(sizes / middle)).astype(np.int64)[order]
    places = points[order] / 2.0 ** octave[:, None]

    def firsts(side: float) -> np.ndarray:
        cubes = np.column_stack([np.floor(places / side).astype(np.int64), octave])
        return np.unique(cubes @ _PRIMES, return_index=True)[1]

    low, high = np.log2([1e-3 * middle, 1e6 * middle])
    while high - low > 0.05:
        half = (low + high) / 2
        low, high = (low, half) if len(firsts(2.0**half)) <= most else (half, high)
    return order[firsts(2.0**high)[:most]]
