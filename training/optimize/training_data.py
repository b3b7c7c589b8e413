"""What methods train on: views at training size, held-out views, and the scene's own units."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch

from ..errors import LodgsError
from ..lod.crop import Crop
from ..rasterize import Target
from ..scenes.cameras import Camera, pick_evenly
from ..scenes.colmap import Scene
from ..scenes.depths import DepthPriors
from ..scenes.exposures import remove_gain
from ..scenes.images import load_image, load_mask
from .image_cache import ImageCache, default_budget
from .memory import TARGET_BYTES
from .support import Support

ALPHA_SAMPLES = 3
"""Photographs that are looked at for whether they are transparent."""
MIN_SIDE = 11
"""Pixels of a photograph's shorter side: SSIM compares windows of so many."""
DEPTH_BYTES = 4
"""Bytes a pixel that depth takes beside a photograph."""
OPAQUE_ALPHA = 0.99
"""Alpha from here on is no transparency, but rounding."""

ViewPlan = Callable[[int], tuple[int, float] | None]
"""Of a step: the index of its training view, and how many times smaller that is; None: it needs none."""


@dataclass(frozen=True)
class TrainingView:
    """What a step compares its picture with.

    Attributes:
        index: of the training view.
        camera: the view, at the size of the target.
        target: the photograph, ready for the loss.
        shrink: how many times smaller than training size it is.
    """

    index: int
    camera: Camera
    target: Target
    shrink: float = 1


