"""Sets of splats, wherever they stand, as one picture: what every command and Blender's F12 draw with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize, pad

from ..errors import LodgsError, out_of_memory
from ..rasterize import Gaussians, device_of, strips
from ..rasterize.features import rotation_matrices
from ..rasterize.sh import basis, degree_of
from ..scenes.cameras import Camera, check_size
from ..splats.gaussians import Splats
from .picture import NOTHING, Picture

STRIP = 1 << 20
"""Pixels drawn between two calls of ``progress``."""

FLAT = 1e6
"""A transform that stretches one direction so many times as much as another is refused."""


class SplatSet:
    """Splats where a backend draws them; kept from frame to frame while they are the same.

    Args:
        splats: in the set's own coordinates.
        weights: (N,) on the opacities; None: ones.
        backend: rasterizer.

    Attributes:
        gaussians, weights: the same, on the backend's device.
    """

    def __init__(self, splats: Splats, weights: np.ndarray | None = None, backend: str = "auto") -> None:
        device = device_of(backend)
        self.gaussians = Gaussians.of(splats, device)
        weights = np.ones(len(splats), np.float32) if weights is None else weights
        self.weights = torch.as_tensor(weights, dtype=torch.float32, device=device)
        self._in_world: tuple[bytes, Gaussians] | None = None
        self._joined: tuple[list[SplatSet], Gaussians] | None = None

    def __len__(self) -> int:
        return len(self.gaussians)

    def in_world(self, matrix: np.ndarray) -> Gaussians:
        """The splats where a transform (4, 4) puts them, any affine one; their harmonics stay the set's."""
        key = matrix.tobytes()
        if self._in_world is None or self._in_world[0] != key:
            self._in_world = key, self._transformed(torch.from_numpy(matrix))
        return self._in_world[1]

    def joined(self, others: list[SplatSet]) -> Gaussians:
        """These splats and those of other sets as one, kept as long as these are the others.

        All of them are parts of it then, so that nothing is there twice.
        """
        if not others:
            return self.gaussians
        if self._joined is None or self._joined[0] != others:
            sets = [self, *others]
            most = max(one.gaussians.sh.shape[1] for one in sets)
            whole = Gaussians.concatenated([
                replace(one.gaussians, sh=pad(one.gaussians.sh, (0, 0, 0, most - one.gaussians.sh.shape[1])))
                for one in sets
            ])  # fmt: skip
            if self in others:  # drawn twice at one place
                return whole
            begin = 0
            for one in sets:
                end = begin + len(one)
                one.gaussians, begin = whole.select(slice(begin, end)), end
            self._joined = others, whole
        return self._joined[1]

    def _transformed(self, matrix: torch.Tensor) -> Gaussians:
        own = self.gaussians
        matrix = matrix.to(own.means.device)
        linear = matrix[:3, :3]
        means = (own.means.double() @ linear.T + matrix[:3, 3]).float()
        turned, lengths = rotation_matrices(own.quats.double()), own.log_scales.double().exp()
        if similarity(matrix.cpu().numpy()):
            unit = torch.linalg.det(linear) ** (1 / 3)
            turned, lengths = linear @ turned / unit, lengths * unit
        else:
            # an ellipsoid's axes A = L Q diag(s) stay no axes then: those of A Aᵀ are
            turned, lengths, _ = torch.linalg.svd(linear @ turned * lengths[:, None])
            turned = turned * torch.linalg.det(turned).sign()[:, None, None]
        quats = Rotation.from_matrix(turned.cpu().numpy()).as_quat()[:, [3, 0, 1, 2]]
        return replace(
            own,
            means=means,
            quats=torch.from_numpy(quats).to(means),
            log_scales=lengths.clamp_min(1e-30).log().float(),
        )

    def colours(self, matrix: np.ndarray, eye: np.ndarray, some: torch.Tensor) -> torch.Tensor:
        """Colours (M, 3) of ``some`` (M,) that an eye in the world sees: harmonics turn, shrink and lean with
        the set."""
        own = np.linalg.solve(matrix, np.append(eye, 1.0))[:3]
        means, sh = self.gaussians.means[some], self.gaussians.sh[some]
        directions = normalize(means - torch.as_tensor(own).to(means), dim=1)
        values: list = [None] * sh.shape[1]
        x, y, z = directions.unbind(1)
        basis(x, y, z, degree_of(len(values)), values)
        return (0.5 + torch.einsum("kn,nkc->nc", torch.stack(values), sh)).clamp_min(0)


