"""Rasterizer for any graphics device: WGSL compute shaders through wgpu, with analytic gradients.

The stages are those of the cpu backend: ``project`` projects splats to ellipses, ``bin`` sorts them into
tiles and ``blend`` renders pixels. Gradients are first summed per pair of splat and tile, then per splat in a
fixed order. No atomics add floats, so a device gives the same bits every time.

Tensors are on the CPU. The inputs of an image are copied to the device, and the results back. In training,
plain splats can stay on the device (``device_model``).
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
from .default_device import open_default_device
from .device import Buffer, Device
from .device_model import COLUMNS, STATS, GpuModel, pack_splats
from .loss import loss_and_gradient
from .scene import BY_SPLAT, PAIR_SUMS, ProjectedScene


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Raise ValueError unless tensors are float32 on the CPU.

    Raises:
        LodgsError: no device is available, or it was lost or has too little memory.
    """
    count = len(gaussians)
    weights = torch.ones(0) if weights is None else weights
    tensors = *vars(gaussians).values(), weights, features
    require_plain(tensors, "gpu")
    side = SideOutputs.of(count, settings, TILE)
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
    device = open_default_device()
    gaussians = replace(gaussians, sh=gaussians.means.new_zeros(count, 1, 3))
    weights = torch.ones(0) if weights is None else weights
    with device.lock:
        scene, index = _upload_scene(device, [*vars(gaussians).values(), weights], settings)
        all_weights = np.zeros((count, 3), np.float32)
        radii = np.zeros(count, np.float32)
        all_weights[index] = device.read(scene.weigh())
        radii[index] = device.read(scene.radii)
    largest, total, pixels = torch.from_numpy(all_weights).unbind(1)
    return largest, total, pixels.long(), torch.from_numpy(radii)


def make_step_model(adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool) -> GpuModel | None:
    """See :func:`training.rasterize.make_step_model`."""
    if not {*COLUMNS, "sh"} <= set(adam.tensors) or not set(stats) <= set(STATS):
        return None
    return GpuModel(open_default_device(), adam, stats, antialias) if len(adam.tensors["means"]) else None


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    return _Photometric.apply(image, target, ssim_weight)  # type: ignore[no-any-return]


