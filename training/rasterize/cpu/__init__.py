"""The rasterizer on the CPU: Numba kernels, gradients by hand, the same bits on any number of threads.

``project`` makes ellipses of splats, ``bin`` sorts them into tiles, ``blend`` makes pixels of them; ``loss``
compares with a photograph and ``adam`` takes the step. This page joins them to torch's autograd.

torch's own thread pool beside Numba's slows the kernels by half and more: a trainer that uses this backend
calls ``torch.set_num_threads(1)``.
"""

from __future__ import annotations

import numpy as np
import torch

from ..rendering import Rendering, Target, View
from .bin import TILE, bin_splats
from .blend import blend_backward, blend_forward
from .compile import f32, in_parallel, scratch, serialised
from .loss import loss_and_gradient, moments_of
from .project import COLUMNS, GRAIN, SUMS, lens_of, project_backward, project_forward

TILES = 16
"""How many tiles a thread takes at a time."""


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    weights: torch.Tensor | None,
    *,
    view: View,
    background: tuple[float, float, float],
    degree: int,
    min_scale: float,
) -> Rendering:
    """See :func:`training.rasterize.rasterize`. Tensors are float32 on the CPU; ValueError otherwise.

    The image is laid out in planes: ``image.permute(2, 0, 1)`` is contiguous.
    """
    weights = torch.ones(0) if weights is None else weights
    for tensor in (means, quats, log_scales, opacity_logits, sh, weights):
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"the cpu backend takes float32 on the CPU, not {tensor.dtype} on {tensor.device}"
            )
    radii, grad2d = torch.zeros(len(means)), torch.zeros(len(means))
    planes, alpha = _Rasterize.apply(
        means, quats, log_scales, opacity_logits, sh, weights,
        view, background, degree, min_scale, radii, grad2d,
    )  # fmt: skip
    return Rendering(planes.permute(1, 2, 0), alpha, radii, grad2d)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    @serialised
    def forward(
        ctx, means, quats, log_scales, logits, sh, weights, view, background, degree, min_scale, radii, grad2d
    ):
        tensors = [tensor.contiguous() for tensor in (means, quats, log_scales, logits, sh, weights)]
        splats = [tensor.detach().numpy() for tensor in tensors]
        count = len(means)
        settings = (*lens_of(view), view.width, view.height, degree, f32(min_scale))
        projected = np.empty((count, COLUMNS), np.float32)
        depth = np.empty(count, np.float32)
        in_parallel(project_forward, count, GRAIN, *splats, *settings, projected, depth, radii.numpy())
        pairs = bin_splats(projected, depth, radii.numpy(), view.width, view.height)

        image = np.empty((3, view.height, view.width), np.float32)
        transmittance = np.empty((view.height, view.width), np.float32)
        walked = np.empty(len(pairs.tile_start) - 1, np.int64)
        tiles_x = -(-view.width // TILE)
        in_parallel(
            blend_forward, len(walked), TILES, projected, pairs.splat, pairs.tile_start, tiles_x,
            np.array(background, np.float32), image, transmittance, walked,
        )  # fmt: skip
        ctx.save_for_backward(*tensors)
        ctx.rest = settings, projected, pairs, tiles_x, walked, image, transmittance, radii, grad2d
        return torch.from_numpy(image), torch.from_numpy(1 - transmittance)

    @staticmethod
    @serialised
    def backward(ctx, by_planes, by_alpha):
        settings, projected, pairs, tiles_x, walked, image, transmittance, radii, grad2d = ctx.rest
        tensors = ctx.saved_tensors
        pair_sums = scratch("pair_sums", len(pairs.splat), SUMS)
        in_parallel(
            blend_backward, len(walked), TILES, projected, pairs.splat, pairs.tile_start, tiles_x, walked,
            image, transmittance, by_planes.contiguous().numpy(), by_alpha.contiguous().numpy(), pair_sums,
        )  # fmt: skip
        gradients = [torch.empty_like(tensor, requires_grad=False) for tensor in tensors]
        in_parallel(
            project_backward, len(radii), GRAIN,
            *(tensor.detach().numpy() for tensor in tensors), *settings, projected, radii.numpy(),
            pairs.first, pairs.count, pairs.row, pair_sums,
            *(gradient.numpy() for gradient in gradients), grad2d.numpy(),
        )  # fmt: skip
        return *gradients, None, None, None, None, None, None


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
    drawn = rasterize(**tensors, weights=None, view=view, background=(0.0, 0.0, 0.0), degree=0, min_scale=0.0)
    photometric_loss(drawn.image, Target(torch.zeros(16, 16, 3)), 0.2).backward()
    Adam(tensors, dict.fromkeys(tensors, 0.0)).step()
