"""Rasterizer for NVIDIA GPUs: CUDA kernels with analytic gradients, compiled at run time (``driver``).

The stages are those of the gpu backend. ``project`` projects splats to ellipses and counts their tiles, torch
sorts them by depth and their pairs with tiles by tile, and ``blend`` renders pixels. Gradients are summed in
the order in which threads finish, so results are not bit-reproducible.
"""

from __future__ import annotations

import struct
import sys
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import torch

from ...errors import LodgsError
from ..gaussians import Gaussians
from ..rendering import BackendOutput, KernelCamera, RasterSettings, SideOutputs, Target
from ..self_test import find_difference
from . import driver
from .source import kernel_source

DEVICE = "cuda"
TILE, THREADS, STRIPS = 16, 256, 8
ROW, SUMS = 12, 8
"""Numbers of a projected splat and of the sums of its gradient (kernels.cu)."""
GROUP = 64
"""Splats of a block that computes their gradients."""


@cache
def find_problem() -> LodgsError | None:
    """Return why this backend cannot work, or None. The first call compiles the kernels, for some seconds."""
    if not torch.cuda.is_available():
        return LodgsError(
            "Cannot use the cuda backend: torch detects no NVIDIA GPU.",
            "Train on the CPU (Training Device in Blender, backend = auto or cpu in a job), or install the "
            "driver and a torch built for CUDA.",
        )
    try:
        photometric_loss(torch.zeros(1, 1, 3, device=DEVICE), Target(torch.zeros(1, 1, 3)), 0.2).item()
        parts = torch.__version__, str(torch.version.cuda), torch.cuda.get_device_name(), kernel_source()
        reason = find_difference(sys.modules[__name__], DEVICE, parts)
    except OSError as error:
        return LodgsError(
            f"Cannot use the cuda backend: {error}.",
            "Install torch built for CUDA with its packages, which contain NVRTC; or choose cpu.",
        )
    except Exception as error:  # from the compiler, the driver or the GPU
        return LodgsError(
            f"Cannot run the cuda backend's kernels: {str(error).partition(chr(10))[0]}.",
            "Install a newer driver, or choose gpu or cpu.",
        )
    if reason:
        return LodgsError(
            f"Cannot use the cuda backend: {reason}.", "Install a newer driver, or choose gpu or cpu."
        )
    return None


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Tensors are float32 on one GPU; ValueError otherwise."""
    _check(*vars(gaussians).values(), weights, features)
    weights = settings.mask_weights(weights, gaussians.means)
    side = SideOutputs.of(len(gaussians), settings, TILE, gaussians.means.device)
    tensors = *vars(gaussians).values(), weights, features
    image, alpha, blended = _Rasterize.apply(*tensors, settings, side)  # type: ignore[misc]
    return BackendOutput(
        image, alpha, side.radii, side.grad2d, side.tile_counts, side.absgrad2d, blended, side.median
    )


@torch.no_grad()
def contributions(
    gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return largest weights, sums, pixel counts and radii of one view; see :mod:`training.rasterize`."""
    count = len(gaussians)
    means = gaussians.means
    _check(*vars(gaussians).values(), weights)
    gaussians = replace(gaussians, sh=means.new_zeros(count, 1, 3)).map(torch.Tensor.contiguous)
    weights = settings.mask_weights(weights, means)
    projected = Projected.of(gaussians, None if weights is None else weights.contiguous(), settings)
    tiles = TileLists.of(projected, settings.view)
    largest, pixels = torch.zeros(2, count, dtype=torch.int32, device=means.device)
    total = means.new_zeros(count)
    driver.kernels().launch(
        "weigh", tiles.count, THREADS, _image(settings.view), tiles.starts, tiles.pairs, projected.rows,
        projected.colours, largest, total, pixels,
    )  # fmt: skip
    return largest.view(torch.float32), total, pixels.long(), projected.radii


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    _check(image)
    if "cuda" not in target.cache:
        target.cache["cuda"] = target.image.to(image).contiguous()
    return _Photometric.apply(image, target.cache["cuda"], ssim_weight)  # type: ignore[no-any-return]


def _check(*tensors: torch.Tensor | None) -> None:
    for tensor in tensors:
        if tensor is not None and (tensor.dtype != torch.float32 or tensor.device.type != DEVICE):
            raise ValueError(
                f"the cuda backend requires float32 on a GPU, not {tensor.dtype} on {tensor.device}"
            )


