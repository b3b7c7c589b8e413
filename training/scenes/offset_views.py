"""Views of a scene off the path that it was photographed on: what is right a step aside, where that is known.

    scene/  images/  sparse/0/  aside/NAME.json, each beside the picture that it names

Nobody trains on them. A renderer can make them, or somebody who photographs and registers them besides.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from ..errors import LodgsError, printable
from .cameras import Camera, read_camera
from .image_files import ImageFiles
from .images import image_size


def read_offset_views(scene: Path) -> list[Camera]:
    """The views in a scene's folder ``aside`` by file name, at their pictures' size; none without the folder.

    Each is a JSON file as ``cameras.write_camera`` makes it, in the model's world; ``name`` is the picture's.

    Raises:
        LodgsError: a camera or its picture cannot be read.
    """
    found, pictures = [], ImageFiles(scene / "aside", scene)
    for path in sorted((scene / "aside").glob("*.json")):
        camera, _ = read_camera(path)
        try:
            image = pictures.find(camera.name)
        except LodgsError as error:
            raise LodgsError(f"The picture that {path} names cannot be taken: {error.what}") from error
        if image is None:
            raise LodgsError(
                f"{path.with_name(printable(camera.name)[:200])} cannot be read: there is no such file.",
                f"{path.name} names it.",
            )
        found.append(replace(camera.resized(*image_size(image)), image=image))
    return found
