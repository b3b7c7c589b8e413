"""Up direction, extent and first view of splats whose cameras are unknown. numpy only."""

from __future__ import annotations

import numpy as np

from ..splats.gaussians import Splats
from ..splats.levels import Bundle
from ..splats.quats import rotation_matrices
from .cameras import Camera, look_at
from .ground import ground_plane

MIN_SPLATS = 1000
"""Minimum number of splats of a scene whose up direction and view are estimated."""
_MAX_SPLATS = 40_000
"""Number of splats used; larger sets are sampled at random."""
_MIN_LOGIT = -2.2
"""Minimum opacity of a visible splat, 0.1, before the sigmoid."""
_HOLLOW_RADIUS, _HOLLOW_SHARE = 0.35, 0.06
"""A scene is hollow, such as a room around the viewer, if its center is almost empty: less than this share of
its splats is within this fraction of its radius."""
_FURNISHED_SHARE, _CLOSED = 0.2, 0.95
"""A furnished room has more splats there, at most _FURNISHED_SHARE, and walls in most directions."""
_WALL_RADIUS, _WALL_CONE, _WALL_DIRECTIONS = 1.6, 0.995, 300
"""Maximum distance of walls from the center in radii, cosine of the angle that a splat covers, and number of
directions."""
_MIN_FLATNESS, _MAX_OBLONG, _MIN_GROUND = 2.2, 1.4, 0.05
"""Minimum flatness, maximum ratio of length to width, and minimum score of a ground that is not across -y.
Flatness is the mean spread of the splats, relative to the spread along the axis. A wall is more oblong."""
_MIN_ROOM_FLATNESS, _MAX_ROOM_OBLONG = 1.3, 2.0
"""The same limits for hollow scenes: rooms are higher than gardens."""
_MAX_SLOPE = 20.0
"""Maximum slope of such a ground in degrees."""
_OPPOSITE_FACTOR = 2.0
"""Minimum ratio of scores to prefer a ground that faces against the usual direction of its axis."""
_THIN_RATIO, _MIN_THIN = 1.0, 100
"""Minimum logarithmic ratio of the sizes of flat splats and needles, and minimum number of each."""
_ALONG = 0.97
"""Minimum cosine of the angle between an axis and the normal of a flat splat, or a needle, along it."""
_MIN_FACING, _FACING_FACTOR = 0.3, 3.0
"""Minimum share of flat splats that face z if z is up, and minimum ratio to the shares of x and y."""
_FAR_FACTOR = 2.5
"""Splats beyond this multiple of the median distance from the center are background."""
_NEAR_DEPTH = 0.01
"""Near depth of an overview, relative to the distance of its target."""
LARGE, NEAR, FAR = 0.5, 2.0, 20.0
"""Multiples of the radius: splats larger than LARGE and within NEAR of the center veil the subject. Splats
beyond FAR are outliers."""
_MAX_LARGE = 0.05
"""Maximum share of large splats to report; a scene with more consists of them."""
_AROUND, _INSIDE = (1.2, 1.6, 2.2), (0.15, 0.4, 0.7)
"""Distances of candidate viewpoints from the center in radii, outside an object and inside a hollow scene."""
_ROOM_DEPTH = 0.5
"""Depth in radii to which depths in views of a hollow scene are relative. Relative to the distance from the
center, views near the center would always seem to see farthest."""
_ELEVATIONS = np.radians([12.0, 25.0]), np.radians([0.0, 8.0])
"""Elevations of candidate viewpoints, outside an object and inside a hollow scene."""
_AZIMUTHS = 24
"""Number of directions of candidate viewpoints."""
_GRID = 32, 18
"""Columns and rows of the grid in which the depths of a candidate view are compared."""
_MIN_COVERAGE = 0.3
"""Minimum share of a cell of this grid that its splats cover; sparse outliers do not end a view."""
_TANGENT = 0.7
"""Half width of the view at depth 1: the default lens of Blender's viewports."""


