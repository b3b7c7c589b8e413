"""Distorted photographs made pinhole, by COLMAP through pycolmap: for the trainer's environment only."""

from __future__ import annotations

import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError
from . import pycolmap_process
from .cameras import Camera
from .colmap import DEPTHS, MASKS, Scene, read_scene
from .depths import read_depth_map
from .exr import write_exr
from .images import load_exr, load_image, load_mask, write_png

CACHE_FOLDER = ".undistorted"
"""Folder in a scene's of what is made of it once, for all runs and for Blender."""
_VERSION = b"4"  # of what is kept in the cache
_BENT = "bent"
"""Folder of where in a photograph each pixel of the straight one is, as shares of its sides."""
_LEFT = 86_400.0
"""Seconds after which what is half done in a cache is nobody's."""


def undistort_scene(scene: Scene, cache: Path) -> Scene:
    """The scene with every lens undone: all views pinhole, `distorted` empty, the world unchanged.

    Photographs and model are written into a folder of `cache` that is named after them, and taken from there
    the next time; it appears whole or not at all. A scene without distorted views is returned as it is.
    Undistorted images are cropped so that no pixel is empty (COLMAP's blank_pixels = 0).

    Raises:
        LodgsError: pycolmap is missing or fails, one camera's photographs have several sizes, or the cache
            cannot be written.
    """
    if not scene.distorted:
        return scene
    try:
        target = cache / _key(scene)
        if not target.is_dir():
            _remove_left(cache)
            _undistort_into(target, scene)
    except OSError as error:
        raise LodgsError(
            f"The lens distortion of {scene.folder} could not be undone: {error.strerror or error}.",
            "Check the images and the free space.",
        ) from error
    return _read(target, scene)


def undistort_cache(scene: Scene, otherwise: Path) -> Path:
    """The cache beside a scene's photographs; another folder, where that may not be written to."""
    cache = scene.folder / CACHE_FOLDER
    try:
        cache.mkdir(exist_ok=True)
        with tempfile.TemporaryFile(dir=cache):
            return cache
    except OSError:
        return otherwise


def cached_undistorted_scene(scene: Scene) -> Scene | None:
    """As :func:`undistort_scene`, where that was done before and is kept with the scene; else None.

    Raises:
        LodgsError: what is kept is damaged.
    """
    if not scene.distorted:
        return scene
    try:
        target = scene.folder / CACHE_FOLDER / _key(scene)
        return _read(target, scene) if target.is_dir() else None
    except OSError:
        return None


def _read(target: Path, scene: Scene) -> Scene:
    result = read_scene(target, model=target / "sparse", images=target / "images")
    missing = {camera.name for camera in scene.cameras} - {camera.name for camera in result.cameras}
    lost = [f"{name} is left out: its lens distortion could not be undone." for name in sorted(missing)]
    turns = {camera.name: camera.turns for camera in scene.cameras}
    cameras = [replace(camera, turns=turns[camera.name]) for camera in result.cameras]
    return replace(result, cameras=cameras, names=scene.names, warnings=[*scene.warnings, *lost])


def _key(scene: Scene) -> str:
    """A digest of names, sizes and times of the model's files and of every photograph."""
    digest = hashlib.blake2b(_VERSION, digest_size=16)
    model = sorted(path for path in scene.model.iterdir() if path.suffix in (".bin", ".txt"))
    files = [(path.name, path) for path in model]
    files += [(camera.name, camera.image) for camera in scene.cameras if camera.image is not None]
    files += [(camera.name, camera.mask) for camera in scene.cameras if camera.mask is not None]
    files += [(camera.name, camera.depth) for camera in scene.cameras if camera.depth is not None]
    for name, path in files:
        status = path.stat()
        text = f"{name}\0{status.st_size}\0{status.st_mtime_ns}\0"
        digest.update(text.encode("utf-8", "surrogateescape"))
    return digest.hexdigest()


def _remove_left(cache: Path) -> None:
    """Removes what killed programs have left half done."""
    for left in cache.glob("undistorting-*"):
        if time.time() - left.stat().st_mtime > _LEFT:
            shutil.rmtree(left, ignore_errors=True)


def _undistort_into(target: Path, scene: Scene) -> None:
    """Run this module as a program on the scene, in a folder beside the target that then takes its name."""
    request = {
        "model": str(scene.model),
        "images": str(scene.images_folder),
        "sizes": {camera.name: [camera.width, camera.height] for camera in scene.cameras},
        "here": [camera.name for camera in scene.cameras if camera.depth is not None or _is_foreign(camera)],
    }
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent, prefix="undistorting-") as work:
        request["work"] = work
        masks = Path(work) / MASKS
        for camera in scene.cameras:
            if camera.mask is not None:
                light = load_mask(camera.mask, camera.width, camera.height)
                path = masks / f"{camera.name}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                write_png(path, np.repeat(np.rint(255 * light).astype(np.uint8)[..., None], 3, axis=2))
        problem = pycolmap_process.run_program("undistort", request, Path(work))
        if problem:
            raise LodgsError(
                f"The lens distortion of {scene.folder} could not be undone: {problem}",
                "Check the trainer's environment and the free space, or give an undistorted scene "
                "(colmap image_undistorter).",
            )
        for camera in scene.cameras:
            places = Path(work) / _BENT / f"{camera.name}.npy"
            if places.exists():
                _straighten_here(camera, np.load(places), Path(work) / "undistorted")
        try:
            os.replace(Path(work) / "undistorted", target)
        except OSError:
            if not target.is_dir():  # else another process was quicker, with the same content
                raise


