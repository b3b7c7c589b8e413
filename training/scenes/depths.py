"""Depth priors of photos: from depth map files, or from the model's points. numpy, Pillow and OpenEXR."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..documents import open_file
from ..errors import LodgsError
from .cameras import MAX_COORDINATE, Camera, pick_evenly
from .colmap import Scene
from .exr import MAGIC
from .image_headers import check_image_size
from .images import area_average, load_image, same_proportions
from .observations import observations
from .rendered_views import SKY_DEPTH, read_exr_depth, sample_surfaces

DEPTH_KINDS = ("metric", "relative", "inverse", "points")
"""Sources of depth: maps in the scene's unit; maps of depth or inverse depth with unknown scale and shift per
view; or the model's points."""
UNIT = 1e-3
"""Scene units per step of an integer depth map, as in nerfstudio and most sensors."""
TESTED_VIEWS = 3
"""Number of views used to compare maps with the scene's points."""
MAX_METRIC_RATIO = 1.25
"""Maximum ratio between map and point depths of at least half of the points, for metric maps."""
MIN_POINTS = 20
"""Minimum number of points to fit scale and shift of a map."""
ROUNDS = 3
"""Number of least-squares rounds; each drops residuals above OUTLIER_RATIO times the median."""
OUTLIER_RATIO = 3.0
MIN_EXPLAINED = 0.5
"""Minimum fraction of the points' variance that a fitted map must explain."""
FEW_POINTS = 1000
"""Number of scene points below which depth maps add points."""
MAX_ADDED_POINTS = 100_000
"""Maximum number of points added from depth maps."""
DISTANCE_RANGE = 0.3, 1000
"""Plausible median depth of the maps, in distances to the nearest camera; others suggest a wrong unit."""
_MAX_NUMPY_HEADER = 1 << 16
"""Maximum bytes of an NPY header, which numpy would read into memory."""


