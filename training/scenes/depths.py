"""How deep photographs are: depth maps beside them, or the model's own points. numpy, Pillow and OpenEXR."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from .cameras import MAX_COORDINATE, Camera, pick_evenly
from .colmap import Scene, observations
from .exr import MAGIC
from .images import area_average, check_image_size, load_image, same_proportions
from .rendered_views import SKY_DEPTH, read_exr_depth, sample_surfaces

DEPTH_KINDS = ("metric", "relative", "inverse", "points")
"""What is known: depth in the scene's unit; depth, or inverse depth, of which scale and shift are each view's
own; or only where the model's points are."""
UNIT = 1e-3
"""A step of a map of whole numbers in the scene's unit, as nerfstudio and most sensors have it."""
TRIED = 3
"""Views by which maps are compared with the scene's points."""
ALIKE = 1.25
"""Metric maps are not used unless half of the points are no more than so many times as deep as there, or as
little."""
FEWEST = 20
"""Points that scale and shift of a map are found by."""
ROUNDS = 3
"""Least squares are repeated so often, without what is more than OUTLYING times as far off as most."""
OUTLYING = 3.0
EXPLAINED = 0.5
"""A map that explains less than this share of the points' variance is not used."""
FEW_POINTS = 1000
"""Scenes with fewer points get some from their depth maps,"""
MOST_POINTS = 100_000
"""at most so many."""
STEPS = 0.3, 1000
"""What is shown is so many times as far away as the next photograph, or maps are in another unit."""


