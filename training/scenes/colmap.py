"""COLMAP scenes: a model and its photographs. numpy only, so that Blender can read scenes."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from ..errors import LodgsError, printable
from ..files import check_folder
from .cameras import MAX_COORDINATE, Camera, camera_extent, pick_evenly
from .colmap_model import (
    DAMAGED_REMEDY,
    Intrinsics,
    Pose,
    count_images,
    model_suffix,
    read_cameras,
    read_observations,
    read_points,
    read_poses,
)
from .image_files import ImageFiles, SidecarFiles, find_image_folder
from .images import image_size, quarter_turns
from .orientation import up_rotation

OUTLIER_FACTOR = 1000
"""What lies so many times as far from the middle of the cameras as most cameras or points is an error."""
MASKS, DEPTHS = "masks", "depths"
"""Folders beside that of the photographs, or in the scene's where they are that."""
DEPTH_SUFFIXES = ".exr", ".png", ".npy"
"""How names of depth maps end."""
MAX_DEPTH_CAMERAS = 500
"""Cameras, evenly chosen, that tell the median depth."""
MAX_NAMED = 5
"""Of so many views that are odd in one way each is named; more are summed up."""
MAX_FOLDERS = 20_000
"""Folders that models are looked for in."""

Progress = Callable[[float], object]
"""Called with the share of a scene that is read, from 0 to 1."""


@dataclass(frozen=True)
class Scene:
    """A COLMAP model with its photographs, in COLMAP's world.

    Attributes:
        folder, model, images_folder: where it was read.
        cameras: the views whose photograph can be used, sorted by name; their size is the photograph's.
        points: (P, 3) float32, possibly none.
        point_colors: (P, 3) uint8.
        distorted: names of views whose lens distorts; their cameras are the pinhole part of the lens.
        warnings: one sentence for each thing that was left out or is odd.
        point_ids: (P,) int64, the model's own; none where the points come from elsewhere.
        names: of all views of the model, sorted, with and without a photograph; by default the cameras'.
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

    def split(self, test_every: int, validation: bool = False) -> tuple[list[Camera], list[Camera]]:
        """Training and held-out cameras: of every `test_every` by name the first is held out; 0: none is.

        Views without a photograph are counted: where one gets lost, the others stay what they were.

        Args:
            validation: leave those out altogether, and hold out the one in the middle between two of them.
        """
        if test_every <= 0:
            return list(self.cameras), []
        middle = test_every // 2 if validation else 0
        names = self.names or [camera.name for camera in self.cameras]
        rest = {name: number % test_every for number, name in enumerate(names)}
        train = [camera for camera in self.cameras if rest[camera.name] not in (0, middle)]
        return train, [camera for camera in self.cameras if rest[camera.name] == middle]

    @property
    def center(self) -> np.ndarray:
        """The mean of the cameras' eyes, (3,) float64."""
        return np.array([camera.center for camera in self.cameras]).mean(axis=0)

    def up_rotation(self) -> np.ndarray:
        """Rotation from this world to a z-up world, (3, 3) float64, see ``orientation.up_rotation``."""
        return up_rotation(self.cameras)

    def extent(self, default: float | None = None) -> float:
        """Return 1.1 x the largest distance of a camera from the mean camera position, in COLMAP units.

        3DGS defines it so. If all cameras have the same position, return the median depth.

        Args:
            default: value if there is no median depth either; None: raise an error.

        Raises:
            LodgsError: as :meth:`median_depth`.
        """
        return camera_extent(self.cameras) or self.median_depth(default)

    def median_depth(self, default: float | None = None) -> float:
        """Return the median over the cameras of the median depth of their visible points, in COLMAP units.

        A camera sees the points in front of it and inside its image. Uses at most 50,000 points, evenly
        spaced in the model's order, and at most MAX_DEPTH_CAMERAS cameras.

        Args:
            default: value if no camera sees a point; None: raise an error.

        Raises:
            LodgsError: no camera sees a point.
        """
        if np.isfinite(self._median_depth):
            return self._median_depth
        if default is None:
            raise LodgsError(f"No camera of {self.model} sees a point.", "Reconstruct the scene with points.")
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
        """Return the depth where rendering begins, in COLMAP units: a hundredth of the median depth.

        Args:
            default: value if no camera sees a point; None: raise an error.

        Raises:
            LodgsError: as :meth:`median_depth`.
        """
        if default is not None and not np.isfinite(self._median_depth):
            return default
        return 0.01 * self.median_depth()


