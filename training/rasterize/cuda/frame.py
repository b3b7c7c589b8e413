"""An image of splats on an NVIDIA GPU: projection, lists of tiles, blending, and the backward pass."""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np
import torch

from ..gaussians import Gaussians
from ..rendering import KernelCamera, RasterSettings, Target
from . import driver

TILE, THREADS, STRIPS = 16, 256, 8
ROW, SUMS = 12, 8
"""Numbers of a projected splat and of the sums of its gradient (kernels.cu)."""
GROUP = 64
"""Splats of a block that computes their gradients."""


def upload_photo(target: Target, like: torch.Tensor) -> torch.Tensor:
    """Return the photo on the device of a tensor; cached in the target."""
    if "cuda" not in target.cache:
        target.cache["cuda"] = target.image.to(like).contiguous()
    return target.cache["cuda"]


def upload_mask(target: Target, like: torch.Tensor) -> torch.Tensor | None:
    """Return the photo's mask (H, W, 1) on the device of a tensor, or None; cached in the target."""
    if target.mask is not None and "cuda_mask" not in target.cache:
        target.cache["cuda_mask"] = target.mask.to(like)[..., None]
    return target.cache.get("cuda_mask")


def image_structure(view: KernelCamera, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> bytes:
    """Return the structure ``Image`` of a view."""
    return struct.pack("=3f3i", *background, view.width, view.height, -(-view.width // TILE))


class Projected(NamedTuple):
    """N splats, projected for a view.

    Attributes:
        view: the structure ``View`` of kernels.cu.
        filters: (N,) uint8, positive for splats with Mip-Splatting's filter; None for no splat.
        rows: (N, ROW), undefined for splats that are not drawn.
        colours: (N, 3).
        radii: (N,), see ``Rendering.radii``.
        depths: (N,), infinite for splats that are not drawn.
        counts: (N,) int32, number of tiles.
    """

    view: bytes
    filters: torch.Tensor | None
    rows: torch.Tensor
    colors: torch.Tensor
    radii: torch.Tensor
    depths: torch.Tensor
    counts: torch.Tensor

    @classmethod
    def of(cls, gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings) -> Projected:
        """Project splats; ``weights`` (N,) as in ``rasterize``, or None. All tensors are contiguous."""
        v, means, antialias = settings.view, gaussians.means, settings.antialias
        count = len(means)
        pose = np.column_stack([v.rotation, v.translation]).flatten()
        tiles = -(-v.width // TILE), -(-v.height // TILE)
        view = struct.pack(
            "=25f7i", *pose, *v.position, v.fx, v.fy, v.cx, v.cy, v.x_limits[0], v.y_limits[0], v.x_limits[1],
            v.y_limits[1], v.near, settings.min_scale, v.width, v.height, *tiles, count,
            gaussians.sh.shape[1], settings.degree,
        )  # fmt: skip
        filters = None
        if isinstance(antialias, torch.Tensor):
            filters = antialias.to(means.device, torch.uint8).contiguous()
        elif antialias:
            filters = means.new_ones(count, dtype=torch.uint8)
        empty = means.new_empty
        projected = cls(
            view, filters, empty(count, ROW), empty(count, 3), empty(count), empty(count),
            torch.empty(count, dtype=torch.int32, device=means.device),
        )  # fmt: skip
        driver.kernels().launch(
            "project", -(-count // THREADS), THREADS, view, *vars(gaussians).values(), weights, filters,
            *projected[2:],
        )  # fmt: skip
        return projected


class TileLists(NamedTuple):
    """Lists of splats for each tile of 16x16 pixels, in row-major order.

    Attributes:
        pairs: (P,) int32, splats, tile after tile, front to back in each tile.
        starts: (tiles + 1,) int32, index of each tile's first pair, and of the end.
    """

    pairs: torch.Tensor
    starts: torch.Tensor

    @property
    def count(self) -> int:
        """Number of tiles."""
        return len(self.starts) - 1

    @classmethod
    def of(cls, projected: Projected, view: KernelCamera) -> TileLists:
        """List the splats of all tiles. Waits for the number of pairs."""
        device = projected.depths.device
        count = len(projected.depths)
        last = -(-view.width // TILE) * -(-view.height // TILE)
        kind, kernel = (torch.int16, "list_pairs") if last < 1 << 15 else (torch.int32, "list_many_pairs")
        order = projected.depths.argsort(stable=True)
        ends = projected.counts[order].cumsum(0)
        total = int(ends[-1]) if count else 0
        tiles, splats = (torch.empty(total, dtype=dtype, device=device) for dtype in (kind, torch.int32))
        driver.kernels().launch(
            kernel, -(-count // THREADS), THREADS, projected.view, order, ends, projected.rows,
            projected.counts, tiles, splats,
        )  # fmt: skip
        # splats are front to back, and a stable sort preserves this order within a tile
        sorted_tiles, index = tiles.sort(stable=True)
        numbers = torch.arange(last + 1, dtype=kind, device=device)
        return cls(splats[index], torch.searchsorted(sorted_tiles, numbers, out_int32=True))


class CardFrame:
    """Projected splats and their lists of tiles.

    Args:
        gaussians: contiguous tensors.
        weights: (N,) contiguous, or None.

    Attributes:
        projected, tiles: see the classes.
        light: (H, W), transmittance of the last blended image.
    """

    def __init__(self, gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings) -> None:
        self._parameters = list(vars(gaussians).values())
        self._weights = weights
        self.view = settings.view
        self.projected = Projected.of(gaussians, weights, settings)
        self.tiles = TileLists.of(self.projected, settings.view)
        means = gaussians.means
        self.light = means.new_empty(self.view.height, self.view.width)
        self._reached = torch.empty(self.tiles.count * STRIPS, dtype=torch.int32, device=means.device)

    def blend(
        self,
        colors: torch.Tensor,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        limit: torch.Tensor | None = None,
        median: torch.Tensor | None = None,
    ) -> torch.Tensor:
        """Return the image (H, W, 3) of colours (N, 3).

        Args:
            limit, median: (H, W), maximum depth, and median splats to fill; see ``BackendOutput``.
        """
        image = self.light.new_empty(*self.light.shape, 3)
        driver.kernels().launch(
            "blend", self.tiles.count, THREADS, image_structure(self.view, background), self.tiles.starts,
            self.tiles.pairs, self.projected.rows, colors, limit, image, self.light, self._reached, median,
        )  # fmt: skip
        return image

    def new_sums(self) -> torch.Tensor:
        """Return sums of gradients (N, SUMS), zero."""
        return self.light.new_zeros(len(self.projected.depths), SUMS)

    def differentiate(
        self,
        colors: torch.Tensor,
        image: torch.Tensor,
        by_image: torch.Tensor | None,
        by_alpha: torch.Tensor | None,
        sums: torch.Tensor,
        absolute: bool = False,
    ) -> torch.Tensor:
        """Add an image's share to the sums; return the gradient by colours (N, 3)."""
        by_colors = torch.zeros_like(colors)
        if by_image is None and by_alpha is None:
            return by_colors
        driver.kernels().launch(
            "blend_backward", self.tiles.count, THREADS, image_structure(self.view), self.tiles.starts,
            self.tiles.pairs, self.projected.rows, colors, self._reached, image, self.light,
            None if by_image is None else by_image.contiguous(),
            None if by_alpha is None else by_alpha.contiguous(), sums, by_colors, int(absolute),
        )  # fmt: skip
        return by_colors

    def project_backward(
        self,
        sums: torch.Tensor,
        by_colors: torch.Tensor,
        grad2d: torch.Tensor,
        absgrad2d: torch.Tensor | None = None,
        by_weights: torch.Tensor | None = None,
    ) -> list[torch.Tensor]:
        """Return the gradients of the parameters; fill those of weights, and grad2d (N, 2), zero before."""
        gradients = [torch.empty_like(tensor) for tensor in self._parameters]
        projected = self.projected
        driver.kernels().launch(
            "project_backward", -(-len(projected.depths) // GROUP), GROUP, projected.view,
            *self._parameters, self._weights, projected.filters, projected.rows, projected.radii, sums,
            by_colors, *gradients, by_weights, grad2d, absgrad2d,
        )  # fmt: skip
        return gradients


class PhotometricLoss:
    """Photometric loss of an image and a photo, (H, W, 3) and contiguous."""

    def __init__(self, image: torch.Tensor, photo: torch.Tensor, ssim_weight: float) -> None:
        height, width, _ = image.shape
        self._image, self._photo, self._ssim_weight = image, photo, ssim_weight
        self._view = struct.pack("=3f3i", 0.0, 0.0, 0.0, width, height, -(-width // TILE))
        self._groups = -(-width // TILE) * -(-height // TILE)
        self._slopes = image.new_empty(9, height, width)
        self._sums = image.new_zeros(2, dtype=torch.float64)
        driver.kernels().launch(
            "compare", self._groups, THREADS, self._view, image, photo, self._slopes, self._sums
        )

    @property
    def value(self) -> torch.Tensor:
        """The loss, float32."""
        l1, ssim = (self._sums / self._image.numel()).unbind()
        return ((1 - self._ssim_weight) * l1 + self._ssim_weight * (1 - ssim)).float()

    def gradient(self, by_loss: torch.Tensor) -> torch.Tensor:
        """Return the gradient by the image, times a number."""
        by_image = torch.empty_like(self._image)
        driver.kernels().launch(
            "compare_backward", self._groups, THREADS, self._view, self._image, self._photo, self._slopes,
            by_loss, self._ssim_weight, by_image,
        )  # fmt: skip
        return by_image
