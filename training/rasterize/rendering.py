"""What every backend shares: the constants of the definition, the view, the rendering and the target."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from ..scenes.cameras import Camera

DILATION = 0.3
"""Added to the variance of each projected splat, in square pixels (3DGS's low-pass filter)."""
OUTPUTS = ("depth", "inverse_depth", "median_depth", "normals", "absgrad2d")
"""What can be asked for besides the image and its alpha."""
ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
"""A splat adds nothing to a pixel where its alpha is below this."""
TRANSMITTANCE_MIN = 1e-4
"""The splat that would bring a pixel's transmittance to this or below is not blended, nor any behind it."""
FRUSTUM_MARGIN = 0.3
"""The projection's Jacobian is taken no further outside the image than this times half its width (height)."""


@dataclass(frozen=True)
class KernelCamera:
    """A camera as the kernels take it: numbers only.

    Attributes:
        rotation, translation: world to camera, (3, 3) and (3,) float64.
        eye: camera centre in the world, (3,) float64.
        fx, fy, cx, cy: intrinsics in pixels, pixel centres at +0.5.
        x_limits, y_limits: range of x/z and of y/z in which the Jacobian is evaluated.
        near: depth at or under which a splat is not drawn, in world units.
    """

    width: int
    height: int
    rotation: np.ndarray
    translation: np.ndarray
    eye: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    x_limits: tuple[float, float]
    y_limits: tuple[float, float]
    near: float

    @classmethod
    def of(cls, camera: Camera, near: float, window: tuple[int, int, int, int] | None = None) -> KernelCamera:
        """The whole image, or the part of it that a window (left, top, width, height) shows."""
        left, top, width, height = window or (0, 0, camera.width, camera.height)
        margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
        margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
        return cls(
            width=width,
            height=height,
            rotation=camera.world_to_camera[:3, :3],
            translation=camera.world_to_camera[:3, 3],
            eye=camera.center,
            fx=camera.fx,
            fy=camera.fy,
            cx=camera.cx - left,
            cy=camera.cy - top,
            x_limits=(-camera.cx / camera.fx - margin_x, (camera.width - camera.cx) / camera.fx + margin_x),
            y_limits=(-camera.cy / camera.fy - margin_y, (camera.height - camera.cy) / camera.fy + margin_y),
            near=near,
        )


@dataclass(frozen=True)
class RasterSettings:
    """What a backend is told besides tensors of splats; see :func:`training.rasterize.rasterize`.

    Attributes:
        degree: of the harmonics to draw with.
        median, absolute: whether ``BackendOutput.median`` and ``BackendOutput.absgrad2d`` are wanted.
        rows: (M,) int32, those that are looked at; None: all.
    """

    view: KernelCamera
    min_scale: float
    antialias: bool | torch.Tensor
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    degree: int = 0
    median: bool = False
    absolute: bool = False
    limit: torch.Tensor | None = None
    rows: torch.Tensor | None = None

    def weights(self, weights: torch.Tensor | None, like: torch.Tensor) -> torch.Tensor | None:
        """The weights (N,) with those of rows that are not looked at 0, for backends that look at all."""
        if self.rows is None:
            return weights
        looked_at = torch.zeros_like(like[:, 0]).index_fill_(0, self.rows.long(), 1)
        return looked_at if weights is None else weights * looked_at


@dataclass
class Rendering:
    """What a camera sees.

    Attributes:
        image: (H, W, 3), colours over the background; not clamped.
        alpha: (H, W), one minus the transmittance left behind the last splat.
        radii: (N,) float32, three standard deviations along the longest axis of the projected splat, in
            pixels; 0 for a splat that is not drawn.
        grad2d: (N, 2) float32, zeros until ``backward`` has run: the loss's gradient by the projected mean,
            in the units of 3DGS's densification threshold (per pixel, times half the image's width and
            height). Backward runs that follow overwrite it.
        tile_counts: (ceil(H / 16), ceil(W / 16)) int64, how many splats each tile of 16x16 pixels has to look
            at (LODGE's measure of what a picture costs).
        absgrad2d: (N, 2), on request: as grad2d, with the absolute values of the pixels' shares of image and
            alpha summed (AbsGS, Ye et al. 2024).
        depth: (H, W), on request: mean depth of what a pixel shows, Σ w z / Σ w, 0 where alpha is 0.
        inverse_depth: (H, W), on request: Σ w / z, 0 where nothing is.
        median_depth: (H, W), on request: depth of the splat that brings the transmittance to a half or below,
            0 where none does.
        normals: (H, W, 3), on request: Σ w n in camera coordinates, n the unit vector of a splat's shortest
            axis that faces the camera; not normalised.
        features: (H, W, F), of the features given: Σ w f.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    radii: torch.Tensor
    grad2d: torch.Tensor
    tile_counts: torch.Tensor
    absgrad2d: torch.Tensor | None = None
    depth: torch.Tensor | None = None
    inverse_depth: torch.Tensor | None = None
    median_depth: torch.Tensor | None = None
    normals: torch.Tensor | None = None
    features: torch.Tensor | None = None


@dataclass
class Contributions:
    """What each splat gave to the pixels of one or more views; w = alpha T is its weight in a pixel.

    Attributes:
        largest: (N,), the largest w (the importance of RadSplat and LODGE).
        total: (N,), Σ w over pixels (LightGaussian's blended opacity).
        pixels: (N,) int64, in how many pixels w > 0 (LightGaussian's hits).
        views: (N,) int64, in how many views it was drawn.
        radius: (N,), the largest of :attr:`Rendering.radii`.
    """

    largest: torch.Tensor
    total: torch.Tensor
    pixels: torch.Tensor
    views: torch.Tensor
    radius: torch.Tensor


@dataclass
class SideOutputs:
    """What a backend for the CPU's tensors fills in besides what autograd differentiates, see BackendOutput."""

    radii: torch.Tensor
    grad2d: torch.Tensor
    absgrad2d: torch.Tensor | None
    median: torch.Tensor | None
    tile_counts: torch.Tensor

    @classmethod
    def of(cls, count: int, settings: RasterSettings, tile: int) -> SideOutputs:
        """Those of N splats, to be filled, with tiles of so many pixels a side."""
        height, width = settings.view.height, settings.view.width
        return cls(
            radii=torch.zeros(count),
            grad2d=torch.zeros(count, 2) if torch.is_grad_enabled() else torch.zeros(1, 2).expand(count, 2),
            absgrad2d=torch.zeros(count, 2) if settings.absolute else None,
            median=torch.full((height, width), -1, dtype=torch.int32) if settings.median else None,
            tile_counts=torch.empty(-(-height // tile), -(-width // tile), dtype=torch.int64),
        )


def require_plain(tensors: Iterable[torch.Tensor], backend: str) -> None:
    """Raises ValueError unless tensors are float32 on the CPU, as a backend by this name takes them."""
    for tensor in tensors:
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"the {backend} backend takes float32 on the CPU, not {tensor.dtype} on {tensor.device}"
            )


class BackendOutput(NamedTuple):
    """What a backend returns: a :class:`Rendering` before its outputs are named.

    Attributes:
        features: (H, W, F), the features given, blended over zero.
        median: (H, W) int32, the splat that brings the transmittance to a half or below, -1 where none does;
            None where it was not asked for.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    radii: torch.Tensor
    grad2d: torch.Tensor
    tile_counts: torch.Tensor
    absgrad2d: torch.Tensor | None
    features: torch.Tensor
    median: torch.Tensor | None


class Target:
    """A photograph to compare with, and what a backend keeps about it between steps.

    Args:
        image: (H, W, 3) float32 in [0, 1], torch or numpy.
        mask: (H, W) in [0, 1], how much each pixel counts in the loss; None: all do.
        alpha: (H, W) in [0, 1], of a photograph that is transparent, over black; None: it is opaque.
        inverse_depth: (H, W), what the view should show as ``Rendering.inverse_depth``, NaN where that is not
            known; None: it is known nowhere.

    The cpu backend keeps 36 bytes a pixel: the photograph and its two local moments. Drop the target and make
    it anew where a scene has more views than memory.
    """

    def __init__(
        self,
        image: torch.Tensor | np.ndarray,
        mask: torch.Tensor | np.ndarray | None = None,
        alpha: torch.Tensor | np.ndarray | None = None,
        inverse_depth: torch.Tensor | np.ndarray | None = None,
    ) -> None:
        self.image = torch.as_tensor(image)
        self.mask = None if mask is None else torch.as_tensor(mask)
        self.alpha = None if alpha is None else torch.as_tensor(alpha)
        self.inverse_depth = None if inverse_depth is None else torch.as_tensor(inverse_depth)
        if self.image.ndim != 3 or self.image.shape[2] != 3:
            raise ValueError(f"a target has shape (H, W, 3), not {tuple(self.image.shape)}")
        if self.mask is not None and self.mask.shape != self.image.shape[:2]:
            raise ValueError(f"a mask has shape {tuple(self.image.shape[:2])}, not {tuple(self.mask.shape)}")
        self.cache: dict[str, Any] = {}

    def over(self, background: tuple[float, float, float]) -> Target:
        """A transparent photograph over a colour; the same, if it is opaque."""
        if self.alpha is None:
            return self
        behind = (1 - self.alpha[..., None]) * torch.tensor(background).to(self.image)
        return Target(self.image + behind, self.mask)
