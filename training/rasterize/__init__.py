"""Splats to pixels and back: one meaning, several backends.

``reference`` (plain torch) is the definition, ``cpu`` (Numba, gradients by hand) the fast path on any
computer, ``cuda`` (gsplat) that on NVIDIA graphics cards. A backend is a module with ``rasterize``,
``contributions`` and ``photometric_loss`` of the reference's signatures, imported when it is first used.
"""

from __future__ import annotations

import gc
from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from importlib import import_module

import numpy as np
import torch

from ..errors import LodgsError
from ..scenes.cameras import Camera
from .adam import Adam
from .features import depths, normals
from .rendering import OUTPUTS, Contributions, Rendering, Target, View
from .sh import C0, degree_of

__all__ = [
    "BACKENDS", "OUTPUTS", "Adam", "Contributions", "Rendering", "Target",
    "contributions", "device_of", "photometric_loss", "rasterize", "render", "resolve", "strips", "warm_up",
]  # fmt: skip

BACKENDS = ("cpu", "cuda", "reference")
"""Backends by name; :func:`resolve` says which one ``auto`` is."""

STRIP = 1 << 21
"""Pixels that :func:`strips` draws at a time: a Full HD frame at once, an 8k frame in sixteen strips."""


def rasterize(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    camera: Camera,
    *,
    weights: torch.Tensor | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    min_scale: float = 0.0,
    near: float = 0.01,
    antialias: bool = False,
    outputs: Collection[str] = (),
    features: torch.Tensor | None = None,
    limit: torch.Tensor | None = None,
    backend: str = "auto",
) -> Rendering:
    """Draw splats as a camera sees them; differentiable by every tensor given.

    Projection, alpha and blending are those of 3D Gaussian Splatting (Kerbl et al. 2023); the constants are
    in :mod:`.rendering`. The view direction's part of the gradient reaches the means.

    Args:
        means: (N, 3) in the world.
        quats: (N, 4) rotations wxyz, of any length but zero.
        log_scales: (N, 3); the standard deviations are exp(log_scales) + min_scale, in world units.
        opacity_logits: (N,); the opacity is sigmoid(opacity_logits) times the weight.
        sh: (N, (d+1)², 3) spherical-harmonics coefficients; the colour is 0.5 + Σ c·Y, at least 0. Or (N, 3)
            colours, the same from everywhere, at least 0 as well.
        camera: the view; any pinhole, any principal point.
        weights: (N,) in [0, 1], or None for ones. A splat of weight 0 is dropped before projection.
        background: colour behind everything.
        sh_degree: use the coefficients up to this degree only (the others get a gradient of zero); None: all.
        min_scale: lower bound of every scale, in world units (FLoD, Eq. 4).
        near: a splat is drawn where its mean lies deeper than this, in world units.
        antialias: instead of 3DGS's dilation, filter with :data:`.rendering.MIP_VARIANCE` and give what a
            splat gains in area back in opacity, sqrt(det before / det after) (Mip-Splatting, Yu et al. 2024,
            Eq. 10).
        outputs: of :data:`OUTPUTS`, what :class:`Rendering` shall have besides; differentiable, too.
        features: (N, F) further values of each splat, blended as colours are over zero.
        limit: (H, W), for each pixel a depth along the camera's z axis, in world units: splats whose means
            lie beyond it have no part in the pixel, whatever is asked for. For pictures only: without
            gradients.
        backend: one of :data:`BACKENDS`, or "auto": cuda for tensors on a GPU, else cpu.

    Raises:
        ValueError: for tensors whose shapes do not belong together, an output that does not exist, or a limit
            where gradients are wanted.
        LodgsError: for a backend that does not exist, or does not work on this computer.
    """
    return _draw(
        means, quats, log_scales, opacity_logits, sh, View.of(camera, near), weights=weights,
        background=background, sh_degree=sh_degree, min_scale=min_scale, antialias=antialias,
        outputs=outputs, features=features, limit=limit, backend=backend,
    )  # fmt: skip


