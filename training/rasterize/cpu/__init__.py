"""CPU rasterizer: Numba kernels with analytic gradients, bit-identical for any number of threads.

``project`` projects splats to ellipses, ``bin`` sorts them into tiles, ``blend`` renders pixels, ``loss``
compares the image with a photo, and ``adam`` updates the parameters. This module connects them to torch's
autograd.

torch's own thread pool slows the kernels by half or more. A trainer that uses this backend should call
``torch.set_num_threads(1)``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from ..gaussians import Gaussians
from ..rendering import BackendOutput, KernelCamera, RasterSettings, SideOutputs, Target, require_plain
from .bin import TILE, Pairs, bin_splats
from .blend import (
    REACHED,
    blend_backward,
    blend_backward_absolute,
    blend_forward,
    blend_median,
    blend_weights,
)
from .compile import Buffers, f32, run_parallel, serialised
from .loss import loss_and_gradient
from .project import (
    BLUE,
    COLUMNS,
    G_RED,
    GRAIN,
    LN2,
    RED,
    SUMS,
    kernel_arguments,
    project_forward,
)
from .project_backward import gather_sums, gather_weights, project_backward

TILES = 16
"""Tiles in a thread's unit of work."""


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Raise ValueError unless tensors are float32 on the CPU.

    The image is stored in planes: ``image.permute(2, 0, 1)`` is contiguous.
    """
    view = settings.view
    limit = settings.limit
    count = len(gaussians)
    weights = torch.ones(0) if weights is None else weights
    tensors = *vars(gaussians).values(), weights, features
    require_plain(tensors, "cpu")
    side = SideOutputs.of(count, settings, TILE)
    if limit is not None:  # fast-math kernels do not support infinity
        limit = limit.to(torch.float32).clamp_max(torch.finfo(torch.float32).max).contiguous()
    background = np.array(settings.background, np.float32)
    planes, alpha, blended = _Rasterize.apply(
        *tensors, _rows(settings), _kernel_settings(settings), view, background,
        None if limit is None else limit.numpy(), side,
    )  # fmt: skip
    return BackendOutput(
        image=planes.permute(1, 2, 0), alpha=alpha, radii=side.radii, grad2d=side.grad2d,
        tile_counts=side.tile_counts, absgrad2d=side.absgrad2d, features=blended.permute(1, 2, 0),
        median=side.median,
    )  # fmt: skip


def _rows(settings: RasterSettings) -> np.ndarray | None:
    return None if settings.rows is None else settings.rows.to(torch.int32).contiguous().numpy()


def _kernel_settings(settings: RasterSettings) -> tuple:
    """Convert settings to arguments of ``project``'s kernels."""
    view = settings.view
    size = view.width, view.height
    antialias = np.atleast_1d(np.asarray(settings.antialias))  # one entry, or N
    return *kernel_arguments(view), *size, settings.degree, f32(settings.min_scale), antialias


def _project_and_bin(
    splats: list,
    rows: np.ndarray | None,
    settings: tuple,
    view: KernelCamera,
    radii: torch.Tensor,
    buffers: Buffers,
) -> tuple[np.ndarray, np.ndarray, Pairs]:
    """Project the splats at ``rows``, or all with positive weight, and bin them.

    Returns:
        Their indices (M,), the projected splats (M, COLUMNS) and their pairs with tiles. Both refer to these
        M splats and use memory of ``buffers``. ``radii``, initially zero, are filled.
    """
    weights = splats[-1]
    index = rows
    if index is None:
        index = (np.flatnonzero(weights > 0) if len(weights) else np.arange(len(radii))).astype(np.int32)
    projected = buffers.take("projected", np.float32, len(index), COLUMNS)
    depths = np.empty(len(index), np.float32)
    run_parallel(
        project_forward, len(index), GRAIN, *splats, *settings, index, depths, projected, radii.numpy()
    )
    drawn = np.flatnonzero(depths).astype(np.int32)
    return index, projected, bin_splats(projected, drawn, depths[drawn], view.width, view.height, buffers)


