"""The pictures of docs/scenes.md that need no window: what masks, alpha, lenses and a region change.

    python lab/scene_images.py build/scene_images [masks alone lens region]

Each is made by the commands that its page tells of, of the example or of a monkey that Blender renders; a few
minutes on two cores. Then look at them, and copy what is to be shown to docs/images.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))

GARDEN = ROOT / "examples" / "lantern_garden"
AS_BLENDER = ROOT / "tests" / "blender" / "as_blender.py"
SEEN = "view_20.jpg"
"""The view of the example that is shown; not one that is held out."""
HELD_OUT = "view_24.jpg"
STEPS = 500
WIDE = 360
"""Pixels across each part of a picture."""
LENS = 0.25, 0.05
"""k1 and k2 of the lens that bends the example's lines."""
MONKEY = """
import bpy, sys
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_monkey_add()
monkey = bpy.context.object
monkey.modifiers.new("Smooth", "SUBSURF").render_levels = 2
fur = bpy.data.materials.new("Fur")
fur.use_nodes = True
nodes, links = fur.node_tree.nodes, fur.node_tree.links
pattern, ramp = nodes.new("ShaderNodeTexVoronoi"), nodes.new("ShaderNodeValToRGB")
pattern.inputs["Scale"].default_value = 6
ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (0.9, 0.4, 0.1, 1), (0.1, 0.2, 0.5, 1)
links.new(pattern.outputs["Distance"], ramp.inputs["Fac"])
links.new(ramp.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
monkey.data.materials.append(fur)
bpy.ops.object.light_add(type="SUN", rotation=(0.6, 0.3, 0))
scene = bpy.context.scene
scene.world = bpy.data.worlds.new("World")
scene.world.use_nodes = True
scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.8, 0.8, 0.8, 1)
scene.render.engine, scene.cycles.samples, scene.render.film_transparent = "CYCLES", 16, True
bpy.ops.wm.save_as_mainfile(filepath=sys.argv[1])
"""

Tile = tuple[str, Image.Image]


def lodgs(*words: object) -> None:
    """The command, which has to succeed."""
    subprocess.run([sys.executable, "-m", "training", *map(str, words)], cwd=ROOT, check=True)


def train(scene: Path, run: Path, *words: object, scale: float = 0.5) -> Path:
    shutil.rmtree(run, ignore_errors=True)
    lodgs("train", "--scene", scene, "--out", run, "--method", "3dgs", "--image-scale", scale,
          "--set", f"steps={STEPS}", "--set", "max_splats=20000", *words)  # fmt: skip
    return run


def drawn(run: Path, view: str, *words: object) -> Image.Image:
    picture = run / "picture.png"
    lodgs("render", run, "--view", view, "--out", picture, *words)
    return Image.open(picture).convert("RGBA")


def copied(scene: Path, change: Callable[[Image.Image, int], Image.Image]) -> Path:
    """The example with other photographs."""
    shutil.rmtree(scene, ignore_errors=True)
    shutil.copytree(GARDEN / "sparse", scene / "sparse")
    (scene / "images").mkdir()
    for number, path in enumerate(sorted((GARDEN / "images").iterdir())):
        change(Image.open(path).convert("RGB"), number).save(scene / "images" / path.name, quality=95)
    return scene


def passer_by(number: int, size: tuple[int, int]) -> Image.Image:
    """Where somebody stands in a photograph, white; each time elsewhere, as people walk on."""
    picture = Image.new("L", size)
    draw, middle = ImageDraw.Draw(picture), 60 + (number * 137) % 360
    draw.ellipse((middle - 14, 70, middle + 14, 104), fill=255)
    draw.rounded_rectangle((middle - 26, 106, middle + 26, 230), 18, fill=255)
    draw.rectangle((middle - 20, 226, middle + 20, 319), fill=255)
    return picture


def masks(folder: Path) -> list[Tile]:
    """People who walk through, with masks and without."""

    def walked_through(picture: Image.Image, number: int) -> Image.Image:
        color = [(150, 40, 50), (40, 60, 140), (60, 110, 70)][number % 3]
        picture.paste(color, mask=passer_by(number, picture.size))
        return picture

    scene = copied(folder / "masked", walked_through)
    without = train(scene, folder / "without_masks")
    (scene / "masks").mkdir()
    for number, path in enumerate(sorted((scene / "images").iterdir())):
        person = passer_by(number, Image.open(path).size)
        Image.eval(person, lambda value: 255 - value).save(scene / "masks" / f"{path.name}.png")
    having = train(scene, folder / "with_masks")
    return [
        (f"images/{SEEN}", Image.open(scene / "images" / SEEN)),
        (f"masks/{SEEN}.png", Image.open(scene / "masks" / f"{SEEN}.png")),
        ("trained without masks", drawn(without, SEEN)),
        ("trained with masks", drawn(having, SEEN)),
    ]


def alone(folder: Path) -> list[Tile]:
    """A thing on transparent ground, from a Blender scene."""
    blend, scene, view = folder / "monkey.blend", folder / "monkey", "view_0006.png"
    subprocess.run([sys.executable, "-c", MONKEY, str(blend)], check=True)
    subprocess.run(
        [sys.executable, str(AS_BLENDER), "--command", "lodgs", "capture", str(blend), "--out", str(scene),
         "--around", "--views", "24", "--size", "300x200"],
        check=True, stdout=subprocess.DEVNULL, env=os.environ | {"LODGS_TRAINER_PYTHON": sys.executable},
    )  # fmt: skip
    run = train(scene, folder / "monkey_run", scale=1)
    return [
        ("a view, captured with a transparent film", over(Image.open(scene / "images" / view), None)),
        ("splats, transparent", over(drawn(run, view, "--background", "transparent"), None)),
        ("over white", drawn(run, view, "--background", "1,1,1")),
        ("over magenta", drawn(run, view, "--background", "1,0,1")),
    ]


