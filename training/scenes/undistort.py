"""Removal of lens distortion with COLMAP, through pycolmap. Runs in the trainer's environment only."""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import LodgsError, system_reason
from ..files import is_file
from . import pycolmap_process
from .cameras import Camera
from .colmap import DEPTHS, MASKS, Scene, read_scene, scene_lenses
from .depths import read_depth_map
from .exr import write_exr
from .images import load_exr, load_image, load_mask, write_png
from .scene_cache import remove_abandoned, scene_digest, writable_cache
from .write_colmap import write_model

if TYPE_CHECKING:
    pass

CACHE_FOLDER = ".undistorted"
"""Folder inside a scene's folder that caches undistorted images for all runs and for Blender."""
_VERSION = b"4"  # format of the cached files
_SOURCE_PIXELS = "source_pixels"
"""Folder of arrays with the position of each undistorted pixel in the photo, as fractions of its sides."""


def undistort_scene(scene: Scene, cache: Path) -> Scene:
    """Return the scene with pinhole views only, an empty ``distorted`` list and an unchanged world.

    Photos and model are written to a folder in ``cache`` that is named after their digest, and reused later.
    The folder appears completely or not at all. A scene without distorted views is returned unchanged.
    Undistorted images are cropped to contain no empty pixels (COLMAP's blank_pixels = 0).

    Raises:
        LodgsError: pycolmap is missing or fails, or the cache cannot be written.
    """
    if not scene.distorted:
        return scene
    try:
        target = cache / scene_digest(scene, _VERSION)
        if not target.is_dir():
            remove_abandoned(cache, "undistorting-")
            _undistort_into(target, scene)
    except OSError as error:
        raise LodgsError(
            f"Cannot undistort {scene.folder}: {system_reason(error)}.",
            "Check the images and the free disk space.",
        ) from error
    return _read_cached(target, scene)


def undistort_cache(scene: Scene, fallback: Path) -> Path:
    """Return the cache folder inside the scene's folder, or ``fallback`` if that is not writable."""
    return writable_cache(scene, CACHE_FOLDER, fallback)


def cached_undistorted_scene(scene: Scene) -> Scene | None:
    """Return the undistorted scene from the cache inside the scene's folder, or None if it is not cached.

    Raises:
        LodgsError: the cached scene is damaged.
    """
    if not scene.distorted:
        return scene
    try:
        target = scene.folder / CACHE_FOLDER / scene_digest(scene, _VERSION)
        return _read_cached(target, scene) if target.is_dir() else None
    except OSError:
        return None


def _read_cached(target: Path, scene: Scene) -> Scene:
    result = read_scene(target, model=target / "sparse", images=target / "images", origin=scene.origin)
    missing = {camera.name for camera in scene.cameras} - {camera.name for camera in result.cameras}
    warnings = [f"Skipped {name}: it cannot be undistorted." for name in sorted(missing)]
    turns = {camera.name: camera.turns for camera in scene.cameras}
    cameras = [replace(camera, turns=turns[camera.name]) for camera in result.cameras]
    return replace(
        result, cameras=cameras, names=scene.names, points=scene.points, point_colors=scene.point_colors,
        point_ids=scene.point_ids, point_model=scene.point_model or scene.model,
        georeference=scene.georeference, warnings=[*scene.warnings, *warnings],
    )  # fmt: skip


def _undistort_into(target: Path, scene: Scene) -> None:
    """Run this module as a program in a temporary folder, and rename the result to the target."""
    request = {
        "images": str(scene.images_folder),
        "names": [camera.name for camera in scene.cameras],
        "source_pixels": [
            camera.name
            for camera in scene.cameras
            if camera.depth is not None or not _reads_photo(scene, camera)
        ],
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="undistorting-") as work:
        request["work"] = work
        poses = [(camera.name, camera.moved(scene.origin).world_to_camera) for camera in scene.cameras]
        no_points = np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        write_model(Path(work) / "sparse", scene_lenses(scene), poses, *no_points)
        masks = Path(work) / MASKS
        for camera in scene.cameras:
            if camera.mask is not None:
                values = load_mask(camera.mask, camera.width, camera.height)
                path = masks / f"{camera.name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_png(path, np.repeat(np.rint(255 * values).astype(np.uint8)[..., None], 3, axis=2))
        problem = pycolmap_process.run_program("undistort", request, Path(work))
        if problem:
            raise LodgsError(
                f"Cannot undistort {scene.folder}: {problem}",
                "Check the trainer's environment and the free disk space, or choose an undistorted scene "
                "(colmap image_undistorter).",
            )
        for camera in scene.cameras:
            file = Path(work) / _SOURCE_PIXELS / f"{camera.name}.npy"
            if file.exists():
                _resample_files(scene, camera, np.load(file), Path(work) / "undistorted")
        try:
            os.replace(Path(work) / "undistorted", target)
        except OSError:
            if not target.is_dir():  # another process may have written the same content first
                raise


