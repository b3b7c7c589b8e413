"""Check that usd-core and Blender 5.3 open our USD files. Part of ``make interop``.

Trains each method briefly and writes its levels as ``.usdc`` and ``.usdz``. usd-core's validators must find
no error. Blender 5.3 must import all levels with the values of their splats and the first view's camera:
LODGS in Blender must draw the finest of them as our renderer does. Blender's own engines shade or blend
splats differently. ``python tools/interop_usd.py BUNDLE.ply ...`` uses given bundles, without a record.
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
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools.interop_results import Record, store_result  # noqa: E402

if TYPE_CHECKING:
    from training.splats.levels import Level

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
    parser.add_argument("--methods", nargs="+", default=[], help="methods to train, all by default")
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
    for source in options.bundles or [train_method(method) for method in options.methods or METHODS]:
        for result in check(source, options.images):
            failed |= not result["passed"]
            if not options.bundles:
                store_result(result)
    return int(failed)


def check(source: Path, images: Path | None) -> list[Record]:
    """Write, validate and import the levels of a bundle. Print and return the results of both programs."""
    from training.api import load_bundle, render_image
    from training.editing.edit import Outputs, edit
    from training.editing.export import FileOptions
    from training.editing.portable import portable_levels
    from training.scenes.view_tables import read_view_tables
    from training.splats.levels import Bundle, Level

    bundle = load_bundle(source)
    levels = portable_levels(bundle)[0].bundle.levels
    cameras, near, _ = read_view_tables(bundle.tables)
    camera = cameras[0].scaled(WIDTH / cameras[0].width)
    name, antialias = source.parent.name, bundle.antialias
    finest = Bundle("", [Level(1, levels[-1].rows.select(slice(None)))], meta={"antialias": antialias})
    pictures = [render_image(finest, camera, near=near, backend="cpu").clip(0, 1)]
    results = []
    with tempfile.TemporaryDirectory() as folder:
        job = Path(folder)
        files = [job / f"{name}.{ending}" for ending in ENDINGS]
        edit(source, Outputs(levels=files), options=FileOptions(antialiased=True))
        answer = import_in_blender(job, files, levels, [camera.width, camera.height], antialias)
        for file in files:
            faults = validate(file)
            differences = answer["differences"].get(file.name, [answer["problem"]])
            likeness = 0.0
            if (image := job / f"{file.name}.npy").exists():
                pictures.append(np.load(image))
                likeness = float(-10 * np.log10(np.square(pictures[-1] - pictures[0]).mean()))
            problem = "; ".join([*faults, *differences])
            print(
                f"{file.name:<16}  {len(levels)} levels  {likeness:.1f} dB  {problem or 'valid'}", flush=True
            )
            facts = {"check": "usd", "format": file.suffix, "method": name}
            passed = not differences and likeness >= MIN_PSNR
            results += [
                {**facts, "program": "usd-core", "version": version("usd-core"), "passed": not faults},
                {**facts, "program": "Blender", "version": answer["version"], "passed": passed,
                 "levels": len(levels), "psnr": round(likeness, 1), "min_psnr": MIN_PSNR},
            ]  # fmt: skip
    if images is not None:
        from tools.interop_viewers import save

        save(images, f"{name}-usd.png", pictures)
    return results


def import_in_blender(
    job: Path, files: list[Path], levels: list[Level], size: list[int], antialias: bool
) -> dict[str, Any]:
    """Return Blender's version, a problem, and by file name the differences of the imported levels.

    Args:
        job: folder for the task and the images.
        size: width and height of the images.
    """
    for level in levels:
        splats = level.rows.select(slice(None))
        np.savez(job / f"Level_{level.number}.npz", position=splats.means, sh=splats.sh, **{
            "scale": np.exp(splats.log_scales),
            "rotation": splats.quats / np.linalg.norm(splats.quats, axis=1, keepdims=True),
        })  # fmt: skip
    facts = {
        "files": [file.name for file in files], "levels": [f"Level_{level.number}" for level in levels],
        "size": size, "antialias": antialias,
    }  # fmt: skip
    (job / "job.json").write_text(json.dumps(facts), "utf-8")
    command = [str(BLENDER), __file__, "--blender", str(job)]
    process = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if not (job / "answer.json").exists():
        problem = f"Blender failed: {(process.stderr or process.stdout)[-500:]}"
        return {"version": "", "problem": problem, "differences": {}}
    return {"problem": "", **json.loads((job / "answer.json").read_text("utf-8"))}


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
    differences = {}
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
        differences[file] = problems
    answer = {"version": bpy.app.version_string, "differences": differences}
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
