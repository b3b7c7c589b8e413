"""CPU rasterizer: Numba kernels with analytic gradients, bit-identical for any number of threads.

``project`` projects splats to ellipses, ``bin`` sorts them into tiles, ``blend`` renders pixels, ``loss``
compares the image with a photo, and ``adam`` updates the parameters. This module connects them to torch's
autograd.

torch's own thread pool slows the kernels by half or more. A trainer that uses this backend should call
``torch.set_num_threads(1)``.
"""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import replace

import numpy as np
import torch

from ..adam import Adam
from ..gaussians import Gaussians
from ..rendering import BackendOutput, RasterSettings, SideOutputs, Target, require_plain
from .bin import TILE
from .blend import blend_weights
from .compile import Buffers, run_parallel, serialized
from .frame import TILES, HostFrame
from .host_model import TENSORS, HostModel, image_planes
from .loss import loss_and_gradient
from .project import BLUE, G_RED, LN2, RED, SUMS
from .project_backward import gather_sums, gather_weights


def make_step_model(
    adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool
) -> HostModel | None:
    """See :func:`training.rasterize.make_step_model`."""
    return HostModel(adam, stats, antialias) if set(TENSORS) <= set(adam.tensors) else None


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Raise ValueError unless tensors are float32 on the CPU.

    The image is stored in planes: ``image.permute(2, 0, 1)`` is contiguous.
    """
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
        *tensors, _rows(settings), settings, background, None if limit is None else limit.numpy(), side,
    )  # fmt: skip
    return BackendOutput(
        image=planes.permute(1, 2, 0), alpha=alpha, radii=side.radii, grad2d=side.grad2d,
        tile_counts=side.tile_counts, absgrad2d=side.absgrad2d, features=blended.permute(1, 2, 0),
        median=side.median,
    )  # fmt: skip


def _rows(settings: RasterSettings) -> np.ndarray | None:
    return None if settings.rows is None else settings.rows.to(torch.int32).contiguous().numpy()


class _Rasterize(torch.autograd.Function):
    """Rasterization as an autograd function; extra passes blend features like colours, three at a time."""

    @staticmethod
    @serialized
    def forward(
        ctx, means, quats, log_scales, logits, sh, weights, features, rows, settings, background, limit, side
    ):
        tensors = [tensor.contiguous() for tensor in (means, quats, log_scales, logits, sh, weights)]
        frame = HostFrame([t.detach().numpy() for t in tensors], rows, settings, side.radii.numpy())
        counts = side.tile_counts.numpy()
        counts[:] = np.diff(frame.pairs.tile_start).reshape(counts.shape)
        feature_array = features.detach().numpy()
        passes = [frame.projected]
        if feature_array.shape[1]:
            passes += _as_colors(feature_array[frame.index], frame.projected)
        height, width = frame.transmittance.shape
        images = np.empty((len(passes), 3, height, width), np.float32)
        for colored, image in zip(passes, images, strict=True):
            pass_background = background if colored is frame.projected else np.zeros_like(background)
            frame.blend(colored, pass_background, image, limit)
        if side.median is not None:
            frame.blend_median(limit, side.median.numpy())
        ctx.save_for_backward(*tensors)  # autograd then detects changes in place
        ctx.saved = frame, side, passes, images
        blended = images[1:].reshape(-1, height, width)[: features.shape[1]]
        return tuple(map(torch.from_numpy, (images[0], 1 - frame.transmittance, blended)))

    @staticmethod
    @serialized
    def backward(ctx, by_planes, by_alpha, by_blended):
        frame, side, passes, images = ctx.saved
        tensors = ctx.saved_tensors
        count = len(frame.index)
        columns = SUMS if side.absgrad2d is None else SUMS + 2
        working = Buffers()
        pair_sums = working.take("pair_sums", np.float32, len(frame.pairs.splat), columns)
        gradients_of_images = by_planes.contiguous().numpy(), by_alpha.contiguous().numpy()
        frame.differentiate(passes[0], images[0], *gradients_of_images, pair_sums)
        if side.absgrad2d is not None:
            sums = np.zeros((count, columns), np.float32)
            frame.reduce(gather_sums, pair_sums, sums)
            height, width = frame.transmittance.shape
            half_size = np.array([width / 2, height / 2], np.float32)
            side.absgrad2d.numpy()[frame.index] = sums[:, SUMS:] * (half_size * LN2)

        by_features = np.zeros((len(side.radii), 3 * (len(passes) - 1)), np.float32)
        by_images = np.zeros_like(images[1:])
        by_images.reshape(-1, *frame.transmittance.shape)[: len(by_blended)] = by_blended.numpy()
        no_alpha = np.zeros_like(frame.transmittance)
        for k, colored in enumerate(passes[1:]):
            feature_sums = working.take(f"feature_sums {k}", np.float32, len(pair_sums), SUMS)
            sums = np.zeros((count, SUMS), np.float32)
            frame.differentiate(colored, images[k + 1], by_images[k], no_alpha, feature_sums)
            frame.reduce(gather_sums, feature_sums, sums)
            by_features[frame.index, 3 * k : 3 * k + 3] = sums[:, G_RED:]
            pair_sums[:, :G_RED] += feature_sums[:, :G_RED]

        # kernels do not write the gradients of unselected splats; numpy's memory has large pages
        empty = np.empty if count == len(side.radii) else np.zeros
        gradients = [empty(tensor.shape, np.float32) for tensor in tensors]
        frame.project_backward(pair_sums, gradients, side.grad2d.numpy())
        return (
            *map(torch.from_numpy, gradients),
            torch.from_numpy(by_features[:, : len(by_blended)]),
            *(None,) * 5,
        )


def _as_colors(features: np.ndarray, projected: np.ndarray) -> list[np.ndarray]:
    """Return copies of projected splats with their colours replaced by three features each, padded by
    zeros."""
    copies = []
    for first in range(0, features.shape[1], 3):
        colored = projected.copy()
        triple = features[:, first : first + 3]
        colored[:, RED : BLUE + 1] = 0
        colored[:, RED : RED + triple.shape[1]] = triple
        copies.append(colored)
    return copies


@serialized
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
    frame = HostFrame(splats, _rows(settings), settings, radii.numpy())
    pairs = frame.pairs
    pair_weights = frame.buffers.take("pair_weights", np.float32, len(pairs.splat), 3)
    row_weights = np.empty((len(frame.index), 3), np.float32)
    all_weights = np.zeros((count, 3), np.float32)
    run_parallel(
        blend_weights, len(frame.visited), TILES, frame.projected, pairs.splat, pairs.tile_start,
        -(-view.width // TILE), view.width, view.height, pair_weights,
    )  # fmt: skip
    frame.reduce(gather_weights, pair_weights, row_weights)
    all_weights[frame.index] = row_weights
    largest, total, pixels = torch.from_numpy(all_weights).unbind(1)
    return largest, total, pixels.long(), radii


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    return _Photometric.apply(image.permute(2, 0, 1), target, ssim_weight)  # type: ignore[no-any-return]


class _Photometric(torch.autograd.Function):
    @staticmethod
    @serialized
    def forward(ctx, planes, target, ssim_weight):
        image = planes.detach().contiguous().numpy()
        loss, gradient = loss_and_gradient(image, image_planes(target), ssim_weight)
        ctx.gradient = torch.from_numpy(gradient)
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx, by_loss):
        return (ctx.gradient if by_loss == 1 else ctx.gradient * by_loss), None, None
