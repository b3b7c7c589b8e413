"""Rendering of several sets of splats, each with its own transform, into one image."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from torch.nn.functional import normalize

from ..editing.look import Looks
from ..errors import LodgsError, is_out_of_memory
from ..lod.query import LodQuery
from ..rasterize import Gaussians, Rendering, rasterize_strips
from ..rasterize.features import rotation_matrices
from ..rasterize.resident import SplatSet, WeightedSet, combine_visible
from ..scenes.cameras import Camera, check_render_size
from ..splats.sh import basis, degree_from_count
from ..splats.similarity import is_similarity
from .image import NO_DEPTH, RenderedImage

STRIP_PIXELS = 1 << 20
"""Approximate number of pixels between two calls of ``progress``."""

MAX_CONDITION = 1e6
"""Maximum ratio of the largest to the smallest scale of a transform."""


@dataclass
class Instance:
    """A set of splats in the world.

    Attributes:
        splats: the set.
        matrix: (4, 4) float64, from the set's coordinates to the world.
        level: level number of the set; 0 for none.
        antialias: see ``Bundle.antialias``.
        query: rule and arguments that weight the splats in addition to the set's own weights, or None.
        looks: changes of colours and opacities, in the set's coordinates.
        motion: the matrix at equal intervals of the shutter time (``blur``); empty for a set at rest.
    """

    splats: SplatSet
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    level: int = 0
    antialias: bool = False
    query: LodQuery | None = None
    looks: Looks = ()
    motion: tuple[np.ndarray, ...] = ()


@dataclass
class _Frame:
    """Splats of all instances in common coordinates.

    Attributes:
        gaussians: all N splats.
        rows: rows to draw, or None for all.
        weights: (N,), or None if all are 1.
        counts: number of splats of each instance.
        camera: camera in these coordinates.
        near: depth of the near plane in these coordinates.
        unit: world units per unit of these coordinates.
    """

    gaussians: Gaussians
    rows: torch.Tensor | None
    weights: torch.Tensor | None
    counts: list[int]
    camera: Camera
    near: float
    unit: float


def draw(
    instances: Sequence[Instance],
    camera: Camera,
    *,
    near: float = 0.01,
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
    depth: bool = False,
    levels: bool = False,
    window: tuple[int, int, int, int] | None = None,
    limit: np.ndarray | None = None,
    orthographic: float | None = None,
    backend: str = "auto",
    progress: Callable[[float], bool] = lambda share: True,
) -> RenderedImage | None:
    """Render all sets of splats, sorted together.

    Sets that share one similarity transform are drawn in their own coordinates, so the transform does not
    change a bit of the image. Otherwise all splats are transformed to the world.

    Args:
        near: depth of the near plane in the world.
        background: display-coded colour behind the splats; None is transparent.
        depth: draw the depth pass.
        levels: draw the share of each pixel that each level covers.
        window: left, top, width and height of the part of the image to draw in pixels; None means all.
        limit: (H, W) of the window, depth of meshes along the camera's z axis in the world, or NO_DEPTH;
            splats and background behind it are held out.
        orthographic: depth at which an orthographic camera and the pinhole camera show the same scale; None
            for a pinhole camera.
        backend: rasterizer backend.
        progress: receives the completed share; returning False cancels.

    Returns:
        The image, or None if drawing was cancelled.

    Raises:
        LodgsError: a set's transform is flat, the image is too large, or memory is insufficient.
    """
    width, height = window[2:] if window else (camera.width, camera.height)
    check_render_size(width, height)
    _check_transforms(instances)
    numbers = sorted({instance.level for instance in instances}) if levels else []
    instances = [instance for instance in instances if len(instance.splats)]
    with _memory_errors(instances, width, height):
        image = RenderedImage.empty(width, height, background, depth, numbers)
        back_color = background or (0.0, 0.0, 0.0)
        if limit is not None:  # meshes also hide the background, so it is added to unlimited pixels later
            image.image[limit < NO_DEPTH], image.alpha[limit < NO_DEPTH] = 0, 0
            back_color = 0.0, 0.0, 0.0
        if not instances:
            return image
        instances = [replace(item, splats=item.splats.with_looks(item.looks)) for item in instances]
        options = {"background": back_color, "window": window, "backend": backend}
        if orthographic is None:
            frame = _common_frame(instances, camera, near)
        else:
            frame = _orthographic_frame(instances, camera, near, orthographic)
        completed = _draw_strips(image, instances, frame, limit, progress, options)
    return image if completed else None


@contextmanager
def _memory_errors(instances: Sequence[Instance], width: int, height: int) -> Iterator[None]:
    """Report insufficient memory as an error with the numbers of splats and pixels."""
    try:
        yield
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise LodgsError(
            f"Cannot draw {sum(len(x.splats) for x in instances):,} splats at {width}x{height}: "
            "not enough memory.",
            "Render a coarser level or a smaller image.",
        ) from error


def _draw_strips(
    image: RenderedImage,
    instances: list[Instance],
    frame: _Frame,
    limit: np.ndarray | None,
    progress: Callable[[float], bool],
    options: dict[str, Any],
) -> bool:
    """Draw an image strip by strip. Return False if ``progress`` cancels it."""
    counts = torch.tensor(frame.counts, device=frame.gaussians.means.device)
    for top, strip in rasterize_strips(
        frame.gaussians, frame.camera, rows=frame.rows, weights=frame.weights, near=frame.near,
        antialias=_antialias_flags(instances, counts),
        outputs=("depth", "median_depth") if image.depth.size else (),
        features=_membership(instances, counts, image) if image.levels else None,
        limit=None if limit is None else torch.from_numpy(limit / frame.unit).to(frame.gaussians.means),
        strip=STRIP_PIXELS, **options,
    ):  # fmt: skip
        _copy_strip(image, top, strip, frame.unit, has_limit=limit is not None)
        if not progress((top + len(strip.alpha)) / len(image.alpha)):
            return False
    return True


def _check_transforms(instances: Sequence[Instance]) -> None:
    for instance in instances:
        linear = instance.matrix[:3, :3]
        is_flat = not np.isfinite(instance.matrix).all() or np.linalg.cond(linear) > MAX_CONDITION
        if is_flat or not linear.any():
            raise LodgsError(
                "Cannot draw a set of splats: its scale is 0.", "Give its object a scale above 0."
            )


def _copy_strip(image: RenderedImage, top: int, strip: Rendering, unit: float, has_limit: bool) -> None:
    """Copy a strip into an image, over the background that a limit leaves visible."""
    rows = slice(top, top + len(strip.alpha))
    alpha = strip.alpha.cpu().numpy()
    visible_background = (1 - alpha)[..., None] * image.image[rows] if has_limit else 0
    image.image[rows] = strip.image.cpu().numpy() + visible_background
    image.alpha[rows] = np.maximum(image.alpha[rows], alpha)
    if image.depth.size:
        assert strip.depth is not None and strip.median_depth is not None
        depth = torch.where(strip.median_depth > 0, strip.median_depth, strip.depth) * unit
        image.depth[rows] = torch.where(strip.alpha > 0, depth, NO_DEPTH).cpu().numpy()
    if strip.features is not None:
        image.masks[:, rows] = strip.features.permute(2, 0, 1).cpu().numpy()


def _common_frame(instances: list[Instance], camera: Camera, near: float) -> _Frame:
    """Bring all splats to the coordinates that they share, or else to the world."""
    first = instances[0].matrix
    if is_similarity(first) and all(np.array_equal(instance.matrix, first) for instance in instances):
        camera, unit = camera.in_object_space(first)
        sets = [WeightedSet(instance.splats, instance.query) for instance in instances]
        gaussians, rows, weights = combine_visible(sets, camera, near / unit)
        counts = [len(instance.splats) for instance in instances]
        return _Frame(gaussians, rows, weights, counts, camera, near / unit, unit)
    parts, part_weights = [], []
    for instance in instances:
        own_camera, unit = None, 1.0
        if is_similarity(instance.matrix):
            own_camera, unit = camera.in_object_space(instance.matrix)
        rows, weights = instance.splats.select_visible(instance.query, own_camera, near / unit)
        parts.append(_to_world(instance, camera, torch.from_numpy(rows).long()))
        part_weights.append(torch.from_numpy(weights).to(parts[-1].means))
    gaussians = Gaussians.concatenated(parts)
    return _Frame(gaussians, None, torch.cat(part_weights), list(map(len, parts)), camera, near, 1.0)


def _to_world(instance: Instance, camera: Camera, rows: torch.Tensor) -> Gaussians:
    """Transform rows (M,) of a set to the world, by any affine transform.

    The harmonics become constant colours, evaluated for the camera in the set's coordinates.
    """
    own = instance.splats.gaussians
    rows = rows.to(own.means.device)
    transformed = instance.splats.transformed(instance.matrix).select(rows)
    means, sh = own.means[rows], own.sh[rows]
    position = np.linalg.solve(instance.matrix, np.append(camera.center, 1.0))[:3]
    directions = normalize(means - torch.as_tensor(position).to(means), dim=1)
    return replace(transformed, sh=_colors(sh, directions))


def _colors(sh: torch.Tensor, directions: torch.Tensor) -> torch.Tensor:
    """Evaluate harmonics (M, K, 3) in unit directions (M, 3). Return colours (M, 3)."""
    values: list = [None] * sh.shape[1]
    x, y, z = directions.unbind(1)
    basis(x, y, z, degree_from_count(len(values)), values)
    return (0.5 + torch.einsum("kn,nkc->nc", torch.stack(values), sh)).clamp_min(0)


def _orthographic_frame(instances: list[Instance], camera: Camera, near: float, distance: float) -> _Frame:
    """Move all splats so that the pinhole camera sees the image of the orthographic camera.

    Splats become flat and face the camera. Their projection onto the image plane, depth and colour are exact.
    """
    parts, part_weights = [], []
    for instance in instances:
        rows, weights = instance.splats.select_visible(instance.query)
        part, visible = _to_orthographic(instance, camera, torch.from_numpy(rows).long(), near, distance)
        parts.append(part)
        part_weights.append(torch.from_numpy(weights).to(part.means)[visible])
    counts = list(map(len, parts))
    camera = replace(camera, world_to_camera=np.eye(4))
    return _Frame(Gaussians.concatenated(parts), None, torch.cat(part_weights), counts, camera, near, 1.0)


def _to_orthographic(
    instance: Instance, camera: Camera, rows: torch.Tensor, near: float, distance: float
) -> tuple[Gaussians, torch.Tensor]:
    """Return the flat splats of rows (M,) of a set that lie behind the near plane, and their mask (M,)."""
    own = instance.splats.gaussians
    own = own.select(rows.to(own.means.device))
    to_camera = torch.from_numpy(camera.world_to_camera @ instance.matrix).to(own.means.device)
    positions = own.means.double() @ to_camera[:3, :3].T + to_camera[:3, 3]
    visible = positions[:, 2] > near
    own, positions = own.select(visible), positions[visible]
    axes = to_camera[:2, :3] @ rotation_matrices(own.quats.double()) * own.log_scales.double().exp()[:, None]
    covariance = axes @ axes.mT
    a, b, c = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    radius = torch.hypot((a - c) / 2, b)
    variances = torch.stack([(a + c) / 2 + radius, (a + c) / 2 - radius], 1).clamp_min(1e-60)
    half_angle = torch.atan2(2 * b, a - c) / 4
    zero = torch.zeros_like(half_angle)
    share = positions[:, 2:] / distance
    lengths = torch.cat([variances.sqrt() * share, zero[:, None] + 1e-30], 1)
    direction = np.linalg.solve(instance.matrix[:3, :3], camera.world_to_camera[2, :3])
    directions = torch.from_numpy(direction / np.linalg.norm(direction)).to(own.means).expand(len(own), 3)
    return replace(
        own,
        means=torch.cat([positions[:, :2] * share, positions[:, 2:]], 1).float(),
        quats=torch.stack([half_angle.cos(), zero, zero, half_angle.sin()], 1).float(),
        log_scales=lengths.log().float(),
        sh=_colors(own.sh, directions),
    ), visible


def _antialias_flags(instances: list[Instance], counts: torch.Tensor) -> bool | torch.Tensor:
    """Return one flag for all splats, or flags (N,) if instances differ."""
    flags = [instance.antialias for instance in instances]
    if len(set(flags)) == 1:
        return flags[0]
    return torch.tensor(flags, device=counts.device).repeat_interleave(counts)


def _membership(instances: list[Instance], counts: torch.Tensor, image: RenderedImage) -> torch.Tensor:
    """Return (N, L) with 1 where a splat belongs to one of the image's levels."""
    levels = torch.tensor(image.levels, device=counts.device)
    splat_levels = torch.tensor([instance.level for instance in instances], device=counts.device)
    return (splat_levels[:, None] == levels).float().repeat_interleave(counts, 0)
