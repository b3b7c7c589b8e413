"""Sets of splats, wherever they stand, as one picture: what every command and Blender's F12 draw with."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch.nn.functional import normalize

from ..errors import LodgsError
from ..rasterize import device_of, strips
from ..rasterize.features import rotation_matrices
from ..rasterize.sh import basis, degree_of
from ..scenes.cameras import Camera
from ..splats.gaussians import Splats
from .picture import NOTHING, Picture

STRIP = 1 << 20
"""Pixels drawn between two looks at whether the picture is still wanted."""

FLAT = 1e6
"""A transform that stretches one direction so many times as much as another is refused."""

Columns = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


class SplatSet:
    """Splats where a backend draws them; kept from frame to frame while they are the same.

    Args:
        splats: in the set's own coordinates.
        weights: (N,) on the opacities; None: ones.
        backend: rasterizer.
    """

    def __init__(self, splats: Splats, weights: np.ndarray | None = None, backend: str = "auto") -> None:
        device = device_of(backend)

        def tensor(column: np.ndarray) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(column, np.float32)).to(device)

        self.means, self.quats, self.log_scales, self.opacity_logits, self.sh = map(
            tensor,
            (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh),
        )
        self.weights = tensor(np.ones(len(splats), np.float32) if weights is None else weights)
        self._there: tuple[bytes, tuple[torch.Tensor, torch.Tensor, torch.Tensor]] | None = None

    def __len__(self) -> int:
        return len(self.means)

    def in_world(self, matrix: np.ndarray) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Means, quats and log-scales where a transform (4, 4) puts them, any affine one."""
        key = matrix.tobytes()
        if self._there is None or self._there[0] != key:
            self._there = key, self._moved(torch.from_numpy(matrix))
        return self._there[1]

    def _moved(self, matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        matrix = matrix.to(self.means.device)
        linear = matrix[:3, :3]
        means = (self.means.double() @ linear.T + matrix[:3, 3]).float()
        # an ellipsoid's axes A = L Q diag(s) stay no axes where L is no similarity: those of A Aᵀ are
        axes = linear @ rotation_matrices(self.quats.double()) * self.log_scales.double().exp()[:, None]
        if similarity(matrix.cpu().numpy()):
            lengths = axes.norm(dim=1).clamp_min(1e-30)
            turned = axes / lengths[:, None]
        else:
            turned, lengths, _ = torch.linalg.svd(axes)
            turned = turned * torch.linalg.det(turned).sign()[:, None, None]
        quats = Rotation.from_matrix(turned.cpu().numpy()).as_quat()[:, [3, 0, 1, 2]]
        return means, torch.from_numpy(quats).to(means), lengths.log().float()

    def colours(self, matrix: np.ndarray, eye: np.ndarray) -> torch.Tensor:
        """Colours (N, 3) that an eye in the world sees: harmonics turn, shrink and lean with the set."""
        own = np.linalg.solve(matrix, np.append(eye, 1.0))[:3]
        directions = normalize(self.means - torch.as_tensor(own).to(self.means), dim=1)
        values: list = [None] * self.sh.shape[1]
        x, y, z = directions.unbind(1)
        basis(x, y, z, degree_of(len(values)), values)
        return (0.5 + torch.einsum("kn,nkc->nc", torch.stack(values), self.sh)).clamp_min(0)


@dataclass
class Placed:
    """A set of splats in the world.

    Attributes:
        matrix: (4, 4) float64, from the set's coordinates to the world.
        level: number of the level of detail that it is; 0 where it is none.
    """

    splats: SplatSet
    matrix: np.ndarray = field(default_factory=lambda: np.eye(4))
    level: int = 0


def draw(
    placed: Sequence[Placed],
    camera: Camera,
    *,
    near: float = 0.01,
    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0),
    depth: bool = False,
    levels: bool = False,
    window: tuple[int, int, int, int] | None = None,
    limit: np.ndarray | None = None,
    backend: str = "auto",
    wanted: Callable[[float], bool] = lambda share: True,
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
        wanted: told the share that is done from time to time; False ends it.

    Returns:
        The picture, or None where it was no longer wanted.

    Raises:
        LodgsError: a set's transform is flat, or there is not enough memory.
    """
    for one in placed:
        linear = one.matrix[:3, :3]
        if not np.isfinite(one.matrix).all() or np.linalg.cond(linear) > FLAT or not linear.any():
            raise LodgsError("A set of splats is scaled to nothing.", "Give its object a scale above 0.")
    width, height = window[2:] if window else (camera.width, camera.height)
    numbers = sorted({one.level for one in placed}) if levels else []
    picture = Picture.empty(width, height, background, depth, numbers)
    behind = background or (0.0, 0.0, 0.0)
    if limit is not None:  # the background, too, is behind meshes: drawn over black, it is added elsewhere
        picture.image[limit < NOTHING], picture.alpha[limit < NOTHING] = 0, 0
        behind = 0.0, 0.0, 0.0
    some = [one for one in placed if len(one.splats)]
    if not some:
        return picture
    try:
        columns, weights, camera, near, unit = _in_one_frame(some, camera, near)
        features = _membership(some, picture) if levels else None
        for top, drawn in strips(
            *columns, camera, weights=weights, background=behind, near=near,
            outputs=("depth", "median_depth") if depth else (), features=features, window=window,
            limit=None if limit is None else torch.from_numpy(limit / unit).to(columns[0]),
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
            if not wanted((top + len(drawn.alpha)) / height):
                return None
    except (MemoryError, torch.cuda.OutOfMemoryError) as error:
        raise LodgsError(
            f"There is not enough memory to draw {sum(len(x.splats) for x in some):,} splats "
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
    placed: list[Placed], camera: Camera, near: float
) -> tuple[Columns, torch.Tensor, Camera, float, float]:
    """Columns and weights of all sets in one frame; the camera and its near depth in that frame, and how
    many units of the world one of its units is."""
    first = placed[0].matrix
    together = similarity(first) and all(np.array_equal(one.matrix, first) for one in placed)
    sets = [one.splats for one in placed]
    weights = torch.cat([one.weights for one in sets])
    logits = torch.cat([one.opacity_logits for one in sets])
    if together:
        camera, unit = camera.within(first)
        shape = [torch.cat([getattr(one, name) for one in sets]) for name in ("means", "quats", "log_scales")]
        most = max(one.sh.shape[1] for one in sets)
        colours = torch.cat(
            [torch.nn.functional.pad(one.sh, (0, 0, 0, most - one.sh.shape[1])) for one in sets]
        )
        return (*shape, logits, colours), weights, camera, near / unit, unit  # type: ignore[return-value]
    there = [one.splats.in_world(one.matrix) for one in placed]
    shape = [torch.cat(column) for column in zip(*there, strict=True)]
    colours = torch.cat([one.splats.colours(one.matrix, camera.center) for one in placed])
    return (*shape, logits, colours), weights, camera, near, 1.0  # type: ignore[return-value]


def _membership(placed: list[Placed], picture: Picture) -> torch.Tensor:
    """(N, L) with 1 where a splat is of a level of the picture's."""
    device = placed[0].splats.means.device
    levels = torch.tensor(picture.levels, device=device)
    of = torch.cat([torch.full((len(one.splats),), one.level, device=device) for one in placed])
    return (of[:, None] == levels).float()
