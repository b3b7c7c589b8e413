"""Training steps on an NVIDIA GPU without autograd, whose bookkeeping takes longer than the kernels."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping
from dataclasses import fields

import torch

from ...scenes.cameras import Camera
from ..adam import Adam
from ..gaussians import Gaussians
from ..rendering import KernelCamera, RasterSettings, StepOptions, Target
from ..stats import accumulate_stats
from .frame import CardFrame, PhotometricLoss, upload_mask, upload_photo

TENSORS = tuple(field.name for field in fields(Gaussians))


class CardModel:
    """Tensors of an optimizer, trained in place; see ``StepModel`` of :mod:`training.rasterize`.

    Args:
        adam: optimizer of TENSORS, on a GPU.
        stats: statistics of density control, updated in place.
        antialias: see ``rasterize``.
    """

    def __init__(self, adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool) -> None:
        self._adam = adam
        self._stats = stats
        self._antialias = antialias

    @torch.no_grad()
    def step(self, camera: Camera, target: Target, options: StepOptions) -> Callable[[], float]:
        """Make one Adam step; return a function that waits for the loss."""
        tensors = {name: self._adam.tensors[name].detach() for name in TENSORS}
        view = KernelCamera.of(camera, options.near)
        settings = RasterSettings(
            view, float(options.min_scale), self._antialias, options.background, options.sh_degree
        )
        frame = CardFrame(Gaussians(**tensors), options.weights, settings)
        image = frame.blend(frame.projected.colors, options.background)
        target = target.over(options.background)
        photo = upload_photo(target, image)
        mask = upload_mask(target, image)
        compared = image if mask is None else photo + mask * (image - photo)
        loss = PhotometricLoss(compared, photo, options.ssim_weight)
        by_image = loss.gradient(image.new_ones(()))
        if mask is not None:
            by_image *= mask
        sums = frame.new_sums()
        by_colors = frame.differentiate(frame.projected.colors, image, by_image, None, sums)
        grad2d = image.new_zeros(len(tensors["means"]), 2)
        gradients = frame.project_backward(sums, by_colors, grad2d)
        if options.shrink is not None:
            radii = frame.projected.radii
            accumulate_stats(self._stats, grad2d, radii, tensors["opacity_logits"], options.shrink)
        named = dict(zip(TENSORS, gradients, strict=True))
        if options.drawn_only and options.weights is not None:
            rows = torch.nonzero(options.weights).squeeze(1)
            self._adam.step_rows(rows, {name: gradient[rows] for name, gradient in named.items()})
        else:
            self._adam.step(named, {"sh": frame.projected.radii > 0} if options.sparse_sh else {})
        self._image = image, 1 - frame.light
        return lambda: float(loss.value)

    def last_image(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the last step's image (H, W, 3) and alpha (H, W)."""
        return self._image
