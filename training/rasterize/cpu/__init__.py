"""The rasterizer on the CPU: Numba kernels, gradients by hand, the same bits on any number of threads.

``project`` makes ellipses of splats, ``bin`` sorts them into tiles, ``blend`` makes pixels of them; ``loss``
compares with a photograph and ``adam`` takes the step. This page joins them to torch's autograd.

torch's own thread pool beside Numba's slows the kernels by half and more: a trainer that uses this backend
calls ``torch.set_num_threads(1)``.
"""

from __future__ import annotations

import numpy as np
import torch

from ..rendering import Drawn, Target, View
from .bin import TILE, bin_splats
from .blend import blend_backward, blend_forward, blend_median
from .compile import f32, in_parallel, scratch, serialised
from .loss import loss_and_gradient, moments_of
from .project import (
    BLUE,
    COLUMNS,
    G_RED,
    GRAIN,
    RED,
    SUMS,
    gather_sums,
    lens_of,
    project_backward,
    project_forward,
)

TILES = 16
"""How many tiles a thread takes at a time."""


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    weights: torch.Tensor | None,
    features: torch.Tensor,
    *,
    view: View,
    background: tuple[float, float, float],
    degree: int,
    min_scale: float,
    antialias: bool,
    median: bool,
) -> Drawn:
    """See :func:`training.rasterize.rasterize`. Tensors are float32 on the CPU; ValueError otherwise.

    The image is laid out in planes: ``image.permute(2, 0, 1)`` is contiguous.
    """
    weights = torch.ones(0) if weights is None else weights
    for tensor in (means, quats, log_scales, opacity_logits, sh, weights, features):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"the cpu backend takes float32 on the CPU, not {tensor.dtype} on {tensor.device}"
            )
    radii, grad2d = torch.zeros(len(means)), torch.zeros(len(means))
    middle = torch.full((view.height, view.width), -1, dtype=torch.int32) if median else None
    planes, alpha, blended = _Rasterize.apply(
        means, quats, log_scales, opacity_logits, sh, weights, features,
        view, background, degree, min_scale, antialias, radii, grad2d, middle,
    )  # fmt: skip
    return Drawn(planes.permute(1, 2, 0), alpha, radii, grad2d, blended.permute(1, 2, 0), middle)


