"""Rasterizer for NVIDIA GPUs through gsplat (Ye et al. 2025, arXiv:2409.06765).

Projection and tile lists use the reference's own functions in float32 on the GPU. gsplat's kernels evaluate
spherical harmonics and blend tiles, forward and backward. The results therefore agree with the reference
except for the internals of these kernels:

- alpha is capped at 0.999 instead of 0.99, which affects only the centres of nearly opaque splats;
- the exponential is the GPU's fast approximation, with errors of a few parts in a million;
- gradients are summed in the order in which threads finish, so results are not bit-reproducible.

gsplat compiles its kernels on first use with NVIDIA's compiler nvcc, which takes some minutes.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import torch

from ..errors import LodgsError
from ..files import exclusive
from .gaussians import Gaussians
from .reference import ellipses, intersects_tile, loss_with_moments, moments, squared_reach
from .rendering import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    BackendOutput,
    KernelCamera,
    RasterSettings,
    Target,
)

DEVICE = "cuda"
TILE = 16
CHUNK_PAIRS = 1 << 24
"""Pairs of splat and pixel that :func:`blend_chunks` keeps in memory, about 40 bytes each."""


@cache
def find_problem() -> LodgsError | None:
    """Return why this backend cannot work, or None. The first call compiles gsplat, which takes minutes."""
    if not torch.cuda.is_available():
        return LodgsError(
            "Cannot use the cuda backend: torch detects no NVIDIA GPU.",
            "Train on the CPU (Training Device in Blender, backend = auto or cpu in a job), or install the "
            "driver and a torch built for CUDA.",
        )
    try:
        # standard output is reserved for the trainer's events; concurrent compilations corrupt each other
        with redirect_stdout(sys.stderr), exclusive("gsplat"):
            gsplat = _gsplat()
            ones = torch.ones(1, 3, device=DEVICE)
            gsplat.spherical_harmonics(0, ones, ones[None]).cpu()
    except ModuleNotFoundError as error:
        return LodgsError(
            f"Cannot use the cuda backend: the Python package {error.name} is not installed.",
            f"Install it with: {sys.executable} -m pip install gsplat",
        )
    except AttributeError:  # without nvcc, gsplat's kernels are None
        return LodgsError(
            "Cannot compile gsplat's kernels: NVIDIA's compiler nvcc is not installed.",
            "Install the CUDA toolkit of torch's version, or a gsplat built for this torch; or choose cpu.",
        )
    except Exception as error:  # from the compiler, the loader or the GPU
        return LodgsError(
            f"Cannot run gsplat's kernels: {str(error).partition(chr(10))[0].partition(': [')[0]}.",
            "Read the log and gsplat's installation page, or choose cpu.",
        )
    return None


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Tensors are float32 on one GPU; ValueError otherwise."""
    gsplat = _gsplat()
    _check(features)
    means = gaussians.means
    view = settings.view
    limit = settings.limit
    splats = VisibleSplats.of(gaussians, weights, settings)
    tiles = TileLists.of(splats, view)
    directions = means[splats.index] - torch.as_tensor(view.position).to(means)
    colours = gsplat.spherical_harmonics(settings.degree, directions, gaussians.sh[splats.index])
    colours = (colours + 0.5).clamp_min(0)
    gradients = torch.zeros(2, len(means), 2, device=means.device)  # signed and absolute
    background = means.new_tensor(settings.background)
    if limit is None:
        image, alpha, blended = _Blend.apply(
            splats.mean2d, splats.conic, splats.opacity, colours, features[splats.index],
            background, splats.index, tiles, view, gradients, settings.absolute,
        )  # fmt: skip
    else:
        image, alpha, blended = blend_limited(
            splats, tiles, view, limit.to(means), colours, features[splats.index], background
        )
    return BackendOutput(
        image=image, alpha=alpha, radii=splats.radii, grad2d=gradients[0], tile_counts=tiles.counts,
        absgrad2d=gradients[1] if settings.absolute else None, features=blended,
        median=median_splat(splats, tiles, view, limit) if settings.median else None,
    )  # fmt: skip