def find_models(folder: Path) -> list[Path]:
    """Folders at or below `folder` that hold a COLMAP model (cameras and images, .bin or .txt).

    The model with the most registered images comes first; among equals the one nearest to `folder`, then by
    name. Looks four levels deep, which covers `sparse/`, `sparse/0` and `dense/0/sparse`, through links too,
    and in MOST_FOLDERS at most, the nearest first.

    Raises:
        LodgsError: there is no such folder.
    """
    folder = _absolute(folder)
    check_folder(folder, "Choose the folder of a COLMAP scene.")
    found, level, seen = [], [folder], {os.path.realpath(folder)}
    around = [str(parent) for parent in Path(os.path.realpath(folder)).parents]
    seen.update(around)  # a link upwards leads out of the scene
    for depth in range(5):
        found += [(-count_images(here), depth, here.parts, here) for here in level if model_suffix(here)]
        below = []
        for here in level if depth < 4 else ():
            for path in _subfolders(here):
                real = os.path.realpath(path)
                if real not in seen and len(seen) < MAX_FOLDERS:
                    seen.add(real)
                    below.append(path)
        level = below
    return [entry[-1] for entry in sorted(found)]


def _subfolders(folder: Path) -> list[Path]:
    """By name, without hidden ones and those that may not be read."""
    try:
        with os.scandir(folder) as entries:
            names = [entry.name for entry in entries if not entry.name.startswith(".") and entry.is_dir()]
    except OSError:
        return []
    return [folder / name for name in sorted(names)]


def read_scene(
    folder: Path, model: Path | None = None, images: Path | None = None, progress: Progress | None = None
) -> Scene:
    """Read a COLMAP scene: cameras, points, and which photographs are there.

    A view whose photograph cannot be used, or that cannot be, is left out with a warning, as is a point
    without a place or astray (see ASTRAY).

    Args:
        folder: the scene, or a model folder within it.
        model: the folder of the model; by default the largest one found.
        images: the folder of the photographs; by default `images/`, or another folder in or beside the scene
            where the model's names are found.
        progress: called now and then.

    Raises:
        LodgsError: there is no folder, model or photograph, or a file of the model is damaged.
    """
    folder = _absolute(folder)
    warnings: list[str] = []
    model = _largest_model(folder, warnings) if model is None else _absolute(model)
    if not model_suffix(model):
        raise LodgsError(
            f"{model} holds no cameras and images files.", "Choose the folder of a COLMAP model."
        )
    intrinsics = read_cameras(model)
    poses = sorted(read_poses(model), key=lambda pose: pose.name)
    if not poses:
        raise LodgsError(f"{model} has no registered images.", "Choose a model that COLMAP has registered.")
    for pose in poses:
        if pose.camera_id not in intrinsics:
            raise LodgsError(
                f"{model / f'cameras{model_suffix(model)}'} lacks camera {pose.camera_id}, "
                f"which {_shown(pose.name)} uses.",
                DAMAGED_REMEDY,
            )
    if images is None:
        images = find_image_folder(folder, model, [pose.name for pose in poses])
    images = _absolute(images)
    if not images.is_dir():
        raise LodgsError(f"There is no image folder {images}.", "Choose the folder of the photographs.")
    beside = folder if images == folder else images.parent
    views = _Views(
        ImageFiles(images, folder),
        SidecarFiles(beside / MASKS, ".png"),
        SidecarFiles(beside / DEPTHS, *DEPTH_SUFFIXES),
    )
    for number, pose in enumerate(poses):
        if progress and number % 50 == 0:
            progress(0.5 * number / len(poses))
        views.add(pose, intrinsics[pose.camera_id])
    if not views.cameras:
        raise LodgsError(
            f"None of the {len(poses)} views in {model} has a usable photograph in {images}."
            + "".join(f" {_shown(name)}: {why}" for name, why in views.left_out[:1]),
            "Choose the folder that holds the images under the names that the model uses.",
        )

    points, colors, ids = read_points(model)
    if not len(points):
        warnings.append(f"{model} has no points in points3D{model_suffix(model)}: the scene has no points.")
    possible = (np.abs(points) <= MAX_COORDINATE).all(axis=1)
    far, cameras = _astray(points[possible], views.cameras)
    possible[possible] = ~far
    if not possible.all():
        warnings.append(
            f"{np.sum(~possible):,} points of {model} have no place, or lie over {OUTLIER_FACTOR:,} times as far "
            "off as most, and are left out."
        )
    views.keep(cameras)
    if progress:
        progress(1.0)
    return Scene(
        folder=folder,
        model=model,
        images_folder=images,
        cameras=views.cameras,
        points=points[possible],
        point_colors=colors[possible],
        point_ids=ids[possible],
        names=list(dict.fromkeys(pose.name.replace("\\", "/") for pose in poses)),
        distorted=views.distorted,
        warnings=[*warnings, *views.warnings(images)],
    )


