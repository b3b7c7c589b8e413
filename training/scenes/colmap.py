"""COLMAP scenes: a model and its photos. numpy only, so that Blender can read scenes."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import LodgsError, missing_clause, printable
from ..files import check_folder, is_file
from ..splats.georeference import Georeference, read_georeference
from ..splats.origin import NO_ORIGIN, choose_origin
from . import point_cloud
from .cameras import MAX_COORDINATE, Camera, camera_extent, pick_evenly
from .colmap_model import (
    DAMAGED_REMEDY,
    Pose,
    count_images,
    model_suffix,
    read_cameras,
    read_points,
    read_poses,
)
from .image_files import (
    MASK_SUFFIXES,
    MAX_FOLDERS,
    ImageFiles,
    SidecarFiles,
    find_image_folder,
    find_moved_images,
)
from .lenses import Intrinsics, make_intrinsics
from .orientation import up_rotation
from .view_selection import OUTLIER_FACTOR, ViewCollector, exclusion_messages, find_outliers, quote_name

MASKS, DEPTHS = "masks", "depths"
"""Folders next to the image folder, or in the scene folder if the photos are there."""
DEPTH_SUFFIXES = ".exr", ".png", ".npy"
"""File name suffixes of depth maps."""
MAX_DEPTH_CAMERAS = 500
"""Maximum number of cameras used to compute the median depth."""
NO_POINTS = "The scene has no points"
"""First words of the warning about a scene without points."""

Progress = Callable[[float], object]
"""Callback that receives the completed fraction, from 0 to 1."""


@dataclass(frozen=True)
class Scene:
    """A COLMAP model with its photos, relative to a local origin (``splats.origin``).

    Attributes:
        folder: folder of the scene.
        model: folder of the model.
        images_folder: folder of the photos.
        cameras: views with a usable photo, sorted by name; their size is the photo's size.
        points: (P, 3) float32, possibly empty.
        point_colors: (P, 3) uint8.
        distorted: names of views with lens distortion; their cameras are the pinhole part of the lens.
        warnings: one sentence per skipped or suspicious item.
        point_ids: (P,) int64 ids of the model; empty if the points come from another source.
        names: names of all views of the model, sorted, with or without a photo. Default: the cameras' names.
        point_model: folder of the model that records the points' observations. Default: ``model``.
        origin: (3,) float64 position of the scene's (0, 0, 0) in COLMAP's world; zeros if that is precise.
        georeference: place of COLMAP's world on Earth, or None.
    """

    folder: Path
    model: Path
    images_folder: Path
    cameras: list[Camera]
    points: np.ndarray
    point_colors: np.ndarray
    distorted: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    point_ids: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    names: Sequence[str] = ()
    point_model: Path | None = None
    origin: np.ndarray = field(default_factory=lambda: NO_ORIGIN)
    georeference: Georeference | None = None

    def split(self, test_every: int, validation: bool = False) -> tuple[list[Camera], list[Camera]]:
        """Split the cameras into training cameras and held-out cameras.

        The first of every ``test_every`` views by name is held out. Views without a photo are counted too, so
        that a lost photo does not change the role of the other views.

        Args:
            test_every: distance between held-out views; 0 holds out none.
            validation: exclude the test views, and hold out the middle view between two test views instead.
        """
        if test_every <= 0:
            return list(self.cameras), []
        middle = test_every // 2 if validation else 0
        names = self.names or [camera.name for camera in self.cameras]
        phase = {name: number % test_every for number, name in enumerate(names)}
        train = [camera for camera in self.cameras if phase[camera.name] not in (0, middle)]
        return train, [camera for camera in self.cameras if phase[camera.name] == middle]

    def select_points(self, index: np.ndarray) -> Scene:
        """Return the scene with only some of its points, given by a mask (P,) or indices."""
        ids = self.point_ids
        return replace(
            self, points=self.points[index], point_colors=self.point_colors[index],
            point_ids=ids[index] if len(ids) else ids,
        )  # fmt: skip

    @property
    def center(self) -> np.ndarray:
        """Mean camera position, (3,) float64."""
        return np.array([camera.center for camera in self.cameras]).mean(axis=0)

    def up_rotation(self) -> np.ndarray:
        """Return the rotation (3, 3) float64 to a z-up world, see ``orientation.up_rotation``."""
        return up_rotation(self.cameras)

    def extent(self, default: float | None = None) -> float:
        """Return 1.1 x the largest distance of a camera from the mean camera position, as 3DGS does.

        The unit is COLMAP's. If all cameras share one position, return the median depth.

        Args:
            default: value if there is no median depth either; None raises an error.

        Raises:
            LodgsError: see :meth:`median_depth`.
        """
        return camera_extent(self.cameras) or self.median_depth(default)

    def median_depth(self, default: float | None = None) -> float:
        """Return the median over the cameras of the median depth of their visible points, in COLMAP units.

        A point is visible if it lies in front of the camera and inside its image. At most 50,000 evenly
        spaced points and MAX_DEPTH_CAMERAS cameras are used.

        Args:
            default: value if no camera sees a point; None raises an error.

        Raises:
            LodgsError: no camera sees a point.
        """
        if np.isfinite(self._median_depth):
            return self._median_depth
        if default is None:
            raise LodgsError(
                f"Cannot determine the scale of {self.model}: no camera sees a point.",
                "Reconstruct the scene with points.",
            )
        return default

    @cached_property
    def _median_depth(self) -> float:
        """NaN if no camera sees a point."""
        points = self.points[:: max(1, len(self.points) // 50_000)].astype(np.float64)
        medians = []
        for camera in pick_evenly(self.cameras, MAX_DEPTH_CAMERAS):
            depths = camera.view_space(points)[camera.sees(points), 2]
            if len(depths):
                medians.append(np.median(depths))
        return float(np.median(medians)) if medians else float("nan")

    def near(self, default: float | None = None) -> float:
        """Return the near depth for rendering, in COLMAP units: a hundredth of the median depth.

        Args:
            default: value if no camera sees a point; None raises an error.

        Raises:
            LodgsError: see :meth:`median_depth`.
        """
        if default is not None and not np.isfinite(self._median_depth):
            return default
        return 0.01 * self.median_depth()


def find_models(folder: Path) -> list[Path]:
    """Return the folders at or below ``folder`` that hold a COLMAP model (cameras and images, .bin or .txt).

    The model with the most registered images comes first, then the one closest to ``folder``, then by name.
    The search follows links and goes four levels deep, which covers ``sparse/``, ``sparse/0`` and
    ``dense/0/sparse``. It visits at most MAX_FOLDERS folders, upper levels first.

    Raises:
        LodgsError: the folder does not exist.
    """
    folder = _absolute(folder)
    check_folder(folder, "Choose the folder of a COLMAP scene.")
    models = []
    level = [folder]
    real_folder = os.path.realpath(folder)
    visited = {real_folder}
    visited.update(str(parent) for parent in Path(real_folder).parents)  # links upwards leave the scene
    for depth in range(5):
        models += [(-count_images(path), depth, path.parts, path) for path in level if model_suffix(path)]
        next_level = []
        for parent in level if depth < 4 else ():
            for path in subfolders(parent):
                real = os.path.realpath(path)
                if real not in visited and len(visited) < MAX_FOLDERS:
                    visited.add(real)
                    next_level.append(path)
        level = next_level
    return [entry[-1] for entry in sorted(models)]


def subfolders(folder: Path) -> list[Path]:
    """Return the readable, visible subfolders sorted by name."""
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir()]
    except OSError:
        return []
    return [folder / name for name in sorted(names)]


def read_scene(
    folder: Path,
    model: Path | None = None,
    images: Path | None = None,
    progress: Progress | None = None,
    origin: np.ndarray | None = None,
) -> Scene:
    """Read the cameras and points of a COLMAP scene and locate its photos.

    Views with an unusable photo or camera, points without a finite position and outliers (see
    OUTLIER_FACTOR) are skipped with a warning.

    Args:
        folder: the scene, or a model folder inside it.
        model: folder of the model. Default: the largest model in the scene.
        images: folder of the photos. Default: ``images/``, or another folder in or next to the scene that
            contains the model's image names.
        progress: called now and then.
        origin: (3,) local origin. Default: ``splats.origin.choose_origin`` for the cameras of the model.

    Raises:
        LodgsError: there is no folder, model or photo, or a model file is damaged.
    """
    folder = _absolute(folder)
    warnings: list[str] = []
    if model is None:
        model, images = _choose_model(folder, images, warnings)
    model = _absolute(model)
    intrinsics, poses = read_registered(model, warnings)
    if images is None:
        images = _find_images(folder, model, [pose.name for pose in poses], warnings)
    images = _absolute(images)
    views = _view_collector(folder, images, [pose.name for pose in poses])
    views.add_all(poses, intrinsics, lambda share: progress and progress(0.5 * share))
    views.require_cameras(model, images)
    points, colors, ids = _read_model_points(folder, model, views.cameras, warnings)
    if origin is None:
        centers = np.array([pose.center for pose in poses])
        origin = choose_origin(centers[np.isfinite(centers).all(axis=1)], points)
    views.cameras = [camera.moved(-origin) for camera in views.cameras]
    with np.errstate(over="ignore"):  # infinite positions are dropped
        points = (points - origin).astype(np.float32)
    has_inliers, inliers = _inliers(model, points, views.cameras, warnings)
    views.drop_outliers(inliers)
    if progress:
        progress(1.0)
    return Scene(
        folder=folder,
        model=model,
        images_folder=images,
        cameras=views.cameras,
        points=points[has_inliers],
        point_colors=colors[has_inliers],
        point_ids=ids[has_inliers] if len(ids) else ids,
        origin=origin,
        georeference=read_georeference(folder, warnings.append),
        names=list(dict.fromkeys(pose.name.replace("\\", "/") for pose in poses)),
        distorted=views.distorted,
        warnings=[*warnings, *views.warnings(images)],
    )


def _view_collector(folder: Path, images: Path, names: Sequence[str]) -> ViewCollector:
    """Return an empty collector for the named photos, masks and depth maps of a scene."""
    if not images.is_dir():
        what = f"Cannot read scene: image folder {images} {missing_clause(images)}."
        raise LodgsError(what, "Choose the folder of the photos.")
    base = folder if images == folder else images.parent
    masks = _mask_folder(base)
    return ViewCollector(
        ImageFiles(images, names),
        SidecarFiles(masks or images, "mask", *MASK_SUFFIXES, beside=masks is None),
        SidecarFiles(base / DEPTHS, "depth", *DEPTH_SUFFIXES),
    )


def _mask_folder(base: Path) -> Path | None:
    """Return the folder "masks", or the first of other spellings that exists, or None.

    Without such a folder, masks may be beside the photos, as for RealityScan.
    """
    spellings = (base / name for name in (MASKS, "Masks", "MASKS", "mask", "Mask", "MASK"))
    return next((folder for folder in spellings if folder.is_dir()), None)


def _read_model_points(
    folder: Path, model: Path, cameras: Sequence[Camera], warnings: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions (P, 3) float64, possibly not finite, colours and ids of the points of a model."""
    points, colors, ids = read_points(model)
    cloud = point_cloud.find_cloud(folder, model, has_points=len(points) > 0)
    if cloud is not None:
        points, colors = point_cloud.read_points(cloud)
        ids = np.zeros(0, np.int64)
        warnings.append(f"{len(points):,} points were read from {cloud} instead of {model}.")
    if not len(points):
        warnings.append(
            f"{NO_POINTS}: {model} has no points3D{model_suffix(model)} with points. Training creates them "
            f"from the {'photos' if any(camera.depth is None for camera in cameras) else 'depth maps'}."
        )
    return points, colors, ids


