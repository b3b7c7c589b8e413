"""Load a job's training data: its scene, cameras and held-out views."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..documents import read_json
from ..errors import LodgsError, SystemProblem
from ..files import atomic_write
from ..lod.crop import Crop
from ..optimize.training_data import TrainingData
from ..scenes.cameras import Camera
from ..scenes.colmap import Scene, exclude_views, read_scene
from ..scenes.depths import DepthPriors, add_depth_points
from ..scenes.exposures import exposure_gains
from ..scenes.images import check_image, check_mask
from ..scenes.regions import Region
from ..scenes.rendered_views import thin_evenly
from ..scenes.triangulate import triangulate_scene
from ..scenes.undistort import undistort_cache, undistort_scene
from ..scenes.view_selection import quote_name
from ..splats.bundle import read_header
from ..splats.origin import describe_origin
from .base import base_origin
from .capture import capture, is_complete
from .folder import RunFolder
from .job import Job

OUTSIDE_SHARE = 0.1
"""Maximum number of points outside a job's region, as a share of the maximum number of splats."""
MAX_VIEWS_BYTES = 1 << 26
"""Maximum size of the file with the views of a run."""
DECODERS = 4
"""Number of threads that check whether photos can be decoded."""


def training_data(
    job: Job,
    folder: RunFolder,
    report: Callable[..., None] | None = None,
    *,
    pixels: bool = True,
    keep_views: bool = False,
) -> TrainingData:
    """Read the job's scene; capture and undistort it first where needed, once per scene.

    For a scene in cells, units and held-out views come from the model as read, regardless of undecodable
    photos, so that they are the same in all cells and in the merged result.

    Args:
        job: the job.
        folder: its run.
        report: called with the kind and values of an event (status, warning).
        keep_views: store the views of a new run, and require them when it is resumed.
        pixels: drop views whose photo cannot be decoded. Disable if no pixel is used, to save time.

    Raises:
        LodgsError: the scene cannot be read, or has too little data to train on.
    """
    report = report or _ignore
    parameters = job.resolved_parameters()
    add_depths = pixels and parameters.depth == "metric" and not job.cell and not job.cells
    full_scene = _read_job_scene(job, folder, report, add_depths)
    region = Region.read(Path(job.cell)) if job.cell else None
    scene = full_scene if region is None else region.select_views(full_scene)
    if pixels:
        scene = _exclude_undecodable(scene)
    if keep_views:
        scene = _keep_views(scene, folder)
    warnings = list(scene.warnings)
    if scene.distorted:
        report("status", message=f"Undistorting {len(scene.distorted)} views")
        scene = undistort_scene(scene, undistort_cache(scene, folder.undistorted))
    if add_depths:
        scene = add_depth_points(scene)
    full_scene = full_scene if job.cells or region is not None else scene
    depths = gains = None
    if pixels and parameters.depth_weight:
        depths = DepthPriors(scene, parameters.depth)
        scene = replace(scene, warnings=[*scene.warnings, *depths.warnings])
    if pixels and parameters.match_exposure and not job.capture:  # renders have one exposure
        gains = _match_exposure(job, scene, full_scene, report)
    if job.crop is not None:
        scene = thin_outside_region(scene, job.crop, int(OUTSIDE_SHARE * parameters.splat_limit))
    warnings += [warning for warning in scene.warnings if warning not in warnings]
    for warning in warnings:
        report("warning", message=warning)
    if region is not None:
        scene = region.select_points(scene, full_scene)
    return TrainingData(
        scene, job.image_scale, job.test_every, job.exposure, job.validation,
        photo_memory=job.photo_memory * 10**6 or None,
        splat_memory=job.splat_memory * 10**6 or None, scratch=folder.checkpoints,
        full_scene=full_scene, depths=depths, region=job.crop, gains=gains,
    )  # fmt: skip


def _read_job_scene(job: Job, folder: RunFolder, report: Callable[..., None], add_depths: bool) -> Scene:
    """Read a job's scene, with points unless depth maps of all views will add them."""
    model, images = job.model_and_images
    scene = read_scene(
        _scene_folder(job, folder, report), model=model, images=images, origin=_origin(job, folder)
    )
    if add_depths and all(camera.depth is not None for camera in scene.cameras):
        return scene
    return ensure_points(scene, job, folder, report)


def ensure_points(scene: Scene, job: Job, folder: RunFolder, report: Callable[..., None]) -> Scene:
    """Return a job's scene with points; triangulate them first if it has none, once per scene.

    Args:
        folder: the job's run.
        report: called with the kind and values of an event.

    Raises:
        LodgsError: see ``triangulate_scene``.
    """
    if len(scene.points):
        return scene

    def report_stage(stage: str, done: int, total: int) -> None:
        if total > 1:
            report("status", message=f"{stage} {done} of {total}", step=done, of=total)
        else:
            report("status", message=stage)

    return triangulate_scene(scene, folder.points_cache, report_stage, job.exposure)


def _ignore(kind: str, **values: object) -> None:
    pass


