"""The views of a scene that pictures of splats are measured on: held-out ones, where there are some."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from ..lod.on_disk import CulledReader
from ..lod.rule import Values, find_rule
from ..lod.selection import BundleSelector, complete_splats, resolve_controls
from ..optimize.training_data import TrainingData
from ..rasterize import Gaussians, Rendering, Target, rasterize, tensor_device
from ..rasterize.resident import ResidentBundle, SplatSet, WeightedSet, draw
from ..scenes.cameras import Camera, pick_evenly
from ..splats.gaussians import Splats
from ..splats.levels import Bundle, Level
from .metrics import psnr, ssim

MAX_TRAINING_VIEWS = 24
"""How many training views tell the quality of all."""
REPEATS = 3
"""How often a view is drawn to time it."""

Measure = Callable[[torch.Tensor, torch.Tensor, torch.Tensor | None], float | tuple[float, ...]]
"""What is found of a picture and its photograph, (H, W, 3) both, and of the mask of what counts of it."""
SplatSelector = Callable[[Camera], tuple[Splats, np.ndarray | None]]
"""What a camera is shown: splats, all that there are or those in its sight, and weights (N,) in [0, 1] on
opacities; None: all 1."""


def full_detail_selector(bundle: Bundle, level: Level) -> SplatSelector:
    """What a camera is shown at full detail up to a level.

    That is all that is drawn at the level, but for rules whose weights always count: there splats without
    them are not what was trained, and each camera is shown what the rule gives it. Of levels that are not in
    memory it is what the camera has in sight.
    """
    if bundle.on_disk:
        return _in_sight(bundle, level)
    rule = find_rule(bundle.rule)
    if rule is None or not rule.always_active:
        everything = complete_splats(bundle, level)
        return lambda camera: (everything, None)
    alone = replace(bundle, levels=bundle.drawn_levels(level.number))
    choice, values = BundleSelector(alone), resolve_controls(alone, {})
    return lambda camera: (choice.splats, choice.weights(camera.center, camera.focal, values))


def _in_sight(bundle: Bundle, level: Level) -> SplatSelector:
    sights = [CulledReader(each.rows) for each in bundle.drawn_levels(level.number)]
    parts: list[Splats | None] = [None] * len(sights)

    def shown_to(camera: Camera) -> tuple[Splats, None]:
        for i, sight in enumerate(sights):
            missing = sight.missing(camera)
            if missing is not None:
                parts[i] = None  # so that both are never in memory
                parts[i] = sight.read(missing)
        return Splats.concatenated([part for part in parts if part is not None]), None

    return shown_to


class Evaluation:
    """Views of a scene, ready to be compared with.

    Args:
        data: the scene at training size.
        backend: rasterizer.
        antialias: how splats are drawn, see ``Bundle.antialias``.

    Attributes:
        cameras: the held-out views; where none are, training views, ``MOST_TRAINING_VIEWS`` at most.
        prefix: of the names that quality on ``cameras`` goes by: none, or ``train_`` for training views.
    """

    def __init__(self, data: TrainingData, backend: str = "auto", antialias: bool = False) -> None:
        self.data, self.backend, self.device = data, backend, tensor_device(backend)
        self.antialias = antialias
        self.cameras = data.test or pick_evenly(data.train, MAX_TRAINING_VIEWS)
        self.prefix = "" if data.test else "train_"

    def target(self, camera: Camera) -> Target:
        """The photograph of a view, on black where it is transparent, and what of it counts."""
        return self.data.photographs.target(camera)

    def load(self, splats: Splats | Gaussians) -> Gaussians:
        """Splats where they are drawn, for those that are drawn again and again."""
        return splats if isinstance(splats, Gaussians) else Gaussians.of(splats, self.device)

    def draw(
        self, splats: Splats | Gaussians, camera: Camera, weights: np.ndarray | None = None
    ) -> torch.Tensor:
        """A picture of splats on black, (H, W, 3), on the CPU, with a weight on each splat's opacity."""
        return self.render(splats, camera, weights).image.cpu()

    def render(
        self, splats: Splats | Gaussians, camera: Camera, weights: np.ndarray | None = None
    ) -> Rendering:
        """The same with all that a rendering tells."""
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
        shown_to: SplatSelector,
        measure: Measure = psnr,
    ) -> np.ndarray:
        """The PSNR of each of some views with a photograph, in dB, (V,); or what else ``measure`` finds."""
        found = []
        for camera in cameras:
            splats, weights = shown_to(camera)
            target = self.target(camera)
            found.append(measure(self.draw(splats, camera, weights), target.image, target.mask))
        return np.array(found)

    def measure(self, render: Callable[[Camera], Rendering], count: Callable[[Camera], int]) -> dict:
        """Mean quality, splats that have a weight and seconds a frame over ``cameras``.

        Args:
            render: what a camera sees, choosing included.
            count: how many splats have a weight for it, in sight or not.

        Returns:
            ``splats`` (mean count), ``drawn`` (of these in the image), ``psnr`` (dB), ``ssim``, ``frame_s``
            (median, selection included); on training views ``train_psnr`` and ``train_ssim``.
        """
        drawn = []

        def picture(camera: Camera) -> torch.Tensor:
            rendering = render(camera)
            drawn.append(int((rendering.radii > 0).sum()))
            return rendering.image.cpu()

        quality = self.measure_images(picture)
        splats = np.mean([count(camera) for camera in self.cameras])
        return {"splats": round(float(splats)), "drawn": round(float(np.mean(drawn))), **quality}

    def measure_images(self, picture: Callable[[Camera], torch.Tensor]) -> dict:
        """Quality and ``frame_s`` as :meth:`measure`, of pictures however they are made."""
        rows = []
        for camera in self.cameras:
            started = time.perf_counter()
            image = picture(camera)
            seconds = time.perf_counter() - started
            target = self.target(camera)
            pair = image, target.image, target.mask
            rows.append((psnr(*pair), ssim(*pair), seconds))
        table = np.array(rows)
        return {
            f"{self.prefix}psnr": round(float(table[:, 0].mean()), 3),
            f"{self.prefix}ssim": round(float(table[:, 1].mean()), 4),
            "frame_s": round(float(np.median(table[:, 2])), 4),
        }

    def measure_by_distance(self, resident: ResidentBundle, values: Values) -> dict:
        """The same of what each view is shown of a bundle by its rule, with these values of the controls."""

        def count(camera: Camera) -> int:
            shown = resident.select_by_rule(camera, values).values()
            return sum(len(one.splats.select_visible(one.query)[0]) for one in shown)

        return self.measure(lambda camera: resident.draw(camera, values, **self._options), count)

    def measure_level(self, bundle: Bundle, level: Level) -> dict:
        """The same of all that is drawn at a level; by the bundle's rule where its weights always count."""
        rule, alone = find_rule(bundle.rule), replace(bundle, levels=bundle.drawn_levels(level.number))
        resident = ResidentBundle(alone, self.backend)
        if rule is not None and rule.always_active:
            return self.measure_by_distance(resident, resolve_controls(alone, {}))
        total = sum(len(each.rows) for each in alone.levels)
        return self.measure(
            lambda camera: resident.draw_level(level.number, camera, **self._options), lambda camera: total
        )

    def measure_splats(self, splats: Splats, weights: np.ndarray | None = None) -> dict:
        """The same for one set of splats that every view is shown."""
        shown = [WeightedSet(SplatSet(splats, weights, self.backend), None)]
        return self.measure(
            lambda camera: draw(shown, camera, backend=self.backend, **self._options),
            lambda camera: len(splats),
        )

    def frame_times(self, draws: Mapping[str, Callable[[Camera], object]]) -> dict[str, float]:
        """Seconds a frame of several ways to draw, by name: the median over views, drawn in turn."""
        found: dict[str, list[float]] = {name: [] for name in draws}
        for camera in pick_evenly(self.cameras, MAX_TRAINING_VIEWS):
            for _ in range(REPEATS):
                for name, one in draws.items():
                    started = time.perf_counter()
                    one(camera)
                    found[name].append(time.perf_counter() - started)
        return {name: round(float(np.median(seconds)), 5) for name, seconds in found.items()}