def central_ball(means: np.ndarray, default: float = 1.0) -> tuple[np.ndarray, float]:
    """Return center (3,) and radius of a ball around the subject of a scene.

    It holds nine tenths of the splats, or those within 2.5 times the median distance from the median position
    if that is smaller, as in scenes with a far background.

    Args:
        means: (N, 3) finite positions, N > 0.
        default: radius if most splats are at one place.
    """
    means = means.astype(np.float64)
    distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    median, ninth_decile = np.percentile(distances, (50, 90))
    near = means[is_near(means)]
    return np.median(near, axis=0), float(min(ninth_decile, _FAR_FACTOR * median)) or default


def is_near(means: np.ndarray) -> np.ndarray:
    """Return a mask (N,) of the positions (N, 3), N > 0, that are not in the far background of a scene.

    They are within 2.5 times the median distance from the median position.
    """
    distances = np.linalg.norm(means - np.median(means, axis=0), axis=1)
    return distances <= _FAR_FACTOR * np.median(distances)


def guess_up_rotation(splats: Splats) -> np.ndarray | None:
    """Return a rotation (3, 3) float64 to z up; None if -y, the convention of 3DGS, is the best guess.

    Another axis (+y, +z or -z) is up if a clear ground lies across it, see ``ground.ground_plane``. Without a
    clear ground, as around a high building, +z is up if most flat splats face it and needles are along it.
    """
    sample = _sample(splats)
    if sample is None:
        return None
    center, radius = central_ball(sample.means)
    sample_near = sample.select(np.linalg.norm(sample.means - center, axis=1) < 2 * radius)
    points = sample_near.means.astype(np.float64)
    spreads = np.maximum(np.ptp(np.percentile(points, (10, 90), axis=0), axis=0), 1e-12)
    axis = int(spreads.argmin())
    width, depth = np.delete(spreads, axis)
    oblong = max(width, depth) / min(width, depth)
    hollow = _is_hollow(sample.means, center, radius)
    flatness = _MIN_ROOM_FLATNESS if hollow else _MIN_FLATNESS
    is_ground = spreads.mean() >= flatness * spreads[axis]
    if axis == 0 or not is_ground or oblong > (_MAX_ROOM_OBLONG if hollow else _MAX_OBLONG):
        return np.eye(3) if _is_upright(sample_near) else None
    usual = np.eye(3)[axis] * (-1 if axis == 1 else 1)
    grounds = [ground_plane(points, up, _MAX_SLOPE) for up in (usual, -usual)]
    scores = [ground[2] if ground else 0.0 for ground in grounds]
    if max(scores) < _MIN_GROUND:
        return np.eye(3) if _is_upright(sample_near) else None
    is_usual = scores[1] < _OPPOSITE_FACTOR * scores[0]
    if axis == 1:
        return None if is_usual else np.array([(1, 0, 0), (0, 0, -1), (0, 1, 0)], np.float64)
    return np.eye(3) if is_usual else np.diag([1.0, -1.0, -1.0])


