"""COLMAP scenes from rendered views with exact cameras and depth maps.

folder/  images/view_0001.png    rendered image
         depths/view_0001.exr    depth along the camera's z axis in a channel Depth.Z, as Blender writes it
         cameras/view_0001.json  camera, as ``write_camera`` writes it
         sparse/0/*.bin          the model written here
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError, system_reason
from ..files import atomic_folder, temporary_folder
from .cameras import MAX_COORDINATE, Camera, read_camera_folder
from .colmap import DEPTHS
from .exr import read_parts
from .images import load_image
from .visibility import visible_points
from .write_colmap import write_visible_points

IMAGES, CAMERAS = "images", "cameras"
"""Folders of the rendered images and their cameras."""
MAX_POINTS = 100_000
"""Maximum number of points of a model."""
SKY_DEPTH = 1e9
"""Minimum depth of pixels without a surface; renderers write 1e10."""
SKY_SHARE = 0.1
"""Maximum fraction of the points that represents the sky."""
SKY_FACTOR, MIN_SKY_DISTANCE = 2, 20
"""Minimum radius of the sky, in multiples of the farthest surface's and of the farthest camera's distance."""
_CANDIDATES_PER_POINT = 10
"""Approximate number of pixels sampled per point."""
_PRIMES = np.array([73856093, 19349663, 83492791, 15485863])

Report = Callable[[int, int], object]
"""Callback that receives the number of the next view, from 1, and the number of views."""


@dataclass(frozen=True)
class Sky:
    """A sphere around the scene that stands for everything without a surface.

    Attributes:
        center: (3,) in the world.
    """

    center: np.ndarray
    radius: float

    def fill_depth(self, view: Camera, depth: np.ndarray) -> np.ndarray:
        """Return a view's depths (H, W) with the sphere's depth at pixels without a surface."""
        y, x = np.nonzero(depth >= SKY_DEPTH)
        origin = view.center - self.center
        rays = view.unproject(np.column_stack([x, y]) + 0.5, np.ones(len(x))) - view.center
        a, b, c = (rays**2).sum(1), rays @ origin, origin @ origin - self.radius**2
        filled = depth.copy()
        filled[y, x] = (np.sqrt(b**2 - a * c) - b) / a
        return filled


def write_rendered_model(
    folder: Path, limit: int = MAX_POINTS, report: Report = lambda number, count: None
) -> tuple[int, int]:
    """Write folder/sparse/0/*.bin with the cameras and surface points at random pixels.

    Points are spaced like the pixels. Each has its pixel's colour and a track of views that see it. Opaque
    pixels without a surface give points on a :class:`Sky`; transparent ones give none. Depth maps are read a
    second time for the tracks, so only one view is in memory at a time.

    Args:
        limit: maximum number of points.

    Returns:
        The number of views and the number of points.

    Raises:
        LodgsError: a view lacks a file or depth, or no two views show the same surface.
    """
    cameras, _ = read_camera_folder(folder / CAMERAS)
    views = [replace(camera, name=f"{camera.name}.png") for camera in cameras]
    depth_files = [folder / DEPTHS / f"{view.name}.exr" for view in cameras]

    def load_views() -> Iterator[tuple[Camera, np.ndarray, np.ndarray]]:
        for number, (view, file) in enumerate(zip(views, depth_files, strict=True)):
            report(number + 1, len(views))
            image = load_image(folder / IMAGES / view.name, view.width, view.height, alpha=True)
            depth = read_exr_depth(file)
            if depth.shape != image.shape[:2]:
                raise LodgsError(
                    f"Cannot use depth map {file}: its size {depth.shape[1]}x{depth.shape[0]} differs "
                    f"from its camera's {view.width}x{view.height}.",
                    "Render the view again.",
                )
            yield view, depth, image

    points, colors, sky = sample_surfaces(load_views(), len(views), limit, np.random.default_rng(0))

    def depth_of(number: int) -> np.ndarray:
        depth = read_exr_depth(depth_files[number])
        return depth if sky is None else sky.fill_depth(views[number], depth)

    try:
        with temporary_folder(folder) as temporary:
            count = write_visible_points(temporary, views, depth_of, points, 255 * colors)
            with atomic_folder(folder / "sparse") as sparse:
                (temporary / "sparse" / "0").rename(sparse / "0")
    except OSError as error:
        raise LodgsError(
            f"Cannot write the model in {folder}: {system_reason(error)}.", "Free disk space."
        ) from error
    return len(views), count


def sample_surfaces(
    views: Iterable[tuple[Camera, np.ndarray, np.ndarray]], count: int, limit: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, Sky | None]:
    """Sample surface points (P, 3) at random pixels, spaced like the pixels, see :func:`thin_by_grid`.

    Args:
        views: camera; depths (H, W), at least SKY_DEPTH without a surface; and image (H, W, 3), or (H, W, 4)
            over black with alpha to include the sky.
        count: number of views.
        limit: maximum number of points.

    Returns:
        The points, surfaces before sky; their colours (P, 3); and the sky, if visible.
    """
    view_points, pixel_sizes, view_colors, positions = [], [], [], []
    for view, depth, image in views:
        valid = depth < SKY_DEPTH
        if image.shape[2] == 4:
            valid |= image[..., 3] > 0.99
        y, x = np.nonzero(valid)
        sample = rng.permutation(len(x))[: limit * _CANDIDATES_PER_POINT // count + 1]
        y, x = y[sample], x[sample]
        color = image[y, x]
        if image.shape[2] == 4:
            color = color[:, :3] / np.maximum(color[:, 3:], 1e-3)
        view_points.append(view.unproject(np.column_stack([x, y]) + 0.5, depth[y, x]))
        pixel_sizes.append(depth[y, x] / view.focal)
        view_colors.append(color)
        positions.append(view.center)
    points, size, color = map(np.concatenate, (view_points, pixel_sizes, view_colors))
    center = np.mean(positions, axis=0)
    distance = np.linalg.norm(points - center, axis=1)
    is_sky = distance >= SKY_DEPTH
    max_sky = round(SKY_SHARE * limit)
    chosen = np.flatnonzero(~is_sky)
    chosen = chosen[
        thin_by_grid(points[chosen], size[chosen], limit - max_sky if is_sky.any() else limit, rng)
    ]
    if not is_sky.any() or not len(chosen):
        return points[chosen], color[chosen], None
    camera_radius = np.linalg.norm(positions - center, axis=1).max()
    radius = max(SKY_FACTOR * float(distance[~is_sky].max()), MIN_SKY_DISTANCE * float(camera_radius))
    sky = Sky(center, radius)
    sky_rows = np.flatnonzero(is_sky)
    points[sky_rows] = center + sky.radius * (points[sky_rows] - center) / distance[sky_rows, None]
    max_sky = min(max_sky, round(SKY_SHARE * len(chosen)))
    sky_rows = sky_rows[thin_by_grid(points[sky_rows], size[sky_rows], max_sky, rng)]
    chosen = np.concatenate([chosen, sky_rows])
    return points[chosen], color[chosen], sky


def sample_coverage(
    views: Sequence[Camera], depths: Sequence[np.ndarray], limit: int
) -> tuple[np.ndarray, np.ndarray]:
    """Sample surface points (N, 3) of V views, and count the views that see each point, (N,) from 1.

    Args:
        depths: (H, W) of each view along its z axis, at any resolution; 0 without a surface.
        limit: maximum number of points.
    """
    view_points, view_depths = [np.zeros((0, 3))], [np.zeros(0)]
    for view, depth in zip(views, depths, strict=True):
        y, x = np.nonzero(depth)
        pixels = (np.column_stack([x, y]) + 0.5) * (view.width / depth.shape[1])
        view_points.append(view.unproject(pixels, depth[y, x]))
        view_depths.append(depth[y, x])
    points, point_depths = np.concatenate(view_points), np.concatenate(view_depths)
    points = points[thin_evenly(points, point_depths, limit, np.random.default_rng(0))]
    counts = np.zeros(len(points), np.int64)
    for view, depth in zip(views, depths, strict=True):
        counts += visible_points(depth, view, points)[1]
    return points[counts > 0], counts[counts > 0]


def read_exr_depth(file: Path) -> np.ndarray:
    """Read depths (H, W) float64 of an EXR, with MAX_COORDINATE for pixels without a surface.

    The depth is the nearest of the layers' Depth.Z channels. Without these, channels named Z, depth or V
    count.

    Raises:
        LodgsError: the file cannot be read or contains no depth.
    """
    try:
        channels = [channel for _, _, part in read_parts(file) for channel in part.items()]
    except (RuntimeError, OSError, ValueError) as error:
        raise LodgsError(f"Cannot read {file}: {error}.", "Render the view again.") from error
    layers = [pixels for name, pixels in channels if name.endswith("Depth.Z")]
    if not layers:
        layers = [pixels for name, pixels in channels if name.lower() in ("z", "depth", "v")]
    if not layers:
        raise LodgsError(
            f"Cannot read depth from {file}: it has no depth channel.",
            "Render with an engine that supports the Depth pass.",
        )
    nearest = np.min(layers, axis=0).astype(np.float64)
    return np.where((nearest > 0) & (nearest < SKY_DEPTH), nearest, MAX_COORDINATE)


def thin_evenly(points: np.ndarray, depths: np.ndarray, limit: int, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of at most ``limit`` of the points (N, 3), evenly spaced.

    Beyond the median of the depths (N,), the spacing grows with the depth.
    """
    return thin_by_grid(points, np.maximum(depths, np.median(depths)) if len(depths) else depths, limit, rng)


def thin_by_grid(points: np.ndarray, sizes: np.ndarray, limit: int, rng: np.random.Generator) -> np.ndarray:
    """Return the indices of at most ``limit`` points (N, 3), one random point per grid cube.

    The cubes are as small as the limit allows. Their sides are proportional to the pixel sizes (N,) of the
    points, rounded to powers of two.
    """
    order = rng.permutation(len(points))
    if len(points) <= limit:
        return order
    median_size = float(np.median(sizes))
    octave = np.floor(np.log2(sizes / median_size)).astype(np.int64)[order]
    scaled = points[order] / 2.0 ** octave[:, None]

    def first_per_cube(side: float) -> np.ndarray:
        cubes = np.column_stack([np.floor(scaled / side).astype(np.int64), octave])
        return np.unique(cubes @ _PRIMES, return_index=True)[1]

    low, high = np.log2([1e-3 * median_size, 1e6 * median_size])
    while high - low > 0.05:
        half = (low + high) / 2
        low, high = (low, half) if len(first_per_cube(2.0**half)) <= limit else (half, high)
    return order[first_per_cube(2.0**high)[:limit]]
