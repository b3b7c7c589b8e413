"""Conversion of other programs' photos and cameras to COLMAP scenes. Works without pycolmap, inside Blender.

Each format is a module with ``NAME``, ``find`` and ``read``, and independent of the other formats. ``read``
gets the result of ``find``, and the folder to search for photos that are not where the export states.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType

from ...errors import LodgsError, SystemProblem, system_reason, system_remedy
from ...files import check_folder, is_file, link_or_copy, temporary_folder
from ...splats.georeference import FILE as GEOREFERENCE_FILE
from ...splats.georeference import read_georeference, write_georeference
from ..colmap import (
    DEPTHS,
    MASKS,
    NO_POINTS,
    Scene,
    find_models,
    read_scene,
    require_complete_model,
    scene_lenses,
    subfolders,
)
from ..colmap_model import model_suffix
from ..image_files import find_image_folder
from ..image_headers import exif_orientation, image_size
from ..view_selection import STORE_UPRIGHT, exclusion_messages, fits_upright_photos, photo_turns
from ..write_colmap import write_model
from . import (
    bundler,
    metashape,
    openmvg,
    opensfm,
    polycam,
    realitycapture,
    record3d,
    scanner_app,
    splat_cameras,
    transforms,
)
from .exported import ExportedScene, ExportedView
from .foreign import describe_foreign

FORMATS = (
    transforms, polycam, record3d, metashape, openmvg, opensfm, bundler, realitycapture, scanner_app,
    splat_cameras,
)  # fmt: skip
"""Supported formats; the first one that recognises a folder is used."""
MAX_DEPTH, MAX_SUBFOLDERS = 3, 1000
"""Maximum depth of an export below the given folder, and of subfolders searched at each depth."""
FORMAT_NAMES = ", ".join(module.NAME for module in FORMATS)


@dataclass(frozen=True)
class ConvertedScene:
    """A converted COLMAP scene.

    Attributes:
        folder: folder of the scene.
        source: name of the export's format.
        views, points: number of views and points.
        warnings: a sentence for each skipped or suspicious item.
        is_source: whether the folder is the COLMAP scene that was given, whose model must not change.
    """

    folder: Path
    source: str
    views: int
    points: int
    warnings: list[str]
    is_source: bool = False


def find_exports(folder: Path) -> list[tuple[ModuleType, Path]]:
    """Return the format of a folder and the file or folder to read; if it is unknown, those of subfolders.

    Archives often add folders, so subfolders are searched by depth, until one depth has exports. Only names
    and the first bytes of small files are inspected.
    """
    level = [folder]
    for _ in range(MAX_DEPTH + 1):
        matches = [match for place in level if (match := _export_in(place))]
        if matches:
            return matches
        level = [path for place in level for path in subfolders(place)][:MAX_SUBFOLDERS]
    return []


def _export_in(folder: Path) -> tuple[ModuleType, Path] | None:
    candidates = ((module, module.find(folder)) for module in FORMATS)
    return next(((module, path) for module, path in candidates if path), None)


def scene_of_file(path: Path) -> tuple[Path, Path | None]:
    """Return the folder of the scene that a file belongs to, and its model if the scene has several.

    Raises:
        LodgsError: the file's folder has neither a COLMAP model nor an export.
    """
    model = folder = path.absolute().parent
    if not model_suffix(model):
        if _export_in(folder):
            return folder, None
        raise LodgsError(
            f"Cannot import {path}: its folder has neither a COLMAP model nor a known export.",
            f"Choose a file of a COLMAP model, such as cameras.bin, or of an export of {FORMAT_NAMES}.",
        )
    folder = scene_of_model(model)
    return folder, model if len(find_models(folder)) > 1 else None


def scene_of_model(folder: Path) -> Path:
    """Return the folder that contains ``sparse`` or ``sparse/0``, or another folder itself."""
    if folder.name.isdigit() and folder.parent.name == "sparse":
        folder = folder.parent
    return folder.parent if folder.name == "sparse" else folder


def ensure_colmap_scene(folder: Path, warn: Callable[[str], object]) -> Path:
    """Convert another program's export in place unless the folder is a COLMAP scene, and return the folder.

    Raises:
        LodgsError: see :func:`convert_export`, or the folder has files of an unsupported program.
    """
    if not folder.is_dir() or find_models(folder):
        return folder
    if find_exports(folder):
        for message in convert_export(folder).warnings:
            warn(message)
        return folder
    require_complete_model(folder)
    if foreign := describe_foreign(folder):
        raise LodgsError(f"Cannot read scene {folder}: {foreign[0]}.", foreign[1])
    return folder


def convert_export(
    folder: Path, out: Path | None = None, add_points: Callable[[Path, Path], Scene] | None = None
) -> ConvertedScene:
    """Convert another program's export to a COLMAP scene with its model in ``sparse/0``.

    The model appears under its name when it is complete, so that an interrupted conversion can be repeated.

    Args:
        folder: folder of the export, or of a COLMAP scene without points.
        out: folder of the scene, which receives links to or copies of the photos. By default, the model is
            written next to the photos, which stay unchanged.
        add_points: adds points to the model of an export that has neither points nor depth maps, as
            ``triangulate.write_points``. It receives the folders of the scene and of the unfinished model.

    Raises:
        LodgsError: the format is unknown, the export is damaged, or the scene cannot be written.
    """
    folder = folder.absolute()
    check_folder(folder, "Choose the folder of another program's export.")
    export = _choose_export(folder)
    scene = folder if out is None else out
    _check_output(scene, in_place=out is None)
    if export is None:
        name, path, exported = "COLMAP", folder, _read_model_without_points(folder)
        if out is None:
            return ConvertedScene(folder, name, len(exported.views), 0, exported.warnings, is_source=True)
    else:
        name, path, exported = export[0].NAME, export[1], export[0].read(export[1], folder)
    views, excluded = _usable_views(exported)
    if not views:
        reason = f" {excluded[0][0]}: {excluded[0][1]}" if excluded else ""
        raise LodgsError(
            f"Cannot convert {path}: it has no usable view.{reason}",
            "Check its cameras and the photos next to it.",
        )
    warnings = [*exported.warnings, *exclusion_messages(excluded)]
    if missing := [view.mask for view in views if view.mask is not None and not is_file(view.mask)]:
        warnings.append(
            f"{len(missing)} masks are missing, such as {missing[0]}. Their photos are not masked."
        )
    if exported.georeference is None or (folder / GEOREFERENCE_FILE).is_file():
        own = read_georeference(folder, warnings.append)
        if own is not None:  # the user's file stays as it is
            exported = replace(exported, georeference=None if out is None else own)
    count = len(exported.points)
    if not count and all(view.has_depth for view in views):
        warnings.append(f"{name} has no points. Training creates them from the depth maps.")
        add_points = None
    try:
        completed = _write(scene, views, exported, None if count else add_points)
    except OSError as error:
        raise LodgsError(
            f"Cannot write COLMAP scene {scene}: {system_reason(error)}.",
            system_remedy(error, "Choose another output folder (lodgs scene --from DIR --out DIR)."),
        ) from error
    if completed is not None:
        warnings, count = [*warnings, *completed.warnings], len(completed.points)
    return ConvertedScene(scene, name, len(views), count, warnings)


def _choose_export(folder: Path) -> tuple[ModuleType, Path] | None:
    """Return the only result of :func:`find_exports`; None for a COLMAP scene.

    Raises:
        LodgsError: there are several exports, or neither an export nor a COLMAP scene.
    """
    exports = find_exports(folder)
    if len(exports) > 1:
        raise LodgsError(
            f"Cannot convert {folder}: it has {len(exports)} exports, such as {exports[0][1]} and "
            f"{exports[1][1]}.",
            "Choose the folder of one of them.",
        )
    if not exports and not find_models(folder):
        reason, remedy = describe_foreign(folder) or (
            "its format is unknown",
            f"Choose an export of {FORMAT_NAMES}, or the folder of a COLMAP scene.",
        )
        raise LodgsError(f"Cannot convert {folder}: {reason}.", remedy)
    return exports[0] if exports else None


def _check_output(scene: Path, in_place: bool) -> None:
    """Raise LodgsError if the scene's folder has a model; in place, only one that would be overwritten."""
    if in_place and model_suffix(scene / "sparse" / "0") and find_exports(scene):
        raise LodgsError(
            f"Cannot write scene: {scene / 'sparse' / '0'} already holds a model.",
            "Use the folder as it is, or choose another output folder (--out DIR).",
        )
    if not in_place and scene.is_dir() and find_models(scene):
        raise LodgsError(
            f"Cannot write scene: {scene} already holds a COLMAP scene.", "Choose another folder."
        )


