"""Splats to pixels and back: one meaning, several backends.

``reference`` (plain torch) is the definition, ``cpu`` (Numba, gradients by hand) the fast path on any
computer, ``cuda`` (gsplat) that on NVIDIA graphics cards, ``gpu`` (compute shaders) runs on graphics cards of
any make. A backend is a module with ``rasterize``, ``contributions`` and ``photometric_loss`` of the
reference's signatures, imported when it is first used.
"""

from __future__ import annotations

import gc
from collections.abc import Collection, Iterable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import Any, Protocol

import numpy as np
import torch

from ..errors import LodgsError
from ..scenes.cameras import Camera
from ..splats.gaussians import SH_C0
from ..splats.sh import degree_from_count
from .adam import Adam
from .features import depths, normals
from .gaussians import Gaussians
from .rendering import OUTPUTS, Contributions, KernelCamera, RasterSettings, Rendering, Target

__all__ = [
    "BACKENDS", "OUTPUTS", "Adam", "Contributions", "DeviceModel", "Gaussians", "Rendering", "Target",
    "contributions", "cpu_fallback_reason", "make_device_model", "photometric_loss", "rasterize", "rasterize_strips",
    "render", "resolve_backend", "tensor_device", "warm_up",
]  # fmt: skip

BACKENDS = ("cpu", "cuda", "gpu", "reference")
"""Backends by name; :func:`resolve_backend` says which one ``auto`` is."""

