"""The rasterizer on any graphics device: compute shaders in WGSL through wgpu, gradients by hand.

As the cpu backend: ``project`` makes ellipses of splats, ``bin`` sorts them into tiles, ``blend`` makes
pixels of them, and gradients are summed in a row of their own for each pair of splat and tile, then in a
fixed order for each splat. So nothing is added by atomics, and a device gives the same bits every time.

Tensors live on the CPU. What a picture needs is copied to the device, and what comes of it back. In training,
plain splats can stay there (``twin``).
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
from .device_model import COLUMNS, STATS, GpuModel, packed
from .loss import loss_and_gradient
from .scene import BY_SPLAT, GEOMETRY, SUMS, Scene


def rasterize(
    gaussians: Gaussians, weights: torch.Tensor | None, features: torch.Tensor, settings: RasterSettings
) -> BackendOutput:
    """See :func:`training.rasterize.rasterize`. Tensors are float32 on the CPU; ValueError otherwise.

    Raises:
        LodgsError: there is no device, it was lost, or has too little memory.
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
    """See :func:`training.rasterize.contributions`: of one view, the largest, the sum, pixels and radii."""
    count, device = len(gaussians), open_default_device()
    gaussians = replace(gaussians, sh=gaussians.means.new_zeros(count, 1, 3))
    weights = torch.ones(0) if weights is None else weights
    with device.lock:
        scene, some = _scene_of(device, [*vars(gaussians).values(), weights], settings)
        everywhere, radii = np.zeros((count, 3), np.float32), np.zeros(count, np.float32)
        everywhere[some], radii[some] = device.read(scene.weigh()), device.read(scene.radii)
    largest, total, pixels = torch.from_numpy(everywhere).unbind(1)
    return largest, total, pixels.long(), torch.from_numpy(radii)


def make_device_model(
    adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool
) -> GpuModel | None:
    """See :func:`training.rasterize.make_device_model`."""
    if not {*COLUMNS, "sh"} <= set(adam.tensors) or not set(stats) <= set(STATS):
        return None
    return GpuModel(open_default_device(), adam, stats, antialias) if len(adam.tensors["means"]) else None


def photometric_loss(image: torch.Tensor, target: Target, ssim_weight: float) -> torch.Tensor:
    """See :func:`training.rasterize.photometric_loss`."""
    return _Photometric.apply(image, target, ssim_weight)  # type: ignore[no-any-return]


