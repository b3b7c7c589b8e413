"""Check that usd-core and Blender 5.3 open our USD files. Part of ``make interop``.

Trains each method briefly and writes its levels as ``.usdc`` and ``.usdz``. usd-core's validators must find
no error. Blender 5.3 must import all levels with the values of their splats and the first view's camera:
LODGS in Blender must draw the finest of them as our renderer does. Blender's own engines shade or blend
splats differently. ``python tools/interop_usd.py BUNDLE.ply ...`` uses given bundles.
Exit code 0: all agree; 1: differences; 2: nothing was checked.
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

BLENDER = ROOT / ".venv-blender-5.3" / "bin" / "python"
ENDINGS = "usdc", "usdz"
MIN_PSNR = 40.0
"""Minimum likeness in dB of the level that Blender imported to our image."""
WIDTH = 240
_EXACT = {"position": 0.0, "scale": 1e-6, "rotation": 1e-6, "sh": 1e-6}
"""Maximum difference of values that Blender imported; scales are relative."""


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("bundles", nargs="*", type=Path, metavar="BUNDLE.ply")
    parser.add_argument("--blender", type=Path, help="internal: folder of a job for Blender")
    parser.add_argument("--images", type=Path, metavar="DIR", help="folder for the images")
    options = parser.parse_args()
    if options.blender:
        open_in_blender(options.blender)
    try:
        from pxr import UsdLod  # noqa: F401
    except ImportError:
        print("interop: usd-core is not installed. USD is not checked.")
        return 2
    if not BLENDER.exists():
        print(f"interop: {BLENDER} is missing; install Python 3.13 and run make setup. USD is not checked.")
        return 2
    from tools.interop_viewers import METHODS, train_method

    failed = False
    for source in options.bundles or [train_method(method) for method in METHODS]:
        failed |= not check(source, options.images)
    return int(failed)


def check(source: Path, images: Path | None) -> bool:
    """Write, validate and import the levels of a bundle, print the results, and return whether all agree."""
    from training.api import load_bundle, render_image
    from training.editing.cleaning import Cleaning
    from training.editing.edit import edit
    from training.editing.portable import portable_levels
    from training.scenes.view_tables import read_view_tables
    from training.splats.levels import Bundle, Level

    bundle = load_bundle(source)
    levels = portable_levels(bundle)[0].bundle.levels
    cameras, near, _ = read_view_tables(bundle.tables)
    camera = cameras[0].scaled(WIDTH / cameras[0].width)
    name = source.parent.name
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder)
        files = [job / f"{name}.{ending}" for ending in ENDINGS]
        edit(source, None, Cleaning(), levels=files, antialiased=True)
        problems = {file.name: validate(file) for file in files}
        sets = {f"Level_{level.number}": level.rows.select(slice(None)) for level in levels}
        for key, splats in sets.items():
            np.savez(job / f"{key}.npz", position=splats.means, sh=splats.sh, **{
                "scale": np.exp(splats.log_scales),
                "rotation": splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True),
            })  # fmt: skip
        size = [camera.width, camera.height]
        facts = {
            "files": [file.name for file in files], "levels": list(sets), "size": size,
            "antialias": bundle.antialias,
        }  # fmt: skip
        (job / "job.json").write_text(json.dumps(facts), "utf-8")
        command = [str(BLENDER), __file__, "--blender", folder]
        process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if not (job / "answer.json").exists():
            print(f"{name}: Blender 5.3 failed: {(process.stderr or process.stdout)[-500:]}")
            return False
        answer = json.loads((job / "answer.json").read_text("utf-8"))
        finest = Bundle("", [Level(1, splats)], meta={"antialias": bundle.antialias})
        expected = render_image(finest, camera, near=near, backend="cpu").clip(0, 1)
        pictures = [expected]
        agrees = True
        for file in (file.name for file in files):
            problem = "; ".join([*problems[file], *answer[file]])
            pictures.append(np.load(job / f"{file}.npy"))
            likeness = float(-10 * np.log10(np.square(pictures[-1] - expected).mean()))
            agrees &= not problem and likeness >= MIN_PSNR
            print(f"{file:<12}  {len(sets)} levels  {likeness:.1f} dB  {problem or 'valid'}", flush=True)
    if images is not None:
        from tools.interop_viewers import save

        save(images, f"{name}-usd.png", pictures)
    return agrees


def validate(file: Path) -> list[str]:
    """Return the errors that usd-core's validators find in a file."""
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(file)))
    return [error.GetErrorString() for error in errors]


