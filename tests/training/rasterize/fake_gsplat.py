"""Functions of gsplat 1.5 that the cuda backend calls, in plain torch on the CPU, for small images.

It is based on gsplat's interface and behaviour, not on its source: a leading camera dimension, int32 indices
into the flattened (camera, splat) array, alpha capped at 0.999, and absolute gradients stored in backward as
``absgrad`` of the input tensor of means. It rejects inputs that the kernels reject or would misread. A test
compares its signatures with gsplat's if gsplat is installed.
"""

import torch
from torch import Tensor
from torch.nn.functional import normalize

from training.splats import sh

CHANNELS = 513


def spherical_harmonics(
    degrees_to_use: int, dirs: Tensor, coeffs: Tensor, masks: Tensor | None = None
) -> Tensor:
    """Compute Σ c·Y (..., 3), without the offset of 0.5; directions may have any length.

    The signs and the order of gsplat's basis, compared manually, are the same in all degrees.
    """
    assert masks is None
    assert (degrees_to_use + 1) ** 2 <= coeffs.shape[-2] and coeffs.shape[:-2] == dirs.shape[:-1]
    assert dirs.shape[-1] == coeffs.shape[-1] == 3
    assert dirs.dtype == coeffs.dtype == torch.float32
    values: list = [None] * sh.coefficient_count(degrees_to_use)
    sh.basis(*normalize(dirs, dim=-1).unbind(-1), degrees_to_use, values)
    return (torch.stack(values, -1)[..., None] * coeffs[..., : len(values), :]).sum(-2)


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    image_width: int,
    image_height: int,
    tile_size: int,
    isect_offsets: Tensor,
    flatten_ids: Tensor,
    backgrounds: Tensor | None = None,
    masks: Tensor | None = None,
    packed: bool = False,
    absgrad: bool = False,
) -> tuple[Tensor, Tensor]:
    """Render colours (1, H, W, channels) and alphas (1, H, W, 1) of one camera."""
    cameras, count = means2d.shape[:2]
    channels = colors.shape[-1]
    assert cameras == 1 and masks is None and not packed
    assert means2d.shape == (1, count, 2) and conics.shape == (1, count, 3)
    assert colors.shape == (1, count, channels) and opacities.shape == (1, count)
    assert backgrounds is None or backgrounds.shape == (1, channels)
    assert 0 < channels <= CHANNELS, f"Unsupported number of color channels: {channels}"
    rows, columns = isect_offsets.shape[1:]
    assert rows * tile_size >= image_height and columns * tile_size >= image_width
    assert isect_offsets.dtype == flatten_ids.dtype == torch.int32
    floats = [means2d, conics, colors, opacities, *([] if backgrounds is None else [backgrounds])]
    assert all(tensor.dtype == torch.float32 for tensor in floats)
    assert len(flatten_ids) == 0 or 0 <= flatten_ids.min() <= flatten_ids.max() < count
    return _Pixels.apply(
        means2d.contiguous(), conics.contiguous(), colors.contiguous(), opacities.contiguous(), backgrounds,
        (image_width, image_height, tile_size), isect_offsets[0], flatten_ids.long(), absgrad,
    )  # type: ignore[return-value] # fmt: skip


class _Pixels(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, conics, colors, opacities, backgrounds, size, offsets, ids, absgrad):
        ctx.save_for_backward(means, conics, colors, opacities, backgrounds, offsets, ids)
        ctx.settings = size, absgrad
        width, height, tile = size
        image, alpha = (
            means.new_zeros(1, height, width, colors.shape[-1]),
            means.new_zeros(1, height, width, 1),
        )
        for index, (x, y) in _tiles(offsets, ids, tile):
            pixels, remaining = _blend(
                *_deltas(means[0, index], x, y), conics[0, index], colors[0, index], opacities[0, index]
            )
            pixels = pixels if backgrounds is None else pixels + remaining[:, None] * backgrounds[0]
            inside = (x < width) & (y < height)
            image[0, y[inside].long(), x[inside].long()] = pixels[inside]
            alpha[0, y[inside].long(), x[inside].long(), 0] = 1 - remaining[inside]
        return image, alpha

    @staticmethod
    def backward(ctx, by_image, by_alpha):
        means, conics, colors, opacities, backgrounds, offsets, ids = ctx.saved_tensors
        (width, height, tile), absgrad = ctx.settings
        signed, absolute = torch.zeros_like(means), torch.zeros_like(means)
        gradients = [torch.zeros_like(tensor) for tensor in (conics, colors, opacities)]
        for index, (x, y) in _tiles(offsets, ids, tile):
            inside = (x < width) & (y < height)
            x, y = x[inside], y[inside]
            leaves = [
                *_deltas(means[0, index], x, y),
                *(tensor[0, index] for tensor in (conics, colors, opacities)),
            ]
            leaves = [leaf.detach().requires_grad_() for leaf in leaves]
            with torch.enable_grad():
                pixels, remaining = _blend(*leaves)
                pixels = pixels if backgrounds is None else pixels + remaining[:, None] * backgrounds[0]
                loss = (pixels * by_image[0, y.long(), x.long()]).sum()
                loss = loss - (remaining * by_alpha[0, y.long(), x.long(), 0]).sum()
            *by_delta, by_conic, by_color, by_opacity = torch.autograd.grad(loss, leaves)
            signed[0].index_add_(0, index, torch.stack(by_delta, -1).sum(1))
            absolute[0].index_add_(0, index, torch.stack(by_delta, -1).abs().sum(1))
            for total, part in zip(gradients, (by_conic, by_color, by_opacity), strict=True):
                total[0].index_add_(0, index, part)
        if absgrad:
            means.absgrad = absolute
        return signed, *gradients, None, None, None, None, None


def _tiles(offsets, ids, tile):
    """Yield the splats of each tile, front to back, and its pixel centres."""
    starts = offsets.flatten().cpu().tolist()
    pixel = torch.arange(tile * tile, device=ids.device)
    for number, (start, end) in enumerate(zip(starts, [*starts[1:], len(ids)], strict=True)):
        row, column = divmod(number, offsets.shape[1])
        assert start <= end
        yield ids[start:end], (column * tile + pixel % tile + 0.5, row * tile + pixel // tile + 0.5)


def _deltas(means, x, y):
    """Return the offsets from pixels to means, (n, pixels) each."""
    return means[:, :1] - x, means[:, 1:] - y


def _blend(dx, dy, conics, colors, opacities):
    """Blend colours (pixels, channels) without background, and the remaining transmittance (pixels,)."""
    a, b, c = (column[:, None] for column in conics.unbind(1))
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities[:, None] * torch.exp(-sigma)).clamp_max(0.999)
    alpha = torch.where((sigma >= 0) & (alpha >= 1 / 255), alpha, 0)
    light = torch.cat([torch.ones_like(alpha[:1]), 1 - alpha]).cumprod(0)
    active = light[1:] > 1e-4
    weight = torch.where(active, alpha * light[:-1], 0)
    return weight.T @ colors, torch.where(active, 1 - alpha, 1).prod(0)
