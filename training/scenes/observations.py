"""Observations of a scene's points: which points a view sees, at which pixels, and how well they agree."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from .colmap import Scene, read_registered
from .colmap_model import read_observations

_MAX_OBSERVATIONS = 2000
"""Maximum number of a view's observations whose error is measured."""
_SMALLER = 0.75
"""Fraction of the image sides below which all pixels lie if they are those of a smaller photo."""
_CENTRAL = 0.25
"""Distance from the principal point up to which distortion hardly moves points, in image diagonals."""


def observations(scene: Scene, names: Collection[str]) -> dict[str, np.ndarray]:
    """Return the indices (O,) of the scene points that the model records as observed, by view name.

    The result is empty if the model has no observations of the scene's points.
    """
    indices = {name: points for name, (points, _) in observed_pixels(scene, names).items()}
    return indices if any(map(len, indices.values())) else {}


def observed_pixels(
    scene: Scene, names: Collection[str], limit: int = 0
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the points that views observe and their pixels, by view name.

    Args:
        limit: maximum number of evenly spaced observations of a view; 0 for all.

    Returns:
        Indices (O,) of scene points, and pixels (O, 2) in the photos of the model.
    """
    if not len(scene.point_ids):
        return {}
    order = np.argsort(scene.point_ids)
    sorted_ids = scene.point_ids[order]
    observed = {}
    for name, records in read_observations(scene.point_model or scene.model, names).items():
        records = records[:: len(records) // limit + 1 if limit else 1]
        slots = np.searchsorted(sorted_ids, records["point"]).clip(max=len(order) - 1)
        known = sorted_ids[slots] == records["point"]
        observed[name] = order[slots[known]], records["xy"][known]
    return observed


def reprojection_errors(scene: Scene, names: Collection[str]) -> dict[str, float]:
    """Return the median reprojection error of views, as a fraction of the image diagonal, by name.

    Points behind the camera have an infinite error. Only observations near the principal point count, so that
    distortion hardly matters. Views without such observations, of fisheye lenses, or with pixels of
    larger or smaller photos are left out.
    """
    lenses, poses = read_registered(scene.point_model or scene.model, [])
    views = {pose.name.replace("\\", "/"): pose for pose in poses}
    errors = {}
    for name, (indices, pixels) in observed_pixels(scene, names, _MAX_OBSERVATIONS).items():
        lens = lenses[views[name].camera_id]
        size = np.array([lens.width, lens.height])
        of_larger = 10 * (pixels > size).any(axis=1).sum() > len(pixels)
        of_smaller = (pixels < _SMALLER * size).all()
        if not lens.lens.perspective or of_larger or of_smaller:
            continue
        fx, fy, cx, cy = lens.pinhole
        diagonal = np.hypot(*size)
        central = np.linalg.norm(pixels - (cx, cy), axis=1) < _CENTRAL * diagonal
        if not central.any():
            continue
        pose = views[name].world_to_camera
        local = (scene.points[indices[central]] + scene.origin) @ pose[:3, :3].T + pose[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            offsets = local[:, :2] / local[:, 2:] * (fx, fy) + (cx, cy) - pixels[central]
        distances = np.where(local[:, 2] > 0, np.linalg.norm(offsets, axis=1), np.inf)
        errors[name] = float(np.median(distances) / diagonal)
    return errors


def observed_points(scene: Scene, names: Collection[str]) -> np.ndarray:
    """Return a mask (P,) of the scene points that the named views observe.

    Without observations in the model, a point counts as observed if it projects into one of the images.
    """
    mask = np.zeros(len(scene.points), bool)
    for indices in observations(scene, names).values():
        mask[indices] = True
    if not mask.any():
        for camera in scene.cameras:
            if camera.name in names:
                mask |= camera.sees(scene.points)
    return mask