def _read_model_without_points(folder: Path) -> ExportedScene:
    """Return the views of a COLMAP scene.

    Raises:
        LodgsError: see ``read_scene``, or the scene has points.
    """
    scene = read_scene(folder)
    if len(scene.points):
        raise LodgsError(f"Cannot convert {folder}: it already is a COLMAP scene.", "Import it directly.")
    views = [
        ExportedView(
            camera.image, lens, camera.moved(scene.origin).world_to_camera, camera.mask, camera.depth
        )
        for camera, lens in zip(scene.cameras, scene_lenses(scene), strict=True)
        if camera.image is not None
    ]
    warnings = [warning for warning in scene.warnings if not warning.startswith(NO_POINTS)]
    return ExportedScene(views, warnings=warnings)


def _usable_views(exported: ExportedScene) -> tuple[list[ExportedView], list[tuple[str, str]]]:
    """Return the views with a readable photo and a valid camera, and (name, reason) pairs of the others."""
    views, excluded = [], list(exported.excluded)
    unique = {(view.image, view.world_to_camera.tobytes()): view for view in exported.views}
    counts = Counter(image for image, _ in unique)
    upright = fits_upright_photos((view.image, view.lens.width, view.lens.height) for view in unique.values())
    for view in unique.values():
        name = view.image.name
        if counts[view.image] > 1:
            excluded.append((name, f"{counts[view.image]} views have the photo {view.image}."))
            continue
        try:
            width, height = image_size(view.image)
        except SystemProblem:
            raise
        except LodgsError as error:
            excluded.append((name, error.what))
            continue
        lens = view.lens
        try:
            turns = photo_turns(view.image, width, height, lens.width, lens.height, upright is True)
            view = (view.turned(turns) if turns else view).sized(width, height)
        except LodgsError as error:
            excluded.append((name, error.what))
            continue
        if flaw := view.camera(name).flaw:
            excluded.append((name, f"{flaw}."))
        else:
            views.append(view)
    turned = [view.image for view in views if upright is None and exif_orientation(view.image) > 1]
    if turned:
        exported.warnings.append(
            f"EXIF data turns or mirrors {len(turned):,} photos, such as {turned[0]}, but sizes do not show "
            f"if their cameras are upright. Pixels are used as stored. If that is wrong, {STORE_UPRIGHT}."
        )
    return views, excluded


