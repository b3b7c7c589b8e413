"""Triangulate points of scenes that have cameras but no points, with COLMAP through pycolmap.

.triangulated/<digest>/  sparse/       model with the scene's cameras, the points and their observations
                         summary.json  sentences about the result
"""

from __future__ import annotations

import json
import os
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..documents import read_json
from ..errors import LodgsError, SystemProblem, system_reason
from ..files import name_errors, temporary_folder
from . import pycolmap_process
from .cameras import Camera
from .colmap import NO_POINTS, Scene, read_scene, scene_lenses
from .colmap_model import read_points
from .images import load_image, load_mask, write_png
from .scene_cache import remove_abandoned, scene_digest, writable_cache
from .sfm_known_poses import photo_name
from .view_selection import find_outliers
from .write_colmap import write_model

CACHE_FOLDER = ".triangulated"
"""Folder inside a scene's folder that caches triangulated points for all runs."""
MAX_SECONDS = 900.0
"""Maximum time for features and matches: about 1000 photos on two cores. Later photos are left out."""
MAX_SIDE = 1000
"""Longer side in pixels of the photos for feature extraction."""
DETAILED_PHOTOS = 100
"""Number of photos up to which features are also searched in enlarged photos: few photos give few points."""
FEATURES, DETAILED_FEATURES = 2048, 4096
"""Maximum number of features per photo, and for few photos."""
MIN_POINTS = 100
"""Number of points below which training starts from random points."""
RANDOM_POINTS = 30_000
"""Number of random initial points."""
STAGES = {
    "features": "Extracting features of photo",
    "pairs": "Comparing pair",
    "points": "Triangulating points",
    "empty parts": "Estimating points in photo",
}
REPORT_SECONDS = 1.0
"""Minimum time between two reports."""
DECODERS = 4
"""Number of photos decoded at a time."""

_PREFIX = "triangulating-"
_VERSION = b"2"  # of the cached files
_SUMMARY = "summary.json"
_NO_POINTS = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)

Report = Callable[[str, int, int], object]
"""Callback that receives the stage, the number of completed items and their total."""


def triangulate_scene(scene: Scene, fallback: Path, report: Report, exposure: float = 0.0) -> Scene:
    """Return the scene with triangulated points, or with random ones where nothing can be matched.

    Photos are matched in pairs that probably overlap. Cameras stay fixed, with their lens distortion. Points
    are cached in the scene's folder, under the digest of its files, and reused later. The result is
    deterministic unless MAX_SECONDS is reached.

    Args:
        scene: scene without points.
        fallback: folder of the cache if the scene's folder is not writable.
        report: called with the progress, and at last with the result.
        exposure: exposure in stops for photos of linear light.

    Raises:
        LodgsError: if the cache cannot be written.
    """
    cache = writable_cache(scene, CACHE_FOLDER, fallback)
    try:
        target = cache / _digest(scene, exposure)
        if not target.is_dir():
            cache.mkdir(parents=True, exist_ok=True)
            remove_abandoned(cache, _PREFIX)
            with tempfile.TemporaryDirectory(dir=cache, prefix=_PREFIX) as work:
                result = _triangulate(scene, Path(work), report, exposure)
                try:
                    os.replace(result, target)
                except OSError:
                    if not target.is_dir():  # another process may have written the same content first
                        raise
        return _with_points(scene, target, report)
    except OSError as error:
        raise LodgsError(
            f"Cannot triangulate points of {scene.folder}: {system_reason(error)}.",
            "Check the images and the free disk space.",
        ) from error


def cached_points(scene: Scene, exposure: float = 0.0) -> Scene:
    """Return a scene without points with those in the cache inside its folder; unchanged without a cache.

    Raises:
        LodgsError: if the cached points are damaged.
    """
    if len(scene.points):
        return scene
    try:
        target = scene.folder / CACHE_FOLDER / _digest(scene, exposure)
        return _with_points(scene, target) if target.is_dir() else scene
    except OSError:
        return scene


def write_points(folder: Path, model: Path, report: Report) -> Scene:
    """Add points to an unfinished model without points, as :func:`triangulate_scene`.

    Args:
        folder: folder of the scene.
        model: folder of the model, which is replaced.

    Raises:
        OSError: if the model cannot be written.
    """
    scene = read_scene(folder, model)
    with temporary_folder(model.parent) as work:
        result = _triangulate(scene, work, report, 0.0)
        os.replace(model, work / "previous")
        os.replace(result / "sparse", model)
        return replace(_with_points(scene, result, report), point_model=None)