def open_in_blender(folder: Path) -> None:
    """Import the files of a job with Blender's importer, compare values, draw the finest level, and exit."""
    from tools.blender_module import EXTENSION, start_blender

    bpy = start_blender()
    job = json.loads((folder / "job.json").read_text("utf-8"))
    viewport_quality = importlib.import_module(f"{EXTENSION}.blender_lodgs.render.viewport_quality")
    answer = {}
    for file in job["files"]:
        bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
        bpy.ops.wm.usd_import(filepath=str(folder / file))
        clouds = {obj.name: obj for obj in bpy.data.objects if obj.type == "POINTCLOUD"}
        problems = [] if sorted(clouds) == sorted(job["levels"]) else [f"Blender imported {sorted(clouds)}"]
        for name in sorted(clouds.keys() & set(job["levels"])):
            problems += compare(clouds[name].data, np.load(folder / f"{name}.npz"), name)
        finest = max(clouds.values(), key=lambda obj: len(obj.data.points))
        for obj in clouds.values():
            if obj is not finest:
                bpy.data.objects.remove(obj)
        scene = bpy.context.scene
        scene.camera = bpy.data.objects["view_00"]
        scene.render.resolution_x, scene.render.resolution_y = job["size"]
        scene.render.resolution_percentage = 100
        scene.view_settings.view_transform = "Standard"
        finest.select_set(True)
        bpy.ops.lodgs.add_to_scene()
        root = next(obj for obj in bpy.data.objects if obj.lodgs.levels)
        root.lodgs.antialias = job["antialias"]
        bpy.context.view_layer.update()
        scene.render.filepath = str(folder / "lodgs")
        (path,) = viewport_quality.render_animation(bpy.context, [1])
        np.save(folder / f"{file}.npy", pixels(bpy, path))
        answer[file] = problems
    (folder / "answer.json").write_text(json.dumps(answer), "utf-8")
    sys.stdout.flush()
    os._exit(0)  # Blender as a module may crash at exit


def compare(cloud: Any, expected: Any, name: str) -> list[str]:
    """Return the differences of a splat cloud from the values (N, ...) of its level."""

    def values(attribute: str, kind: str, width: int) -> np.ndarray:
        result = np.empty((len(cloud.points), width), np.float32)
        cloud.attributes[attribute].data.foreach_get(kind, result.reshape(-1))
        return result

    if len(cloud.points) != len(expected["position"]):
        return [f"{name} has {len(cloud.points):,} splats"]
    rest = expected["sh"].shape[1] - 1
    rotation = values("rotation", "value", 4)
    rotation *= np.sign((rotation * expected["rotation"]).sum(axis=1, keepdims=True))
    sh = np.stack([values(f"radiance:sh_{i}", "vector", 3) for i in range(rest)], axis=1)
    differences = {
        "position": values("position", "vector", 3) - expected["position"],
        "scale": values("scale", "vector", 3) / expected["scale"] - 1,
        "rotation": rotation - expected["rotation"],
        "sh": sh - expected["sh"][:, 1:],
    }
    largest = {key: float(np.abs(value).max(initial=0)) for key, value in differences.items()}
    return [f"{name}: {key} differs by {largest[key]:.2g}" for key in _EXACT if largest[key] > _EXACT[key]]


def pixels(bpy: Any, path: Path) -> np.ndarray:
    """Return the displayed colours (H, W, 3) of an image file."""
    image = bpy.data.images.load(str(path))
    values = np.array(image.pixels[:], np.float32).reshape(image.size[1], image.size[0], 4)
    return values[::-1, :, :3]


if __name__ == "__main__":
    sys.exit(main())