def _inliers(
    model: Path, points: np.ndarray, cameras: Sequence[Camera], warnings: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Return masks of the points (P,) and of the cameras (V,) that are no outliers."""
    valid = (np.abs(points) <= MAX_COORDINATE).all(axis=1)
    outliers, inlier_cameras = find_outliers(points[valid], cameras)
    valid[valid] = ~outliers
    if not valid.all():
        warnings.append(
            f"Skipped {np.sum(~valid):,} points of {model}: their position is not finite, or more than "
            f"{OUTLIER_FACTOR:,} times the median distance from the cameras."
        )
    return valid, inlier_cameras


def read_registered(model: Path, warnings: list[str]) -> tuple[dict[int, Intrinsics], list[Pose]]:
    """Return the lenses by id and the poses sorted by name.

    Raises:
        LodgsError: a file is missing or damaged, or there is no pose.
    """
    suffix = model_suffix(model)
    if not suffix:
        raise LodgsError(
            f"Cannot read COLMAP model: {model} has no cameras and images files.",
            "Choose the folder of a COLMAP model.",
        )
    poses = sorted(read_poses(model), key=lambda pose: pose.name)
    intrinsics = read_cameras(model, {pose.camera_id for pose in poses}, warnings.append)
    if not poses:
        raise LodgsError(
            f"Cannot read COLMAP model: {model} has no registered images.",
            "Choose a model with registered images.",
        )
    for pose in poses:
        if pose.camera_id not in intrinsics:
            raise LodgsError(
                f"Cannot read COLMAP model: {model / f'cameras{suffix}'} lacks camera {pose.camera_id} "
                f"of image {quote_name(pose.name)}.",
                DAMAGED_REMEDY,
            )
    return intrinsics, poses


def exclude_views(scene: Scene, reasons: dict[str, str]) -> Scene:
    """Return the scene without some of its views, with a warning for each.

    Args:
        reasons: a sentence by view name, which follows "Skipped <name>:".

    Raises:
        LodgsError: no view remains.
    """
    if not reasons:
        return scene
    remaining = [camera for camera in scene.cameras if camera.name not in reasons]
    if not remaining:
        name, reason = next(iter(reasons.items()))
        raise LodgsError(
            f"Cannot use any view of {scene.folder}. {quote_name(name)}: {reason}", "Check the photos."
        )
    return replace(
        scene,
        cameras=remaining,
        distorted=[name for name in scene.distorted if name not in reasons],
        warnings=[*scene.warnings, *exclusion_messages(list(reasons.items()))],
    )


def scene_lenses(scene: Scene) -> list[Intrinsics]:
    """Return the lens of each camera, with its distortion, at the size of its photo."""
    lenses, poses = read_registered(scene.model, [])
    lens_of = {pose.name.replace("\\", "/"): lenses[pose.camera_id] for pose in poses}
    distorted = set(scene.distorted)
    return [
        lens_of[camera.name].resized(camera.width, camera.height)
        if camera.name in distorted
        else make_intrinsics(  # the camera may be turned as its photo
            "PINHOLE", camera.width, camera.height, np.array([camera.fx, camera.fy, camera.cx, camera.cy])
        )
        for camera in scene.cameras
    ]


def _absolute(path: Path | str) -> Path:
    """Return an absolute path that is valid in other processes; links are kept.

    Raises:
        LodgsError: the path is not UTF-8, because jobs and Blender cannot store it.
    """
    path = Path(os.path.abspath(path))
    if printable(path) != str(path):
        raise LodgsError(f"Cannot use path {printable(path)}: it is not UTF-8.", "Rename its folders.")
    return path


def _choose_model(folder: Path, images: Path | None, warnings: list[str]) -> tuple[Path, Path | None]:
    """Return the first result of :func:`find_models` that has photos, and their folder; warn about others."""
    models = find_models(folder)
    if not models:
        require_complete_model(folder)
        raise LodgsError(
            f"Cannot read scene: {folder} holds no COLMAP model.",
            "Choose a folder with sparse/0/cameras.bin, images.bin and points3D.bin (or .txt), or convert "
            "another program's export (lodgs scene --from DIR --out DIR), or find the cameras of photos "
            "(lodgs scene --photos DIR --out DIR).",
        )
    counts = [count_images(model) for model in models]
    for model, count in zip(models, counts, strict=True):
        if count < counts[0]:
            warnings.append(f"Skipped {model}: a smaller model of {count} views.")
        elif model != models[0] and (lost := _names(model) - _names(models[0])):
            warnings.append(f"Skipped {model}: another model, with {len(lost)} views that {models[0]} lacks.")
    for model in models if images is None else ():
        photo_folder, photos = find_image_folder(folder, model, [pose.name for pose in read_poses(model)])
        if photos:
            if model != models[0]:
                warnings.append(f"Used {model}: the photos of {models[0]} are missing.")
            return model, photo_folder
    return models[0], images


def _names(model: Path) -> set[str]:
    return {pose.name for pose in read_poses(model)}


def _find_images(folder: Path, model: Path, names: Sequence[str], warnings: list[str]) -> Path:
    """Return the usual image folder of a model, or any other folder of the scene that has its photos."""
    images, photos = find_image_folder(folder, model, names)
    if photos:
        return images
    is_model = "sparse" in (folder.name, folder.parent.name)
    scene = folder.parents[0 if folder.name == "sparse" else 1] if is_model else folder
    if (moved := find_moved_images(scene, names)) is not None:
        warnings.append(f"Found the photos in {moved}.")
    return moved or images


def require_complete_model(folder: Path) -> None:
    """Raise an error that names the missing file, if a folder has a part of a COLMAP model."""
    for root in (folder, folder / "sparse", folder / "sparse" / "0"):
        for suffix in (".bin", ".txt"):
            present = {name for name in ("cameras", "images") if is_file(root / f"{name}{suffix}")}
            if len(present) == 1:
                missing = ({"cameras", "images"} - present).pop()
                raise LodgsError(
                    f"Cannot read scene: {root / f'{missing}{suffix}'} is missing.",
                    f"Copy it next to {present.pop()}{suffix}, or export the model again.",
                )
