"""Rasterize Gaussian splats and differentiate the result, with one interface for several backends.

``reference`` (plain torch) is the definition. ``cpu`` (Numba kernels with analytic gradients) is fast on any
computer, ``cuda`` (CUDA kernels) on NVIDIA GPUs, and ``gpu`` (compute shaders) runs on GPUs of any vendor. A
backend is a module that implements ``rasterize``, ``contributions`` and ``photometric_loss`` with the
reference's signatures. It is imported on first use.
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import Any, Protocol

import numpy as np
import torch

from ..errors import LodgsError
from ..scenes.cameras import Camera
from ..splats.gaussians import SH_C0
from ..splats.sh import degree_from_count
from .adam import Adam
from .features import blended_values, name_outputs
from .gaussians import Gaussians
from .rendering import (
    OUTPUTS,
    Contributions,
    KernelCamera,
    RasterSettings,
    Rendering,
    StepOptions,
    Target,
)

__all__ = [
    "BACKENDS", "OUTPUTS", "Adam", "Contributions", "DeviceModel", "Gaussians", "Rendering", "StepModel",
    "StepOptions", "Target", "contributions", "cpu_fallback_reason", "make_step_model", "photometric_loss",
    "rasterize", "rasterize_strips", "render", "resolve_backend", "tensor_device", "warm_up",
]  # fmt: skip

BACKENDS = ("cpu", "cuda", "gpu", "reference")
"""Names of the backends; :func:`resolve_backend` resolves ``auto``."""

STRIP = 1 << 21
"""Pixels in a strip of :func:`rasterize_strips`: a Full HD image is one strip, an 8K image is sixteen."""


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    weights: torch.Tensor | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    min_scale: float = 0.0,
    near: float = 0.01,
    antialias: bool | torch.Tensor = False,
    outputs: Collection[str] = (),
    features: torch.Tensor | None = None,
    limit: torch.Tensor | None = None,
    window: tuple[int, int, int, int] | None = None,
    rows: torch.Tensor | None = None,
    backend: str = "auto",
) -> Rendering:
    """Render N Gaussians from a camera, differentiable with respect to every input tensor.

    Projection, alpha and blending follow 3D Gaussian Splatting (Kerbl et al. 2023); :mod:`.rendering` holds
    the constants. Gradients of the view-dependent colour reach the means too.

    Args:
        gaussians: splats in world coordinates.
        camera: any pinhole camera, with any principal point.
        weights: (N,) non-negative factors of the opacities; None means 1. Splats of weight 0 are dropped
            before projection.
        background: colour behind all splats.
        sh_degree: highest degree of the coefficients to use; higher coefficients get zero gradients. None
            uses all.
        min_scale: length added to every standard deviation, in world units. It is thus their lower bound
            (FLoD, Eq. 4).
        near: depth in world units. Splats whose mean lies at or in front of it are not drawn.
        antialias: replace 3DGS's dilation by the 2D Mip filter of variance
            :data:`..editing.bake_filter.MIP_VARIANCE`, and scale opacity by sqrt(det before / det after)
            (Mip-Splatting, Yu et al. 2024, Eq. 10). An (N,) bool tensor selects it per splat.
        outputs: names from :data:`OUTPUTS` of further differentiable outputs in :class:`Rendering`.
        features: (N, F) values per splat, blended like colours over zero.
        limit: (H, W) maximum depth per pixel along the camera's z axis, in world units. A splat does not
            contribute to pixels whose limit is less than the depth of its mean. Not differentiable.
        window: left, top, width and height in pixels of the image region to draw. None draws the whole image.
        rows: (M,) int32, ascending indices of the splats to consider, as if all others had weight 0. None
            considers all. Splats that are known to be invisible then cost nothing.
        backend: one of :data:`BACKENDS`, or "auto": cuda for tensors on a GPU, otherwise cpu.

    Raises:
        ValueError: shapes do not match, an output does not exist, or a limit is combined with gradients.
        LodgsError: the backend does not exist or does not work on this computer.
    """
    view = KernelCamera.of(camera, near, window)
    _check_inputs(gaussians, view, weights, antialias, outputs, features, limit)
    gaussians = replace(gaussians, sh=_coefficients(gaussians.sh))
    red, green, blue = (float(value) for value in background)
    settings = RasterSettings(
        view, float(min_scale), antialias, (red, green, blue), _degree(gaussians.sh, sh_degree),
        median="median_depth" in outputs, absolute="absgrad2d" in outputs, limit=limit, rows=rows,
    )  # fmt: skip
    values = blended_values(gaussians, view, outputs, features)
    output = _backend(backend, gaussians.means).rasterize(gaussians, weights, values, settings)
    return name_outputs(output, gaussians, view, outputs, None if features is None else features.shape[1])


@torch.no_grad()
def rasterize_strips(
    gaussians: Gaussians,
    camera: Camera,
    *,
    limit: torch.Tensor | None = None,
    window: tuple[int, int, int, int] | None = None,
    strip: int = STRIP,
    **options: Any,
) -> Iterator[tuple[int, Rendering]]:
    """Render an image in horizontal strips from top to bottom, without gradients.

    Args:
        limit: maximum depth of the window's pixels.
        strip: approximate number of pixels in a strip.
        gaussians, camera, window, options: see :func:`rasterize`.

    Yields:
        The first row of a strip within the window, and the strip's rendering.
    """
    left, above, width, height = window or (0, 0, camera.width, camera.height)
    if limit is not None and limit.shape != (height, width):
        raise ValueError(f"limit must have shape {(height, width)}, not {tuple(limit.shape)}")
    rows = max(strip // width // 16 * 16, 16)
    for top in range(0, height, rows):
        part = left, above + top, width, min(rows, height - top)
        part_limit = None if limit is None else limit[top : top + rows]
        yield top, rasterize(gaussians, camera, limit=part_limit, window=part, **options)


@torch.no_grad()
def render(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    *,
    dtype: str = "float32",
    strip: int = STRIP,
    **options: Any,
) -> Iterator[np.ndarray]:
    """Render one image per camera, without gradients.

    Large images are rendered in strips, so little memory is used besides the image itself.

    Args:
        dtype: "uint8" (colours clamped to 0 to 1 and rounded), "float16" or "float32".
        strip: approximate number of pixels in a strip.
        gaussians, options: see :func:`rasterize`.

    Yields:
        Array (H, W, 4) of this type: colour over the background, and alpha.
    """
    if dtype not in ("uint8", "float16", "float32"):
        raise ValueError(f'dtype must be "uint8", "float16" or "float32", not "{dtype}"')
    for camera in cameras:
        image = np.empty((camera.height, camera.width, 4), dtype)
        for top, rendering in rasterize_strips(gaussians, camera, strip=strip, **options):
            pixels = torch.cat([rendering.image, rendering.alpha[..., None]], 2)
            if dtype == "uint8":
                pixels = pixels.clamp_(0, 1).mul_(255).round_()
            image[top : top + len(pixels)] = pixels.cpu().numpy()
        yield image


@torch.no_grad()
def contributions(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    *,
    weights: torch.Tensor | None = None,
    min_scale: float = 0.0,
    near: float = 0.01,
    antialias: bool | torch.Tensor = False,
    rows: torch.Tensor | None = None,
    backend: str = "auto",
) -> Contributions:
    """Measure how much each splat contributes to the pixels of several views, without gradients.

    Args: see :func:`rasterize`, which blends the same splats with the same weights. Colours are ignored.
    """
    count = len(gaussians)
    device = gaussians.means.device
    _check_weights(weights, count)
    _check_antialias(antialias, count)
    largest, total, radius = (torch.zeros(count, dtype=torch.float32, device=device) for _ in range(3))
    pixels, views = (torch.zeros(count, dtype=torch.int64, device=device) for _ in range(2))
    for camera in cameras:
        settings = RasterSettings(KernelCamera.of(camera, near), float(min_scale), antialias, rows=rows)
        view_largest, view_total, view_pixels, view_radius = _backend(backend, gaussians.means).contributions(
            gaussians, weights, settings
        )
        largest = torch.maximum(largest, view_largest)
        total += view_total
        pixels += view_pixels
        views += view_radius > 0
        radius = torch.maximum(radius, view_radius)
    return Contributions(largest, total, pixels, views, radius)


def _check_inputs(
    gaussians: Gaussians,
    view: KernelCamera,
    weights: torch.Tensor | None,
    antialias: bool | torch.Tensor,
    outputs: Collection[str],
    features: torch.Tensor | None,
    limit: torch.Tensor | None,
) -> None:
    """Check the shapes of the inputs of :func:`rasterize`; raise ValueError otherwise."""
    count = len(gaussians)
    _check_weights(weights, count)
    _check_antialias(antialias, count)
    if not set(outputs) <= set(OUTPUTS):
        raise ValueError(f"outputs must be among {', '.join(OUTPUTS)}, not {', '.join(outputs)}")
    if features is not None and (features.ndim != 2 or len(features) != count):
        raise ValueError(f"features must have shape ({count}, F), not {tuple(features.shape)}")
    if limit is not None:
        if limit.shape != (view.height, view.width):
            raise ValueError(f"limit must have shape {(view.height, view.width)}, not {tuple(limit.shape)}")
        leaves = *vars(gaussians).values(), weights, features
        if torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in leaves):
            raise ValueError("limit is not differentiable; use torch.no_grad() or detached tensors")


def _check_weights(weights: torch.Tensor | None, count: int) -> None:
    if weights is not None and weights.shape != (count,):
        raise ValueError(f"weights must have shape ({count},), not {tuple(weights.shape)}")


def _check_antialias(antialias: bool | torch.Tensor, count: int) -> None:
    if isinstance(antialias, torch.Tensor) and (antialias.shape, antialias.dtype) != ((count,), torch.bool):
        raise ValueError(f"antialias must be one bool or {count}, not {tuple(antialias.shape)}")


def _coefficients(sh: torch.Tensor) -> torch.Tensor:
    """Convert plain colours (N, 3) to coefficients (N, 1, 3) of degree 0; return coefficients unchanged."""
    return ((sh - 0.5) / SH_C0)[:, None] if sh.ndim == 2 else sh


def _degree(sh: torch.Tensor, active: int | None) -> int:
    """Return the active degree, or the degree of sh (N, K, 3) if None; ValueError if sh has less."""
    degree = degree_from_count(sh.shape[1])
    if active is not None and active > degree:
        raise ValueError(f"sh_degree {active} exceeds degree {degree} of sh")
    return degree if active is None else active


def photometric_loss(
    image: torch.Tensor, target: Target, ssim_weight: float = 0.2, *, backend: str = "auto"
) -> torch.Tensor:
    """Compute (1 − ssim_weight) L1 + ssim_weight (1 − SSIM) as in 3DGS (Eq. 7).

    SSIM uses an 11x11 Gaussian window of sigma 1.5 and zeros outside the image. If the target has a mask m,
    m·image + (1 − m)·photo is compared with the photo. Masked pixels then add nothing to the loss, and do not
    affect their neighbours' SSIM.

    Args:
        image: (H, W, 3), a rendering.
        target: the photo. Reuse it between steps, because backends cache copies of it.

    Returns:
        Scalar, differentiable with respect to the image.
    """
    if image.shape != target.image.shape:
        raise ValueError(f"image {tuple(image.shape)} and target {tuple(target.image.shape)} differ in shape")
    if target.mask is not None:
        truth = target.image.to(image)
        image = truth + target.mask[..., None].to(image) * (image - truth)
    return _backend(backend, image).photometric_loss(image, target, float(ssim_weight))


class StepModel(Protocol):
    """Splats that a backend trains without autograd."""

    def step(self, camera: Camera, target: Target, options: StepOptions) -> Callable[[], float]:
        """Make one Adam step with :func:`photometric_loss` of one image.

        Return a function that returns the loss. It waits for the device, so call it rarely. A
        :class:`DeviceModel` returns the first loss that was not finite from then on.

        Args:
            target: photo; a :class:`DeviceModel` requires an opaque one without a mask.

        Raises:
            LodgsError: the device was lost or has too little memory. The splats are lost with it.
        """
        ...

    def last_image(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the last step's image (H, W, 3) and alpha (H, W)."""
        ...