def _draw(
    means, quats, log_scales, opacity_logits, sh, view: View, *,
    weights, background, sh_degree, min_scale, antialias, outputs, features, limit, backend,
) -> Rendering:  # fmt: skip
    """:func:`rasterize` of a view, which may be a strip of a camera's."""
    count = len(means)
    _check(means, quats, log_scales, opacity_logits, weights)
    sh = _coefficients(sh)
    degree = _degree(sh, count, sh_degree)
    if not set(outputs) <= set(OUTPUTS):
        raise ValueError(f"outputs can be {', '.join(OUTPUTS)}, not {', '.join(outputs)}")
    if features is not None and (features.ndim != 2 or len(features) != count):
        raise ValueError(f"features must have shape ({count}, F), not {tuple(features.shape)}")
    if limit is not None:
        if limit.shape != (view.height, view.width):
            wanted = view.height, view.width
            raise ValueError(f"limit must have shape {wanted}, not {tuple(limit.shape)}")
        leaves = means, quats, log_scales, opacity_logits, sh, weights, features
        if torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in leaves):
            raise ValueError("a limit is for pictures: it has no gradients")
    red, green, blue = (float(value) for value in background)
    blended = [] if features is None else [features]
    if "depth" in outputs:
        blended.append(depths(means, view)[:, None])
    if "normals" in outputs:
        blended.append(normals(means, quats, log_scales, view))
    drawn = _backend(backend, means).rasterize(
        means, quats, log_scales, opacity_logits, sh, weights,
        torch.cat(blended, 1) if blended else means.new_zeros(count, 0),
        view=view, background=(red, green, blue), degree=degree, min_scale=float(min_scale),
        antialias=bool(antialias), median="median_depth" in outputs, absolute="absgrad2d" in outputs,
        limit=limit,
    )  # fmt: skip
    rendering = Rendering(
        drawn.image, drawn.alpha, drawn.radii, drawn.grad2d, drawn.tile_counts, drawn.absgrad2d
    )
    given = 0 if features is None else features.shape[1]
    if features is not None:
        rendering.features = drawn.features[..., :given]
    if "depth" in outputs:
        nothing = drawn.alpha == 0
        rendering.depth = torch.where(
            nothing, 0, drawn.features[..., given] / drawn.alpha.masked_fill(nothing, 1)
        )
    if "normals" in outputs:
        rendering.normals = drawn.features[..., -3:]
    if drawn.median is not None:
        padded = torch.cat([depths(means, view), means.new_zeros(1)])  # -1 is the last
        rendering.median_depth = padded[drawn.median.long()]
    return rendering


