"""Check of a scene before training, for facts that lower the quality without any error. No torch."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import LodgsError
from ..splats.origin import describe_origin
from .cameras import pick_evenly
from .colmap import NO_POINTS, Progress, Scene, read_scene
from .evidence import MIN_PARALLAX, MIN_PHOTOS, measure_evidence
from .observations import observations, reprojection_errors
from .triangulate import cached_points

MIN_VIEWS = 2
"""Number of views below which nothing can be trained."""
FEW_VIEWS = 20
"""Number of views below which floaters are likely."""
SMALL_SIDE = 200
"""Longer side of a photo, in pixels at the trained scale, below which details are lost."""
MIN_SHARED = 20
"""Number of points that a view must share with other views to overlap them."""
WEAK_SHARE = 0.2
"""Share of a scene with weak evidence that is worth a warning."""
MAX_REPROJECTION = 0.05
"""Median reprojection error of a view above which its pose is wrong, as a fraction of the image diagonal."""
MAX_OFFSET = 0.2
"""Distance of a principal point from the image centre from which it is unusual, as a fraction of the side."""
_POSES, _POINTS = 50, 20_000
"""Maximum numbers of poses and of points that are compared."""
ERROR, WARNING, INFO = SEVERITIES = "error", "warning", "info"
ESTIMATE = "estimate"
"""Severity of the expected costs and of suggested settings, see ``runs.estimate``."""


class Finding(NamedTuple):
    """A fact about a scene that affects training.

    Attributes:
        severity: "error" if training is impossible, "warning" if the quality is lower, else "info".
        what: sentence with the fact and its effect.
        remedy: the user's next step, in the imperative.
    """

    severity: str
    what: str
    remedy: str = ""

    def __str__(self) -> str:
        return f"{self.what} {self.remedy}".strip()


def check_folder(
    folder: Path,
    model: Path | None = None,
    images: Path | None = None,
    *,
    image_scale: float = 1.0,
    exposure: float = 0.0,
    progress: Progress | None = None,
) -> list[Finding]:
    """Read a scene as training does, and return the findings of its reading and of :func:`check_scene`.

    Photos of other exposure are only found if Pillow and SciPy are installed.

    Args:
        folder, model, images, progress: see ``read_scene``.
        image_scale: scale of the photos in training.
        exposure: exposure in stops for photos of linear light.

    Returns:
        The findings, the most severe first. A scene that cannot be read is one finding.
    """
    try:
        scene = cached_points(read_scene(folder, model, images, progress), exposure)
        findings = [*check_scene(scene, image_scale), *_exposure(scene, exposure)]
    except LodgsError as error:
        return [Finding(ERROR, error.what, error.remedy)]
    findings += [*_missing(scene), *_no_points(scene)]
    findings += [Finding(WARNING, text) for text in scene.warnings if not text.startswith(NO_POINTS)]
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def check_scene(scene: Scene, image_scale: float = 1.0) -> list[Finding]:
    """Return the findings besides the scene's own warnings, without decoding its photos."""
    observed = observations(scene, [camera.name for camera in scene.cameras])
    return [
        *_views(scene), *_poses(scene), *_centers(scene), *_sizes(scene, image_scale), *_origin(scene),
        *_overlap(scene, observed), *_coverage(scene, observed),
    ]  # fmt: skip


def _views(scene: Scene) -> Iterator[Finding]:
    count = len(scene.cameras)
    if count < MIN_VIEWS:
        yield Finding(ERROR, f"The scene has {count} view(s), but training needs {MIN_VIEWS}.", "Add photos.")
    elif count < FEW_VIEWS:
        yield Finding(
            WARNING,
            f"The scene has only {count} views, which often causes floaters.",
            f"Add photos that overlap, at least {FEW_VIEWS} and better 100.",
        )