class DeviceModel(StepModel, Protocol):
    """Splats in device memory.

    The host's tensors are out of date until :meth:`copy_to_host`. Every method raises LodgsError if the
    device was lost or has too little memory. If the method modifies splats, they are then lost, and training
    has to continue from the last checkpoint.
    """

    def __len__(self) -> int: ...

    def read(self, name: str) -> torch.Tensor:
        """Return the current values of one tensor or statistic."""
        ...

    def read_rows(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the tensors' values at indices (M,), by name."""
        ...

    def select(self, index: torch.Tensor) -> None:
        """Keep only the splats at indices (M,), at least one, in this order."""

    def append(self, rows: Mapping[str, torch.Tensor]) -> None:
        """Append at least one splat, with zero moments and statistics."""

    def assign(self, name: str, values: torch.Tensor, keep_moments: bool = False) -> None:
        """Replace a tensor's values; reset its moments to zero unless ``keep_moments``."""

    def reset_stats(self) -> None:
        """Reset all statistics to zero."""

    def raise_log_scales(self, minimum: torch.Tensor) -> None:
        """Raise every log-scale of a splat to at least its minimum (N,)."""

    def lower_log_scales(self, maximum: torch.Tensor) -> None:
        """Lower every log-scale of a splat to at most its maximum (N,)."""

    def copy_to_host(self) -> None:
        """Replace the host's tensors, moments and statistics by the device's values."""


def make_step_model(
    backend: str, adam: Adam, stats: MutableMapping[str, torch.Tensor], *, antialias: bool = False
) -> StepModel | None:
    """Return a model whose steps need no autograd, or None if the backend has none.

    ``cpu`` and ``cuda`` change the tensors and statistics in place. ``gpu`` copies them to its device and
    returns a :class:`DeviceModel`.

    Args:
        adam: optimizer of means, quats, log_scales, opacity_logits and sh. Its other tensors stay unchanged.
        stats: (N,) statistics of density control, by name (``optimize.model``).
        antialias: see :func:`rasterize`.

    Raises:
        LodgsError: the device was lost or has too little memory.
    """
    make = getattr(_backend(backend, adam.tensors["means"]), "make_step_model", None)
    return make and make(adam, stats, antialias)


def resolve_backend(backend: str) -> str:
    """Return the backend that will be used for a name on this computer.

    ``auto`` becomes cuda if that works, otherwise cpu. ``gpu`` becomes cpu if the graphics device fails its
    self-test, which runs before the first use of a device. :func:`cpu_fallback_reason` then reports the
    cause.

    Raises:
        LodgsError: the backend does not exist or does not work on this computer.
    """
    from . import cuda

    if backend == "auto":
        return "cpu" if cuda.find_problem() else "cuda"
    if backend not in BACKENDS:
        raise LodgsError(
            f'Unknown rasterizer backend "{backend}".', f"Choose auto or one of {', '.join(BACKENDS)}."
        )
    if backend == "cuda" and (problem := cuda.find_problem()):
        raise problem
    if backend == "gpu":
        from .gpu.default_device import default_adapter
        from .self_test import find_failure

        return "cpu" if find_failure(default_adapter()) else "gpu"
    return backend


def cpu_fallback_reason(backend: str) -> str:
    """Return why the cpu backend replaces an available or requested GPU; empty if there is nothing to report.

    Raises:
        LodgsError: see :func:`resolve_backend`.
    """
    from . import cuda

    if backend == "auto" and torch.cuda.is_available() and (problem := cuda.find_problem()):
        return f"The NVIDIA GPU is not used. {problem}"
    if backend == "gpu" and resolve_backend(backend) == "cpu":
        from .gpu.default_device import default_adapter
        from .self_test import find_failure

        adapter = default_adapter()
        reason = find_failure(adapter)
        return f"{adapter.name} is not used: {reason}. The CPU is used instead; a newer driver may help."
    return ""


def tensor_device(backend: str) -> torch.device:
    """Return the torch device of a backend's input tensors; LodgsError as in :func:`resolve_backend`."""
    from . import cuda

    return torch.device(cuda.DEVICE if resolve_backend(backend) == "cuda" else "cpu")


def warm_up(backend: str = "auto") -> None:
    """Compile all kernels by making one step on one splat.

    The first time on a computer this takes some seconds with cpu. Later runs read its kernels from a cache.
    With cuda it takes some seconds in every process.
    """
    gc_enabled = gc.isenabled()
    gc.disable()  # Numba allocates millions of objects; collecting garbage would take a fifth of the time
    try:
        if resolve_backend(backend) == "cpu":
            from .cpu.compile import compile_in_two_processes

            compile_in_two_processes(partial(_step, "cpu"))
        _step(backend)
    finally:
        if gc_enabled:
            gc.enable()


def _step(backend: str) -> None:
    values = [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0, 0.0]], [[0.0] * 3], [0.0], [[[0.0] * 3]]
    device = tensor_device(backend)
    gaussians = Gaussians(*(torch.tensor(value, device=device, requires_grad=True) for value in values))
    camera = Camera("", 16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))
    target = Target(torch.zeros(16, 16, 3))
    adam = Adam(vars(gaussians), dict.fromkeys(vars(gaussians), 0.0))
    if model := make_step_model(backend, adam, {}):  # needs no kernels of the CPU
        model.step(camera, target, StepOptions(0.01, 0, (0.0, 0.0, 0.0)))()
        return
    photometric_loss(rasterize(gaussians, camera, backend=backend).image, target, backend=backend).backward()
    adam.step()


def _backend(name: str, tensor: torch.Tensor) -> ModuleType:
    if name == "auto":  # the device of the tensors already decides
        name = "cuda" if tensor.is_cuda else "cpu"
    return import_module(f".{resolve_backend(name)}", __package__)
