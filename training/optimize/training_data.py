"""Training data: views at training size, held-out views, images and the scene's units."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import torch

from ..errors import LodgsError, SystemProblem
from ..lod.crop import Crop
from ..rasterize import Target
from ..scenes.cameras import Camera, pick_evenly
from ..scenes.colmap import Scene
from ..scenes.depths import DepthPriors
from ..scenes.exposures import remove_gain
from ..scenes.image_headers import image_size
from ..scenes.images import load_image, load_mask
from .image_cache import ImageCache, default_budget
from .memory import TARGET_BYTES

ALPHA_SAMPLES = 3
"""Number of images to check for transparency."""
MIN_SIDE = 11
"""Minimum side of an image in pixels: the window size of SSIM."""
DEPTH_BYTES = 4
"""Bytes per pixel of a depth map."""
OPAQUE_ALPHA = 0.99
"""Alpha that counts as opaque despite rounding."""

ViewPlan = Callable[[int], tuple[int, float] | None]
"""Forecast of a step: index of its training view and image reduction factor. None if it needs no view."""


@dataclass(frozen=True)
class TrainingView:
    """Camera and image of a training step.

    Attributes:
        index: index of the training view.
        camera: camera at the size of the target.
        target: image, ready for the loss.
        shrink: reduction factor relative to training size.
    """

    index: int
    camera: Camera
    target: Target
    shrink: float = 1


class TrainingData:
    """Views of a scene at training size, with a cache of their images.

    Args:
        full_scene: undivided scene, if ``scene`` is a cell. It determines units and held-out views. None if
            ``scene`` is complete.
        photo_memory: size of the image cache in bytes; None for ``image_cache.default_budget``. Does not
            affect the result.
        splat_memory: bytes of splats in memory, for methods with splats on disk; None for their default.
        scratch: folder for files of such methods, to which checkpoints refer; None for a temporary folder.
        depths: depth priors of training views, if any.
        region: region in scene coordinates where splats are added; None for everywhere.
        gains: exposure corrections by image name (see ``scenes.exposures``); None for no correction.

    Attributes:
        scene: scene to train.
        full_scene: undivided scene, or ``scene`` itself.
        full_train: training cameras of the full scene, at training size.
        train, test: cameras at training size. Test views are every n-th by name (see ``Scene.split``).
        images: cache of the images of these views.
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
        self.full_scene = scene if full_scene is None else full_scene
        all_train, all_test = self.full_scene.split(test_every, validation)
        train, test = (_intersection(scene.cameras, cameras) for cameras in (all_train, all_test))
        _check_scene(scene, train)
        if validation and not all_test:
            raise LodgsError(
                f"Cannot validate: test_every = {test_every} holds out none of the "
                f"{len(self.full_scene.cameras)} usable views in {scene.folder} for validation.",
                "Use a smaller test_every, or train without validation.",
            )
        self.scene = scene
        self.exposure = exposure
        self.depths = depths
        self.region = region
        self._train_names = {camera.name for camera in train}
        self._gains = gains or {}
        self._sizes = {camera.image: (camera.width, camera.height) for camera in scene.cameras}
        self.full_train = [camera.scaled(image_scale) for camera in all_train]
        self.train = [camera.scaled(image_scale) for camera in train]
        self.test = [camera.scaled(image_scale) for camera in test]
        for camera in (*self.train, *self.test):
            if min(camera.width, camera.height) < MIN_SIDE:
                raise LodgsError(
                    f"Cannot train: the size of {camera.name} is {camera.width} x {camera.height} pixels, "
                    f"{MIN_SIDE} per side are needed.",
                    "Use a larger image_scale.",
                )
        _check_masks(self.train)
        budget = default_budget() if photo_memory is None else photo_memory
        if depths:
            budget = budget * TARGET_BYTES // (TARGET_BYTES + DEPTH_BYTES)
        self.images = ImageCache(self._read, budget)
        self.splat_memory = splat_memory
        self._scratch = scratch
        self._planned: ViewPlan | None = None

    @cached_property
    def scratch(self) -> Path:
        """Folder for files of methods that store splats on disk."""
        if self._scratch is not None:
            return self._scratch
        self._temporary = tempfile.TemporaryDirectory(prefix="lodgs-")
        return Path(self._temporary.name)

    @cached_property
    def extent(self) -> float:
        """Scene extent in scene units: 1.1 x the largest distance of a camera from the mean position."""
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
        """Median focal length of the training views, in pixels."""
        return float(np.median([camera.focal for camera in self.full_train]))

    @cached_property
    def near(self) -> float:
        """Near plane, in scene units."""
        return self.full_scene.near()

    @cached_property
    def threshold_scale(self) -> float:
        """Factor on 3DGS's gradient threshold for the image size.

        The loss is a mean over pixels, and gradients are in half image widths. For a splat of constant size
        in pixels, the gradient is therefore inversely proportional to the image's side.
        """
        pixels = np.median([camera.width * camera.height for camera in self.full_train])
        return float(np.sqrt(1e6 / pixels))

    @cached_property
    def transparent(self) -> bool:
        """True if any of ``ALPHA_SAMPLES`` training images has transparent pixels."""
        for camera in pick_evenly(self.train, ALPHA_SAMPLES):
            if camera.image is not None:
                try:
                    pixels = load_image(camera.image, camera.width, camera.height, alpha=True)
                except SystemProblem:
                    raise
                except LodgsError:  # raised again by the step that needs the image
                    continue
                if pixels[..., 3].min() < OPAQUE_ALPHA:
                    return True
        return False

    def training_view(self, step: int, seed: int) -> int:
        """Return the index of a step's view. Each epoch is a new shuffle, from (seed, epoch)."""
        epoch, position = divmod(step, len(self.train))
        return int(_shuffled(len(self.train), seed, epoch)[position])

    def view_at(self, step: int, planned: ViewPlan) -> TrainingView:
        """Return the view of a step, and read the images of the next steps ahead.

        Args:
            planned: forecast of views.
        """
        if planned != self._planned:
            self._planned = planned
            self._plan = lambda step: None if (view := planned(step)) is None else self.camera(*view)
        self.images.prefetch(step, self._plan)
        view = planned(step)
        assert view is not None
        return self.view(*view)

    def view(self, index: int, shrink: float = 1) -> TrainingView:
        """Return a training view by index, reduced by ``shrink``."""
        return TrainingView(index, self.camera(index, shrink), self.target(index, shrink), shrink)

    def camera(self, view: int, shrink: float = 1) -> Camera:
        """Return the camera of a training view, with an image reduced by ``shrink``."""
        return self.train[view] if shrink == 1 else self.train[view].scaled(1 / shrink)

    def target(self, view: int, shrink: float = 1) -> Target:
        """Return the image of a training view, reduced by ``shrink`` and ready for the loss."""
        return self.images.target(self.camera(view, shrink))

    def _read(self, camera: Camera) -> Target:
        """Load an image at the camera's size, in planar layout as needed by losses."""
        assert camera.image is not None
        size = (camera.width, camera.height)
        alpha = self.transparent
        image = load_image(camera.image, *size, exposure=self.exposure, alpha=alpha)
        self._check_size(camera.image)
        if camera.name in self._gains:
            image[..., :3] = remove_gain(image[..., :3], self._gains[camera.name])
        planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
        mask = None if camera.mask is None else load_mask(camera.mask, *size)
        inverse_depth = (
            self.depths.inverse(camera) if self.depths and camera.name in self._train_names else None
        )
        if inverse_depth is not None and mask is not None:
            inverse_depth[mask <= 0.5] = np.nan
        return Target(planes[:3].permute(1, 2, 0), mask, planes[3] if alpha else None, inverse_depth)

    def _check_size(self, image: Path) -> None:
        """Raise LodgsError if a photo of the scene was replaced by one of another size."""
        size = image_size(image)
        expected = self._sizes.get(image, size)
        if size != expected:
            raise LodgsError(
                f"Cannot train: the size of {image} changed from {expected[0]}x{expected[1]} to "
                f"{size[0]}x{size[1]} pixels.",
                "Restore the photo, then resume the run.",
            )


