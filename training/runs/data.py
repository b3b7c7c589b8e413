"""From a job to the views that it trains and is measured on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from ..lod.crop import Crop
from ..optimize.training_data import TrainingData
from ..scenes.cameras import Camera
from ..scenes.colmap import Scene, read_scene, without
from ..scenes.depths import Depths, with_points
from ..scenes.exposures import own_gains
from ..scenes.images import check_image, check_mask
from ..scenes.regions import Region
from ..scenes.rendered import even
from ..scenes.undistort import cache_of, undistorted
from .capture import capture
from .folder import RunFolder
from .job import Job

OUTSIDE = 0.1
"""Most points outside of a job's region, as a share of the splats that a model may have."""
DECODERS = 4
"""Photographs that are decoded at once to see whether they can be."""


def training_data(
    job: Job, folder: RunFolder, tell: Callable[..., None] | None = None, *, pixels: bool = True
) -> TrainingData:
    """The job's scene, read and where needed captured and undistorted (once, beside it).

    Where it is trained in cells, units and held-out views are those of the model as it was read, whatever
    photographs cannot be decoded: so the same in all blocks, and where they are measured together.

    Args:
        tell: called with an event's kind and values (status, warning) while this goes on.
        pixels: leave out views whose photograph cannot be decoded; to be saved where none is looked at.

    Raises:
        LodgsError: if the scene cannot be read, or has too little to train on.
    """
    model, images = (Path(path) if path else None for path in (job.model, job.images))
    whole = read_scene(_scene_folder(job, folder, tell), model=model, images=images)
    region = Region.read(Path(job.cell)) if job.cell else None
    scene = whole if region is None else region.views_of(whole)
    if pixels:
        scene = without(scene, _undecodable(scene.cameras))
        for camera in scene.cameras:
            if camera.mask is not None:
                check_mask(camera.mask, camera.width, camera.height)
    warnings = list(scene.warnings)
    if scene.distorted:
        if tell:
            tell("status", message=f"Undistorting {len(scene.distorted)} views")
        scene = undistorted(scene, cache_of(scene, folder.undistorted))
    parameters, depths = job.resolved_parameters(), None
    if pixels and parameters.depth == "metric" and region is None and not job.cells:
        scene = with_points(scene)
    whole = whole if job.cells or region is not None else scene
    if pixels and parameters.depth_weight:
        depths = Depths(scene, parameters.depth)
        scene = replace(scene, warnings=[*scene.warnings, *depths.warnings])
    gains = None
    if pixels and parameters.match_exposure:
        if tell:
            tell("status", message="Comparing the photographs' exposure")
        trained = {camera.name for camera in whole.split(job.test_every, job.validation)[0]}
        gains = own_gains(scene, [each for each in scene.cameras if each.name in trained], job.exposure)
        if gains and tell:
            most = max(abs(np.log(gain)).max() for gain in gains.values())
            tell("status", message=f"Photographs differ in exposure by up to {np.expm1(most):.0%}: evened")
    if job.crop is not None:
        scene = thin_outside_region(scene, job.crop, int(OUTSIDE * parameters.max_splats))
    warnings += [warning for warning in scene.warnings if warning not in warnings]
    for warning in warnings:
        if tell:
            tell("warning", message=warning)
    if region is not None:
        these = region.points_of(whole)
        scene = replace(scene, points=whole.points[these], point_colors=whole.point_colors[these])
    return TrainingData(
        scene, job.image_scale, job.test_every, job.exposure, job.validation,
        photo_memory=job.photo_memory * 10**6 or None,
        splat_memory=job.splat_memory * 10**6 or None,
        scratch=folder.checkpoints,
        whole=whole,
        depths=depths,
        region=job.crop,
        gains=gains,
    )  # fmt: skip


def thin_outside_region(scene: Scene, region: Crop, most: int) -> Scene:
    """The scene with at most so many of its points outside of a region, even in space.

    Raises:
        LodgsError: the region holds no point.
    """
    inside = region.holds(scene.points)
    if not inside.any():
        raise LodgsError(
            "The region holds none of the scene's points.",
            "Move it to where they are, or leave it out. It is told in the scene's own coordinates.",
        )
    outside = np.flatnonzero(~inside)
    if len(outside) > most:
        points = scene.points[outside]
        away = np.linalg.norm(points - scene.center, axis=1)
        outside = outside[even(points, away, most, np.random.default_rng(0))]
    rows = np.sort(np.concatenate([np.flatnonzero(inside), outside]))
    return replace(
        scene, points=scene.points[rows], point_colors=scene.point_colors[rows],
        point_ids=scene.point_ids[rows] if len(scene.point_ids) else scene.point_ids,
    )  # fmt: skip


def _scene_folder(job: Job, folder: RunFolder, tell: Callable[..., None] | None) -> Path:
    """Where the job's scene is; it is made of the base's own pictures, where the job says so."""
    if not job.capture:
        return Path(job.scene)
    if not folder.captured.exists():

        def tell_view(number: int, count: int) -> None:
            if tell:
                tell("status", message=f"Drawing view {number} of {count}", step=number, of=count)

        capture(
            job.base, folder.captured, job.capture, job.views, job.view_width,
            backend=job.backend, tell=tell_view,
        )  # fmt: skip
    return folder.captured


def _undecodable(cameras: Sequence[Camera]) -> dict[str, str]:
    """Why a photograph cannot be decoded, by the names of the views of which that is so."""

    def trouble(camera: Camera) -> str:
        assert camera.image is not None
        try:
            check_image(camera.image)
        except LodgsError as error:
            return error.what
        return ""

    with ThreadPoolExecutor(DECODERS) as pool:  # Pillow decodes without holding Python's lock
        found = zip(cameras, pool.map(trouble, cameras), strict=True)
        return {camera.name: why for camera, why in found if why}
