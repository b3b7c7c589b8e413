"""Selection of the usable views of a COLMAP model, with warnings about the other views. numpy only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from ..errors import LodgsError, SystemProblem, printable
from .cameras import Camera
from .colmap_model import Pose
from .image_files import ImageFiles, SidecarFiles
from .image_headers import exif_orientation, image_size, quarter_turns
from .images import same_proportions
from .lenses import Intrinsics

OUTLIER_FACTOR = 1000
"""Points and cameras farther from the camera centre than this multiple of the median distance are dropped."""
MAX_NAMED = 5
"""Maximum number of views named by warnings of one kind; the remaining ones are counted."""
MAX_STRETCH = 0.02
"""Maximum difference in proportions of a photo and its camera; the camera is scaled along each axis."""
STORE_UPRIGHT = "store its pixels upright (exiftran -a, or mogrify -auto-orient)"
"""Remedy for photos that EXIF data turns or mirrors."""
_TURNS = {3: 2, 6: 1, 8: 3}
"""Clockwise quarter turns by EXIF orientation, without mirrored ones."""
_MIRRORED = 2, 4, 5, 7
_SIDEWAYS = 5
"""First EXIF orientation that exchanges width and height."""


class ViewCollector:
    """Collector of the usable views of a model, and of the reasons for skipping the other views.

    Attributes:
        excluded: (name, sentence) for each skipped view.
    """

    def __init__(self, files: ImageFiles, masks: SidecarFiles, depths: SidecarFiles) -> None:
        self._files = files
        self._masks = masks
        self._depths = depths
        self._missing: list[str] = []
        self.cameras: list[Camera] = []
        self.distorted: list[str] = []
        self.excluded: list[tuple[str, str]] = []

    def add_all(
        self, poses: Sequence[Pose], lenses: Mapping[int, Intrinsics], progress: Callable[[float], object]
    ) -> None:
        """Add views, with the lenses by id; report the fraction of added views now and then."""
        upright = fits_upright_photos(self._photos(poses, lenses)) is True
        for number, pose in enumerate(poses):
            if number % 50 == 0:
                progress(number / len(poses))
            self._add(pose, lenses[pose.camera_id], upright)

    def _photos(
        self, poses: Sequence[Pose], lenses: Mapping[int, Intrinsics]
    ) -> Iterator[tuple[Path, int, int]]:
        for pose in poses:
            with suppress(LodgsError):  # reported for its view
                if (path := self._files.find(pose.name)) is not None:
                    lens = lenses[pose.camera_id]
                    yield path, lens.width, lens.height

    def _add(self, pose: Pose, lens: Intrinsics, upright: bool) -> None:
        """Add a view at the size of its photo, or record the reason for skipping it."""
        name = pose.name.replace("\\", "/")
        try:
            if not np.isfinite(pose.world_to_camera).all():
                raise LodgsError("it has no valid pose.")
            if not lens.lens.focals:
                raise LodgsError(f"{lens.lens.name} is a panorama: cut it into perspective views.")
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
            if turns := photo_turns(image, width, height, lens.width, lens.height, upright):
                if lens.distorted:
                    raise LodgsError(f"only its EXIF data turns it: {STORE_UPRIGHT}.")
                camera = camera.turned(turns)
            if (width, height) != (camera.width, camera.height):
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

    def require_cameras(self, model: Path, images: Path) -> None:
        """Raise LodgsError unless a view is usable."""
        if self.cameras:
            return
        count = len(self.excluded) + len(self._missing)
        raise LodgsError(
            f"Cannot read scene: none of the {count} views of {model} has a usable photo in {images}."
            + "".join(f" {quote_name(name)}: {reason}" for name, reason in self.excluded[:1]),
            "Choose the folder that holds the images under the names used by the model."
            if self._missing
            else "Correct the model or its photos.",
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
                more = f" and {len(names) - MAX_NAMED:,} more" if len(names) > MAX_NAMED else ""
                messages.append(
                    f"Skipped {len(names):,} views without a file in {folder}: "
                    f"{', '.join(map(quote_name, names[:MAX_NAMED]))}{more}."
                )
        if renamed := self._files.renamed:
            name, file = next(iter(renamed.items()))
            place = file.relative_to(folder).as_posix()
            messages.append(
                f"Matched {len(renamed):,} photos with another folder, suffix or case, such as "
                f"{quote_name(place)} for {quote_name(name)}."
            )
        for attribute, sidecars in ("mask", self._masks), ("depth", self._depths):
            if all(getattr(camera, attribute) is None for camera in self.cameras):
                messages += filter(None, [sidecars.mismatch_warning(quote_name(self.cameras[0].name))])
        return messages


def fits_upright_photos(photos: Iterable[tuple[Path, int, int]]) -> bool | None:
    """Return True if cameras belong to photos turned by their EXIF orientation, False if to stored ones.

    Photos that a quarter turn makes upright tell it by their sizes. Without any, the result is None.

    Args:
        photos: (path, width, height) with the size of the lens.
    """
    evidence = set()
    for path, lens_width, lens_height in photos:
        if exif_orientation(path) >= _SIDEWAYS and min(lens_width, lens_height) > 0:
            with suppress(LodgsError):
                width, height = image_size(path)
                stored = same_proportions(width, height, lens_width, lens_height, MAX_STRETCH)
                turned = same_proportions(height, width, lens_width, lens_height, MAX_STRETCH)
                evidence |= {turned} if stored != turned else set()
    return evidence.pop() if len(evidence) == 1 else None


def photo_turns(
    path: Path, width: int, height: int, lens_width: int, lens_height: int, upright: bool = False
) -> int:
    """Return the clockwise quarter turns that make a photo fit a lens of another size: 0 to 3.

    Sizes fit if their proportions differ by less than MAX_STRETCH. The turn of a photo comes from its EXIF
    data.

    Args:
        width, height: size of the photo as stored.
        upright: True if the lens belongs to the upright photo, see :func:`fits_upright_photos`. Otherwise a
            photo is turned only if its size requires it.

    Raises:
        LodgsError: if no turn makes them fit, or EXIF data mirrors the photo. ``what`` continues a sentence
            such as "Skipped <name>:".
    """
    fits = same_proportions(width, height, lens_width, lens_height, MAX_STRETCH)
    if fits and not upright:
        return 0
    turned = same_proportions(height, width, lens_width, lens_height, MAX_STRETCH)
    orientation = exif_orientation(path)
    if turned if orientation >= _SIDEWAYS else fits:
        if orientation in _MIRRORED:
            raise LodgsError(f"only its EXIF data mirrors it: {STORE_UPRIGHT}.")
        return _TURNS.get(orientation, 0)
    reason = f"its size {width}x{height} does not match its camera's {lens_width}x{lens_height}"
    raise LodgsError(f"{reason}: the photo was {'rotated' if turned else 'cropped'}.")


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
