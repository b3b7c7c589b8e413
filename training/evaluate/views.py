"""The held-out views of a scene: what pictures of splats are measured on."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
import torch

from ..lod.rule import Values, find_rule
from ..lod.selection import Choice, complete, settings
from ..methods.data import TrainingData
from ..rasterize import Gaussians, Rendering, device_of, rasterize
from ..scenes.cameras import Camera
from ..splats.bundle import Bundle, Level
from ..splats.gaussians import Splats
from .metrics import psnr, ssim


class Evaluation:
    """The held-out views of a scene, ready to be compared with.

    Args:
        data: the scene at training size; its ``test`` views are used.
        backend: rasterizer.
    """

    def __init__(self, data: TrainingData, backend: str = "auto") -> None:
        self.data, self.backend, self.device = data, backend, device_of(backend)
        self.cameras = data.test
        self._targets: dict[str, torch.Tensor] = {}

    def target(self, camera: Camera) -> torch.Tensor:
        """The photograph of a view, (H, W, 3)."""
        if camera.name not in self._targets:
            self._targets[camera.name] = torch.from_numpy(self.data.image(camera))
        return self._targets[camera.name]

    def load(self, splats: Splats | Gaussians) -> Gaussians:
        """Splats where they are drawn, for those that are drawn again and again."""
        return splats if isinstance(splats, Gaussians) else Gaussians.of(splats, self.device)

    def draw(
        self, splats: Splats | Gaussians, camera: Camera, weights: np.ndarray | None = None
    ) -> torch.Tensor:
        """A picture of splats on black, (H, W, 3), on the CPU, with a weight on each splat's opacity."""
        return self.render(splats, camera, weights).image.cpu()

    def render(
        self,
        splats: Splats | Gaussians,
        camera: Camera,
        weights: np.ndarray | None = None,
        outputs: Collection[str] = (),
    ) -> Rendering:
        """The same with all that a rendering tells, and ``outputs`` of it (``rasterize.OUTPUTS``)."""
        with torch.no_grad():
            return rasterize(
                self.load(splats),
                camera,
                weights=None if weights is None else torch.as_tensor(weights).to(self.device, torch.float32),
                near=self.data.near,
                outputs=outputs,
                backend=self.backend,
            )

    def measure(self, shown_to: Callable[[Camera], tuple[Gaussians, np.ndarray | None]]) -> dict:
        """Mean quality, splats that have a weight and seconds a frame over the held-out views.

        Args:
            shown_to: the splats that a camera is shown, with their weights (None: all 1).

        Returns:
            ``splats`` (mean count), ``drawn`` (of these in the image), ``psnr`` (dB), ``ssim``, ``frame_s``
            (median, selection included).
        """
        found = []

        def picture(camera: Camera) -> torch.Tensor:
            splats, weights = shown_to(camera)
            rendering = self.render(splats, camera, weights)
            found.append((len(splats) if weights is None else weights, rendering.radii))
            return rendering.image.cpu()

        quality = self.measure_pictures(picture)
        drawn = [int((radii > 0).sum()) for _, radii in found]
        splats = [given if isinstance(given, int) else np.count_nonzero(given > 0) for given, _ in found]
        return {"splats": round(float(np.mean(splats))), "drawn": round(float(np.mean(drawn))), **quality}

    def measure_pictures(self, picture: Callable[[Camera], torch.Tensor]) -> dict:
        """``psnr``, ``ssim`` and ``frame_s`` as :meth:`measure`, of pictures however they are made."""
        rows = []
        for camera in self.cameras:
            started = time.perf_counter()
            image = picture(camera)
            seconds = time.perf_counter() - started
            target = self.target(camera)
            rows.append((psnr(image, target), ssim(image, target), seconds))
        table = np.array(rows)
        return {
            "psnr": round(float(table[:, 0].mean()), 3),
            "ssim": round(float(table[:, 1].mean()), 4),
            "frame_s": round(float(np.median(table[:, 2])), 4),
        }

    def measure_by_distance(self, bundle: Bundle, values: Values) -> dict:
        """The same of what each view is shown of a bundle by its rule, with these values of the controls."""
        choice = Choice(bundle)
        splats = self.load(choice.splats)
        return self.measure(lambda camera: (splats, choice.weights(camera.center, camera.focal, values)))

    def measure_level(self, bundle: Bundle, level: Level) -> dict:
        """The same of all that is drawn at a level; by the bundle's rule where its weights always count."""
        rule = find_rule(bundle.rule)
        if rule is None or not rule.always:
            return self.measure_set(complete(bundle, level))
        alone = replace(bundle, levels=bundle.upto(level.number))
        return self.measure_by_distance(alone, settings(alone, {}))

    def measure_set(self, splats: Splats, weights: np.ndarray | None = None) -> dict:
        """The same for one set of splats that every view is shown."""
        loaded = self.load(splats)
        return self.measure(lambda camera: (loaded, weights))