def over(picture: Image.Image, color: tuple[int, int, int] | None) -> Image.Image:
    """A picture with alpha over a colour, or over a checkerboard."""
    width, height = picture.size
    if color is None:
        light = 130 + 60 * ((np.arange(height)[:, None] // 12 + np.arange(width) // 12) % 2)
        ground = Image.fromarray(np.repeat(light[..., None], 3, axis=2).astype(np.uint8))
    else:
        ground = Image.new("RGB", picture.size, color)
    ground.paste(picture.convert("RGB"), mask=picture.convert("RGBA").getchannel("A"))
    return ground


def lens(folder: Path) -> list[Tile]:
    """Photographs whose lens bends lines, as they are and straightened."""
    subprocess.run([sys.executable, "-c", BENT, str(GARDEN), str(folder / "bent")], cwd=ROOT, check=True)
    lodgs("undistort", folder / "bent")
    straight = next((folder / "bent" / ".undistorted").rglob(SEEN))
    return [
        ("as its lens took it", Image.open(folder / "bent" / "images" / SEEN)),
        ("straightened", Image.open(straight)),
    ]


BENT = f"""
import sys
from pathlib import Path
import numpy as np, pycolmap
garden, folder = map(Path, sys.argv[1:])
model = pycolmap.Reconstruction(garden / "sparse" / "0")
(camera,) = model.cameras.values()
fx, fy, cx, cy = camera.params
camera.model = pycolmap.CameraModelId.OPENCV
camera.params = [fx, fy, cx, cy, *{LENS!r}, 0, 0]
(folder / "sparse" / "0").mkdir(parents=True, exist_ok=True)
(folder / "images").mkdir(exist_ok=True)
model.write(folder / "sparse" / "0")
y, x = np.mgrid[:camera.height, :camera.width] + 0.5
rays = np.array(camera.cam_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))
u, v = rays[:, 0] * fx + cx - 0.5, rays[:, 1] * fy + cy - 0.5
for path in sorted((garden / "images").iterdir()):
    pixels = pycolmap.Bitmap.read(path, True).to_array()
    left, top = (np.clip(np.floor(each), 0, side - 2).astype(int)
                 for each, side in ((u, camera.width), (v, camera.height)))
    a, b = np.clip(u - left, 0, 1)[:, None], np.clip(v - top, 0, 1)[:, None]
    upper = pixels[top, left] * (1 - a) + pixels[top, left + 1] * a
    lower = pixels[top + 1, left] * (1 - a) + pixels[top + 1, left + 1] * a
    bent = (upper * (1 - b) + lower * b).reshape(camera.height, camera.width, 3)
    bent[((u < -0.5) | (u > camera.width) | (v < -0.5) | (v > camera.height)).reshape(bent.shape[:2])] = 0
    pycolmap.Bitmap.from_array(np.rint(bent).astype(np.uint8)).write(folder / "images" / path.name)
"""


def region(folder: Path) -> list[Tile]:
    """The table in detail, and all else coarsely."""
    box = "box -1.2 -1.2 0.4 1.2 1.2 1.8"
    within = train(GARDEN, folder / "region", "--region", box)
    whole = train(GARDEN, folder / "whole")
    return [
        ("a photograph that was held out", Image.open(GARDEN / "images" / HELD_OUT)),
        ("trained as a whole", drawn(whole, HELD_OUT)),
        (f"--region '{box}'", drawn(within, HELD_OUT)),
    ]


def sheet(path: Path, tiles: Sequence[Tile], columns: int) -> None:
    """Writes tiles with their captions side by side."""
    tiles = [(name, image.convert("RGB")) for name, image in tiles]
    high = max(round(WIDE * image.height / image.width) for _, image in tiles)
    whole = Image.new(
        "RGB", (columns * (WIDE + 4) - 4, -(-len(tiles) // columns) * (high + 22)), (24, 24, 24)
    )
    draw, font = ImageDraw.Draw(whole), ImageFont.load_default(size=13)
    for place, (name, image) in enumerate(tiles):
        x, y = place % columns * (WIDE + 4), place // columns * (high + 22)
        size = WIDE, round(WIDE * image.height / image.width)
        whole.paste(image.resize(size, Image.Resampling.LANCZOS), (x, y + 22))
        draw.text((x + 6, y + 3), name, fill=(230, 230, 230), font=font)
    whole.save(path, quality=88)
    print(path)


SHOWN = {"masks": (masks, 2), "alone": (alone, 2), "lens": (lens, 2), "region": (region, 3)}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("which", nargs="*", choices=list(SHOWN), metavar="WHICH", help=", ".join(SHOWN))
    chosen = parser.parse_args()
    folder = chosen.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for name in chosen.which or SHOWN:
        make, columns = SHOWN[name]
        sheet(folder / f"scenes-{name}.jpg", make(folder), columns)
    return 0


if __name__ == "__main__":
    sys.exit(main())