def _origin(job: Job, folder: RunFolder) -> np.ndarray | None:
    """Return the local origin of a job's scene, or None to choose it from the cameras.

    A finished run can be evaluated without its base. The base of cells does not exist before training: it is
    the coarse run, which has the scene's own origin.
    """
    if job.base and folder.bundle.exists() and not Path(job.base).exists():
        return read_header(folder.bundle).origin
    if job.base and job.cell and not RunFolder(job.base).bundle.exists():
        return None
    return base_origin(job)


def thin_outside_region(scene: Scene, region: Crop, limit: int) -> Scene:
    """Thin the scene's points outside a region to at most ``limit``, evenly in space.

    Raises:
        LodgsError: the region contains no point.
    """
    inside = region.contains(scene.points)
    if not inside.any():
        raise LodgsError(
            "Cannot train the region: it contains none of the scene's points.",
            "Move the region or remove it. It is in the scene's COLMAP coordinates. "
            f"{describe_origin(scene.origin)}".strip(),
        )
    outside = np.flatnonzero(~inside)
    if len(outside) > limit:
        points = scene.points[outside]
        distances = np.linalg.norm(points - scene.center, axis=1)
        outside = outside[thin_evenly(points, distances, limit, np.random.default_rng(0))]
    return scene.select_points(np.sort(np.concatenate([np.flatnonzero(inside), outside])))


def _scene_folder(job: Job, folder: RunFolder, report: Callable[..., None]) -> Path:
    """Return the folder of the job's scene; capture it from the base first if the job asks for it.

    Raises:
        LodgsError: the scene of an existing run does not exist, or see ``capture``.
    """
    if not job.capture:
        if folder.has_results and not Path(job.scene).is_dir():
            raise LodgsError(
                f"Cannot use {folder.path}: its scene {job.scene} does not exist.",
                f"Restore the scene, or set its new path in {folder.job} (scene = ...).",
            )
        return Path(job.scene)
    if folder.captured.exists() and not is_complete(folder.captured):
        report("warning", message=f"The views in {folder.captured} are damaged. They are rendered again.")
        shutil.rmtree(folder.captured)
    if not folder.captured.exists():

        def report_view(number: int, count: int) -> None:
            report("status", message=f"Rendering view {number} of {count}", step=number, of=count)

        capture(
            job.base, folder.captured, job.capture, job.views, job.view_width,
            backend=job.backend, report=report_view,
        )  # fmt: skip
    return folder.captured


def _match_exposure(
    job: Job, scene: Scene, full_scene: Scene, report: Callable[..., None]
) -> dict[str, np.ndarray]:
    """Return the exposure gains of the training views by name; see ``exposure_gains``."""
    report("status", message="Comparing exposure of the photos")
    trained = {camera.name for camera in full_scene.split(job.test_every, job.validation)[0]}
    gains = exposure_gains(
        scene, [camera for camera in scene.cameras if camera.name in trained], job.exposure
    )
    if gains:
        largest = max(abs(np.log(gain)).max() for gain in gains.values())
        report("status", message=f"Compensating exposure differences of up to {np.expm1(largest):.0%}")
    return gains


def _exclude_undecodable(scene: Scene) -> Scene:
    """Drop views whose photo cannot be decoded.

    Raises:
        LodgsError: the mask of another view is invalid.
    """
    scene = exclude_views(scene, _undecodable(scene.cameras))
    for camera in scene.cameras:
        if camera.mask is not None:
            check_mask(camera.mask, camera.width, camera.height)
    return scene


def _keep_views(scene: Scene, folder: RunFolder) -> Scene:
    """Store the views of a run without checkpoints; else return the scene with the stored views.

    Raises:
        LodgsError: a view is missing, or its photo has another size.
    """
    views = {camera.name: [camera.width, camera.height] for camera in scene.cameras}
    if not folder.views.exists() or not any(folder.checkpoints.glob("step_*.pt")):
        with atomic_write(folder.views) as temporary:
            temporary.write_text(json.dumps(views), "utf-8")
        return scene
    stored = read_json(folder.views, max_bytes=MAX_VIEWS_BYTES)
    if changed := [name for name, size in stored.items() if views.get(name) != size]:
        raise LodgsError(
            f"Cannot resume the run in {folder.path}: {len(changed):,} of its {len(stored):,} photos changed "
            f"or are missing, such as {quote_name(changed[0])}.",
            "Restore the photos, or train again in another folder.",
        )
    return exclude_views(scene, {name: "the run began without it." for name in views.keys() - stored.keys()})


def _undecodable(cameras: Sequence[Camera]) -> dict[str, str]:
    """Return the decoding error of each undecodable photo, by view name."""

    def decoding_error(camera: Camera) -> str:
        assert camera.image is not None
        try:
            check_image(camera.image)
        except SystemProblem:
            raise
        except LodgsError as error:
            return error.what
        return ""

    with ThreadPoolExecutor(DECODERS) as pool:  # Pillow decodes without holding Python's lock
        errors = zip(cameras, pool.map(decoding_error, cameras), strict=True)
        return {camera.name: error for camera, error in errors if error}
