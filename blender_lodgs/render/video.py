"""Extraction of sharp video frames with Blender's video reader, as photos for the camera search."""

from __future__ import annotations

import os
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import bpy
import numpy as np

from ...training.errors import LodgsError
from .. import compat
from .written_images import is_complete_image

MAX_FRAMES = 120
"""Default maximum number of extracted frames."""
CANDIDATES = 3
"""Number of frames per interval that are compared for sharpness."""
_NAME = re.compile(r"frame_(\d{6})\.png")


def extract_frames(
    video: Path,
    folder: Path,
    maximum: int,
    on_frame: Callable[[int, int], object] = lambda number, count: None,
) -> int:
    """Write the sharpest frame of each of several equal time intervals of a video.

    Files are named by frame numbers. Intervals with an existing file are skipped.

    Args:
        video: path of the video.
        folder: output folder.
        maximum: maximum number of frames.
        on_frame: function called before each frame with its number (from 1) and the number of frames.

    Returns:
        Number of frames.

    Raises:
        LodgsError: the video cannot be read, or the folder is not writable.
    """
    with _open_video(video) as (scene, frames):
        count = min(maximum, frames)
        edges = np.linspace(0, frames, count + 1).astype(int)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            matches = [_NAME.fullmatch(path.name) for path in folder.iterdir()]
            existing = [int(match[1]) for match in matches if match]
            for number, (first, end) in enumerate(pairwise(edges), 1):
                on_frame(number, count)
                if any(first < frame <= end for frame in existing):
                    continue
                candidates = np.unique(np.linspace(first + 1, end, CANDIDATES, dtype=int))
                with tempfile.TemporaryDirectory(dir=folder, prefix=".frames-") as temporary:
                    images = [_render(scene, int(frame), Path(temporary)) for frame in candidates]
                    best = max(images, key=lambda image: sharpness(_green_channel(image)))
                    os.replace(best, folder / best.name)
        except OSError as error:
            raise LodgsError(
                f"Cannot write to {folder}: {error.strerror or error}.", "Choose another folder."
            ) from error
    return count


def sharpness(image: np.ndarray) -> float:
    """Return the sharpness of an image (H, W): the variance of its Laplacian (Pech-Pacheco et al. 2000)."""
    center = image[1:-1, 1:-1]
    neighbors = image[:-2, 1:-1] + image[2:, 1:-1] + image[1:-1, :-2] + image[1:-1, 2:]
    return float(np.var(neighbors - 4 * center))


def _render(scene: bpy.types.Scene, frame: int, folder: Path) -> Path:
    """Render a frame to a file, as an animation: stills of an inactive scene always show its first frame."""
    scene.frame_start = scene.frame_end = frame
    scene.render.filepath = str(folder / "frame_######")
    path = folder / f"frame_{frame:06d}.png"
    if bpy.ops.render.render(animation=True, scene=scene.name) != {"FINISHED"} or not is_complete_image(path):
        raise LodgsError(f"Cannot write frame {frame} of the video to {folder}.", "Free some disk space.")
    return path


def _green_channel(path: Path) -> np.ndarray:
    """Load the green channel of an image, (H, W) float32."""
    image = bpy.data.images.load(str(path))
    try:
        width, height = tuple(image.size)
        pixels = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(pixels)
        return pixels.reshape(height, width, -1)[..., 1]
    finally:
        bpy.data.images.remove(image)


@contextmanager
def _open_video(video: Path) -> Iterator[tuple[bpy.types.Scene, int]]:
    """Yield a temporary scene that renders the frames of a video, and their number."""
    scene = bpy.data.scenes.new("video")
    try:
        strip = compat.sequencer_strips(scene).new_movie("video", str(video), channel=1, frame_start=1)
        element = strip.elements[0] if strip.elements else None
        if element is None or not (element.orig_width and element.orig_height) or strip.frame_duration < 2:
            raise LodgsError(
                f"Cannot read {video}: it is not a video that Blender reads.", "Choose another file."
            )
        render = scene.render
        render.resolution_x, render.resolution_y = element.orig_width, element.orig_height
        render.resolution_percentage = 100
        compat.use_standard_view(scene.view_settings)
        compat.set_png(render.image_settings, alpha=False)
        yield scene, strip.frame_duration
    finally:
        bpy.data.scenes.remove(scene)
