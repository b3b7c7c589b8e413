"""Training steps in the host's memory without autograd, which would store all gradients."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping

import numpy as np
import torch

from ...scenes.cameras import Camera
from ..adam import Adam
from ..rendering import KernelCamera, RasterSettings, StepOptions, Target
from ..stats import accumulate_stats
from .adam import decay_rows, step_arguments
from .compile import Buffers, serialized
from .frame import HostFrame
from .loss import loss_and_gradient
from .project import SUMS

TENSORS = ("means", "quats", "log_scales", "opacity_logits", "sh")


def image_planes(target: Target) -> np.ndarray:
    """Return the photo as planes (3, H, W) float32; cached in the target."""
    if "cpu" not in target.cache:
        target.cache["cpu"] = np.ascontiguousarray(target.image.permute(2, 0, 1).float().numpy())
    return target.cache["cpu"]


class HostModel:
    """Tensors of an optimizer, trained in place; see ``StepModel`` of :mod:`training.rasterize`.

    Args:
        adam: optimizer of means, quats, log_scales, opacity_logits and sh.
        stats: statistics of density control, updated in place.
        antialias: see ``rasterize``.
    """

    def __init__(self, adam: Adam, stats: MutableMapping[str, torch.Tensor], antialias: bool) -> None:
        self._adam = adam
        self._stats = stats
        self._antialias = antialias

    @torch.no_grad()
    @serialized
    def step(self, camera: Camera, target: Target, options: StepOptions) -> Callable[[], float]:
        """Make one Adam step; return a function that returns the loss."""
        adam = self._adam
        arrays = {name: tensor.detach().numpy() for name, tensor in adam.tensors.items()}
        count = len(arrays["means"])
        view = KernelCamera.of(camera, options.near)
        settings = RasterSettings(
            view, float(options.min_scale), self._antialias, options.background, options.sh_degree
        )
        factors = np.empty(0, np.float32) if options.weights is None else options.weights.numpy()
        splats = [*(arrays[name] for name in TENSORS), factors]
        radii, grad2d = torch.zeros(count), torch.zeros(count, 2)
        frame = HostFrame(splats, None, settings, radii.numpy())
        image = np.empty((3, view.height, view.width), np.float32)
        frame.blend(frame.projected, np.array(options.background, np.float32), image)
        loss, by_image = self._compare(image, target.over(options.background), options.ssim_weight)

        working = Buffers()
        pair_sums = working.take("pair_sums", np.float32, len(frame.pairs.splat), SUMS)
        no_alpha = np.zeros_like(frame.transmittance)
        frame.differentiate(frame.projected, image, by_image, no_alpha, pair_sums)
        logits = None if options.shrink is None else adam.tensors["opacity_logits"].detach().clone()
        steps = [step_arguments(arrays[name], *adam.state[name], *adam.count_step(name)) for name in TENSORS]
        frame.project_backward(pair_sums, None, grad2d.numpy(), steps, options.sparse_sh)
        if options.shrink is not None:
            accumulate_stats(self._stats, grad2d, radii, logits, options.shrink)
        if not options.drawn_only and len(frame.index) < count:
            others = np.setdiff1d(np.arange(count), frame.index, assume_unique=True)
            for step in steps[:-1] if options.sparse_sh else steps:
                decay_rows(others, step)
        self._image = image, 1 - frame.transmittance
        return lambda: loss

    def _compare(self, image: np.ndarray, target: Target, ssim_weight: float) -> tuple[float, np.ndarray]:
        """Return the photometric loss of planes (3, H, W) and its gradient."""
        truth = image_planes(target)
        if target.mask is None:
            return loss_and_gradient(image, truth, ssim_weight)
        mask = target.mask.numpy().astype(np.float32, copy=False)
        loss, gradient = loss_and_gradient(truth + mask * (image - truth), truth, ssim_weight)
        return loss, gradient * mask

    def last_image(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the last step's image (H, W, 3) and alpha (H, W)."""
        planes, alpha = self._image
        return torch.from_numpy(planes).permute(1, 2, 0), torch.from_numpy(alpha)