def _image(view: KernelCamera, background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> bytes:
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
    colours: torch.Tensor
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
        if antialias is not False:
            flags = torch.as_tensor(antialias, dtype=torch.uint8, device=means.device)
            filters = flags.expand(count).contiguous()
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


class _Rasterize(torch.autograd.Function):
    """Rasterization as an autograd function; extra passes blend features like colours, three at a time."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, logits, sh, weights, features, settings, side):
        ctx.set_materialize_grads(False)
        parameters = [tensor.contiguous() for tensor in (means, quats, log_scales, logits, sh)]
        weights = None if weights is None else weights.contiguous()
        view = settings.view
        projected = Projected.of(Gaussians(*parameters), weights, settings)
        tiles = TileLists.of(projected, view)
        padded = torch.nn.functional.pad(features, (0, -features.shape[1] % 3))
        shades = [projected.colours, *(part.contiguous() for part in padded.split(3, 1) if part.shape[1])]
        limit = None if settings.limit is None else settings.limit.to(means).contiguous()
        size = view.height, view.width
        images = [means.new_empty(*size, 3) for _ in shades]
        light = means.new_empty(size)
        reached = torch.empty(tiles.count * STRIPS, dtype=torch.int32, device=means.device)
        for k, (shade, image) in enumerate(zip(shades, images, strict=True)):
            driver.kernels().launch(
                "blend", tiles.count, THREADS, _image(view) if k else _image(view, settings.background),
                tiles.starts, tiles.pairs, projected.rows, shade, limit, image, light, reached,
                None if k else side.median,
            )  # fmt: skip
        side.radii.copy_(projected.radii)
        side.tile_counts.copy_(tiles.starts.diff().view(side.tile_counts.shape))
        ctx.save_for_backward(*parameters, weights, features)
        ctx.saved = projected, tiles, shades, images, light, reached, settings, side
        blended = torch.cat([light[..., None].expand(*size, 0), *images[1:]], 2)
        return images[0], 1 - light, blended[..., : features.shape[1]].contiguous()

    @staticmethod
    def backward(ctx, by_image, by_alpha, by_features):
        *parameters, weights, features = ctx.saved_tensors
        projected, tiles, shades, images, light, reached, settings, side = ctx.saved
        view, count = settings.view, len(parameters[0])
        by_parts = [by_image]
        if len(shades) > 1:
            width = 3 * (len(shades) - 1)
            if by_features is None:
                by_parts += [None] * (len(shades) - 1)
            else:
                padded = torch.nn.functional.pad(by_features, (0, width - by_features.shape[2]))
                by_parts += padded.split(3, 2)
        sums = light.new_zeros(count, SUMS)
        by_shades = [light.new_zeros(count, 3) for _ in shades]
        for k, (shade, by_shade, by_part) in enumerate(zip(shades, by_shades, by_parts, strict=True)):
            alone = None if k or by_alpha is None else by_alpha.contiguous()
            if by_part is None and alone is None:
                continue
            driver.kernels().launch(
                "blend_backward", tiles.count, THREADS, _image(view), tiles.starts, tiles.pairs,
                projected.rows, shade, reached, images[k], light,
                None if by_part is None else by_part.contiguous(), alone, sums, by_shade,
                int(settings.absolute and not k),
            )  # fmt: skip
        gradients = [torch.empty_like(tensor) for tensor in parameters]
        by_weights = torch.empty_like(weights) if ctx.needs_input_grad[5] else None
        side.grad2d.zero_()
        if side.absgrad2d is not None:
            side.absgrad2d.zero_()
        driver.kernels().launch(
            "project_backward", -(-count // GROUP), GROUP, projected.view, *parameters, weights,
            projected.filters, projected.rows, projected.radii, sums, by_shades[0], *gradients, by_weights,
            side.grad2d, side.absgrad2d,
        )  # fmt: skip
        by_values = None
        if ctx.needs_input_grad[6]:
            by_values = torch.cat([features[:, :0], *by_shades[1:]], 1)[:, : features.shape[1]]
        return *gradients, by_weights, by_values, None, None


class _Photometric(torch.autograd.Function):
    """Photometric loss as an autograd function."""

    @staticmethod
    def forward(ctx, image, photo, ssim_weight):
        height, width, _ = image.shape
        view = struct.pack("=3f3i", 0.0, 0.0, 0.0, width, height, -(-width // TILE))
        image, groups = image.contiguous(), -(-width // TILE) * -(-height // TILE)
        slopes = image.new_empty(9, height, width)
        sums = image.new_zeros(2, dtype=torch.float64)
        driver.kernels().launch("compare", groups, THREADS, view, image, photo, slopes, sums)
        ctx.save_for_backward(image, photo, slopes)
        ctx.saved = view, groups, ssim_weight
        l1, ssim = sums.div_(image.numel()).unbind()
        return ((1 - ssim_weight) * l1 + ssim_weight * (1 - ssim)).float()

    @staticmethod
    def backward(ctx, by_loss):
        image, photo, slopes = ctx.saved_tensors
        view, groups, ssim_weight = ctx.saved
        by_image = torch.empty_like(image)
        driver.kernels().launch(
            "compare_backward", groups, THREADS, view, image, photo, slopes, by_loss, ssim_weight, by_image
        )
        return by_image, None, None