def _reads_photo(scene: Scene, camera: Camera) -> bool:
    """Return False if pycolmap cannot read a photo, clips it, writes a rare variant or misses its file."""
    unsupported = camera.name.lower().endswith((".webp", ".exr", ".tif", ".tiff"))
    return not unsupported and is_file(scene.images_folder / camera.name)


def _resample_files(scene: Scene, camera: Camera, source: np.ndarray, out: Path) -> None:
    """Undistort the files of a view that pycolmap cannot: its depth map (nearest pixel), unsupported photos.

    Args:
        source: (H, W, 2) position of each undistorted pixel in the photo, as fractions of its sides.
        out: folder of the undistorted scene.
    """
    from scipy.ndimage import map_coordinates  # Blender lacks scipy

    def resample(pixels: np.ndarray, order: int) -> np.ndarray:
        height, width = pixels.shape
        x, y = np.moveaxis(source * (width, height) - 0.5, -1, 0)
        return map_coordinates(pixels, [y, x], order=order, mode="nearest")

    if camera.depth is not None:
        path = out / DEPTHS / f"{camera.name}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, {"Z": resample(np.nan_to_num(read_depth_map(camera.depth)), order=0)})
    if camera.image is None or _reads_photo(scene, camera):
        return
    path = out / "images" / camera.name
    path.parent.mkdir(parents=True, exist_ok=True)
    linear = camera.image.suffix.lower() == ".exr"
    pixels = (
        load_exr(camera.image)
        if linear
        else load_image(camera.image, camera.width, camera.height, alpha=True)
    )
    planes = [resample(plane, order=1) for plane in np.moveaxis(pixels, -1, 0)]
    if linear:
        write_exr(path, dict(zip("RGBA", planes, strict=True)))
    else:  # a PNG under the photo's name: formats are detected from the content
        straight = np.stack(
            [*(plane / np.maximum(planes[3], 1e-6) for plane in planes[:3]), planes[3]], axis=-1
        )
        write_png(path, np.rint(255 * straight.clip(0, 1)).astype(np.uint8))


def _main() -> None:
    request = pycolmap_process.read_request()
    pycolmap = pycolmap_process.load_pycolmap()
    model = pycolmap.Reconstruction(Path(request["work"]) / "sparse")
    for camera in model.cameras.values():
        if camera.is_perspective_fisheye() and camera.is_undistorted():
            # COLMAP treats an ideal fisheye as a pinhole; a distortion below 0.01 px prevents that.
            fx, fy = camera.focal_length_x, camera.focal_length_y
            cx, cy = camera.principal_point_x, camera.principal_point_y
            camera.model = pycolmap.CameraModelId.OPENCV_FISHEYE
            camera.params = [fx, fy, cx, cy, 1e-6, 0, 0, 0]
    work = Path(request["work"])
    (work / "model").mkdir()
    model.write(str(work / "model"))
    pycolmap.undistort_images(
        output_path=work / "undistorted",
        input_path=work / "model",
        image_path=request["images"],
        image_names=request["names"],
        jpeg_quality=98,
    )
    names = request["source_pixels"]
    undistorted = pycolmap.Reconstruction(work / "undistorted" / "sparse") if names else None
    for image in undistorted.images.values() if undistorted else ():
        if image.name in names:
            file = work / _SOURCE_PIXELS / f"{image.name}.npy"
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, _source_pixels(image.camera, model.cameras[image.camera_id]))
    masks = work / MASKS
    if masks.is_dir():  # masks are named after their photos and have the same distortion
        for image in model.images.values():
            image.name = f"{image.name}.png"
        (work / "masked").mkdir()
        model.write(str(work / "masked"))
        names = [path.relative_to(masks).as_posix() for path in masks.rglob("*.png")]
        pycolmap.undistort_images(
            output_path=work / "straight", input_path=work / "masked", image_path=masks, image_names=names
        )
        (work / "straight" / "images").rename(work / "undistorted" / MASKS)


def _source_pixels(undistorted: Any, distorted: Any) -> np.ndarray:
    """Return the position of each undistorted pixel in the photo, (H, W, 2) fractions of its sides."""
    y, x = np.mgrid[: undistorted.height, : undistorted.width] + 0.5
    rays = undistorted.cam_from_img(np.stack([x, y], axis=-1).reshape(-1, 2))
    pixels = distorted.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    return (pixels / (distorted.width, distorted.height)).reshape(*x.shape, 2).astype(np.float32)


if __name__ == "__main__":
    _main()
