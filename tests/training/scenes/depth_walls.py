"""The floor and wall of ``walls`` as a scene with depth maps in all formats; depths are computed by hand."""

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


def make_view(number: int) -> Camera:
    pose = look_at(CAMERA_POSITIONS[number], np.array([0.0, 0.6, 0.4]), (0, 0, 1))
    name = f"{number}.png"
    return Camera(name, WIDTH, HEIGHT, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, pose)


def depth_of(camera: Camera) -> np.ndarray:
    """Return depths (H, W) of the nearer of the floor at z = 0 and the wall at y = 1."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    rays = local @ camera.world_to_camera[:3, :3]  # length 1 along the axis
    position = camera.center
    with np.errstate(divide="ignore"):
        to_floor, to_wall = -position[2] / rays[..., 2], (1 - position[1]) / rays[..., 1]
    return np.where((to_floor > 0) & (to_floor < to_wall), to_floor, to_wall)


def write_walls(folder: Path) -> Path:
    """Write six views and 300 points with tracks, without depth maps."""
    rng = np.random.default_rng(0)
    (folder / "images").mkdir()
    views = [make_view(number) for number in range(6)]
    view_points = []
    for camera in views:
        write_png(folder / "images" / camera.name, render_photo(camera.center))
        pixels = rng.integers([WIDTH, HEIGHT], size=(50, 2))
        view_points.append(camera.unproject(pixels + 0.5, depth_of(camera)[pixels[:, 1], pixels[:, 0]]))
    points = np.concatenate(view_points)
    visible = np.array([camera.sees(points) for camera in views])  # there is no occlusion
    write_colmap(folder, views, points, visible, np.full((len(points), 3), 100))
    return folder


def write_depth_scene(scene: Path, folder: Path, write) -> Path:
    """Link the photos and the model into a new folder, and call ``write`` for each view's depth."""
    for name in ("images", "sparse"):
        (folder / name).symlink_to(scene / name)
    (folder / "depths").mkdir()
    for number in range(6):
        write(folder / "depths", number, depth_of(make_view(number)))
    return folder


def write_exr_map(path: Path, values: np.ndarray, channel: str = "L.Depth.Z", **passes: np.ndarray) -> None:
    channels = {channel: values.astype(np.float32), **passes}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))


def write_png_map(path: Path, values: np.ndarray) -> None:
    """Write a 16-bit PNG without Pillow, which corrupts memory in one process with pycolmap."""
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


def write_npy_map(path: Path, values: np.ndarray) -> None:
    with open(path, "wb") as file:  # np.save would change the suffix
        np.save(file, values)


def multilayer(folder, number, depth):
    colors = {f"L.Combined.{name}": np.ones_like(depth, np.float16) for name in "RGBA"}
    normals = {f"L.Normal.{name}": np.ones_like(depth, np.float32) for name in "XYZ"}
    write_exr_map(folder / f"{number}.exr", depth, **colors, **normals)


METRIC = {
    "multilayer": multilayer,
    "one layer": lambda folder, number, depth: write_exr_map(folder / f"{number}.png.exr", depth, "Z"),
    "half": lambda folder, number, depth: OpenEXR.File(
        {"type": OpenEXR.scanlineimage}, {"V": depth.astype(np.float16)}
    ).write(str(folder / f"{number}.exr")),
    "floats": lambda folder, number, depth: write_npy_map(
        folder / f"{number}.png.npy", depth.astype(np.float32)
    ),
    "integers": lambda folder, number, depth: write_npy_map(
        folder / f"{number}.npy", np.rint(1000 * depth[..., None]).astype(np.uint16)
    ),
    "millimetres": lambda folder, number, depth: write_png_map(folder / f"{number}.png", 1000 * depth),
}
FITTED = {
    "relative": lambda folder, number, depth: write_exr_map(
        folder / f"{number}.exr", (depth - 0.3) / (2.0 + number)
    ),
    "inverse": lambda folder, number, depth: write_png_map(
        folder / f"{number}.png", 9000 * (1 / depth + 0.1 + number / 30)
    ),
}