def exclude_views(scene: Scene, reasons: dict[str, str]) -> Scene:
    """The scene without some of its views, and a warning of them.

    Args:
        reasons: by the view's name, a sentence that follows "it is left out:".

    Raises:
        LodgsError: no view is left.
    """
    if not reasons:
        return scene
    kept = [camera for camera in scene.cameras if camera.name not in reasons]
    if not kept:
        name, why = next(iter(reasons.items()))
        raise LodgsError(
            f"No view of {scene.folder} can be used. {_shown(name)}: {why}", "Check the photographs."
        )
    return replace(
        scene,
        cameras=kept,
        distorted=[name for name in scene.distorted if name not in reasons],
        warnings=[*scene.warnings, *exclusion_messages(list(reasons.items()))],
    )


def observations(scene: Scene, names: Collection[str]) -> dict[str, np.ndarray]:
    """Which of the scene's points some of its views observe, rows (O,) by the views' names; empty where the
    model does not tell."""
    if not len(scene.point_ids):
        return {}
    order = np.argsort(scene.point_ids)
    ordered, found = scene.point_ids[order], {}
    for name, ids in read_observations(scene.model, names).items():
        places = np.searchsorted(ordered, ids).clip(max=len(order) - 1)
        found[name] = order[places[ordered[places] == ids]]
    return found if any(map(len, found.values())) else {}


def observed_points(scene: Scene, names: Collection[str]) -> np.ndarray:
    """Which of the scene's points some of its views, by name, observe, (P,).

    Where the model does not tell, as of points that come from elsewhere, those count that a view could see.
    """
    seen = np.zeros(len(scene.points), bool)
    for rows in observations(scene, names).values():
        seen[rows] = True
    if not seen.any():
        for camera in scene.cameras:
            if camera.name in names:
                seen |= camera.sees(scene.points)
    return seen


def _absolute(path: Path | str) -> Path:
    """Whole, so that it means the same in another process; links are kept as they are.

    Raises:
        LodgsError: it is no text, so that neither jobs nor Blender could name it.
    """
    path = Path(os.path.abspath(path))
    if printable(path) != str(path):
        raise LodgsError(f"The path {printable(path)} is not UTF-8.", "Give its folders other names.")
    return path


def _largest_model(folder: Path, warnings: list[str]) -> Path:
    """The first of `find_models`; models that hold fewer views are warned of."""
    models = find_models(folder)
    if not models:
        raise LodgsError(
            f"{folder} holds no COLMAP model.",
            "Choose a folder with sparse/0/cameras.bin, images.bin and points3D.bin (or .txt), or make one "
            "of another program's export: lodgs scene --from DIR --out DIR.",
        )
    views = [count_images(model) for model in models]
    for model, count in zip(models, views, strict=True):
        if count < views[0]:
            warnings.append(f"{model} is a smaller model of {count} views, not read.")
    return models[0]