class DepthPriors:
    """Known depths in a scene's photos; false if there are none.

    Args:
        scene: scene of pinhole cameras with all of its points.
        kind: one of DEPTH_KINDS.

    Attributes:
        warnings: a sentence for each unusable source.
    """

    def __init__(self, scene: Scene, kind: str) -> None:
        self.kind = kind
        self.warnings = list[str]()
        self._points = scene.points
        self._maps = [camera for camera in scene.cameras if camera.depth is not None]
        sources = scene.cameras if kind == "points" else self._maps
        if kind == "metric":
            sources = pick_evenly(sources, TESTED_VIEWS)
        names = [camera.name for camera in sources]
        self._observations = observations(scene, names) if names else {}
        available = bool(self._observations if kind == "points" else self._maps)
        if not available:
            self.warnings.append(
                "Cannot use the depth of points: the model does not record their observations."
                if kind == "points"
                else "Cannot use depth maps: no photo has one. Add them to the folder depths next to the "
                "photos, or use the depth of the scene's points (depth = points)."
            )
        self._usable = available and self._matches_points()

    def inverse(self, camera: Camera) -> np.ndarray | None:
        """Return a view's inverse depth 1 / z, (H, W) float32, NaN where unknown; None without any depth.

        Raises:
            LodgsError: the depth map cannot be read.
        """
        return self._inverse(camera) if self._usable else None

    def __bool__(self) -> bool:
        return self._usable

    def _inverse(self, camera: Camera) -> np.ndarray | None:
        if self.kind == "points":
            return self._inverse_of_points(camera)
        if camera.depth is None:
            return None
        values = _read_camera_map(camera)
        resized = resample_known(
            values if self.kind == "inverse" else 1 / values, camera.width, camera.height
        )
        return resized if self.kind == "metric" else self._fit_to_points(camera, resized)

    def _matches_points(self) -> bool:
        """Return False, with a warning, if the maps contradict the scene's points."""
        tested = pick_evenly(self._maps, TESTED_VIEWS)
        if self.kind in ("relative", "inverse"):
            if any(self._inverse(camera) is not None for camera in tested):
                return True
            self.warnings.append(
                "Cannot use the depth maps: they contradict the scene's points for every scale and shift. "
                f"Check the setting depth ({', '.join(DEPTH_KINDS[:3])})."
            )
            return False
        if self.kind == "points" or not self._observations:
            return True
        ratios = []
        for camera in tested:
            x, y, z = self._project_points(camera)
            ratios.append(z / _read_camera_map(camera, camera.width, camera.height)[y, x])
        ratio = np.concatenate(ratios)
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < MIN_POINTS or np.mean(np.abs(np.log(ratio)) < np.log(MAX_METRIC_RATIO)) >= 0.5:
            return True
        self.warnings.append(
            f"Cannot use the depth maps: their median depth is {1 / np.median(ratio):.3g} times that of the "
            "scene's points. For maps of unknown scale, set depth to relative or inverse."
        )
        return False

    def _project_points(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return pixel columns, pixel rows and depths, (M,) each, of the points that a view observes.

        Without observations in the model, use all points inside the image.
        """
        points = self._points[self._observations.get(camera.name, [])] if self._observations else self._points
        points = points[camera.sees(points)]
        pixels, z = camera.project(points)
        x, y = np.floor(pixels).astype(int).T
        return x, y, z

    def _inverse_of_points(self, camera: Camera) -> np.ndarray | None:
        if camera.name not in self._observations:
            return None
        x, y, z = self._project_points(camera)
        nearest_last = np.argsort(-z)
        inverse = np.full((camera.height, camera.width), np.nan, np.float32)
        inverse[y[nearest_last], x[nearest_last]] = 1 / z[nearest_last]
        return inverse

    def _fit_to_points(self, camera: Camera, values: np.ndarray) -> np.ndarray | None:
        """Convert a view's inverse depths of unknown scale to the scene's unit; None if the fit fails."""
        x, y, z = self._project_points(camera)
        samples = values[y, x]
        finite = np.isfinite(samples)
        is_depth = self.kind == "relative"
        fit = fit_scale_and_shift(1 / samples[finite] if is_depth else samples[finite], z[finite], is_depth)
        if fit is None:
            return None
        scale, shift = fit
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (scale / values + shift) if is_depth else scale * values + shift
        return np.where(inverse > 0, inverse, np.nan).astype(np.float32)


def fit_scale_and_shift(values: np.ndarray, z: np.ndarray, is_depth: bool) -> tuple[float, float] | None:
    """Return the (scale, shift) that best map a view's values (M,) to depths z (M,); None for a poor fit.

    Minimise squared errors of inverse depth, in rounds without outliers.

    Args:
        is_depth: True to map to z, False to map to 1 / z.
    """
    weight = 1 / z**2 if is_depth else np.ones_like(z)  # converts an error of z to one of 1 / z
    rows = np.stack([values * weight, weight], axis=1)
    goal = 1 / z
    inliers = np.ones(len(z), bool)
    solution, residuals = np.zeros(2), goal
    for _ in range(ROUNDS):
        if inliers.sum() < MIN_POINTS:
            return None
        solution = np.linalg.lstsq(rows[inliers], goal[inliers], rcond=None)[0]
        residuals = np.abs(rows @ solution - goal)
        inliers = residuals <= OUTLIER_RATIO * np.median(residuals[inliers])
    explained = 1 - np.mean(residuals[inliers] ** 2) / max(float(np.var(goal[inliers])), 1e-30)
    scale, shift = map(float, solution)
    return (scale, shift) if scale > 0 and explained >= MIN_EXPLAINED else None


def add_depth_points(scene: Scene) -> Scene:
    """Add coloured points from metric depth maps to a scene of few points, spaced like the maps' pixels.

    Scenes whose maps contradict the existing points stay unchanged, apart from a warning.

    Raises:
        LodgsError: a map or a photo cannot be read.
    """
    views = [camera for camera in scene.cameras if camera.depth is not None]
    if len(scene.points) >= FEW_POINTS or not views:
        return scene
    depths = DepthPriors(scene, "metric")
    if not depths:
        return replace(scene, warnings=[*scene.warnings, *depths.warnings])

    medians = []

    def load_views() -> Iterator[tuple[Camera, np.ndarray, np.ndarray]]:
        for camera in views:
            assert camera.image is not None
            image = load_image(camera.image, camera.width, camera.height)
            depth = _read_camera_map(camera, camera.width, camera.height)
            medians.append(np.median(depth[np.isfinite(depth)]) if np.isfinite(depth).any() else np.nan)
            yield camera, np.where(np.isfinite(depth), depth, MAX_COORDINATE), image

    points, colors, _ = sample_surfaces(load_views(), len(views), MAX_ADDED_POINTS, np.random.default_rng(0))
    messages = [f"Added {len(points):,} initial points from the depth maps."]
    distance = float(np.nanmedian(medians)) / _median_spacing(views) if len(points) else np.nan
    if distance < DISTANCE_RANGE[0] or distance > DISTANCE_RANGE[1]:
        messages.append(
            f"The median depth of the depth maps is {distance:.3g} times the distance between cameras: check "
            "that the maps are in the scene's unit."
        )
    return replace(
        scene,
        points=np.concatenate([scene.points, points.astype(np.float32)]),
        point_colors=np.concatenate([scene.point_colors, np.rint(255 * colors).astype(np.uint8)]),
        point_ids=scene.point_ids[:0],
        warnings=[*scene.warnings, *messages],
    )


def _median_spacing(views: list[Camera]) -> float:
    """Return the median distance from a view to the nearest other view; NaN if all share one position."""
    sample = np.array([camera.center for camera in pick_evenly(views, 500)])
    positions = np.array([camera.center for camera in views])
    distances = np.linalg.norm(sample[:, None] - positions, axis=2)
    nearest = np.where(distances > 0, distances, np.inf).min(axis=1)
    return float(np.median(nearest)) if np.isfinite(nearest).all() else np.nan


def read_depth_map(path: Path) -> np.ndarray:
    """Read a depth map, (H, W) float64, with NaN for missing depth (0, or a renderer's sky).

    EXR and floating-point NPY files store scene units. In an EXR, the nearest of the layers' Depth.Z channels
    counts, or another depth channel. Integers in NPY and grey PNG files count UNIT each.

    Raises:
        LodgsError: the file cannot be read or contains no depth.
    """
    try:
        with open_file(path) as file:
            head = file.read(12)
        if head[:4] == MAGIC:
            depth = read_exr_depth(path)
            return np.where(depth < MAX_COORDINATE, depth, np.nan)
        if head.startswith(b"\x93NUMPY"):
            if head[6:7] != b"\1" and int.from_bytes(head[8:12], "little") > _MAX_NUMPY_HEADER:
                raise ValueError("its header is too long")
            values = _read_numpy(path)
        else:
            from PIL import Image

            with Image.open(path, formats=("PNG",)) as image:
                check_image_size(path, image.size)
                if image.mode not in ("I;16", "I", "L"):
                    raise LodgsError(
                        f"Cannot read {path}: it is a colour image, not a depth map.",
                        "Export depth maps as grey 16-bit PNG or as EXR.",
                    )
                values = np.asarray(image, np.float64) * UNIT
    except LodgsError:
        raise
    except Exception as error:  # Pillow raises many exception types for damaged files
        raise LodgsError(
            f"Cannot read {path} as a depth map: {error}.", "Export it again, or remove it."
        ) from error
    return np.where((values > 0) & (values < SKY_DEPTH), values, np.nan)


def _read_numpy(path: Path) -> np.ndarray:
    stored = np.load(path, mmap_mode="r", allow_pickle=False)
    if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[2]):  # one channel, first or last
        stored = stored.squeeze(0 if stored.shape[0] == 1 else 2)
    if stored.ndim != 2 or stored.dtype.kind not in "fiu":
        raise LodgsError(
            f"Cannot read {path} as a depth map: it is a {stored.dtype} array of shape {stored.shape}.",
            "Save an array of height x width numbers.",
        )
    check_image_size(path, (stored.shape[1], stored.shape[0]))
    return np.asarray(stored, np.float64) * (1 if stored.dtype.kind == "f" else UNIT)


def resample_known(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resample values (H, W) to (height, width) float32 by averaging finite values.

    A pixel becomes NaN if less than half of its area is known.
    """
    finite = np.isfinite(values)
    channels = np.stack([np.where(finite, values, 0), finite], axis=-1)
    total, share = area_average(area_average(channels, height, 0), width, 1).transpose(2, 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(share >= 0.5, total / share, np.nan).astype(np.float32)


def _read_camera_map(camera: Camera, width: int = 0, height: int = 0) -> np.ndarray:
    """Read a view's depth map as stored, or as depths at the given size."""
    assert camera.depth is not None
    values = read_depth_map(camera.depth)
    map_height, map_width = values.shape
    if not same_proportions(map_width, map_height, camera.width, camera.height):
        raise LodgsError(
            f"Cannot use depth map {camera.depth}: its size {map_width}x{map_height} does not match the "
            f"aspect ratio of its photo ({camera.width}x{camera.height}).",
            "Export it again, or remove it.",
        )
    return 1 / resample_known(1 / values, width, height) if width else values
