"""Quality and speed of rendered images, measured on the held-out views of a scene if it has some."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from ..lod.on_disk import CulledReader
from ..lod.rule import Values
from ..lod.selection import BundleSelector, complete_splats, full_detail_controls
from ..optimize.training_data import TrainingData
from ..rasterize import Gaussians, Rendering, Target, rasterize, tensor_device
from ..rasterize.resident import ResidentBundle, SplatSet, WeightedSet, draw
from ..scenes.cameras import Camera, pick_evenly
from ..splats.gaussians import Splats
from ..splats.levels import Bundle, Level
from .metrics import psnr, ssim

MAX_TRAINING_VIEWS = 24
"""Maximum number of training views that are measured."""
REDUCTIONS = (1, 2, 4, 8)
"""Factors by which the sides of images are reduced to measure levels from afar."""
REPEATS = 3
"""Repetitions per view and variant when frames are timed."""

Measure = Callable[[torch.Tensor, torch.Tensor, torch.Tensor | None], float | tuple[float, ...]]
"""Compares a rendered image with its photo, both (H, W, 3), where an optional mask (H, W) allows it."""
SplatSource = Callable[[Camera], tuple[Splats, np.ndarray | None]]
"""Returns the splats to draw for a camera, all or only visible ones, and weights (N,) in [0, 1] on their
opacities; None means 1."""


def full_detail_source(bundle: Bundle, level: Level) -> SplatSource:
    """Return a source of the splats at full detail up to a level.

    The source returns all splats of the level. Some rules weight them, because the method trained with these
    weights. Of levels on disk, the source reads only splats that the camera sees.
    """
    if bundle.on_disk:
        return _visible_source(bundle, level)
    drawn = replace(bundle, levels=bundle.drawn_levels(level.number))
    controls = full_detail_controls(drawn)
    if controls is None:
        splats = complete_splats(bundle, level)
        return lambda camera: (splats, None)
    selector = BundleSelector(drawn)
    return lambda camera: (selector.splats, selector.weights(camera.center, camera.focal, controls))


def _visible_source(bundle: Bundle, level: Level) -> SplatSource:
    readers = [CulledReader(drawn.rows) for drawn in bundle.drawn_levels(level.number)]
    parts: list[Splats | None] = [None] * len(readers)

    def read_visible(camera: Camera) -> tuple[Splats, None]:
        for i, reader in enumerate(readers):
            missing = reader.missing(camera)
            if missing is not None:
                parts[i] = None  # free the old part before reading the new one
                parts[i] = reader.read(missing)
        return Splats.concatenated([part for part in parts if part is not None]), None

    return read_visible


def reduce_view(camera: Camera, target: Target, factor: int) -> tuple[Camera, Target]:
    """Reduce a view by a box filter; incomplete blocks of pixels are cut off.

    A reduced pixel counts if the mask allows each of its pixels.
    """
    width, height = camera.width // factor, camera.height // factor
    scaled = {name: getattr(camera, name) / factor for name in ("fx", "fy", "cx", "cy")}

    def blocks(pixels: torch.Tensor) -> torch.Tensor:
        cut = pixels[: height * factor, : width * factor]
        return cut.reshape(height, factor, width, factor, *pixels.shape[2:])

    mask = None if target.mask is None else blocks(target.mask).amin((1, 3))
    return replace(camera, width=width, height=height, **scaled), Target(
        blocks(target.image).mean((1, 3)), mask
    )


def _digest(parts: Sequence[Splats]) -> bytes:
    """Return a digest of splats, without extras."""
    digest = hashlib.blake2b(digest_size=16)
    for splats in parts:
        for values in (splats.means, splats.quats, splats.log_scales, splats.opacity_logits, splats.sh):
            digest.update(np.ascontiguousarray(values).data)
    return digest.digest()


class Evaluation:
    """Comparison of rendered images with the photos of a scene.

    Args:
        data: scene at training size.
        backend: rasterizer backend.
        antialias: as ``Bundle.antialias``.
        measures: measures of images by name, besides PSNR; SSIM if None.

    Attributes:
        cameras: held-out views; without any, at most ``MAX_TRAINING_VIEWS`` training views.
        prefix: prefix of the names of quality measures on ``cameras``: "", or "train_" for training views.
    """

    def __init__(
        self,
        data: TrainingData,
        backend: str = "auto",
        antialias: bool = False,
        measures: Mapping[str, Measure] | None = None,
    ) -> None:
        self.data = data
        self.backend = backend
        self.device = tensor_device(backend)
        self.antialias = antialias
        self.measures = {"ssim": ssim} if measures is None else measures
        self.cameras = data.test or pick_evenly(data.train, MAX_TRAINING_VIEWS)
        self.prefix = "" if data.test else "train_"
        self._measured: dict[bytes, dict] = {}

    def with_filter(self, antialias: bool) -> Evaluation:
        """Return the evaluation for a bundle with or without antialiasing."""
        return Evaluation(self.data, self.backend, antialias, self.measures)

    def target(self, camera: Camera) -> Target:
        """Return the photo (H, W, 3) of a view, with transparent parts black, and its mask (H, W) or None."""
        return self.data.images.target(camera)

    def load(self, splats: Splats | Gaussians) -> Gaussians:
        """Copy splats to the rasterizer's device, for repeated drawing."""
        return splats if isinstance(splats, Gaussians) else Gaussians.of(splats, self.device)

    def draw(
        self, splats: Splats | Gaussians, camera: Camera, weights: np.ndarray | None = None
    ) -> torch.Tensor:
        """Draw splats on black, with optional weights (N,) on their opacities; (H, W, 3) on the CPU."""
        return self.render(splats, camera, weights).image.cpu()

    def render(
        self, splats: Splats | Gaussians, camera: Camera, weights: np.ndarray | None = None
    ) -> Rendering:
        """Draw splats as :meth:`draw` does and return the complete rendering, on the rasterizer's device."""
        with torch.no_grad():
            return rasterize(
                self.load(splats),
                camera,
                weights=None if weights is None else torch.as_tensor(weights).to(self.device, torch.float32),
                near=self.data.near,
                antialias=self.antialias,
                backend=self.backend,
            )

    @property
    def _options(self) -> dict:
        return {"near": self.data.near, "antialias": self.antialias}

    def compare_views(
        self,
        cameras: Sequence[Camera],
        source: SplatSource,
        measure: Measure = psnr,
    ) -> np.ndarray:
        """Return the measure of each view, by default PSNR in dB, (V,)."""
        values = []
        for camera in cameras:
            splats, weights = source(camera)
            target = self.target(camera)
            values.append(measure(self.draw(splats, camera, weights), target.image, target.mask))
        return np.array(values)

    def measure_sizes(self, source: SplatSource) -> list[float]:
        """Return the mean PSNR of ``cameras`` in dB at each of REDUCTIONS, against box-filtered photos."""
        values = []
        for camera in self.cameras:
            splats, weights = source(camera)
            gaussians, photo = self.load(splats), self.target(camera)
            for factor in REDUCTIONS:
                view, target = reduce_view(camera, photo, factor)
                values.append(psnr(self.draw(gaussians, view, weights), target.image, target.mask))
        means = np.reshape(values, (-1, len(REDUCTIONS))).mean(0)
        return [round(float(value), 3) for value in means]

    def measure(
        self, render: Callable[[Camera], Rendering], count: Callable[[Camera], int] | None = None
    ) -> dict:
        """Measure quality, number of splats and seconds per frame over ``cameras``.

        Args:
            render: selects and draws the splats of a camera.
            count: returns the number of splats with a weight for a camera, visible or not. None counts those
                given to the rasterizer.

        Returns:
            ``splats`` (mean count), ``drawn`` (mean number in the image), ``psnr`` (dB), ``measures`` and
            ``frame_s`` (median, with selection). Names on training views are ``train_psnr`` and so on.
        """
        drawn, rendered = [], []

        def draw_image(camera: Camera) -> torch.Tensor:
            rendering = render(camera)
            drawn.append(int((rendering.radii > 0).sum()))
            rendered.append(len(rendering.radii))
            return rendering.image.cpu()

        quality = self.measure_images(draw_image)
        splats = np.mean([count(camera) for camera in self.cameras] if count else rendered)
        return {"splats": round(float(splats)), "drawn": round(float(np.mean(drawn))), **quality}

    def measure_images(self, draw_image: Callable[[Camera], torch.Tensor]) -> dict:
        """Measure quality and ``frame_s`` as :meth:`measure` does, for images (H, W, 3) from any source."""
        rows = []
        for camera in self.cameras:
            started = time.perf_counter()
            image = draw_image(camera)
            seconds = time.perf_counter() - started
            target = self.target(camera)
            pair = image, target.image, target.mask
            rows.append((seconds, psnr(*pair), *(measure(*pair) for measure in self.measures.values())))
        seconds, quality, *columns = np.array(rows).T
        named = zip(self.measures, columns, strict=True)
        return {
            f"{self.prefix}psnr": round(float(quality.mean()), 3),
            **{f"{self.prefix}{name}": round(float(values.mean()), 4) for name, values in named},
            "frame_s": round(float(np.median(seconds)), 4),
        }

    def measure_by_distance(self, resident: ResidentBundle, values: Values) -> dict:
        """Measure a bundle with the levels that its rule selects for the given control values."""

        def count(camera: Camera) -> int:
            sets = resident.select_by_rule(camera, values).values()
            return sum(len(part.splats.select_visible(part.query)[0]) for part in sets)

        return self.measure(lambda camera: resident.draw(camera, values, **self._options), count)

    def measure_level(self, bundle: Bundle, level: Level) -> dict:
        """Measure a complete level, with the weights of full detail.

        Levels in memory without weights are measured once, because trainings finish some levels repeatedly.
        """
        drawn = replace(bundle, levels=bundle.drawn_levels(level.number))
        resident = ResidentBundle(drawn, self.backend)
        controls = full_detail_controls(drawn)
        if controls is not None:
            return self.measure_by_distance(resident, controls)
        total = sum(len(part.rows) for part in drawn.levels)
        digest = b"" if drawn.on_disk else _digest([part.splats for part in drawn.levels])
        if not digest or digest not in self._measured:
            self._measured[digest] = self.measure(
                lambda camera: resident.draw_level(level.number, camera, **self._options),
                lambda camera: total,
            )
        return dict(self._measured[digest])

    def measure_splats(self, splats: Splats, weights: np.ndarray | None = None) -> dict:
        """Measure one set of splats that is the same for all views, with weights (N,) on their opacities."""
        sets = [WeightedSet(SplatSet(splats, weights, self.backend), None)]
        return self.measure(
            lambda camera: draw(sets, camera, backend=self.backend, **self._options),
            lambda camera: len(splats),
        )

    def frame_times(self, draws: Mapping[str, Callable[[Camera], object]]) -> dict[str, float]:
        """Measure the median seconds per frame of several ways to draw, by name, drawn in turn."""
        times: dict[str, list[float]] = {name: [] for name in draws}
        for camera in pick_evenly(self.cameras, MAX_TRAINING_VIEWS):
            for _ in range(REPEATS):
                for name, draw_view in draws.items():
                    started = time.perf_counter()
                    draw_view(camera)
                    times[name].append(time.perf_counter() - started)
        return {name: round(float(np.median(seconds)), 5) for name, seconds in times.items()}
