"""Sharp frames of a video, by Blender's own reader, as photographs whose cameras are to be found."""

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

MOST_FRAMES = 120
"""Frames that are kept of a video, if nothing is said."""
CANDIDATES = 3
"""Of so many frames that follow each other the sharpest is kept."""
_NAME = re.compile(r"frame_(\d{6})\.png")


def extract_frames(
    video: Path, folder: Path, most: int, tell: Callable[[int, int], object] = lambda number, count: None
) -> int:
    """Writes at most so many frames of a video, evenly over time, the sharpest of those about each.

    Frames are named by their numbers. Where some are there already, it goes on.

    Args:
        tell: is told before each frame which one it is, from 1 on, and of how many.

    Returns:
        How many there are.

    Raises:
        LodgsError: it cannot be read as a video, or the folder cannot be written.
    """
    with _reading(video) as (scene, frames):
        count = min(most, frames)
        edges = np.linspace(0, frames, count + 1).astype(int)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there = [int(found[1]) for path in folder.iterdir() if (found := _NAME.fullmatch(path.name))]
            for number, (first, end) in enumerate(pairwise(edges), 1):
                tell(number, count)
                if any(first < frame <= end for frame in there):
                    continue
                tried = np.unique(np.linspace(first + 1, end, CANDIDATES, dtype=int))
                with tempfile.TemporaryDirectory(dir=folder, prefix=".frames-") as work:
                    pictures = [_render(scene, int(frame), Path(work)) for frame in tried]
                    best = max(pictures, key=lambda picture: sharpness(_light(picture)))
                    os.replace(best, folder / best.name)
        except OSError as error:
            raise LodgsError(
                f"{folder} could not be written: {error.strerror or error}.", "Choose another folder."
            ) from error
    return count


def sharpness(light: np.ndarray) -> float:
    """How much a picture (H, W) differs from the mean of its neighbours: the variance of its Laplacian
    (Pech-Pacheco et al. 2000)."""
    middle = light[1:-1, 1:-1]
    around = light[:-2, 1:-1] + light[2:, 1:-1] + light[1:-1, :-2] + light[1:-1, 2:]
    return float(np.var(around - 4 * middle))


def _render(scene: bpy.types.Scene, frame: int, folder: Path) -> Path:
    """A frame as a file; an animation of it alone, because a still of another scene is always its first."""
    scene.frame_start = scene.frame_end = frame
    scene.render.filepath = str(folder / "frame_######")
    path = folder / f"frame_{frame:06d}.png"
    if bpy.ops.render.render(animation=True, scene=scene.name) != {"FINISHED"} or not path.is_file():
        raise LodgsError(f"Frame {frame} of the video could not be written.", "Free some space there.")
    return path


def _light(path: Path) -> np.ndarray:
    """The green of a picture, (H, W) float32."""
    image = bpy.data.images.load(str(path))
    try:
        width, height = tuple(image.size)
        pixels = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(pixels)
        return pixels.reshape(height, width, -1)[..., 1]
    finally:
        bpy.data.images.remove(image)


@contextmanager
def _reading(video: Path) -> Iterator[tuple[bpy.types.Scene, int]]:
    """A scene of the video's size, whose frames are the video's, and how many these are."""
    scene = bpy.data.scenes.new("video")
    try:
        strip = compat.strips(scene).new_movie("video", str(video), channel=1, frame_start=1)
        element = strip.elements[0] if strip.elements else None
        if element is None or not (element.orig_width and element.orig_height) or strip.frame_duration < 2:
            raise LodgsError(f"{video} cannot be read as a video.", "Choose another file.")
        render = scene.render
        render.resolution_x, render.resolution_y = element.orig_width, element.orig_height
        render.resolution_percentage = 100
        scene.view_settings.view_transform = "Standard"
        compat.png(render.image_settings, alpha=False)
        yield scene, strip.frame_duration
    finally:
        bpy.data.scenes.remove(scene)