def _check_scene(scene: Scene, train: Sequence[Camera]) -> None:
    """Raise LodgsError unless a scene has points and enough views to train."""
    if len(scene.points) == 0:
        raise LodgsError(
            f"Cannot train: the COLMAP model in {scene.model} has no 3D points.",
            "Triangulate points in COLMAP, or choose another model.",
        )
    if len(scene.cameras) < 2:
        raise LodgsError(
            f"Cannot train {scene.folder}: it has {len(scene.cameras)} usable view(s) and needs 2.",
            "Check that the image folder contains the photos of the model.",
        )
    if len(train) < 2:
        raise LodgsError(
            f"Cannot train: {len(train)} of {len(scene.cameras)} usable views in {scene.folder} remain "
            "for training after holding out views, 2 are needed.",
            "Set test_every to 0 to hold out no views, or to a larger number.",
        )


def _check_masks(train: Sequence[Camera]) -> None:
    """Raise LodgsError if all cameras have masks that ignore all pixels."""
    for camera in train:  # the first mask usually decides
        if camera.mask is None or load_mask(camera.mask, camera.width, camera.height).any():
            return
    raise LodgsError(
        f"Cannot train: masks such as {train[0].mask} are black, so that all pixels are ignored.",
        "Make the parts to train white, or remove the masks.",
    )


def _intersection(cameras: Sequence[Camera], selection: Sequence[Camera]) -> list[Camera]:
    """Return the cameras that also occur in another list, by name."""
    names = {camera.name for camera in selection}
    return [camera for camera in cameras if camera.name in names]


@lru_cache(8)
def _shuffled(count: int, seed: int, epoch: int) -> np.ndarray:
    return np.random.default_rng([seed, epoch]).permutation(count)