STRIP = 1 << 21
"""Pixels that :func:`rasterize_strips` draws at a time: a Full HD frame at once, an 8k frame in sixteen strips."""


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
    """Draw N Gaussians as a camera sees them; differentiable by every tensor given.

    Projection, alpha and blending are those of 3D Gaussian Splatting (Kerbl et al. 2023); the constants are
    in :mod:`.rendering`. The view direction's part of the gradient reaches the means.

    Args:
        gaussians: in the world.
        camera: the view; any pinhole, any principal point.
        weights: (N,) at least 0 on the opacities, or None for ones. A splat of weight 0 is dropped before
            projection.
        background: colour behind everything.
        sh_degree: use the coefficients up to this degree only (the others get a gradient of zero); None: all.
        min_scale: added to every standard deviation, and so its lower bound, in world units (FLoD, Eq. 4).
        near: a splat is drawn where its mean lies deeper than this, in world units.
        antialias: instead of 3DGS's dilation, filter with :data:`..lod.unfiltered.MIP_VARIANCE` and give what
            a splat gains in area back in opacity, sqrt(det before / det after) (Mip-Splatting, Yu et al.
            2024, Eq. 10). Or (N,) bool, for each splat whether it is so.
        outputs: of :data:`OUTPUTS`, what :class:`Rendering` shall have besides; differentiable, too.
        features: (N, F) further values of each splat, blended as colours are over zero.
        limit: (H, W), for each pixel a depth along the camera's z axis, in world units: splats whose means
            lie beyond it have no part in the pixel, whatever is asked for. For pictures only: without
            gradients.
        window: left, top, width and height in pixels of the part of the camera's image to draw; None: all.
        rows: (M,) int32, ascending, those of the N that are looked at, as if the others had weight 0; None:
            all. What is known to be out of sight costs nothing then.
        backend: one of :data:`BACKENDS`, or "auto": cuda for tensors on a GPU, else cpu.

    Raises:
        ValueError: for tensors whose shapes do not belong together, an output that does not exist, or a limit
            where gradients are wanted.
        LodgsError: for a backend that does not exist, or does not work on this computer.
    """
    count, means, view = len(gaussians), gaussians.means, KernelCamera.of(camera, near, window)
    _check_weights(weights, count)
    _check_antialias(antialias, count)
    gaussians = replace(gaussians, sh=_coefficients(gaussians.sh))
    if not set(outputs) <= set(OUTPUTS):
        raise ValueError(f"outputs can be {', '.join(OUTPUTS)}, not {', '.join(outputs)}")
    if features is not None and (features.ndim != 2 or len(features) != count):
        raise ValueError(f"features must have shape ({count}, F), not {tuple(features.shape)}")
    if limit is not None:
        if limit.shape != (view.height, view.width):
            raise ValueError(f"limit must have shape {(view.height, view.width)}, not {tuple(limit.shape)}")
        leaves = *vars(gaussians).values(), weights, features
        if torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in leaves):
            raise ValueError("a limit is for pictures: it has no gradients")
    blended = [] if features is None else [features]
    plain = [name for name in ("depth", "inverse_depth") if name in outputs]
    if plain:
        depth = depths(means, view)[:, None]
        values = {"depth": depth, "inverse_depth": 1 / depth.clamp_min(view.near or 1e-6)}
        blended += [values[name] for name in plain]
    if "normals" in outputs:
        blended.append(normals(gaussians, view))
    red, green, blue = (float(value) for value in background)
    settings = RasterSettings(
        view, float(min_scale), antialias, (red, green, blue), _degree(gaussians.sh, sh_degree),
        median="median_depth" in outputs, absolute="absgrad2d" in outputs, limit=limit, rows=rows,
    )  # fmt: skip
    drawn = _backend(backend, means).rasterize(
        gaussians, weights, torch.cat(blended, 1) if blended else means.new_zeros(count, 0), settings
    )
    rendering = Rendering(
        drawn.image, drawn.alpha, drawn.radii, drawn.grad2d, drawn.tile_counts, drawn.absgrad2d
    )
    given = 0 if features is None else features.shape[1]
    if features is not None:
        rendering.features = drawn.features[..., :given]
    planes = dict(zip(plain, drawn.features[..., given:].unbind(-1), strict=False))
    if "depth" in outputs:
        nothing = drawn.alpha == 0
        rendering.depth = torch.where(nothing, 0, planes["depth"] / drawn.alpha.masked_fill(nothing, 1))
    rendering.inverse_depth = planes.get("inverse_depth")
    if "normals" in outputs:
        rendering.normals = drawn.features[..., -3:]
    if drawn.median is not None:
        padded = torch.cat([depths(means, view), means.new_zeros(1)])  # -1 is the last
        rendering.median_depth = padded[drawn.median.long()]
    return rendering


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
    """Draw a picture strip by strip, from the top: nothing is kept for gradients or between strips.

    Args:
        limit: of the window's pixels.
        strip: pixels to draw at a time, about.
        gaussians, camera, window, options: as for :func:`rasterize`.

    Yields:
        The first row of a strip in the window, and what it shows.
    """
    left, above, width, height = window or (0, 0, camera.width, camera.height)
    if limit is not None and limit.shape != (height, width):
        raise ValueError(f"limit must have shape {(height, width)}, not {tuple(limit.shape)}")
    rows = max(strip // width // 16 * 16, 16)
    for top in range(0, height, rows):
        part = left, above + top, width, min(rows, height - top)
        hidden = None if limit is None else limit[top : top + rows]
        yield top, rasterize(gaussians, camera, limit=hidden, window=part, **options)


@torch.no_grad()
def render(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    *,
    dtype: str = "float32",
    strip: int = STRIP,
    **options: Any,
) -> Iterator[np.ndarray]:
    """Draw pictures, one camera after the other: nothing is kept for gradients.

    Large images are drawn in strips, so that beyond the picture itself little memory is used.

    Args:
        dtype: "uint8" (colours clamped to 0 to 1, rounded), "float16" or "float32".
        strip: pixels to draw at a time, about.
        gaussians, options: as for :func:`rasterize`.

    Yields:
        (H, W, 4) of this type: the colour over the background, and alpha.
    """
    if dtype not in ("uint8", "float16", "float32"):
        raise ValueError(f'dtype can be "uint8", "float16" or "float32", not "{dtype}"')
    for camera in cameras:
        picture = np.empty((camera.height, camera.width, 4), dtype)
        for top, drawn in rasterize_strips(gaussians, camera, strip=strip, **options):
            pixels = torch.cat([drawn.image, drawn.alpha[..., None]], 2)
            if dtype == "uint8":
                pixels = pixels.clamp_(0, 1).mul_(255).round_()
            picture[top : top + len(pixels)] = pixels.cpu().numpy()
        yield picture


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
    """What each splat gives to the pixels of some views; no picture is kept, nothing is differentiated.

    Args: as for :func:`rasterize`, which draws the same splats with the same weights in a pixel. Colours do
    not matter.
    """
    count, device = len(gaussians), gaussians.means.device
    _check_weights(weights, count)
    _check_antialias(antialias, count)
    largest, total, radius = (torch.zeros(count, dtype=torch.float32, device=device) for _ in range(3))
    pixels, views = (torch.zeros(count, dtype=torch.int64, device=device) for _ in range(2))
    for camera in cameras:
        settings = RasterSettings(KernelCamera.of(camera, near), float(min_scale), antialias, rows=rows)
        found = _backend(backend, gaussians.means).contributions(gaussians, weights, settings)
        largest = torch.maximum(largest, found[0])
        total += found[1]
        pixels += found[2]
        views += found[3] > 0
        radius = torch.maximum(radius, found[3])
    return Contributions(largest, total, pixels, views, radius)


def _check_weights(weights: torch.Tensor | None, count: int) -> None:
    if weights is not None and weights.shape != (count,):
        raise ValueError(f"weights must have shape ({count},), not {tuple(weights.shape)}")


def _check_antialias(antialias: bool | torch.Tensor, count: int) -> None:
    if isinstance(antialias, torch.Tensor) and (antialias.shape, antialias.dtype) != ((count,), torch.bool):
        raise ValueError(f"antialias must be one bool or {count}, not {tuple(antialias.shape)}")


def _coefficients(sh: torch.Tensor) -> torch.Tensor:
    """Plain colours (N, 3) as the coefficients (N, 1, 3) that give them; coefficients as they are."""
    return ((sh - 0.5) / SH_C0)[:, None] if sh.ndim == 2 else sh


def _degree(sh: torch.Tensor, active: int | None) -> int:
    """The degree to draw with; ValueError unless sh (N, K, 3) is of that degree at least."""
    degree = degree_from_count(sh.shape[1])
    if active is not None and active > degree:
        raise ValueError(f"sh has degree {degree}, sh_degree asks for {active}")
    return degree if active is None else active


def photometric_loss(
    image: torch.Tensor, target: Target, ssim_weight: float = 0.2, *, backend: str = "auto"
) -> torch.Tensor:
    """(1 − ssim_weight) L1 + ssim_weight (1 − SSIM), as 3DGS (Eq. 7): a scalar, differentiable by the image.

    SSIM has an 11x11 Gaussian window of sigma 1.5 and zeros outside the image. Where the target has a mask m,
    m·image + (1 − m)·photograph is compared, so that what is masked out costs nothing, nor do its neighbours
    for its sake.

    Args:
        image: (H, W, 3), a rendering.
        target: the photograph; keep it from step to step, its moments are computed once.
    """
    if image.shape != target.image.shape:
        raise ValueError(f"image {tuple(image.shape)} and target {tuple(target.image.shape)} differ in shape")
    if target.mask is not None:
        truth = target.image.to(image)
        image = truth + target.mask[..., None].to(image) * (image - truth)
    return _backend(backend, image).photometric_loss(image, target, float(ssim_weight))


class DeviceModel(Protocol):
    """Splats that a backend trains where it draws them: what is here in the meantime is what they were.

    Whatever is asked of it raises LodgsError where the device was lost, or has too little memory. Where that
    would have changed splats, they are lost with it: the run goes on from its last checkpoint.
    """

    def __len__(self) -> int: ...

    def step(
        self,
        camera: Camera,
        target: Target,
        *,
        near: float,
        sh_degree: int,
        background: tuple[float, float, float],
        ssim_weight: float,
        weights: torch.Tensor | None = None,
        min_scale: float = 0.0,
        shrink: float | None = None,
    ) -> float:
        """One step of Adam by :func:`photometric_loss` of one picture; its loss.

        Args:
            target: opaque, and without a mask.
            shrink: the statistics are added up, of a photograph so many times smaller; None: they are not.
            camera, near, sh_degree, background, weights, min_scale: as of :func:`rasterize`.

        Raises:
            LodgsError: the device was lost, or has too little memory. The splats are lost with it.
        """
        ...

    def last_image(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The last step's picture (H, W, 3), and its alpha (H, W)."""
        ...

    def read(self, name: str) -> torch.Tensor:
        """A tensor's values, or a statistic's, as they are now; all others stay where they are."""
        ...

    def read_rows(self, index: torch.Tensor) -> dict[str, torch.Tensor]:
        """Tensors' values at indices (M,), by name."""
        ...

    def select(self, index: torch.Tensor) -> None:
        """Only the splats at indices (M,), at least one, stay, in this order."""

    def append(self, rows: Mapping[str, torch.Tensor]) -> None:
        """Adds splats at the end, at least one, with moments and statistics of zero."""

    def assign(self, name: str, values: torch.Tensor) -> None:
        """Gives a tensor new values and zero moments."""

    def reset_stats(self) -> None:
        """Begins anew with what is added up."""

    def raise_log_scales(self, minimum: torch.Tensor) -> None:
        """No log-scale of a splat is below its least one (N,) from here."""

    def copy_to_host(self) -> None:
        """Makes of what is here what has become of it: other tensors in the same places."""


def make_device_model(
    backend: str, adam: Adam, stats: MutableMapping[str, torch.Tensor], *, antialias: bool = False
) -> DeviceModel | None:
    """What a model trains, where a backend can train it by itself; None where it cannot.

    Args:
        adam: of means, quats, log_scales, opacity_logits and sh; what else it has stays as it is.
        stats: (N,) statistics of density control, by name (``optimize.model``).
        antialias: as of :func:`rasterize`.

    Raises:
        LodgsError: the device was lost, or has too little memory.
    """
    make = getattr(_backend(backend, adam.tensors["means"]), "make_device_model", None)
    return make and make(adam, stats, antialias)


def resolve_backend(backend: str) -> str:
    """The backend that a name means on this computer: ``auto`` is cuda where that works, else cpu.

    ``gpu`` is cpu where the graphics device does not draw what the reference draws, which is tried before the
    device is first used (:func:`cpu_fallback_reason` says so).

    Raises:
        LodgsError: for a backend that does not exist, or does not work on this computer.
    """
    from . import cuda

    if backend == "auto":
        return "cpu" if cuda.problem() else "cuda"
    if backend not in BACKENDS:
        raise LodgsError(
            f'There is no rasterizer backend "{backend}".', f"Choose auto or one of {', '.join(BACKENDS)}."
        )
    if backend == "cuda" and (problem := cuda.problem()):
        raise problem
    if backend == "gpu":
        from .gpu.default_device import default_adapter
        from .self_test import failure

        return "cpu" if failure(default_adapter()) else "gpu"
    return backend


def cpu_fallback_reason(backend: str) -> str:
    """Why the cpu draws where a GPU was asked for, or could be; nothing where there is no reason to say so.

    Raises:
        LodgsError: as :func:`resolve_backend`.
    """
    from . import cuda

    if backend == "auto" and torch.cuda.is_available() and (problem := cuda.problem()):
        return f"The NVIDIA GPU is not used. {problem}"
    if backend == "gpu" and resolve_backend(backend) == "cpu":
        from .gpu.default_device import default_adapter
        from .self_test import failure

        device = chosen()
        return (
            f"{device.name} is not used: {difference(device)}. The processor takes its place; a newer "
            "driver may help."
        )
    return ""


def tensor_device(backend: str) -> torch.device:
    """Where the tensors live that a backend draws; LodgsError as :func:`resolve_backend`."""
    from . import cuda

    return torch.device(cuda.DEVICE if resolve_backend(backend) == "cuda" else "cpu")


def warm_up(backend: str = "auto") -> None:
    """Make one step on one splat, so that kernels are compiled: the first time on a computer this takes some
    seconds on the cpu and some minutes with cuda; later they are read from a cache.

    Numba makes millions of objects on the way; looking among them for garbage, again and again, would take a
    fifth of the time.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        if resolve_backend(backend) == "cpu":
            from .cpu.compile import compile_in_two_processes

            compile_in_two_processes(partial(_step, "cpu"))
        _step(backend)
    finally:
        if collects:
            gc.enable()


def _step(backend: str) -> None:
    one = [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0, 0.0]], [[0.0] * 3], [0.0], [[[0.0] * 3]]
    device = tensor_device(backend)
    gaussians = Gaussians(*(torch.tensor(values, device=device, requires_grad=True) for values in one))
    camera = Camera("", 16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))
    drawn = rasterize(gaussians, camera, backend=backend)
    photometric_loss(drawn.image, Target(torch.zeros(16, 16, 3)), backend=backend).backward()
    Adam(vars(gaussians), dict.fromkeys(vars(gaussians), 0.0)).step()


def _backend(name: str, tensor: torch.Tensor):
    if name == "auto":  # whoever made the tensors has chosen
        name = "cuda" if tensor.is_cuda else "cpu"
    return import_module(f".{resolve_backend(name)}", __package__)