class _Rasterize(torch.autograd.Function):
    """Rasterization as an autograd function; extra passes blend features like colours, three at a time."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, logits, sh, weights, features, settings, side):
        tensors = [means, quats, log_scales, logits, sh, weights]
        device = open_default_device()
        view = settings.view
        with device.lock:
            scene, index = _upload_scene(device, tensors, settings)
            limit = np.zeros(1, np.float32)
            if settings.limit is not None:  # not every device supports infinity
                maximum = torch.finfo(torch.float32).max
                limit = settings.limit.to(torch.float32).clamp_max(maximum).numpy()
            limit = device.upload(limit)
            visited = device.empty(np.uint32, *scene.ranges.shape)
            median = device.empty(np.int32, view.height, view.width)
            shades = [scene.colors, *_as_colors(device, features.detach().numpy()[index])]
            images = [device.empty(np.float32, view.height, view.width, 4) for _ in shades]
            for k, (shade, image) in enumerate(zip(shades, images, strict=True)):
                scene.draw(
                    (0.0, 0.0, 0.0) if k else settings.background, settings.limit is not None,
                    colors=shade, limit=limit, drawn=image, visited=visited, median=median,
                )  # fmt: skip
            drawn, *blended = (torch.from_numpy(device.read(image)) for image in images)
            side.radii.numpy()[index] = device.read(scene.radii)
            begin, end = device.read(scene.ranges).astype(np.int64).T
            side.tile_counts.numpy()[:] = (end - begin).reshape(side.tile_counts.shape)
            if side.median is not None:
                side.median.numpy()[:] = np.append(index, -1)[device.read(median)]
        ctx.save_for_backward(*tensors)
        ctx.saved = scene, index, shades, images, visited, settings, side
        blended = [drawn[..., :0], *(image[..., :3] for image in blended)]
        features = torch.cat(blended, 2)[..., : features.shape[1]]
        return drawn[..., :3].contiguous(), 1 - drawn[..., 3], features.contiguous()

    @staticmethod
    def backward(ctx, by_image, by_alpha, by_features):
        scene, index, shades, images, visited, settings, side = ctx.saved
        device = scene.device
        count = scene.count
        sums = device.scratch(np.float32, count, PAIR_SUMS)
        by_shades = [None, *(device.empty(np.float32, count, 3) for _ in shades[1:])]
        with device.lock:
            for k, (shade, image, by_shade) in enumerate(zip(shades, images, by_shades, strict=True)):
                output_gradient = np.zeros(image.shape, np.float32)
                if k:
                    triple = by_features[..., 3 * k - 3 : 3 * k]
                    output_gradient[..., : triple.shape[2]] = triple
                else:
                    output_gradient[..., :3] = by_image
                    output_gradient[..., 3] = by_alpha
                scene.differentiate(
                    sums, visited, settings.absolute and k == 0, by_shade, colors=shade, image=image,
                    by_image=device.upload(output_gradient),
                )  # fmt: skip
            by_splats = device.empty(np.float32, count, BY_SPLAT)
            by_sh = device.empty(np.float32, *scene.sh.shape)
            scene.backward(sums, by_splats, by_sh)
            splat_gradients = device.read(by_splats)
            sh_gradients = device.read(by_sh)
            feature_gradients = [device.read(by_shade) for by_shade in by_shades if by_shade is not None]
        gradients = [torch.zeros_like(tensor, requires_grad=False) for tensor in ctx.saved_tensors]
        parts = [slice(0, 3), slice(4, 8), slice(8, 11), 3]
        for gradient, part in zip(gradients, parts, strict=False):
            gradient.numpy()[index] = splat_gradients[:, part]
        gradients[4].numpy()[index, : sh_gradients.shape[1]] = sh_gradients
        if len(gradients[5]):
            gradients[5].numpy()[index] = splat_gradients[:, 11]
        side.grad2d.numpy()[index] = splat_gradients[:, 12:14]
        if side.absgrad2d is not None:
            side.absgrad2d.numpy()[index] = splat_gradients[:, 14:16]
        all_features = np.zeros((len(gradients[0]), by_features.shape[2]), np.float32)
        if feature_gradients:
            all_features[index] = np.concatenate(feature_gradients, 1)[:, : by_features.shape[2]]
        return *gradients, torch.from_numpy(all_features), None, None


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, ssim_weight):
        device = open_default_device()
        with device.lock:
            if target.cache.get("gpu", (None,))[0] is not device:
                target.cache["gpu"] = device, device.upload(target.image.float().numpy())
            _, photo = target.cache["gpu"]
            drawn = device.upload(np.pad(image.detach().numpy(), ((0, 0), (0, 0), (0, 1))))
            loss, gradient = loss_and_gradient(device, drawn, photo, ssim_weight)
            ctx.gradient = torch.from_numpy(np.ascontiguousarray(gradient[..., :3]))
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx, by_loss):
        return (ctx.gradient if by_loss == 1 else ctx.gradient * by_loss), None, None


def _upload_scene(
    device: Device, tensors: list[torch.Tensor], settings: RasterSettings
) -> tuple[ProjectedScene, np.ndarray]:
    """Copy the considered splats with positive weight to a device; return their scene and indices (M,).

    Args:
        tensors: means, quats, log-scales, logits, coefficients and weights; weights are empty if all are 1.
    """
    arrays = [tensor.detach().numpy() for tensor in tensors]
    weights = arrays[-1]
    index = np.arange(len(arrays[0])) if settings.rows is None else settings.rows.numpy()
    index = index[weights[index] > 0] if len(weights) else index
    filtered = np.broadcast_to(np.asarray(settings.antialias), len(arrays[0]))[index]
    weights = weights[index] if len(weights) else 1
    splats = pack_splats(*(array[index] for array in arrays[:4]), weights=weights, filtered=filtered)
    sh = device.upload(arrays[4][index, : (settings.degree + 1) ** 2])
    return ProjectedScene.of(device, device.upload(splats), sh, settings), index


def _as_colors(device: Device, features: np.ndarray) -> list[Buffer]:
    """Upload features (M, F) as colours (M, 4), three per buffer, padded by zeros."""
    buffers = []
    for first in range(0, features.shape[1], 3):
        triple = features[:, first : first + 3]
        buffers.append(device.upload(np.pad(triple, ((0, 0), (0, 4 - triple.shape[1])))))
    return buffers