class DepthPriors:
    """What a scene knows of the depth in its photographs.

    Args:
        scene: of pinhole cameras, with all of its points.
        kind: one of KINDS.

    Attributes:
        warnings: a sentence where something is not used.
    """

    def __init__(self, scene: Scene, kind: str) -> None:
        self.kind, self.warnings = kind, list[str]()
        self._points = scene.points
        self._maps = [camera for camera in scene.cameras if camera.depth is not None]
        asked = scene.cameras if kind == "points" else self._maps
        if kind == "metric":
            asked = pick_evenly(asked, TRIED)
        self._seen = observations(scene, [camera.name for camera in asked]) if asked else {}
        known = self._seen if kind == "points" else self._maps
        if not known:
            self.warnings.append(
                "Depth is asked for, but the model does not tell which photographs see its points."
                if kind == "points"
                else "Depth is asked for, but no photograph has a depth map: put them into the folder depths "
                "beside the photographs, or take the depth of the scene's points (depth = points)."
            )
        self._used = bool(known) and self._fits()

    def inverse(self, camera: Camera) -> np.ndarray | None:
        """1 / z of what a view shows, (H, W) float32 of its size, NaN where that is not known; or None.

        Raises:
            LodgsError: its map cannot be read.
        """
        return self._inverse(camera) if self._used else None

    def __bool__(self) -> bool:
        """Whether anything is known."""
        return self._used

    def _inverse(self, camera: Camera) -> np.ndarray | None:
        if self.kind == "points":
            return self._of_points(camera)
        if camera.depth is None:
            return None
        values = _read_map(camera)
        if self.kind == "inverse":
            found = resample_known(values, camera.width, camera.height)
        else:
            found = resample_known(1 / values, camera.width, camera.height)
        return found if self.kind == "metric" else self._fitted(camera, found)

    def _fits(self) -> bool:
        """Whether maps and points agree, as far as points tell; a sentence where they do not."""
        tried = pick_evenly(self._maps, TRIED)
        if self.kind in ("relative", "inverse"):
            if any(self._inverse(camera) is not None for camera in tried):
                return True
            self.warnings.append(
                "The depth maps are not used: they do not go with the scene's points, whatever their scale "
                f"and shift. Say what they are with depth ({', '.join(DEPTH_KINDS[:3])})."
            )
            return False
        if self.kind == "points" or not self._seen:
            return True
        ratios = []
        for camera in tried:
            x, y, z = self._where(camera)
            ratios.append(z / _read_map(camera, camera.width, camera.height)[y, x])
        ratio = np.concatenate(ratios)
        ratio = ratio[np.isfinite(ratio)]
        if len(ratio) < FEWEST or np.mean(np.abs(np.log(ratio)) < np.log(ALIKE)) >= 0.5:
            return True
        self.warnings.append(
            "The depth maps are not used: depths in them are not those of the scene's points, but "
            f"{1 / np.median(ratio):.3g} times as large, by the median. If they are only relative, say so "
            "with depth (relative or inverse)."
        )
        return False

    def _where(self, camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels, x and y, of the points that a view observes, and their depths, (M,) each; of all in its
        image where the model does not tell."""
        points = self._points[self._seen.get(camera.name, [])] if self._seen else self._points
        points = points[camera.sees(points)]
        pixels, z = camera.project(points)
        x, y = np.floor(pixels).astype(int).T
        return x, y, z

    def _of_points(self, camera: Camera) -> np.ndarray | None:
        if camera.name not in self._seen:
            return None
        x, y, z = self._where(camera)
        nearest_last = np.argsort(-z)
        found = np.full((camera.height, camera.width), np.nan, np.float32)
        found[y[nearest_last], x[nearest_last]] = 1 / z[nearest_last]
        return found

    def _fitted(self, camera: Camera, values: np.ndarray) -> np.ndarray | None:
        """A view's values, inverse depths of any scale, as inverse depths in the scene's unit."""
        x, y, z = self._where(camera)
        there = values[y, x]
        known = np.isfinite(there)
        depth = self.kind == "relative"
        found = fit_scale_and_shift(1 / there[known] if depth else there[known], z[known], depth)
        if found is None:
            return None
        scale, shift = found
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (scale / values + shift) if depth else scale * values + shift
        return np.where(inverse > 0, inverse, np.nan).astype(np.float32)


def fit_scale_and_shift(values: np.ndarray, z: np.ndarray, depth: bool) -> tuple[float, float] | None:
    """(scale, shift) that bring a view's values (M,) closest to depths z (M,); None where they do not go
    together.

    Least squares of inverse depths, repeated without what is far off.

    Args:
        depth: scale * values + shift is z; otherwise it is 1 / z.
    """
    weight = 1 / z**2 if depth else np.ones_like(z)  # an error of z counts as the one of 1 / z that it makes
    rows, goal, kept = np.stack([values * weight, weight], axis=1), 1 / z, np.ones(len(z), bool)
    for _ in range(ROUNDS):
        if kept.sum() < FEWEST:
            return None
        solution = np.linalg.lstsq(rows[kept], goal[kept], rcond=None)[0]
        apart = np.abs(rows @ solution - goal)
        kept = apart <= OUTLYING * np.median(apart[kept])
    explained = 1 - np.mean(apart[kept] ** 2) / max(float(np.var(goal[kept])), 1e-30)
    scale, shift = map(float, solution)
    return (scale, shift) if scale > 0 and explained >= EXPLAINED else None


def add_depth_points(scene: Scene) -> Scene:
    """A scene of few points with such as its metric depth maps show, as close as pixels are and
    coloured; with none of them where the maps are not those of the points that there are.

    Raises:
        LodgsError: a map or a photograph cannot be read.
    """
    views = [camera for camera in scene.cameras if camera.depth is not None]
    if len(scene.points) >= FEW_POINTS or not views:
        return scene
    depths = DepthPriors(scene, "metric")
    if not depths:
        return replace(scene, warnings=[*scene.warnings, *depths.warnings])

    medians = []

    def shown() -> Iterator[tuple[Camera, np.ndarray, np.ndarray]]:
        for camera in views:
            assert camera.image is not None
            picture = load_image(camera.image, camera.width, camera.height)
            depth = _read_map(camera, camera.width, camera.height)
            medians.append(np.median(depth[np.isfinite(depth)]) if np.isfinite(depth).any() else np.nan)
            yield camera, np.where(np.isfinite(depth), depth, MAX_COORDINATE), picture

    points, colors, _ = sample_surfaces(shown(), len(views), MOST_POINTS, np.random.default_rng(0))
    told = [f"{len(points):,} points to begin with are taken from the depth maps."]
    times = float(np.nanmedian(medians)) / _apart(views) if len(points) else np.nan
    if times < STEPS[0] or times > STEPS[1]:
        told.append(
            f"The depth maps show what is {times:.3g} times as far away as the next photograph: make sure "
            "that they are in the scene's unit."
        )
    return replace(
        scene,
        points=np.concatenate([scene.points, points.astype(np.float32)]),
        point_colors=np.concatenate([scene.point_colors, np.rint(255 * colors).astype(np.uint8)]),
        point_ids=scene.point_ids[:0],
        warnings=[*scene.warnings, *told],
    )


def _apart(views: list[Camera]) -> float:
    """How far views are from the next one, by the median; NaN where all stand in one place."""
    eyes = np.array([camera.center for camera in pick_evenly(views, 500)])
    apart = np.linalg.norm(eyes[:, None] - np.array([camera.center for camera in views]), axis=2)
    nearest = np.where(apart > 0, apart, np.inf).min(axis=1)
    return float(np.median(nearest)) if np.isfinite(nearest).all() else np.nan


def read_depth_map(path: Path) -> np.ndarray:
    """The values of a depth map, (H, W) float64, NaN where there are none (0, or the sky of a renderer).

    An EXR's are as they are stored: the nearest of its layers' Depth.Z, or what else is depth there. So are a
    NPY's of floats; whole numbers, there and in a grey PNG, count UNIT each.

    Raises:
        LodgsError: it cannot be read, or holds no depth.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(6)
        if head[:4] == MAGIC:
            depth = read_exr_depth(path)
            return np.where(depth < MAX_COORDINATE, depth, np.nan)
        if head == b"\x93NUMPY":
            values = _of_numpy(path)
        else:
            from PIL import Image

            with Image.open(path, formats=("PNG",)) as image:
                check_image_size(path, image.size)
                if image.mode not in ("I;16", "I", "L"):
                    raise LodgsError(
                        f"{path} is a picture in colours, not a depth map.",
                        "Give grey PNGs of 16 bits, or EXR.",
                    )
                values = np.asarray(image, np.float64) * UNIT
    except LodgsError:
        raise
    except Exception as error:  # Pillow raises many kinds for damaged files
        raise LodgsError(
            f"{path} cannot be read as a depth map: {error}.", "Write it again, or take it away."
        ) from error
    return np.where((values > 0) & (values < SKY_DEPTH), values, np.nan)


def _of_numpy(path: Path) -> np.ndarray:
    stored = np.load(path, mmap_mode="r", allow_pickle=False)
    if stored.ndim == 3 and 1 in (stored.shape[0], stored.shape[2]):  # a channel, first or last
        stored = stored.squeeze(0 if stored.shape[0] == 1 else 2)
    if stored.ndim != 2 or stored.dtype.kind not in "fiu":
        raise LodgsError(
            f"{path} holds {stored.dtype} of shape {stored.shape}, not a depth map.",
            "Save an array of height x width numbers.",
        )
    check_image_size(path, (stored.shape[1], stored.shape[0]))
    return np.asarray(stored, np.float64) * (1 if stored.dtype.kind == "f" else UNIT)


def resample_known(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Values (H, W) at another size, (height, width) float32: the means of what is known; NaN where less than
    half is."""
    known = np.isfinite(values)
    both = np.stack([np.where(known, values, 0), known], axis=-1)
    total, share = area_average(area_average(both, height, 0), width, 1).transpose(2, 0, 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(share >= 0.5, total / share, np.nan).astype(np.float32)


def _read_map(camera: Camera, width: int = 0, height: int = 0) -> np.ndarray:
    """A view's map as it is, or depths at a size."""
    assert camera.depth is not None
    values = read_depth_map(camera.depth)
    high, wide = values.shape
    if not same_proportions(wide, high, camera.width, camera.height):
        raise LodgsError(
            f"{camera.depth} is {wide}x{high}, of other proportions than its photograph.",
            "Write it again, or take it away.",
        )
    return 1 / resample_known(1 / values, width, height) if width else values