@dataclass
class Instance:
    """A set of splats in the world.

    Attributes:
        matrix: (4, 4) float64, from the set's coordinates to the world.
        level: number of the level of detail that it is; 0 where it is none.
        antialias: how it is drawn, see ``Bundle.antialias``.
        weights: (N,) of its splats here; None: the set's own.
    """

    splats: SplatSet
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    level: int = 0
    antialias: bool = False
    weights: np.ndarray | None = None


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
) -> Picture | None:
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
    check_size(width, height)
    for one in instances:
        linear = one.matrix[:3, :3]
        if not np.isfinite(one.matrix).all() or np.linalg.cond(linear) > FLAT or not linear.any():
            raise LodgsError("A set of splats is scaled to nothing.", "Give its object a scale above 0.")
    numbers = sorted({one.level for one in instances}) if levels else []
    try:
        picture = Picture.empty(width, height, background, depth, numbers)
        behind = background or (0.0, 0.0, 0.0)
        if limit is not None:  # the background, too, is behind meshes: over black here, added elsewhere
            picture.image[limit < NOTHING], picture.alpha[limit < NOTHING] = 0, 0
            behind = 0.0, 0.0, 0.0
        instances = [one for one in instances if len(one.splats)]
        if not instances:
            return picture
        gaussians, weights, camera, near, unit = _in_one_frame(instances, camera, near)
        features = _membership(instances, weights, picture) if levels else None
        for top, drawn in strips(
            gaussians, camera, weights=torch.cat(weights), background=behind, near=near,
            antialias=_filtered(instances, weights),
            outputs=("depth", "median_depth") if depth else (), features=features, window=window,
            limit=None if limit is None else torch.from_numpy(limit / unit).to(gaussians.means),
            strip=STRIP, backend=backend,
        ):  # fmt: skip
            rows = slice(top, top + len(drawn.alpha))
            alpha = drawn.alpha.cpu().numpy()
            kept = 0 if limit is None else (1 - alpha)[..., None] * picture.image[rows]
            picture.image[rows] = drawn.image.cpu().numpy() + kept
            picture.alpha[rows] = np.maximum(picture.alpha[rows], alpha)
            if depth:
                assert drawn.depth is not None and drawn.median_depth is not None
                seen = torch.where(drawn.median_depth > 0, drawn.median_depth, drawn.depth) * unit
                picture.depth[rows] = torch.where(drawn.alpha > 0, seen, NOTHING).cpu().numpy()
            if drawn.features is not None:
                picture.masks[:, rows] = drawn.features.permute(2, 0, 1).cpu().numpy()
            if not progress((top + len(drawn.alpha)) / height):
                return None
    except Exception as error:
        if not out_of_memory(error):
            raise
        raise LodgsError(
            f"There is not enough memory to draw {sum(len(x.splats) for x in instances):,} splats "
            f"at {width}x{height}.",
            "Render a coarser level or a smaller picture.",
        ) from error
    return picture


def similarity(matrix: np.ndarray) -> bool:
    """Whether a transform (4, 4) is a rotation, one scale for all axes, and a translation."""
    linear = matrix[:3, :3]
    square = linear.T @ linear
    scale = np.trace(square) / 3
    return np.linalg.det(linear) > 0 and bool(np.abs(square / scale - np.eye(3)).max() < 1e-5)


def _in_one_frame(
    instances: list[Instance], camera: Camera, near: float
) -> tuple[Gaussians, list[torch.Tensor], Camera, float, float]:
    """Splats of all sets in one frame, and each set's weights; the camera and its near depth in that frame,
    and how many units of the world one of its units is."""
    first = instances[0].matrix
    together = similarity(first) and all(np.array_equal(one.matrix, first) for one in instances)
    sets = [one.splats for one in instances]
    weights = [
        one.splats.weights if one.weights is None else torch.as_tensor(one.weights).to(one.splats.weights)
        for one in instances
    ]
    if together:
        camera, unit = camera.within(first)
        return sets[0].joined(sets[1:]), weights, camera, near / unit, unit
    drawn = [(weight > 0).nonzero()[:, 0] for weight in weights]
    there = [
        replace(
            one.splats.in_world(one.matrix).select(some),
            sh=one.splats.colours(one.matrix, camera.center, some),
        )
        for one, some in zip(instances, drawn, strict=True)
    ]
    left = [weight[some] for weight, some in zip(weights, drawn, strict=True)]
    return Gaussians.concatenated(there), left, camera, near, 1.0


def _filtered(instances: list[Instance], weights: list[torch.Tensor]) -> bool | torch.Tensor:
    """Whether splats are antialiased: all or none, or (N,) of each where sets differ."""
    flags = {one.antialias for one in instances}
    if len(flags) == 1:
        return flags.pop()
    each = zip(instances, weights, strict=True)
    return torch.cat([torch.full_like(weight, one.antialias).bool() for one, weight in each])


def _membership(instances: list[Instance], weights: list[torch.Tensor], picture: Picture) -> torch.Tensor:
    """(N, L) with 1 where a splat is of a level of the picture's."""
    levels = torch.tensor(picture.levels, device=weights[0].device)
    of = torch.cat([torch.full_like(each, one.level) for one, each in zip(instances, weights, strict=True)])
    return (of[:, None] == levels).float()