class _Rasterize(torch.autograd.Function):
    """Features are blended as colours are, three to a pass that leaves everything else as it was."""

    @staticmethod
    @serialised
    def forward(
        ctx, means, quats, log_scales, logits, sh, weights, features,
        view, background, degree, min_scale, antialias, radii, grad2d, median,
    ):  # fmt: skip
        tensors = [tensor.contiguous() for tensor in (means, quats, log_scales, logits, sh, weights)]
        splats = [tensor.detach().numpy() for tensor in tensors]
        count = len(means)
        settings = (*lens_of(view), view.width, view.height, degree, f32(min_scale), antialias)
        projected = np.empty((count, COLUMNS), np.float32)
        depth = np.empty(count, np.float32)
        in_parallel(project_forward, count, GRAIN, *splats, *settings, projected, depth, radii.numpy())
        pairs = bin_splats(projected, depth, radii.numpy(), view.width, view.height)

        transmittance = np.empty((view.height, view.width), np.float32)
        walked = np.empty(len(pairs.tile_start) - 1, np.int64)
        tiles = pairs.splat, pairs.tile_start, -(-view.width // TILE)
        passes = [(projected, np.array(background, np.float32))]
        passes += [(coloured, np.zeros(3, np.float32)) for coloured in _as_colours(features, projected)]
        images = []
        for coloured, behind in passes:
            image = np.empty((3, view.height, view.width), np.float32)
            in_parallel(
                blend_forward, len(walked), TILES, coloured, *tiles, behind, image, transmittance, walked
            )
            images.append(image)
        if median is not None:
            in_parallel(blend_median, len(walked), TILES, projected, *tiles, walked, median.numpy())
        ctx.save_for_backward(*tensors)
        ctx.rest = (
            settings,
            [p for p, _ in passes],
            pairs,
            tiles,
            walked,
            images,
            transmittance,
            radii,
            grad2d,
        )
        blended = np.concatenate(images[1:])[: features.shape[1]] if len(images) > 1 else image[:0]
        return tuple(map(torch.from_numpy, (images[0], 1 - transmittance, blended)))

    @staticmethod
    @serialised
    def backward(ctx, by_planes, by_alpha, by_blended):
        settings, passes, pairs, tiles, walked, images, transmittance, radii, grad2d = ctx.rest
        tensors = ctx.saved_tensors
        pair_sums = scratch("pair_sums", len(pairs.splat), SUMS)
        in_parallel(
            blend_backward, len(walked), TILES, passes[0], *tiles, walked, images[0], transmittance,
            by_planes.contiguous().numpy(), by_alpha.contiguous().numpy(), pair_sums,
        )  # fmt: skip
        by_features = torch.zeros(len(radii), by_blended.shape[0])
        if len(passes) > 1:
            further, no_alpha = scratch("further_sums", *pair_sums.shape), np.zeros_like(transmittance)
            by_image = np.zeros((3 * (len(passes) - 1), *transmittance.shape), np.float32)
            by_image[: len(by_blended)] = by_blended.numpy()
            for k, coloured in enumerate(passes[1:]):
                in_parallel(
                    blend_backward, len(walked), TILES, coloured, *tiles, walked, images[k + 1],
                    transmittance, by_image[3 * k : 3 * k + 3], no_alpha, further,
                )  # fmt: skip
                pair_sums[:, :G_RED] += further[:, :G_RED]
                by_three = np.zeros((len(radii), SUMS), np.float32)
                in_parallel(
                    gather_sums, len(radii), GRAIN, pairs.first, pairs.count, pairs.row, further, by_three
                )
                mine = by_features[:, 3 * k : 3 * k + 3]
                mine.copy_(torch.from_numpy(by_three[:, G_RED : G_RED + mine.shape[1]]))
        gradients = [torch.empty_like(tensor, requires_grad=False) for tensor in tensors]
        in_parallel(
            project_backward, len(radii), GRAIN,
            *(tensor.detach().numpy() for tensor in tensors), *settings, passes[0], radii.numpy(),
            pairs.first, pairs.count, pairs.row, pair_sums,
            *(gradient.numpy() for gradient in gradients), grad2d.numpy(),
        )  # fmt: skip
        return *gradients, by_features, *[None] * 8


def _as_colours(features: torch.Tensor, projected: np.ndarray) -> list[np.ndarray]:
    """Projected splats with three features each in the place of their colours, zeros where they run out."""
    found = []
    for first in range(0, features.shape[1], 3):
        coloured = projected.copy()
        three = features[:, first : first + 3].detach().numpy()
        coloured[:, RED : BLUE + 1] = 0
        coloured[:, RED : RED + three.shape[1]] = three
        found.append(coloured)
    return found


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


def warm_up() -> None:
    """Compile the kernels, or read them from the cache: one step on one splat."""
    from ...scenes.cameras import Camera
    from ..adam import Adam

    tensors = {
        "means": torch.tensor([[0.0, 0.0, 1.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "log_scales": torch.zeros(1, 3),
        "opacity_logits": torch.zeros(1),
        "sh": torch.zeros(1, 1, 3),
    }
    for tensor in tensors.values():
        tensor.requires_grad_()
    view = View.of(Camera("", 16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4)), 0.01)
    drawn = rasterize(
        **tensors, weights=None, features=torch.zeros(1, 0), view=view, background=(0.0, 0.0, 0.0), degree=0,
        min_scale=0.0, antialias=False, median=False,
    )  # fmt: skip
    photometric_loss(drawn.image, Target(torch.zeros(16, 16, 3)), 0.2).backward()
    Adam(tensors, dict.fromkeys(tensors, 0.0)).step()