@torch.no_grad()
def contributions(
    gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return largest weights, sums, pixel counts and radii of one view; see :mod:`training.rasterize`."""
    view = settings.view
    splats = VisibleSplats.of(gaussians, weights, settings)
    largest, total = gaussians.means.new_zeros(2, len(gaussians))
    pixels = torch.zeros(len(gaussians), dtype=torch.int64, device=largest.device)
    for _, splat, weight, _ in blend_chunks(splats, TileLists.of(splats, view), view):
        splat = splats.index[splat].flatten()
        largest.scatter_reduce_(0, splat, weight.amax(1).flatten(), "amax")
        total.index_add_(0, splat, weight.sum(1).flatten())
        pixels.index_add_(0, splat, (weight > 0).sum(1).flatten())
    return largest, total, pixels, splats.radii


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    if "cuda" not in target.cache:
        truth = target.image.to(image)
        target.cache["cuda"] = truth, moments(truth)
    truth, truth_moments = target.cache["cuda"]
    return loss_with_moments(image, truth, truth_moments, ssim_weight)


def _gsplat() -> Any:
    return import_module("gsplat")


def _check(*tensors: torch.Tensor | None) -> None:
    for tensor in tensors:
        if tensor is not None and (tensor.dtype != torch.float32 or tensor.device.type != DEVICE):
            raise ValueError(
                f"the cuda backend requires float32 on a GPU, not {tensor.dtype} on {tensor.device}"
            )


class VisibleSplats(NamedTuple):
    """The n splats whose ellipses intersect the image, front to back.

    Attributes:
        index: (n,) int64, indices of the splats.
        mean2d: (n, 2) in pixels.
        conic: (n, 3), xx, xy and yy of the inverse covariance.
        opacity: (n,).
        depth: (n,) along the camera's z axis.
        covariance, determinant: see the reference's ``Ellipses``.
        radii: (N,) float32 of all splats, see ``Rendering.radii``.
    """

    index: torch.Tensor
    mean2d: torch.Tensor
    conic: torch.Tensor
    opacity: torch.Tensor
    depth: torch.Tensor
    covariance: tuple[torch.Tensor, ...]
    determinant: torch.Tensor
    radii: torch.Tensor

    @classmethod
    def of(
        cls, gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings
    ) -> VisibleSplats:
        """Project splats and select the visible ones; ``weights`` (N,) as in ``rasterize``, or None.

        Raises:
            ValueError: tensors are not float32 on the GPU.
        """
        _check(*vars(gaussians).values(), weights)
        weights = settings.mask_weights(weights, gaussians.means)
        projected = ellipses(gaussians, weights, settings)
        inside = projected.inside.nonzero()[:, 0]
        order = inside[projected.depth[inside].argsort(stable=True)]
        xx, xy, yy = covariance = tuple(values[order] for values in projected.covariance)
        determinant = projected.determinant[order]
        conic = torch.stack([yy, -xy, xx], 1) / determinant[:, None]
        return cls(
            projected.drawn[order],
            projected.mean2d[order],
            conic,
            projected.opacity[order],
            projected.depth[order],
            covariance,
            determinant,
            projected.radii,
        )


class TileLists(NamedTuple):
    """List of splats for each tile of 16x16 pixels.

    Attributes:
        splat: (P,) int32, rows of :class:`VisibleSplats`, tile after tile, front to back in each tile.
        start: (tiles down, tiles across) int32, index of each tile's first entry in ``splat``.
        counts: (tiles down, tiles across) int64, number of entries of each tile.
    """

    splat: torch.Tensor
    start: torch.Tensor
    counts: torch.Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, splats: VisibleSplats, view: KernelCamera) -> TileLists:
        """List the tiles in each ellipse's bounding box that the ellipse intersects."""
        across, down = -(-view.width // TILE), -(-view.height // TILE)
        limits = torch.tensor([across, down], device=splats.index.device)
        xx, xy, yy = splats.covariance
        reach = squared_reach(splats.opacity)
        half_size = (reach[:, None] * torch.stack([xx, yy], 1)).sqrt()
        first = ((splats.mean2d - half_size) / TILE).floor().clamp_min(0).minimum(limits).long()
        past = ((splats.mean2d + half_size) / TILE).floor().add(1).clamp_min(0).minimum(limits).long()
        size = past - first

        splat = torch.repeat_interleave(size.prod(1))
        place = torch.arange(len(splat), device=splat.device)
        place = place - (size.prod(1).cumsum(0) - size.prod(1))[splat]
        columns = size[splat, 0]
        tile_x, tile_y = first[splat, 0] + place % columns, first[splat, 1] + place // columns
        offset = TILE * torch.stack([tile_x, tile_y]) + 0.5 - splats.mean2d[splat].T
        conic = yy[splat], -xy[splat], xx[splat]
        intersects = intersects_tile(offset, conic, splats.determinant[splat], reach[splat])

        # splats are front to back, and a stable sort preserves this order within a tile
        tile, order = (tile_y * across + tile_x)[intersects].sort(stable=True)
        counts = torch.bincount(tile, minlength=across * down)
        start = counts.cumsum(0) - counts
        return cls(splat[intersects][order].int(), start.int().view(down, across), counts.view(down, across))


class _Blend(torch.autograd.Function):
    """gsplat's blending as one autograd function, whose backward pass also stores image-plane gradients.

    The inner graph is separate, because gsplat stores absolute gradients as an attribute of its input means.
    A hook that reads this attribute would create a reference cycle with the graph.
    """

    @staticmethod
    def forward(
        ctx, mean2d, conic, opacity, colours, features, background, index, tiles, view, gradients, absolute
    ):
        gsplat = _gsplat()
        inputs = [tensor.detach()[None] for tensor in (mean2d, conic, opacity, colours, features)]
        for tensor, needed in zip(inputs, ctx.needs_input_grad, strict=False):
            tensor.requires_grad_(needed)
        if len(tiles.splat) == 0:
            ctx.zeros = [torch.zeros_like(tensor[0]) for tensor in inputs]
            return (
                background.expand(view.height, view.width, 3).clone(),
                background.new_zeros(view.height, view.width),
                background.new_zeros(view.height, view.width, features.shape[1]),
            )
        size = view.width, view.height, TILE, tiles.start[None], tiles.splat
        with torch.enable_grad():
            means, conics, opacities, *shades = inputs
            image, alpha = gsplat.rasterize_to_pixels(
                means, conics, shades[0], opacities, *size, backgrounds=background[None], absgrad=absolute
            )
            outputs = [image, alpha]
            if features.shape[1]:  # separately, because absolute gradients exclude them
                outputs.append(gsplat.rasterize_to_pixels(means, conics, shades[1], opacities, *size)[0])
        ctx.inner = inputs, outputs, index, gradients, absolute, view
        image, alpha, *blended = (output.detach()[0] for output in outputs)
        return image, alpha[..., 0], blended[0] if blended else alpha[..., :0]

    @staticmethod
    def backward(ctx, by_image, by_alpha, by_features):
        if hasattr(ctx, "zeros"):
            return *ctx.zeros, *(None,) * 6
        inputs, outputs, index, gradients, absolute, view = ctx.inner
        by_outputs = [by_image[None], by_alpha[None, ..., None], by_features[None]][: len(outputs)]
        leaves = [tensor for tensor in inputs if tensor.requires_grad]
        by_leaves = iter(
            torch.autograd.grad(outputs, leaves, by_outputs, retain_graph=True, allow_unused=True)
        )
        by_inputs = [next(by_leaves) if tensor.requires_grad else None for tensor in inputs]
        half_size = gradients.new_tensor([view.width / 2, view.height / 2])
        if by_inputs[0] is not None:
            gradients[0, index] = by_inputs[0][0] * half_size
            if absolute:
                gradients[1, index] = inputs[0].absgrad[0] * half_size
        return *(None if gradient is None else gradient[0] for gradient in by_inputs), *(None,) * 6


def blend_chunks(
    splats: VisibleSplats, tiles: TileLists, view: KernelCamera, limit: torch.Tensor | None = None
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Blend in plain torch, for outputs that gsplat does not provide: k splats per tile, front to back.

    Args:
        limit: (H, W), maximum depth of each pixel's splats; None means unlimited.

    Yields:
        Active tiles (t,), the next rows of ``splats`` in each tile (t, k), their weights in the tile's pixels
        (t, 256, k), row by row, and the transmittance behind each splat (t, 256, k). Tiles with fewer than k
        remaining splats are padded with arbitrary splats of weight 0.
    """
    down, across = tiles.counts.shape
    start, counts = tiles.start.flatten().long(), tiles.counts.flatten()
    tile = torch.arange(down * across, device=start.device)
    pixel = torch.arange(TILE * TILE, device=start.device)
    x = tile[:, None] % across * TILE + pixel % TILE + 0.5
    y = tile[:, None] // across * TILE + pixel // TILE + 0.5
    light = ((x < view.width) & (y < view.height)).to(
        splats.mean2d
    )  # transmittance so far; 0 outside the image
    if limit is not None:
        edge = torch.nn.functional.pad(limit, (0, across * TILE - view.width, 0, down * TILE - view.height))
        limit = edge.view(down, TILE, across, TILE).transpose(1, 2).reshape(down * across, TILE * TILE)
    done = 0
    while len(tile := ((counts > done) & (light > TRANSMITTANCE_MIN).any(1)).nonzero()[:, 0]):
        step = min(max(CHUNK_PAIRS // (TILE * TILE * len(tile)), 1), int(counts.max()) - done)
        place = done + torch.arange(step, device=start.device)
        valid = place < counts[tile, None]
        splat = tiles.splat[(start[tile, None] + place).clamp_max(len(tiles.splat) - 1)].long()
        (mean_x, mean_y), (a, b, c) = splats.mean2d[splat].unbind(-1), splats.conic[splat].unbind(-1)
        dx, dy = x[tile][..., None] - mean_x[:, None], y[tile][..., None] - mean_y[:, None]
        distance = a[:, None] * dx * dx + 2 * b[:, None] * dx * dy + c[:, None] * dy * dy
        alpha = (splats.opacity[splat][:, None] * torch.exp(-0.5 * distance)).clamp_max(ALPHA_MAX)
        alpha = torch.where((alpha >= ALPHA_MIN) & valid[:, None], alpha, 0)
        if limit is not None:
            alpha = torch.where(splats.depth[splat][:, None] <= limit[tile][..., None], alpha, 0)
        front = torch.cat([light[tile, :, None], 1 - alpha], 2).cumprod(2)
        back = front[..., 1:]
        yield tile, splat, torch.where(back > TRANSMITTANCE_MIN, alpha * front[..., :-1], 0), back
        light[tile] = back[..., -1]
        done += step


@torch.no_grad()
def blend_limited(
    splats: VisibleSplats, tiles: TileLists, view: KernelCamera, limit: torch.Tensor,
    colours: torch.Tensor, features: torch.Tensor, background: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    """Blend splats up to a maximum depth per pixel, which gsplat's kernels do not support.

    Returns:
        Image (H, W, 3), alpha (H, W) and blended features (H, W, F).
    """
    values = torch.cat([colours, features, torch.ones_like(colours[:, :1])], 1)  # Σ w · 1 is alpha
    sums = values.new_zeros(tiles.counts.numel(), TILE * TILE, values.shape[1])
    for tile, splat, weight, _ in blend_chunks(splats, tiles, view, limit):
        sums[tile] += weight @ values[splat]
    blended = _tiles_to_image(sums, tiles, view)
    alpha = blended[..., -1]
    return blended[..., :3] + (1 - alpha)[..., None] * background, alpha, blended[..., 3:-1]


@torch.no_grad()
def median_splat(
    splats: VisibleSplats, tiles: TileLists, view: KernelCamera, limit: torch.Tensor | None = None
) -> torch.Tensor:
    """Return the splat (H, W) int32 that reduces the transmittance to a half or below, -1 if there is
    none."""
    down, across = tiles.counts.shape
    median = torch.full((down * across, TILE * TILE), -1, dtype=torch.int32, device=splats.index.device)
    for tile, splat, weight, back in blend_chunks(splats, tiles, view, limit):
        reached = (back <= 0.5) & (weight > 0)
        first = splats.index[splat].gather(1, reached.int().argmax(2)).int()
        median[tile] = torch.where((median[tile] < 0) & reached.any(2), first, median[tile])
    return _tiles_to_image(median[..., None], tiles, view)[..., 0].contiguous()


def _tiles_to_image(pixels: torch.Tensor, tiles: TileLists, view: KernelCamera) -> torch.Tensor:
    """Rearrange pixels by tile (tiles, 256, K) to an image (H, W, K)."""
    down, across = tiles.counts.shape
    rows = pixels.view(down, across, TILE, TILE, -1).transpose(1, 2)
    return rows.reshape(down * TILE, across * TILE, -1)[: view.height, : view.width]