def _write(
    scene: Path,
    views: list[ExportedView],
    exported: ExportedScene,
    add_points: Callable[[Path, Path], Scene] | None,
) -> Scene | None:
    """Link photos outside the scene's folder, then write the model completely or not at all.

    Returns:
        The result of ``add_points``, if given.
    """
    sparse = scene / "sparse"
    try:
        images = Path(os.path.commonpath([view.image.parent for view in views]))
    except ValueError as error:  # raised on Windows only
        raise LodgsError(
            f"Cannot write COLMAP scene {scene}: the photos are on several drives.", "Move them to one drive."
        ) from error
    if not images.is_relative_to(scene):
        for view in views:
            link_or_copy(view.image, scene / "images" / view.image.relative_to(images))
    elif find_image_folder(scene, sparse / "0", [view.image.name for view in views])[0] != images:
        images = scene
    sparse.mkdir(parents=True, exist_ok=True)
    names = [view.image.relative_to(images).as_posix() for view in views]
    for view, name in zip(views, names, strict=True):
        if view.mask is not None and is_file(view.mask):
            link_or_copy(view.mask, scene / MASKS / f"{name}.png")
        if view.depth is not None and view.has_depth:
            link_or_copy(view.depth, scene / DEPTHS / f"{name}{view.depth.suffix.lower()}")
    if exported.georeference is not None:
        write_georeference(scene, exported.georeference)
    with temporary_folder(sparse) as work:
        model = work / "0"
        lenses = [view.lens for view in views]
        poses = [(name, view.world_to_camera) for name, view in zip(names, views, strict=True)]
        write_model(model, lenses, poses, exported.points, exported.colors)
        completed = add_points(scene, model) if add_points is not None else None
        os.replace(model, sparse / "0")
    return completed
