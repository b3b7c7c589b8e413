"""Render the image of docs/manual/native-splats.md: the same level by LODGS and by Blender.

Run with Blender 5.3 as a module and a graphics driver (software Vulkan will do):

    .venv-blender-5.3/bin/python tools/native_pictures.py LEVELS docs/images/native-splats.jpg

LEVELS is a bundle or a folder of levels trained on examples/lantern_garden.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.blender_module import EXTENSION, start_blender  # noqa: E402

SIZE = (480, 320)
SAMPLES = 8
ENGINES = {"Workbench": "BLENDER_WORKBENCH", "EEVEE": "BLENDER_EEVEE", "Cycles": "CYCLES"}


def main() -> None:
    parser = argparse.ArgumentParser(description="render the image of docs/manual/native-splats.md")
    parser.add_argument("levels", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--engines", nargs="*", default=["Workbench"], choices=ENGINES)
    options = parser.parse_args()
    bpy = start_blender()
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    importing = importlib.import_module(f"{EXTENSION}.blender_lodgs.data.importing")
    placement = importlib.import_module(f"{EXTENSION}.blender_lodgs.data.placement")
    viewport_quality = importlib.import_module(f"{EXTENSION}.blender_lodgs.render.viewport_quality")
    scene = bpy.context.scene
    photos = importing.import_colmap(bpy.context, ROOT / "examples" / "lantern_garden", photographs=False)
    photos.lodgs.points.hide_render = True
    splats = importing.import_splats(bpy.context, options.levels)
    bpy.context.view_layer.update()
    placement.axes_of(splats).matrix_world = placement.axes_of(photos).matrix_world
    scene.render.resolution_x, scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = f"{folder}/LODGS"
        (path,) = viewport_quality.render_animation(bpy.context, [1])
        images = [_pixels(bpy.data.images.load(str(path)))]
        for name in options.engines:
            scene.render.engine = ENGINES[name]
            scene.cycles.samples = scene.eevee.taa_render_samples = SAMPLES
            scene.display.render_aa = "32"
            scene.cycles.use_denoising = False
            scene.render.filepath = f"{folder}/{name}.png"
            bpy.ops.render.render(write_still=True)
            images.append(_pixels(bpy.data.images.load(scene.render.filepath)))
    _save(bpy, images, options.out)
    sys.stdout.flush()
    os._exit(0)  # Blender as a module may crash at exit


def _pixels(image) -> np.ndarray:
    """Return an image's colours as displayed, (height, width, 4), the bottom row first."""
    values = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)
    if image.colorspace_settings.name == "sRGB" or not image.is_float:
        return values
    color = values[..., :3].clip(0, 1)
    values[..., :3] = np.where(color <= 0.0031308, 12.92 * color, 1.055 * color ** (1 / 2.4) - 0.055)
    return values


def _save(bpy, images: list[np.ndarray], path: Path) -> None:
    """Save images in two columns as a JPEG."""
    blank = np.zeros_like(images[0])
    rows = [images[i : i + 2] + [blank] * (2 - len(images[i : i + 2])) for i in range(0, len(images), 2)]
    sheet = np.concatenate([np.concatenate(row, axis=1) for row in reversed(rows)])
    image = bpy.data.images.new("sheet", sheet.shape[1], sheet.shape[0])
    image.pixels = sheet.reshape(-1)
    image.file_format, image.filepath_raw = "JPEG", str(path)
    image.save(quality=90)


if __name__ == "__main__":
    main()