def choose_view(splats: Splats, up: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the position (3,) and target (3,) of a view that shows a scene, float64; None for few splats.

    Candidates circle the center of the scene, or are inside a hollow one. The best one sees far, relative to
    its distance from the center or to the size of a hollow scene, and through few splats near to it.

    Args:
        up: (3,) unit up direction.
    """
    sample = _sample(splats)
    if sample is None:
        return None
    share = len(sample) / len(_visible_rows(splats))
    center, radius = central_ball(sample.means)
    log_sizes = np.minimum(np.sort(sample.log_scales, axis=1)[:, 1:], 80).mean(axis=1)
    sizes = np.exp(log_sizes.astype(np.float64))
    opacities = 1 / (1 + np.exp(-sample.opacity_logits.astype(np.float64)))
    hollow = _is_hollow(sample.means, center, radius)
    east = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    best, best_score = None, -1.0
    for distance in radius * np.array(_INSIDE if hollow else _AROUND):
        unit = _ROOM_DEPTH * radius if hollow else distance
        for elevation in _ELEVATIONS[int(hollow)]:
            for angle in np.linspace(0, 2 * np.pi, _AZIMUTHS, endpoint=False):
                across = np.cos(angle) * east + np.sin(angle) * north
                position = center + distance * (np.cos(elevation) * across + np.sin(elevation) * up)
                pose = look_at(position, center, up)
                score = _clarity(sample.means, sizes, opacities, pose, unit, share)
                if score > best_score:
                    best, best_score = position, score
    return None if best is None else (best, center)


def describe_clutter(splats: Splats) -> list[str]:
    """Return sentences with the numbers of splats that veil the subject, and of outliers; none for few."""
    rows = _visible_rows(splats)
    if len(rows) < MIN_SPLATS:
        return []
    means = splats.means[rows].astype(np.float64)
    center, radius = central_ball(means)
    distances = np.linalg.norm(means - center, axis=1)
    is_large = splats.log_scales[rows].max(axis=1) > np.log(LARGE * radius)
    large = int((is_large & (distances < NEAR * radius)).sum())
    far = int((distances > FAR * radius).sum())
    sentences = []
    if 0 < large < _MAX_LARGE * len(splats):
        sentences.append(
            f"{large:,} splats are larger than {LARGE * radius:.3g} and can veil the scene. To hide them: "
            "Clean Up > Find Clutter."
        )
    if far:
        sentences.append(
            f"{far:,} splats are more than {FAR * radius:.3g} away from the scene. To hide them: "
            "Clean Up > Find Clutter."
        )
    return sentences


def complete_meta(bundle: Bundle) -> None:
    """Estimate ``up_rotation`` and ``view`` of a bundle that lacks them and has no cameras."""
    levels = bundle.drawn_levels(bundle.levels[-1].number)
    splats = levels[0].splats if len(levels) == 1 else Splats.concatenated([level.splats for level in levels])
    if "up_rotation" not in bundle.meta and (rotation := guess_up_rotation(splats)) is not None:
        bundle.meta["up_rotation"] = rotation.tolist()
    if "view" not in bundle.meta and (view := choose_view(splats, bundle.up_rotation[2])) is not None:
        bundle.meta["view"] = [point.tolist() for point in view]


def overview_camera(bundle: Bundle, width: int) -> tuple[Camera, float]:
    """Return a camera that shows splats without known views, 16:9, and its near depth.

    Complete the bundle's meta, see :func:`complete_meta`. The camera's name is empty.

    Args:
        bundle: in memory.
        width: image width in pixels.
    """
    complete_meta(bundle)
    if "view" in bundle.meta:
        position, target = np.asarray(bundle.meta["view"], np.float64)
    else:
        means = bundle.levels[-1].splats.means
        target, radius = central_ball(means) if len(means) else (np.zeros(3), 1.0)
        position = target + 3 * radius * bundle.up_rotation.T @ (0.0, -1.0, 0.3)
    height, focal = width * 9 // 16, width / 2 / _TANGENT
    pose = look_at(position, target, bundle.up_rotation[2])
    camera = Camera("", width, height, focal, focal, width / 2, height / 2, pose)
    return camera, _NEAR_DEPTH * float(np.linalg.norm(target - position))


def _is_hollow(means: np.ndarray, center: np.ndarray, radius: float) -> bool:
    """Return True if a scene, given its means (N, 3), is around the viewer.

    It has few splats near its center, or some inside walls in all directions.
    """
    offsets = (means - center).astype(np.float64)
    distances = np.linalg.norm(offsets, axis=1)
    share = float((distances < _HOLLOW_RADIUS * radius).mean())
    if not _HOLLOW_SHARE <= share < _FURNISHED_SHARE:
        return share < _HOLLOW_SHARE
    walls = (distances > 1e-9) & (distances < _WALL_RADIUS * radius)
    directions = np.random.default_rng(0).normal(size=(_WALL_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cosines = (offsets[walls] / distances[walls, None]) @ directions.T
    return bool((cosines > _WALL_CONE).any(axis=0).mean() > _CLOSED)


def _is_upright(splats: Splats) -> bool:
    """Return True if most flat splats face z and more needles are along z than along x or y.

    The ground faces the vertical axis, and trunks, posts and edges of buildings are along it. Flat splats
    of a wall face another axis, but few needles are across the wall.
    """
    unit = splats.quats / np.maximum(np.linalg.norm(splats.quats, axis=1, keepdims=True), 1e-12)
    axes = np.moveaxis(rotation_matrices(unit), 0, -1)
    order, sizes = np.argsort(splats.log_scales, axis=1), np.sort(splats.log_scales, axis=1)

    def shares(column: int, thin: np.ndarray) -> np.ndarray:
        along = np.abs(axes[:, order[thin, column], thin]) > _ALONG
        return along.mean(axis=1)

    flat = np.flatnonzero(sizes[:, 1] - sizes[:, 0] > _THIN_RATIO)
    needles = np.flatnonzero(sizes[:, 2] - sizes[:, 1] > _THIN_RATIO)
    if min(len(flat), len(needles)) < _MIN_THIN:
        return False
    facing, along = shares(0, flat), shares(2, needles)
    is_ground = facing[2] >= max(_MIN_FACING, _FACING_FACTOR * facing[:2].max())
    return bool(is_ground and along.argmax() == 2)


def _clarity(
    means: np.ndarray,
    sizes: np.ndarray,
    opacities: np.ndarray,
    pose: np.ndarray,
    unit: float,
    share: float = 1.0,
) -> float:
    """Return the mean depth of the nearest splats over the view, relative to ``unit`` and at most 1.5.

    Splats near the camera reduce it by the share of the view that they cover. Cells of the grid that splats
    hardly cover count 0.3.

    Args:
        share: number of these splats relative to those of the scene.
    """
    local = means @ pose[:3, :3].T + pose[:3, 3]
    x, y, z = local.T
    width, height = _GRID
    tangents = _TANGENT, _TANGENT * height / width
    front = (z > 0.02 * unit) & (np.abs(x) < tangents[0] * z) & (np.abs(y) < tangents[1] * z)
    x, y, z, sizes, opacities = x[front], y[front], z[front], sizes[front], opacities[front]
    covered = opacities * np.minimum((2 * sizes / z) ** 2 * np.pi / (4 * tangents[0] * tangents[1]), 1)
    veil = float(covered[z < 0.4 * unit].sum())
    column = ((x / z / tangents[0] + 1) / 2 * width).astype(int).clip(0, width - 1)
    row = ((y / z / tangents[1] + 1) / 2 * height).astype(int).clip(0, height - 1)
    nearest, cell = np.full(width * height, np.inf), row * width + column
    np.minimum.at(nearest, cell, z)
    coverage = np.bincount(cell, covered, width * height) * width * height / share
    ratios = np.where(coverage >= _MIN_COVERAGE, np.minimum(nearest / unit, 1.5), 0.3)
    return float(ratios.mean() * np.exp(-veil))


def _sample(splats: Splats) -> Splats | None:
    """Return a random sample of the visible splats; None if there are few."""
    rows = _visible_rows(splats)
    if len(rows) < MIN_SPLATS:
        return None
    if len(rows) > _MAX_SPLATS:
        rows = np.sort(np.random.default_rng(0).choice(rows, _MAX_SPLATS, replace=False))
    return splats.select(rows)


def _visible_rows(splats: Splats) -> np.ndarray:
    """Return the indices (M,) of the splats with finite positions and sizes that are not transparent."""
    finite = np.isfinite(splats.means).all(axis=1) & np.isfinite(splats.log_scales).all(axis=1)
    return np.flatnonzero(finite & (splats.opacity_logits > _MIN_LOGIT))