class _Rasterize(torch.autograd.Function):
    """Rasterization as an autograd function; extra passes blend features like colours, three at a time."""

    @staticmethod
    @serialised
    def forward(
        ctx, means, quats, log_scales, logits, sh, weights, features,
        rows, settings, view, background, limit, side,
    ):  # fmt: skip
        tensors = [tensor.contiguous() for tensor in (means, quats, log_scales, logits, sh, weights)]
        splats = [tensor.detach().numpy() for tensor in tensors]
        buffers = Buffers()
        index, projected, pairs = _project_and_bin(splats, rows, settings, view, side.radii, buffers)
        counts = side.tile_counts.numpy()
        counts[:] = np.diff(pairs.tile_start).reshape(counts.shape)

        tiles = pairs.splat, pairs.tile_start, counts.shape[1]
        transmittance = buffers.take("transmittance", np.float32, view.height, view.width)
        visited = np.empty(counts.size, np.int64)
        reached = buffers.take("reached", np.uint8, len(pairs.splat), REACHED)
        feature_array = features.detach().numpy()
        passes = [projected]
        if feature_array.shape[1]:
            passes += _as_colours(feature_array[index], projected)
        images = np.empty((len(passes), 3, view.height, view.width), np.float32)
        for coloured, image in zip(passes, images, strict=True):
            pass_background = background if coloured is projected else np.zeros_like(background)
            run_parallel(
                blend_forward, counts.size, TILES, coloured, *tiles, pass_background, limit, image,
                transmittance, visited, reached,
            )  # fmt: skip
        if side.median is not None:
            median = side.median.numpy()
            run_parallel(blend_median, counts.size, TILES, projected, *tiles, visited, limit, median)
            median[median >= 0] = index[median[median >= 0]]
        ctx.save_for_backward(*tensors)
        ctx.saved = (
            buffers,
            settings,
            side,
            index,
            pairs,
            tiles,
            visited,
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
        _, settings, side, index, pairs, tiles, visited, reached, passes, images, transmittance = ctx.saved
        tensors = ctx.saved_tensors
        count = len(index)
        pair_arrays = pairs.first, pairs.count, pairs.row
        backward, columns = (
            (blend_backward, SUMS) if side.absgrad2d is None else (blend_backward_absolute, SUMS + 2)
        )
        working = Buffers()
        pair_sums = working.take("pair_sums", np.float32, len(pairs.splat), columns)
        run_parallel(
            backward, visited.size, TILES, passes[0], *tiles, visited, reached, images[0], transmittance,
            by_planes.contiguous().numpy(), by_alpha.contiguous().numpy(), pair_sums,
        )  # fmt: skip
        if side.absgrad2d is not None:
            sums = np.zeros((count, columns), np.float32)
            run_parallel(gather_sums, count, GRAIN, *pair_arrays, pair_sums, sums)
            height, width = transmittance.shape
            half_size = np.array([width / 2, height / 2], np.float32)
            side.absgrad2d.numpy()[index] = sums[:, SUMS:] * (half_size * LN2)

        by_features = np.zeros((len(side.radii), 3 * (len(passes) - 1)), np.float32)
        by_images = np.zeros_like(images[1:])
        by_images.reshape(-1, *transmittance.shape)[: len(by_blended)] = by_blended.numpy()
        no_alpha = np.zeros_like(transmittance)
        for k, coloured in enumerate(passes[1:]):
            feature_sums = working.take(f"feature_sums {k}", np.float32, len(pair_sums), SUMS)
            sums = np.zeros((count, SUMS), np.float32)
            run_parallel(
                blend_backward, visited.size, TILES, coloured, *tiles, visited, reached, images[k + 1],
                transmittance, by_images[k], no_alpha, feature_sums,
            )  # fmt: skip
            run_parallel(gather_sums, count, GRAIN, *pair_arrays, feature_sums, sums)
            by_features[index, 3 * k : 3 * k + 3] = sums[:, G_RED:]
            pair_sums[:, :G_RED] += feature_sums[:, :G_RED]

        # kernels do not write the gradients of unselected splats; numpy's memory has large pages
        empty = np.empty if count == len(side.radii) else np.zeros
        gradients = [empty(tensor.shape, np.float32) for tensor in tensors]
        run_parallel(
            project_backward, count, GRAIN, *(tensor.detach().numpy() for tensor in tensors), *settings,
            index, passes[0], *pair_arrays, pair_sums,
            *gradients, side.grad2d.numpy(),
        )  # fmt: skip
        return (
            *map(torch.from_numpy, gradients),
            torch.from_numpy(by_features[:, : len(by_blended)]),
            *(None,) * 6,
        )


def _as_colours(features: np.ndarray, projected: np.ndarray) -> list[np.ndarray]:
    """Return copies of projected splats with their colours replaced by three features each, padded by
    zeros."""
    copies = []
    for first in range(0, features.shape[1], 3):
        coloured = projected.copy()
        triple = features[:, first : first + 3]
        coloured[:, RED : BLUE + 1] = 0
        coloured[:, RED : RED + triple.shape[1]] = triple
        copies.append(coloured)
    return copies


@serialised
def contributions(
    gaussians: Gaussians, weights: torch.Tensor | None, settings: RasterSettings
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return largest weights, sums, pixel counts and radii of one view; see :mod:`training.rasterize`."""
    count = len(gaussians)
    view = settings.view
    gaussians = replace(gaussians, sh=gaussians.means.new_zeros(count, 1, 3))
    weights = gaussians.means.new_ones(0) if weights is None else weights
    tensors = *vars(gaussians).values(), weights
    splats = [tensor.detach().contiguous().numpy() for tensor in tensors]
    radii = torch.zeros(count)
    buffers = Buffers()
    index, projected, pairs = _project_and_bin(
        splats, _rows(settings), _kernel_settings(settings), view, radii, buffers
    )
    pair_weights = buffers.take("pair_weights", np.float32, len(pairs.splat), 3)
    row_weights = np.empty((len(index), 3), np.float32)
    all_weights = np.zeros((count, 3), np.float32)
    run_parallel(
        blend_weights, len(pairs.tile_start) - 1, TILES, projected, pairs.splat, pairs.tile_start,
        -(-view.width // TILE), view.width, view.height, pair_weights,
    )  # fmt: skip
    run_parallel(
        gather_weights, len(index), GRAIN, pairs.first, pairs.count, pairs.row, pair_weights, row_weights
    )
    all_weights[index] = row_weights
    largest, total, pixels = torch.from_numpy(all_weights).unbind(1)
    return largest, total, pixels.long(), radii


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    if "cpu" not in target.cache:
        target.cache["cpu"] = np.ascontiguousarray(target.image.permute(2, 0, 1).float().numpy())
    return _Photometric.apply(image.permute(2, 0, 1), target, ssim_weight)  # type: ignore[no-any-return]


class _Photometric(torch.autograd.Function):
    @staticmethod
    @serialised
    def forward(ctx, planes, target, ssim_weight):
        image = planes.detach().contiguous().numpy()
        loss, gradient = loss_and_gradient(image, target.cache["cpu"], ssim_weight)
        ctx.gradient = torch.from_numpy(gradient)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx, by_loss):
        return (ctx.gradient if by_loss == 1 else ctx.gradient * by_loss), None, None