def _poses(scene: Scene) -> Iterator[Finding]:
    """Find poses that contradict the observations, or without them the positions of the points."""
    cameras = pick_evenly(scene.cameras, _POSES)
    errors = reprojection_errors(scene, {camera.name for camera in cameras})
    if errors:
        wrong, count = sum(error > MAX_REPROJECTION for error in errors.values()), len(errors)
        problem = f"a median reprojection error above {MAX_REPROJECTION:.0%} of the image diagonal"
    else:
        points = scene.points[:: len(scene.points) // _POINTS + 1]
        wrong, count = sum(not camera.sees(points).any() for camera in cameras), len(cameras)
        problem = "no points in front of the camera and inside the image"
    if len(scene.points) and 2 * wrong > count:
        yield Finding(
            WARNING,
            f"The poses do not fit the points: {wrong} of {count} tested views have {problem}.",
            "Check the export: poses may belong to other photos, or be camera-to-world instead of COLMAP's "
            "world-to-camera.",
        )


def _centers(scene: Scene) -> Iterator[Finding]:
    """Find principal points far from the image centre, as of a focal length for another image size."""
    places = np.array([(camera.cx / camera.width, camera.cy / camera.height) for camera in scene.cameras])
    far = places[(np.abs(places - 0.5) > MAX_OFFSET).any(axis=1)]
    if 2 * len(far) > len(places):
        x, y = np.median(far, axis=0)
        yield Finding(
            WARNING,
            f"The principal points of {len(far)} of {len(places)} views are far from the image centre, at "
            f"{x:.0%} of the width and {y:.0%} of the height.",
            "Check the export: focal length and principal point may be for another image size.",
        )


def _missing(scene: Scene) -> Iterator[Finding]:
    missing = len(scene.names) - len(scene.cameras)
    if missing > 0:
        yield Finding(
            WARNING,
            f"{missing} of {len(scene.names)} views of the model have no usable photo.",
            f"Copy their photos to {scene.images_folder}, or choose another image folder.",
        )


def _sizes(scene: Scene, image_scale: float) -> Iterator[Finding]:
    sides = [image_scale * max(camera.width, camera.height) for camera in scene.cameras]
    small = [side for side in sides if side < SMALL_SIDE]
    if small:
        yield Finding(
            WARNING,
            f"{len(small)} of {len(sides)} photos have fewer than {SMALL_SIDE} pixels on their longer side "
            f"in training (smallest: {min(small):.0f}), which loses details.",
            "Use larger photos, or increase the image scale.",
        )


def _no_points(scene: Scene) -> Iterator[Finding]:
    if not len(scene.points) and any(camera.depth is None for camera in scene.cameras):
        yield Finding(
            WARNING,
            f"{NO_POINTS}. Training triangulates them from the photos first, which takes minutes.",
            "Export the points too to save this time.",
        )


def _origin(scene: Scene) -> Iterator[Finding]:
    if scene.origin.any():
        yield Finding(INFO, f"The scene lies far from 0. {describe_origin(scene.origin)}")


def _overlap(scene: Scene, observed: dict[str, np.ndarray]) -> Iterator[Finding]:
    """Find views that share too few points with other views, and groups of views without common points."""
    names = [camera.name for camera in scene.cameras]
    if not observed or len(names) < MIN_VIEWS:
        return
    view = np.repeat(np.arange(len(names)), [len(observed.get(name, ())) for name in names])
    point = np.concatenate([observed[name] for name in names if name in observed])
    shared = np.bincount(point, minlength=len(scene.points))[point] > 1
    counts = np.bincount(view[shared], minlength=len(names))
    isolated = np.flatnonzero(counts < MIN_SHARED)
    if len(isolated):
        yield Finding(
            WARNING,
            f"{len(isolated)} of {len(names)} views share fewer than {MIN_SHARED} points with other views "
            f"(such as {names[isolated[0]]}).",
            "Take photos between them, or remove them.",
        )
    groups = _groups(view[shared], point[shared], np.flatnonzero(counts >= MIN_SHARED))
    if len(groups) > 1:
        sizes = " and ".join(str(len(group)) for group in groups[:2])
        yield Finding(
            WARNING,
            f"The views form {len(groups)} groups without common points, the largest of {sizes} views. "
            "Their parts of the scene may not fit together.",
            "Take photos that connect the groups, or train each group on its own.",
        )


def _coverage(scene: Scene, observed: dict[str, np.ndarray]) -> Iterator[Finding]:
    """Report how many photos see each region, and find parts with weak evidence."""
    evidence = measure_evidence(scene.cameras, scene.points, observed)
    if not len(evidence.points):
        return
    photos, few = (evidence.quantile(evidence.photos, share) for share in (0.5, 0.1))
    parallax = evidence.quantile(evidence.parallax, 0.5)
    weak, flat = evidence.weak_share, evidence.flat_share
    yield Finding(
        INFO,
        f"Coverage: half of the scene is seen by {photos:.0f} photos or more, a tenth by {few:.0f} or fewer; "
        f"median angle between the outermost photos of a part: {parallax:.0f}°.",
    )
    if weak > WEAK_SHARE:
        yield Finding(
            WARNING,
            f"{weak:.0%} of the scene is seen by fewer than {MIN_PHOTOS} photos. "
            "Expect blur and floaters there.",
            "Take more photos of these parts, from several sides.",
        )
    if flat > WEAK_SHARE:
        yield Finding(
            WARNING,
            f"{flat:.0%} of the scene is seen within {MIN_PARALLAX:.0f}° only, so its depth is uncertain. "
            "Expect good images near the photos only.",
            "Take photos from other positions.",
        )


def _groups(view: np.ndarray, point: np.ndarray, members: np.ndarray) -> list[list[int]]:
    """Return the groups of views that observations (O,) of shared points connect, the largest first.

    Args:
        members: views to divide into groups; others are left out.
    """
    order = np.lexsort((view, point))
    view, point = view[order], point[order]
    is_member = np.isin(view, members)
    view, point = view[is_member], point[is_member]
    pairs = np.unique(np.stack([view[:-1], view[1:]], axis=1)[point[:-1] == point[1:]], axis=0)
    parent = list(range(int(members.max(initial=0)) + 1))

    def root(number: int) -> int:
        while parent[number] != number:
            parent[number] = number = parent[parent[number]]
        return number

    for first, second in pairs.tolist():
        parent[root(first)] = root(second)
    groups: dict[int, list[int]] = {}
    for number in members.tolist():
        groups.setdefault(root(number), []).append(number)
    return sorted(groups.values(), key=len, reverse=True)


def _exposure(scene: Scene, exposure: float) -> Iterator[Finding]:
    """Find photos whose exposure or white balance differs from that of their neighbours."""
    try:
        from .exposures import exposure_gains
    except ImportError:
        return
    cameras = [camera for camera in scene.cameras if camera.name not in scene.distorted]
    gains = exposure_gains(scene, cameras, exposure)
    if gains:
        deviations = {name: float(np.abs(np.log(gain)).max()) for name, gain in gains.items()}
        worst = max(deviations, key=lambda name: deviations[name])
        yield Finding(
            WARNING,
            f"Exposure or white balance differs between photos, by {np.expm1(deviations[worst]):.0%} "
            f"in {worst}.",
            "Keep match_exposure enabled, or take photos with fixed exposure.",
        )
