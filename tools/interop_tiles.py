"""Check that CesiumJS draws our 3D Tiles as we do. Part of ``make interop``.

Writes the levels of a bundle with views as 3D Tiles, draws the first view in Chromium without a window and
without a graphics card, and compares the image with our own. ``python tools/interop_tiles.py [BUNDLE.ply]``
uses a given bundle, or that of ``make demo``. Exit code 0: the images agree; 1: they do not; 2: nothing was
checked.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import urllib.parse
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tools import interop  # noqa: E402
from tools.interop_gltf import draw, judge, prepare  # noqa: E402
from training.api import render_image  # noqa: E402
from training.editing.export import export_tiles  # noqa: E402

PACKAGE, VERSION = "cesium", "1.145.0"
MIN_PSNR = 28.0
"""Minimum likeness of the compressed splats to our image, dB."""
WIDTH = 480


def main() -> int:
    inputs = prepare(PACKAGE, VERSION, WIDTH)
    if inputs is None:
        return 2
    browser, source, bundle, camera = inputs
    axes = bundle.up_rotation @ camera.world_to_camera[:3, :3].T  # right, down and forward, with z up
    view = {
        "eye": (bundle.up_rotation @ camera.center).tolist(), "up": (-axes[:, 1]).tolist(),
        "direction": axes[:, 2].tolist(), "angle": 2 * math.atan(camera.width / 2 / camera.fx),
        "size": [camera.width, camera.height],
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        export_tiles(Path(folder) / "tiles", bundle)
        build = interop.FOLDER / "node_modules" / PACKAGE / "Build" / "Cesium"
        mounts = {"/cesium": build, "/tiles": Path(folder) / "tiles"}
        page, query = Path(__file__).with_suffix(".html"), urllib.parse.quote(json.dumps(view))
        answer = draw(browser, page, mounts, query)
    return judge(f"CesiumJS {VERSION}", answer, render_image(bundle, camera, backend="cpu"), source, MIN_PSNR)


if __name__ == "__main__":
    sys.exit(main())
