"""Offset views: ground-truth views of a scene away from the camera path of its photos, for evaluation only.

    scene/  images/  sparse/0/  aside/NAME.json, each next to the image that it names

A renderer can create them, or they are extra photos registered with the scene.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..errors import LodgsError, printable
from ..splats.origin import NO_ORIGIN
from .cameras import Camera, read_camera
from .image_files import ImageFiles
from .image_headers import image_size


def read_offset_views(scene: Path, origin: np.ndarray = NO_ORIGIN) -> list[Camera]:
    """Read the views of a scene's folder ``aside``, sorted by file name, at their images' size.

    Each file has the format of ``cameras.write_camera``, in the model's world; ``name`` is the image's name.
    Without the folder, the list is empty.

    Args:
        origin: (3,) local origin of the result.

    Raises:
        LodgsError: a camera or its image cannot be read.
    """
    views = []
    files = ImageFiles(scene / "aside")
    for path in sorted((scene / "aside").glob("*.json")):
        camera = read_camera(path)[0].moved(-origin)
        try:
            image = files.find(camera.name)
        except LodgsError as error:
            raise LodgsError(f"Cannot use the image named in {path}: {error.what}") from error
        if image is None:
            raise LodgsError(
                f"Cannot read {path.with_name(printable(camera.name)[:200])}: the file does not exist.",
                f"Add the file, or change the name in {path.name}.",
            )
        views.append(replace(camera.resized(*image_size(image)), image=image))
    return views