class TrainingData:
    """A scene's views, resized, and their photographs, never more than fit.

    Args:
        whole: the scene that this one is a part of, whose units, and whose held-out views, count; None: it is
            no part.
        photo_memory: bytes of photographs that are kept; None: ``targets.default_budget``. What is trained
            does not depend on it.
        splat_memory: bytes of splats that are kept by methods that have them in files; None: as they choose.
        scratch: where such methods make files, which a checkpoint tells of; None: in a temporary folder.
        depths: what is known of the depth in training views; None: nothing.
        region: where splats are added, in the scene's coordinates; None: everywhere.
        gains: of photographs by name what they are evened by, see ``scenes.exposures``; None: none is.

    Attributes:
        scene: what is trained on.
        whole: the scene that it is a part of, or the same.
        whole_train: training cameras of the whole scene, at training size.
        train, test: cameras at training size; test views are every n-th by name (see ``Scene.split``).
        photographs: of any of these views.
    """

    def __init__(
        self,
        scene: Scene,
        image_scale: float = 1.0,
        test_every: int = 8,
        exposure: float = 0.0,
        validation: bool = False,
        photo_memory: int | None = None,
        splat_memory: int | None = None,
        scratch: Path | None = None,
        full_scene: Scene | None = None,
        depths: DepthPriors | None = None,
        region: Crop | None = None,
        gains: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        if len(scene.points) == 0:
            raise LodgsError(
                f"The COLMAP model in {scene.model} has no 3D points, so there is nothing to train from.",
                "Triangulate the model's points in COLMAP, or choose another model.",
            )
        self.full_scene = scene if full_scene is None else full_scene
        all_train, all_test = self.full_scene.split(test_every, validation)
        train, test = (_among(scene.cameras, each) for each in (all_train, all_test))
        if len(scene.cameras) < 2:
            raise LodgsError(
                f"The scene {scene.folder} has {len(scene.cameras)} usable view(s); 2 are needed.",
                "Check that the image folder holds the photographs that the model names.",
            )
        if len(train) < 2:
            raise LodgsError(
                f"Of the {len(scene.cameras)} usable views in {scene.folder} {len(train)} would be trained "
                "on and the others held out; 2 are needed.",
                "Hold out none (test_every = 0), or one of more.",
            )
        if validation and not all_test:
            raise LodgsError(
                f"Of the {len(self.full_scene.cameras)} usable views in {scene.folder} validation leaves some out "
                f"and measures none, with one of every {test_every} held out.",
                "Give a smaller test_every, or train without validation.",
            )
        self.scene, self.exposure, self.depths, self.region = scene, exposure, depths, region
        self._trained, self._gains = {camera.name for camera in train}, gains or {}
        self.full_train = [camera.scaled(image_scale) for camera in all_train]
        self.train = [camera.scaled(image_scale) for camera in train]
        self.test = [camera.scaled(image_scale) for camera in test]
        for camera in (*self.train, *self.test):
            if min(camera.width, camera.height) < MIN_SIDE:
                raise LodgsError(
                    f"{camera.name} would be trained on at {camera.width} x {camera.height} pixels; "
                    f"{MIN_SIDE} are needed.",
                    "Give a larger image_scale.",
                )
        budget = default_budget() if photo_memory is None else photo_memory
        if depths:
            budget = budget * TARGET_BYTES // (TARGET_BYTES + DEPTH_BYTES)
        self.images = ImageCache(self._read, budget)
        self.splat_memory, self._scratch = splat_memory, scratch
        self._planned: ViewPlan | None = None

    @cached_property
    def scratch(self) -> Path:
        """A folder for files of the run that methods go on with after a checkpoint."""
        if self._scratch is not None:
            return self._scratch
        self._temporary = tempfile.TemporaryDirectory(prefix="lodgs-")
        return Path(self._temporary.name)

    @cached_property
    def extent(self) -> float:
        """Scene extent in scene units: 1.1 x the largest distance of a camera from their mean."""
        return self.full_scene.extent()

    @cached_property
    def median_depth(self) -> float:
        """Median depth of the points in the views, in scene units."""
        return self.full_scene.median_depth()

    @cached_property
    def mean_camera(self) -> np.ndarray:
        """Mean position of the training cameras, (3,)."""
        return np.mean([camera.center for camera in self.full_train], axis=0)

    @cached_property
    def focal(self) -> float:
        """Focal length in pixels: the training views' median."""
        return float(np.median([camera.focal for camera in self.full_train]))

    @cached_property
    def support(self) -> Support:
        """Where the training views leave room for splats."""
        return Support(self.train, self.scene.points)

    @cached_property
    def near(self) -> float:
        """Depth before which nothing is drawn, in scene units."""
        return self.full_scene.near()

    @cached_property
    def threshold_scale(self) -> float:
        """Factor on 3DGS's gradient threshold for the size of these images.

        The loss is a mean over pixels, and the gradient counts half image widths: for a splat of given
        size in pixels it grows as the image shrinks, with the inverse of the image's side.
        """
        pixels = np.median([camera.width * camera.height for camera in self.full_train])
        return float(np.sqrt(1e6 / pixels))

    @cached_property
    def transparent(self) -> bool:
        """Whether photographs have alpha that counts: one of TRIED training views is not opaque."""
        for camera in pick_evenly(self.train, ALPHA_SAMPLES):
            if camera.image is not None:
                with suppress(LodgsError):  # which the step that needs it tells
                    pixels = load_image(camera.image, camera.width, camera.height, alpha=True)
                    if pixels[..., 3].min() < OPAQUE_ALPHA:
                        return True
        return False

    def training_view(self, step: int, seed: int) -> int:
        """The index of the view to train at a step: every epoch is a new shuffle, from (seed, epoch)."""
        epoch, place = divmod(step, len(self.train))
        return int(_shuffled(len(self.train), seed, epoch)[place])

    def view_at(self, step: int, planned: ViewPlan) -> TrainingView:
        """The view of a step; those that the next steps need are read meanwhile.

        Args:
            planned: what steps need, as far as is known now.
        """
        if planned != self._planned:
            self._planned = planned
            self._plan = lambda step: None if (view := planned(step)) is None else self.camera(*view)
        self.images.prefetch(step, self._plan)
        view = planned(step)
        assert view is not None
        return self.view(*view)

    def view(self, index: int, shrink: float = 1) -> TrainingView:
        """A training view by index, its image ``shrink`` times smaller."""
        return TrainingView(index, self.camera(index, shrink), self.target(index, shrink), shrink)

    def camera(self, view: int, shrink: float = 1) -> Camera:
        """A training view, its image ``shrink`` times smaller: what one as far away would see."""
        return self.train[view] if shrink == 1 else self.train[view].scaled(1 / shrink)

    def target(self, view: int, shrink: float = 1) -> Target:
        """The ground truth of a training view, ``shrink`` times smaller, ready for the loss."""
        return self.images.target(self.camera(view, shrink))

    def _read(self, camera: Camera) -> Target:
        """The photograph at the camera's size, its planes one after the other as losses take them."""
        assert camera.image is not None
        size, alpha = (camera.width, camera.height), self.transparent
        image = load_image(camera.image, *size, exposure=self.exposure, alpha=alpha)
        if camera.name in self._gains:
            image[..., :3] = remove_gain(image[..., :3], self._gains[camera.name])
        planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
        mask = None if camera.mask is None else load_mask(camera.mask, *size)
        known = self.depths.inverse(camera) if self.depths and camera.name in self._trained else None
        if known is not None and mask is not None:
            known[mask <= 0.5] = np.nan
        return Target(planes[:3].permute(1, 2, 0), mask, planes[3] if alpha else None, known)


def _among(cameras: Sequence[Camera], others: Sequence[Camera]) -> list[Camera]:
    """Those of some cameras that are among others, by name."""
    names = {camera.name for camera in others}
    return [camera for camera in cameras if camera.name in names]


@lru_cache(8)
def _shuffled(count: int, seed: int, epoch: int) -> np.ndarray:
    return np.random.default_rng([seed, epoch]).permutation(count)
