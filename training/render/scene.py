"""Sets of splats, wherever they stand, as one picture: what every command and Blender's F12 draw with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch.nn.functional import normalize

from ..editing.look import Looks
from ..errors import LodgsError, is_out_of_memory
from ..lod.query import LodQuery
from ..rasterize import Gaussians, rasterize_strips
from ..rasterize.resident import SplatSet, WeightedSet, combine_visible
from ..scenes.cameras import Camera, check_render_size
from ..splats.sh import basis, degree_from_count
from ..splats.similarity import is_similarity
from .image import NO_DEPTH, RenderedImage

STRIP_PIXELS = 1 << 20
"""Pixels drawn between two calls of ``progress``."""

MAX_CONDITION = 1e6
"""A transform that stretches one direction so many times as much as another is refused."""


@dataclass
class Instance:
    """A set of splats in the world.

    Attributes:
        matrix: (4, 4) float64, from the set's coordinates to the world.
        level: number of the level of detail that it is; 0 where it is none.
        antialias: how it is drawn, see ``Bundle.antialias``.
        choice: by what its splats are weighted, on top of the set's own weights; None: by these alone.
        looks: what is made of its colours and opacities, places in the set's coordinates.
    """

    splats: SplatSet
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    level: int = 0
    antialias: bool = False
    choice: LodQuery | None = None
    looks: Looks = ()


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
    backend: str = "auto",
    progress: Callable[[float], bool] = lambda share: True,
) -> RenderedImage | None:
    """What a camera sees of splats, all sets sorted together.

    Sets that stand together under one rotation, uniform scale and translation are drawn in their own
    coordinates, so that it does not show, to the bit, where they stand. Else all are brought to the world.

    Args:
        near: depth in the world before which nothing is drawn.
        background: display-coded colour behind the splats; None leaves it transparent.
        depth: draw the pass as well.
        levels: as well, how much of each pixel every level fills.
        window: left, top, width and height in pixels of the part of the camera's image to draw; None: all.
        limit: (H, W) of the window, depths of meshes along the camera's z axis in the world, NOTHING where
            there are none: what lies behind is held out, the background as well.
        backend: rasterizer.
        progress: called with the share that is done; drawing is cancelled where it returns False.

    Returns:
        The picture, or None where it was cancelled.

    Raises:
        LodgsError: a set's transform is flat, the picture too large, or there is not enough memory.
    """
    width, height = window[2:] if window else (camera.width, camera.height)
    check_render_size(width, height)
    for one in instances:
        linear = one.matrix[:3, :3]
        if not np.isfinite(one.matrix).all() or np.linalg.cond(linear) > MAX_CONDITION or not linear.any():
            raise LodgsError("A set of splats is scaled to nothing.", "Give its object a scale above 0.")
    numbers = sorted({one.level for one in instances}) if levels else []
    try:
        picture = RenderedImage.empty(width, height, background, depth, numbers)
        behind = background or (0.0, 0.0, 0.0)
        if limit is not None:  # the background, too, is behind meshes: over black here, added elsewhere
            picture.image[limit < NO_DEPTH], picture.alpha[limit < NO_DEPTH] = 0, 0
            behind = 0.0, 0.0, 0.0
        instances = [
            replace(one, splats=one.splats.with_looks(one.looks)) for one in instances if len(one.splats)
        ]
        if not instances:
            return picture
        gaussians, rows, weights, counts, camera, near, unit = _in_one_frame(instances, camera, near)
        each = torch.tensor(counts, device=gaussians.means.device)
        features = _membership(instances, each, picture) if levels else None
        for top, drawn in rasterize_strips(
            gaussians, camera, rows=rows, weights=weights, background=behind, near=near,
            antialias=_filtered(instances, each),
            outputs=("depth", "median_depth") if depth else (), features=features, window=window,
            limit=None if limit is None else torch.from_numpy(limit / unit).to(gaussians.means),
            strip=STRIP_PIXELS, backend=backend,
        ):  # fmt: skip
            part = slice(top, top + len(drawn.alpha))
            alpha = drawn.alpha.cpu().numpy()
            kept = 0 if limit is None else (1 - alpha)[..., None] * picture.image[part]
            picture.image[part] = drawn.image.cpu().numpy() + kept
            picture.alpha[part] = np.maximum(picture.alpha[part], alpha)
            if depth:
                assert drawn.depth is not None and drawn.median_depth is not None
                seen = torch.where(drawn.median_depth > 0, drawn.median_depth, drawn.depth) * unit
                picture.depth[part] = torch.where(drawn.alpha > 0, seen, NO_DEPTH).cpu().numpy()
            if drawn.features is not None:
                picture.masks[:, part] = drawn.features.permute(2, 0, 1).cpu().numpy()
            if not progress((top + len(drawn.alpha)) / height):
                return None
    except Exception as error:
        if not is_out_of_memory(error):
            raise
        raise LodgsError(
            f"There is not enough memory to draw {sum(len(x.splats) for x in instances):,} splats "
            f"at {width}x{height}.",
            "Render a coarser level or a smaller picture.",
        ) from error
    return picture


def _in_one_frame(
    instances: list[Instance], camera: Camera, near: float
) -> tuple[Gaussians, torch.Tensor | None, torch.Tensor | None, list[int], Camera, float, float]:
    """Splats of all sets in one frame, which rows of them to look at (None: all), their weights (None: all
    1), and how many are of each set; the camera and its near depth in that frame, and how many units of the
    world one of its units is."""
    first = instances[0].matrix
    if is_similarity(first) and all(np.array_equal(one.matrix, first) for one in instances):
        camera, unit = camera.in_object_space(first)
        chosen = [WeightedSet(one.splats, one.choice) for one in instances]
        gaussians, rows, weights = combine_visible(chosen, camera, near / unit)
        return gaussians, rows, weights, [len(one.splats) for one in instances], camera, near / unit, unit
    there, weights = [], []
    for one in instances:
        inside, unit = camera.in_object_space(one.matrix) if is_similarity(one.matrix) else (None, 1.0)
        rows, weight = (
            torch.from_numpy(each) for each in one.splats.select_visible(one.choice, inside, near / unit)
        )
        there.append(_in_world(one, camera, rows.long()))
        weights.append(weight.to(there[-1].means))
    return Gaussians.concatenated(there), None, torch.cat(weights), list(map(len, there)), camera, near, 1.0


def _in_world(one: Instance, camera: Camera, some: torch.Tensor) -> Gaussians:
    """Some (M,) of a set's splats where its transform puts them, any affine one, in the colours that an eye
    sees: harmonics turn, shrink and lean with the set."""
    own = one.splats.gaussians
    some = some.to(own.means.device)
    placed, means, sh = one.splats.transformed(one.matrix).select(some), own.means[some], own.sh[some]
    eye = np.linalg.solve(one.matrix, np.append(camera.center, 1.0))[:3]
    directions = normalize(means - torch.as_tensor(eye).to(means), dim=1)
    values: list = [None] * sh.shape[1]
    x, y, z = directions.unbind(1)
    basis(x, y, z, degree_from_count(len(values)), values)
    colours = (0.5 + torch.einsum("kn,nkc->nc", torch.stack(values), sh)).clamp_min(0)
    return replace(placed, sh=colours)


def _filtered(instances: list[Instance], counts: torch.Tensor) -> bool | torch.Tensor:
    """Whether splats are antialiased: all or none, or (N,) of each where sets differ."""
    flags = [one.antialias for one in instances]
    if len(set(flags)) == 1:
        return flags[0]
    return torch.tensor(flags, device=counts.device).repeat_interleave(counts)


def _membership(instances: list[Instance], counts: torch.Tensor, picture: RenderedImage) -> torch.Tensor:
    """(N, L) with 1 where a splat is of a level of the picture's."""
    levels = torch.tensor(picture.levels, device=counts.device)
    of = torch.tensor([one.level for one in instances], device=counts.device)
    return (of[:, None] == levels).float().repeat_interleave(counts, 0)
