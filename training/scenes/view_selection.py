"""Selection of the usable views of a COLMAP model, with warnings about the other views. numpy only."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..errors import LodgsError, SystemProblem, printable
from .cameras import Camera
from .colmap_model import Intrinsics, Pose
from .image_files import ImageFiles, SidecarFiles
from .images import image_size, quarter_turns

OUTLIER_FACTOR = 1000
"""Points and cameras farther from the camera centre than this multiple of the median distance are dropped."""
MAX_NAMED = 5
"""Maximum number of views named by warnings of one kind; the remaining ones are counted."""


class ViewCollector:
    """Collects the usable views of a model and the reasons for skipping the other views.

    Attributes:
        excluded: (name, sentence) for each skipped view.
    """

    def __init__(self, files: ImageFiles, masks: SidecarFiles, depths: SidecarFiles) -> None:
        self._files = files
        self._masks = masks
        self._depths = depths
        self._missing: list[str] = []
        self._reshaped: list[str] = []
        self.cameras: list[Camera] = []
        self.distorted: list[str] = []
        self.excluded: list[tuple[str, str]] = []

    def add(self, pose: Pose, lens: Intrinsics) -> None:
        """Add a view at the size of its photo, or record the reason for skipping it."""
        name = pose.name.replace("\\", "/")
        try:
            if not lens.lens.focals:
                raise LodgsError(f"camera model {lens.lens.name} is a panorama, not a perspective view.")
            if self.cameras and self.cameras[-1].name == name:
                raise LodgsError("the model has another view of the same name.")
            image = self._files.find(pose.name)
            if image is None:
                self._missing.append(name)
                return
            width, height = image_size(image)
            sidecars = self._masks.find(name), self._depths.find(name)
            camera = Camera(
                name, lens.width, lens.height, *lens.pinhole, pose.world_to_camera, image, *sidecars,
                turns=quarter_turns(image),
            )  # fmt: skip
            if (width, height) != (lens.width, lens.height):
                camera = camera.resized(width, height)
            if flaw := camera.flaw:
                raise LodgsError(f"{flaw}.")
        except SystemProblem:
            raise
        except LodgsError as error:
            self.excluded.append((name, error.what))
            return
        self.cameras.append(camera)
        if lens.distorted:
            self.distorted.append(name)
        stretch = np.log(width) + np.log(lens.height) - np.log(height) - np.log(lens.width)
        if abs(stretch) > 0.01 + 1 / min(width, height):  # more than rounding to whole pixels explains
            self._reshaped.append(
                f"{quote_name(name)} is {width}x{height}, but its camera in the model is "
                f"{lens.width}x{lens.height}: check that the photo is neither rotated nor cropped."
            )

    def drop_outliers(self, inliers: np.ndarray) -> None:
        """Drop the cameras outside the mask ``inliers`` (V,)."""
        outliers = [camera.name for camera, inlier in zip(self.cameras, inliers, strict=True) if not inlier]
        self.excluded += [
            (name, f"its position exceeds {OUTLIER_FACTOR:,} times the median distance from the cameras.")
            for name in outliers
        ]
        self.cameras = [camera for camera in self.cameras if camera.name not in outliers]
        self.distorted = [name for name in self.distorted if name not in outliers]

    def warnings(self, folder: Path) -> list[str]:
        """Return a limited number of warnings, whatever the number of views."""
        messages = exclusion_messages(self.excluded)
        match self._missing:
            case []:
                pass
            case [name]:
                messages.append(f"Skipped {quote_name(name)}: {folder} has no such file.")
            case names:
                more = ", ..." if len(names) > MAX_NAMED else ""
                messages.append(
                    f"Skipped {len(names):,} views without a file in {folder}: "
                    f"{', '.join(map(quote_name, names[:MAX_NAMED]))}{more}."
                )
        if renamed := self._files.renamed:
            name, file = next(iter(renamed.items()))
            messages.append(
                f"Matched {len(renamed):,} photos with another suffix or case, such as {file.name} for "
                f"{quote_name(name)}."
            )
        for attribute, sidecars in ("mask", self._masks), ("depth", self._depths):
            if all(getattr(camera, attribute) is None for camera in self.cameras):
                messages += filter(None, [sidecars.mismatch_warning(quote_name(self.cameras[0].name))])
        messages += self._reshaped[:MAX_NAMED]
        if len(self._reshaped) > MAX_NAMED:
            messages.append(f"{len(self._reshaped) - MAX_NAMED:,} more photos have another aspect ratio.")
        return messages


def exclusion_messages(excluded: Sequence[tuple[str, str]]) -> list[str]:
    """Return sentences for (name, reason) pairs; pairs after the first MAX_NAMED are summarised."""
    messages = [f"Skipped {quote_name(name)}: {reason}" for name, reason in excluded[:MAX_NAMED]]
    if len(excluded) > MAX_NAMED:
        messages.append(f"Skipped {len(excluded) - MAX_NAMED:,} more views for similar reasons.")
    return messages


def quote_name(name: str) -> str:
    """Return a view's name in printable form, with at most 200 characters."""
    return printable(name if len(name) <= 200 else f"{name[:200]}...")


def find_outliers(points: np.ndarray, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return a mask (P,) of outlier points and a mask (V,) of inlier cameras."""
    positions = np.array([camera.center for camera in cameras])
    middle = np.median(positions, axis=0)
    point_distances = np.linalg.norm(points - middle, axis=1)
    camera_distances = np.linalg.norm(positions - middle, axis=1)
    scale = max(np.median(camera_distances), np.median(point_distances) if len(point_distances) else 0.0)
    if scale == 0:
        return np.zeros(len(points), bool), np.ones(len(cameras), bool)
    return point_distances > OUTLIER_FACTOR * scale, camera_distances <= OUTLIER_FACTOR * scale
