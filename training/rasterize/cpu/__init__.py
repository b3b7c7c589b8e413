"""The rasterizer on the CPU: Numba kernels, gradients by hand, the same bits on any number of threads.

``project`` makes ellipses of splats, ``bin`` sorts them into tiles, ``blend`` makes pixels of them; ``loss``
compares with a photograph and ``adam`` takes the step. This page joins them to torch's autograd.

torch's own thread pool beside the kernels' slows them by half and more: a trainer that uses this backend
calls ``torch.set_num_threads(1)``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..gaussians import Gaussians
from ..rendering import BackendOutput, KernelCamera, RasterSettings, SideOutputs, Target, require_plain
from .bin import TILE, Pairs, bin_splats
from .blend import blend_backward, blend_backward_absolute, blend_forward, blend_median, blend_weights
from .compile import Buffers, f32, run_parallel, serialised
from .loss import loss_and_gradient, moments_of
from .project import (
    BLUE,
    COLUMNS,
    G_RED,
    GRAIN,
    LN2,
    RED,
    SUMS,
    gather_sums,
    gather_weights,
    lens_of,
    project_backward,
    project_forward,
)

TILES = 16
"""How many tiles a thread takes at a time."""


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Tensors are float32 on the CPU; ValueError otherwise.

    The image is laid out in planes: ``image.permute(2, 0, 1)`` is contiguous.
    """
    view, limit, count = settings.view, settings.limit, len(gaussians)
    weights = torch.ones(0) if weights is None else weights
    tensors = *vars(gaussians).values(), weights, features
    require_plain(tensors, "cpu")
    side = SideOutputs.of(count, settings, TILE)
    if limit is not None:  # the kernels know no infinity
        limit = limit.to(torch.float32).clamp_max(torch.finfo(torch.float32).max).contiguous()
    behind, most = np.array(settings.background, np.float32), None if limit is None else limit.numpy()
    drawn = _Rasterize.apply(*tensors, _rows(settings), _of_kernels(settings), view, behind, most, side)
    planes, alpha, blended = drawn
    return BackendOutput(
        image=planes.permute(1, 2, 0), alpha=alpha, radii=side.radii, grad2d=side.grad2d,
        tile_counts=side.tile_counts, absgrad2d=side.absgrad2d, features=blended.permute(1, 2, 0),
        median=side.median,
    )  # fmt: skip


def _rows(settings: RasterSettings) -> np.ndarray | None:
    return None if settings.rows is None else settings.rows.to(torch.int32).contiguous().numpy()


def _of_kernels(settings: RasterSettings) -> tuple:
    """The settings as ``project``'s kernels take them."""
    view = settings.view
    size = view.width, view.height
    antialias = np.atleast_1d(np.asarray(settings.antialias))  # one for all, or one for each
    return *lens_of(view), *size, settings.degree, f32(settings.min_scale), antialias


def _project_and_bin(
    splats: list,
    rows: np.ndarray | None,
    settings: tuple,
    view: KernelCamera,
    radii: torch.Tensor,
    buffers: Buffers,
) -> tuple[np.ndarray, np.ndarray, Pairs]:
    """The M splats that have a weight, or the ``rows`` given; these projected, (M, COLUMNS); and their pairs
    with tiles. All that follows counts only these M. Fills the radii, which are zeros. The last two live in
    ``buffers``.
    """
    weights, some = splats[-1], rows
    if some is None:
        some = (np.flatnonzero(weights > 0) if len(weights) else np.arange(len(radii))).astype(np.int32)
    projected = buffers.take("projected", np.float32, len(some), COLUMNS)
    depths = np.empty(len(some), np.float32)
    run_parallel(
        project_forward, len(some), GRAIN, *splats, *settings, some, depths, projected, radii.numpy()
    )
    drawn = np.flatnonzero(depths).astype(np.int32)
    return some, projected, bin_splats(projected, drawn, depths[drawn], view.width, view.height, buffers)


