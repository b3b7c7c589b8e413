"""Rasterizer for NVIDIA GPUs: CUDA kernels with analytic gradients, compiled at run time (``driver``).

The stages are those of the gpu backend. ``project`` projects splats to ellipses and counts their tiles, torch
sorts them by depth and their pairs with tiles by tile, and ``blend`` renders pixels. Gradients are summed in
the order in which threads finish, so results are not bit-reproducible.
"""

from __future__ import annotations

import sys
from collections.abc import MutableMapping
from dataclasses import replace
from functools import cache

import torch

from ...errors import LodgsError
from ..adam import Adam
from ..gaussians import Gaussians
from ..rendering import BackendOutput, RasterSettings, SideOutputs, Target
from ..self_test import find_difference
from . import driver
from .card_model import TENSORS, CardModel
from .frame import (
    THREADS,
    TILE,
    CardFrame,
    PhotometricLoss,
    Projected,
    TileLists,
    image_structure,
    upload_photo,
)
from .source import kernel_source

DEVICE = "cuda"


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


def make_step_model(
    adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool
) -> CardModel | None:
    """See :func:`training.rasterize.make_step_model`."""
    return CardModel(adam, stats, antialias) if set(TENSORS) <= set(adam.tensors) else None


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
        "weigh", tiles.count, THREADS, image_structure(settings.view), tiles.starts, tiles.pairs,
        projected.rows, projected.colors, largest, total, pixels,
    )  # fmt: skip
    return largest.view(torch.float32), total, pixels.long(), projected.radii


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    _check(image)
    return _Photometric.apply(image, upload_photo(target, image), ssim_weight)  # type: ignore[no-any-return]


def _check(*tensors: torch.Tensor | None) -> None:
    for tensor in tensors:
        if tensor is not None and (tensor.dtype != torch.float32 or tensor.device.type != DEVICE):
            raise ValueError(
                f"the cuda backend requires float32 on a GPU, not {tensor.dtype} on {tensor.device}"
            )


class _Rasterize(torch.autograd.Function):
    """Rasterization as an autograd function; extra passes blend features like colours, three at a time."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, logits, sh, weights, features, settings, side):
        ctx.set_materialize_grads(False)
        parameters = [tensor.contiguous() for tensor in (means, quats, log_scales, logits, sh)]
        weights = None if weights is None else weights.contiguous()
        frame = CardFrame(Gaussians(*parameters), weights, settings)
        padded = torch.nn.functional.pad(features, (0, -features.shape[1] % 3))
        shades = [part.contiguous() for part in padded.split(3, 1) if part.shape[1]]
        limit = None if settings.limit is None else settings.limit.to(means).contiguous()
        image = frame.blend(frame.projected.colors, settings.background, limit, side.median)
        images = [frame.blend(shade, limit=limit) for shade in shades]
        side.radii.copy_(frame.projected.radii)
        side.tile_counts.copy_(frame.tiles.starts.diff().view(side.tile_counts.shape))
        ctx.save_for_backward(*parameters, weights, features)
        ctx.saved = frame, [frame.projected.colors, *shades], [image, *images], settings, side
        blended = torch.cat([image[..., :0], *images], 2)
        return image, 1 - frame.light, blended[..., : features.shape[1]].contiguous()

    @staticmethod
    def backward(ctx, by_image, by_alpha, by_features):
        *_, weights, features = ctx.saved_tensors  # autograd then detects changes in place
        frame, shades, images, settings, side = ctx.saved
        by_parts = [by_image]
        if len(shades) > 1:
            width = 3 * (len(shades) - 1)
            if by_features is None:
                by_parts += [None] * (len(shades) - 1)
            else:
                padded = torch.nn.functional.pad(by_features, (0, width - by_features.shape[2]))
                by_parts += padded.split(3, 2)
        sums = frame.new_sums()
        by_shades = [
            frame.differentiate(
                shade, image, by_part, None if k else by_alpha, sums, settings.absolute and not k
            )
            for k, (shade, image, by_part) in enumerate(zip(shades, images, by_parts, strict=True))
        ]
        by_weights = torch.empty_like(weights) if ctx.needs_input_grad[5] else None
        side.grad2d.zero_()
        if side.absgrad2d is not None:
            side.absgrad2d.zero_()
        gradients = frame.project_backward(sums, by_shades[0], side.grad2d, side.absgrad2d, by_weights)
        by_values = None
        if ctx.needs_input_grad[6]:
            by_values = torch.cat([features[:, :0], *by_shades[1:]], 1)[:, : features.shape[1]]
        return *gradients, by_weights, by_values, None, None


class _Photometric(torch.autograd.Function):
    """Photometric loss as an autograd function."""

    @staticmethod
    def forward(ctx, image, photo, ssim_weight):
        image = image.detach().contiguous()
        loss = PhotometricLoss(image, photo, ssim_weight)
        ctx.save_for_backward(image)  # autograd then detects changes in place
        ctx.loss = loss
        return loss.value

    @staticmethod
    def backward(ctx, by_loss):
        _ = ctx.saved_tensors
        return ctx.loss.gradient(by_loss), None, None
