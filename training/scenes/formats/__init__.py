"""What other programs write of photographs and their cameras, as an ordinary COLMAP scene. No pycolmap, so
that Blender does it without a trainer.

Each format is a file here with ``NAME``, ``find`` and ``read``; nothing else knows it.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from ...errors import LodgsError
from ...files import check_folder, link_or_copy
from ..cameras import Camera
from ..colmap import DEPTHS, MASKS, exclusion_messages, find_models
from ..colmap_model import write_model
from ..image_files import find_image_folder
from ..images import image_size, same_proportions
from . import bundler, metashape, openmvg, polycam, record3d, transforms
from .exported import ExportedScene, ExportedView

FORMATS = transforms, polycam, record3d, metashape, openmvg, bundler
"""The first that finds itself in a folder is taken."""
RANDOM_POINTS = 30_000
"""So many are put where cameras look, if a program tells of no points."""
FORMAT_NAMES = ", ".join(each.NAME for each in FORMATS)


@dataclass(frozen=True)
class ConvertedScene:
    """A COLMAP scene that has been made.

    Attributes:
        folder: of the scene.
        what: the program whose export it was.
        views, points: how many there are.
        warnings: a sentence for each thing that was left out or is odd.
    """

    folder: Path
    what: str
    views: int
    points: int
    warnings: list[str]


def find_export(folder: Path) -> tuple[ModuleType, Path] | None:
    """The format that a folder is of, or one of the folders in it, and what it is read from; or None.

    Only names are looked at, and of small files their begin.
    """
    for each in FORMATS:
        if path := each.find(folder):
            return each, path
    try:
        below = [path for path in sorted(folder.iterdir()) if path.is_dir() and path.name[0] != "."]
    except OSError:
        return None
    # what was packed as a folder is unpacked into another
    found = [[(each, path) for each in FORMATS if (path := each.find(place))] for place in below]
    found = [formats[0] for formats in found if formats]
    return found[0] if len(found) == 1 else None


def ensure_colmap_scene(folder: Path, warn: Callable[[str], object]) -> Path:
    """The folder itself; what another program has exported there is a COLMAP scene from then on.

    Raises:
        LodgsError: as :func:`convert_export`.
    """
    if folder.is_dir() and not find_models(folder) and find_export(folder):
        for message in convert_export(folder).warnings:
            warn(message)
    return folder


def convert_export(folder: Path, out: Path | None = None) -> ConvertedScene:
    """Makes a COLMAP scene of what another program has exported: its model in ``sparse/0``.

    Args:
        out: the scene's folder, whose photographs are links or copies; None: the model is put beside them,
            and no photograph is touched.

    Raises:
        LodgsError: it is of no known format, damaged, or the scene cannot be written.
    """
    folder = folder.absolute()
    check_folder(folder, "Choose the folder that a program has exported.")
    found = find_export(folder)
    if found is None:
        is_scene = bool(find_models(folder))
        raise LodgsError(
            f"{folder} is a COLMAP scene as it is." if is_scene else f"{folder} is no export that is known.",
            "Import it."
            if is_scene
            else f"Known are {FORMAT_NAMES}; or choose the folder of a COLMAP scene.",
        )
    format_, path = found
    scene = folder if out is None else out
    if out is not None and out.is_dir() and find_models(out):
        raise LodgsError(f"{out} holds a COLMAP scene already.", "Choose another folder.")
    exported = format_.read(path)
    views, left_out = _usable(exported)
    if not views:
        why = f" {left_out[0][0]}: {left_out[0][1]}" if left_out else ""
        raise LodgsError(f"{path} has no view that can be used.{why}", "Check the photographs beside it.")
    warnings = [*exported.warnings, *exclusion_messages(left_out)]
    if unmasked := [view.mask for view in views if view.mask is not None and not view.mask.is_file()]:
        warnings.append(f"{len(unmasked)} masks are missing, such as {unmasked[0]}: nothing is masked there.")
    points, colors = exported.points, exported.colors
    if not len(points) and all(view.has_depth for view in views):
        warnings.append(f"{format_.NAME} tells of no points here: training takes them from the depth maps.")
    elif not len(points):
        points = random_start_points([view.camera(str(n)) for n, view in enumerate(views)])
        colors = np.full((len(points), 3), 128, np.uint8)
        warnings.append(
            f"{format_.NAME} tells of no points here: {len(points):,} stand at random where cameras look."
        )
    try:
        _write(scene, views, points, colors)
    except OSError as error:
        raise LodgsError(
            f"The COLMAP scene {scene} could not be written: {error.strerror or error}.",
            "Choose another folder to write to (lodgs scene --from DIR --out DIR).",
        ) from error
    return ConvertedScene(scene, format_.NAME, len(views), len(points), warnings)


def random_start_points(cameras: list[Camera], count: int = RANDOM_POINTS) -> np.ndarray:
    """Places (N, 3) that at least two views see, if any two see the same, to begin training with.

    They lie on random pixels' rays, about as far as what the cameras look at together: the place nearest to
    all their axes. Where there is no such place before them, as in a walk, about as far as three times the
    cameras are from their neighbours.
    """
    rng = np.random.default_rng(0)
    eyes = np.array([camera.center for camera in cameras])
    axes = np.array([camera.world_to_camera[2, :3] for camera in cameras])
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    focus = np.linalg.lstsq(across.sum(axis=0), np.einsum("nij,nj->i", across, eyes), rcond=None)[0]
    depths = np.einsum("ni,ni->n", focus - eyes, axes)
    if len(cameras) < 2 or np.mean(depths > 0) < 0.9:
        apart = np.linalg.norm(eyes[:, None] - eyes[None, :200], axis=2)
        nearest = np.where(apart > 0, apart, np.inf).min(axis=1, initial=np.inf)
        step = float(np.median(nearest[np.isfinite(nearest)])) if np.isfinite(nearest).any() else 1.0
        depths = np.full(len(cameras), 3 * step)
    which = rng.integers(len(cameras), size=4 * count)
    pixels, away = rng.random((4 * count, 2)), np.exp2(rng.uniform(-2, 1, 4 * count))
    points = np.empty((4 * count, 3))
    for number in np.unique(which):
        camera, rows = cameras[number], np.flatnonzero(which == number)
        depth = max(float(depths[number]), 1e-6) * away[rows]
        points[rows] = camera.unproject(pixels[rows] * (camera.width, camera.height), depth)
    seen = np.zeros(len(points), np.int32)
    for camera in cameras:
        seen += camera.sees(points)
    shared = points[seen >= min(2, len(cameras))]
    return (shared if len(shared) >= count // 10 else points)[:count]


def _usable(exported: ExportedScene) -> tuple[list[ExportedView], list[tuple[str, str]]]:
    """Views with photographs and possible cameras, and why others are left out."""
    views, left_out = [], list(exported.left_out)
    for view in exported.views:
        name = view.image.name
        try:
            size = image_size(view.image)
        except LodgsError as error:
            left_out.append((name, error.what))
            continue
        lens = view.lens
        if not same_proportions(*size, lens.width, lens.height):
            shape = f"{lens.width}x{lens.height}: it was turned or cropped."
            left_out.append((name, f"it is {size[0]}x{size[1]}, and its camera's pictures are {shape}"))
            continue
        view = view.sized(*size)
        if flaw := view.camera(name).flaw:
            left_out.append((name, f"its {flaw}."))
        else:
            views.append(view)
    return views, left_out


def _write(scene: Path, views: list[ExportedView], points: np.ndarray, colors: np.ndarray) -> None:
    """The model whole or not at all; photographs first, where the scene is another folder than theirs."""
    sparse = scene / "sparse"
    try:
        images = Path(os.path.commonpath([view.image.parent for view in views]))
    except ValueError as error:  # on Windows
        raise LodgsError("The photographs lie on several drives.", "Bring them to one.") from error
    if not images.is_relative_to(scene):
        for view in views:
            link_or_copy(view.image, scene / "images" / view.image.relative_to(images))
    elif find_image_folder(scene, sparse / "0", [view.image.name for view in views]) != images:
        images = scene
    sparse.mkdir(parents=True, exist_ok=True)
    for view in views:
        if view.mask is not None and view.mask.is_file():
            name = view.image.relative_to(images).as_posix()
            link_or_copy(view.mask, scene / MASKS / f"{name}.png")
        if view.depth is not None and view.has_depth:
            name = view.image.relative_to(images).as_posix()
            link_or_copy(view.depth, scene / DEPTHS / f"{name}{view.depth.suffix.lower()}")
    with tempfile.TemporaryDirectory(dir=sparse, prefix=".model-") as work:
        model = Path(work) / "0"
        lenses = [view.lens for view in views]
        poses = [(view.image.relative_to(images).as_posix(), view.world_to_camera) for view in views]
        write_model(model, lenses, poses, points, colors)
        os.replace(model, sparse / "0")
