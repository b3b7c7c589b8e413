"""Create the images of docs/manual/photos.md that need no window: masks, alpha, lens distortion and a region.

    python lab/scene_images.py build/scene_images [masks alone lens region]

Uses the commands of that page on the example or on a monkey rendered with Blender; takes a few minutes on two
cores. Check the images and copy them to docs/images.
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
"""Displayed view of the example; not a held-out one."""
HELD_OUT = "view_24.jpg"
STEPS = 500
WIDE = 360
"""Width of each tile in pixels."""
LENS = 0.25, 0.05
"""k1 and k2 of the lens distortion added to the example."""
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
    """Run a lodgs command; raise an error if it fails."""
    subprocess.run([sys.executable, "-m", "training", *map(str, words)], cwd=ROOT, check=True)


def train(scene: Path, run: Path, *words: object, scale: float = 0.5) -> Path:
    shutil.rmtree(run, ignore_errors=True)
    lodgs("train", "--scene", scene, "--out", run, "--method", "3dgs", "--image-scale", scale,
          "--set", f"steps={STEPS}", "--set", "max_splats=20000", *words)  # fmt: skip
    return run


def rendered(run: Path, view: str, *words: object) -> Image.Image:
    path = run / "rendering.png"
    lodgs("render", run, "--view", view, "--out", path, *words)
    return Image.open(path).convert("RGBA")


def copied(scene: Path, change: Callable[[Image.Image, int], Image.Image]) -> Path:
    """Copy the example with changed photos."""
    shutil.rmtree(scene, ignore_errors=True)
    shutil.copytree(GARDEN / "sparse", scene / "sparse")
    (scene / "images").mkdir()
    for number, path in enumerate(sorted((GARDEN / "images").iterdir())):
        change(Image.open(path).convert("RGB"), number).save(scene / "images" / path.name, quality=95)
    return scene


def person_mask(number: int, size: tuple[int, int]) -> Image.Image:
    """Return a mask of a walking person, white, at a position that depends on the photo's number."""
    mask = Image.new("L", size)
    draw, center = ImageDraw.Draw(mask), 60 + (number * 137) % 360
    draw.ellipse((center - 14, 70, center + 14, 104), fill=255)
    draw.rounded_rectangle((center - 26, 106, center + 26, 230), 18, fill=255)
    draw.rectangle((center - 20, 226, center + 20, 319), fill=255)
    return mask


def masks(folder: Path) -> list[Tile]:
    """Train with people in the photos, with and without masks."""

    def add_person(image: Image.Image, number: int) -> Image.Image:
        color = [(150, 40, 50), (40, 60, 140), (60, 110, 70)][number % 3]
        image.paste(color, mask=person_mask(number, image.size))
        return image

    scene = copied(folder / "masked", add_person)
    without = train(scene, folder / "without_masks")
    (scene / "masks").mkdir()
    for number, path in enumerate(sorted((scene / "images").iterdir())):
        person = person_mask(number, Image.open(path).size)
        Image.eval(person, lambda value: 255 - value).save(scene / "masks" / f"{path.name}.png")
    having = train(scene, folder / "with_masks")
    return [
        (f"images/{SEEN}", Image.open(scene / "images" / SEEN)),
        (f"masks/{SEEN}.png", Image.open(scene / "masks" / f"{SEEN}.png")),
        ("trained without masks", rendered(without, SEEN)),
        ("trained with masks", rendered(having, SEEN)),
    ]


def alone(folder: Path) -> list[Tile]:
    """Train an object with transparent background from a Blender scene."""
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
        ("splats, transparent", over(rendered(run, view, "--background", "transparent"), None)),
        ("over white", rendered(run, view, "--background", "1,1,1")),
        ("over magenta", rendered(run, view, "--background", "1,0,1")),
    ]


def over(image: Image.Image, color: tuple[int, int, int] | None) -> Image.Image:
    """Composite an image with alpha over a colour or a checkerboard."""
    width, height = image.size
    if color is None:
        light = 130 + 60 * ((np.arange(height)[:, None] // 12 + np.arange(width) // 12) % 2)
        ground = Image.fromarray(np.repeat(light[..., None], 3, axis=2).astype(np.uint8))
    else:
        ground = Image.new("RGB", image.size, color)
    ground.paste(image.convert("RGB"), mask=image.convert("RGBA").getchannel("A"))
    return ground


def lens(folder: Path) -> list[Tile]:
    """Distort the example's photos and undistort them."""
    subprocess.run([sys.executable, "-c", DISTORT, str(GARDEN), str(folder / "bent")], cwd=ROOT, check=True)
    lodgs("undistort", folder / "bent")
    straight = next((folder / "bent" / ".undistorted").rglob(SEEN))
    return [
        ("photo with lens distortion", Image.open(folder / "bent" / "images" / SEEN)),
        ("undistorted photo", Image.open(straight)),
    ]


DISTORT = f"""
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
    """Train the table in detail and the surroundings coarsely."""
    box = "box -1.2 -1.2 0.4 1.2 1.2 1.8"
    within = train(GARDEN, folder / "region", "--region", box)
    full = train(GARDEN, folder / "full")
    return [
        ("held-out photo", Image.open(GARDEN / "images" / HELD_OUT)),
        ("full scene", rendered(full, HELD_OUT)),
        (f"--region '{box}'", rendered(within, HELD_OUT)),
    ]


def sheet(path: Path, tiles: Sequence[Tile], columns: int) -> None:
    """Write tiles with captions as one image."""
    tiles = [(name, image.convert("RGB")) for name, image in tiles]
    high = max(round(WIDE * image.height / image.width) for _, image in tiles)
    canvas = Image.new(
        "RGB", (columns * (WIDE + 4) - 4, -(-len(tiles) // columns) * (high + 22)), (24, 24, 24)
    )
    draw, font = ImageDraw.Draw(canvas), ImageFont.load_default(size=13)
    for index, (name, image) in enumerate(tiles):
        x, y = index % columns * (WIDE + 4), index // columns * (high + 22)
        size = WIDE, round(WIDE * image.height / image.width)
        canvas.paste(image.resize(size, Image.Resampling.LANCZOS), (x, y + 22))
        draw.text((x + 6, y + 3), name, fill=(230, 230, 230), font=font)
    canvas.save(path, quality=88)
    print(path)


IMAGES = {"masks": (masks, 2), "alone": (alone, 2), "lens": (lens, 2), "region": (region, 3)}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("which", nargs="*", choices=list(IMAGES), metavar="WHICH", help=", ".join(IMAGES))
    options = parser.parse_args()
    folder = options.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    for name in options.which or IMAGES:
        make, columns = IMAGES[name]
        sheet(folder / f"scenes-{name}.jpg", make(folder), columns)
    return 0


if __name__ == "__main__":
    sys.exit(main())