class _Rasterize(torch.autograd.Function):
    """Features are blended as colours are, three to a pass that leaves everything else as it was."""

    @staticmethod
    @serialised
    def forward(
        ctx, means, quats, log_scales, logits, sh, weights, features,
        rows, settings, view, background, limit, side,
    ):  # fmt: skip
        tensors = [tensor.contiguous() for tensor in (means, quats, log_scales, logits, sh, weights)]
        splats = [tensor.detach().numpy() for tensor in tensors]
        buffers = Buffers()
        some, projected, pairs = _project_and_bin(splats, rows, settings, view, side.radii, buffers)
        counts = side.tile_counts.numpy()
        counts[:] = np.diff(pairs.tile_start).reshape(counts.shape)

        tiles = pairs.splat, pairs.tile_start, counts.shape[1]
        transmittance = buffers.take("transmittance", np.float32, view.height, view.width)
        walked = np.empty(counts.size, np.int64)
        reached = buffers.take("reached", np.uint8, len(pairs.splat), 2)
        further = features.detach().numpy()
        passes = [projected, *(_as_colours(further[some], projected) if further.shape[1] else [])]
        images = np.empty((len(passes), 3, view.height, view.width), np.float32)
        for coloured, image in zip(passes, images, strict=True):
            behind = background if coloured is projected else np.zeros_like(background)
            run_parallel(
                blend_forward, counts.size, TILES, coloured, *tiles, behind, limit, image, transmittance,
                walked, reached,
            )  # fmt: skip
        if side.median is not None:
            median = side.median.numpy()
            run_parallel(blend_median, counts.size, TILES, projected, *tiles, walked, limit, median)
            median[median >= 0] = some[median[median >= 0]]
        ctx.save_for_backward(*tensors)
        ctx.rest = (
            buffers,
            settings,
            side,
            some,
            pairs,
            tiles,
            walked,
            reached,
            passes,
            images,
            transmittance,
        )
        blended = images[1:].reshape(-1, view.height, view.width)[: features.shape[1]]
        return tuple(map(torch.from_numpy, (images[0], 1 - transmittance, blended)))

    @staticmethod
    @serialised
    def backward(ctx, by_planes, by_alpha, by_blended):
        _, settings, side, some, pairs, tiles, walked, reached, passes, images, transmittance = ctx.rest
        tensors, count = ctx.saved_tensors, len(some)
        of_pairs = pairs.first, pairs.count, pairs.row
        backward, columns = (
            (blend_backward, SUMS) if side.absgrad2d is None else (blend_backward_absolute, SUMS + 2)
        )
        working = Buffers()
        pair_sums = working.take("pair_sums", np.float32, len(pairs.splat), columns)
        run_parallel(
            backward, walked.size, TILES, passes[0], *tiles, walked, reached, images[0], transmittance,
            by_planes.contiguous().numpy(), by_alpha.contiguous().numpy(), pair_sums,
        )  # fmt: skip
        if side.absgrad2d is not None:
            sums = np.zeros((count, columns), np.float32)
            run_parallel(gather_sums, count, GRAIN, *of_pairs, pair_sums, sums)
            height, width = transmittance.shape
            half_size = np.array([width / 2, height / 2], np.float32)
            side.absgrad2d.numpy()[some] = sums[:, SUMS:] * (half_size * LN2)

        by_features = np.zeros((len(side.radii), 3 * (len(passes) - 1)), np.float32)
        by_images = np.zeros_like(images[1:])
        by_images.reshape(-1, *transmittance.shape)[: len(by_blended)] = by_blended.numpy()
        no_alpha = np.zeros_like(transmittance)
        for k, coloured in enumerate(passes[1:]):
            further = working.take(f"further_sums {k}", np.float32, len(pair_sums), SUMS)
            sums = np.zeros((count, SUMS), np.float32)
            run_parallel(
                blend_backward, walked.size, TILES, coloured, *tiles, walked, reached, images[k + 1],
                transmittance, by_images[k], no_alpha, further,
            )  # fmt: skip
            run_parallel(gather_sums, count, GRAIN, *of_pairs, further, sums)
            by_features[some, 3 * k : 3 * k + 3] = sums[:, G_RED:]
            pair_sums[:, :G_RED] += further[:, :G_RED]

        # of splats without a weight no kernel writes the gradients
        empty = torch.empty_like if count == len(side.radii) else torch.zeros_like
        gradients = [empty(tensor, requires_grad=False) for tensor in tensors]
        run_parallel(
            project_backward, count, GRAIN, *(tensor.detach().numpy() for tensor in tensors), *settings,
            some, passes[0], *of_pairs, pair_sums,
            *(gradient.numpy() for gradient in gradients), side.grad2d.numpy(),
        )  # fmt: skip
        return *gradients, torch.from_numpy(by_features[:, : len(by_blended)]), *(None,) * 6


def _as_colours(features: np.ndarray, projected: np.ndarray) -> list[np.ndarray]:
    """Projected splats with three features each in the place of their colours, zeros where they run out."""
    found = []
    for first in range(0, features.shape[1], 3):
        coloured = projected.copy()
        three = features[:, first : first + 3]
        coloured[:, RED : BLUE + 1] = 0
        coloured[:, RED : RED + three.shape[1]] = three
        found.append(coloured)
    return found


@serialised
def contributions(
    gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """See :func:`training.rasterize.contributions`: of one view, the largest, the sum, pixels and radii."""
    count, view = len(gaussians), settings.view
    gaussians = replace(gaussians, sh=gaussians.means.new_zeros(count, 1, 3))
    weights = gaussians.means.new_ones(0) if weights is None else weights
    tensors = *vars(gaussians).values(), weights
    splats = [tensor.detach().contiguous().numpy() for tensor in tensors]
    radii = torch.zeros(count)
    buffers = Buffers()
    some, projected, pairs = _project_and_bin(
        splats, _rows(settings), _of_kernels(settings), view, radii, buffers
    )
    pair_weights = buffers.take("pair_weights", np.float32, len(pairs.splat), 3)
    found, everywhere = np.empty((len(some), 3), np.float32), np.zeros((count, 3), np.float32)
    run_parallel(
        blend_weights, len(pairs.tile_start) - 1, TILES, projected, pairs.splat, pairs.tile_start,
        -(-view.width // TILE), view.width, view.height, pair_weights,
    )  # fmt: skip
    run_parallel(gather_weights, len(some), GRAIN, pairs.first, pairs.count, pairs.row, pair_weights, found)
    everywhere[some] = found
    largest, total, pixels = torch.from_numpy(everywhere).unbind(1)
    return largest, total, pixels.long(), radii


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    if "cpu" not in target.cache:
        truth = np.ascontiguousarray(target.image.permute(2, 0, 1).float().numpy())
        target.cache["cpu"] = truth, moments_of(truth)
    return _Photometric.apply(image.permute(2, 0, 1), target, ssim_weight)  # type: ignore[no-any-return]


class _Photometric(torch.autograd.Function):
    @staticmethod
    @serialised
    def forward(ctx, planes, target, ssim_weight):
        truth, moments = target.cache["cpu"]
        loss, gradient = loss_and_gradient(planes.detach().contiguous().numpy(), truth, moments, ssim_weight)
        ctx.gradient = torch.from_numpy(gradient)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx, by_loss):
        return (ctx.gradient if by_loss == 1 else ctx.gradient * by_loss), None, None