@torch.no_grad()
def strips(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    camera: Camera,
    *,
    weights: torch.Tensor | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    min_scale: float = 0.0,
    near: float = 0.01,
    antialias: bool = False,
    outputs: Collection[str] = (),
    features: torch.Tensor | None = None,
    limit: torch.Tensor | None = None,
    window: tuple[int, int, int, int] | None = None,
    strip: int = STRIP,
    backend: str = "auto",
) -> Iterator[tuple[int, Rendering]]:
    """Draw a picture for eyes strip by strip, from the top: nothing is kept for gradients or between strips.

    Args: as for :func:`rasterize`, and
        limit: of the window's pixels.
        window: left, top, width and height in pixels of the part of the camera's image to draw; None: all.
        strip: pixels to draw at a time, about.

    Yields:
        The first row of a strip, and what it shows.
    """
    left, above, width, height = window or (0, 0, camera.width, camera.height)
    whole = replace(View.of(camera, near), width=width)
    whole = replace(whole, cx=whole.cx - left, cy=whole.cy - above)
    if limit is not None and limit.shape != (height, width):
        raise ValueError(f"limit must have shape {(height, width)}, not {tuple(limit.shape)}")
    rows = max(strip // width // 16 * 16, 16)
    for top in range(0, height, rows):
        part = replace(whole, cy=whole.cy - top, height=min(rows, height - top))
        yield top, _draw(
            means, quats, log_scales, opacity_logits, sh, part, weights=weights, background=background,
            sh_degree=sh_degree, min_scale=min_scale, antialias=antialias, outputs=outputs,
            features=features, limit=None if limit is None else limit[top : top + rows], backend=backend,
        )  # fmt: skip


@torch.no_grad()
def render(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    opacity_logits: torch.Tensor,
    sh: torch.Tensor,
    cameras: Iterable[Camera],
    *,
    weights: torch.Tensor | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    min_scale: float = 0.0,
    near: float = 0.01,
    antialias: bool = False,
    kind: str = "float32",
    strip: int = STRIP,
    backend: str = "auto",
) -> Iterator[np.ndarray]:
    """Draw pictures for eyes, one camera after the other: nothing is kept for gradients.

    Large images are drawn in strips, so that beyond the picture itself little memory is used.

    Args: as for :func:`rasterize`, and
        kind: "uint8" (colours clamped to 0 to 1, rounded), "float16" or "float32".
        strip: pixels to draw at a time, about.

    Yields:
        (H, W, 4) of this kind: the colour over the background, and alpha.
    """
    if kind not in ("uint8", "float16", "float32"):
        raise ValueError(f'kind can be "uint8", "float16" or "float32", not "{kind}"')
    for camera in cameras:
        picture = np.empty((camera.height, camera.width, 4), kind)
        for top, drawn in strips(
            means, quats, log_scales, opacity_logits, sh, camera, weights=weights, background=background,
            sh_degree=sh_degree, min_scale=min_scale, near=near, antialias=antialias, strip=strip,
            backend=backend,
        ):  # fmt: skip
            pixels = torch.cat([drawn.image, drawn.alpha[..., None]], 2)
            if kind == "uint8":
                pixels = pixels.clamp_(0, 1).mul_(255).round_()
            picture[top : top + len(pixels)] = pixels.cpu().numpy()
        yield picture


@torch.no_grad()
def contributions(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    opacity_logits: torch.Tensor,
    cameras: Iterable[Camera],
    *,
    weights: torch.Tensor | None = None,
    min_scale: float = 0.0,
    near: float = 0.01,
    antialias: bool = False,
    backend: str = "auto",
) -> Contributions:
    """What each splat gives to the pixels of some views; no picture is kept, nothing is differentiated.

    Args: as for :func:`rasterize`, which draws the same splats with the same weights in a pixel.
    """
    _check(means, quats, log_scales, opacity_logits, weights)
    of = {"dtype": torch.float32, "device": means.device}
    count = len(means)
    largest, total, radius = (torch.zeros(count, **of) for _ in range(3))
    pixels, views = (torch.zeros(count, dtype=torch.int64, device=means.device) for _ in range(2))
    for camera in cameras:
        found = _backend(backend, means).contributions(
            means, quats, log_scales, opacity_logits, weights,
            view=View.of(camera, near), min_scale=float(min_scale), antialias=bool(antialias),
        )  # fmt: skip
        largest = torch.maximum(largest, found[0])
        total += found[1]
        pixels += found[2]
        views += found[3] > 0
        radius = torch.maximum(radius, found[3])
    return Contributions(largest, total, pixels, views, radius)


def _check(means, quats, log_scales, opacity_logits, weights) -> None:
    """ValueError unless all are of as many splats."""
    count = len(means)
    for name, tensor, columns in (
        ("means", means, 3), ("quats", quats, 4), ("log_scales", log_scales, 3),
    ):  # fmt: skip
        if tensor.shape != (count, columns):
            raise ValueError(f"{name} must have shape ({count}, {columns}), not {tuple(tensor.shape)}")
    for name, tensor in (("opacity_logits", opacity_logits), ("weights", weights)):
        if tensor is not None and tensor.shape != (count,):
            raise ValueError(f"{name} must have shape ({count},), not {tuple(tensor.shape)}")


def _coefficients(sh: torch.Tensor) -> torch.Tensor:
    """Plain colours (N, 3) as the coefficients (N, 1, 3) that give them; coefficients as they are."""
    return ((sh - 0.5) / C0)[:, None] if sh.ndim == 2 else sh


def _degree(sh: torch.Tensor, count: int, wanted: int | None) -> int:
    """The degree to draw with; ValueError unless sh is of ``count`` splats and of that degree at least."""
    if sh.ndim != 3 or sh.shape[0] != count or sh.shape[2] != 3:
        raise ValueError(f"sh must be ({count}, coefficients, 3) or ({count}, 3), not {tuple(sh.shape)}")
    degree = degree_of(sh.shape[1])
    if wanted is not None and wanted > degree:
        raise ValueError(f"sh has degree {degree}, sh_degree asks for {wanted}")
    return degree if wanted is None else wanted


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


def resolve(backend: str) -> str:
    """The backend that a name means on this computer: ``auto`` is cuda where that works, else cpu.

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
    return backend


def device_of(backend: str) -> torch.device:
    """Where the tensors live that a backend draws; LodgsError as :func:`resolve`."""
    from . import cuda

    return torch.device(cuda.DEVICE if resolve(backend) == "cuda" else "cpu")


def warm_up(backend: str = "auto") -> None:
    """Make one step on one splat, so that kernels are compiled: the first time on a computer this takes some
    seconds on the cpu and some minutes with cuda; later they are read from a cache.

    Numba makes millions of objects on the way; looking among them for garbage, again and again, would take a
    fifth of the time.
    """
    collects = gc.isenabled()
    gc.disable()
    try:
        if resolve(backend) == "cpu":
            from .cpu.compile import compile_in_two_processes

            compile_in_two_processes(partial(_step, "cpu"))
        _step(backend)
    finally:
        if collects:
            gc.enable()


def _step(backend: str) -> None:
    one = {
        "means": [[0.0, 0.0, 1.0]], "quats": [[1.0, 0.0, 0.0, 0.0]], "log_scales": [[0.0] * 3],
        "opacity_logits": [0.0], "sh": [[[0.0] * 3]],
    }  # fmt: skip
    device = device_of(backend)
    tensors = {name: torch.tensor(v, device=device, requires_grad=True) for name, v in one.items()}
    camera = Camera("", 16, 16, 16.0, 16.0, 8.0, 8.0, np.eye(4))
    drawn = rasterize(*tensors.values(), camera, backend=backend)  # pyright: ignore[reportCallIssue]
    photometric_loss(drawn.image, Target(torch.zeros(16, 16, 3)), backend=backend).backward()
    Adam(tensors, dict.fromkeys(tensors, 0.0)).step()


def _backend(name: str, tensor: torch.Tensor):
    if name == "auto":  # whoever made the tensors has chosen
        name = "cuda" if tensor.is_cuda else "cpu"
    return import_module(f".{resolve(name)}", __package__)