class _Views:
    """The views of a model that can be used, and what is odd about the others.

    Attributes:
        left_out: names, and a sentence each.
    """

    def __init__(self, files: ImageFiles, masks: SidecarFiles, depths: SidecarFiles) -> None:
        self._files, self._masks, self._depths = files, masks, depths
        self._missing: list[str] = []
        self._reshaped: list[str] = []
        self.cameras: list[Camera] = []
        self.distorted: list[str] = []
        self.left_out: list[tuple[str, str]] = []

    def add(self, pose: Pose, lens: Intrinsics) -> None:
        """Takes a view, at the size of its photograph, or leaves it out."""
        name = pose.name.replace("\\", "/")
        try:
            if not lens.lens.focals:
                raise LodgsError(f"its camera model {lens.lens.name} is a panorama, not a perspective view.")
            if self.cameras and self.cameras[-1].name == name:
                raise LodgsError("the model has another view of that name.")
            image = self._files.find(pose.name)
            if image is None:
                self._missing.append(name)
                return
            width, height = image_size(image)
            beside = self._masks.find(name), self._depths.find(name)
            camera = Camera(
                name, lens.width, lens.height, *lens.pinhole, pose.world_to_camera, image, *beside,
                turns=quarter_turns(image),
            )  # fmt: skip
            if (width, height) != (lens.width, lens.height):
                camera = camera.resized(width, height)
            if flaw := camera.flaw:
                raise LodgsError(f"its {flaw}.")
        except LodgsError as error:
            self.left_out.append((name, error.what))
            return
        self.cameras.append(camera)
        if lens.distorted:
            self.distorted.append(name)
        # beyond rounding to whole pixels
        stretch = np.log(width) + np.log(lens.height) - np.log(height) - np.log(lens.width)
        if abs(stretch) > 0.01 + 1 / min(width, height):
            self._reshaped.append(
                f"{_shown(name)} is {width}x{height}, of other proportions than the model's "
                f"{lens.width}x{lens.height}: make sure that it is neither turned nor cropped."
            )

    def keep(self, which: np.ndarray) -> None:
        """Leaves out the cameras that are astray, all but ``which`` (V,)."""
        astray = [camera.name for camera, kept in zip(self.cameras, which, strict=True) if not kept]
        self.left_out += [
            (name, f"it stands over {OUTLIER_FACTOR:,} times as far off as most of the model.")
            for name in astray
        ]
        self.cameras = [camera for camera in self.cameras if camera.name not in astray]
        self.distorted = [name for name in self.distorted if name not in astray]

    def warnings(self, folder: Path) -> list[str]:
        """What is odd, in few sentences however many views there are."""
        found = exclusion_messages(self.left_out)
        match self._missing:
            case []:
                pass
            case [name]:
                found.append(f"{_shown(name)} is left out: there is no such file in {folder}.")
            case names:
                more = ", ..." if len(names) > MAX_NAMED else ""
                found.append(
                    f"{len(names):,} views are left out: {folder} has no files of their names "
                    f"({', '.join(map(_shown, names[:MAX_NAMED]))}{more})."
                )
        for what, beside in ("mask", self._masks), ("depth", self._depths):
            if all(getattr(camera, what) is None for camera in self.cameras):
                found += filter(None, [beside.misnamed(_shown(self.cameras[0].name))])
        found += self._reshaped[:MAX_NAMED]
        if len(self._reshaped) > MAX_NAMED:
            found.append(f"{len(self._reshaped) - MAX_NAMED:,} more photographs have other proportions.")
        return found


def exclusion_messages(left_out: Sequence[tuple[str, str]]) -> list[str]:
    """Names and reasons as sentences; many are summed up."""
    found = [f"{_shown(name)} is left out: {why}" for name, why in left_out[:MAX_NAMED]]
    if len(left_out) > MAX_NAMED:
        found.append(f"{len(left_out) - MAX_NAMED:,} more views are left out for reasons like these.")
    return found


def _shown(name: str) -> str:
    """A view's name for a message: any text, and not too long."""
    return printable(name if len(name) <= 200 else f"{name[:200]}...")


def _astray(points: np.ndarray, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Which points (P, 3) are too far off to be true (P,), and which cameras are not (V,)."""
    eyes = np.array([camera.center for camera in cameras])
    middle = np.median(eyes, axis=0)
    away, eyes_away = (np.linalg.norm(places - middle, axis=1) for places in (points, eyes))
    reach = max(np.median(eyes_away), np.median(away) if len(away) else 0.0)
    if reach == 0:
        return np.zeros(len(points), bool), np.ones(len(cameras), bool)
    return away > OUTLIER_FACTOR * reach, eyes_away <= OUTLIER_FACTOR * reach
