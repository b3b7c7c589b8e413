"""The rasterizer on NVIDIA graphics cards, through gsplat (Ye et al. 2025, arXiv:2409.06765).

Which splats are drawn, where, and in which tiles comes from the reference's own functions, in float32 on the
card; gsplat's kernels make colours of harmonics and pixels of tiles, and take both back. So everything means
what the reference says, but for what is inside those kernels:

- alpha is capped at 0.999, not 0.99: only where an opacity is above 0.99, and only near the splat's middle;
- the exponential is the card's fast one, good to some parts in a million;
- gradients are summed in the order in which threads end, so no two runs end in the same bits.

gsplat compiles its kernels when they are first used, for some minutes, with NVIDIA's compiler nvcc.
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
from .reference import ellipses, loss_to, meets_tile, moments, squared_reach
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
WALK = 1 << 24
"""Pairs of a splat and a pixel that :func:`walk` has in memory at a time, some 40 bytes each."""


@cache
def problem() -> LodgsError | None:
    """Why this backend cannot work here, or None; the first question may take minutes, as gsplat compiles."""
    if not torch.cuda.is_available():
        return LodgsError(
            "This computer has no NVIDIA GPU that torch can use.",
            "Train on the CPU (Training Device in Blender, backend = auto or cpu in a job), or install the "
            "driver and a torch built for CUDA.",
        )
    try:
        # it talks, and the trainer's standard output is for events; processes that compile at once undo each
        # other's work
        with redirect_stdout(sys.stderr), exclusive("gsplat"):
            gsplat = _gsplat()
            one = torch.ones(1, 3, device=DEVICE)
            gsplat.spherical_harmonics(0, one, one[None]).cpu()
    except ModuleNotFoundError as error:
        return LodgsError(
            f"The rasterizer for NVIDIA GPUs needs {error.name}, which the trainer's Python does not have.",
            f"Install it with: {sys.executable} -m pip install gsplat",
        )
    except AttributeError:  # of the kernels, which are None then
        return LodgsError(
            "gsplat's kernels are not compiled, and NVIDIA's compiler nvcc was not found.",
            "Install the CUDA toolkit of torch's version, or a gsplat built for this torch; or choose cpu.",
        )
    except Exception as error:  # of the compiler, the loader or the card
        return LodgsError(
            f"gsplat's kernels do not work here: {str(error).partition(chr(10))[0].partition(': [')[0]}.",
            "Look at the log and at gsplat's installation page; or choose cpu.",
        )
    return None


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Tensors are float32 on one GPU; ValueError otherwise."""
    gsplat = _gsplat()
    _check(features)
    means, view, limit = gaussians.means, settings.view, settings.limit
    splats = VisibleSplats.of(gaussians, weights, settings)
    tiles = TileLists.of(splats, view)
    towards = means[splats.which] - torch.as_tensor(view.eye).to(means)
    colours = gsplat.spherical_harmonics(settings.degree, towards, gaussians.sh[splats.which])
    colours = (colours + 0.5).clamp_min(0)
    gradients = torch.zeros(2, len(means), 2, device=means.device)  # signed and absolute
    behind = means.new_tensor(settings.background)
    if limit is None:
        image, alpha, blended = _Blend.apply(
            splats.mean2d, splats.conic, splats.opacity, colours, features[splats.which],
            behind, splats.which, tiles, view, gradients, settings.absolute,
        )  # fmt: skip
    else:
        image, alpha, blended = blend_limited(
            splats, tiles, view, limit.to(means), colours, features[splats.which], behind
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
    """See :func:`training.rasterize.contributions`: of one view, the largest, the sum, pixels and radii."""
    splats, view = VisibleSplats.of(gaussians, weights, settings), settings.view
    largest, total = gaussians.means.new_zeros(2, len(gaussians))
    pixels = torch.zeros(len(gaussians), dtype=torch.int64, device=largest.device)
    for _, splat, weight, _ in walk(splats, TileLists.of(splats, view), view):
        splat = splats.which[splat].flatten()
        largest.scatter_reduce_(0, splat, weight.amax(1).flatten(), "amax")
        total.index_add_(0, splat, weight.sum(1).flatten())
        pixels.index_add_(0, splat, (weight > 0).sum(1).flatten())
    return largest, total, pixels, splats.radii


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    if "cuda" not in target.cache:
        truth = target.image.to(image)
        target.cache["cuda"] = truth, moments(truth)
    truth, of_truth = target.cache["cuda"]
    return loss_to(image, truth, of_truth, ssim_weight)


def _gsplat() -> Any:
    return import_module("gsplat")


def _check(*tensors: torch.Tensor | None) -> None:
    for tensor in tensors:
        if tensor is not None and (tensor.dtype != torch.float32 or tensor.device.type != DEVICE):
            raise ValueError(
                f"the cuda backend takes float32 on a GPU, not {tensor.dtype} on {tensor.device}"
            )


class VisibleSplats(NamedTuple):
    """The n splats that meet the image, front to back.

    Attributes:
        which: (n,) int64, which splats they are.
        mean2d: (n, 2) in pixels.
        conic: (n, 3), xx, xy and yy of the inverse covariance.
        opacity: (n,).
        depth: (n,) along the camera's z axis.
        covariance, determinant: as the reference's ``Ellipses``.
        radii: (N,) float32 of all splats, as ``Rendering.radii``.
    """

    which: torch.Tensor
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
        """The splats that meet an image; ``weights`` (N,) as in ``rasterize``, or None.

        Raises:
            ValueError: tensors that are not float32 or not on the GPU.
        """
        _check(*vars(gaussians).values(), weights)
        weights = settings.weights(weights, gaussians.means)
        seen = ellipses(gaussians, weights, settings)
        inside = seen.inside.nonzero()[:, 0]
        some = inside[seen.depth[inside].argsort(stable=True)]
        xx, xy, yy = covariance = tuple(values[some] for values in seen.covariance)
        determinant = seen.determinant[some]
        conic = torch.stack([yy, -xy, xx], 1) / determinant[:, None]
        which, mean2d, opacity = seen.drawn[some], seen.mean2d[some], seen.opacity[some]
        depth = seen.depth[some]
        return cls(which, mean2d, conic, opacity, depth, covariance, determinant, seen.radii)


class TileLists(NamedTuple):
    """Which splats each tile of 16x16 pixels has to look at.

    Attributes:
        splat: (P,) int32, rows of :class:`VisibleSplats`, tile after tile, front to back in each.
        start: (tiles down, tiles across) int32, each tile's first place in ``splat``.
        counts: (tiles down, tiles across) int64.
    """

    splat: torch.Tensor
    start: torch.Tensor
    counts: torch.Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, splats: VisibleSplats, view: KernelCamera) -> TileLists:
        """Takes each ellipse's box of tiles, and keeps the tiles that the ellipse meets."""
        across, down = -(-view.width // TILE), -(-view.height // TILE)
        limits = torch.tensor([across, down], device=splats.which.device)
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
        meets = meets_tile(offset, conic, splats.determinant[splat], reach[splat])

        # splats came front to back, and a stable sort leaves them so within a tile
        tile, order = (tile_y * across + tile_x)[meets].sort(stable=True)
        counts = torch.bincount(tile, minlength=across * down)
        start = counts.cumsum(0) - counts
        return cls(splat[meets][order].int(), start.int().view(down, across), counts.view(down, across))


class _Blend(torch.autograd.Function):
    """gsplat's blending, as one step whose backward also writes the image-plane gradients aside.

    Its graph is kept apart: gsplat leaves the absolute gradients as an attribute of the means that it was
    given, and a hook that looks for them there would hold a graph that holds the hook.
    """

    @staticmethod
    def forward(
        ctx, mean2d, conic, opacity, colours, features, background, index, tiles, view, gradients, absolute
    ):
        gsplat = _gsplat()
        inputs = [each.detach()[None] for each in (mean2d, conic, opacity, colours, features)]
        for each, needed in zip(inputs, ctx.needs_input_grad, strict=False):
            each.requires_grad_(needed)
        if len(tiles.splat) == 0:
            ctx.zeros = [torch.zeros_like(each[0]) for each in inputs]
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
            if features.shape[1]:  # apart, as they have no part in the absolute gradients
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
        wanted = [each for each in inputs if each.requires_grad]
        found = iter(torch.autograd.grad(outputs, wanted, by_outputs, retain_graph=True, allow_unused=True))
        by_inputs = [next(found) if each.requires_grad else None for each in inputs]
        half_size = gradients.new_tensor([view.width / 2, view.height / 2])
        if by_inputs[0] is not None:
            gradients[0, index] = by_inputs[0][0] * half_size
            if absolute:
                gradients[1, index] = inputs[0].absgrad[0] * half_size
        return *(None if each is None else each[0] for each in by_inputs), *(None,) * 6


def walk(
    splats: VisibleSplats, tiles: TileLists, view: KernelCamera, limit: torch.Tensor | None = None
) -> Iterator[tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]]:
    """Blends in plain torch what gsplat does not tell: some splats of every tile at a time, front to back.

    Args:
        limit: (H, W), the depth beyond which a pixel takes no splats; None: there is none.

    Yields:
        the tiles concerned (t,), the rows of ``splats`` that come next in each (t, k), their weights in the
        tile's pixels (t, 256, k), row by row, and the transmittance that each leaves behind (t, 256, k).
        Where a tile has fewer than k left, a splat stands for nothing, with weight 0.
    """
    down, across = tiles.counts.shape
    start, counts = tiles.start.flatten().long(), tiles.counts.flatten()
    tile = torch.arange(down * across, device=start.device)
    pixel = torch.arange(TILE * TILE, device=start.device)
    x = tile[:, None] % across * TILE + pixel % TILE + 0.5
    y = tile[:, None] // across * TILE + pixel // TILE + 0.5
    before = ((x < view.width) & (y < view.height)).to(splats.mean2d)  # no light comes from beyond the border
    if limit is not None:
        edge = torch.nn.functional.pad(limit, (0, across * TILE - view.width, 0, down * TILE - view.height))
        limit = edge.view(down, TILE, across, TILE).transpose(1, 2).reshape(down * across, TILE * TILE)
    done = 0
    while len(tile := ((counts > done) & (before > TRANSMITTANCE_MIN).any(1)).nonzero()[:, 0]):
        step = min(max(WALK // (TILE * TILE * len(tile)), 1), int(counts.max()) - done)
        place = done + torch.arange(step, device=start.device)
        there = place < counts[tile, None]
        splat = tiles.splat[(start[tile, None] + place).clamp_max(len(tiles.splat) - 1)].long()
        (mean_x, mean_y), (a, b, c) = splats.mean2d[splat].unbind(-1), splats.conic[splat].unbind(-1)
        dx, dy = x[tile][..., None] - mean_x[:, None], y[tile][..., None] - mean_y[:, None]
        distance = a[:, None] * dx * dx + 2 * b[:, None] * dx * dy + c[:, None] * dy * dy
        alpha = (splats.opacity[splat][:, None] * torch.exp(-0.5 * distance)).clamp_max(ALPHA_MAX)
        alpha = torch.where((alpha >= ALPHA_MIN) & there[:, None], alpha, 0)
        if limit is not None:
            alpha = torch.where(splats.depth[splat][:, None] <= limit[tile][..., None], alpha, 0)
        light = torch.cat([before[tile, :, None], 1 - alpha], 2).cumprod(2)
        behind = light[..., 1:]
        yield tile, splat, torch.where(behind > TRANSMITTANCE_MIN, alpha * light[..., :-1], 0), behind
        before[tile] = behind[..., -1]
        done += step


@torch.no_grad()
def blend_limited(
    splats: VisibleSplats, tiles: TileLists, view: KernelCamera, limit: torch.Tensor,
    colours: torch.Tensor, features: torch.Tensor, background: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:  # fmt: skip
    """Image, alpha and blended features of what lies before a depth, which gsplat's kernels cannot draw."""
    values = torch.cat([colours, features, torch.ones_like(colours[:, :1])], 1)  # Σ w · 1 is alpha
    sums = values.new_zeros(tiles.counts.numel(), TILE * TILE, values.shape[1])
    for tile, splat, weight, _ in walk(splats, tiles, view, limit):
        sums[tile] += weight @ values[splat]
    blended = _as_picture(sums, tiles, view)
    alpha = blended[..., -1]
    return blended[..., :3] + (1 - alpha)[..., None] * background, alpha, blended[..., 3:-1]


@torch.no_grad()
def median_splat(
    splats: VisibleSplats, tiles: TileLists, view: KernelCamera, limit: torch.Tensor | None = None
) -> torch.Tensor:
    """(H, W) int32: the splat that brings a pixel's transmittance to a half or below, -1 where none does."""
    down, across = tiles.counts.shape
    found = torch.full((down * across, TILE * TILE), -1, dtype=torch.int32, device=splats.which.device)
    for tile, splat, weight, behind in walk(splats, tiles, view, limit):
        here = (behind <= 0.5) & (weight > 0)
        first = splats.which[splat].gather(1, here.int().argmax(2)).int()
        found[tile] = torch.where((found[tile] < 0) & here.any(2), first, found[tile])
    return _as_picture(found[..., None], tiles, view)[..., 0].contiguous()


def _as_picture(pixels: torch.Tensor, tiles: TileLists, view: KernelCamera) -> torch.Tensor:
    """(H, W, K) of what tiles have in their pixels, (tiles, 256, K)."""
    down, across = tiles.counts.shape
    rows = pixels.view(down, across, TILE, TILE, -1).transpose(1, 2)
    return rows.reshape(down * TILE, across * TILE, -1)[: view.height, : view.width]