def random_start_points(cameras: list[Camera], count: int = RANDOM_POINTS) -> np.ndarray:
    """Return random initial points (N, 3) for training, visible in at least two views if any views overlap.

    The points lie on random pixels' rays, around the depth of the point closest to all optical axes. If most
    cameras do not face that point, as on a walk, the depth is three times the distance between cameras.
    """
    rng = np.random.default_rng(0)
    positions = np.array([camera.center for camera in cameras])
    axes = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    projections = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(
        projections.sum(axis=0), np.einsum("nij,nj->i", projections, positions), rcond=None
    )[0]
    depths = np.einsum("ni,ni->n", focus - positions, axes)
    if len(cameras) < 2 or np.mean(depths > 0) < 0.9:
        distances = np.linalg.norm(positions[:, None] - positions[None, :200], axis=2)
        nearest = np.where(distances > 0, distances, np.inf).min(axis=1, initial=np.inf)
        step = float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else 1.0
        depths = np.full(len(cameras), 3 * step)
    view = rng.integers(len(cameras), size=4 * count)
    pixels = rng.random((4 * count, 2))
    depth_factors = np.exp2(rng.uniform(-2, 1, 4 * count))
    points = np.empty((4 * count, 3))
    for number in np.unique(view):
        camera, rows = cameras[number], np.flatnonzero(view == number)
        depth = max(float(depths[number]), 1e-6) * depth_factors[rows]
        points[rows] = camera.unproject(pixels[rows] * (camera.width, camera.height), depth)
    view_counts = np.zeros(len(points), np.int32)
    for camera in cameras:
        view_counts += camera.sees(points)
    shared = points[view_counts >= min(2, len(cameras))]
    return (shared if len(shared) >= count // 10 else points)[:count]


def _digest(scene: Scene, exposure: float) -> str:
    return scene_digest(scene, _VERSION + str(exposure).encode())


def _ignore(stage: str, done: int, total: int) -> None:
    pass


def _with_points(scene: Scene, result: Path, report: Report = _ignore) -> Scene:
    """Return the scene with the points of a result and its warnings, and report its message."""
    model = result / "sparse" if (result / "sparse").is_dir() else scene.model
    positions, colors, ids = read_points(model)
    points = (positions - scene.origin).astype(np.float32)
    inliers = ~find_outliers(points, scene.cameras)[0]
    summary = read_json(result / _SUMMARY)
    report(summary["message"], 1, 1)
    warnings = [warning for warning in scene.warnings if not warning.startswith(NO_POINTS)]
    return replace(
        scene, points=points[inliers], point_colors=colors[inliers], point_ids=ids[inliers],
        point_model=model, warnings=[*warnings, *summary["warnings"]],
    )  # fmt: skip


def _triangulate(scene: Scene, work: Path, report: Report, exposure: float) -> Path:
    """Write the points of a scene to a folder inside ``work`` and return the folder."""
    for name in ("photos", "masks"):
        (work / name).mkdir()
    sizes = [_reduced_size(camera) for camera in scene.cameras]
    _write_cameras(scene, sizes, work)
    detailed = len(sizes) <= DETAILED_PHOTOS or max(map(max, sizes)) <= MAX_SIDE / 2
    request = {
        "work": str(work), "seconds": MAX_SECONDS, "origin": scene.origin.tolist(),
        "features": DETAILED_FEATURES if detailed else FEATURES, "octave": -1 if detailed else 0,
        "scales": [
            [camera.width / width, camera.height / height]
            for camera, (width, height) in zip(scene.cameras, sizes, strict=True)
        ],
    }  # fmt: skip
    result: dict = {}
    last_stage, next_report = "", 0.0

    def on_message(message: dict) -> dict | None:
        nonlocal last_stage, next_report
        if "result" in message:
            result.update(message["result"])
        elif "photos" in message:
            numbers = message["photos"]

            def write(n: int) -> bool:
                return _write_photo(n, scene.cameras[n - 1], sizes[n - 1], work, exposure)

            with ThreadPoolExecutor(DECODERS) as pool:
                return {
                    "photos": [
                        n for n, usable in zip(numbers, pool.map(write, numbers), strict=True) if usable
                    ]
                }
        elif message["stage"] != last_stage or time.monotonic() > next_report:
            last_stage, next_report = message["stage"], time.monotonic() + REPORT_SECONDS
            report(STAGES[last_stage], message["done"], message["total"])
        return None

    problem = pycolmap_process.run_program("sfm_known_poses", request, work, on_message)
    points = 0 if problem else result["points"]
    if points < MIN_POINTS:
        _write_random_points(scene, work)
    folder = work / "result"
    folder.mkdir()
    os.replace(work / ("sparse" if points >= MIN_POINTS else "random"), folder / "sparse")
    summary = json.dumps(_summarize(scene, result, problem))
    with name_errors(folder / _SUMMARY):
        (folder / _SUMMARY).write_text(summary, encoding="utf-8")
    return folder


def _reduced_size(camera: Camera) -> tuple[int, int]:
    """Return the width and height of a photo for feature extraction."""
    share = min(1, MAX_SIDE / max(camera.width, camera.height))
    return max(round(share * camera.width), 1), max(round(share * camera.height), 1)


def _write_cameras(scene: Scene, sizes: Sequence[tuple[int, int]], work: Path) -> None:
    """Write the cameras as models: "full" as they are, and "poses" for reduced and numbered photos."""
    lenses = scene_lenses(scene)
    poses = [camera.world_to_camera for camera in scene.cameras]
    names = [camera.name for camera in scene.cameras]
    write_model(work / "full", lenses, list(zip(names, poses, strict=True)), *_NO_POINTS)
    reduced = [lens.resized(*size) for lens, size in zip(lenses, sizes, strict=True)]
    numbers = [photo_name(number) for number in range(1, len(poses) + 1)]
    write_model(work / "poses", reduced, list(zip(numbers, poses, strict=True)), *_NO_POINTS)


def _write_photo(number: int, camera: Camera, size: tuple[int, int], work: Path, exposure: float) -> bool:
    """Write a reduced photo, and a mask of its ignored or transparent parts; return False if unreadable."""
    assert camera.image is not None
    try:
        pixels = load_image(camera.image, *size, exposure=exposure, alpha=True)
        visible = pixels[..., 3] >= 0.5
        if camera.mask is not None:
            visible &= load_mask(camera.mask, *size) >= 0.5
    except SystemProblem:
        raise
    except LodgsError:  # training names the file
        return False
    name = photo_name(number)
    write_png(work / "photos" / name, np.rint(255 * pixels[..., :3]).astype(np.uint8))
    codes = np.where(visible, 255, 0).astype(np.uint8)  # COLMAP wants a mask for each photo
    write_png(work / "masks" / f"{name}.png", np.repeat(codes[..., None], 3, axis=2))
    return True


def _write_random_points(scene: Scene, work: Path) -> None:
    """Write a model of the scene with random points."""
    points = random_start_points(scene.cameras)
    poses = [(camera.name, camera.moved(scene.origin).world_to_camera) for camera in scene.cameras]
    gray = np.full((len(points), 3), 128, np.uint8)
    write_model(work / "random", scene_lenses(scene), poses, points + scene.origin, gray)


def _summarize(scene: Scene, result: Mapping, problem: str) -> dict:
    """Return the message and the warnings about a result."""
    warnings = []
    if problem or result["points"] < MIN_POINTS:
        reason = (
            f"COLMAP stopped: {problem}"
            if problem
            else f"only {result['points']} points match between {len(scene.cameras)} photos."
        )
        message = f"Added {RANDOM_POINTS:,} random points"
        warnings.append(
            f"Cannot triangulate points of {scene.folder}: {reason} Training starts from random points, "
            "which costs several dB. Export the points too, check the poses, or find the cameras again: "
            "lodgs scene --photos DIR --out SCENE."
        )
    else:
        message = (
            f"Triangulated {result['points']:,} points from {result['photos']:,} photos, "
            f"{result['error']:.2f} px; estimated {result['estimated']:,} in parts without features"
        )
    if not problem and not result["in_time"]:
        warnings.append(
            f"Matching stopped after {MAX_SECONDS:.0f} s, with features of {result['features']:,} of "
            f"{len(scene.cameras):,} photos. Export the points too, or use fewer photos."
        )
    return {"message": message, "warnings": warnings}
