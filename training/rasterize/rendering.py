"""Constants and data types that all backends share: camera, settings, rendering and target."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from ..scenes.cameras import Camera

DILATION = 0.3
"""Variance added to each projected splat, in square pixels (3DGS's low-pass filter)."""
OUTPUTS = ("depth", "inverse_depth", "median_depth", "normals", "absgrad2d")
"""Optional outputs besides image and alpha."""
ALPHA_MAX = 0.99
ALPHA_MIN = 1 / 255
"""A splat is skipped in pixels where its alpha is below this."""
TRANSMITTANCE_MIN = 1e-4
"""Blending stops before the splat that would reduce a pixel's transmittance to this value or below."""
FRUSTUM_MARGIN = 0.3
"""The projection's Jacobian is clamped this far outside the image, relative to half its width or height."""


@dataclass(frozen=True)
class KernelCamera:
    """Camera parameters in the form that kernels use.

    Attributes:
        rotation, translation: world to camera, (3, 3) and (3,) float64.
        position: camera centre in the world, (3,) float64.
        fx, fy, cx, cy: intrinsics in pixels, pixel centres at +0.5.
        x_limits, y_limits: range of x/z and of y/z to which the Jacobian's arguments are clamped.
        near: largest depth at which a splat is not drawn, in world units.
    """

    width: int
    height: int
    rotation: np.ndarray
    translation: np.ndarray
    position: np.ndarray
    fx: float
    fy: float
    cx: float
    cy: float
    x_limits: tuple[float, float]
    y_limits: tuple[float, float]
    near: float

    @classmethod
    def of(cls, camera: Camera, near: float, window: tuple[int, int, int, int] | None = None) -> KernelCamera:
        """Create it from a camera, for the whole image or for a window (left, top, width, height)."""
        left, top, width, height = window or (0, 0, camera.width, camera.height)
        margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
        margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
        return cls(
            width=width,
            height=height,
            rotation=camera.world_to_camera[:3, :3],
            translation=camera.world_to_camera[:3, 3],
            position=camera.center,
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
    """Non-tensor arguments of a backend; see :func:`training.rasterize.rasterize`.

    Attributes:
        degree: active degree of the spherical harmonics.
        median, absolute: compute ``BackendOutput.median`` and ``BackendOutput.absgrad2d``.
        rows: (M,) int32, indices of the splats to consider; None considers all.
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

    def mask_weights(self, weights: torch.Tensor | None, like: torch.Tensor) -> torch.Tensor | None:
        """Set the weights (N,) outside ``rows`` to 0, for backends that process all splats."""
        if self.rows is None:
            return weights
        mask = torch.zeros_like(like[:, 0]).index_fill_(0, self.rows.long(), 1)
        return mask if weights is None else weights * mask


@dataclass(frozen=True)
class StepOptions:
    """Arguments of a training step; see :class:`training.rasterize.StepModel`.

    Attributes:
        near, sh_degree, background, weights, min_scale: see :func:`training.rasterize.rasterize`.
        ssim_weight: see :func:`training.rasterize.photometric_loss`.
        shrink: factor by which the photo was downscaled; used to scale the density statistics. None collects
            no statistics.
        drawn_only: splats of weight 0 keep their values and moments, instead of a step with zero gradients.
        sparse_sh: the same for harmonics of splats outside the image.
    """

    near: float
    sh_degree: int
    background: tuple[float, float, float]
    ssim_weight: float = 0.2
    weights: torch.Tensor | None = None
    min_scale: float = 0.0
    shrink: float | None = None
    drawn_only: bool = False
    sparse_sh: bool = False


@dataclass
class Rendering:
    """Rendered image with its auxiliary outputs.

    Attributes:
        image: (H, W, 3), colours over the background; not clamped.
        alpha: (H, W), one minus the transmittance behind the last splat.
        radii: (N,) float32, three standard deviations along the longest axis of the projected splat, in
            pixels; 0 for splats that are not drawn.
        grad2d: (N, 2) float32, gradient of the loss with respect to the projected mean, in the units of
            3DGS's densification threshold (per pixel, times half the image's width and height). Zero before
            ``backward``; each backward pass overwrites it.
        tile_counts: (ceil(H / 16), ceil(W / 16)) int64, number of splats in each tile of 16x16 pixels
            (LODGE's measure of rendering cost).
        absgrad2d: (N, 2), optional: like grad2d, but with the absolute values of the pixels' gradients by
            image and alpha summed (AbsGS, Ye et al. 2024).
        depth: (H, W), optional: mean depth Σ w z / Σ w, 0 where alpha is 0.
        inverse_depth: (H, W), optional: Σ w / z, 0 in empty pixels.
        median_depth: (H, W), optional: depth of the splat that reduces the transmittance to a half or below,
            0 in pixels without one.
        normals: (H, W, 3), optional: Σ w n in camera coordinates, not normalised; n is the unit vector along
            a splat's shortest axis, turned towards the camera.
        features: (H, W, F), optional: Σ w f.
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
    """Contribution of each splat to the pixels of one or more views; w = alpha T is its weight in a pixel.

    Attributes:
        largest: (N,), the largest w (the importance of RadSplat and LODGE).
        total: (N,), Σ w over pixels (LightGaussian's blended opacity).
        pixels: (N,) int64, number of pixels with w > 0 (LightGaussian's hits).
        views: (N,) int64, number of views in which it was drawn.
        radius: (N,), the largest of :attr:`Rendering.radii`.
    """

    largest: torch.Tensor
    total: torch.Tensor
    pixels: torch.Tensor
    views: torch.Tensor
    radius: torch.Tensor


@dataclass
class SideOutputs:
    """Outputs that autograd does not differentiate, see BackendOutput; backends fill them."""

    radii: torch.Tensor
    grad2d: torch.Tensor
    absgrad2d: torch.Tensor | None
    median: torch.Tensor | None
    tile_counts: torch.Tensor

    @classmethod
    def of(
        cls, count: int, settings: RasterSettings, tile: int, device: torch.device | str = "cpu"
    ) -> SideOutputs:
        """Allocate the outputs of ``count`` splats, for square tiles with sides of ``tile`` pixels."""
        height, width = settings.view.height, settings.view.width
        rows = count if torch.is_grad_enabled() else 1
        return cls(
            radii=torch.zeros(count, device=device),
            grad2d=torch.zeros(rows, 2, device=device).expand(count, 2),
            absgrad2d=torch.zeros(count, 2, device=device) if settings.absolute else None,
            median=torch.full((height, width), -1, dtype=torch.int32, device=device)
            if settings.median
            else None,
            tile_counts=torch.empty(-(-height // tile), -(-width // tile), dtype=torch.int64, device=device),
        )


def require_plain(tensors: Iterable[torch.Tensor], backend: str) -> None:
    """Raise ValueError unless all tensors are float32 on the CPU."""
    for tensor in tensors:
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"the {backend} backend requires float32 on the CPU, not {tensor.dtype} on {tensor.device}"
            )


class BackendOutput(NamedTuple):
    """Output of a backend, before conversion to :class:`Rendering`.

    Attributes:
        features: (H, W, F), the features blended over zero.
        median: (H, W) int32, index of the splat that reduces the transmittance to a half or below, -1 in
            pixels without one; None if not requested.
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
    """A photo to compare a rendering with, and a cache for the backends.

    Args:
        image: (H, W, 3) float32 in [0, 1], torch or numpy.
        mask: (H, W) in [0, 1], weight of each pixel in the loss; None means 1.
        alpha: (H, W) in [0, 1], alpha of a transparent photo over black; None means opaque.
        inverse_depth: (H, W), expected ``Rendering.inverse_depth``, NaN in unknown pixels; None if unknown.

    The cpu backend caches the photo in planes, without memory if ``image.permute(2, 0, 1)`` is contiguous.
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
            raise ValueError(f"a target must have shape (H, W, 3), not {tuple(self.image.shape)}")
        if self.mask is not None and self.mask.shape != self.image.shape[:2]:
            raise ValueError(
                f"a mask must have shape {tuple(self.image.shape[:2])}, not {tuple(self.mask.shape)}"
            )
        self.cache: dict[str, Any] = {}

    def over(self, background: tuple[float, float, float]) -> Target:
        """Composite a transparent photo over a colour; return the same target if it is opaque."""
        if self.alpha is None:
            return self
        visible = (1 - self.alpha[..., None]) * torch.tensor(background).to(self.image)
        return Target(self.image + visible, self.mask)