class _Rasterize(torch.autograd.Function):
    """Features are blended as colours are, three to a pass that leaves everything else as it was."""

    @staticmethod
    def forward(ctx, means, quats, log_scales, logits, sh, weights, features, settings, side):
        tensors, device, view = (
            [means, quats, log_scales, logits, sh, weights],
            open_default_device(),
            settings.view,
        )
        with device.lock:
            scene, some = _scene_of(device, tensors, settings)
            limit = np.zeros(1, np.float32)
            if settings.limit is not None:  # not every device knows an infinity
                most = torch.finfo(torch.float32).max
                limit = settings.limit.to(torch.float32).clamp_max(most).numpy()
            limit, walked = device.upload(limit), device.empty(np.uint32, *scene.ranges.shape)
            median = device.empty(np.int32, view.height, view.width)
            shades = [scene.colours, *_as_colours(device, features.detach().numpy()[some])]
            pictures = [device.empty(np.float32, view.height, view.width, 4) for _ in shades]
            for k, (shade, picture) in enumerate(zip(shades, pictures, strict=True)):
                scene.draw(
                    (0.0, 0.0, 0.0) if k else settings.background, settings.limit is not None,
                    colours=shade, limit=limit, drawn=picture, walked=walked, median=median,
                )  # fmt: skip
            drawn, *blended = (torch.from_numpy(device.read(picture)) for picture in pictures)
            side.radii.numpy()[some] = device.read(scene.radii)
            begin, end = device.read(scene.ranges).astype(np.int64).T
            side.tile_counts.numpy()[:] = (end - begin).reshape(side.tile_counts.shape)
            if side.median is not None:
                found = device.read(median)
                side.median.numpy()[:] = np.append(some, -1)[found]
        ctx.save_for_backward(*tensors)
        ctx.rest = scene, some, shades, pictures, walked, settings, side
        blended = [drawn[..., :0], *(each[..., :3] for each in blended)]
        features = torch.cat(blended, 2)[..., : features.shape[1]]
        return drawn[..., :3].contiguous(), 1 - drawn[..., 3], features.contiguous()

    @staticmethod
    def backward(ctx, by_image, by_alpha, by_features):
        scene, some, shades, pictures, walked, settings, side = ctx.rest
        device, count = scene.device, scene.count
        sums = device.empty(np.float32, count, SUMS)
        by_shades = [device.empty(np.float32, count, 3) for _ in shades]
        with device.lock:
            for k, (shade, picture, by_shade) in enumerate(zip(shades, pictures, by_shades, strict=True)):
                by_picture = np.zeros(picture.shape, np.float32)
                if k:
                    three = by_features[..., 3 * k - 3 : 3 * k]
                    by_picture[..., : three.shape[2]] = three
                else:
                    by_picture[..., :3], by_picture[..., 3] = by_image, by_alpha
                scene.differentiate(
                    GEOMETRY if k else SUMS, settings.absolute and k == 0, sums, by_shade, walked,
                    colours=shade, picture=picture, by_picture=device.upload(by_picture),
                )  # fmt: skip
            by_splats = device.empty(np.float32, count, BY_SPLAT)
            by_sh = device.empty(np.float32, *scene.sh.shape)
            scene.backward(sums, by_shades[0], by_splats, by_sh)
            found, of_sh = device.read(by_splats), device.read(by_sh)
            of_features = [device.read(by_shade) for by_shade in by_shades[1:]]
        gradients = [torch.zeros_like(tensor, requires_grad=False) for tensor in ctx.saved_tensors]
        parts = [slice(0, 3), slice(4, 8), slice(8, 11), 3]
        for gradient, part in zip(gradients, parts, strict=False):
            gradient.numpy()[some] = found[:, part]
        gradients[4].numpy()[some, : of_sh.shape[1]] = of_sh
        if len(gradients[5]):
            gradients[5].numpy()[some] = found[:, 11]
        side.grad2d.numpy()[some] = found[:, 12:14]
        if side.absgrad2d is not None:
            side.absgrad2d.numpy()[some] = found[:, 14:16]
        of_all = np.zeros((len(gradients[0]), by_features.shape[2]), np.float32)
        if of_features:
            of_all[some] = np.concatenate(of_features, 1)[:, : by_features.shape[2]]
        return *gradients, torch.from_numpy(of_all), None, None


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx, image, target, ssim_weight):
        device = open_default_device()
        with device.lock:
            if target.cache.get("gpu", (None,))[0] is not device:
                target.cache["gpu"] = device, device.upload(_planes(target.image.float()))
            _, truth = target.cache["gpu"]
            shown = device.upload(_planes(image.detach()))
            loss, gradient = loss_and_gradient(device, shown, truth, ssim_weight)
            ctx.gradient = torch.from_numpy(device.read(gradient)).permute(1, 2, 0).contiguous()
        return torch.tensor(loss, dtype=torch.float32)

    @staticmethod
    def backward(ctx, by_loss):
        return (ctx.gradient if by_loss == 1 else ctx.gradient * by_loss), None, None


def _scene_of(
    device: Device, tensors: list[torch.Tensor], settings: RasterSettings
) -> tuple[Scene, np.ndarray]:
    """Those splats that have a weight and are looked at, copied to a device, and which (M,) they are.

    Args:
        tensors: means, quats, log-scales, logits, coefficients and weights; the last are empty for ones.
    """
    arrays = [tensor.detach().numpy() for tensor in tensors]
    weights = arrays[-1]
    some = np.arange(len(arrays[0])) if settings.rows is None else settings.rows.numpy()
    some = some[weights[some] > 0] if len(weights) else some
    filtered = np.broadcast_to(np.asarray(settings.antialias), len(arrays[0]))[some]
    weights = weights[some] if len(weights) else 1
    splats = packed(*(array[some] for array in arrays[:4]), weights=weights, filtered=filtered)
    sh = device.upload(arrays[4][some, : (settings.degree + 1) ** 2])
    return Scene.of(device, device.upload(splats), sh, settings), some


def _planes(image: torch.Tensor) -> np.ndarray:
    """(3, H, W) of an image (H, W, 3)."""
    return image.permute(2, 0, 1).numpy()


def _as_colours(device: Device, features: np.ndarray) -> list[Buffer]:
    """Features (M, F) as colours (M, 4), three at a time, zeros where they run out."""
    found = []
    for first in range(0, features.shape[1], 3):
        three = features[:, first : first + 3]
        found.append(device.upload(np.pad(three, ((0, 0), (0, 4 - three.shape[1])))))
    return found