def _is_foreign(camera: Camera) -> bool:
    """Whether pycolmap does not read a photograph of this kind, loses its light, or writes what few read."""
    return camera.name.lower().endswith((".webp", ".exr", ".tif", ".tiff"))


def _straighten_here(camera: Camera, places: np.ndarray, out: Path) -> None:
    """What pycolmap does not straighten of a view: its depth map, by the nearest pixel; a foreign photograph.

    Args:
        places: where each pixel is in the photograph, (H, W, 2) shares of its sides.
        out: folder of what is straight.
    """
    from scipy.ndimage import map_coordinates  # which Blender lacks

    def at(pixels: np.ndarray, order: int) -> np.ndarray:
        height, width = pixels.shape
        x, y = np.moveaxis(places * (width, height) - 0.5, -1, 0)
        return map_coordinates(pixels, [y, x], order=order, mode="nearest")

    if camera.depth is not None:
        path = out / DEPTHS / f"{camera.name}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        write_exr(path, {"Z": at(np.nan_to_num(read_depth_map(camera.depth)), order=0)})
    if camera.image is None or not _is_foreign(camera):
        return
    path = out / "images" / camera.name
    path.parent.mkdir(parents=True, exist_ok=True)
    linear = camera.name.lower().endswith(".exr")
    pixels = (
        load_exr(camera.image)
        if linear
        else load_image(camera.image, camera.width, camera.height, alpha=True)
    )
    planes = [at(plane, order=1) for plane in np.moveaxis(pixels, -1, 0)]
    if linear:
        write_exr(path, dict(zip("RGBA", planes, strict=True)))
    else:  # a PNG, which is told by its content
        straight = np.stack(
            [*(plane / np.maximum(planes[3], 1e-6) for plane in planes[:3]), planes[3]], axis=-1
        )
        write_png(path, np.rint(255 * straight.clip(0, 1)).astype(np.uint8))


def _main() -> None:
    request = pycolmap_process.read_request()
    pycolmap = pycolmap_process.load_pycolmap()
    model = pycolmap.Reconstruction(request["model"])
    sizes = defaultdict(set)
    for image in model.images.values():
        with suppress(UnicodeDecodeError):  # a name that is no text has no size
            if image.name in request["sizes"]:
                sizes[image.camera_id].add(tuple(request["sizes"][image.name]))
    for camera_id, found in sizes.items():
        if len(found) > 1:
            sys.exit(f"the photographs of camera {camera_id} have several sizes: {sorted(found)}.")
        model.cameras[camera_id].rescale(*found.pop())
    for camera in model.cameras.values():
        if camera.is_perspective_fisheye() and camera.is_undistorted():
            # COLMAP copies an ideal fisheye as if it were a pinhole: bend it, by less than 0.01 px.
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
        image_names=list(request["sizes"]),
        jpeg_quality=98,
    )
    straight = pycolmap.Reconstruction(work / "undistorted" / "sparse") if request["here"] else None
    for image in straight.images.values() if straight else ():
        if image.name in request["here"]:
            file = work / _BENT / f"{image.name}.npy"
            file.parent.mkdir(parents=True, exist_ok=True)
            np.save(file, _places(image.camera, model.cameras[image.camera_id]))
    masks = work / MASKS
    if masks.is_dir():  # bent like their photographs, whose names theirs begin with
        for image in model.images.values():
            image.name = f"{image.name}.png"
        (work / "masked").mkdir()
        model.write(str(work / "masked"))
        names = [path.relative_to(masks).as_posix() for path in masks.rglob("*.png")]
        pycolmap.undistort_images(
            output_path=work / "straight", input_path=work / "masked", image_path=masks, image_names=names
        )
        (work / "straight" / "images").rename(work / "undistorted" / MASKS)


def _places(straight, bent) -> np.ndarray:
    """Where in a photograph of a bent lens a straight one's pixels are, (H, W, 2) shares of its sides."""
    y, x = np.mgrid[: straight.height, : straight.width] + 0.5
    rays = straight.cam_from_img(np.stack([x, y], axis=-1).reshape(-1, 2))
    pixels = bent.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
    return (pixels / (bent.width, bent.height)).reshape(*x.shape, 2).astype(np.float32)


if __name__ == "__main__":
    _main()
