"""The floor and the wall of ``walls`` as a scene with depth maps of every kind; depths worked out by hand."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR

from training.scenes.cameras import Camera, look_at
from training.scenes.images import write_png
from training.scenes.write_colmap import write_colmap

from .walls import CAMERA_POSITIONS, FOCAL, HEIGHT, WIDTH, render_photo


def view(number: int) -> Camera:
    pose = look_at(CAMERA_POSITIONS[number], np.array([0.0, 0.6, 0.4]), (0, 0, 1))
    name = f"{number}.png"
    return Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def depth_of(camera: Camera) -> np.ndarray:
    """(H, W) along the camera's axis to the floor at z = 0 or the wall at y = 1, whichever is nearer."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = local @ camera.world_to_camera[:3, :3]  # as long as 1 along the axis
    eye = camera.center
    with np.errstate(divide="ignore"):
        down, ahead = -eye[2] / rays[..., 2], (1 - eye[1]) / rays[..., 1]
    return np.where((down > 0) & (down < ahead), down, ahead)


def write_walls(folder: Path) -> Path:
    """Six views and 300 points with tracks; no maps yet."""
    rng = np.random.default_rng(0)
    (folder / "images").mkdir()
    views, points = [view(number) for number in range(6)], []
    for camera in views:
        write_png(folder / "images" / camera.name, render_photo(camera.center))
        pixels = rng.integers([WIDTH, HEIGHT], size=(50, 2))
        points.append(camera.unproject(pixels + 0.5, depth_of(camera)[pixels[:, 1], pixels[:, 0]]))
    places = np.concatenate(points)
    visible = np.array([camera.sees(places) for camera in views])  # nothing hides anything here
    write_colmap(folder, views, places, visible, np.full((len(places), 3), 100))
    return folder


def put(scene: Path, folder: Path, write) -> Path:
    """A scene of the same photographs and model, with a file of each view's depth written by ``write``."""
    for name in ("images", "sparse"):
        (folder / name).symlink_to(scene / name)
    (folder / "depths").mkdir()
    for number in range(6):
        write(folder / "depths", number, depth_of(view(number)))
    return folder


def exr(path: Path, values: np.ndarray, channel: str = "L.Depth.Z", **more: np.ndarray) -> None:
    channels = {channel: values.astype(np.float32), **more}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))


def grey(path: Path, values: np.ndarray) -> None:
    """A PNG of 16 bits, by hand: Pillow's writing beside pycolmap in one process corrupts memory."""
    height, width = values.shape
    lines = np.rint(values).astype(">u2").view(np.uint8).reshape(height, 2 * width)
    chunks = (
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(np.insert(lines, 0, 0, axis=1).tobytes())),
        (b"IEND", b""),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
            for kind, data in chunks
        )
    )


def npy(path: Path, values: np.ndarray) -> None:
    with open(path, "wb") as file:  # whatever the name
        np.save(file, values)


def multilayer(folder, number, depth):
    colors = {f"L.Combined.{each}": np.ones_like(depth, np.float16) for each in "RGBA"}
    normals = {f"L.Normal.{each}": np.ones_like(depth, np.float32) for each in "XYZ"}
    exr(folder / f"{number}.exr", depth, **colors, **normals)


METRIC = {
    "multilayer": multilayer,
    "one layer": lambda folder, number, depth: exr(folder / f"{number}.png.exr", depth, "Z"),
    "half": lambda folder, number, depth: OpenEXR.File(
        {"type": OpenEXR.scanlineimage}, {"V": depth.astype(np.float16)}
    ).write(str(folder / f"{number}.exr")),
    "numbers": lambda folder, number, depth: npy(folder / f"{number}.png.npy", depth.astype(np.float32)),
    "whole numbers": lambda folder, number, depth: npy(
        folder / f"{number}.npy", np.rint(1000 * depth[..., None]).astype(np.uint16)
    ),
    "millimetres": lambda folder, number, depth: grey(folder / f"{number}.png", 1000 * depth),
}
FITTED = {
    "relative": lambda folder, number, depth: exr(folder / f"{number}.exr", (depth - 0.3) / (2.0 + number)),
    "inverse": lambda folder, number, depth: grey(
        folder / f"{number}.png", 9000 * (1 / depth + 0.1 + number / 30)
    ),
}
